"""A scene: a world, the paths of its moving objects, and the camera.

Small plain data, as `world`: it is pickled to the camera's process.
"""

from __future__ import annotations

import bisect
import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import accumulate, pairwise
from typing import Literal, Protocol

from mavlink_sim.camera.depth_camera import DepthSensor
from mavlink_sim.camera.image_effects import MILD_EFFECTS, ImageEffects
from mavlink_sim.camera.lens import Shutter
from mavlink_sim.camera.renderer import DEFAULT_CAMERA, DEFAULT_MOUNT
from mavlink_sim.world.obstacles import ObstacleMotion
from mavlink_sim.world.world import Vector, World, WorldObject
from vision.camera_model import CameraModel, CameraMount

Repeat = Literal["loop", "back_and_forth", "once"]


class Motion(ObstacleMotion, Protocol):
    """The motion of an object; `Path` is one."""

    @property
    def period_s(self) -> float:
        """The time after which it has covered its whole path."""


@dataclass(frozen=True)
class Path:
    """A path through waypoints at a constant speed.

    Attributes:
        waypoints_ned_m: two or more positions.
        speed_mps: along the straight legs between them.
        repeat: "loop" continues from the last waypoint to the first; "back_and_forth" reverses; "once" stays
        at
            the last one.
        start_s: the offset along the path at time 0, in seconds.
        fixed_yaw_rad: the heading; None: along the path, and the last heading on a vertical leg.

    Raises:
        ValueError: fewer than two waypoints, all identical, or a speed that is not positive.
    """

    waypoints_ned_m: tuple[Vector, ...]
    speed_mps: float
    repeat: Repeat = "loop"
    start_s: float = 0.0
    fixed_yaw_rad: float | None = None

    def __post_init__(self) -> None:
        if not self.speed_mps > 0.0:
            raise ValueError(f"a path's speed must be positive, got {self.speed_mps} m/s")
        if len(self.waypoints_ned_m) < 2:
            raise ValueError(f"a path needs two waypoints or more, got {len(self.waypoints_ned_m)}")
        if not self._marks[-1] > 0.0:
            raise ValueError("a path's waypoints are all identical; use place_m without a path")

    @cached_property
    def _waypoints(self) -> tuple[Vector, ...]:
        closed = self.waypoints_ned_m[:1] if self.repeat == "loop" else ()
        return self.waypoints_ned_m + closed

    @cached_property
    def _marks(self) -> list[float]:
        """Distance along the path of each waypoint, metres."""
        return list(accumulate((math.dist(a, b) for a, b in pairwise(self._waypoints)), initial=0.0))

    @property
    def period_s(self) -> float:
        """Time for one loop, or there and back, or the whole path once."""
        return self._marks[-1] / self.speed_mps * (2.0 if self.repeat == "back_and_forth" else 1.0)

    def pose_at(self, time_s: float) -> tuple[Vector, float]:
        """(position NED in metres, yaw in radians) at a time."""
        length = self._marks[-1]
        along = (time_s + self.start_s) * self.speed_mps
        forth = True
        if self.repeat == "loop":
            along %= length
        elif self.repeat == "back_and_forth":
            along %= 2.0 * length
            if along > length:
                along, forth = 2.0 * length - along, False
        else:
            along = min(max(along, 0.0), length)
        leg = min(max(bisect.bisect_right(self._marks, along) - 1, 0), len(self._waypoints) - 2)
        start, end = self._waypoints[leg], self._waypoints[leg + 1]
        span = self._marks[leg + 1] - self._marks[leg]
        share = (along - self._marks[leg]) / span if span > 0.0 else 0.0
        position = tuple(a + (b - a) * share for a, b in zip(start, end, strict=True))
        return (position[0], position[1], position[2]), self._heading(leg, forth)

    def _heading(self, leg: int, forth: bool) -> float:
        if self.fixed_yaw_rad is not None:
            return self.fixed_yaw_rad
        count = len(self._waypoints) - 1
        # Vertical legs keep the heading of the one before.
        for back in range(count):
            index = (leg - back) % count if forth else (leg + back) % count
            start, end = self._waypoints[index], self._waypoints[index + 1]
            north, east = end[0] - start[0], end[1] - start[1]
            if math.hypot(north, east) > 1e-9:
                return math.atan2(east, north) if forth else math.atan2(-east, -north)
        return 0.0


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """A camera as a scene describes it.

    Attributes:
        model: size, intrinsics, distortion.
        mount: its position and attitude on the body; on a gimbal, the initial attitude.
        rate_hz: frames per second.
        shutter: rolling shutter and exposure; None for an instantaneous image.
        effects: of lens and sensor on colours; None: none.
        depth: the depth camera; None for true depth.
        draw_within_m: objects farther than this are not drawn.
        loss: share of lost frames, 0..1.
        latency_s: from a frame's capture to its arrival.
        seed: of noise, dropouts and losses.
    """

    model: CameraModel = DEFAULT_CAMERA
    mount: CameraMount = DEFAULT_MOUNT
    rate_hz: float = 30.0
    shutter: Shutter | None = None
    effects: ImageEffects | None = MILD_EFFECTS
    depth: DepthSensor | None = None
    draw_within_m: float = math.inf
    loss: float = 0.0
    latency_s: float = 0.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not 0.0 < self.rate_hz <= 1000.0:
            raise ValueError(f"the camera's rate must be positive and at most 1000 Hz, got {self.rate_hz} Hz")
        if not 0.0 <= self.loss < 1.0:
            raise ValueError(f"the share of frames lost must be 0 to below 1, got {self.loss}")
        if not 0.0 <= self.latency_s <= 5.0:
            raise ValueError(f"the camera's latency must be 0 to 5 s, got {self.latency_s} s")


@dataclass(frozen=True, slots=True)
class Scene:
    """A world at time 0, the paths of moving objects (by identifier), and the camera.

    >>> from mavlink_sim import load_scene
    >>> scene = load_scene("village")
    >>> len(scene.world.objects), scene.camera.model.width
    (10, 640)
    """

    world: World
    paths: Mapping[int, Motion] = field(default_factory=dict)
    camera: CameraSettings = field(default_factory=CameraSettings)
    name: str = "scene"

    def __post_init__(self) -> None:
        unknown = set(self.paths) - {item.identifier for item in self.world.objects}
        if unknown:
            raise ValueError(f"paths for objects that are not in the scene: {sorted(unknown)}")

    def objects_at(self, time_s: float) -> tuple[WorldObject, ...]:
        """All objects at a time, those with a path moved along it, in the world's order."""
        if not self.paths:
            return self.world.objects
        return tuple(_moved(item, self.paths.get(item.identifier), time_s) for item in self.world.objects)

    def world_at(self, time_s: float) -> World:
        """The world at a time."""
        return replace(self.world, objects=self.objects_at(time_s)) if self.paths else self.world


def _moved(item: WorldObject, path: Motion | None, time_s: float) -> WorldObject:
    if path is None:
        return item
    position, yaw = path.pose_at(time_s)
    return replace(item, position_ned_m=position, yaw_rad=yaw)
