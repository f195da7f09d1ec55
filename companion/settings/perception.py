"""The settings of perception: source, camera, detector, tracker, markers, recording, preview."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, Field, model_validator

from companion.settings.marker_files import Print, read_boards, read_map
from companion.settings.section import NO_KEY, Section
from companion.settings.texts import HEIGHT_TEXT, KEY_WORD, MARKER_TEXT
from vision.calibration_files.camera_info import read_camera_info, read_registration
from vision.camera_model import CameraModel, CameraMount, pixels_without_rays, scaled_to_frames
from vision.class_names import fold_name
from vision.frame import Frame
from vision.home import expanded
from vision.marker_boards import Board
from vision.marker_dictionaries import dictionary_named
from vision.markers import MarkerKind, PadMarker, markers_in
from vision.object_detector import YOLO, DetectorSettings
from vision.sources.source import SourceSettings
from vision.tracking.tracks import TrackerSettings

# The name of the bundled model in `vision.detector`, repeated since settings are read without a detector.
DEFAULT_MODEL = "default"
# As `source.uri`: no camera, and no perception worker.
NO_SOURCE = "none"


class SourceSection(Section):
    """Where frames come from."""

    uri: Annotated[str, Field(min_length=1)] = "/dev/video0"
    """/dev/video0, csi://0, file, folder, FIFO, - (standard input), rtsp, http, udp, ros://…; none"""
    width: Annotated[int | None, Field(ge=16, le=16384)] = None
    """frame width, pixels; requested from a camera, required for raw frames from a pipe"""
    height: Annotated[int | None, Field(ge=16, le=16384)] = None
    """frame height, pixels, as width"""
    rate_hz: Annotated[float | None, Field(gt=0, le=1000)] = None
    """frame rate, Hz; requested from a camera, playback rate of images and raw files"""
    pixel_format: str | None = None
    """a camera's FourCC (MJPG, YUYV), or the format of a pipe: bgr24, rgb24, gray8, yuv420, y4m, mjpeg"""
    exposure_us: Annotated[float | None, Field(ge=1, le=1e7)] = None
    """exposure time of a camera, microseconds; unset: automatic (csi://), left as it is (/dev/video0)"""
    gain: Annotated[float | None, Field(ge=0, le=1e6)] = None
    """gain of a camera: a factor (csi://), the driver's unit (/dev/video0); unset as exposure_us"""
    mirror: bool = False
    """the source delivers a mirror image: exchange left and right of image and depth"""
    rotate_deg: Annotated[int, Field(ge=0, le=270, multiple_of=90)] = 0
    """rotate image and depth clockwise, degrees; section camera describes the rotated image"""
    name: Annotated[str | None, Field(min_length=1, max_length=40)] = None
    """the source's name in messages and preview; unset: its address"""
    depth: Annotated[str | None, Field(min_length=1)] = None
    """second source, the depth of the first one's pixels: 16-bit PNG, TIFF, NPY, gray16 pipe, shm://NAME"""
    depth_scale: Annotated[float | None, Field(gt=0, le=1000)] = None
    """metres per unit of depth; unset: 0.001 for 16-bit integers, 1 for floats"""
    depth_calibration_file: Annotated[str | None, Field(min_length=1)] = None
    """calibration of a depth camera that is not registered, as companion calibrate writes it"""
    loop: bool = False
    """repeat a file or folder; not with depth"""
    every_frame: bool = False
    """of a file or pipe, as fast as they are processed; false: the newest one, a file at its frame rate"""
    open_timeout_s: Annotated[float, Field(gt=0, le=3600)] = 10.0
    """timeout of the first frame at start, seconds"""
    read_timeout_s: Annotated[float, Field(gt=0, le=3600)] = 5.0
    """timeout after which a silent live source is reopened, seconds"""
    share: Annotated[str | None, KEY_WORD] = None
    """also share the frames with other local programs and other cameras of the service, as shm://NAME"""

    @model_validator(mode="after")
    def _can_be_opened(self) -> Self:
        self.opening()
        if self.depth_scale is not None and self.depth is None:
            raise ValueError("depth_scale is the unit of depth, which is not set: set depth, or remove it")
        if self.depth_calibration_file is not None and self.depth is None:
            raise ValueError("depth_calibration_file is for depth, which is not set: set depth, or remove it")
        if self.depth_calibration_file is not None:
            read_registration(self.depth_calibration_file, self.opening().orientation)
        return self

    def opening(self, on_frame: Callable[[Frame], None] | None = None) -> SourceSettings:
        """Convert for `vision.sources.open_source`. Raises ValueError for an invalid pixel format."""
        values = self.model_dump(exclude={"uri", "share"})
        return SourceSettings(**values, realtime=not self.every_frame, on_frame=on_frame)


