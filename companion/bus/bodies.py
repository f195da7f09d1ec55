"""The body of every message as a type: the public contract with subscribers. Fields are added, never changed.

JSON Schema and the tables of `companion topics` are made of these types. They cost nothing when a message is
published: a body is a plain dict. Stamps are CLOCK_MONOTONIC nanoseconds of the publishing computer; frames,
quaternions (w, x, y, z) and vectors are as in `companion.vehicle.state`. Boxes are pixels: left, top, right,
bottom.
"""

from __future__ import annotations

from typing import Annotated, Any, NotRequired

from pydantic import Field
from typing_extensions import TypedDict

Two = Annotated[list[float], Field(min_length=2, max_length=2)]
Three = Annotated[list[float], Field(min_length=3, max_length=3)]
Four = Annotated[list[float], Field(min_length=4, max_length=4)]
Corners = list[Two]
Matrix3 = Annotated[list[float], Field(min_length=9, max_length=9)]
Matrix34 = Annotated[list[float], Field(min_length=12, max_length=12)]
Speed = Annotated[float, Field(ge=-50, le=50, allow_inf_nan=False)]
Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]


def _one_of(*words: str) -> Any:
    return Field(json_schema_extra={"enum": list(words)})


TrackWord = Annotated[str, _one_of("confirmed", "tentative", "none")]
TrackEventWord = Annotated[str, _one_of("new", "update", "lost", "end")]
RangeWord = Annotated[str, _one_of("depth", "ground_plane", "known_height", "marker", "none")]
RoleWord = Annotated[str, _one_of("alone", "leader", "follower", "virtual")]
LevelWord = Annotated[str, _one_of("info", "warning", "error")]
HeightWord = Annotated[str, _one_of("distance_sensor", "home")]


class ErrorEllipseBody(TypedDict):
    """One-sigma error ellipse of a horizontal position; 95 % are within 2.45 times its axes."""

    semi_major_m: float
    """half of the longer axis"""
    semi_minor_m: float
    """half of the shorter axis"""
    orientation_rad: float
    """of the longer axis, clockwise from north, 0 to pi"""


class PositionBody(TypedDict):
    """Position of an object, null where unknown."""

    position_ned_m: Three | None
    """local NED"""
    latitude_deg: float | None
    """WGS 84"""
    longitude_deg: float | None
    """WGS 84"""
    altitude_amsl_m: float | None
    """above mean sea level"""
    error_ellipse: ErrorEllipseBody | None
    """of the position, with the vehicle's own position error"""


class FrameBody(TypedDict):
    """Fields of every message about one frame."""

    vehicle: str
    """name of the vehicle"""
    camera: str | None
    """name of the camera; null: the first"""
    sequence: int
    """number of the frame; a gap: frames that were not processed"""
    captured_ns: int
    """capture of the frame"""
    published_ns: int
    """publication of this message"""
    width: int
    """width of the frame, pixels"""
    height: int
    """height of the frame, pixels"""


class DetectionBody(PositionBody):
    """One detection. Its position and the fields from `bearing_rad` on are null where unknown, and for other
    cameras than the steering one.
    """

    class_id: int
    """the model's own number of the class"""
    class_name: str
    """name of the class"""
    confidence: float
    """of this frame, 0 to 1"""
    xyxy: Four
    """box, pixels: left, top, right, bottom"""
    center: Two
    """centre of the box, pixels: x, y"""
    depth_m: float | None
    """distance of the nearest point along the optical axis; null without depth"""
    nearest_camera_m: Three | None
    """horizontally nearest visible point: metres right, down, forward of the lens; null without depth"""
    track_id: int | None
    """constant for an object across frames; never reused while the service runs"""
    track_score: float | None
    """median confidence of the track's newest 100 detections"""
    track_state: TrackWord | None
    """null if tracker.enabled is false"""
    track_age_s: float | None
    """time from the track's first detection to this frame; null without a track"""
    bearing_rad: float | None
    """direction of the box's centre at the capture, clockwise from north"""
    elevation_rad: float | None
    """the same above the horizon"""
    ground_range_m: float | None
    """horizontal distance from the vehicle to the nearest surface"""
    distance_m: float | None
    """straight distance to the same point"""
    range_source: RangeWord | None
    """what the range was measured by; none: no range"""
    range_sigma_m: float | None
    """one-sigma error of ground_range_m"""


