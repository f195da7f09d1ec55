"""Everything that can be set: one frozen value, a section for each part of the service.

Every key is declared once, with its default, its range and one line of help; the file's comments, the flags,
the checks and their messages (`config.py`) all come from that declaration.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, model_validator

from companion.geometry.fence import Fence, Polygon
from companion.geometry.points import points_from
from vision.camera_model import CameraModel, CameraMount
from vision.frame import Frame
from vision.frame_selection import Selection
from vision.markers import MarkerKind, PadMarker, markers_in
from vision.sources.source import SourceSettings
from vision.tracking.tracks import TrackerSettings

# What `vision.detector` calls the bundled model. Named here too, as importing that module would load torch.
DEFAULT_MODEL = "default"


class Section(BaseModel):
    """One table of the file. Values are never changed and never guessed from another type."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, use_attribute_docstrings=True
    )


# One word of a zenoh key expression: no `/`, and none of its wildcards and separators `* $ ? # @`.
_KEY_WORD = StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", max_length=64)
KeyWord = Annotated[str, _KEY_WORD]
_HOST_AND_PORT = StringConstraints(pattern=r"^[^\s:]+:[0-9]{1,5}$", max_length=300)
# The same without a dot, as `views.NAME.source` is a key.
_VIEW_NAME = StringConstraints(pattern=r"^[A-Za-z0-9][A-Za-z0-9_-]*$", max_length=64)
ViewName = Annotated[str, _VIEW_NAME]
VehicleUrl = Annotated[
    str, StringConstraints(pattern=r"^(udpin|udpout|udp|tcp|tcpin|tcpout|serial)://.+$", max_length=400)
]
# ID:SIZE of a marker of its own size; with @PAD, and :RIGHT:UP where it does not lie on the pad's centre.
_MARKER_TEXT = StringConstraints(pattern=r"^[0-9]+:[0-9.]+(@[0-9]+(:-?[0-9.]+:-?[0-9.]+)?)?$", max_length=80)
ZenohEndpoint = Annotated[
    str,
    StringConstraints(pattern=r"^(tcp|udp|tls|quic|ws|serial|unixsock-stream|unixpipe|vsock)/.+$"),
]

# What a pattern means, in words, for a person whose value did not match it.
PATTERN_MEANINGS = {
    r"^[A-Za-z0-9][A-Za-z0-9_.-]*$": "a word of letters, digits, `_`, `-` and `.`",
    r"^[^\s:]+:[0-9]{1,5}$": "HOST:PORT such as 127.0.0.1:9100",
    r"^[A-Za-z0-9][A-Za-z0-9_-]*$": "a word of letters, digits, `_` and `-`",
    r"^(udpin|udpout|udp|tcp|tcpin|tcpout|serial)://.+$": (
        "udpin://HOST:PORT, udpout://HOST:PORT, tcp://HOST:PORT or serial://DEVICE:BAUD"
    ),
    r"^[0-9]+:[0-9.]+(@[0-9]+(:-?[0-9.]+:-?[0-9.]+)?)?$": (
        "ID:SIZE, ID:SIZE@PAD or ID:SIZE@PAD:RIGHT:UP such as 17:0.15@4:0.75:0"
    ),
    r"^(tcp|udp|tls|quic|ws|serial|unixsock-stream|unixpipe|vsock)/.+$": (
        "a zenoh endpoint such as tcp/192.168.1.5:7447"
    ),
}


class VehicleSection(Section):
    """The autopilot, and what the vehicle is called."""

    url: VehicleUrl = "udpin://127.0.0.1:14540"
    """where the autopilot is: udpin:// (listen), udpout:// or tcp://HOST:PORT, or serial:///dev/ttyAMA0:921600"""
    driver: Literal["mavsdk", "pymavlink"] = "mavsdk"
    """the library that speaks MAVLink"""
    system_id: Annotated[int, Field(ge=1, le=255)] = 1
    """the autopilot's MAVLink system id"""
    name: KeyWord = "vehicle1"
    """what the vehicle is called in zenoh's keys: companion/NAME/detections"""
    connect_timeout_s: Annotated[float, Field(gt=0, le=3600)] = 30.0
    """how long to wait for the autopilot's first heartbeat, seconds"""
    signing_key_file: str | None = None
    """sign MAVLink with this file's 32 bytes or passphrase, readable by its owner alone; unset: unsigned"""