# Focal length over the image's size: of a pinhole camera of 179° and of 1°.
_LEAST_FOCAL, _MOST_FOCAL = 0.0043, 58.0


class CameraSection(Section):
    """Lens and mount; unset keys come from the camera's calibration, if any. Body: forward, right, down."""

    calibration_file: Annotated[str | None, Field(min_length=1)] = None
    """the lens, as ROS camera_info YAML: `companion calibrate` writes it; instead of horizontal_fov_deg"""
    horizontal_fov_deg: Annotated[float, Field(gt=1, lt=179)] = 80.0
    """horizontal field of view of a lens without distortion, degrees; unused with calibration_file"""
    mount_forward_m: Annotated[float, Field(ge=-10, le=10)] = 0.0
    """the camera's position forward of the autopilot, metres"""
    mount_right_m: Annotated[float, Field(ge=-10, le=10)] = 0.0
    """the camera's position right of the autopilot, metres"""
    mount_down_m: Annotated[float, Field(ge=-10, le=10)] = 0.0
    """the camera's position below the autopilot, metres"""
    mount_roll_deg: Annotated[float, Field(ge=-180, le=180)] = 0.0
    """the camera's roll relative to the body, degrees"""
    mount_pitch_deg: Annotated[float, Field(ge=-90, le=90)] = 0.0
    """the camera's pitch relative to the body, degrees; negative is down"""
    mount_yaw_deg: Annotated[float, Field(ge=-180, le=180)] = 0.0
    """the camera's yaw relative to the body, degrees clockwise"""
    stabilized: bool = False
    """a gimbal stabilizes the camera: roll and pitch are relative to the horizon, yaw to the nose"""
    on_gimbal: bool = False
    """the camera is on the autopilot's gimbal, which reports its attitude; mount angles are relative to it"""
    rolling_shutter_ms: Annotated[float, Field(ge=0, le=500)] = 0.0
    """time from the first row's exposure to the last row's, ms, for levelled images; 0: a global shutter"""
    lens: Annotated[CameraModel | None, NO_KEY] = None
    """that of calibration_file, which is then recorded with the settings, or the camera's own"""

    @model_validator(mode="before")
    @classmethod
    def _with_calibration_file(cls, values: Any) -> Any:
        """Read the file, unless its lens is here already: a recording is replayed without the file."""
        if not isinstance(values, dict) or not isinstance(file := values.get("calibration_file"), str):
            return values
        if values.get("lens") is not None:
            return values
        if "horizontal_fov_deg" in values:
            raise ValueError("calibration_file sets the lens, horizontal_fov_deg too: remove one of them")
        return values | {"lens": read_camera_info(expanded(file)).model}

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.on_gimbal and self.stabilized:
            raise ValueError(
                "on_gimbal and stabilized exclude each other: a gimbal reports its attitude (on_gimbal), "
                "or one that reports nothing and holds the camera level (stabilized)"
            )
        if self.lens is not None:
            _check_lens(self.lens)
        return self

    def model(self, width: int, height: int) -> CameraModel:
        """Return the camera model for frames of this size, pixels.

        Raises:
            ValueError: the lens was calibrated with images of another aspect.
        """
        if self.lens is None:
            return CameraModel.from_horizontal_fov(width, height, math.radians(self.horizontal_fov_deg))
        return scaled_to_frames(self.lens, width, height)

    def lens_problem(self) -> str:
        """Where the image has no rays, in words; empty: nowhere, or there is no calibration."""
        return "" if self.lens is None else pixels_without_rays(self.lens)

    @property
    def field_rad(self) -> float:
        """Horizontal field of view, radians; from the calibration, if any."""
        return math.radians(self.horizontal_fov_deg) if self.lens is None else self.lens.horizontal_fov_rad

    def mount(self) -> CameraMount:
        """Return the camera's mount on the body."""
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


