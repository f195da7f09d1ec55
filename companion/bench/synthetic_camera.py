"""A camera in lockstep with detections made of the truth; tracker and all behind it are the product's.

Many flights cannot each run a network; `rendered_camera` has the real detector.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from companion.bench.lockstep_flight import LockstepFlight
from companion.guidance.objects.from_detections import HistoryError, StateHistory, mount_at
from companion.perception.cameras import PerceptionCamera
from companion.settings import Settings
from companion.vehicle.state import Vector3, VehicleState
from mavlink_sim.camera.freeze import CameraFreeze
from mavlink_sim.lockstep import Truth
from vision.attitude import Quaternion
from vision.detections import Detections
from vision.markers import Marker
from vision.pipeline import PerceptionResult
from vision.tracking import AttitudeHistory, CameraView, Tracker, TrackerSettings, TrackEvent

# True position (NED), true attitude (FRD to NED) and seconds of the flight → detections.
Detect = Callable[[Vector3, Quaternion, float], Detections]


class SyntheticCamera:
    """See `lockstep_flight.Camera`.

    The fault `camera_freeze` repeats the detections of the last frame, as they are made of its image.

    Args:
        settings: the camera's model and mount, and all else that places what it sees.
        detect: None: it detects nothing.
        find_markers: at the true state and seconds of the flight; its None: the frame is lost.
        tracker: how identities are given; None: no tracking.
    """

    def __init__(
        self,
        settings: Settings,
        *,
        detect: Detect | None = None,
        find_markers: Callable[[Truth, float], tuple[Marker, ...] | None] | None = None,
        size: tuple[int, int] = (640, 480),
        rate_hz: float = 15.0,
        latency_s: float = 0.08,
        tracker: TrackerSettings | None = TrackerSettings(),  # noqa: B008 - frozen
    ) -> None:
        self.perceived = PerceptionCamera(settings)
        self.rate_hz, self.latency_s = rate_hz, latency_s
        self._detect, self._find_markers = detect, find_markers
        self._size = size
        self._tracker = None if tracker is None or detect is None else Tracker(tracker)
        self._attitudes = AttitudeHistory()
        self._sequence = -1
        self._shown: tuple[Detections, tuple[Marker, ...] | None] | None = None
        self._image_ns = self._depth_ns = 0

    def on_state(self, state: VehicleState, history: StateHistory) -> None:
        if state.attitude is not None:
            self._attitudes.add(state.attitude_ns, state.attitude)

    def capture(self, flight: LockstepFlight) -> Callable[[], PerceptionResult | None]:
        captured_ns, seconds, truth = flight.now_ns, flight.scene_seconds, flight.vehicle.truth
        freeze = flight.vehicle.vehicle.faults.camera_freeze
        self._sequence += 1
        sequence = self._sequence
        if CameraFreeze.IMAGE not in freeze or self._shown is None:
            detections = Detections.empty(())
            if self._detect is not None:
                detections = self._detect(truth.position_ned_m, truth.quaternion, seconds)
            markers = None if self._find_markers is None else self._find_markers(truth, seconds)
            if self._find_markers is not None and markers is None:
                return lambda: None
            self._shown, self._image_ns = (detections, markers), captured_ns
        if CameraFreeze.DEPTH not in freeze:
            self._depth_ns = captured_ns
        detections, markers = self._shown
        image_ns = captured_ns if CameraFreeze.CLOCK in freeze else self._image_ns
        depth_ns = self._depth_ns if np.isfinite(detections.depth_m).any() else None
        width, height = self._size

        def finish() -> PerceptionResult:
            tracked = detections
            events: tuple[TrackEvent, ...] = ()
            if self._tracker is not None:
                found = self._tracker.update(detections, captured_ns, self._view_at(flight, captured_ns))
                tracked, events = found.detections, found.events
            return PerceptionResult(
                sequence,
                captured_ns,
                flight.now_ns,
                width,
                height,
                tracked,
                {},
                0,
                track_events=events,
                markers=markers,
                image_since_ns=image_ns,
                depth_since_ns=depth_ns,
            )

        return finish

    def _view_at(self, flight: LockstepFlight, captured_ns: int) -> CameraView | None:
        """Where the camera looked when it took a frame; None without the attitude of that moment."""
        ned_from_body = self._attitudes.at(captured_ns)
        if ned_from_body is None:
            return None
        camera = self.perceived.settings.camera
        try:
            mount = mount_at(camera.mount(), flight.inputs.history, captured_ns)
        except HistoryError:
            return None
        return CameraView(camera.model(*self._size), mount.ned_from_optical(ned_from_body))
