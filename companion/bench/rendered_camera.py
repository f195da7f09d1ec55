"""The rendered camera in lockstep, with the real detector, tracker, markers and ranging behind it.

The pictures are those of the simulator's camera process, and what looks at them is the perception worker's
pipeline, made by the same functions of the same settings. Simulated time stands still meanwhile.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import cv2

from companion.bench.lockstep_flight import LockstepFlight
from companion.perception.assembly import CameraTelemetry, build_pipeline, load_detector
from companion.perception.views import View
from companion.settings import Settings
from companion.vehicle.state import VehicleState
from mavlink_sim.camera.scene import Scene
from mavlink_sim.camera.simulated_camera import SimulatedCamera
from mavlink_sim.spectators import camera_turn_rad
from vision.frame import Frame
from vision.pipeline import PerceptionResult
from vision.rotation import matrix_from_quaternion
from vision.sources import EndOfStream, Source, SourceStatistics

if TYPE_CHECKING:
    from vision.detector import Detector


class RenderedCamera:
    """See `lockstep_flight.Camera`.

    Args:
        settings: as `companion run` has them; `source` is not looked at.
        scene: what is seen, with its camera.
        latency_s: from capture until a result can steer; more than a small computer takes for it.
    """

    def __init__(
        self, settings: Settings, scene: Scene, *, rate_hz: float = 10.0, latency_s: float = 0.1
    ) -> None:
        cv2.setNumThreads(1)
        detector = _detector(settings.model_dump_json()) if settings.detector.enabled else None
        self.view = View(settings, None, None if detector is None else detector.class_names)
        self.rate_hz, self.latency_s = rate_hz, latency_s
        self.scene = scene
        self._camera = SimulatedCamera(scene)
        self._frames = _OneFrame()
        self._telemetry = CameraTelemetry()
        self._now_ns = 0
        self._pipeline = build_pipeline(
            settings, self._frames, detector, self._telemetry, clock_ns=lambda: self._now_ns
        )

    def on_state(self, state: VehicleState) -> None:
        """As `WorkerView.send_state` tells the worker."""
        if state.attitude is not None:
            self._telemetry.attitudes.add(state.attitude_ns, state.attitude)
            self._telemetry.height_m = state.altitude_m

    def capture(self, flight: LockstepFlight) -> Callable[[], PerceptionResult | None]:
        truth, vehicle = flight.vehicle.truth, flight.vehicle.vehicle
        attitude = matrix_from_quaternion(truth.quaternion)
        turn_rad = camera_turn_rad(vehicle)
        mount = None
        if turn_rad is not None:
            roll, pitch, yaw = turn_rad
            mount = replace(self.scene.camera.mount, roll_rad=roll, pitch_rad=pitch, yaw_rad=yaw)
            gimbal = flight.state.gimbal
            if gimbal is not None and gimbal.attitude is not None:
                self._telemetry.gimbal.add(
                    gimbal.attitude_ns, flight.inputs.history.gimbal_at(gimbal.attitude_ns)
                )
        taken = self._camera.capture(
            truth.position_ned_m, attitude, flight.now_ns, vehicle.now_s, mount=mount
        )

        def finish() -> PerceptionResult | None:
            if taken is None:
                return None
            results: list[PerceptionResult] = []
            self._frames.frame, self._now_ns = taken.frame, flight.now_ns
            self._pipeline.step(0.0, results.append)
            return results[0] if results else None

        return finish


class _OneFrame(Source):
    """Gives the frame that was put in."""

    uri, live = "rendered", True

    def __init__(self) -> None:
        self.frame: Frame | None = None

    def read(self, timeout_s: float = 1.0) -> Frame | None:
        if self.frame is None:
            raise EndOfStream("no frame was put in")
        frame, self.frame = self.frame, None
        return frame

    @property
    def statistics(self) -> SourceStatistics:
        return SourceStatistics()

    def close(self) -> None:
        self.frame = None


@lru_cache(maxsize=2)
def _detector(settings: str) -> Detector:
    """One for each settings and process: to load it takes as long as many frames."""
    return load_detector(Settings.model_validate_json(settings))
