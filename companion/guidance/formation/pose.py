"""The pose message that vehicles share: `companion/<vehicle>/pose`.

Positions are latitude, longitude and height above sea level, because every vehicle has its own local origin.
Stamps are of the sender's clock, whose offset is unknown to receivers; see `neighbours.py`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from companion.geometry.formation import SHAPES
from companion.peer_data import PeerDataError
from companion.vehicle.state import LandedState, Vector3, VehicleState

# GLOBAL_POSITION_INT comes 5 to 50 times a second.
GLOBAL_MAX_AGE_S = 0.5
ROLES = ("alone", "leader", "follower", "virtual")


class PoseError(PeerDataError):
    """The message is not a valid pose. The text is one line for a person."""


@dataclass(frozen=True, slots=True, order=True)
class Plan:
    """A formation plan. Of two plans the greater one holds; every new command increments `version`."""

    version: int
    author: str
    shape: str
    spacing_m: float


@dataclass(frozen=True, slots=True)
class Structure:
    """State of a virtual structure on its path.

    Attributes:
        place: latitude and longitude, degrees, and height above sea level, metres.
        velocity_ned_mps, heading_rad: of its virtual leader.
        origin: origin of the path's points, in the format of `place`.
        along_m: progress along the path.
        over: it is at the end of its path, and all vehicles are in their slots.
    """

    place: Vector3
    velocity_ned_mps: Vector3
    heading_rad: float
    origin: Vector3
    along_m: float
    over: bool = False


@dataclass(frozen=True, slots=True)
class FormationNote:
    """A vehicle's part in a formation.

    Attributes:
        leader: name of the leader. plan: the plan it follows.
        wish: the slot its operator requested, from 1; None: any.
        error_m: distance to its slot.
        slots: (vehicle, slot from 1) as assigned by this vehicle; of several assigning vehicles the first
            by name holds.
        count: number of slots.
        heading_rad, turn_rate_radps: of the formation, which turns slower than a leader can.
        structure: state of the virtual structure, if any.
    """

    leader: str
    plan: Plan
    wish: int | None = None
    error_m: float = 0.0
    slots: tuple[tuple[str, int], ...] = ()
    count: int = 0
    heading_rad: float = 0.0
    turn_rate_radps: float = 0.0
    structure: Structure | None = None


@dataclass(frozen=True, slots=True)
class Pose:
    """One pose message.

    Attributes:
        vehicle: its name. source: changes when its service restarts.
        published_ns: by the sender's CLOCK_MONOTONIC. age_s: of the position, when it was published.
        altitude_m: above sea level. heading_rad: clockwise from north.
        turn_rate_radps: of the heading, clockwise.
        role: alone, leader, follower or virtual (not a real vehicle).
        airborne: armed and not on the ground.
        in_command: its service is in command of it; None: not published, as by a virtual leader.
        mode: of its autopilot, a `FlightMode`.
    """

    vehicle: str
    source: str
    published_ns: int
    age_s: float
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    velocity_ned_mps: Vector3
    heading_rad: float
    turn_rate_radps: float
    role: str = "alone"
    airborne: bool = True
    formation: FormationNote | None = None
    in_command: bool | None = None
    mode: str = "unknown"


def global_problem(state: VehicleState, now_ns: int) -> str | None:
    """Why the vehicle's global position is unknown; None: it is known."""
    if state.position_fault(now_ns) is not None or state.velocity_ned_mps is None:
        return "own position unknown"
    if not all(map(math.isfinite, (state.latitude_deg, state.longitude_deg, state.altitude_amsl_m))):
        return "own latitude and longitude unknown"
    age_s = (now_ns - state.global_ns) / 1e9
    return f"own latitude and longitude are {age_s:.1f} s old" if age_s > GLOBAL_MAX_AGE_S else None


def pose_of(
    state: VehicleState,
    now_ns: int,
    *,
    vehicle: str,
    source: str,
    role: str = "alone",
    formation: FormationNote | None = None,
    in_command: bool | None = None,
) -> Pose | None:
    """The pose of a vehicle now; None while its global position is unknown."""
    yaw_rad = state.yaw_rad
    if global_problem(state, now_ns) is not None or yaw_rad is None or state.velocity_ned_mps is None:
        return None
    return Pose(
        vehicle,
        source,
        now_ns,
        max(0.0, (now_ns - state.global_ns) / 1e9),
        state.latitude_deg,
        state.longitude_deg,
        state.altitude_amsl_m,
        state.velocity_ned_mps,
        yaw_rad,
        turn_rate(state),
        role,
        state.armed and state.landed is not LandedState.ON_GROUND,
        formation,
        in_command,
        state.mode.value,
    )


def turn_rate(state: VehicleState) -> float:
    """Turn rate of the heading, rad/s clockwise, from body rates, roll and pitch."""
    if state.attitude is None or state.angular_velocity_frd_radps is None:
        return 0.0
    w, x, y, z = state.attitude
    _, pitch_rate, yaw_rate = state.angular_velocity_frd_radps
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    # Bounded near 90° of pitch, where the heading is undefined.
    return (math.sin(roll) * pitch_rate + math.cos(roll) * yaw_rate) / max(0.2, math.cos(pitch))