class DetectionsBody(FrameBody):
    """The detections of one frame, in the detector's order."""

    captured_boot_ns: int | None
    """capture on the autopilot's clock (since boot, by TIMESYNC); null until known"""
    captured_boot_error_ns: int | None
    """bound of its error"""
    inferred_ns: int
    """the detections were ready"""
    model: str | None
    """name of the model; null without a detector"""
    model_sha256: Sha256 | None
    """of the model's file; null for a detector without one"""
    localization_error: str | None
    """why the detections have no direction; empty if they have, null for another than the steering camera"""
    timing_ms: dict[str, float]
    """stage: duration"""
    dropped: int
    """frames lost so far unintentionally"""
    detections: list[DetectionBody]
    """the detections"""


class TrackEventBody(PositionBody):
    """One event of a confirmed track. The position is fused over its detections; it is null without a range,
    and for other cameras than the steering one.
    """

    event: TrackEventWord
    """what happened"""
    stamp_ns: int
    """capture of the frame of this event"""
    track_id: int
    """as in detections"""
    class_id: int
    """as in detections"""
    class_name: str
    """name of the class"""
    xyxy: Four
    """the detection's box or, for lost and end, the predicted one; pixels"""
    confidence: float
    """of the newest detection, 0 to 1"""
    track_score: float
    """as in detections"""
    track_state: TrackWord
    """as in detections"""
    seen: int
    """frames with a detection"""
    first_ns: int
    """capture of the first of these frames"""
    last_ns: int
    """capture of the newest of these frames"""
    moving: bool | None
    """the object moves; the position is the newest, not fused over the track"""


class TracksBody(FrameBody):
    """The track events of one frame."""

    events: list[TrackEventBody]
    """oldest first"""


Covariance = Annotated[list[float], Field(min_length=21, max_length=21)]


class MarkerBody(TypedDict):
    """One marker. The fields from `pad` on are null where the vehicle's pose at the capture is unknown."""

    id: int
    """in its dictionary"""
    size_m: float
    """side of the black square"""
    corners_px: Annotated[list[Two], Field(min_length=4, max_length=4)]
    """clockwise from the print's upper left, pixels"""
    position_camera_m: Three
    """metres right, down, forward of the lens"""
    reprojection_px: float
    """reprojection error"""
    ambiguity: float
    """0 to 1: how well the second pose of a square fits; 1: both fit equally"""
    pad: int | None
    """id of the pad it lies on"""
    bearing_rad: float | None
    """from the vehicle, clockwise from north"""
    elevation_rad: float | None
    """from the vehicle, above the horizon"""
    distance_m: float | None
    """slant range"""
    ground_range_m: float | None
    """range over ground"""
    heading_rad: float | None
    """direction of the print's upper edge, clockwise from north"""
    position_ned_m: Three | None
    """local NED, of its centre"""
    pad_ned_m: Three | None
    """local NED, of the pad's centre"""
    resolved: bool | None
    """which of the two poses of a square is true is known; false: the one nearer to level is assumed"""
    position_body_m: Three | None
    """metres forward, right, down of the vehicle"""
    rotation_body_wxyz: Four | None
    """quaternion from the marker's axes (right, upper edge, out of it) to the body's (FRD)"""
    covariance_body: Covariance | None
    """upper right triangle, row by row, of position (m²) and rotation about the body's axes (rad²)"""
    range_sigma_m: float | None
    """one sigma of the distance, from that"""
    angle_sigma_rad: float | None
    """one sigma of the rotation about the least certain axis, from that"""


