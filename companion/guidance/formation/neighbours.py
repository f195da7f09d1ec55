"""Who flies nearby: the poses the others tell, brought to now and into the own local frame.

How old a pose is. Sender and receiver have clocks of their own, whose difference nobody knows. What is known
of each message is its receipt minus its sending: that difference plus the message's delay. The least of it
over the last minute belongs to the message that was delayed least; what a message is above that, it was
delayed more. So the age of a pose is its own age when it was sent, plus that measured delay, plus the time
since its receipt; it is too small by the network's least delay alone, which is a millisecond or a few on a
radio network, and at 5 m/s a centimetre or two. Clocks drift by some 50 parts in a million: 3 ms in a minute.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from companion.geometry.geodesy import north_east
from companion.guidance.formation.pose import FormationNote, Pose, global_problem
from companion.vehicle.state import Vector3, VehicleState
from vision.attitude import wrap_angle

# A pose older than this says nothing of the present: the vehicle counts as silent.
SILENT_S = 1.0
# A silent vehicle stays an obstacle where it should have come to rest, for so long.
FORGET_S = 30.0
# The least delay is looked for in this and the one before.
_WINDOW_NS = 30 * 10**9


@dataclass(frozen=True, slots=True)
class Neighbour:
    """Another vehicle, now, in the own local frame.

    Attributes:
        position_ned_m: brought forward by its velocity to now, or for a second where it is silent.
        velocity_ned_mps: as it was told; nothing of a silent one.
        heading_rad, turn_rate_radps: the heading brought forward too.
        age_s: of what is known. role, airborne, formation: as it was told.
        virtual: it is not there, and nothing keeps away from it.
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

    @property
    def silent(self) -> bool:
        return self.age_s > SILENT_S

    @property
    def virtual(self) -> bool:
        return self.role == "virtual"


@dataclass(frozen=True, slots=True)
class Neighbourhood:
    """All that is known of the others.

    Attributes:
        own: the name of this vehicle. vehicles: the others, by name.
        problem: why they cannot be placed; None: they are.
        anchor: of the own vehicle, for other global places.
    """

    own: str
    vehicles: tuple[Neighbour, ...] = ()
    problem: str | None = None
    anchor: Anchor | None = None

    def named(self, name: str) -> Neighbour | None:
        return next((vehicle for vehicle in self.vehicles if vehicle.name == name), None)


def missing_neighbours(neighbourhood: Neighbourhood | None, names: Sequence[str]) -> list[str]:
    """What a behaviour that needs these vehicles lacks, in words; none: nothing."""
    if neighbourhood is None:
        return ["neighbours (this service does not share poses)"]
    if neighbourhood.problem is not None:
        return [f"neighbours ({neighbourhood.problem})"]
    heard = [vehicle.name for vehicle in neighbourhood.vehicles if not vehicle.silent]
    known = f"heard are {', '.join(heard)}" if heard else "nobody is heard"
    missing = []
    for name in names:
        vehicle = neighbourhood.named(name)
        if name == neighbourhood.own:
            missing.append(f"another leader than itself ({known})")
        elif vehicle is None:
            missing.append(f"the pose of {name} (none came; {known})")
        elif vehicle.silent:
            missing.append(f"the pose of {name} (it is {vehicle.age_s:.1f} s old)")
    return missing


@dataclass(frozen=True, slots=True)
class Anchor:
    """One place known in both ways: globally, and in the own local frame."""

    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    position_ned_m: Vector3

    @classmethod
    def of(cls, state: VehicleState, now_ns: int) -> Anchor | None:
        """Where the vehicle was when it last knew both; None while it does not."""
        position, velocity = state.position_ned_m, state.velocity_ned_mps
        if global_problem(state, now_ns) is not None or position is None or velocity is None:
            return None
        # The two come in messages of their own: the local place is taken to the other's time.
        dt_s = (state.global_ns - state.position_ns) / 1e9
        north, east, down = (p + v * dt_s for p, v in zip(position, velocity, strict=True))
        return cls(state.latitude_deg, state.longitude_deg, state.altitude_amsl_m, (north, east, down))

    def local(self, latitude_deg: float, longitude_deg: float, altitude_m: float) -> Vector3:
        """A global place in the local frame, NED metres."""
        north, east = north_east((self.latitude_deg, self.longitude_deg), (latitude_deg, longitude_deg))
        return (
            self.position_ned_m[0] + north,
            self.position_ned_m[1] + east,
            self.position_ned_m[2] - (altitude_m - self.altitude_m),
        )

    def globally(self, place: Vector3) -> Vector3:
        """A local place as latitude, longitude, degrees, and height above sea level, metres."""
        north, east = place[0] - self.position_ned_m[0], place[1] - self.position_ned_m[1]
        latitude, longitude = self.latitude_deg, self.longitude_deg
        for _ in range(4):
            # Newton's way with the metres a degree has here: each round leaves a hundred-thousandth.
            off_north, off_east = north_east((self.latitude_deg, self.longitude_deg), (latitude, longitude))
            per_latitude, _ = north_east((latitude, longitude), (latitude + 1e-3, longitude))
            _, per_longitude = north_east((latitude, longitude), (latitude, longitude + 1e-3))
            latitude += (north - off_north) / per_latitude * 1e-3
            longitude += (east - off_east) / per_longitude * 1e-3
        return (latitude, longitude, self.altitude_m - (place[2] - self.position_ned_m[2]))


