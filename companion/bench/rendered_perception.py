"""The rendered camera and the product's perception in lockstep: the simulated clock waits for both.

The images are those of the simulator's camera process, and the pipeline that reads them is the perception
worker's, built by the same functions from the same settings.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import cv2

from companion.perception.assembly import (
    CameraTelemetry,
    build_path_planning,
    build_pipeline,
    load_detector,
)
from companion.settings import Settings
from companion.settings.perception import DetectorSection, TrackerSection
from companion.settings.plugins import load_plugins
from companion.vehicle.state import Vector3
from mavlink_sim.camera.scene import Scene
from mavlink_sim.camera.simulated_camera import Captured, SimulatedCamera
from mavlink_sim.lockstep import LockstepVehicle
from mavlink_sim.realtime.sim_outputs import camera_turn_rad
from mavlink_sim.vehicles.fleet_world import position_in_world
from mavlink_sim.world.aircraft import Aircraft
from vision.attitude import Quaternion
from vision.frame import Frame
from vision.object_detector import ObjectDetector
from vision.pipeline import PerceptionResult
from vision.rotation import matrix_from_quaternion
from vision.sources.source import OneFrame
from vision.tracking import SelectRequest


class RenderedPerception:
    """Camera, detector, tracker, markers and depth of one vehicle, computed when asked.

    >>> from companion.settings.reading import load_settings
    >>> from mavlink_sim.camera.scene_file import scene_or_demo
    >>> vehicle = LockstepVehicle(seed=1)
    >>> vehicle.take_off(4.0)
    >>> settings = load_settings("/dev/null", {"detector.image_size": "320"}, environment={})
    >>> perception = RenderedPerception(settings, vehicle, scene_or_demo(None, seed=1))
    >>> now_ns = round(vehicle.now_s * 1e9)
    >>> perception.add_attitude(now_ns, vehicle.truth.quaternion, vehicle.truth.height_m)
    >>> result = perception.look(now_ns)
    >>> result.captured_ns == now_ns
    True

    The same seed and the same calls give the same results, `timing_ms` apart. The network and OpenCV compute
    with one thread each, the network in float32 unless `detector.precision` names another; it is loaded once
    a process for each `[detector]`.

    Args:
        settings: as `companion run` reads them. Of `camera`, `detector`, `tracker`, `markers` and
            `guidance.obstacles` everything counts; `source`, `recording` and `preview` are not used.
        vehicle: flown by the caller. The camera is at the vehicle's true pose, on its gimbal if any.
        scene: what the camera sees, and its own settings; None: the scene that the vehicle flies in.

    Attributes:
        scene: what the camera sees.
        planning: the map and the path planning; None without `guidance.avoid`.
        class_names: of the detector; empty without one.

    Raises:
        ValueError: there is no scene. CheckpointError: the model cannot be loaded.
    """

    def __init__(self, settings: Settings, vehicle: LockstepVehicle, scene: Scene | None = None) -> None:
        if scene is None:
            if vehicle.vehicle.collision_world is None:
                raise ValueError("the vehicle flies in no scene: give one, as scene_or_demo(None, seed)")
            scene = vehicle.vehicle.collision_world.scene
        cv2.setNumThreads(1)
        detector = None
        if settings.detector.enabled:
            load_plugins(settings.plugins.modules)
            keys = (settings.detector.model_dump_json(), settings.tracker.model_dump_json())
            detector = _detector(*keys)
        self.scene = scene
        self.class_names: tuple[str, ...] = () if detector is None else detector.class_names
        self._vehicle = vehicle
        self._camera = SimulatedCamera(scene)
        self._telemetry = CameraTelemetry()
        self._now_ns = 0
        self._source = OneFrame()
        self._pipeline = build_pipeline(
            settings, self._source, detector, self._telemetry, clock_ns=lambda: self._now_ns
        )
        self.planning = build_path_planning(settings, self._telemetry)

    def add_attitude(
        self,
        stamp_ns: int,
        wxyz: Quaternion,
        height_m: float | None,
        position: tuple[int, Vector3] | None = None,
        *,
        in_flight: bool = False,
    ) -> None:
        """Receive the vehicle's attitude, as the service sends it to the worker.

        Args:
            wxyz: `ned_from_body`. height_m: above home; None: not known.
            position: its own stamp, and local NED metres.
            in_flight: whether it flies.
        """
        self._telemetry.in_flight = in_flight
        self._telemetry.attitudes.add(stamp_ns, wxyz)
        self._telemetry.height_m = height_m
        if position is not None:
            self._telemetry.positions.add(*position)

    def add_gimbal(self, stamp_ns: int, wxyz: Quaternion) -> None:
        """Receive the gimbal's attitude (its frame to NED, as `StateHistory.gimbal_at` gives it)."""
        self._telemetry.gimbal.add(stamp_ns, wxyz)

    def select(self, request: SelectRequest) -> None:
        """Select an object with the next frame."""
        if self._pipeline.object_selection is None:
            raise ValueError("select needs tracks: set detector.enabled and tracker.enabled")
        self._pipeline.object_selection.request(request)

    def capture(
        self, now_ns: int, others: tuple[Aircraft, ...] = (), time_s: float | None = None
    ) -> Captured | None:
        """Render the camera at the vehicle's true pose; None: the scene's camera loses this frame.

        Args:
            now_ns: the frame's capture stamp.
            others: other aircraft in view.
            time_s: the scene's time, by which its objects move; None: the vehicle's.
        """
        vehicle = self._vehicle.vehicle
        turn_rad = camera_turn_rad(vehicle)
        mount = None
        if turn_rad is not None:
            roll, pitch, yaw = turn_rad
            mount = replace(self.scene.camera.mount, roll_rad=roll, pitch_rad=pitch, yaw_rad=yaw)
        attitude = matrix_from_quaternion(vehicle.quaternion)
        time_s = vehicle.faults.now_s if time_s is None else time_s
        return self._camera.capture(
            position_in_world(vehicle),
            attitude,
            now_ns,
            time_s,
            mount,
            others=others,
            freeze=vehicle.faults.camera_freeze,
        )

    def process(self, frame: Frame, now_ns: int) -> PerceptionResult | None:
        """Run the pipeline on a frame; None: `[detector]` leaves it out (`every`, `rate_hz`, `max_age_s`).

        Args:
            now_ns: when the result is there; becomes `inferred_ns`. Attitudes of the time since the capture
                may have been added meanwhile, as in flight.
        """
        self._source.frame, self._now_ns = frame, now_ns
        results: list[PerceptionResult] = []
        self._pipeline.step(0.0, results.append)
        return results[0] if results else None

    def look(self, now_ns: int) -> PerceptionResult | None:
        """`capture` and `process` at one moment."""
        captured = self.capture(now_ns)
        return None if captured is None else self.process(captured.frame, now_ns)


@lru_cache(maxsize=4)
def _detector(detector_json: str, tracker_json: str) -> ObjectDetector:
    """Loading takes as long as many frames, and a network keeps nothing from one frame to the next."""
    detector = DetectorSection.model_validate_json(detector_json)
    changes: dict[str, Any] = {"threads": 1}
    if detector.precision == "auto":
        # Which is faster is measured, and comes out otherwise on a busy computer.
        changes["precision"] = "float32"
    detector = detector.model_copy(update=changes)
    tracker = TrackerSection.model_validate_json(tracker_json)
    return load_detector(Settings(detector=detector, tracker=tracker))
