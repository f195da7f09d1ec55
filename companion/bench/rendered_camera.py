"""The rendered camera with the real detector, tracker, markers and ranging, in flights in lockstep."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from dataclasses import replace

from companion.bench.lockstep_flight import LockstepFlight
from companion.bench.rendered_perception import RenderedPerception
from companion.guidance.objects.from_detections import HistoryError, StateHistory
from companion.perception.cameras import PerceptionCamera
from companion.settings import Settings
from companion.vehicle.state import VehicleState
from mavlink_sim.camera.renderer import Rendered
from mavlink_sim.camera.scene import Scene
from mavlink_sim.lockstep import LockstepVehicle
from vision.pipeline import PerceptionResult
from vision.tracking import SelectRequest


class RenderedCamera:
    """See `lockstep_flight.Camera`.

    Args:
        settings: as `companion run` has them; `source` is not looked at.
        scene: what is seen, with its camera.
        latency_s: from capture until a result can steer; more than a small computer takes for it.
        by_flight: what moves does so by the seconds of the flight, not by those since the vehicle's boot.
        depth: frames have depth.

    Attributes:
        shown: the truth of the newest frame; None before the first.
        perception: of the camera. planning: as of `RenderedPerception`.
    """

    def __init__(
        self,
        settings: Settings,
        scene: Scene,
        vehicle: LockstepVehicle,
        *,
        rate_hz: float = 10.0,
        latency_s: float = 0.1,
        by_flight: bool = False,
        depth: bool = True,
    ) -> None:
        self.perception = RenderedPerception(settings, vehicle, scene)
        self.planning = self.perception.planning
        self.perceived = PerceptionCamera(settings, None, self.perception.class_names or None)
        self.rate_hz, self.latency_s = rate_hz, latency_s
        self._by_flight, self._depth = by_flight, depth
        self.shown: Rendered | None = None

    def on_state(self, state: VehicleState, history: StateHistory) -> None:
        """As `WorkerCamera.send_state` sends it to the worker."""
        if state.attitude is not None:
            position = None if state.position_ned_m is None else (state.position_ns, state.position_ned_m)
            self.perception.add_attitude(
                state.attitude_ns,
                state.attitude,
                state.height_m,
                position,
                in_flight=self.perceived.in_flight,
            )
        gimbal = state.gimbal
        if gimbal is not None and gimbal.attitude is not None and self.perceived.settings.camera.on_gimbal:
            with contextlib.suppress(HistoryError):
                self.perception.add_gimbal(gimbal.attitude_ns, history.gimbal_at(gimbal.attitude_ns))

    def select(self, request: SelectRequest) -> None:
        """Select an object with the next frame."""
        self.perception.select(request)

    def capture(self, flight: LockstepFlight) -> Callable[[], PerceptionResult | None]:
        time_s = flight.scene_seconds if self._by_flight else None
        taken = self.perception.capture(flight.now_ns, time_s=time_s)
        self.shown = self.shown if taken is None else taken.rendered

        def finish() -> PerceptionResult | None:
            if taken is None:
                return None
            frame = taken.frame if self._depth else replace(taken.frame, depth_m=None)
            result = self.perception.process(frame, flight.now_ns)
            if (planning := self.planning) is not None:
                if (request := self.perceived.path_request) is not None:
                    planning.request(request, flight.now_ns)
                self.perceived.planned = planning.update(frame, flight.now_ns) or self.perceived.planned
            return result

        return finish