def pose_from_message(message: Any) -> Pose:
    """Parse and validate a published pose. Raises PoseError."""
    fields = _Fields(message, "pose")
    role = fields.text("role")
    if role not in ROLES:
        raise PoseError(f"pose: role must be one of {', '.join(ROLES)}, got {role!r}")
    formation = fields.value("formation")
    return Pose(
        fields.text("vehicle"),
        fields.text("source"),
        fields.whole("published_ns", 0),
        fields.number("age_s", 0.0, 60.0),
        fields.number("latitude_deg", -90.0, 90.0),
        fields.number("longitude_deg", -180.0, 180.0),
        fields.number("altitude_amsl_m", -1000.0, 100_000.0),
        fields.vector("velocity_ned_mps", 200.0),
        fields.number("heading_rad", -10.0, 10.0),
        fields.number("turn_rate_radps", -50.0, 50.0),
        role,
        fields.value("airborne") is True,
        None if formation is None else _note_from(formation),
        fields.flag("in_command"),
        fields.text("mode") if "mode" in fields.names else "unknown",
    )


def _note_from(message: Any) -> FormationNote:
    fields = _Fields(message, "pose.formation")
    plan = _Fields(fields.value("plan"), "pose.formation.plan")
    shape = plan.text("shape")
    if shape not in SHAPES:
        raise PoseError(f"pose.formation.plan: shape must be one of {', '.join(SHAPES)}, got {shape!r}")
    slots = _Fields(fields.value("slots"), "pose.formation.slots")
    wish, structure = fields.value("wish"), fields.value("structure")
    return FormationNote(
        fields.text("leader"),
        Plan(plan.whole("version", 0), plan.text("author"), shape, plan.number("spacing_m", 0.1, 1000.0)),
        None if wish is None else fields.whole("wish", 1),
        fields.number("error_m", 0.0, 1e6),
        tuple((name, slots.whole(name, 1)) for name in slots.names),
        fields.whole("count", 0),
        fields.number("heading_rad", -10.0, 10.0),
        fields.number("turn_rate_radps", -50.0, 50.0),
        None if structure is None else _structure_from(structure),
    )


def _structure_from(message: Any) -> Structure:
    fields = _Fields(message, "pose.formation.structure")
    return Structure(
        fields.place("place"),
        fields.vector("velocity_ned_mps", 200.0),
        fields.number("heading_rad", -10.0, 10.0),
        fields.place("origin"),
        fields.number("along_m", 0.0, 1e9),
        fields.value("over") is True,
    )


class _Fields:
    """Fields of an object, validated as they are read."""

    def __init__(self, message: Any, what: str) -> None:
        if not isinstance(message, Mapping):
            raise PoseError(f"{what} must be an object, got {type(message).__name__}")
        self._message, self._what = message, what

    @property
    def names(self) -> list[str]:
        return list(self._message)

    def value(self, key: str) -> Any:
        if key not in self._message:
            raise PoseError(f"{self._what}: {key} is missing")
        return self._message[key]

    def text(self, key: str) -> str:
        value = self.value(key)
        if not isinstance(value, str) or not 1 <= len(value) <= 100:
            raise PoseError(f"{self._what}: {key} must be a string of 1 to 100 characters, got {value!r:.50}")
        return value

    def flag(self, key: str) -> bool | None:
        """None where it is not published."""
        value = self.value(key) if key in self._message else None
        if value is not None and not isinstance(value, bool):
            raise PoseError(f"{self._what}: {key} must be true, false or null, got {value!r:.50}")
        return value

    def number(self, key: str, low: float, high: float) -> float:
        return self._checked(key, self.value(key), low, high)

    def whole(self, key: str, low: int) -> int:
        value = self.value(key)
        # The range of a 64-bit nanosecond stamp.
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value < 2**63:
            raise PoseError(f"{self._what}: {key} must be an integer of at least {low}, got {value!r:.50}")
        return value

    def vector(self, key: str, limit: float) -> Vector3:
        return self._three(key, ((-limit, limit),) * 3)

    def place(self, key: str) -> Vector3:
        return self._three(key, ((-90.0, 90.0), (-180.0, 180.0), (-1000.0, 100_000.0)))

    def _three(self, key: str, ranges: tuple[tuple[float, float], ...]) -> Vector3:
        value = self.value(key)
        if not isinstance(value, list | tuple) or len(value) != 3:
            raise PoseError(f"{self._what}: {key} must be three numbers, got {value!r:.50}")
        x, y, z = (self._checked(key, part, *limits) for part, limits in zip(value, ranges, strict=True))
        return (x, y, z)

    def _checked(self, key: str, value: Any, low: float, high: float) -> float:
        if isinstance(value, bool) or not isinstance(value, int | float) or not low <= value <= high:
            raise PoseError(f"{self._what}: {key} must be {low:g} to {high:g}, got {value!r:.50}")
        return float(value)
