"""Cameras: each with its model in a separate process, published under its own name.

The first camera uses the sections `source`, `camera` and `detector`; it has no name. One camera is the
steering one.
"""

from __future__ import annotations

import contextlib
import logging
import os
import statistics
from collections import deque
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from companion.guidance.objects.from_detections import (
    HistoryError,
    StateHistory,
    targets_from_detections,
)
from companion.guidance.objects.ranging import ALL_MEANS, RangeMeans, sees_ground
from companion.guidance.objects.table import ObjectTable
from companion.guidance.objects.target import Target
from companion.host.load import with_load
from companion.perception.messages import AnyPreview
from companion.perception.process import START_S
from companion.perception.supervisor import PerceptionStartError, PerceptionState, PerceptionSupervisor
from companion.settings import DetectorSection, Section, Settings
from companion.settings.calibration import adopt_calibration
from companion.settings.perception import NO_SOURCE
from companion.vehicle.state import VehicleState
from vision.camera_model import CameraCalibration, CameraModel, CameraMount
from vision.obstacle_sectors import ObstacleSectors
from vision.path_planner import PathRequest, PlannedPath
from vision.pipeline import PerceptionResult
from vision.tracking import Selected, SelectRequest

logger = logging.getLogger(__name__)

# A camera is unhealthy when its newest result is older than this plus its usual interval.
_SEEING_S = 1.0


def recorded_frames_names(settings: Settings) -> dict[str | None, str]:
    """Return camera → name of the shared memory in which its worker gives a recorder every processed frame.

    Empty if images are not recorded, or as JPEG.
    """
    recording = settings.recording
    if not (recording.directory and "png" in recording.content):
        return {}
    first = f"companion-{os.getpid()}-{settings.vehicle.name}-recorded"
    return {None: first} | {name: f"{first}-{name}" for name in settings.cameras}


class _Optics(NamedTuple):
    """Lens and mount of a camera, and the heights of its detector's classes, metres."""

    model: CameraModel
    mount: CameraMount
    heights_m: dict[str, float]