class SourceSection(Section):
    """Where frames come from."""

    uri: Annotated[str, Field(min_length=1)] = "/dev/video0"
    """a video file, a folder of images, /dev/video0, a FIFO or - (standard input), rtsp://, http:// or udp://"""
    width: Annotated[int | None, Field(ge=16, le=16384)] = None
    """of a frame, pixels; asked of a camera, and needed for raw frames from a pipe"""
    height: Annotated[int | None, Field(ge=16, le=16384)] = None
    """of a frame, pixels, as width"""
    rate_hz: Annotated[float | None, Field(gt=0, le=1000)] = None
    """frames a second; asked of a camera, and the pace of images and raw files"""
    pixel_format: str | None = None
    """a camera's four letters (MJPG, YUYV), or what a pipe carries: bgr24, rgb24, gray8, y4m, mjpeg"""
    loop: bool = False
    """begin a file or folder again when it ends"""
    realtime: bool = True
    """play a file or folder at its own pace, as a camera would; false: every frame, as fast as can be"""
    every_frame: bool | None = None
    """pipes only: true: every frame, the writer waits; false: the newest; unset: true for a regular file"""
    open_timeout_s: Annotated[float, Field(gt=0, le=3600)] = 10.0
    """how long the first frame may take at start, seconds"""
    read_timeout_s: Annotated[float, Field(gt=0, le=3600)] = 5.0
    """a live source that is silent for so long is opened again, seconds"""
    share: Annotated[str | None, _KEY_WORD] = None
    """also offer the frames to other programs of this computer, and to other views, as shm://NAME"""

    @model_validator(mode="after")
    def _can_be_opened(self) -> Self:
        self.opening()
        return self

    def opening(self, on_frame: Callable[[Frame], None] | None = None) -> SourceSettings:
        """The same, as `vision.sources.open_source` takes it. Raises ValueError for a bad pixel format."""
        return SourceSettings(**self.model_dump(exclude={"uri", "share"}), on_frame=on_frame)


class CameraSection(Section):
    """The lens, and how the camera is mounted. Body frame: forward, right, down."""

    horizontal_fov_deg: Annotated[float, Field(gt=1, lt=179)] = 80.0
    """field of view from the left edge to the right, degrees; unused when fx_px is set"""
    mount_forward_m: Annotated[float, Field(ge=-10, le=10)] = 0.0
    """the camera's place ahead of the autopilot, metres"""
    mount_right_m: Annotated[float, Field(ge=-10, le=10)] = 0.0
    """the camera's place to the right of the autopilot, metres"""
    mount_down_m: Annotated[float, Field(ge=-10, le=10)] = 0.0
    """the camera's place below the autopilot, metres"""
    mount_roll_deg: Annotated[float, Field(ge=-180, le=180)] = 0.0
    """the camera's roll on the body, degrees"""
    mount_pitch_deg: Annotated[float, Field(ge=-90, le=90)] = 0.0
    """the camera's pitch on the body, degrees; negative looks down"""
    mount_yaw_deg: Annotated[float, Field(ge=-180, le=180)] = 0.0
    """the camera's yaw on the body, degrees clockwise"""
    mount_levelled: bool = False
    """a gimbal holds the camera: its roll and pitch count from the horizon, its yaw from the nose"""
    fx_px: Annotated[float | None, Field(gt=0)] = None
    """calibrated focal length along x, pixels; with it fy_px, cx_px, cy_px and calibrated_* are needed"""
    fy_px: Annotated[float | None, Field(gt=0)] = None
    """calibrated focal length along y, pixels"""
    cx_px: float | None = None
    """calibrated principal point, pixels from the left"""
    cy_px: float | None = None
    """calibrated principal point, pixels from the top"""
    calibrated_width: Annotated[int | None, Field(ge=16, le=16384)] = None
    """width of the pictures that calibrated the camera, pixels"""
    calibrated_height: Annotated[int | None, Field(ge=16, le=16384)] = None
    """height of the pictures that calibrated the camera, pixels"""
    distortion: tuple[float, ...] = ()
    """k1, k2, p1, p2, k3 in OpenCV's order: none, four or five numbers"""

    @model_validator(mode="after")
    def _calibration_is_whole(self) -> Self:
        calibration = {
            name: getattr(self, name)
            for name in ("fx_px", "fy_px", "cx_px", "cy_px", "calibrated_width", "calibrated_height")
        }
        missing = [name for name, value in calibration.items() if value is None]
        if missing and len(missing) < len(calibration):
            raise ValueError(f"a calibration needs all of {', '.join(calibration)}; {missing[0]} is not set")
        if len(self.distortion) not in (0, 4, 5):
            raise ValueError(f"distortion must have 0, 4 or 5 numbers, got {len(self.distortion)}")
        return self

    def model(self, width: int, height: int) -> CameraModel:
        """The camera's model for frames of this size, pixels."""
        if (
            self.fx_px is None
            or self.fy_px is None
            or self.cx_px is None
            or self.cy_px is None
            or self.calibrated_width is None
            or self.calibrated_height is None
        ):
            fov_rad = math.radians(self.horizontal_fov_deg)
            ideal = CameraModel.from_horizontal_fov(width, height, fov_rad)
            return CameraModel(width, height, ideal.fx, ideal.fy, ideal.cx, ideal.cy, self.distortion)
        calibrated = CameraModel(
            self.calibrated_width,
            self.calibrated_height,
            self.fx_px,
            self.fy_px,
            self.cx_px,
            self.cy_px,
            self.distortion,
        )
        return calibrated.scaled(width, height)

    def mount(self) -> CameraMount:
        """How the camera sits on the body."""
        return CameraMount(
            self.mount_forward_m,
            self.mount_right_m,
            self.mount_down_m,
            math.radians(self.mount_roll_deg),
            math.radians(self.mount_pitch_deg),
            math.radians(self.mount_yaw_deg),
            self.mount_levelled,
        )


