"""The rendered camera in lockstep, with the real detector, tracker, markers and ranging behind it.

The pictures are those of the simulator's camera process, and what looks at them is the perception worker's
pipeline, made by the same functions of the same settings. Simulated time stands still meanwhile.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import cv2
import numpy as np

from companion.bench.lockstep_flight import LockstepFlight
from companion.bench.synthetic_detector import SceneObject
from companion.perception.assembly import CameraTelemetry, build_pipeline, load_detector
from companion.perception.views import View
from companion.settings import Settings
from companion.vehicle.state import Vector3, VehicleState
from mavlink_sim.camera.depth_camera import DepthSensor
from mavlink_sim.camera.scene import CameraSettings, Scene
from mavlink_sim.camera.simulated_camera import SimulatedCamera
from mavlink_sim.spectators import camera_turn_rad
from mavlink_sim.world.world import Ground, Light, Sky, World, WorldObject
from vision.camera_model import CameraModel, CameraMount
from vision.frame import Frame
from vision.pipeline import PerceptionResult
from vision.rotation import matrix_from_quaternion
from vision.sources import EndOfStream, Source, SourceStatistics

# Where what is hidden is taken to.
AWAY_M = 2000.0

if TYPE_CHECKING:
    from vision.detector import Detector


class RenderedCamera:
    """See `lockstep_flight.Camera`.

    Args:
        settings: as `companion run` has them; `source` is not looked at.
        scene: what is seen, with its camera.
        latency_s: from capture until a result can steer; more than a small computer takes for it.
        by_flight: what moves does so by the seconds of the flight, not by those since the vehicle's boot.
        depth: frames have depth.
    """

    def __init__(
        self,
        settings: Settings,
        scene: Scene,
        *,
        rate_hz: float = 10.0,
        latency_s: float = 0.1,
        by_flight: bool = False,
        depth: bool = True,
    ) -> None:
        cv2.setNumThreads(1)
        detector = _detector(settings.model_dump_json()) if settings.detector.enabled else None
        self.view = View(settings, None, None if detector is None else detector.class_names)
        self.rate_hz, self.latency_s = rate_hz, latency_s
        self.scene, self._by_flight, self._depth = scene, by_flight, depth
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
        time_s = flight.seconds if self._by_flight else vehicle.now_s
        taken = self._camera.capture(truth.position_ned_m, attitude, flight.now_ns, time_s, mount=mount)

        def finish() -> PerceptionResult | None:
            if taken is None:
                return None
            results: list[PerceptionResult] = []
            frame = taken.frame if self._depth else replace(taken.frame, depth_m=None)
            self._frames.frame, self._now_ns = frame, flight.now_ns
            self._pipeline.step(0.0, results.append)
            return results[0] if results else None

        return finish


def rendered_scene(
    objects: Sequence[SceneObject], camera: CameraModel, mount: CameraMount, seed: int, *, depth: bool = False
) -> tuple[Scene, tuple[SceneObject, ...]]:
    """The objects on a field, and the same with the sizes of those that are drawn, in their order.

    Args:
        objects: of classes that can be drawn; one that is hidden is taken away meanwhile.
        depth: the camera is a stereo camera with depth; False: its frames have none.
    """
    rng = np.random.default_rng((seed, 73))
    drawn, sized = [], []
    for number, item in enumerate(objects):
        thing = WorldObject(number, item.class_name, (0.0, 0.0, 0.0), appearance=int(rng.integers(2**31)))
        rear, front, left, right = thing.footprint_m
        drawn.append(thing)
        sized.append(replace(item, size_m=(front - rear, right - left, item.size_m[2])))
    ground = Ground(("meadow", "grass"), seed, 1024, 0.08)
    world = World(tuple(drawn), ground, Light(float(rng.uniform(-math.pi, math.pi))), Sky(seed=seed))
    motions = {number: _ObjectMotion(item) for number, item in enumerate(objects)}
    sensor = DepthSensor() if depth else None
    settings = CameraSettings(model=camera, mount=mount, depth=sensor, seed=seed)
    return Scene(world, motions, settings, "campaign"), tuple(sized)


@dataclass(frozen=True, slots=True)
class _ObjectMotion:
    item: SceneObject
    speed_mps: float = 0.0  # nothing runs into it
    period_s: float = 0.0

    def pose_at(self, time_s: float) -> tuple[Vector3, float]:
        pose = self.item.pose(time_s)
        away_m = AWAY_M if self.item.hidden(time_s) else 0.0
        return (pose.north_m + away_m, pose.east_m, 0.0), pose.yaw_rad


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