class PerceptionCamera:
    """One camera with its model, and its newest result.

    Attributes:
        name: None for the first.
        settings: with this camera's own sections; `camera` includes the camera's own calibration.
        in_flight: set by the owner. Then a result with an image seen before is no new one (`repeats`); on
            the ground a camera may well see nothing change.
        newest: the newest result; None before the first. repeats: it shows nothing new, or is outdated.
        seen_ns: capture of the newest result that showed something new; None before the first.
        obstacles: of the newest new depth image; None before the first.
        targets: that result's localized objects, after `localize`.
        localization_error: why they could not be localized; empty if they were.
        objects: what it shows and has shown, after `localize`.
        class_names: classes of the detector; None before it is loaded.
        planned: the newest planned path; None before the first.
        path_request: what path to plan, the newest request.
    """

    def __init__(
        self, settings: Settings, name: str | None = None, class_names: tuple[str, ...] | None = None
    ) -> None:
        self.name = name
        self.settings = settings
        self.in_flight = self.repeats = False
        self.newest: PerceptionResult | None = None
        self.seen_ns: int | None = None
        self.obstacles: ObstacleSectors | None = None
        self.targets: tuple[Target, ...] = ()
        self.localization_error = ""
        self.objects = ObjectTable()
        self.planned: PlannedPath | None = None
        self.path_request: PathRequest | None = None
        self._class_names = class_names
        self._has_depth = False
        self._optics: tuple[tuple[object, ...], _Optics] | None = None
        self._ranging: tuple[tuple[object, ...], RangeMeans] | None = None
        self._repeated = ""
        self._valid_from_ns = 0
        self._between_s: deque[float] = deque(maxlen=9)

    @property
    def class_names(self) -> tuple[str, ...] | None:
        return self._class_names

    def age_s(self, now_ns: int) -> float | None:
        """Age of the newest result that showed something new, since its capture; None before the first."""
        return None if self.seen_ns is None else (now_ns - self.seen_ns) / 1e9

    def frozen(self, now_ns: int) -> str:
        """Why the camera counts as frozen, in words; empty: it does not."""
        age_s = self.age_s(now_ns)
        if not self.repeats or age_s is None or age_s <= self.settings.guidance.perception_max_age_s:
            return ""
        return f"camera frozen: the same {self._repeated} for {age_s:.1f} s"

    def blind(self, now_ns: int) -> str:
        """Why it does not see as expected, in words; empty: it does."""
        return self.overdue(now_ns)

    def overdue(self, now_ns: int) -> str:
        """Why results do not arrive as expected, in words; empty: they do. Each is of a frame."""
        what = "result" if self.settings.detector.enabled else "frame"
        age_s = self.age_s(now_ns)
        if age_s is None:
            return f"no {what} yet"
        allowed_s = max(_SEEING_S, self.settings.guidance.perception_max_age_s)
        # Just before the next result the newest is as old as its own latency and one interval.
        usual_s = statistics.median(self._between_s) if self._between_s else 0.0
        if age_s <= allowed_s + 2 * usual_s:
            return ""
        return self.frozen(now_ns) or f"no {what} for {age_s:.1f} s"

    def ranging(self, pitch_rad: float) -> RangeMeans:
        """Return the available means of range estimation; all of them before the first result.

        Args:
            pitch_rad: of the camera above the horizon, with the vehicle level.
        """
        newest = self.newest
        if newest is None:
            return ALL_MEANS
        optics = self._optics_of(newest)
        of = (optics, pitch_rad, self._has_depth)
        if self._ranging is None or self._ranging[0] != of:
            ground, heights = sees_ground(optics.model, pitch_rad), frozenset(optics.heights_m)
            self._ranging = of, RangeMeans(self._has_depth, ground, heights)
        return self._ranging[1]

    def _optics_of(self, result: PerceptionResult) -> _Optics:
        """The camera for images of this size; computed again when the camera's calibration is adopted."""
        of = (result.width, result.height, self.settings)
        if self._optics is None or self._optics[0] != of:
            camera, heights_m = self.settings.camera, self.settings.detector.heights()
            self._optics = of, _Optics(camera.model(result.width, result.height), camera.mount(), heights_m)
        return self._optics[1]

    def discard_received(self, now_ns: int) -> None:
        """What was received is outdated, and so is a result of an image from before, when it arrives."""
        self._valid_from_ns = now_ns
        self.newest = self.planned = self.seen_ns = self.obstacles = None
        self.targets = ()
        self.objects.clear()

    def localize(self, result: PerceptionResult, history: StateHistory) -> None:
        """Set `targets` from a result, or `localization_error`."""
        try:
            detections, optics = result.detections.records(), self._optics_of(result)
            self.targets = targets_from_detections(
                detections, result.captured_ns, optics.model, optics.mount, history, optics.heights_m
            )
            self.localization_error = ""
            vehicle = history.at(result.captured_ns).position_ned_m
            self.objects.update(self.targets, vehicle, result.captured_ns)
        except HistoryError as error:
            # Without an attitude at the capture a box has no direction: it is published, but not a target.
            self.targets, self.localization_error = (), str(error)

    def on_path(self, planned: PlannedPath) -> None:
        """Set the newest path, unless its depth is from before a standstill."""
        if planned.captured_ns >= self._valid_from_ns:
            self.planned = planned

    async def select(self, request: SelectRequest) -> Selected:
        """Select an object in this camera's images."""
        return Selected(False, "this camera has no perception process")

    def request_path(self, request: PathRequest) -> None:
        """Set what path to plan."""
        self.path_request = request

    def update(self, result: PerceptionResult) -> None:
        """Set the newest result; `localize` sets its targets."""
        if self.newest is not None:
            self._between_s.append(max(result.captured_ns - self.newest.captured_ns, 0) / 1e9)
        self.newest = result
        # Frames may be left out between two results: what counts is a change since the last one.
        self._repeated = "image" if _seen(result.image_since_ns, self.seen_ns) else "depth image"
        outdated = result.captured_ns < self._valid_from_ns
        self.repeats = outdated or (self.in_flight and _seen(result.since_ns, self.seen_ns))
        if not self.repeats:
            self.seen_ns = result.captured_ns
        if (obstacles := result.obstacles) is not None and not outdated:
            known_ns = None if self.obstacles is None else self.obstacles.captured_ns
            if not (self.in_flight and _seen(result.depth_since_ns, known_ns)):
                self.obstacles = obstacles
        if result.obstacles is not None or bool(np.isfinite(result.detections.depth_m).any()):
            self._has_depth = True


