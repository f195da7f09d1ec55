"""Builds the perception pipeline from the settings, for the worker and for flights in lockstep."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.perception.messages import Detecting
from companion.perception.path_planning import PathPlanning, PositionHistory
from companion.settings import Settings
from vision.camera_model import CameraMount
from vision.depth import surfaces
from vision.frame import Frame
from vision.gc_pause import gc_paused
from vision.levelling import Levelling, level_image, level_rotations, poses_of_readout
from vision.marker_boards import BoardPose, locate_board
from vision.markers import Marker, MarkerDetector
from vision.object_detector import ObjectDetector, resolve_classes
from vision.obstacle_sectors import ObstacleSectors, obstacle_sectors
from vision.pipeline import FrameDetector, FrameRecorder, Pipeline, SurfacesIn
from vision.sources import Source
from vision.tracking import AttitudeHistory, CameraView, Tracker
from vision.tracking.camera_motion import Array

# A frame of the video may wait for its encoder: two seconds of frames, ten times as long on a busy computer.
ATTITUDES_S = 20.0


class CameraTelemetry:
    """The vehicle telemetry that the pipeline of one camera uses.

    Attributes:
        attitudes: of the vehicle, the last `ATTITUDES_S`. height_m: the newest above home; None: unknown.
        gimbal: attitudes of the camera's gimbal; empty for a fixed camera.
        positions: of the vehicle, the last few seconds.
        in_flight: whether the vehicle flies.
    """

    def __init__(self) -> None:
        self.attitudes, self.gimbal = AttitudeHistory(ATTITUDES_S), AttitudeHistory(ATTITUDES_S)
        self.positions = PositionHistory()
        self.height_m: float | None = None
        self.in_flight = False


def build_pipeline(
    settings: Settings,
    source: Source,
    detector: FrameDetector | None,
    telemetry: CameraTelemetry,
    *,
    recorder: FrameRecorder | None = None,
    first_track_id: int = 1,
    clock_ns: Callable[[], int] = time.monotonic_ns,
    tracker_stamp_ns: Callable[[Frame], int] = lambda frame: frame.captured_ns,
) -> Pipeline:
    """Build the pipeline of the settings.

    Args:
        source: open. detector: from `load_detector`; None if detection is disabled.
        clock_ns: the clock of the frames' stamps. tracker_stamp_ns: as of `Pipeline`.
    """
    return Pipeline(
        source,
        tiled(settings, detector),
        max_rate_hz=settings.detector.rate_hz,
        recorder=recorder,
        tracker=_tracker(settings, first_track_id),
        view_at=_view_at(settings, telemetry),
        find_markers=marker_finder(settings),
        obstacles_in=_obstacles_in(settings, telemetry),
        surfaces_in=_surfaces_in(settings, telemetry),
        clock_ns=clock_ns,
        tracker_stamp_ns=tracker_stamp_ns,
    )


def build_levelling(settings: Settings, telemetry: CameraTelemetry) -> Levelling:
    """Build the function that levels a frame's image; it returns None without an attitude at its capture."""
    pose_at, readout_s = _pose_at(settings, telemetry), settings.camera.rolling_shutter_ms / 1e3

    def level(frame: Frame, image: NDArray[np.uint8]) -> NDArray[np.uint8] | None:
        poses = poses_of_readout(pose_at, frame.captured_ns, readout_s)
        if poses is None:
            return None
        model = settings.camera.model(frame.width, frame.height)
        return level_image(image, model, level_rotations(poses), settings.source.rotate_deg)

    return level


def build_path_planning(settings: Settings, telemetry: CameraTelemetry) -> PathPlanning | None:
    """Build the path planning of a camera; None without `guidance.avoid`."""
    if not settings.guidance.avoid:
        return None
    pose_at, model = _pose_at(settings, telemetry), settings.camera.model
    return PathPlanning(
        telemetry.positions, pose_at, model, lambda: telemetry.height_m, lambda: telemetry.in_flight
    )


def tiled(settings: Settings, detector: FrameDetector | None) -> FrameDetector | None:
    """Wrap the detector for tiling if the settings enable it."""
    section = settings.detector
    if detector is None or not section.tiles:
        return detector
    from vision.tiling import TiledDetector

    return TiledDetector(detector, tile_size=section.image_size)


def load_detector(settings: Settings) -> ObjectDetector:
    """Load the detector of `detector.kind`; the plug-ins must be loaded before.

    Raises:
        ValueError: as `vision.detector.open_detector`.
    """
    with gc_paused():  # only here: the import takes half a second
        from vision.detector import open_detector

    section = settings.detector
    if section.threads is not None:
        # Else OpenCV's resizing uses every core, independent of the network's threads.
        cv2.setNumThreads(section.threads)
    return open_detector(section.kind, section.loading(_min_confidence(settings)))


def _min_confidence(settings: Settings) -> float:
    """Return the detector's threshold; the tracker also needs detections below `detector.confidence`."""
    confidence, tracker = settings.detector.confidence, settings.tracker
    return min(confidence, tracker.following(confidence).low_confidence) if tracker.enabled else confidence


