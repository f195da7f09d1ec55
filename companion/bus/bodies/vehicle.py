"""Bodies of the messages about the vehicle: state, setpoints, velocities, obstacles, and pose for others."""

from __future__ import annotations

from typing import Annotated, NotRequired

from pydantic import Field
from typing_extensions import TypedDict

from companion.bus.bodies import Four, Three, Two, one_of

RoleWord = Annotated[str, one_of("alone", "leader", "follower", "virtual")]
HeightWord = Annotated[str, one_of("distance_sensor", "home")]
Speed = Annotated[float, Field(ge=-50, le=50, allow_inf_nan=False)]


class GimbalBody(TypedDict):
    """The gimbal in `vehicle`."""

    attitude_age_s: float | None
    """age of the attitude"""
    attitude_wxyz: Four | None
    """rotates the gimbal frame (FRD, x along its axis) into NED, or into NED rotated by the heading"""
    yaw_from: str
    """reference of its yaw: north or nose"""
    pitch_rad: float | None
    """above the horizon"""
    primary_control: tuple[int, int] | None
    """MAVLink address with primary control; [0, 0]: none"""


class VehicleBody(TypedDict):
    """The vehicle's state."""

    stamp_ns: int
    """of this message"""
    connected: bool
    """a heartbeat was received within 3 s"""
    heartbeat_age_s: float | None
    """age of the newest heartbeat"""
    position_age_s: float | None
    """age of the position"""
    global_age_s: float | None
    """age of the global position"""
    boot_offset_ns: int | None
    """the autopilot's clock minus CLOCK_MONOTONIC; null until known"""
    boot_error_ns: int | None
    """bound of its error"""
    armed: bool
    """motors are armed"""
    mode: str
    """flight mode, named as PX4 names it"""
    landed: str
    """MAV_LANDED_STATE"""
    failsafe: bool
    """MAV_STATE_CRITICAL or EMERGENCY"""
    position_ned_m: Three | None
    """from the autopilot's origin at first contact"""
    position_valid: bool | None
    """false while the autopilot's estimator reports its position as unusable"""
    reset_count: int
    """how often the autopilot's own coordinates have moved"""
    reset_offset_ned_m: Three | None
    """how far they have moved"""
    velocity_ned_mps: Three | None
    """velocity"""
    attitude_wxyz: Four | None
    """rotates body (FRD) into NED"""
    yaw_rad: float | None
    """heading, clockwise from north"""
    home_ned_m: Three | None
    """home, as position_ned_m; null until known"""
    altitude_m: float | None
    """above home"""
    ground_height_m: float | None
    """above the ground, by a range finder that looks down; null while it does not meet the ground"""
    height_source: HeightWord | None
    """the height from which ranges to objects are computed"""
    latitude_deg: float | None
    """WGS 84"""
    longitude_deg: float | None
    """WGS 84"""
    altitude_amsl_m: float | None
    """above mean sea level"""
    battery_fraction: float | None
    """0 to 1"""
    gimbal: GimbalBody | None
    """null until a gimbal is received"""


class SetpointBody(TypedDict):
    """One setpoint; fields that it does not set are null."""

    position_ned_m: Three | None
    """position"""
    velocity_ned_mps: Three | None
    """velocity, or feed-forward"""
    acceleration_ned_mps2: Three | None
    """acceleration feed-forward"""
    yaw_rad: float | None
    """heading"""
    yaw_rate_radps: float | None
    """turn rate"""
    deadline_ns: int
    """not sent after this time"""


class SetpointsBody(TypedDict):
    """The requested setpoint and the one sent."""

    stamp_ns: int
    """of this message"""
    asked: SetpointBody | None
    """of the behaviour, before the envelope"""
    sent: SetpointBody | None
    """the newest that was sent"""
    sent_ns: int | None
    """when it was sent"""
    stream: str
    """state of the streamer"""
    limited_by: list[str]
    """limits of the envelope that changed it"""
    path_ned_m: list[Two]
    """north and east of the points of the active path around obstacles; empty: none"""