def _seen(since_ns: int | None, seen_ns: int | None) -> bool:
    """Whether an image is that of an earlier result."""
    return since_ns is not None and seen_ns is not None and since_ns <= seen_ns


class WorkerCamera(PerceptionCamera):
    """A camera whose results are produced by a perception worker, a separate process run by `supervisor`."""

    def __init__(
        self,
        settings: Settings,
        name: str | None,
        *,
        on_result: Callable[[WorkerCamera, PerceptionResult], None],
        on_preview: Callable[[WorkerCamera, AnyPreview], None],
        on_event: Callable[[str, str], None],
        on_calibration: Callable[[], None],
        record_as: str | None = None,
    ) -> None:
        super().__init__(settings, name)
        self._given = settings.camera
        self._calibration: CameraCalibration | None = None
        self._on_calibration = on_calibration
        self._on_result = on_result
        self._on_event = on_event
        self._gimbal_ns = 0
        self.supervisor = PerceptionSupervisor(
            settings,
            on_result=self._on_report,
            on_event=self._event,
            on_preview=lambda preview: on_preview(self, preview),
            on_calibration=self._adopt,
            on_path=self.on_path,
            record_as=record_as,
        )

    @property
    def class_names(self) -> tuple[str, ...] | None:
        return self.supervisor.class_names or None

    def blind(self, now_ns: int) -> str:
        if self.settings.source.uri == NO_SOURCE or self.supervisor.state is PerceptionState.FINISHED:
            return ""
        if not (why := self.overdue(now_ns)):
            return ""
        return with_load(f"{why}; {self.supervisor.problem}" if self.supervisor.problem else why)

    async def start(self) -> None:
        """Start the worker, as `PerceptionSupervisor.start`; the error has the camera's name."""
        if self.settings.source.uri == NO_SOURCE:
            return
        rotate_deg, roll_deg = self.settings.source.rotate_deg, self._given.mount_roll_deg
        if rotate_deg == 180 and abs(roll_deg) > 90.0:
            self._event(
                "warning",
                f"source.rotate_deg is 180 and camera.mount_roll_deg {roll_deg:g}: the mount is that of the "
                f"rotated image; a camera fixed upside down has mount_roll_deg 0",
            )
        self._check_lens()
        try:
            await self.supervisor.start()
        except PerceptionStartError as error:
            if self.name is None:
                raise
            raise PerceptionStartError(f"camera {self.name}: {error}") from error

    async def select(self, request: SelectRequest) -> Selected:
        return await self.supervisor.select(request)

    def send_state(self, state: VehicleState, history: StateHistory) -> None:
        """Send the attitudes of vehicle and gimbal to the worker, for its tracker."""
        if state.attitude is not None:
            position = None if state.position_ned_m is None else (state.position_ns, state.position_ned_m)
            self.supervisor.send_attitude(
                state.attitude_ns, state.attitude, state.height_m, position, in_flight=self.in_flight
            )
        gimbal = state.gimbal
        if gimbal is None or not self.settings.camera.on_gimbal or gimbal.attitude is None:
            return
        if gimbal.attitude_ns != self._gimbal_ns:
            self._gimbal_ns = gimbal.attitude_ns
            with contextlib.suppress(HistoryError):
                self.supervisor.send_gimbal(gimbal.attitude_ns, history.gimbal_at(gimbal.attitude_ns))

    def request_path(self, request: PathRequest) -> None:
        super().request_path(request)
        self.supervisor.request_path(request)

    def _on_report(self, result: PerceptionResult) -> None:
        self.update(result)
        try:
            self._on_result(self, result)
        except Exception as error:
            # An error in the service must not end perception.
            logger.exception("a result could not be processed")
            self.targets, self.localization_error = (), f"{type(error).__name__}: {error}"

    def _adopt(self, calibration: CameraCalibration | None) -> None:
        """Adopt the camera's calibration; the worker does the same with its own copy of the settings."""
        if calibration == self._calibration:
            return
        self._calibration = calibration
        camera = self._given
        if calibration is not None:
            adopted = adopt_calibration(self._given, calibration)
            camera = adopted.camera
            if not adopted.conflict:
                self._event("info", "using lens and mount of the camera's calibration")
            else:
                key = "camera" if self.name is None else f"cameras.{self.name}.camera"
                self._event(
                    "warning", f"{key}: settings override the camera's calibration: {adopted.conflict}"
                )
        self.settings = self.settings.model_copy(update={"camera": camera})
        self._check_lens()
        self._on_calibration()

    def _check_lens(self) -> None:
        if problem := self.settings.camera.lens_problem():
            self._event("warning", f"camera: {problem}")

    def _event(self, level: str, text: str) -> None:
        self._on_event(level, text if self.name is None else f"camera {self.name}: {text}")


