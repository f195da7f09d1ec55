"""The pose message that vehicles share: `companion/<vehicle>/pose`.

Positions are latitude, longitude and height above sea level, because every vehicle has its own local origin.
Stamps are of the sender's clock, whose offset is unknown to receivers; see `neighbours.py`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field, TypeAdapter, ValidationError

from companion.geometry.formation import SHAPES
from companion.host.peer_data import PeerDataError
from companion.vehicle.global_position import global_problem
from companion.vehicle.state import LandedState, VehicleState
from vision.attitude import euler_from_quaternion


def _within(low: float, high: float) -> Any:
    """The range of a number in a message."""
    return Field(strict=True, ge=low, le=high, allow_inf_nan=False)


def _from(low: int) -> Any:
    """The least value of an integer in a message; the greatest is that of a 64-bit nanosecond stamp."""
    return Field(strict=True, ge=low, lt=2**63)


Role = Literal["alone", "leader", "follower", "virtual"]
_Name = Annotated[str, Field(strict=True, min_length=1, max_length=100)]
_Angle = Annotated[float, _within(-10.0, 10.0)]
_TurnRate = Annotated[float, _within(-50.0, 50.0)]
_Speed = Annotated[float, _within(-200.0, 200.0)]
_Latitude = Annotated[float, _within(-90.0, 90.0)]
_Longitude = Annotated[float, _within(-180.0, 180.0)]
_Altitude = Annotated[float, _within(-1000.0, 100_000.0)]
_Place = tuple[_Latitude, _Longitude, _Altitude]
_Velocity = tuple[_Speed, _Speed, _Speed]
_Flag = Annotated[bool, Field(strict=True)]
_Slots = Annotated[
    tuple[tuple[_Name, Annotated[int, _from(1)]], ...],
    BeforeValidator(lambda slots: tuple(slots.items()) if isinstance(slots, dict) else slots),
]


class PoseError(PeerDataError):
    """The message is not a valid pose. The text is one line for a person."""


@dataclass(frozen=True, slots=True, order=True)
class Plan:
    """A formation plan. Of two plans the greater one holds; every new command increments `version`."""

    version: Annotated[int, _from(0)]
    author: _Name
    shape: Annotated[str, Field(pattern=f"^({'|'.join(SHAPES)})$")]
    spacing_m: Annotated[float, _within(0.1, 1000.0)]


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

    place: _Place
    velocity_ned_mps: _Velocity
    heading_rad: _Angle
    origin: _Place
    along_m: Annotated[float, _within(0.0, 1e9)]
    over: _Flag = False


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

    leader: _Name
    plan: Plan
    wish: Annotated[int, _from(1)] | None = None
    error_m: Annotated[float, _within(0.0, 1e6)] = 0.0
    slots: _Slots = ()
    count: Annotated[int, _from(0)] = 0
    heading_rad: _Angle = 0.0
    turn_rate_radps: _TurnRate = 0.0
    structure: Structure | None = None


@dataclass(frozen=True, slots=True)
class Pose:
    """One pose message.

    Attributes:
        vehicle: its name. source: changes when its service restarts.
        published_ns: by the sender's CLOCK_MONOTONIC. age_s: of the position, when it was published.
        altitude_amsl_m: above sea level. heading_rad: clockwise from north.
        turn_rate_radps: of the heading, clockwise.
        role: alone, leader, follower or virtual (not a real vehicle).
        airborne: armed and not on the ground.
        in_command: its service is in command of it; None: not published, as by a virtual leader.
        mode: of its autopilot, a `FlightMode`.
    """

    vehicle: _Name
    source: _Name
    published_ns: Annotated[int, _from(0)]
    age_s: Annotated[float, _within(0.0, 60.0)]
    latitude_deg: _Latitude
    longitude_deg: _Longitude
    altitude_amsl_m: _Altitude
    velocity_ned_mps: _Velocity
    heading_rad: _Angle
    turn_rate_radps: _TurnRate
    role: Role
    airborne: _Flag
    formation: FormationNote | None
    in_command: _Flag | None = None
    mode: _Name = "unknown"


_POSE = TypeAdapter(Pose)


def pose_of(
    state: VehicleState,
    now_ns: int,
    *,
    vehicle: str,
    source: str,
    role: Role = "alone",
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
    roll, pitch, _ = euler_from_quaternion(state.attitude)
    _, pitch_rate, yaw_rate = state.angular_velocity_frd_radps
    # Bounded near 90° of pitch, where the heading is undefined.
    return (math.sin(roll) * pitch_rate + math.cos(roll) * yaw_rate) / max(0.2, math.cos(pitch))


def pose_from_message(message: Any) -> Pose:
    """Parse and validate a published pose. Raises PoseError."""
    try:
        return _POSE.validate_python(message)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(map(str, ("pose", *first["loc"])))
        raise PoseError(f"{where}: {first['msg']}, got {first['input']!r:.50}") from None
