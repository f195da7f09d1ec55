"""Formation: hold a slot relative to a leader, which is a vehicle or a virtual point on a path.

The slot is fixed in the leader's heading frame. Its velocity (the leader's plus that of the turn) is fed
forward, and the position error is corrected by a proportional law, the same for every vehicle, so that
vehicles that change slots do not collide (`companion.geometry.formation.assign`). A leader whose pose is lost
is not predicted: its followers brake, hold, and end after `lost_timeout_s`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

from companion.geometry.formation import SHAPES, Vector3, slot_motion
from companion.geometry.points import points_from
from companion.guidance.behaviour import Behaviour, BehaviourContext, BehaviourOutput, Outcome, Requirement
from companion.guidance.command import (
    BuildContext,
    Command,
    EnumArgument,
    GrammarError,
    Number,
    Points,
    Word,
    behaviour,
)
from companion.guidance.formation.group import Agreement, Group
from companion.guidance.formation.neighbours import Neighbour, Neighbourhood, anchored
from companion.guidance.formation.pose import FormationNote, Plan, Structure
from companion.guidance.formation.separation import MARGIN_M, avoid, repulsion
from companion.guidance.formation.virtual_structure import VirtualStructure
from companion.guidance.motion import (
    Lasting,
    Standing,
    add_velocity_error,
    home_of,
    position_and_yaw,
    stopping_speed,
)
from companion.vehicle.setpoint import Setpoint
from vision.attitude import wrap_angle

VIRTUAL = "virtual"
# Gain of the position error, 1/s, and the limits of its horizontal and vertical velocity.
SLOT_GAIN_PER_S = 0.8
CATCH_UP_MPS = 1.8
CLIMB_MPS = 1.0
# Limits of the outermost slot's speed and acceleration in a turn.
SWING_MPS = 1.5
SWING_MPS2 = 0.7
# A neighbour slower than this relative to the formation is an obstacle to fly around.
IN_THE_WAY_MPS = 0.6
# Clearance of detours around others, added to the minimum separation.
CLEARANCE_M = 1.2
# Nearer than this to its slot the vehicle flies straight there.
FAR_M = 3.0
# Virtual structure: slot tolerance and duration for completion; then how long completion is published.
ARRIVED_M, ARRIVED_S, PUBLISH_S = 1.2, 1.0, 1.5
OVER = f"the structure has flown its path, all within {ARRIVED_M:g} m of their slots"


@dataclass(frozen=True, slots=True)
class _Leader:
    """Motion of the leader, local NED; the heading may jump."""

    position: Vector3
    velocity: Vector3
    heading_rad: float
    turn_rate_radps: float
    over: bool = False


# Sanity limit.
MOST_SLOTS = 200


@behaviour("formation", "hold a slot about a leader: another vehicle, or a virtual one on a path")
class Formation(Command):
    shape: Annotated[str, EnumArgument("shape", SHAPES, "of the formation")]
    leader: Annotated[str, Word("leader", 'vehicle.name of the leader, or "virtual"')]
    spacing_m: Annotated[float, Number("spacing", "m", 1.0, 100.0, "between neighbouring slots")] = 6.0
    slot: Annotated[str, Word("slot", "slot number from 1, or auto")] = "auto"
    points: Annotated[
        str | None, Points("points", 'path of a virtual leader, from home: "0,0 20,0 20,20,8"')
    ] = None
    speed_mps: Annotated[float, Number("speed", "m/s", 0.2, 20.0, "maximum speed of a virtual leader")] = 2.0
    laps: Annotated[float, Number("laps", "", 0.0, 1000.0, "of its path; 0: until another command")] = 1.0
    lost_timeout_s: Annotated[
        float, Number("lost_timeout", "s", 0.5, 600.0, "how long to hold without the leader's pose")
    ] = 5.0

    @property
    def endless(self) -> bool:
        return self.points is None or self.laps == 0.0

    @property
    def slot_number(self) -> int | None:
        """None: auto."""
        return None if self.slot == "auto" else int(self.slot)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.slot != "auto" and not (self.slot.isdecimal() and 1 <= int(self.slot) <= MOST_SLOTS):
            raise GrammarError(f"formation: slot must be auto or 1 to {MOST_SLOTS}, got {self.slot!r}")
        if (self.leader == VIRTUAL) != (self.points is not None):
            raise GrammarError("formation: give both leader=virtual and points=…, or neither")
        if 0.0 < self.laps < 1.0:
            raise GrammarError(f"formation: laps must be 0, or 1 or more, got {self.laps:g}")

    def build(self, context: BuildContext) -> Behaviour:
        return FormationBehaviour(self)


class FormationBehaviour(Behaviour):
    """Holds a slot until another command comes, or a virtual structure has flown its path.

    Attributes:
        note: published to the others; None while inactive.
        slot_offset_ned_m: from the leader to the slot, as last commanded.
    """

    name = "formation"
    requirements = frozenset({Requirement.POSITION, Requirement.IN_AIR, Requirement.NEIGHBOURS})

    def __init__(self, command: Formation) -> None:
        self._command, self._slot, self.leader_name = command, command.slot_number, command.leader
        path = points_from(command.points or ""), command.speed_mps, command.laps
        self._structure = VirtualStructure(*path) if command.leader == VIRTUAL else None
        self.neighbour_names = (command.leader,) if self._structure is None else ()
        self._reset()

    def _reset(self) -> None:
        self._group: Group | None = None
        self._agreement: Agreement | None = None
        self._heading_rad: float | None = None
        self._turn_rate_radps = 0.0
        self._error_m = 0.0
        self._lost, self._arrived = Lasting(), Lasting()
        self._standing: Standing | None = None
        self._over_since_ns: int | None = None
        self._led: bool | None = None
        self._words = "waiting for the others"
        self._side = 1.0
        self.note = None
        self.slot_offset_ned_m: Vector3 | None = None

    def on_activate(self, context: BehaviourContext) -> None:
        self._reset()

    def on_deactivate(self) -> None:
        self.note = None

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        hood = context.neighbourhood
        if hood is not None:
            hood = anchored(hood, context.state, context.now_ns)
        if hood is None or hood.problem is not None or hood.anchor is None:
            why = "pose sharing is off" if hood is None else hood.problem
            return self._without_leader(dt_s, context, why)
        leader = self._leader(dt_s, context, hood)
        if isinstance(leader, Outcome):
            return leader
        if isinstance(leader, str):
            self._report_waiting(hood)
            return self._without_leader(dt_s, context, leader)
        self._lost.held_s(False, context.now_ns)
        position, _ = position_and_yaw(context.state)
        if self._heading_rad is None:
            self._heading_rad = leader.heading_rad
        agreement = self._agree(hood, leader, position)
        if ended := self._ended(context, agreement, leader):
            return ended
        self._turn(dt_s, hood, leader, agreement)
        offset = agreement.offset(hood.own, centre_taken=self._centre_taken(hood))
        self._publish(hood, agreement)
        if offset is None:
            self._words = f"waiting for a slot from {agreement.by}"
            return self._stand(dt_s, context)
        self._standing = None
        return self._fly(context, hood, leader, agreement, offset, position)

    # ---- the leader -------------------------------------------------------------------------------------

    def _leader(self, dt_s: float, context: BehaviourContext, hood: Neighbourhood) -> _Leader | Outcome | str:
        """The leader's motion; a string: why it is unknown now; an Outcome: why it cannot be followed."""
        if self._structure is not None:
            return self._virtual_leader(dt_s, context, hood, self._structure)
        if self.leader_name == hood.own:
            return Outcome(False, f"{hood.own} cannot follow itself: name another leader")
        leader = hood.named(self.leader_name)
        if leader is None or leader.silent:
            return f"no pose from the leader {self.leader_name}"
        if leader.formation is not None and leader.formation.leader == hood.own:
            return Outcome(False, f"{leader.name} follows {hood.own}: vehicles cannot follow each other")
        if not (leader.airborne or leader.virtual):
            return Outcome(False, f"the leader {leader.name} is on the ground")
        self._note_command(leader)
        return _Leader(
            leader.position_ned_m, leader.velocity_ned_mps, leader.heading_rad, leader.turn_rate_radps
        )

    def _note_command(self, leader: Neighbour) -> None:
        """Note that the leader's pilot or a failsafe has taken it from its service, and the end of that."""
        if leader.in_command is None or leader.in_command is self._led:
            return
        if not leader.in_command:
            still = "" if self._led is None else " any more"
            self.add_notes(
                f"the leader {leader.name} is not flown by its service{still}, but by its pilot or autopilot "
                f"in mode {leader.mode}; it is followed there"
            )
        elif self._led is False:
            self.add_notes(f"the leader {leader.name} is flown by its service again")
        self._led = leader.in_command

    def _virtual_leader(
        self, dt_s: float, context: BehaviourContext, hood: Neighbourhood, structure: VirtualStructure
    ) -> _Leader | Outcome | str:
        assert hood.anchor is not None
        published = self._published_structures(hood)
        mover = min((other.name for other, _ in self._companions(hood) if not other.silent), default=hood.own)
        if mover < hood.own:
            if mover not in published:
                return f"no structure state from {mover} yet"
            structure.leave()
            other, where = published[mover]
            point = hood.anchor.local(*where.place)
            north, east, down = (
                p + v * other.age_s for p, v in zip(point, where.velocity_ned_mps, strict=True)
            )
            return _Leader((north, east, down), where.velocity_ned_mps, where.heading_rad, 0.0, where.over)
        try:
            if not structure.started:
                known = max((where for _, where in published.values()), key=lambda w: w.along_m, default=None)
                if known is not None:
                    structure.take_over(hood.anchor, known)
                else:
                    home = home_of(context.state)
                    structure.begin(hood.anchor, home, context.state.altitude_m or 0.0)
        except ValueError as error:
            return Outcome(False, f"{self.name}: {error}")
        position, velocity, heading = structure.motion()
        if heading is None:
            heading = self._heading_rad if self._heading_rad is not None else 0.0
        if self._agreement is not None and self._agreement.by == hood.own:
            off_rad = 0.0 if self._heading_rad is None else heading - self._heading_rad
            structure.move(dt_s, self._agreement.worst_error_m, off_rad)
        return _Leader(position, velocity, heading, 0.0, self._over_since_ns is not None)

    def _companions(self, hood: Neighbourhood) -> list[tuple[Neighbour, FormationNote]]:
        """The known neighbours in this formation, and their parts in it."""
        noted = ((other, other.formation) for other in hood.vehicles)
        return [(other, note) for other, note in noted if note and note.leader == self.leader_name]

    def _published_structures(self, hood: Neighbourhood) -> dict[str, tuple[Neighbour, Structure]]:
        return {
            other.name: (other, note.structure)
            for other, note in self._companions(hood)
            if note.structure is not None
        }

    def _centre_taken(self, hood: Neighbourhood) -> bool:
        leader = hood.named(self.leader_name)
        return self._structure is None and not (leader is not None and leader.virtual)

    # ---- the other vehicles ---------------------------------------------------------------------------

    def _agree(self, hood: Neighbourhood, leader: _Leader, position: Vector3) -> Agreement:
        if self._group is None:
            shape, spacing_m = self._command.shape, self._command.spacing_m
            self._group = Group(hood.own, self.leader_name, shape, spacing_m, self._slot)
        self._group.centre_taken = self._centre_taken(hood)
        heading = self._heading_rad or 0.0
        positions = {other.name: _in_frame(other.position_ned_m, leader, heading) for other in hood.vehicles}
        positions[hood.own] = _in_frame(position, leader, heading)
        self._agreement = self._group.agree(hood.vehicles, positions, self._error_m)
        return self._agreement

    def _ended(self, context: BehaviourContext, agreement: Agreement, leader: _Leader) -> Outcome | None:
        own = context.neighbourhood.own if context.neighbourhood is not None else ""
        assigned = agreement.slots.get(own)
        if self._slot is not None and agreement.slots and assigned != self._slot:
            holder = next((name for name, number in agreement.slots.items() if number == self._slot), None)
            if holder is not None:
                return Outcome(False, f"slot {self._slot} is taken by {holder}: choose another, or slot=auto")
        if agreement.plan.spacing_m < context.min_separation_m + MARGIN_M:
            least_m = context.min_separation_m + MARGIN_M
            return Outcome(
                False,
                f"spacing must be at least {least_m:g} m with guidance.min_separation_m = "
                f"{context.min_separation_m:g}, got {agreement.plan.spacing_m:g} m",
            )
        if self._structure is None:
            return None
        now_ns = context.now_ns
        if agreement.by != own:
            return Outcome(True, OVER) if leader.over else None
        arrived = self._structure.arrived and agreement.worst_error_m < ARRIVED_M
        if self._arrived.held_s(arrived, now_ns) > ARRIVED_S and self._over_since_ns is None:
            self._over_since_ns = now_ns
        if self._over_since_ns is not None and now_ns - self._over_since_ns > PUBLISH_S * 1e9:
            return Outcome(True, OVER)
        return None

    def _turn(self, dt_s: float, hood: Neighbourhood, leader: _Leader, agreement: Agreement) -> None:
        """Turn the formation's heading to the leader's, limited by the speed of the outermost slot."""
        assert self._heading_rad is not None
        by = hood.named(agreement.by)
        if agreement.by != hood.own and by is not None and by.formation is not None and by.formation.count:
            note = by.formation
            self._turn_rate_radps = note.turn_rate_radps
            self._heading_rad = wrap_angle(note.heading_rad + note.turn_rate_radps * by.age_s)
            return
        reach_m = max(1.0, agreement.reach_m(centre_taken=self._centre_taken(hood)))
        fastest, growth = SWING_MPS / reach_m, SWING_MPS2 / reach_m
        behind = wrap_angle(leader.heading_rad - self._heading_rad)
        wanted = leader.turn_rate_radps + stopping_speed(behind, fastest, growth)
        wanted = max(-fastest, min(fastest, wanted))
        change = max(-growth * dt_s, min(growth * dt_s, wanted - self._turn_rate_radps))
        self._turn_rate_radps += change
        self._heading_rad = wrap_angle(self._heading_rad + self._turn_rate_radps * dt_s)

    def _publish(self, hood: Neighbourhood, agreement: Agreement) -> None:
        assigning = agreement.by == hood.own
        note = FormationNote(
            self.leader_name,
            agreement.plan,
            self._slot,
            self._error_m,
            tuple(sorted(agreement.slots.items())) if assigning else (),
            agreement.count if assigning else 0,
            self._heading_rad or 0.0,
            self._turn_rate_radps,
        )
        if assigning and self._structure is not None and self._structure.started and hood.anchor is not None:
            _, _, heading = self._structure.motion()
            over = self._over_since_ns is not None
            heading = note.heading_rad if heading is None else heading
            note = replace(note, structure=self._structure.snapshot(hood.anchor, heading, over))
        self.note = note

    def _report_waiting(self, hood: Neighbourhood) -> None:
        """Publish that this vehicle waits: without the leader's pose no slots are assigned."""
        plan = Plan(0, hood.own, self._command.shape, self._command.spacing_m)
        held = self.note
        self.note = FormationNote(self.leader_name, plan if held is None else held.plan, self._slot)

    # ---- flying -----------------------------------------------------------------------------------------

    def _fly(
        self,
        context: BehaviourContext,
        hood: Neighbourhood,
        leader: _Leader,
        agreement: Agreement,
        offset: Vector3,
        position: Vector3,
    ) -> Setpoint:
        assert self._heading_rad is not None
        slot, moving = slot_motion(
            leader.position, leader.velocity, self._heading_rad, self._turn_rate_radps, offset
        )
        north, east, down = (s - p for s, p in zip(slot, leader.position, strict=True))
        self.slot_offset_ned_m = (north, east, down)
        missing = (slot[0] - position[0], slot[1] - position[1], slot[2] - position[2])
        self._error_m = math.hypot(*missing)
        distance_m = math.hypot(missing[0], missing[1])
        gain = min(SLOT_GAIN_PER_S, CATCH_UP_MPS / distance_m) if distance_m > 1e-6 else 0.0
        nearest_m = context.min_separation_m
        closing = (missing[0] * gain, missing[1] * gain)
        if distance_m > FAR_M:
            standing = [other for other in hood.vehicles if _stands(other, moving)]
            closing, self._side = avoid(
                closing, distance_m, position, standing, nearest_m + CLEARANCE_M, self._side
            )
        # No repulsion between neighbours in their slots.
        soft_m = min(nearest_m + CLEARANCE_M, max(nearest_m + MARGIN_M, 0.9 * agreement.plan.spacing_m))
        push = repulsion(position, hood.vehicles, soft_m)
        down = max(-CLIMB_MPS, min(CLIMB_MPS, SLOT_GAIN_PER_S * missing[2]))
        wanted = (moving[0] + closing[0] + push[0], moving[1] + closing[1] + push[1])
        north, east = add_velocity_error(wanted, context.state, math.hypot(*wanted) + 1.0)
        self._words = (
            f"slot {agreement.slots[hood.own]} of {agreement.plan.shape}, {self._error_m:.1f} m from it"
        )
        return Setpoint.velocity((north, east, moving[2] + down), context.now_ns, yaw_rad=self._heading_rad)

    def _without_leader(self, dt_s: float, context: BehaviourContext, why: str | None) -> BehaviourOutput:
        """Brake and hold, at most for the time-out."""
        if self._lost.held_s(True, context.now_ns) > (most_s := self._command.lost_timeout_s):
            return Outcome(False, f"{why or 'the leader is lost'}; waited for {most_s:g} s")
        self._words = f"holding: {why}"
        return self._stand(dt_s, context)

    def _stand(self, dt_s: float, context: BehaviourContext) -> Setpoint:
        self._standing = self._standing or Standing()
        return self._standing.setpoint(context.state, context.now_ns, dt_s, self._heading_rad)

    @property
    def status(self) -> str:
        taken = f", {self.leader_name} is not flown by its service" if self._led is False else ""
        return f"formation, {self._words}{taken}"


def _in_frame(position: Vector3, leader: _Leader, heading_rad: float) -> Vector3:
    """A position as (forward, right, down) relative to the leader."""
    north, east = position[0] - leader.position[0], position[1] - leader.position[1]
    cosine, sine = math.cos(heading_rad), math.sin(heading_rad)
    return (north * cosine + east * sine, east * cosine - north * sine, position[2] - leader.position[2])


def _stands(other: Neighbour, moving: Vector3) -> bool:
    """Whether a neighbour is stationary relative to the formation."""
    return not other.virtual and math.dist(other.velocity_ned_mps[:2], moving[:2]) < IN_THE_WAY_MPS
