"""A world's objects as obstacles: distance to the nearest one, ray and scan ranges.

Moving objects are at their position of the given time. Everything is NED metres in the world frame.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mavlink_sim.world.mesh import mesh_of
from mavlink_sim.world.sectors import SECTORS, nearest_in_sectors
from mavlink_sim.world.shapes import variant_of
from mavlink_sim.world.world import Vector, WorldObject

FLAT_M = 0.05
"""Objects lower than this are flat on the ground and no obstacles."""
_NEAR_M = 0.05
_VELOCITY_STEP_S = 0.01
_STILL: Vector = (0.0, 0.0, 0.0)


class ObstacleMotion(Protocol):
    """The motion of an object; `camera.scene.Path` is one."""

    @property
    def speed_mps(self) -> float:
        """Speed along the path."""

    def pose_at(self, time_s: float) -> tuple[Vector, float]:
        """(position NED in metres, yaw in radians) at a time."""


@dataclass(frozen=True, slots=True)
class Gap:
    """The gap between a body and the nearest obstacle.

    Attributes:
        obstacle: the nearest one; None: there is none.
        clear_m: the body can move at least this far in any direction without contact; 0 or less: contact.
        normal_ned: unit vector out of the obstacle, at the contact.
        push_ned_m: the displacement out of it. Both are zero without contact.
    """

    obstacle: Obstacle | None
    clear_m: float = math.inf
    normal_ned: Vector = _STILL
    push_ned_m: Vector = _STILL


class Obstacle:
    """One obstacle.

    Attributes:
        identifier: of the object. name: its class and identifier, "wall-2".
        moves: it follows a path.

    Raises ValueError for one that leans, which a scene file cannot make.
    """

    def __init__(self, scene_object: WorldObject, motion: ObstacleMotion | None, flatness: float) -> None:
        self.identifier = scene_object.identifier
        self.name = f"{scene_object.class_name}-{scene_object.identifier}"
        if scene_object.leans:
            raise ValueError(f"{self.name} leans: only level objects can be obstacles")
        self.moves = motion is not None
        self._motion = motion
        self._scale = scene_object.scale
        size = scene_object.size_m if scene_object.printed is None else scene_object.printed.board_size_m
        variant = variant_of(scene_object.class_name, scene_object.appearance)
        self._mesh = mesh_of(scene_object.class_name, variant, size)
        self._stretched = mesh_of(scene_object.class_name, variant, size, flatness)
        shape = scene_object.shape
        self._low: list[float] = (shape.low * scene_object.scale).tolist()
        self._high: list[float] = (shape.high * scene_object.scale).tolist()
        reaches = (
            np.hypot(x, y) for x in (self._low[0], self._high[0]) for y in (self._low[1], self._high[1])
        )
        self._reach_m = float(max(reaches))
        self._time_s = math.nan
        self._put(scene_object.position_ned_m, scene_object.yaw_rad)

    def _put(self, position_ned_m: Vector, yaw_rad: float) -> None:
        self._position = position_ned_m
        self._cosine, self._sine = math.cos(yaw_rad), math.sin(yaw_rad)

    def place(self, time_s: float) -> None:
        """Move it to its pose at a time."""
        if self._motion is not None and time_s != self._time_s:
            self._time_s = time_s
            self._put(*self._motion.pose_at(time_s))

    def velocity_at(self, time_s: float) -> Vector:
        """NED m/s, without its rotation."""
        if self._motion is None:
            return _STILL
        (ax, ay, az), (bx, by, bz) = (
            self._motion.pose_at(time_s + side)[0] for side in (-_VELOCITY_STEP_S, 0.0)
        )
        return ((bx - ax) / _VELOCITY_STEP_S, (by - ay) / _VELOCITY_STEP_S, (bz - az) / _VELOCITY_STEP_S)

    def _own(self, point: Vector) -> Vector:
        """A point in its frame, metres."""
        north, east = point[0] - self._position[0], point[1] - self._position[1]
        return (
            self._cosine * north + self._sine * east,
            self._cosine * east - self._sine * north,
            point[2] - self._position[2],
        )

    def _ned(self, x: float, y: float) -> tuple[float, float]:
        return self._cosine * x - self._sine * y, self._sine * x + self._cosine * y

    def far_m(self, point: Vector) -> float:
        """A lower bound of the distance from a point, metres, for any yaw."""
        level = math.hypot(point[0] - self._position[0], point[1] - self._position[1]) - self._reach_m
        z = point[2] - self._position[2]
        upright = max(self._low[2] - z, z - self._high[2], 0.0)
        return upright if level <= 0.0 else math.hypot(level, upright)

    def box_m(self, point: Vector) -> float:
        """Metres from a point to the box around it, 0 inside."""
        x, y, z = self._own(point)
        low, high = self._low, self._high
        beside = max(low[0] - x, x - high[0], 0.0)
        across = max(low[1] - y, y - high[1], 0.0)
        upright = max(low[2] - z, z - high[2], 0.0)
        return math.sqrt(beside * beside + across * across + upright * upright)

    def gap(self, centre: Vector, radius_m: float, flatness: float) -> Gap:
        """The gap to an ellipsoid around a point, `flatness` times wider than high.

        With heights stretched by that factor, the ellipsoid is a sphere.
        """
        x, y, z = self._own(centre)
        scale = self._scale
        point = np.array([x / scale, y / scale, z / scale * flatness])
        nearest, distance = self._stretched.nearest(point)
        margin = distance * scale - radius_m
        if margin > 0.0:
            return Gap(self, margin / flatness)
        inside = self.box_m(centre) == 0.0 and self._stretched.contains(point)
        if inside:
            out, depth = nearest - point, distance * scale + radius_m
        else:
            out, depth = point - nearest, -margin
        dx, dy, dz = (out / distance).tolist() if distance > 1e-9 else (0.0, 0.0, -1.0)
        north, east = self._ned(dx, dy)
        length = math.sqrt(dx * dx + dy * dy + dz * dz * flatness * flatness)
        normal = (north / length, east / length, dz * flatness / length)
        return Gap(self, -depth / flatness, normal, (north * depth, east * depth, dz * depth / flatness))

    def along(self, origin: Vector, direction: Vector) -> float:
        """Metres from a point along a unit vector to it, inf without a hit."""
        start = self._own(origin)
        north, east = direction[0], direction[1]
        direction = (
            self._cosine * north + self._sine * east,
            self._cosine * east - self._sine * north,
            direction[2],
        )
        enters, leaves = 0.0, math.inf
        for begin, step, low, high in zip(start, direction, self._low, self._high, strict=True):
            if abs(step) < 1e-12:
                if not low <= begin <= high:
                    return math.inf
                continue
            one, other = (low - begin) / step, (high - begin) / step
            enters, leaves = max(enters, min(one, other)), min(leaves, max(one, other))
        if enters > leaves:
            return math.inf
        return self._mesh.along(np.array(start) / self._scale, np.array(direction)) * self._scale

    def outline(self, origin: Vector) -> NDArray[np.float64]:
        """(S, 2, 2) segments of its section at a point's height, (north, east) metres from the point."""
        z = (origin[2] - self._position[2]) / self._scale
        own = self._mesh.cut(z) * self._scale
        turn = np.array([[self._cosine, self._sine], [-self._sine, self._cosine]])
        away = np.array([self._position[0] - origin[0], self._position[1] - origin[1]])
        cut: NDArray[np.float64] = own @ turn + away
        return cut


