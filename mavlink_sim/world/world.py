"""A world: objects on level ground, light, atmosphere. All positions NED, metres.

A world is small plain data, so that it can be sent to the camera's process; `renderer` draws it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from mavlink_sim.world.fiducials import Print
from mavlink_sim.world.shapes import CLASS_NAMES, CLUTTER_NAMES, Shape, shape_of, variant_of
from mavlink_sim.world.structures import STRUCTURE_NAMES, check_size

Vector = tuple[float, float, float]


OBJECT_NAMES = CLASS_NAMES + CLUTTER_NAMES + STRUCTURE_NAMES


@lru_cache(maxsize=1024)
def _footprint(
    class_name: str, variant: int, size_m: Vector | None, scale: float
) -> tuple[float, float, float, float]:
    shape = shape_of(class_name, variant, size_m)
    low, high = shape.low * scale, shape.high * scale
    return float(low[0]), float(high[0]), float(low[1]), float(high[1])


@dataclass(frozen=True, slots=True)
class WorldObject:
    """One object on or above the ground.

    Attributes:
        identifier: unique in its world, from 0.
        class_name: a COCO name (`shapes.CLASS_NAMES`), a kind of clutter (`shapes.CLUTTER_NAMES`), or one of
            `structures.STRUCTURE_NAMES`.
        position_ned_m: the centre of its footprint; z = 0 is the ground, negative is above it.
        yaw_rad: direction of its front, from north over east.
        scale: multiplies its natural size.
        appearance: seed of its variant (size, pose) and colours.
        size_m: length, width and height of one of `structures.STRUCTURE_NAMES`; None for its usual size.
        printed: the print of a plate.
        roll_rad, pitch_rad: its lean, about the centre of its height; the footprint does not change.
        system_id: of a simulated vehicle in this world; None for every other object.
    """

    identifier: int
    class_name: str
    position_ned_m: Vector
    yaw_rad: float = 0.0
    scale: float = 1.0
    appearance: int = 0
    size_m: Vector | None = None
    printed: Print | None = None
    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    system_id: int | None = None

    def __post_init__(self) -> None:
        if self.class_name not in OBJECT_NAMES:
            raise ValueError(
                f"object {self.identifier}: unknown class {self.class_name!r}; "
                f"known are {', '.join(OBJECT_NAMES)}"
            )
        if not self.scale > 0.0:
            raise ValueError(f"object {self.identifier}: scale must be positive, got {self.scale}")
        if (self.class_name == "plate") != (self.printed is not None):
            raise ValueError(f"object {self.identifier}: a plate must have a print, other classes must not")
        if self.size_m is not None:
            if self.class_name not in STRUCTURE_NAMES or self.printed is not None:
                raise ValueError(
                    f"object {self.identifier}: a {self.class_name} has its own size, size_m cannot be given"
                )
            check_size(self.class_name, self.size_m)

    @property
    def shape(self) -> Shape:
        """Its shape, in its frame and before `scale`."""
        size_m = self.size_m if self.printed is None else self.printed.board_size_m
        return shape_of(self.class_name, variant_of(self.class_name, self.appearance), size_m)

    @property
    def footprint_m(self) -> tuple[float, float, float, float]:
        """(rear, front, left, right) edges of its footprint in its frame, x forward, y right."""
        size_m = self.size_m if self.printed is None else self.printed.board_size_m
        return _footprint(self.class_name, variant_of(self.class_name, self.appearance), size_m, self.scale)

    @property
    def leans(self) -> bool:
        """Whether it is not level."""
        return self.roll_rad != 0.0 or self.pitch_rad != 0.0

    @property
    def height_m(self) -> float:
        """Its height above the ground."""
        shape = self.shape
        return float(-shape.low[2]) * self.scale


@dataclass(frozen=True, slots=True)
class Patch:
    """A round spot of another ground with an uneven border."""

    kind: str
    north_m: float
    east_m: float
    radius_m: float


@dataclass(frozen=True, slots=True)
class Ground:
    """Level ground at z = 0, textured by a repeated tile.

    Attributes:
        kinds: the tile's ground, and its spots (`textures.KINDS`).
        seed: of the tile.
        tile_texels: side of the tile, a power of two.
        texel_m: size of a texel on the ground.
        yaw_rad, origin_m: the tile's rotation, and the (north, east) of its corner.
        patches: spots of other ground; only for a tile without rotation.
        road_east_m: east of a road that runs north, winding; None for no road.
        pad: paint a landing pad with an H at the origin.
        gain: brightness of blue, green, red.
    """

    kinds: tuple[str, ...] = ("grass",)
    seed: int = 0
    tile_texels: int = 1024
    texel_m: float = 0.1
    yaw_rad: float = 0.0
    origin_m: tuple[float, float] = (0.0, 0.0)
    patches: tuple[Patch, ...] = ()
    road_east_m: float | None = None
    pad: bool = False
    gain: Vector = (1.0, 1.0, 1.0)


@dataclass(frozen=True, slots=True)
class Light:
    """The sun and the sky's light.

    Attributes:
        sun_azimuth_rad, sun_elevation_rad: the sun's direction, azimuth from north over east.
        sun: strength of direct light on surfaces that face it.
        ambient: strength of the sky's light on surfaces that face up.
        tint: colour of the direct light: blue, green, red.
        shadow: 0..1, how much darker the ground is in a shadow.
    """

    sun_azimuth_rad: float = math.radians(225)
    sun_elevation_rad: float = math.radians(48)
    sun: float = 0.68
    ambient: float = 0.5
    tint: Vector = (0.94, 1.0, 1.04)
    shadow: float = 0.45

    @property
    def towards_sun_ned(self) -> Vector:
        """Unit vector."""
        level = math.cos(self.sun_elevation_rad)
        return (
            level * math.cos(self.sun_azimuth_rad),
            level * math.sin(self.sun_azimuth_rad),
            -math.sin(self.sun_elevation_rad),
        )


@dataclass(frozen=True, slots=True)
class Sky:
    """Haze and sky. Colours are BGR, 0..255.

    Attributes:
        visibility_m: distance at which two thirds of an object's colour are lost in haze.
        horizon, zenith: the sky's colours.
        clouds: cloud cover, 0 none to 1 overcast.
        seed: of the clouds.
    """

    visibility_m: float = 900.0
    horizon: Vector = (226.0, 216.0, 202.0)
    zenith: Vector = (196.0, 138.0, 74.0)
    clouds: float = 0.45
    seed: int = 0


@dataclass(frozen=True, slots=True)
class World:
    """Everything visible to a camera."""

    objects: tuple[WorldObject, ...] = ()
    ground: Ground = field(default_factory=Ground)
    light: Light = field(default_factory=Light)
    sky: Sky = field(default_factory=Sky)


def range_to(world_object: WorldObject, position_ned_m: Sequence[float]) -> float:
    """Horizontal metres from a point to the nearest point of the object's footprint, 0 inside it."""
    north = position_ned_m[0] - world_object.position_ned_m[0]
    east = position_ned_m[1] - world_object.position_ned_m[1]
    c, s = math.cos(world_object.yaw_rad), math.sin(world_object.yaw_rad)
    forward, right = c * north + s * east, c * east - s * north
    rear, front, left, right_edge = world_object.footprint_m
    along = max(rear - forward, forward - front, 0.0)
    across = max(left - right, right - right_edge, 0.0)
    return math.hypot(along, across)


