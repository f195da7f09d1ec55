"""A scene around one vehicle: collisions and range measurements."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from mavlink_sim.camera.scene import Scene
from mavlink_sim.camera.scene_file import load_scene
from mavlink_sim.flight.collision_prevention import FRAME_BODY_FRD, ObstacleMap
from mavlink_sim.physics.collisions import CollidingMultirotor
from mavlink_sim.physics.contact import HALF_HEIGHT_M, RADIUS_M
from mavlink_sim.physics.neighbours import Neighbours
from mavlink_sim.physics.obstacle_sensor import (
    MAXIMUM_CM,
    MAXIMUM_M,
    MINIMUM_CM,
    SECTOR_DEG,
    ObstacleSensor,
)
from mavlink_sim.world.obstacles import Obstacles
from mavlink_sim.world.world import World


class CollisionWorld:
    """The obstacles of a scene, and one airframe among them.

    Args:
        scene: a scene, a world in which nothing moves, or what `load_scene` takes.
        seed: of the airframe and of the sensor's noise. gusts_mps: as `Multirotor`'s.
        noise: whether the sensor errs.
        start_ned_m: north and east of the scene's origin, where the vehicle starts.
        clock: the scene's time in seconds.

    Attributes:
        scene: the scene. airframe: the vehicle's airframe in it.

    Raises:
        SceneError: the scene cannot be used. ValueError: an obstacle is at the vehicle's start.
    """

    def __init__(
        self,
        scene: Scene | World | str | Path,
        *,
        seed: int,
        gusts_mps: float,
        noise: bool,
        start_ned_m: tuple[float, float],
        clock: Callable[[], float],
    ) -> None:
        if isinstance(scene, World):
            scene = Scene(scene)
        elif not isinstance(scene, Scene):
            scene = load_scene(scene)
        self.scene = scene
        self._clock = clock
        self._obstacles = Obstacles(scene.world.objects, scene.paths, RADIUS_M, HALF_HEIGHT_M)
        self._sensor = ObstacleSensor(self._obstacles, seed, noise)
        self.airframe = CollidingMultirotor(seed, gusts_mps, self._obstacles, start_ned_m, clock)

    def range_below_m(self) -> float:
        """From the airframe's legs along its own down axis to the first obstacle; inf: none."""
        _, _, x, _, _, y, _, _, z = self.airframe.matrix
        found = self._obstacles.range_along(self.airframe.centre_ned_m, (x, y, z), self._clock())
        return max(found - HALF_HEIGHT_M, 0.0)

    def sense_obstacles(
        self, into: ObstacleMap, yaw_rad: float, now_s: float, neighbours: Neighbours | None = None
    ) -> None:
        """Add a measurement of the obstacle sensor to the map of collision prevention.

        Args:
            into: the vehicle's map. yaw_rad: its estimated heading. now_s: seconds since its boot.
            neighbours: the other vehicles.
        """
        airframe = self.airframe
        beside = [] if neighbours is None else neighbours.outlines(MAXIMUM_M)
        ranges_cm = self._sensor.measure(airframe.centre_ned_m, airframe.yaw_rad, self._clock(), beside)
        into.add(ranges_cm, SECTOR_DEG, 0.0, MINIMUM_CM, MAXIMUM_CM, FRAME_BODY_FRD, yaw_rad, now_s)