def _check_lens(lens: CameraModel) -> None:
    """Raise ValueError for a lens that no camera has: 179° to 1° across, the axis near the image."""
    for axis, size, focal_px, centre_px in (
        ("x", lens.width, lens.fx, lens.cx),
        ("y", lens.height, lens.fy, lens.cy),
    ):
        if not _LEAST_FOCAL * size <= focal_px <= _MOST_FOCAL * size:
            raise ValueError(
                f"f{axis} of images of {size} pixels must be {_LEAST_FOCAL * size:.3g} to "
                f"{_MOST_FOCAL * size:.3g}, got {focal_px:g}"
            )
        if not -size <= centre_px <= 2 * size:
            raise ValueError(
                f"c{axis} of images of {size} pixels must be {-size} to {2 * size}, got {centre_px:g}"
            )


def check_calibration_file(values: Any, source: SourceSection, read_uri: str | None = None) -> None:
    """Check that `camera.calibration_file` in a table of sections is of the images of its source.

    Not where its lens is there already: that of a recording, which is read without the file.

    Args:
        read_uri: a command's own source, which is read instead of `source.uri`.

    Raises:
        ValueError: it is of another camera, or of images that are turned otherwise.
    """
    camera = values.get("camera") if isinstance(values, dict) else None
    if not isinstance(camera, dict) or camera.get("lens") is not None:
        return
    if isinstance(file := camera.get("calibration_file"), str):
        info = read_camera_info(expanded(file))
        info.check_source(source.opening().orientation, source.name, read_uri or source.uri)


class DetectorSection(Section):
    """The object detector."""

    enabled: bool = True
    """false: frames are read without detection"""
    kind: Annotated[str, KEY_WORD] = YOLO
    """yolo, or the kind of a plug-in (plugins.modules), which then defines model, image_size…"""
    model: Annotated[str, Field(min_length=1)] = DEFAULT_MODEL
    """a checkpoint or an exported file; default: the bundled model, trained on rendered scenes"""
    classes: tuple[str | int, ...] = ()
    """only these classes, by name or id; empty: all classes of the model"""
    confidence: Annotated[float, Field(ge=0, le=1)] = 0.25
    """minimum confidence of detections"""
    iou: Annotated[float | None, Field(ge=0, le=1)] = None
    """NMS IoU threshold; unset: that of the model's description, else 0.7"""
    image_size: Annotated[int, Field(ge=32, le=4096, multiple_of=32)] = 640
    """longer side of the network's input, pixels"""
    runtime: Literal["auto", "torch", "onnxruntime", "openvino", "tensorrt"] | None = None
    """runtime of the network; unset: the file's, torch for a checkpoint; auto: the fastest, measured once"""
    precision: Literal["auto", "float32", "bfloat16", "float16"] = "auto"
    """arithmetic of the network; auto uses bfloat16 if the processor supports it well"""
    device: Literal["cpu", "cuda"] = "cpu"
    """where torch computes a checkpoint; cuda: an NVIDIA GPU"""
    threads: Annotated[int | None, Field(ge=1, le=256)] = None
    """CPU threads of the network; unset: all processors but one, divided among the cameras"""
    priority: Literal["low", "idle"] = "low"
    """of the perception process; idle: it runs when the service and what it starts need no processor"""
    rate_hz: Annotated[float | None, Field(gt=0, le=1000)] = None
    """maximum rate of processed frames, Hz; unset: no limit"""
    class_heights_m: tuple[Annotated[str, HEIGHT_TEXT], ...] = ("person:1.7", "car:1.5", "bicycle:1.1")
    """class:metres, known object heights; range estimate where neither depth nor the ground gives one"""
    tiles: bool = False
    """also detect in tiles of image_size, for small objects; 1080p takes some 14 times as long"""

    @model_validator(mode="after")
    def _idle_on_linux(self) -> Self:
        if self.priority == "idle" and not hasattr(os, "SCHED_IDLE"):
            raise ValueError("priority: idle is a policy of Linux: set low")
        return self

    @model_validator(mode="after")
    def _valid_heights(self) -> Self:
        if len(self.heights()) < len(self.class_heights_m):
            raise ValueError(f"class_heights_m: a class is given twice in {', '.join(self.class_heights_m)}")
        for name, height_m in self.heights().items():
            if not 0 < height_m <= 100:
                raise ValueError(
                    f"class_heights_m: {name} must be above 0 and at most 100 m, got {height_m:g}"
                )
        return self

    def loading(self, confidence: float) -> DetectorSettings:
        """Convert for `vision.detector.open_detector`, with this minimum confidence."""
        return DetectorSettings(
            model=self.model,
            classes=self.classes or None,
            confidence=confidence,
            iou=self.iou,
            image_size=self.image_size,
            precision=self.precision,
            device=self.device,
            threads=self.threads,
            runtime=self.runtime,
        )

    def heights(self) -> dict[str, float]:
        """Return class name, as of `fold_name`, → metres."""
        pairs = (text.rpartition(":") for text in self.class_heights_m)
        return {fold_name(name): float(height) for name, _, height in pairs}