class DetectorSection(Section):
    """What looks for objects in the frames."""

    enabled: bool = True
    """false: frames are read and nothing is looked for"""
    model: Annotated[str, Field(min_length=1)] = DEFAULT_MODEL
    """a checkpoint or an exported file; default: the model of this package, which knows drawn scenes"""
    classes: tuple[str | int, ...] = ()
    """only these classes, by name or id; none: all that the model knows"""
    confidence: Annotated[float, Field(ge=0, le=1)] = 0.25
    """the smallest confidence kept"""
    iou: Annotated[float, Field(ge=0, le=1)] = 0.7
    """boxes of one class that overlap by more than this are one object"""
    image_size: Annotated[int, Field(ge=32, le=4096, multiple_of=32)] = 640
    """the frame's longer side as the network sees it, pixels"""
    runtime: Literal["auto", "torch", "onnxruntime", "openvino", "tensorrt"] = "torch"
    """what computes the network; auto takes the fastest installed, measured once on this board"""
    precision: Literal["auto", "float32", "bfloat16", "float16"] = "auto"
    """arithmetic of the network; auto takes bfloat16 where the processor is fast at it"""
    threads: Annotated[int | None, Field(ge=1, le=256)] = None
    """processor threads of the network; unset: one for every processor but one"""
    every: Annotated[int, Field(ge=1, le=1000)] = 1
    """look at every N-th frame only"""
    rate_hz: Annotated[float | None, Field(gt=0, le=1000)] = None
    """look at no more than so many frames a second; unset: at all that come"""
    max_age_s: Annotated[float | None, Field(gt=0, le=3600)] = None
    """do not look at a frame that was captured longer ago, seconds; unset: look at all"""
    tiles: bool = False
    """look at large frames in overlapping tiles too, for small objects; 1080p takes some 14 times as long"""
    tile_size: Annotated[int, Field(ge=64, le=4096)] = 640
    """side of a tile, pixels of the frame; best as large as image_size"""
    tile_overlap: Annotated[float, Field(ge=0, le=0.8)] = 0.2
    """of neighbouring tiles, share of a tile"""

    def selection(self) -> Selection:
        """Which frames are looked at."""
        return Selection(self.every, self.rate_hz, self.max_age_s)


class TrackerSection(Section):
    """Which detection is which object from frame to frame, and which objects count as true."""

    enabled: bool = True
    """give every object an identity; false: every frame stands for itself, and all that is seen counts"""
    high_confidence: Annotated[float, Field(ge=0, le=1)] = 0.35
    """a detection this sure can begin a track (never less than detector.confidence)"""
    low_confidence: Annotated[float, Field(ge=0, le=1)] = 0.1
    """a detection this sure can continue a track, and is then kept in spite of detector.confidence"""
    true_score: Annotated[float, Field(ge=0, le=1)] = 0.4
    """a track counts as true when the median of its confidences reaches this; only such can be flown to"""
    true_frames: Annotated[int, Field(ge=1, le=1000)] = 3
    """and when it was seen in so many frames"""
    lost_s: Annotated[float, Field(gt=0, le=60)] = 0.5
    """unseen for so long, a track is lost, seconds"""
    end_s: Annotated[float, Field(gt=0, le=600)] = 2.0
    """unseen for so long, a track has ended: what comes then is another, seconds"""
    camera_motion: bool = True
    """remove the camera's turning by the vehicle's attitude; false for recorded films"""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        self.following(0.0)
        return self

    def following(self, confidence: float) -> TrackerSettings:
        """The same, as `vision.tracking` takes it, beside a detector with this `confidence`."""
        values = self.model_dump(exclude={"enabled", "camera_motion"})
        values["high_confidence"] = max(self.high_confidence, confidence)
        return TrackerSettings(keep_confidence=confidence, **values)


