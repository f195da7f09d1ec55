"""The settings of what is seen: source, lens, detector, tracker, markers; its film and its pictures."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from companion.settings.section import Section
from companion.settings.texts import HEIGHT_TEXT, KEY_WORD, MARKER_TEXT
from vision.camera_model import CameraModel, CameraMount
from vision.frame import Frame
from vision.frame_selection import Selection
from vision.markers import MarkerKind, PadMarker, markers_in
from vision.object_detector import YOLO, DetectorSettings
from vision.sources.source import SourceSettings
from vision.tracking.tracks import TrackerSettings

# What `vision.detector` calls the bundled model. Named here too, as settings are read without a detector.
DEFAULT_MODEL = "default"
# As `source.uri`: there is no camera, and no perception worker.
NO_SOURCE = "none"


class SourceSection(Section):
    """Where frames come from."""

    uri: Annotated[str, Field(min_length=1)] = "/dev/video0"
    """video file, folder of images, /dev/video0, FIFO, - (standard input), rtsp://, http://, udp://; none"""
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
    share: Annotated[str | None, KEY_WORD] = None
    """also offer the frames to other programs of this computer, and to other cameras of the service, as shm://NAME"""

    @model_validator(mode="after")
    def _can_be_opened(self) -> Self:
        self.opening()
        return self

    def opening(self, on_frame: Callable[[Frame], None] | None = None) -> SourceSettings:
        """The same, as `vision.sources.open_source` takes it. Raises ValueError for a bad pixel format."""
        return SourceSettings(**self.model_dump(exclude={"uri", "share"}), on_frame=on_frame)


class CameraSection(Section):
    """Lens and mount; a key not set is the camera's own where it brings one. Body: forward, right, down."""

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
    stabilized: bool = False
    """a gimbal holds the camera: its roll and pitch count from the horizon, its yaw from the nose"""
    on_gimbal: bool = False
    """the camera sits on the autopilot's gimbal, which tells where it looks; mount angles count from that"""
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
    def _consistent(self) -> Self:
        calibration = {
            name: getattr(self, name)
            for name in ("fx_px", "fy_px", "cx_px", "cy_px", "calibrated_width", "calibrated_height")
        }
        missing = [name for name, value in calibration.items() if value is None]
        if missing and len(missing) < len(calibration):
            raise ValueError(f"a calibration needs all of {', '.join(calibration)}; {missing[0]} is not set")
        if self.on_gimbal and self.stabilized:
            raise ValueError(
                "on_gimbal and stabilized exclude each other: a gimbal reports its attitude (on_gimbal), "
                "or one that reports nothing and holds the camera level (stabilized)"
            )
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

    @property
    def field_rad(self) -> float:
        """What is seen from the left edge to the right, radians: by the calibration where there is one."""
        if self.fx_px is None or self.calibrated_width is None:
            return math.radians(self.horizontal_fov_deg)
        return 2 * math.atan(self.calibrated_width / 2 / self.fx_px)

    def mount(self) -> CameraMount:
        """How the camera sits on the body."""
        return CameraMount(
            self.mount_forward_m,
            self.mount_right_m,
            self.mount_down_m,
            math.radians(self.mount_roll_deg),
            math.radians(self.mount_pitch_deg),
            math.radians(self.mount_yaw_deg),
            self.stabilized,
            self.on_gimbal,
        )


class DetectorSection(Section):
    """What looks for objects in the frames."""

    enabled: bool = True
    """false: frames are read and nothing is looked for"""
    kind: Annotated[str, KEY_WORD] = YOLO
    """yolo, or the kind of a plug-in (plugins.modules), which then gives model, image_size… their meaning"""
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
    class_heights_m: tuple[Annotated[str, HEIGHT_TEXT], ...] = ("person:1.7", "car:1.5", "bicycle:1.1")
    """class:metres, how tall they stand: tells the range where neither depth nor the ground does"""
    tiles: bool = False
    """look at large frames in overlapping tiles too, for small objects; 1080p takes some 14 times as long"""
    tile_size: Annotated[int, Field(ge=64, le=4096)] = 640
    """side of a tile, pixels of the frame; best as large as image_size"""
    tile_overlap: Annotated[float, Field(ge=0, le=0.8)] = 0.2
    """of neighbouring tiles, share of a tile"""

    @model_validator(mode="after")
    def _heights_that_stand(self) -> Self:
        if len(self.heights()) < len(self.class_heights_m):
            raise ValueError(f"class_heights_m: a class is given twice in {', '.join(self.class_heights_m)}")
        for name, height_m in self.heights().items():
            if not 0 < height_m <= 100:
                raise ValueError(
                    f"class_heights_m: {name} must be above 0 and at most 100 m, got {height_m:g}"
                )
        return self

    def loading(self, confidence: float) -> DetectorSettings:
        """The same, as `vision.object_detector.open_detector` takes it, with this least confidence."""
        return DetectorSettings(
            model=self.model,
            classes=self.classes or None,
            confidence=confidence,
            iou=self.iou,
            image_size=self.image_size,
            precision=self.precision,
            threads=self.threads,
            runtime=self.runtime,
        )

    def selection(self) -> Selection:
        """Which frames are looked at."""
        return Selection(self.every, self.rate_hz, self.max_age_s)

    def heights(self) -> dict[str, float]:
        """Class name → metres."""
        pairs = (text.rpartition(":") for text in self.class_heights_m)
        return {name: float(height) for name, _, height in pairs}


class TrackerSection(Section):
    """Which detection is which object from frame to frame, and which objects count as true."""

    enabled: bool = True
    """give every object an identity; false: every frame stands for itself, and all that is seen counts"""
    high_confidence: Annotated[float, Field(ge=0, le=1)] = 0.35
    """a detection this sure can begin a track (never less than detector.confidence)"""
    low_confidence: Annotated[float, Field(ge=0, le=1)] = 0.1
    """a detection this sure can continue a track, and is then kept in spite of detector.confidence"""
    confirm_score: Annotated[float, Field(ge=0, le=1)] = 0.4
    """a track counts as true when the median of its confidences reaches this; only such can be flown to"""
    min_hits: Annotated[int, Field(ge=1, le=1000)] = 3
    """and when it was seen in so many frames"""
    coast_timeout_s: Annotated[float, Field(gt=0, le=60)] = 0.5
    """unseen for so long, a track is lost, seconds"""
    max_age_s: Annotated[float, Field(gt=0, le=600)] = 2.0
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
    others: tuple[Annotated[str, MARKER_TEXT], ...] = ()
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


class RecordingSection(Section):
    """What is kept on disk."""

    video: str | None = None
    """a .webm file to write the annotated video to; unset: none"""
    rate_hz: Annotated[float, Field(ge=0.1, le=240)] = 15.0
    """frames a second; 640x480 costs some 20 ms of a core each with the extra `film`, up to 150 without"""

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
