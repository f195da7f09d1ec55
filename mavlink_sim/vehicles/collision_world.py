"""A scene around one vehicle: it collides with obstacles, can stand on them, and measures ranges to them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from mavlink_sim.camera.scene import Scene
from mavlink_sim.camera.scene_file import load_scene
from mavlink_sim.flight.collision_prevention import FRAME_BODY_FRD, ObstacleMap
from mavlink_sim.physics.airframe import MAX_STANDING_TILT_COSINE, Multirotor
from mavlink_sim.physics.contact import (
    BOUNCE_MPS,
    CRASH_MPS,
    HALF_HEIGHT_M,
    RADIUS_M,
    STANDING_COSINE,
    Collision,
    after_contact,
)
from mavlink_sim.physics.obstacle_sensor import MAXIMUM_CM, MINIMUM_CM, SECTOR_DEG, ObstacleSensor
from mavlink_sim.physics.rotations import Vector
from mavlink_sim.world.obstacles import Gap, Obstacle, Obstacles
from mavlink_sim.world.world import World

SUPPORT_M = 0.01
TOUCH_M = 1e-9

_STILL: Vector = (0.0, 0.0, 0.0)


class CollidingMultirotor(Multirotor):
    """A `Multirotor` that collides with obstacles.

    Args:
        seed, gusts_mps: as `Multirotor`'s.
        obstacles: made for RADIUS_M and HALF_HEIGHT_M.
        start_ned_m: north and east of the world's origin, where the airframe's own frame begins.
        clock: the scene's time in seconds.

    Raises:
        ValueError: an obstacle is at its start position.
    """

    __slots__ = ("_checked_at", "_clearance_m", "_clock", "_obstacles", "_start", "_support")

    def __init__(
        self,
        seed: int,
        gusts_mps: float,
        obstacles: Obstacles,
        start_ned_m: tuple[float, float],
        clock: Callable[[], float],
    ) -> None:
        super().__init__(seed, gusts_mps=gusts_mps)
        self._obstacles = obstacles
        self._start = start_ned_m
        self._clock = clock
        self._support: Obstacle | None = None
        gap = obstacles.nearest(self.centre_ned_m, 0.0)
        if gap.obstacle is not None and gap.clear_m < 0.0:
            north, east = start_ned_m
            raise ValueError(
                f"the vehicle starts at north {north:g} m, east {east:g} m, where the scene's "
                f"{gap.obstacle.name} stands: move one of them"
            )
        # no obstacle is near until it has moved this far from here, less the travel of moving obstacles
        self._checked_at = self.position
        self._clearance_m = gap.clear_m

    @property
    def centre_ned_m(self) -> Vector:
        """The centre of its body in the world frame; its position is the end of its legs."""
        x, y, z = self.position
        return (x + self._start[0], y + self._start[1], z - HALF_HEIGHT_M)

    # ---- time -------------------------------------------------------------------------------------------

    def advance(self, dt_s: float, steps: int = 1) -> None:
        """See Multirotor. Obstacles are searched after each step."""
        for _ in range(steps):
            super().advance(dt_s)
            x, y, z = self.position
            fx, fy, fz = self._checked_at
            x, y, z = x - fx, y - fy, z - fz
            margin = self._clearance_m = self._clearance_m - self._obstacles.top_speed_mps * dt_s
            if margin < 0.0 or x * x + y * y + z * z > margin * margin:
                self._sense_obstacles(dt_s)

    def _sense_obstacles(self, dt_s: float) -> None:
        """Handle contacts, and measure the distance to the next obstacle."""
        now_s = self._clock()
        self._keep_standing(now_s)
        known = self._resting_on
        met = False
        # in a corner it touches one after the other
        while (gap := self._obstacles.nearest(self.centre_ned_m, now_s, known)).clear_m < -TOUCH_M:
            assert gap.obstacle is not None
            self._meet(gap, gap.obstacle, now_s, dt_s)
            known = [*known, gap.obstacle]
            met = True
        self._checked_at = self.position
        self._clearance_m = 0.0 if met else max(gap.clear_m, 0.0)

    # ---- contact ----------------------------------------------------------------------------------------

    def _meet(self, gap: Gap, obstacle: Obstacle, now_s: float, dt_s: float) -> None:
        """Resolve the overlap: bounce off, slide along it or stand on it."""
        px, py, pz = gap.push_ned_m
        x, y, z = self.position
        self.position = (x + px, y + py, min(z + pz, 0.0))
        ux, uy, uz = obstacle.velocity_at(now_s)
        vx, vy, vz = self.velocity
        into, (rx, ry, rz), rates = after_contact(
            (vx - ux, vy - uy, vz - uz), self.rates, self.matrix, gap.normal_ned
        )
        if into < 0.0:
            return
        after = self.velocity = (ux + rx, uy + ry, uz + rz)
        self.rates = rates
        bounces = into > BOUNCE_MPS
        if not bounces:  # in resting contact: the acceleration into it is cancelled
            ax, ay, az = self.acceleration
            self.acceleration = (
                ax + (after[0] - vx) / dt_s,
                ay + (after[1] - vy) / dt_s,
                az + (after[2] - vz) / dt_s,
            )
        standing = -gap.normal_ned[2] > STANDING_COSINE
        was_crashed = self.crashed
        if into > CRASH_MPS or (standing and self.matrix[8] < MAX_STANDING_TILT_COSINE):
            self.crashed = True
        if standing and not bounces:
            self.on_ground = True
            self._support = obstacle
            self.floor_down_m = self.position[2]
        crashed = self.crashed and not was_crashed
        self.count(Collision(now_s, obstacle.identifier, obstacle.name, into, standing, crashed))

    # ---- standing on an obstacle ------------------------------------------------------------------------

    @property
    def _resting_on(self) -> list[Obstacle]:
        """The obstacle it stands on, if neither moves: then no check is needed."""
        support = self._support
        if support is None or support.moves or not self.on_ground or self.velocity != _STILL:
            return []
        return [support]

    def _touch(self, down_mps: float, tilt_cosine: float) -> float:
        self._support = None
        return super()._touch(down_mps, tilt_cosine)

    def _keep_standing(self, now_s: float) -> None:
        """Let it fall when its support is no longer below it."""
        if self._support is None:
            return
        if self.on_ground:
            self._support.place(now_s)
            x, y, z = self.centre_ned_m
            gap = self._obstacles.gap_to(self._support, (x, y, z + SUPPORT_M))
            if gap.clear_m <= 0.0 and -gap.normal_ned[2] > STANDING_COSINE:
                return
            self.on_ground = False
        self._support = None

    def _stand(self, dt_s: float, lift: float) -> None:
        if self._support is None:
            super()._stand(dt_s, lift)
            return
        ux, uy, uz = self._support.velocity_at(self._clock())
        vx, vy, _ = self.velocity
        self.velocity = (vx - ux, vy - uy, 0.0)
        super()._stand(dt_s, lift)
        vx, vy, _ = self.velocity
        x, y, _ = self.position
        self.floor_down_m += uz * dt_s
        self.position = (x + ux * dt_s, y + uy * dt_s, self.floor_down_m)
        self.velocity = (vx + ux, vy + uy, uz)


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

    def sense_obstacles(self, into: ObstacleMap, yaw_rad: float, now_s: float) -> None:
        """Add a measurement of the obstacle sensor to the map of collision prevention.

        Args:
            into: the vehicle's map. yaw_rad: its estimated heading. now_s: seconds since its boot.
        """
        airframe = self.airframe
        ranges_cm = self._sensor.measure(airframe.centre_ned_m, airframe.yaw_rad, self._clock())
        into.add(ranges_cm, SECTOR_DEG, 0.0, MINIMUM_CM, MAXIMUM_CM, FRAME_BODY_FRD, yaw_rad, now_s)
