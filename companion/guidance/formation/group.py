"""Agreement of a formation's vehicles on plan, members and slots, without negotiation.

Every vehicle publishes its own note with its pose, and reads those of the others. The greatest published plan
holds for all, so a command to one vehicle changes the formation. The first by name of the vehicles that are
not silent assigns the slots; the others adopt its assignment; when it falls silent the next one assigns.
Slots are assigned again only when the members, the plan or the requested slots change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from companion.geometry.formation import Vector3, assign, radius_m, slots
from companion.guidance.formation.neighbours import Neighbour
from companion.guidance.formation.pose import FormationNote, Plan

# The slot of a silent vehicle is kept free for this long: it may still be there, or come back.
CLOSE_UP_S = 5.0


@dataclass(frozen=True, slots=True)
class Agreement:
    """The current agreement.

    Attributes:
        plan: the active plan. slots: vehicle → slot, from 1. count: number of slots.
        by: the vehicle that assigned them.
        worst_error_m: greatest slot error of the members that are not silent.
    """

    plan: Plan
    slots: dict[str, int]
    count: int
    by: str
    worst_error_m: float = 0.0

    def offset(self, name: str, *, centre_taken: bool) -> Vector3 | None:
        """A vehicle's slot offset, (forward, right, down) metres from the leader; None: none assigned yet."""
        number = self.slots.get(name)
        if number is None or number > self.count:
            return None
        return slots(self.plan.shape, self.count, self.plan.spacing_m, centre_taken=centre_taken)[number - 1]

    def reach_m(self, *, centre_taken: bool) -> float:
        """Horizontal distance of the outermost slot, metres."""
        return radius_m(slots(self.plan.shape, self.count, self.plan.spacing_m, centre_taken=centre_taken))


@dataclass
class Group:
    """One vehicle's membership in a formation about a leader.

    Args:
        own: its name. leader: name of the leader. wish: the slot requested for it, from 1; None: any.
        centre_taken: the leader is a vehicle, and its own position is not a slot.
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
        self, others: Sequence[Neighbour], positions: dict[str, Vector3], own_error_m: float = 0.0
    ) -> Agreement:
        """Derive the agreement from the neighbours' current notes.

        Args:
            others: all neighbours; those of other formations are ignored.
            positions: name → (forward, right, down) from the leader, of every neighbour and this vehicle.
            own_error_m: slot error of this vehicle.
        """
        notes = {
            other.name: other.formation
            for other in others
            if other.formation is not None
            and other.formation.leader == self.leader
            and other.age_s <= CLOSE_UP_S
        }
        active = [other.name for other in others if other.name in notes and not other.silent]
        plan = self._agreed_plan([note.plan for note in notes.values()])
        by = min([self.own, *active])
        if by == self.own:
            self._assign(plan, notes, positions)
        elif notes[by].plan == plan and notes[by].count:
            self._slots, self._count, self._basis = dict(notes[by].slots), notes[by].count, None
        worst = max([own_error_m, *(notes[name].error_m for name in active)])
        return Agreement(plan, dict(self._slots), self._count, by, worst)

    def _agreed_plan(self, plans: Sequence[Plan]) -> Plan:
        newest = max(plans, default=None)
        if self._plan is None:
            # A command equal to the active plan joins it; any other is a newer plan.
            if newest is not None and (newest.shape, newest.spacing_m) == (self.shape, self.spacing_m):
                self._plan = newest
            else:
                version = 1 if newest is None else newest.version + 1
                self._plan = Plan(version, self.own, self.shape, self.spacing_m)
        elif newest is not None:
            self._plan = max(self._plan, newest)
        return self._plan

    def _assign(self, plan: Plan, notes: dict[str, FormationNote], positions: dict[str, Vector3]) -> None:
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
        # A vehicle that requested an occupied slot gets none; its behaviour ends with that reason.
        rest = [name for name in sorted(wishes) if wishes[name] is None]
        # Slots are filled in order, without gaps.
        free = free[: len(rest)]
        indices = assign([positions[name] for name in rest], [offsets[number - 1] for number in free])
        self._slots = {**granted, **{name: free[index] for name, index in zip(rest, indices, strict=True)}}