class TrackerSection(Section):
    """Multi-object tracking, and the confirmation of tracks."""

    enabled: bool = True
    """enable tracking; false: frames are independent, and all detections are used"""
    confirm_score: Annotated[float, Field(ge=0, le=1)] = 0.4
    """minimum median confidence of a confirmed track; only confirmed tracks are targets"""
    min_hits: Annotated[int, Field(ge=1, le=1000)] = 3
    """minimum detections of a confirmed track"""
    coast_timeout_s: Annotated[float, Field(gt=0, le=60)] = 0.5
    """time without detections after which a track is lost, seconds"""
    max_age_s: Annotated[float, Field(gt=0, le=600)] = 2.0
    """time without detections after which a track ends; a later detection starts a new one; seconds"""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        self.following(0.0)
        return self

    def following(self, confidence: float) -> TrackerSettings:
        """Convert for `vision.tracking`, with the detector's `confidence`."""
        starting = max(starting_confidence(self.confirm_score), confidence)
        return TrackerSettings(
            high_confidence=starting,
            low_confidence=min(TrackerSettings().low_confidence, starting),
            keep_confidence=confidence,
            **self.model_dump(exclude={"enabled"}),
        )


def starting_confidence(confirm_score: float) -> float:
    """Return the least confidence that starts a track: `confirm_score`, at most the tracker's default."""
    return min(TrackerSettings().high_confidence, confirm_score)