class Obstacles:
    """All obstacles of a world.

    Args:
        objects: the world's objects at time 0. Those flat on the ground are left out.
        motions: those of moving objects, by identifier.
        radius_m, half_height_m: of the ellipsoid of a body in `nearest`.

    Attributes:
        top_speed_mps: of the fastest obstacle.
    """

    def __init__(
        self,
        objects: Iterable[WorldObject],
        motions: Mapping[int, ObstacleMotion],
        radius_m: float,
        half_height_m: float,
    ) -> None:
        self.radius_m = radius_m
        self._flatness = radius_m / half_height_m
        self._all = [
            Obstacle(scene_object, motions.get(scene_object.identifier), self._flatness)
            for scene_object in objects
            if scene_object.height_m - scene_object.position_ned_m[2] > FLAT_M
        ]
        self._moving = [one for one in self._all if one.moves]
        speeds = (motions[one.identifier].speed_mps for one in self._moving)
        self.top_speed_mps = max(speeds, default=0.0)

    def _placed(self, time_s: float) -> list[Obstacle]:
        for one in self._moving:
            one.place(time_s)
        return self._all

    def nearest(self, centre: Vector, time_s: float, besides: Collection[Obstacle] = ()) -> Gap:
        """The smallest gap of the body around a point, except to the obstacles in `besides`."""
        found = Gap(None)
        for one in self._placed(time_s):
            if one in besides:
                continue
            clear = one.far_m(centre) - self.radius_m
            if clear >= found.clear_m:
                continue
            if clear <= _NEAR_M and not one.moves:
                clear = one.box_m(centre) - self.radius_m
            if clear > _NEAR_M:
                if clear < found.clear_m:
                    found = Gap(one, clear)
                continue
            gap = self.gap_to(one, centre)
            if gap.clear_m < found.clear_m:
                found = gap
        return found

    def gap_to(self, one: Obstacle, centre: Vector) -> Gap:
        """The gap between one obstacle, at its current pose, and the body around a point."""
        box_m = one.box_m(centre) - self.radius_m
        if box_m > _NEAR_M:
            return Gap(one, _NEAR_M)  # not more: at the next corner of its path it may turn
        return one.gap(centre, self.radius_m, self._flatness)

    def range_along(self, origin: Vector, direction: Vector, time_s: float) -> float:
        """Metres from a point along a unit vector to the first obstacle; inf: none."""
        return min((one.along(origin, direction) for one in self._placed(time_s)), default=math.inf)

    def ranges_around(self, origin: Vector, yaw_rad: float, range_m: float, time_s: float) -> list[float]:
        """Metres to the nearest obstacle at a point's height, in each of `sectors.SECTORS`; inf: out of
        range.

        The first sector is centred on `yaw_rad`, the others follow clockwise.
        """
        cuts = [one.outline(origin) for one in self._placed(time_s) if one.far_m(origin) <= range_m]
        segments = np.concatenate(cuts) if cuts else np.zeros((0, 2, 2))
        if not len(segments):
            return [math.inf] * SECTORS
        cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
        found = nearest_in_sectors(segments @ np.array([[cosine, -sine], [sine, cosine]]))
        return [distance if distance <= range_m else math.inf for distance in found.tolist()]