def change_detecting(
    settings: Settings, change: Detecting, detector: ObjectDetector, tracker: Tracker | None
) -> None:
    """Set confidence and classes for the next frame. Tracks of other classes end as those of lost objects."""
    section = settings.detector.model_copy(
        update={"confidence": change.confidence, "classes": change.classes}
    )
    detector.confidence = _min_confidence(settings.model_copy(update={"detector": section}))
    wanted = section.classes
    detector.class_ids = resolve_classes(wanted, detector.class_names) if wanted else detector.reportable_ids
    if tracker is not None:
        tracker.settings = settings.tracker.following(section.confidence)


def _tracker(settings: Settings, first_track_id: int) -> Tracker | None:
    if not settings.tracker.enabled or not settings.detector.enabled:
        return None
    tracker_settings = settings.tracker.following(settings.detector.confidence)
    return Tracker(tracker_settings, first_track_id=first_track_id)


def _pose_at(
    settings: Settings, telemetry: CameraTelemetry
) -> Callable[[int], tuple[CameraMount, Array] | None]:
    """Return a function from a capture stamp (CLOCK_MONOTONIC ns) to mount and (3, 3) `ned_from_body`.

    It returns None without an attitude at that time: of the vehicle and, for a camera on a gimbal, of the
    gimbal.
    """
    mount = settings.camera.mount()

    def pose_at(captured_ns: int) -> tuple[CameraMount, Array] | None:
        ned_from_body = telemetry.attitudes.at(captured_ns)
        if ned_from_body is None or not mount.on_gimbal:
            return None if ned_from_body is None else (mount, ned_from_body)
        ned_from_gimbal = telemetry.gimbal.at(captured_ns)
        return None if ned_from_gimbal is None else (mount.held(ned_from_gimbal), ned_from_body)

    return pose_at


def _view_at(settings: Settings, telemetry: CameraTelemetry) -> Callable[[Frame], CameraView | None]:
    """Return a function from a frame to the camera's view; None without an attitude at that time."""
    pose_at, model = _pose_at(settings, telemetry), cache(settings.camera.model)

    def view_at(frame: Frame) -> CameraView | None:
        pose = pose_at(frame.captured_ns)
        if pose is None:
            return None
        mount, ned_from_body = pose
        return CameraView(model(frame.width, frame.height), mount.ned_from_optical(ned_from_body))

    return view_at


def marker_finder(
    settings: Settings,
) -> Callable[[Frame], tuple[tuple[Marker, ...], tuple[BoardPose, ...]]] | None:
    """Return a function from a frame to its markers and boards; None if markers are disabled."""
    kind = settings.markers.kind()
    if kind is None:
        return None
    detector, boards = MarkerDetector(kind), settings.markers.boards()

    def find_markers(frame: Frame) -> tuple[tuple[Marker, ...], tuple[BoardPose, ...]]:
        camera = settings.camera.model(frame.width, frame.height)
        markers = detector.detect(frame.image, camera)
        located = (locate_board(board, markers, camera) for board in boards)
        return markers, tuple(board for board in located if board is not None)

    return find_markers


def _obstacles_in(
    settings: Settings, telemetry: CameraTelemetry
) -> Callable[[Frame], ObstacleSectors | None]:
    """Return a function from a depth frame to obstacle distances; None without an attitude at that time."""
    pose_at = _pose_at(settings, telemetry)

    def obstacles_in(frame: Frame) -> ObstacleSectors | None:
        if settings.guidance.obstacles == "off" or frame.depth_m is None:
            return None
        pose = pose_at(frame.captured_ns)
        if pose is None:
            return None
        camera = settings.camera.model(frame.width, frame.height)
        return obstacle_sectors(frame.depth_m, frame.captured_ns, camera, *pose, telemetry.height_m)

    return obstacles_in


def _surfaces_in(settings: Settings, telemetry: CameraTelemetry) -> SurfacesIn:
    """Return a function from a frame's boxes to the nearest points and the middles of the objects in them.

    Without an attitude at the capture the vehicle is assumed level. The attitude selects the point of the
    surface that is nearest over ground, it does not change the point's position in the optical frame.
    """
    pose_at = _pose_at(settings, telemetry)
    mount = settings.camera.mount()

    def surfaces_in(
        frame: Frame, xyxy: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        assert frame.depth_m is not None
        pose = pose_at(frame.captured_ns)
        attitude: Array = np.eye(3)
        used = mount.held(attitude) if mount.on_gimbal else mount
        lens_height_m = None
        if pose is not None:
            used, attitude = pose
            if telemetry.height_m is not None:
                lens_height_m = telemetry.height_m - float(attitude[2] @ used.position_frd_m)
        camera = settings.camera.model(frame.width, frame.height)
        down = used.ned_from_optical(attitude)[2]
        return surfaces(frame.depth_m, xyxy, camera, down, lens_height_m)

    return surfaces_in