def _clear_of(placed: list[WorldObject], north: float, east: float, radius_m: float, gap_m: float) -> bool:
    for item in placed:
        rear, front, left, right = item.footprint_m
        reach = math.hypot(max(-rear, front), max(-left, right))
        if (
            math.hypot(item.position_ned_m[0] - north, item.position_ned_m[1] - east)
            < reach + radius_m + gap_m
        ):
            return False
    return True


def _hides(cars: list[WorldObject], north: float, east: float, half_width_m: float) -> bool:
    """Whether an object here would be between the origin and a car."""
    bearing, distance = math.atan2(east, north), math.hypot(north, east)
    for item in cars:
        car_bearing = math.atan2(item.position_ned_m[1], item.position_ned_m[0])
        car_distance = math.hypot(*item.position_ned_m[:2])
        apart = abs(math.remainder(bearing - car_bearing, math.tau))
        margin = math.atan2(half_width_m + 1.0, distance) + math.atan2(3.0, car_distance)
        if distance < car_distance + 3.0 and apart < margin:
            return True
    return False


def demo_world(seed: int = 0) -> World:
    """A field with a road, a pond, a landing pad at the origin, and objects of all the detector's classes.

    One or two cars are 18 to 35 m from the origin, at bearings drawn from the seed, with no object between
    them and the origin, and none within 6 m of it.
    """
    rng = np.random.default_rng((seed, 60))
    placed: list[WorldObject] = []
    cars: list[WorldObject] = []
    patches: list[Patch] = []

    def put(class_name: str, near_m: float, far_m: float, radius_m: float, ground: str | None = None) -> None:
        for _ in range(400):
            bearing, distance = rng.uniform(-math.pi, math.pi), rng.uniform(near_m, far_m)
            north, east = distance * math.cos(bearing), distance * math.sin(bearing)
            yaw, appearance = float(rng.uniform(-math.pi, math.pi)), int(rng.integers(2**31))
            if class_name == "car" and cars:
                first = math.atan2(cars[0].position_ned_m[1], cars[0].position_ned_m[0])
                if abs(math.remainder(bearing - first, math.tau)) < math.radians(60):
                    continue
            if not _clear_of(placed, north, east, radius_m, 1.5):
                continue
            if any(math.hypot(north - p.north_m, east - p.east_m) < p.radius_m + radius_m for p in patches):
                continue
            if class_name != "car" and _hides(cars, north, east, radius_m):
                continue
            item = WorldObject(len(placed), class_name, (north, east, 0.0), yaw, 1.0, appearance)
            placed.append(item)
            if class_name == "car":
                cars.append(item)
            if ground is not None:
                patches.append(Patch(ground, north, east, radius_m * 1.5 + 1.0))
            return
        raise RuntimeError(f"demo_world({seed}): found no free position for a {class_name}")

    for _ in range(1 + int(rng.integers(2))):
        put("car", 18.0, 35.0, 2.6, "gravel")
    put("boat", 24.0, 42.0, 5.0, "water")
    put("truck", 24.0, 45.0, 4.2, "asphalt")
    for class_name, near, far, radius in (
        ("person", 10.0, 22.0, 0.5),
        ("person", 14.0, 30.0, 0.5),
        ("person", 14.0, 34.0, 0.5),
        ("bicycle", 10.0, 22.0, 0.9),
        ("dog", 9.0, 18.0, 0.6),
        ("chair", 9.0, 16.0, 0.5),
        ("table", 9.0, 18.0, 0.9),
        ("shed", 38.0, 55.0, 4.0),
        ("fence", 20.0, 40.0, 3.0),
        ("bale", 16.0, 40.0, 0.9),
    ):
        put(class_name, near, far, radius)
    for class_name, count in (("tree", 12), ("bush", 7), ("rock", 3), ("pole", 1)):
        for _ in range(count):
            put(class_name, 26.0, 75.0, 1.8)
    road_east = (18.0 if rng.random() < 0.5 else -18.0) * float(rng.uniform(0.9, 1.2))
    ground = Ground(
        ("meadow", "grass"), seed, 2048, 0.08, patches=tuple(patches), road_east_m=road_east, pad=True
    )
    light = Light(sun_azimuth_rad=float(rng.uniform(-math.pi, math.pi)))
    return World(tuple(placed), ground, light, Sky(seed=seed))