class MarkersSection(Section):
    """Detection of printed markers (ArUco, AprilTag), to land on."""

    dictionary: Annotated[str | None, AfterValidator(lambda name: name and dictionary_named(name))] = None
    """OpenCV's dictionary (4X4_50, APRILTAG_36h11), or AprilTag's (tag36h11); unset: no marker detection"""
    size_m: Annotated[float, Field(ge=0.01, le=50)] = 0.5
    """side of a marker's black square, metres"""
    print: Print = "opencv"
    """whose print: AprilRobotics' images (apriltag) are turned by 180 degrees against OpenCV's"""
    others: tuple[Annotated[str, MARKER_TEXT], ...] = ()
    """other sizes: ID:SIZE; on the pad of marker PAD: ID:SIZE@PAD, off its centre ID:SIZE@PAD:RIGHT:UP"""
    boards_file: str | None = None
    """TOML file of boards, rigid sets of markers that are solved together; unset: none"""
    map_file: str | None = None
    """TOML file of a map: where markers are, in local NED or from an origin on the earth; unset: none"""
    localise: bool = False
    """send the autopilot the position that the map gives, for its estimator (VISION_POSITION_ESTIMATE)"""

    @model_validator(mode="after")
    def _can_be_found(self) -> Self:
        self.kind()
        if self.localise and (self.map_file is None or self.dictionary is None):
            raise ValueError("localise needs map_file and dictionary")
        count = None if self.dictionary is None else markers_in(self.dictionary)
        for marker in self.pad_markers():
            if marker.identifier == marker.pad or (count is not None and marker.pad >= count):
                raise ValueError(f"others: {marker.identifier} cannot lie on the pad of {marker.pad}")
        return self

    def kind(self) -> MarkerKind | None:
        """Return the markers to detect; None: disabled. Raises ValueError for invalid settings."""
        sizes = {identifier: size for identifier, size, _ in map(_other_marker, self.others)}
        if len(sizes) < len(self.others):
            raise ValueError(f"others: an id is given twice in {', '.join(self.others)}")
        prints: dict[int, str] = {}
        for board in self.boards():
            for identifier, size_m in board.sizes_m.items():
                printed = board.print or self.print
                if prints.setdefault(identifier, printed) != printed:
                    raise ValueError(
                        f"marker {identifier} is the print {prints[identifier]!r} in another board, and "
                        f"{printed!r} in board {board.name!r}"
                    )
                if sizes.setdefault(identifier, size_m) != size_m:
                    raise ValueError(
                        f"marker {identifier} is {sizes[identifier]:g} m in others or another board, and "
                        f"{size_m:g} m in board {board.name!r}"
                    )
        if self.dictionary is None:
            return None
        return MarkerKind(self.dictionary, self.size_m, sizes, self.print, prints)

    def boards(self) -> tuple[Board, ...]:
        """Read the boards, and the map, which is one. Raises BoardError, a ValueError."""
        boards = () if self.boards_file is None else read_boards(self.boards_file)
        return boards if self.map_file is None else (*boards, read_map(self.map_file))

    def pad_markers(self) -> tuple[PadMarker, ...]:
        """Return the markers on the pad of another one."""
        return tuple(pad for _, _, pad in map(_other_marker, self.others) if pad is not None)


def _other_marker(text: str) -> tuple[int, float, PadMarker | None]:
    own, _, on_pad = text.partition("@")
    identifier, size = own.split(":")
    if not on_pad:
        return int(identifier), float(size), None
    pad, *offset = on_pad.split(":")
    return int(identifier), float(size), PadMarker(int(identifier), int(pad), *map(float, offset))


class VideoSection(Section):
    """The annotated video of one camera."""

    video: str | None = None
    """file of the annotated video, .webm; unset: none"""
    rate_hz: Annotated[float, Field(ge=0.1, le=240)] = 15.0
    """frame rate, Hz; one of 640x480 costs some 20 ms of a core with the extra `cameras`, else up to 150"""
    level: bool = False
    """level the video's images by the attitude at capture, row by row with camera.rolling_shutter_ms"""

    @model_validator(mode="after")
    def _is_webm(self) -> Self:
        if self.video is not None and not self.video.lower().endswith(".webm"):
            raise ValueError(f"video must end in .webm, got {self.video!r}")
        if self.level and self.video is None:
            raise ValueError("level is of the video, which is not set: set video, or remove it")
        return self


class PreviewSection(Section):
    """Preview images and point clouds on the network, only while there is a subscriber."""

    rate_hz: Annotated[float, Field(gt=0, le=60)] = 15.0
    """maximum rate, Hz"""
    width: Annotated[int, Field(ge=16, le=4096)] = 1280
    """maximum width, pixels; larger frames are scaled down"""
    annotate: bool = False
    """draw the detections; the dashboard draws them itself"""
    cloud_rate_hz: Annotated[float, Field(gt=0, le=30)] = 2.0
    """maximum rate of point clouds, Hz"""
    cloud_range_m: Annotated[float, Field(gt=0, le=1000)] = 20.0
    """maximum depth in a point cloud, metres; one point per cube of 1/200 of it, at most 20,000 points"""


def cloud_voxel_m(cloud_range_m: float) -> float:
    """Return the side of the cubes of which a published point cloud has one point each, metres."""
    return cloud_range_m / 200.0
