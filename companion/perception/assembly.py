"""From settings to the pipeline that looks at frames. The worker and flights in lockstep use it."""

from __future__ import annotations

import time
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.settings import Settings
from vision.camera_model import CameraMount
from vision.depth import nearest_points
from vision.frame import Frame
from vision.markers import Marker, MarkerDetector
from vision.object_detector import ObjectDetector, open_detector
from vision.obstacle_sectors import ObstacleSectors, obstacle_sectors
from vision.pipeline import FrameDetector, FrameRecorder, Pipeline
from vision.sources import Source
from vision.tracking import AttitudeHistory, CameraView, Tracker
from vision.tracking.camera_motion import Array


class CameraTelemetry:
    """What the vehicle has told that a camera's pictures are seen by.

    Attributes:
        attitudes: of the vehicle, the last few seconds. height_m: the newest above home; None: not known.
        gimbal: the attitudes of the camera's gimbal; empty for a camera that sits on none.
    """

    def __init__(self) -> None:
        self.attitudes, self.gimbal = AttitudeHistory(), AttitudeHistory()
        self.height_m: float | None = None


def build_pipeline(
    settings: Settings,
    source: Source,
    detector: ObjectDetector | None,
    telemetry: CameraTelemetry,
    *,
    recorder: FrameRecorder | None = None,
    first_track_id: int = 1,
    clock_ns: Callable[[], int] = time.monotonic_ns,
) -> Pipeline:
    """The pipeline as the settings want it.

    Args:
        source: open. detector: as `load_detector` gives it; None where the settings want none.
        clock_ns: the clock of the frames' stamps.
    """
    return Pipeline(
        source,
        tiled(settings, detector),
        selection=settings.detector.selection(),
        recorder=recorder,
        tracker=_tracker(settings, first_track_id),
        view_at=_view_at(settings, telemetry),
        find_markers=_find_markers(settings),
        obstacles_in=_obstacles_in(settings, telemetry),
        nearest_in=_nearest_in(settings, telemetry),
        clock_ns=clock_ns,
    )


def tiled(settings: Settings, detector: ObjectDetector | None) -> FrameDetector | None:
    """The detector as the pipeline uses it."""
    wanted = settings.detector
    if detector is None or not wanted.tiles:
        return detector
    from vision.tiling import TiledDetector

    return TiledDetector(detector, tile_size=wanted.tile_size, overlap=wanted.tile_overlap)


def load_detector(settings: Settings) -> ObjectDetector:
    """The detector of `detector.kind`, ready; the plug-ins must be loaded.

    Raises:
        ValueError: as `vision.object_detector.open_detector`.
    """
    wanted = settings.detector
    if wanted.threads is not None:
        # Else its resizing takes every core, whatever the network was given.
        cv2.setNumThreads(wanted.threads)
    return open_detector(wanted.kind, wanted.loading(_least_confidence(settings)))


def _least_confidence(settings: Settings) -> float:
    """A tracker wants to see the weak ones too; it leaves out again what `detector.confidence` leaves out."""
    wanted, tracker = settings.detector.confidence, settings.tracker
    return min(wanted, tracker.low_confidence) if tracker.enabled else wanted


def _tracker(settings: Settings, first_track_id: int) -> Tracker | None:
    if not settings.tracker.enabled or not settings.detector.enabled:
        return None
    following = settings.tracker.following(settings.detector.confidence)
    return Tracker(following, first_track_id=first_track_id)


def _held_at(
    settings: Settings, telemetry: CameraTelemetry
) -> Callable[[int], tuple[CameraMount, Array] | None]:
    """How the camera was mounted, and (3, 3) `ned_from_body`, at a capture stamp (CLOCK_MONOTONIC ns).

    None without the attitude of that moment: the vehicle's or, for a camera on a gimbal, the gimbal's.
    """
    mount = settings.camera.mount()

    def held_at(captured_ns: int) -> tuple[CameraMount, Array] | None:
        ned_from_body = telemetry.attitudes.at(captured_ns)
        if ned_from_body is None or not mount.on_gimbal:
            return None if ned_from_body is None else (mount, ned_from_body)
        ned_from_gimbal = telemetry.gimbal.at(captured_ns)
        return None if ned_from_gimbal is None else (mount.held(ned_from_gimbal), ned_from_body)

    return held_at


def _view_at(settings: Settings, telemetry: CameraTelemetry) -> Callable[[Frame], CameraView | None]:
    """Where the camera looked when it took a frame; None without the attitude of that moment."""
    if not settings.tracker.camera_motion:
        return lambda _: None
    held_at = _held_at(settings, telemetry)

    def view_at(frame: Frame) -> CameraView | None:
        held = held_at(frame.captured_ns)
        if held is None:
            return None
        mount, ned_from_body = held
        return CameraView(
            settings.camera.model(frame.width, frame.height), mount.ned_from_optical(ned_from_body)
        )

    return view_at


def _find_markers(settings: Settings) -> Callable[[Frame], tuple[Marker, ...]] | None:
    """What looks for markers in a frame; None where the settings do not ask for it."""
    kind = settings.markers.kind()
    if kind is None:
        return None
    detector = MarkerDetector(kind)
    return lambda frame: detector.detect(frame.image, settings.camera.model(frame.width, frame.height))


def _obstacles_in(
    settings: Settings, telemetry: CameraTelemetry
) -> Callable[[Frame], ObstacleSectors | None]:
    """How far obstacles are in a frame with depth; None without the attitude of that moment."""
    held_at = _held_at(settings, telemetry)

    def obstacles_in(frame: Frame) -> ObstacleSectors | None:
        if settings.guidance.obstacles == "off" or frame.depth_m is None:
            return None
        held = held_at(frame.captured_ns)
        if held is None:
            return None
        camera = settings.camera.model(frame.width, frame.height)
        return obstacle_sectors(frame.depth_m, frame.captured_ns, camera, *held, telemetry.height_m)

    return obstacles_in


def _nearest_in(
    settings: Settings, telemetry: CameraTelemetry
) -> Callable[[Frame, NDArray[np.float32]], NDArray[np.float32]]:
    """The nearest points of the objects in a frame's boxes.

    Without the attitude of the capture the vehicle is taken as level. The attitude decides which point of the
    surface counts as the nearest over ground, not where that point lies in the optical frame.
    """
    held_at = _held_at(settings, telemetry)
    mount = settings.camera.mount()

    def nearest_in(frame: Frame, xyxy: NDArray[np.float32]) -> NDArray[np.float32]:
        assert frame.depth_m is not None
        held = held_at(frame.captured_ns)
        attitude: Array = np.eye(3)
        used = mount.held(attitude) if mount.on_gimbal else mount
        lens_height_m = None
        if held is not None:
            used, attitude = held
            if telemetry.height_m is not None:
                lens_height_m = telemetry.height_m - float(attitude[2] @ used.position_frd_m)
        camera = settings.camera.model(frame.width, frame.height)
        down = used.ned_from_optical(attitude)[2]
        return nearest_points(frame.depth_m, xyxy, camera, down, lens_height_m)

    return nearest_in