class MarkersSection(Section):
    """Printed markers (ArUco, AprilTag) that are looked for in the frames, to land on."""

    dictionary: str | None = None
    """OpenCV's name of it without DICT_: APRILTAG_36h11, 4X4_50; unset: no markers are looked for"""
    size_m: Annotated[float, Field(ge=0.01, le=50)] = 0.5
    """side of a marker's black square, metres"""
    others: tuple[Annotated[str, _MARKER_TEXT], ...] = ()
    """of another size: ID:SIZE; on the pad of marker PAD: ID:SIZE@PAD, off its centre ID:SIZE@PAD:RIGHT:UP"""

    @model_validator(mode="after")
    def _can_be_found(self) -> Self:
        self.kind()
        count = None if self.dictionary is None else markers_in(self.dictionary)
        for marker in self.pad_markers():
            if marker.identifier == marker.pad or (count is not None and marker.pad >= count):
                raise ValueError(f"others: {marker.identifier} cannot lie on the pad of {marker.pad}")
        return self

    def kind(self) -> MarkerKind | None:
        """What is looked for; None: nothing. Raises ValueError for what cannot be."""
        sizes = {identifier: size for identifier, size, _ in map(_other_marker, self.others)}
        if len(sizes) < len(self.others):
            raise ValueError(f"others: an id is given twice in {', '.join(self.others)}")
        return None if self.dictionary is None else MarkerKind(self.dictionary, self.size_m, sizes)

    def pad_markers(self) -> tuple[PadMarker, ...]:
        """Those that lie on the pad of another."""
        return tuple(pad for _, _, pad in map(_other_marker, self.others) if pad is not None)


def _other_marker(text: str) -> tuple[int, float, PadMarker | None]:
    own, _, place = text.partition("@")
    identifier, size = own.split(":")
    if not place:
        return int(identifier), float(size), None
    pad, *offset = place.split(":")
    return int(identifier), float(size), PadMarker(int(identifier), int(pad), *map(float, offset))


def _corners(key: str, text: str) -> Polygon:
    try:
        points = points_from(text)
        if any(len(point) != 2 for point in points):
            raise ValueError("a corner is north,east")
        corners = tuple((point[0], point[1]) for point in points)
        Fence(corners)
    except ValueError as error:
        raise ValueError(f"{key}: {error}") from None
    return corners


