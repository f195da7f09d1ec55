"""How vehicles that fly in one formation agree: on the plan, on who is in it, and on who takes which slot.

Nobody is asked and nothing is waited for. Every vehicle tells its own note with its pose, and reads those of
the others. Of the plans told the greatest holds for all, so a command to one of them changes the formation.
Of those who are heard the one whose name comes first assigns the slots, and the others take what it tells;
when it falls silent the next one does. Slots are assigned anew only when somebody comes, goes or wishes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from companion.geometry.formation import Vector3, assign, radius_m, slots
from companion.guidance.formation.neighbours import Neighbour
from companion.guidance.formation.pose import FormationNote, Plan

# So long the slot of a silent vehicle is kept free: it may be where it was, and it may come back.
CLOSE_UP_S = 5.0


@dataclass(frozen=True, slots=True)
class Agreement:
    """What holds now.

    Attributes:
        plan: what is flown. slots: name → slot, from 1. count: of slots.
        by: who assigned them. members: names of all in it, also of the silent ones.
        worst_error_m: of those that are heard, how far the farthest is from its slot.
    """

    plan: Plan
    slots: dict[str, int]
    count: int
    by: str
    members: tuple[str, ...]
    worst_error_m: float = 0.0

    def offset(self, name: str, *, centre_taken: bool) -> Vector3 | None:
        """The slot of a vehicle: (forward, right, down) metres of the leader; None: it has none yet."""
        number = self.slots.get(name)
        if number is None or number > self.count:
            return None
        return slots(self.plan.shape, self.count, self.plan.spacing_m, centre_taken=centre_taken)[number - 1]

    def reach_m(self, *, centre_taken: bool) -> float:
        """How far out the outermost slot is."""
        return radius_m(slots(self.plan.shape, self.count, self.plan.spacing_m, centre_taken=centre_taken))


@dataclass
class Group:
    """One vehicle's part in a formation about a leader.

    Args:
        own: its name. leader: whom all follow. wish: the slot it shall have, from 1; None: any.
        centre_taken: the leader is a vehicle, and its own place no slot.
    """

    own: str
    leader: str
    shape: str
    spacing_m: float
    wish: int | None = None
    centre_taken: bool = True
    _plan: Plan | None = None
    _slots: dict[str, int] = field(default_factory=dict)
    _count: int = 0
    _basis: object = None

    def agree(
        self, others: Sequence[Neighbour], places: dict[str, Vector3], own_error_m: float = 0.0
    ) -> Agreement:
        """What holds, by all that is heard now.

        Args:
            others: all neighbours; those of other formations are passed over.
            places: name → (forward, right, down) of the leader, of every neighbour and of this vehicle.
            own_error_m: how far this vehicle is from its slot.
        """
        notes = {
            other.name: other.formation
            for other in others
            if other.formation is not None
            and other.formation.leader == self.leader
            and other.age_s <= CLOSE_UP_S
        }
        heard = [other.name for other in others if other.name in notes and not other.silent]
        plan = self._agreed_plan([note.plan for note in notes.values()])
        by = min([self.own, *heard])
        if by == self.own:
            self._assign(plan, notes, places)
        elif notes[by].plan == plan and notes[by].count:
            self._slots, self._count, self._basis = dict(notes[by].slots), notes[by].count, None
        worst = max([own_error_m, *(notes[name].error_m for name in heard)])
        members = tuple(sorted([self.own, *notes]))
        return Agreement(plan, dict(self._slots), self._count, by, members, worst)

    def _agreed_plan(self, told: Sequence[Plan]) -> Plan:
        newest = max(told, default=None)
        if self._plan is None:
            # A command that says what is flown already joins; any other is a newer plan.
            if newest is not None and (newest.shape, newest.spacing_m) == (self.shape, self.spacing_m):
                self._plan = newest
            else:
                version = 1 if newest is None else newest.version + 1
                self._plan = Plan(version, self.own, self.shape, self.spacing_m)
        elif newest is not None:
            self._plan = max(self._plan, newest)
        return self._plan

    def _assign(self, plan: Plan, notes: dict[str, FormationNote], places: dict[str, Vector3]) -> None:
        wishes = {self.own: self.wish, **{name: note.wish for name, note in notes.items()}}
        basis = (plan, tuple(sorted(wishes.items())))
        if basis == self._basis:
            return
        self._basis = basis
        granted: dict[str, int] = {}
        for name, wish in sorted(wishes.items()):
            if wish is not None and wish not in granted.values():
                granted[name] = wish
        self._count = max([len(wishes), *granted.values()])
        offsets = slots(plan.shape, self._count, plan.spacing_m, centre_taken=self.centre_taken)
        free = [number for number in range(1, self._count + 1) if number not in granted.values()]
        # Who wished for a taken slot gets none: its operator is told so.
        rest = [name for name in sorted(wishes) if wishes[name] is None]
        # The best slots are filled first: none stays empty before one that is taken.
        free = free[: len(rest)]
        taken = assign([places[name] for name in rest], [offsets[number - 1] for number in free])
        self._slots = {**granted, **{name: free[index] for name, index in zip(rest, taken, strict=True)}}