@dataclass(slots=True)
class _Heard:
    pose: Pose
    receipt_ns: int
    delay_s: float
    # The least receipt minus sending of this window and of the one before.
    least_ns: int
    least_before_ns: int
    window_began_ns: int


@dataclass
class Neighbours:
    """The newest pose of every other vehicle.

    Args:
        own: the name of this vehicle. source: of its own messages.

    Attributes:
        namesakes: sources that publish under our own name; two services were given the same.
        refused: messages that were older than what was known.
    """

    own: str
    source: str
    namesakes: set[str] = field(default_factory=set)
    refused: int = 0
    _heard: dict[str, _Heard] = field(default_factory=dict)

    def hear(self, pose: Pose, receipt_ns: int) -> None:
        """A message that came at that time, CLOCK_MONOTONIC of this host."""
        name = pose.vehicle
        if name == self.own:
            if pose.source == self.source:
                return
            # Not us, and yet there: something to keep away from, under a name nobody can follow.
            self.namesakes.add(pose.source)
            name = f"{name} ({pose.source})"
        difference_ns = receipt_ns - pose.published_ns
        before = self._heard.get(name)
        if before is None or before.pose.source != pose.source:
            heard = _Heard(pose, receipt_ns, 0.0, difference_ns, difference_ns, receipt_ns)
        elif pose.published_ns <= before.pose.published_ns:
            self.refused += 1
            return
        else:
            heard = before
            if receipt_ns - heard.window_began_ns > _WINDOW_NS:
                heard.least_before_ns, heard.least_ns = heard.least_ns, difference_ns
                heard.window_began_ns = receipt_ns
            heard.least_ns = min(heard.least_ns, difference_ns)
            heard.pose, heard.receipt_ns = pose, receipt_ns
            heard.delay_s = (difference_ns - min(heard.least_ns, heard.least_before_ns)) / 1e9
        self._heard[name] = heard

    def around(self, state: VehicleState, now_ns: int) -> Neighbourhood:
        """The others as they are now, from the own vehicle. Those silent for long are forgotten."""
        for name in [name for name, heard in self._heard.items() if _age_s(heard, now_ns) > FORGET_S]:
            del self._heard[name]
        anchor = Anchor.of(state, now_ns)
        if anchor is None:
            return Neighbourhood(self.own, problem=global_problem(state, now_ns) or "its place is unknown")
        vehicles = tuple(
            _placed(name, heard, anchor, _age_s(heard, now_ns)) for name, heard in sorted(self._heard.items())
        )
        return Neighbourhood(self.own, vehicles, None, anchor)

    def leads(self) -> bool:
        """Somebody says that it follows this vehicle."""
        notes = (heard.pose.formation for heard in self._heard.values())
        return any(note is not None and note.leader == self.own for note in notes)

    def ages_s(self, now_ns: int) -> dict[str, float]:
        """How old what is known of everybody is."""
        return {name: round(_age_s(heard, now_ns), 3) for name, heard in sorted(self._heard.items())}


def _age_s(heard: _Heard, now_ns: int) -> float:
    return heard.pose.age_s + heard.delay_s + (now_ns - heard.receipt_ns) / 1e9


def _placed(name: str, heard: _Heard, anchor: Anchor, age_s: float) -> Neighbour:
    pose, ahead_s = heard.pose, min(age_s, SILENT_S)
    place = anchor.local(pose.latitude_deg, pose.longitude_deg, pose.altitude_m)
    north, east, down = (p + v * ahead_s for p, v in zip(place, pose.velocity_ned_mps, strict=True))
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
    )