class GuidanceSection(Section):
    """How the vehicle may be moved, and when what we know is too old to move by."""

    rate_hz: Annotated[float, Field(ge=5, le=200)] = 20.0
    """how often a behaviour is asked where to go, times a second"""
    max_horizontal_speed_mps: Annotated[float, Field(gt=0, le=30)] = 5.0
    """largest horizontal speed asked for, metres a second"""
    max_climb_mps: Annotated[float, Field(gt=0, le=10)] = 2.0
    """largest climb rate asked for, metres a second"""
    max_descend_mps: Annotated[float, Field(gt=0, le=10)] = 1.0
    """largest descent rate asked for, metres a second"""
    max_yaw_rate_radps: Annotated[float, Field(gt=0, le=6)] = 1.0
    """largest turn rate asked for, radians a second"""
    max_acceleration_mps2: Annotated[float, Field(gt=0, le=20)] = 2.0
    """largest change of the velocity asked for, metres a second squared"""
    min_altitude_m: Annotated[float, Field(gt=0, le=1000)] = 1.0
    """never asks to fly lower than this above home, unless to land (on a marker, too), metres"""
    max_altitude_m: Annotated[float, Field(gt=0, le=5000)] = 50.0
    """never asks to fly higher than this above home, metres"""
    max_distance_m: Annotated[float, Field(gt=0, le=100000)] = 200.0
    """never asks to fly farther than this from home, metres"""
    fence_include: str = ""
    """corners of the area never left, north,east of home in metres: "-50,-50 50,-50 50,50"; empty: none"""
    fence_exclude: str = ""
    """areas never entered, written the same way and parted by |"""
    min_separation_m: Annotated[float, Field(gt=0, le=100)] = 3.0
    """never asks to fly nearer than this to another vehicle that shares its pose, metres"""
    setpoint_rate_hz: Annotated[float, Field(ge=5, le=250)] = 50.0
    """setpoints a second on the link; PX4 needs more than 2"""
    setpoint_lifetime_s: Annotated[float, Field(ge=0.02, le=2)] = 0.3
    """a setpoint older than this is not sent any more, seconds"""
    brake_s: Annotated[float, Field(ge=0, le=5)] = 0.5
    """after that a brake is sent for so long, then nothing, and the autopilot's failsafe acts; seconds"""
    min_battery_percent: Annotated[float, Field(ge=0, le=100)] = 15.0
    """no flight begins with less charge than this, and one ends below it; percent, 0: not watched"""
    low_battery: Literal["rtl", "land", "hold"] = "rtl"
    """what follows a flight that ended for its battery: return, land here, or hold under our command"""
    obstacles: Literal["off", "auto", "required"] = "auto"
    """depth slows flight towards obstacles: where it comes (auto), or nothing flies without it (required)"""
    obstacle_margin_m: Annotated[float, Field(gt=0, le=50)] = 2.0
    """distance kept from obstacles, from the vehicle's middle, metres"""
    unknown_speed_mps: Annotated[float | None, Field(gt=0, le=30)] = None
    """largest speed towards what the depth camera does not see; unset: not limited, metres a second"""
    perception_max_age_s: Annotated[float, Field(gt=0, le=10)] = 0.5
    """detections older than this do not steer, seconds from capture"""
    view: Annotated[str | None, _VIEW_NAME] = None
    """the view that steers; unset: the one of the sections source, camera and detector"""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.min_altitude_m >= self.max_altitude_m:
            raise ValueError(
                f"min_altitude_m must be below max_altitude_m, got {self.min_altitude_m:g} "
                f"and {self.max_altitude_m:g}"
            )
        if self.setpoint_lifetime_s <= 1 / self.rate_hz:
            raise ValueError(
                f"setpoint_lifetime_s must be longer than one period of rate_hz ({1 / self.rate_hz:.3g} s), "
                f"got {self.setpoint_lifetime_s:g}: each setpoint would expire before the next"
            )
        self.fence()
        return self

    def fence(self) -> Fence:
        """The same as polygons. Raises ValueError for what is none."""
        include = _corners("fence_include", self.fence_include) if self.fence_include else ()
        areas = [text for text in self.fence_exclude.split("|") if text.strip()]
        return Fence(include, tuple(_corners("fence_exclude", text) for text in areas))


class ZenohSection(Section):
    """The network on which detections are published and commands are taken."""

    mode: Literal["peer", "client"] = "peer"
    """peer: talks to others directly; client: through the router at `connect`"""
    connect: tuple[ZenohEndpoint, ...] = ()
    """endpoints to connect to, e.g. tcp/192.168.1.5:7447; retried until they answer"""
    listen: tuple[ZenohEndpoint, ...] = ("tcp/127.0.0.1:7447",)
    """endpoints to listen on (peer only); tcp/0.0.0.0:7447 lets the whole network in"""
    multicast_scouting: bool = False
    """find other peers on the local network by multicast"""

    @model_validator(mode="after")
    def _reachable(self) -> Self:
        if self.mode == "client" and not self.connect and not self.multicast_scouting:
            raise ValueError("a client needs an endpoint in connect, or multicast_scouting = true")
        return self


class RecordingSection(Section):
    """What is kept on disk."""

    video: str | None = None
    """a .webm file to write the annotated video to; unset: none"""
    rate_hz: Annotated[float, Field(ge=0.1, le=240)] = 15.0
    """frames a second of that video; one of 640x480 costs up to 40 ms of a processor core"""

    @model_validator(mode="after")
    def _is_webm(self) -> Self:
        if self.video is not None and not self.video.lower().endswith(".webm"):
            raise ValueError(f"video must end in .webm, got {self.video!r}")
        return self


class PreviewSection(Section):
    """Pictures on the network: JPEG, only while somebody subscribes to them."""

    rate_hz: Annotated[float, Field(gt=0, le=60)] = 5.0
    """pictures a second, at most"""
    quality: Annotated[int, Field(ge=1, le=100)] = 80
    """of the JPEG, as its encoders count"""
    width: Annotated[int, Field(ge=16, le=4096)] = 1280
    """larger frames are shrunk to this width, pixels"""
    annotate: bool = True
    """draw what was detected"""