class PlanBody(TypedDict):
    """A formation plan."""

    version: int
    """of two plans the one with the greater version holds"""
    author: str
    """vehicle that made it"""
    shape: str
    """shape"""
    spacing_m: float
    """spacing"""


class StructureBody(TypedDict):
    """A virtual structure on its path."""

    place: Three
    """latitude and longitude, degrees, and height above sea level"""
    velocity_ned_mps: Three
    """of its virtual leader"""
    heading_rad: float
    """of its virtual leader"""
    origin: Three
    """origin of the path's points, as place"""
    along_m: float
    """progress along the path"""
    over: bool
    """it is at the end, and all vehicles are in their slots"""


class FormationBody(TypedDict):
    """A vehicle's part in a formation."""

    leader: str
    """name of the leader"""
    plan: PlanBody
    """the plan it follows"""
    wish: int | None
    """slot that its operator requested; null: any"""
    error_m: float
    """distance to its slot"""
    slots: dict[str, int]
    """vehicle: slot, as assigned by this vehicle"""
    count: int
    """number of slots"""
    heading_rad: float
    """of the formation"""
    turn_rate_radps: float
    """of the formation"""
    structure: StructureBody | None
    """the virtual structure, if any"""


class PoseBody(TypedDict):
    """A vehicle's global pose, for the others."""

    vehicle: str
    """its name"""
    source: str
    """changes when the service restarts"""
    published_ns: int
    """on the sender's clock"""
    age_s: float
    """of the position, at that time"""
    latitude_deg: float
    """WGS 84"""
    longitude_deg: float
    """WGS 84"""
    altitude_amsl_m: float
    """above mean sea level"""
    velocity_ned_mps: Three
    """velocity"""
    heading_rad: float
    """clockwise from north"""
    turn_rate_radps: float
    """of the heading, clockwise"""
    role: RoleWord
    """part in a formation"""
    airborne: bool
    """armed and not on the ground"""
    formation: FormationBody | None
    """its formation, if any"""
    in_command: NotRequired[bool | None]
    """its service is in command of it; null: not known"""
    mode: NotRequired[str]
    """of its autopilot"""


class VelocityBody(TypedDict):
    """A velocity to fly, in the vehicle's level frame, sent again before its lifetime is over."""

    source: Annotated[str, Field(pattern=r"^[A-Za-z0-9_.-]{1,64}$")]
    """identifier of the sender, a new one at each start"""
    stamp_ns: Annotated[int, Field(ge=0, le=2**63 - 1)]
    """when it was sent, on the sender's own steady clock"""
    forward_mps: NotRequired[Speed]
    """horizontally along the heading; default 0"""
    right_mps: NotRequired[Speed]
    """horizontally across the heading; default 0"""
    up_mps: NotRequired[Speed]
    """default 0"""
    turn_radps: NotRequired[Annotated[float, Field(ge=-10, le=10, allow_inf_nan=False)]]
    """clockwise seen from above; default 0"""
    lifetime_s: NotRequired[Annotated[float, Field(gt=0, le=0.5, allow_inf_nan=False)]]
    """the vehicle brakes if no newer message has arrived by then; default 0.5"""


class ObstaclesBody(TypedDict):
    """Distance of the nearest obstacle in 72 horizontal directions, from one depth image."""

    vehicle: str
    """name of the vehicle"""
    captured_ns: int
    """capture of the depth image"""
    frame: str
    """reference of the first direction: north"""
    increment_deg: float
    """between two directions, clockwise"""
    distance_m: Annotated[list[float | None], Field(min_length=72, max_length=72)]
    """from the vehicle; null: no obstacle, or unknown"""
    known: Annotated[list[bool], Field(min_length=72, max_length=72)]
    """whether the direction was observed"""
