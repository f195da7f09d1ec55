"""Bodies of the messages about frames and cameras."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field
from typing_extensions import TypedDict

from companion.bus.bodies import Four, Sha256, Three, Two, one_of

TrackWord = Annotated[str, one_of("confirmed", "tentative", "none")]
TrackEventWord = Annotated[str, one_of("new", "update", "lost", "end")]
RangeWord = Annotated[str, one_of("depth", "ground_plane", "known_height", "marker", "none")]
Matrix3 = Annotated[list[float], Field(min_length=9, max_length=9)]
Matrix4 = Annotated[list[float], Field(min_length=16, max_length=16)]
Matrix34 = Annotated[list[float], Field(min_length=12, max_length=12)]
Covariance = Annotated[list[float], Field(min_length=21, max_length=21)]


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


class ObjectBody(TypedDict):
    """One object as guidance has it at this frame, its numbers not rounded; null where unknown."""

    object_id: int
    """constant while the image tracker changes its ids; of one camera, from 1 again after a standstill"""
    track_ids: list[int]
    """the track ids that it had, the newest last; empty without a tracker"""
    class_name: str
    """name of the class"""
    position_ned_m: Three | None
    """local NED, at last_ns; of a standing object fused over its detections; null: no range yet"""
    latitude_deg: float | None
    """WGS 84"""
    longitude_deg: float | None
    """WGS 84"""
    altitude_amsl_m: float | None
    """above mean sea level"""
    velocity_ned_mps: Two
    """north, east"""
    covariance: Matrix4
    """row by row, of north, east (m) and their velocities (m/s), with the vehicle's own position error"""
    moving: bool
    """its speed is more than the error explains; its position is the newest, not fused"""
    located_ns: int
    """capture of the newest frame that showed all of it with a range; 0: none"""
    first_ns: int
    """capture of the first frame with it"""
    last_ns: int
    """capture of the newest frame with it"""
    confirmed: bool
    """it may be the goal of a command"""
    ambiguous: bool
    """its newest detection may be of another class or of another object"""
    doubt: float
    """share of its detections since its confirmation in which it was ambiguous, 0 to 1"""
    occluded: bool
    """it is not in this frame"""
    frames: int
    """number of its detections"""


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
    object_id: int | None
    """the object of `objects` that it was associated with; null: none"""
    track_age_s: float | None
    """time from the track's first detection to this frame; null without a track"""
    bearing_rad: float | None
    """direction of the object at the capture, clockwise from north: of its box's centre, with depth of the
    middle between its ends"""
    elevation_rad: float | None
    """the same above the horizon"""
    ground_range_m: float | None
    """horizontal distance from the vehicle to the nearest surface"""
    distance_m: float | None
    """straight distance to the surface at that range (depth), to the ground there or the object's foot"""
    range_source: RangeWord | None
    """what the range was measured by; none: no range"""
    range_sigma_m: float | None
    """one-sigma error of ground_range_m"""
    depth_sigma_m: float | None
    """one-sigma error of depth_m"""
    distance_sigma_m: float | None
    """one-sigma error of distance_m"""


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
    objects: list[ObjectBody]
    """of the last 10 s, the confirmed ones of the last 60 s; empty for another than the steering camera"""


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
    object_id: int | None
    """the object of `objects` that it is of; null: none"""


class TracksBody(FrameBody):
    """The track events of one frame."""

    events: list[TrackEventBody]
    """oldest first"""
    objects: list[ObjectBody]
    """those of the events"""


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
    """one sigma of distance_m, not of ground_range_m, from that"""
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
    """one sigma of the straight distance of its origin, from that"""
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
    objects: list[ObjectBody]
    """markers, and the pads that they lie on: of the last 10 s, the confirmed ones of the last 60 s"""


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


class DepthImageBody(TypedDict):
    """The attachment of a depth image.

    The payload is zlib data (RFC 1950): little-endian uint16, row by row, millimetres along the optical axis
    of the pixels of the whole frame; 0: unknown, or above 65.535 m.
    """

    camera: str | None
    """name of the camera; null: the first"""
    sequence: int
    """number of the frame, as in detections"""
    captured_ns: int
    """capture of the frame"""
    width: int
    """pixels of a row"""
    height: int
    """number of rows"""


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