class MetricsSection(Section):
    """Numbers for a monitoring system."""

    listen: Annotated[str | None, _HOST_AND_PORT] = None
    """HOST:PORT that serves /metrics in Prometheus' format (extra `metrics`); unset: nothing listens"""


class LogSection(Section):
    """What is said on standard error."""

    level: Literal["debug", "info", "warning", "error"] = "info"
    """the least severe lines that are printed"""


class ViewSections(Section):
    """A further camera or model, with a process of its own, published as views/NAME."""

    source: SourceSection = SourceSection()
    camera: CameraSection = CameraSection()
    detector: DetectorSection = DetectorSection()
    tracker: TrackerSection = TrackerSection()
    markers: MarkersSection = MarkersSection()
    recording: RecordingSection = RecordingSection()


class Settings(Section):
    """Everything that can be set."""

    vehicle: VehicleSection = VehicleSection()
    source: SourceSection = SourceSection()
    camera: CameraSection = CameraSection()
    detector: DetectorSection = DetectorSection()
    tracker: TrackerSection = TrackerSection()
    markers: MarkersSection = MarkersSection()
    guidance: GuidanceSection = GuidanceSection()
    zenoh: ZenohSection = ZenohSection()
    recording: RecordingSection = RecordingSection()
    preview: PreviewSection = PreviewSection()
    metrics: MetricsSection = MetricsSection()
    log: LogSection = LogSection()
    views: dict[ViewName, ViewSections] = {}

    @model_validator(mode="after")
    def _views_fit_together(self) -> Self:
        if self.guidance.view is not None and self.guidance.view not in self.views:
            known = ", ".join(self.views) or "none"
            raise ValueError(f"guidance.view: there is no view {self.guidance.view!r} (views: {known})")
        openers: dict[str, str] = {}
        sharers: dict[str, str] = {}
        for key, source in self.sources().items():
            uri = f"/dev/video{int(source.uri)}" if source.uri.isdecimal() else source.uri
            if uri in openers and _opens_once(uri):
                raise ValueError(
                    f"{key}.uri and {openers[uri]}.uri are both {uri}, which can be "
                    f'opened once: give one of them share = "NAME" and the other uri = "shm://NAME"'
                )
            openers[uri] = key
            if source.share is None:
                continue
            if uri == f"shm://{source.share}":
                raise ValueError(f"{key}.share: {source.share!r} is where its own frames come from")
            if source.share in sharers:
                raise ValueError(f"{key}.share and {sharers[source.share]}.share are both {source.share!r}")
            sharers[source.share] = key
        return self

    @model_validator(mode="after")
    def _films_are_files_of_their_own(self) -> Self:
        films = [self.recording.video, *(sections.recording.video for sections in self.views.values())]
        named = [film for film in films if film is not None]
        if len(set(named)) < len(named):
            raise ValueError(f"every view needs a recording.video of its own, got {', '.join(named)}")
        return self

    @model_validator(mode="after")
    def _tracks_outlive_the_pause_between_frames(self) -> Self:
        views: dict[str, Settings | ViewSections] = {"": self}
        views |= {f"views.{name}.": sections for name, sections in self.views.items()}
        for prefix, view in views.items():
            rate_hz, end_s = view.detector.rate_hz, view.tracker.end_s
            if view.tracker.enabled and rate_hz is not None and 1 / rate_hz >= end_s:
                raise ValueError(
                    f"{prefix}tracker.end_s must be longer than one period of {prefix}detector.rate_hz "
                    f"({1 / rate_hz:.3g} s), got {end_s:g}: every track would end before the next frame"
                )
        return self

    def sources(self) -> dict[str, SourceSection]:
        """Key of the section → where that view's frames come from, the first view first."""
        return {"source": self.source} | {
            f"views.{name}.source": sections.source for name, sections in self.views.items()
        }

    def of_view(self, name: str | None) -> Settings:
        """What the worker of one view goes by: the same, with that view's own sections. None: the first."""
        if name is None:
            return self.model_copy(update={"views": {}})
        sections = self.views[name]
        own = {section: getattr(sections, section) for section in ViewSections.model_fields}
        return self.model_copy(update={"views": {}, **own})


def _opens_once(uri: str) -> bool:
    return uri == "-" or uri.startswith("/dev/")