class BoardBody(TypedDict):
    """One board: several markers solved together."""

    name: str
    """of the board"""
    ids: list[int]
    """its markers that were used"""
    reprojection_px: float
    """reprojection error"""
    ambiguous: bool
    """another pose fits about equally well"""
    position_ned_m: Three
    """local NED, of its origin"""
    position_body_m: Three
    """metres forward, right, down of the vehicle, of its origin"""
    rotation_body_wxyz: Four
    """quaternion from the board's axes to the body's (FRD)"""
    covariance_body: Covariance
    """as of a marker"""
    range_sigma_m: float
    """as of a marker"""
    angle_sigma_rad: float
    """as of a marker"""


class MarkersBody(FrameBody):
    """The markers in one frame."""

    localization_error: str
    """why the markers have no position; empty if they have"""
    markers: list[MarkerBody]
    """the markers"""
    boards: list[BoardBody]
    """the boards of `markers.boards_file`; empty where the vehicle's pose is unknown"""


class DepthBoxBody(TypedDict):
    """The distance of one detection."""

    class_name: str
    """name of its class"""
    track_id: int | None
    """its track; null: none"""
    xyxy: Four
    """edges of its box, pixels: left, top, right, bottom"""
    depth_m: float | None
    """distance of its nearest point along the optical axis, as in detections; null: unknown"""


class DepthBody(FrameBody):
    """The depth image of one frame."""

    centre_m: float | None
    """distance at the centre of the image along the optical axis; null: unknown"""
    valid_share: Annotated[float, Field(ge=0, le=1)]
    """share of the pixels with known depth"""
    boxes: list[DepthBoxBody]
    """the detections"""


class ImageBody(TypedDict):
    """The attachment of an image; the payload is the JPEG itself."""

    camera: str | None
    """name of the camera; null: the first"""
    sequence: int
    """number of the frame, as in detections"""
    captured_ns: int
    """capture of the frame"""
    annotated: bool
    """the detections are drawn in it"""


class CloudBody(TypedDict):
    """The attachment of a point cloud.

    The payload has 16 bytes for each point: x, y, z as little-endian float32, metres, then red, green, blue,
    255. The axes are those of the camera: right, down, forward.
    """

    camera: str | None
    """name of the camera; null: the first"""
    sequence: int
    """number of the frame, as in detections"""
    captured_ns: int
    """capture of the frame"""
    frame_id: str
    """the camera's frame, as in transforms"""
    points: int
    """number of points"""


class MountBody(TypedDict):
    """How a camera is mounted."""

    parent_frame_id: str
    """the frame it is mounted on: body or gimbal"""
    translation_m: Three
    """position of the lens, in the parent's axes; on a gimbal, in those of the body"""
    rotation_wxyz: Four
    """rotates the camera's optical frame into the parent's"""
    stabilized: bool
    """roll and pitch are relative to the horizon instead of the body"""
    on_gimbal: bool
    """the autopilot's gimbal carries it"""


class CameraInfoBody(TypedDict):
    """One camera: lens and mount. `width` to `p` are those of ROS's sensor_msgs/CameraInfo."""

    vehicle: str
    """name of the vehicle"""
    camera: str | None
    """name of the camera; null: the first"""
    stamp_ns: int
    """of this message"""
    frame_id: str
    """of the optical frame (x right, y down, z forward)"""
    width: int
    """width of the frames, pixels"""
    height: int
    """height of the frames, pixels"""
    distortion_model: str
    """plumb_bob (Brown-Conrady), rational_polynomial or equidistant (fisheye)"""
    d: Annotated[list[float], Field(min_length=4, max_length=8)]
    """plumb_bob: k1, k2, p1, p2, k3; rational_polynomial: and k4, k5, k6; equidistant: k1, k2, k3, k4"""
    k: Matrix3
    """camera matrix by rows; pixel (0, 0) is the centre of the upper left pixel"""
    r: Matrix3
    """rectification; the identity"""
    p: Matrix34
    """projection of the rectified image"""
    calibrated: bool
    """false: the lens is computed from camera.horizontal_fov_deg"""
    mount: MountBody
    """its mount"""