def open_cameras(
    settings: Settings,
    *,
    on_result: Callable[[WorkerCamera, PerceptionResult], None],
    on_preview: Callable[[WorkerCamera, AnyPreview], None],
    on_event: Callable[[str, str], None],
    on_calibration: Callable[[], None],
) -> tuple[WorkerCamera, ...]:
    """Create all cameras, the first one first, not started yet.

    `on_calibration` is called after a camera's `settings.camera` was changed to its camera's calibration.
    """
    own_settings = {name: settings.of_camera(name) for name in (None, *settings.cameras)}
    threads = threads_each([own.detector for own in own_settings.values()])
    shared = {f"shm://{source.share}" for source in settings.sources().values() if source.share}
    record_as = recorded_frames_names(settings)
    cameras = []
    for name, own in own_settings.items():
        changes: dict[str, Section] = {}
        if own.detector.threads is None:
            changes["detector"] = own.detector.model_copy(update={"threads": threads})
        if own.source.uri in shared:
            # The process that shares it loads its model first.
            timeout_s = own.source.open_timeout_s + START_S
            changes["source"] = own.source.model_copy(update={"open_timeout_s": timeout_s})
        if name != settings.guidance.camera:
            changes["guidance"] = own.guidance.model_copy(update={"avoid": False})
        own = own.model_copy(update=changes)
        cameras.append(
            WorkerCamera(
                own,
                name,
                on_result=on_result,
                on_preview=on_preview,
                on_event=on_event,
                on_calibration=on_calibration,
                record_as=record_as.get(name),
            )
        )
    return tuple(cameras)


def threads_each(detectors: Sequence[DetectorSection]) -> int:
    """Return the threads of each network without a configured number; at least 1.

    All processors but one, less the configured threads, are divided: the service must not wait for them.
    """
    enabled = [detector for detector in detectors if detector.enabled]
    automatic = [detector for detector in enabled if detector.threads is None]
    configured = sum(detector.threads or 0 for detector in enabled)
    return max(1, (len(os.sched_getaffinity(0)) - 1 - configured) // max(1, len(automatic)))
