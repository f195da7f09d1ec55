"""Neighbours: the poses that vehicles share, the others' predicted to now in the own local frame.

Age of a pose: its age when sent, plus the message's additional delay (`SenderDelay`), plus the time since
receipt. It is too small by the network's minimum delay, a few milliseconds on a radio network (1–2 cm at
5 m/s).
"""

from __future__ import annotations

import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from companion.guidance.formation.pose import FormationNote, Pose, pose_from_message, pose_of
from companion.host.peer_data import parse_object
from companion.vehicle.clock_sync import SenderDelay
from companion.vehicle.global_position import Anchor, global_problem
from companion.vehicle.state import Vector3, VehicleState
from vision.attitude import wrap_angle

# A vehicle whose pose is older than this is silent.
SILENT_S = 1.0
# A silent vehicle remains an obstacle where it should have come to rest, for this long.
FORGET_S = 30.0


@dataclass(frozen=True, slots=True)
class Neighbour:
    """Another vehicle, now, in the own local frame.

    Attributes:
        position_ned_m: predicted by its velocity to now, at most `SILENT_S` ahead.
        velocity_ned_mps: as published; zero for a silent vehicle.
        heading_rad, turn_rate_radps: the heading is predicted too.
        age_s: of the pose. role, airborne, formation, in_command, mode: as published.
        virtual: not a real vehicle; no separation is kept to it.
    """

    name: str
    position_ned_m: Vector3
    velocity_ned_mps: Vector3
    heading_rad: float
    turn_rate_radps: float
    age_s: float
    role: str = "alone"
    airborne: bool = True
    formation: FormationNote | None = None
    in_command: bool | None = None
    mode: str = "unknown"

    @property
    def silent(self) -> bool:
        return self.age_s > SILENT_S

    @property
    def virtual(self) -> bool:
        return self.role == "virtual"


@dataclass(frozen=True, slots=True)
class Neighbourhood:
    """The other vehicles.

    Attributes:
        own: the name of this vehicle. vehicles: the others, sorted by name.
        problem: why their positions are unknown; None: they are known, or there are none.
        anchor: converts between global and local positions; None where there is a problem, or no vehicle.
    """

    own: str
    vehicles: tuple[Neighbour, ...] = ()
    problem: str | None = None
    anchor: Anchor | None = None

    def named(self, name: str) -> Neighbour | None:
        return next((vehicle for vehicle in self.vehicles if vehicle.name == name), None)


def anchored(neighbourhood: Neighbourhood, state: VehicleState, now_ns: int) -> Neighbourhood:
    """The neighbourhood with its anchor, or the problem, where no other vehicle was received."""
    if neighbourhood.vehicles or neighbourhood.anchor is not None or neighbourhood.problem is not None:
        return neighbourhood
    anchor = Anchor.of(state, now_ns)
    problem = None if anchor else global_problem(state, now_ns)
    return replace(neighbourhood, anchor=anchor, problem=problem)


def missing_neighbours(
    neighbourhood: Neighbourhood | None, names: Sequence[str], state: VehicleState, now_ns: int
) -> list[str]:
    """What is missing for a behaviour that needs these vehicles, in words; empty: nothing."""
    if neighbourhood is None:
        return ["neighbours (this service does not share poses)"]
    neighbourhood = anchored(neighbourhood, state, now_ns)
    if neighbourhood.problem is not None:
        return [f"neighbours ({neighbourhood.problem})"]
    received = [vehicle.name for vehicle in neighbourhood.vehicles if not vehicle.silent]
    known = f"received: {', '.join(received)}" if received else "no poses received"
    missing = []
    for name in names:
        vehicle = neighbourhood.named(name)
        if name == neighbourhood.own:
            missing.append(f"a leader other than itself ({known})")
        elif vehicle is None:
            missing.append(f"the pose of {name} (none received; {known})")
        elif vehicle.silent:
            missing.append(f"the pose of {name} (stale: {vehicle.age_s:.1f} s)")
    return missing


@dataclass(slots=True)
class _Received:
    pose: Pose
    receipt_ns: int
    delay: SenderDelay
    delay_s: float