class TransformBody(TypedDict):
    """One transform: a point in the child frame is rotated, then translated into the parent frame."""

    parent_frame_id: str
    """frame of the result"""
    child_frame_id: str
    """frame of the point"""
    translation_m: Three
    """of the child's origin, in the parent's axes"""
    rotation_wxyz: Four
    """rotates the child's axes into the parent's"""


class TransformsBody(TypedDict):
    """The transforms at the capture of one frame, from NED to the camera."""

    vehicle: str
    """name of the vehicle"""
    camera: str | None
    """name of the camera; null: the first"""
    sequence: int
    """number of the frame, as in detections"""
    captured_ns: int
    """capture of the frame: the time of all transforms"""
    transforms: list[TransformBody]
    """NED from body, body from gimbal if there is one, and body or gimbal from camera"""


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
    """north and east of the points of the way around obstacles that is flown; empty: none"""


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


class OtherCommanderBody(TypedDict):
    """Another service that commands this vehicle."""

    via: str
    """mavlink or zenoh"""
    identity: str
    """its MAVLink address, or service of its status"""
    uptime_s: float
    """since its start"""
    in_command: bool
    """whether it is in command"""


class StatusVehicleBody(TypedDict):
    """The link to the vehicle."""

    name: str
    """its name"""
    connected: bool
    """a heartbeat was received within 3 s"""
    autopilot: str | None
    """PX4 or ArduPilot; null until known"""
    driver: str
    """MAVLink library: mavsdk or pymavlink"""
    mode: str
    """flight mode"""
    armed: bool
    """motors are armed"""
    failsafe: bool
    """MAV_STATE_CRITICAL or EMERGENCY"""
    missing_streams: list[str]
    """required messages that arrive at less than half their rate"""
    status_texts: list[str]
    """the autopilot's last 20 texts, newest last"""
    other_commanders: list[OtherCommanderBody]
    """other services seen within 3.5 s"""


class StatusStepBody(TypedDict):
    """A step of a mission that has ended."""

    title: str
    """its title in the mission"""
    command: str
    """its command"""
    success: bool
    """it reached its goal"""
    reason: str
    """how it ended"""
    started_ns: int
    """its start"""
    ended_ns: int
    """its end"""


class StatusMissionBody(TypedDict):
    """The mission being flown."""

    name: str
    """its name"""
    steps: list[str]
    """titles"""
    current: int
    """index of the active step"""
    failure: str
    """why its failure handling is flown; empty: it is not"""
    ended: list[StatusStepBody]
    """the last 20 steps"""


class StatusLimitsBody(TypedDict):
    """Where the vehicle may fly, from home."""

    max_distance_m: float
    """horizontally"""
    max_altitude_m: float
    """above home"""
    fence_include: Corners
    """corners north, east; empty: no fence"""
    fence_exclude: list[Corners]
    """areas not to enter"""


class StatusPilotBody(TypedDict):
    """Guidance."""

    in_command: bool
    """the vehicle follows our setpoints"""
    behaviour: str
    """the active one"""
    stream: str
    """state of the streamer"""
    setpoints_sent: int
    """so far"""
    mission: StatusMissionBody | None
    """null: no mission is flown"""


class StatusCameraBody(TypedDict):
    """One camera with its worker process."""

    state: str
    """stopped, starting, running, restarting, finished or failed"""
    pid: int | None
    """of the process"""
    restarts: int
    """so far"""
    frames: int
    """read so far"""
    results: int
    """received so far"""
    rate_hz: float
    """results a second"""
    sequence: int | None
    """of the newest result"""
    age_s: float | None
    """of the newest result"""
    timing_ms: dict[str, float]
    """stage: newest duration"""
    timing_p50_ms: dict[str, float]
    """stage: median of the newest 200"""
    timing_p99_ms: dict[str, float]
    """stage: 99th percentile of the newest 200"""
    dropped: int
    """frames lost unintentionally"""
    frames_skipped: dict[str, int]
    """reason: frames without a message"""
    stuck_after_s: float | None
    """silence after which the process is restarted"""
    class_names: list[str]
    """classes of the model"""
    tracks: int
    """confirmed tracks that have not ended"""
    model: str | None
    """name of the model"""
    model_sha256: Sha256 | None
    """of its file"""
    runtime: str | None
    """of the network"""
    runtime_reason: str
    """why this runtime and precision"""
    problem: str
    """the last error; empty: none"""


