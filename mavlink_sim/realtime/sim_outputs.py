"""The outputs of a simulation: the camera in its own process, and the truth file.

The simulation never waits for rendering.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

from mavlink_sim.realtime.options import SimulationOptions
from mavlink_sim.vehicles.fleet_world import FleetWorld, position_in_world
from mavlink_sim.world.aircraft import identifier_offset
from mavlink_sim.world.truth_file import TruthFile, object_truth
from vision.attitude import euler_from_quaternion

if TYPE_CHECKING:
    from mavlink_sim.camera.process import CameraProcess
    from mavlink_sim.camera.scene import Scene
    from mavlink_sim.physics.contact import Collision
    from mavlink_sim.physics.rotations import Vector
    from mavlink_sim.vehicles.vehicle import Vehicle

TRUTH_RATE_HZ = 20.0
CAMERA_CHECK_S = 0.5


def camera_turn_rad(vehicle: Vehicle) -> Vector | None:
    """Roll, pitch, yaw from the body to a camera on the gimbal; None for one fixed to the body."""
    gimbal = vehicle.gimbal
    return None if gimbal is None else euler_from_quaternion(gimbal.body_quaternion)


def loaded_scene(options: SimulationOptions) -> Scene | None:
    """The scene of camera and truth file; None if neither is used and no scene was requested.

    Raises SceneError for a scene that cannot be used.
    """
    if not options.shows_world and options.truth is None and options.scene is None:
        return None
    # imported here: a vehicle without camera needs neither the renderer nor its start-up time
    from mavlink_sim.camera.scene_file import scene_or_demo

    return scene_or_demo(options.scene, options.seed if options.world_seed is None else options.world_seed)


class SimOutputs:
    """The camera and the truth file of one vehicle, as set by its options; possibly neither.

    Args:
        vehicle: the vehicle. scene: its surroundings (`loaded_scene`).
        fleet_world: the other vehicles in view.
        resources: closes what is opened here.

    Raises:
        ValueError: an invalid name, scene or address. OSError: a file cannot be written.
    """

    def __init__(
        self,
        vehicle: Vehicle,
        scene: Scene | None,
        fleet_world: FleetWorld,
        options: SimulationOptions,
        on_event: Callable[[str], None],
        resources: ExitStack,
    ) -> None:
        self._vehicle, self._fleet_world, self._options = vehicle, fleet_world, options
        self._on_event = on_event
        self._next_truth_s = 0.0
        self._next_frame_s = 0.0
        self._next_camera_check_s = 0.0
        self._camera: CameraProcess | None = None
        self._camera_seen = False
        self._camera_rate_hz = 30.0
        self._scene = scene
        self._identifier_offset = 0 if scene is None else identifier_offset(scene.world)
        self._truth: TruthFile | None = None
        if options.truth is not None:
            self._truth = TruthFile(options.truth)
            resources.callback(self._truth.close)
        if scene is not None and options.shows_world:
            self._open_camera(scene, resources)

    def _open_camera(self, scene: Scene, resources: ExitStack) -> None:
        from mavlink_sim.camera.process import CameraProcess
        from vision.shared_frame import segment_path

        options = self._options
        if options.camera is not None:
            segment_path(options.camera)  # raises for an invalid name
        self._camera_rate_hz = options.camera_rate_hz or scene.camera.rate_hz
        self._camera = CameraProcess(
            scene,
            rate_hz=self._camera_rate_hz,
            shared_name=options.camera,
            outputs=options.camera_outputs,
            truth=options.camera_truth,
            most_others=self._fleet_world.size - 1,
            on_gimbal=self._vehicle.gimbal is not None,
        )
        resources.callback(self._camera.stop)
        self._camera.start()

    def show(self, simulated_s: float, stamp_ns: int) -> None:
        """Send the pose to the camera and write the truth, each at its rate.

        Args:
            simulated_s: simulated time of the vehicle and of all in its fleet world.
            stamp_ns: the monotonic time at which that was due.
        """
        camera = self._camera
        if camera is not None and simulated_s >= self._next_frame_s:
            period_s = self._options.speed / self._camera_rate_hz  # the rate is in real time
            self._next_frame_s = max(self._next_frame_s + period_s, simulated_s)
            vehicle = self._vehicle
            camera.send_pose(
                position_in_world(vehicle),
                vehicle.quaternion,
                stamp_ns,
                simulated_s,
                camera_turn_rad(vehicle),
                self._fleet_world.others(vehicle),
                vehicle.faults.camera_freeze,
            )
            if simulated_s >= self._next_camera_check_s:
                self._next_camera_check_s = simulated_s + CAMERA_CHECK_S
                self._check_camera(camera)
        if self._truth is not None and simulated_s >= self._next_truth_s:
            self._next_truth_s += 1.0 / TRUTH_RATE_HZ
            why = self._truth.write(json.dumps(self.truth(simulated_s, stamp_ns)))
            if why is not None:
                self._truth = None
                self._on_event(why)

    def _check_camera(self, camera: CameraProcess) -> None:
        """Report the start and the loss of the camera; the simulation continues without it."""
        if not camera.alive:
            self._camera = None
            self._on_event(f"camera {camera.name} is lost: its process ended")
        elif not self._camera_seen and camera.ready:
            self._camera_seen = True
            self._on_event(f"camera {camera.name} is on")

    def truth(self, simulated_s: float, stamp_ns: int) -> dict[str, Any]:
        """The current truth: pose, mode, collisions, the range to every object and vehicle."""
        airframe, autopilot = self._vehicle.airframe, self._vehicle.autopilot
        return {
            "stamp_ns": stamp_ns,
            "position_ned_m": [round(value, 4) for value in airframe.position],
            "velocity_ned_mps": [round(value, 4) for value in airframe.velocity],
            "yaw_rad": round(airframe.yaw_rad, 5),
            "mode": autopilot.mode.name,
            "armed": autopilot.armed,
            "landed": autopilot.landed,
            "crashed": airframe.crashed,
            "collisions": airframe.collisions,
            "last_collision": _collision_truth(airframe.last_collision),
            "objects": [] if self._scene is None else self._objects(self._scene, simulated_s, stamp_ns),
        }

    def _objects(self, scene: Scene, simulated_s: float, stamp_ns: int) -> list[dict[str, Any]]:
        here = position_in_world(self._vehicle)
        others = self._fleet_world.objects(self._vehicle, self._identifier_offset, stamp_ns)
        return [
            object_truth(scene_object, here) for scene_object in (*scene.objects_at(simulated_s), *others)
        ]


def _collision_truth(collision: Collision | None) -> dict[str, Any] | None:
    if collision is None:
        return None
    return {
        "time_s": round(collision.time_s, 3),
        "identifier": collision.identifier,
        "object": collision.name,
        "speed_mps": round(collision.speed_mps, 3),
        "standing": collision.standing,
        "crashed": collision.crashed,
    }