class Neighbours:
    """Shares poses: keeps the newest one of every other vehicle, and makes the own one.

    A pose is published only while the global position is known; without one the others treat it as silent.

    Args:
        vehicle: its name. on_event: called with (level, text) for events.

    Attributes:
        vehicle: its name. source: random identifier of this run of the service.
        received: a pose of another vehicle was received, at any time.
        namesakes: other sources that publish under our own name.
        refused: count of messages older than the newest one.
    """

    def __init__(self, vehicle: str, on_event: Callable[[str, str], None] = lambda level, text: None) -> None:
        self.vehicle, self._on_event = vehicle, on_event
        self.source = uuid.uuid4().hex[:12]
        self.namesakes: set[str] = set()
        self.refused, self.received = 0, False
        self._valid_from_ns = 0
        self._received: dict[str, _Received] = {}

    def discard_received(self, now_ns: int) -> None:
        """What was received until now is outdated, also where it is processed later."""
        self._valid_from_ns = now_ns
        self._received.clear()

    def on_message(self, payload: bytes, receipt_ns: int) -> None:
        """Handle a message on any vehicle's `pose` topic, received at that time (CLOCK_MONOTONIC ns).

        Raises:
            PoseError: the message is not valid.
        """
        if receipt_ns >= self._valid_from_ns:
            self.ingest(pose_from_message(parse_object(payload)), receipt_ns)

    def ingest(self, pose: Pose, receipt_ns: int) -> None:
        """Handle a pose received at that time, CLOCK_MONOTONIC nanoseconds of this host."""
        if pose.source == self.source:
            return
        name, self.received = pose.vehicle, True
        if name == self.vehicle:
            # Keep away from it, under a name that cannot be followed.
            if pose.source not in self.namesakes:
                text = f"duplicate vehicle.name {name!r} on the network: give each service its own"
                self._on_event("error", text)
            self.namesakes.add(pose.source)
            name = f"{name} ({pose.source})"
        before = self._received.get(name)
        same = before is not None and before.pose.source == pose.source
        if before is not None and same and pose.published_ns <= before.pose.published_ns:
            self.refused += 1
            return
        delay = before.delay if before is not None and same else SenderDelay()
        delay_s = delay.update(pose.published_ns, receipt_ns) / 1e9
        self._received[name] = _Received(pose, receipt_ns, delay, delay_s)

    def neighbourhood(self, state: VehicleState, now_ns: int) -> Neighbourhood:
        """The other vehicles now. Those silent for more than `FORGET_S` are removed."""
        for name in [
            name for name, received in self._received.items() if _age_s(received, now_ns) > FORGET_S
        ]:
            del self._received[name]
        alone = anchored(Neighbourhood(self.vehicle), state, now_ns)
        if (anchor := alone.anchor) is None:
            return alone
        vehicles = tuple(
            _predicted(name, received, anchor, _age_s(received, now_ns))
            for name, received in sorted(self._received.items())
        )
        return replace(alone, vehicles=vehicles)

    def pose(
        self, state: VehicleState, note: FormationNote | None, now_ns: int, *, in_command: bool
    ) -> Pose | None:
        """The pose to publish; None while the global position is unknown.

        Args:
            note: of the active behaviour (`Behaviour.note`).
            in_command: whether guidance is in command of the vehicle.
        """
        notes = (received.pose.formation for received in self._received.values())
        leads = any(other is not None and other.leader == self.vehicle for other in notes)
        return pose_of(
            state,
            now_ns,
            vehicle=self.vehicle,
            source=self.source,
            role="follower" if note is not None else "leader" if leads else "alone",
            formation=note,
            in_command=in_command,
        )

    def ages_s(self, now_ns: int) -> dict[str, float]:
        """Age of each vehicle's pose, seconds."""
        return {name: round(_age_s(received, now_ns), 3) for name, received in sorted(self._received.items())}


def _age_s(received: _Received, now_ns: int) -> float:
    return received.pose.age_s + received.delay_s + (now_ns - received.receipt_ns) / 1e9


def _predicted(name: str, received: _Received, anchor: Anchor, age_s: float) -> Neighbour:
    pose, ahead_s = received.pose, min(age_s, SILENT_S)
    position = anchor.local(pose.latitude_deg, pose.longitude_deg, pose.altitude_amsl_m)
    north, east, down = (p + v * ahead_s for p, v in zip(position, pose.velocity_ned_mps, strict=True))
    silent = age_s > SILENT_S
    return Neighbour(
        name,
        (north, east, down),
        (0.0, 0.0, 0.0) if silent else pose.velocity_ned_mps,
        wrap_angle(pose.heading_rad + pose.turn_rate_radps * ahead_s),
        0.0 if silent else pose.turn_rate_radps,
        age_s,
        pose.role,
        pose.airborne,
        pose.formation,
        pose.in_command,
        pose.mode,
    )