class StatusTargetsBody(TypedDict):
    """The objects that guidance may use."""

    camera: str | None
    """the steering camera; null: the first"""
    count: int
    """number of objects in its newest frame"""
    localization_error: str
    """why detections have no direction; empty if they have"""


class StatusGimbalBody(TypedDict):
    """The gimbal in `status`."""

    answers: bool
    """a gimbal was received"""
    pitch_deg: float | None
    """above the horizon"""
    primary_control: str | None
    """MAVLink address with primary control"""
    ours: bool
    """whether the service has primary control"""
    problem: str | None
    """why its attitude is unknown, or why it is not moved"""


class StatusNeighboursBody(TypedDict):
    """The other vehicles."""

    ages_s: dict[str, float]
    """vehicle: age of its pose"""
    unread: int
    """invalid messages"""
    out_of_order: int
    """messages older than the newest"""


class StatusBusBody(TypedDict):
    """The network."""

    connected: bool
    """a node is connected, or none is expected"""
    published: dict[str, int]
    """topic: messages so far, with or without a subscriber"""
    publish_failed: int
    """messages without a session, or refused by zenoh"""
    refused_commands: int
    """commands refused by the rate limit"""


class StatusLogBody(TypedDict):
    """The log."""

    dropped_lines: int
    """lines not written because the reader stalled"""


class StatusBody(TypedDict):
    """The state of every part of the service."""

    stamp_ns: int
    """of this message"""
    service: str
    """changes at each start; source in pose"""
    uptime_s: float
    """since the start of the service"""
    healthy: bool
    """every camera delivers results and the autopilot is connected"""
    vehicle: StatusVehicleBody
    """the link to the vehicle"""
    pilot: StatusPilotBody
    """guidance"""
    limits: StatusLimitsBody
    """where the vehicle may fly"""
    perception: StatusCameraBody
    """the first camera"""
    cameras: dict[str, StatusCameraBody]
    """name: each further camera"""
    targets: StatusTargetsBody
    """objects that guidance may use"""
    gimbal: StatusGimbalBody | None
    """null without a gimbal and a camera on one"""
    neighbours: StatusNeighboursBody
    """other vehicles"""
    bus: StatusBusBody
    """the network"""
    log: StatusLogBody
    """the log"""


class EventBody(TypedDict):
    """One event of the service."""

    stamp_ns: int
    """when"""
    level: LevelWord
    """severity"""
    text: str
    """for the operator"""


class StepBody(TypedDict):
    """One ended step of a mission."""

    title: str
    """name of the step"""
    command: str
    """its command"""
    success: bool
    """result"""
    reason: str
    """reason of the result"""
    started_ns: int
    """begin"""
    ended_ns: int
    """end"""


class CommandReplyBody(TypedDict):
    """The reply to a command."""

    command: str
    """the command as understood"""
    success: bool
    """result"""
    reason: str
    """reason of the result"""
    steps: NotRequired[list[StepBody]]
    """of a mission: its ended steps"""


class ModelBody(TypedDict):
    """One loaded model, in the reply of `models`."""

    camera: str | None
    """name of the camera; null: the first"""
    running: bool
    """whether its process runs"""
    model: str
    """its name"""
    model_sha256: Sha256 | None
    """of its file; null for a detector without one"""
    class_names: list[str]
    """its classes"""
    runtime: str | None
    """of the network"""
    precision: str | None
    """of the network"""


class ModelsBody(TypedDict):
    """The reply of `models`."""

    loaded: list[ModelBody]
    """the models in use"""
    files: list[str]
    """file names in the models folder"""
