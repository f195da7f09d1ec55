"""Labelled images for training the detector: random viewpoints, cameras, light, and objects on the ground.

`random_frame` shows large objects from any viewpoint, `flight_frame` near and far ones between many
distractors from a low vehicle, `world_frame` the default world and the example scenes. `training_frame` mixes
them. All random numbers are from one generator, so that a seed gives the same images again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from mavlink_sim.camera.ground_view import Buffers, View
from mavlink_sim.camera.image_effects import MILD_EFFECTS, ImageEffects
from mavlink_sim.camera.renderer import Rendered, Renderer
from mavlink_sim.camera.scene import Scene
from mavlink_sim.camera.scene_file import example_scenes, load_scene
from mavlink_sim.world.fiducials import Print
from mavlink_sim.world.shapes import CLASS_NAMES, CLUTTER_NAMES
from mavlink_sim.world.textures import KINDS, Image
from mavlink_sim.world.world import Ground, Light, Patch, Sky, World, WorldObject, demo_world, range_to
from vision.camera_model import CameraModel, CameraMount
from vision.rotation import matrix_from_euler

Boxes = NDArray[np.float32]
ClassIds = NDArray[np.int64]

MIN_VISIBLE_FRACTION = 0.35
MIN_SIDE_PX = 8.0
MIN_AREA_PX = 120.0

EMPTY_SHARE = 0.08
MAX_OBJECTS = 14
TILES = 56
PAINTED_TILES = 6
BEFORE_LENS_M = 1.2
"""Least distance of an object from the camera."""
CLASS_WEIGHTS = {
    "person": 1.5,
    "bicycle": 1.0,
    "car": 1.5,
    "truck": 0.9,
    "boat": 0.9,
    "dog": 1.0,
    "chair": 1.0,
}
FLIGHT_SHARE, WORLD_SHARE = 0.36, 0.3
"""Shares of `flight_frame` and `world_frame` in training; the rest is `random_frame`."""
TRAINING_WORLDS = tuple(range(1_000_000, 1_000_008))
"""Seeds of the default worlds in training. Flights and held-out frames use small seeds."""
FARTHEST_M = 70.0
LEARNED_SIDE_PX, LEARNED_AREA_PX = 5.0, 60.0
"""Smaller objects are not used in training, neither as objects nor as background."""
DISTRACTOR_NAMES = (
    *CLUTTER_NAMES,
    *("autumn_tree", "autumn_tree", "tree", "building", "box", "wall", "drone", "plate"),
)
ALIKE = (("car", "truck", "boat"), ("person", "bicycle", "dog", "chair"), ("tree", "bush", "autumn_tree"))
NARROW_SIDE_M = np.array([0.5, 0.5, 1.5, 2.2, 1.7, 0.4, 0.5])
"""Least apparent width of each class, from most sides. Smaller than MIN_SIDE_PX is not attempted."""
OTHER_NARROW_SIDE_M = 0.5
"""The same of other kinds of objects."""

FAR_WEIGHTS = np.array([1.3, 1.2, 1.4, 1.2, 1.8, 1.2, 1.2])
"""Weights of the classes where all distances are equally likely; most boats, which were detected as cars."""
_SIZES_M = {
    "building": ((8.0, 6.0, 3.2), (14.0, 8.0, 6.0), (20.0, 10.0, 4.0), (10.0, 10.0, 9.0)),
    "box": ((1.0, 1.0, 1.0), (4.0, 1.8, 1.4), (2.0, 1.2, 0.6), (0.5, 0.5, 1.7), (6.0, 2.5, 2.6)),
    "wall": ((3.0, 0.24, 1.0), (6.0, 0.3, 2.0), (12.0, 0.3, 2.6), (1.5, 0.2, 1.8)),
    "autumn_tree": ((2.0, 2.0, 3.5), (3.0, 3.4, 5.0), (5.0, 4.0, 6.5), (1.6, 1.2, 1.8), (3.5, 2.5, 2.4)),
}
"""Number of distractor variants: enough variety, few enough to be cached."""


def random_scene(
    rng: np.random.Generator, width: int = 384, height: int = 384, focal_px: tuple[float, float] | None = None
) -> tuple[Image, Boxes, ClassIds]:
    """One labelled image.

    Args:
        rng: the generator of all random numbers.
        focal_px: least and greatest focal length; by default 0.6 to 1.7 times the width.

    Returns:
        The image (height, width, 3) uint8 BGR; boxes (N, 4) float32, left, top, right, bottom edges, pixels;
        class ids (N,) int64, indices into CLASS_NAMES. Only objects of which at least a third is visible
        (MIN_VISIBLE_FRACTION) and whose box is not tiny are labelled.
    """
    rendered = random_frame(rng, width, height, focal_px)
    boxes: list[tuple[float, float, float, float]] = []
    ids: list[int] = []
    for item in rendered.objects:
        class_name = item.world_object.class_name
        if class_name in CLASS_NAMES and _counts(item.xyxy, item.visible_fraction):
            boxes.append(item.xyxy)
            ids.append(CLASS_NAMES.index(class_name))
    return rendered.image, np.array(boxes, np.float32).reshape(-1, 4), np.array(ids, np.int64)


def training_scene(rng: np.random.Generator, width: int, height: int) -> tuple[Image, Boxes, ClassIds]:
    """One image of the mixture with its labels, as `random_scene`.

    Objects too small or too much hidden for training have the id ~class: they are no background either.
    """
    rendered = training_frame(rng, width, height)
    boxes: list[tuple[float, float, float, float]] = []
    ids: list[int] = []
    for item in rendered.objects:
        if item.world_object.class_name in CLASS_NAMES:
            class_id = CLASS_NAMES.index(item.world_object.class_name)
            sides = np.subtract(item.xyxy[2:], item.xyxy[:2])
            large = sides.min() >= LEARNED_SIDE_PX and sides.prod() >= LEARNED_AREA_PX
            boxes.append(item.xyxy)
            ids.append(class_id if large and item.visible_fraction >= MIN_VISIBLE_FRACTION else ~class_id)
    return rendered.image, np.array(boxes, np.float32).reshape(-1, 4), np.array(ids, np.int64)


def training_frame(rng: np.random.Generator, width: int, height: int, more: tuple[str, ...] = ()) -> Rendered:
    """One frame of the mixture that the bundled model is trained on.

    `more`: other kinds of objects to place as often as those of its classes.
    """
    kind = float(rng.random())
    if kind < FLIGHT_SHARE:
        return flight_frame(rng, width, height, more)
    if kind < FLIGHT_SHARE + WORLD_SHARE:
        return world_frame(rng, width, height)
    return random_frame(rng, width, height, more=more)


def flight_frame(rng: np.random.Generator, width: int, height: int, more: tuple[str, ...] = ()) -> Rendered:
    """The view ahead from a low vehicle: objects 3 to 70 m away, many distractors, ground, shadows."""
    low = rng.random() < 0.85
    altitude = float(math.exp(rng.uniform(math.log(1.5), math.log(10.0)) + (0.0 if low else math.log(5.0))))
    camera = CameraModel.from_horizontal_fov(width, height, math.radians(float(rng.uniform(60.0, 92.0))))
    down = math.radians(float(rng.uniform(4.0, 32.0) if low else rng.uniform(12.0, 65.0)))
    yaw = float(rng.uniform(-math.pi, math.pi))
    attitude = matrix_from_euler(math.radians(float(rng.normal(0.0, 4.0))), -down, yaw)
    ground = _random_ground(rng, painted=0.45)
    viewpoint = rng.uniform(-45.0, 45.0, 2)
    if ground.pad or ground.patches:
        # Look at ground features: a pad, a pond.
        spots = [(patch.north_m, patch.east_m) for patch in ground.patches] + [(0.0, 0.0)] * ground.pad
        spot = spots[int(rng.integers(len(spots)))]
        bearing = yaw + float(rng.uniform(-0.5, 0.5))
        away = altitude / math.tan(down) * float(rng.uniform(0.5, 2.5))
        viewpoint = np.array(spot) - min(away, 40.0) * np.array([math.cos(bearing), math.sin(bearing)])
    position = (float(viewpoint[0]), float(viewpoint[1]), -altitude)
    light, sky, buffers = _random_light(rng), _random_sky(rng), _buffers(width, height)
    renderer = Renderer(World((), ground, light, sky), camera, CameraMount(), None, buffers)
    objects = _random_objects(rng, renderer, position, attitude, ground, far=True, more=more)
    if light.shadow > 0.2 and rng.random() < 0.5:
        objects += _shadow_casters(rng, renderer.view(position, attitude), light, objects)
    effects = _random_effects(rng) if rng.random() < 0.6 else MILD_EFFECTS
    renderer = Renderer(World(objects, ground, light, sky), camera, CameraMount(), effects, buffers, rng)
    return renderer.render(position, attitude)


def world_frame(rng: np.random.Generator, width: int, height: int) -> Rendered:
    """A default world or an example scene, with other colours and builds, from a random viewpoint."""
    scenes = _scenes()
    scene = scenes[int(rng.integers(len(scenes)))]
    world = scene.world
    objects = scene.objects_at(float(rng.uniform(0.0, 60.0)))
    if scene.name == "demo" or rng.random() < 0.5:
        objects = tuple(_another(rng, item) for item in objects)
    light = world.light if rng.random() < 0.5 else _random_light(rng)
    sky = world.sky if rng.random() < 0.5 else _random_sky(rng)
    effects = scene.camera.effects if rng.random() < 0.5 else _random_effects(rng)
    model = scene.camera.model
    seen_deg = math.degrees(2 * math.atan(model.width / 2 / model.fx)) * float(rng.uniform(0.85, 1.15))
    ideal = CameraModel.from_horizontal_fov(width, height, math.radians(seen_deg))
    camera = replace(ideal, distortion=model.distortion, distortion_model=model.distortion_model)
    buffers = None if not camera.rectilinear else _buffers(width, height)
    shown = World(objects, world.ground, light, sky)
    renderer = Renderer(shown, camera, CameraMount(), effects, buffers, rng)
    return renderer.render(*_gaze(rng, objects, camera))


@lru_cache(maxsize=1)
def _scenes() -> tuple[Scene, ...]:
    worlds = tuple(Scene(demo_world(seed), name="demo") for seed in TRAINING_WORLDS)
    return worlds + tuple(load_scene(name) for name in example_scenes())


def _another(rng: np.random.Generator, item: WorldObject) -> WorldObject:
    """The object in another build and colour, occasionally one of another kind of the same size."""
    if item.printed is not None:
        return item
    class_name, size = item.class_name, item.size_m
    alike = next((names for names in ALIKE if class_name in names), None)
    if alike is not None and rng.random() < 0.25:
        class_name = alike[int(rng.integers(len(alike)))]
    yaw = item.yaw_rad + float(rng.normal(0.0, 0.6))
    appearance, scale = int(rng.integers(2**31)), item.scale * float(rng.uniform(0.9, 1.12))
    return replace(item, class_name=class_name, size_m=size, yaw_rad=yaw, appearance=appearance, scale=scale)


def _gaze(
    rng: np.random.Generator, objects: Sequence[WorldObject], camera: CameraModel
) -> tuple[tuple[float, float, float], NDArray[np.float64]]:
    """A position 3 to 60 m from one of the objects, mostly low, and an attitude with it in the image."""
    known = [item for item in objects if item.class_name in CLASS_NAMES]
    across, along = math.atan(camera.width / 2 / camera.fx), math.atan(camera.height / 2 / camera.fy)
    north, east, altitude, yaw, depression = 0.0, 0.0, FARTHEST_M, 0.0, math.pi / 2
    for _ in range(20):
        target = (known or objects)[int(rng.integers(len(known or objects)))]
        if rng.random() < 0.3:
            target = objects[int(rng.integers(len(objects)))]
        away = math.exp(rng.uniform(math.log(3.0), math.log(60.0)))
        highest = 9.0 if rng.random() < 0.75 else 40.0
        altitude = math.exp(rng.uniform(math.log(1.8), math.log(highest)))
        yaw = float(rng.uniform(-math.pi, math.pi))
        north = target.position_ned_m[0] - away * math.cos(yaw)
        east = target.position_ned_m[1] - away * math.sin(yaw)
        aim = target.height_m / 2 - target.position_ned_m[2]
        depression = math.atan2(altitude - aim, away)
        if not any(
            range_to(item, (north, east)) < 0.8 and altitude < item.height_m - item.position_ned_m[2] + 0.8
            for item in objects
        ):
            break
    else:
        altitude = FARTHEST_M
    pitch = -depression + float(rng.uniform(-0.7, 0.7)) * along
    if rng.random() < 0.4:
        pitch = -math.radians(float(rng.uniform(8.0, 28.0)))
    yaw += float(rng.uniform(-0.7, 0.7)) * across
    roll = math.radians(float(rng.normal(0.0, 4.0)))
    return (north, east, -altitude), matrix_from_euler(roll, pitch, yaw)


def random_frame(
    rng: np.random.Generator,
    width: int,
    height: int,
    focal_px: tuple[float, float] | None = None,
    more: tuple[str, ...] = (),
) -> Rendered:
    """The frame of `random_scene`, with depth and all visible objects; the same draws, the same image."""
    least, greatest = focal_px or (0.6 * width, 1.7 * width)
    altitude = float(math.exp(rng.uniform(math.log(1.5), math.log(60.0))))
    # Looking down from a greater height with a longer lens, so that people stay visible.
    lens = rng.beta(1.0 + altitude / 25.0, 1.6)
    focal = float(least * (greatest / least) ** lens)
    camera = CameraModel(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
    pitch = -_pitch_down(rng, altitude)
    roll = math.radians(float(np.clip(rng.normal(0.0, 9.0), -25.0, 25.0)))
    attitude = matrix_from_euler(roll, pitch, float(rng.uniform(-math.pi, math.pi)))
    ground = _random_ground(rng)
    position = (float(rng.uniform(-45, 45)), float(rng.uniform(-45, 45)), -altitude)
    light = _random_light(rng)
    sky = _random_sky(rng)
    buffers = _buffers(width, height)
    renderer = Renderer(World((), ground, light, sky), camera, CameraMount(), None, buffers)
    objects = _random_objects(rng, renderer, position, attitude, ground, more=more)
    effects = _random_effects(rng)
    renderer = Renderer(World(objects, ground, light, sky), camera, CameraMount(), effects, buffers, rng)
    return renderer.render(position, attitude)


def _counts(xyxy: tuple[float, float, float, float], visible_fraction: float) -> bool:
    wide, high = xyxy[2] - xyxy[0], xyxy[3] - xyxy[1]
    large = min(wide, high) >= MIN_SIDE_PX and wide * high >= MIN_AREA_PX
    return large and visible_fraction >= MIN_VISIBLE_FRACTION


@lru_cache(maxsize=4)
def _buffers(width: int, height: int) -> Buffers:
    return Buffers(width, height)


def _pitch_down(rng: np.random.Generator, altitude_m: float) -> float:
    """The camera's pitch: from slightly up to straight down; at greater height mostly down."""
    if rng.random() < 0.18:
        return math.radians(float(rng.uniform(75, 90)))
    middle = 12.0 + 14.0 * math.log(max(altitude_m, 1.5) / 1.5)
    return math.radians(float(np.clip(rng.normal(middle, 16.0), -10.0, 90.0)))


def _random_ground(rng: np.random.Generator, painted: float = 0.22) -> Ground:
    gain = rng.uniform(0.72, 1.2) * rng.uniform(0.93, 1.07, 3)
    tint = (float(gain[0]), float(gain[1]), float(gain[2]))
    if rng.random() < painted:
        return _painted_ground(int(rng.integers(PAINTED_TILES)), tint)
    seed = int(rng.integers(TILES))
    kinds, texels, texel_m = _tile_recipe(seed)
    origin = (float(rng.uniform(-50, 50)), float(rng.uniform(-50, 50)))
    size = texel_m * float(rng.uniform(0.7, 1.4))
    return Ground(kinds, seed, texels, size, float(rng.uniform(-math.pi, math.pi)), origin, gain=tint)


@lru_cache(maxsize=TILES)
def _tile_recipe(seed: int) -> tuple[tuple[str, ...], int, float]:
    rng = np.random.default_rng((seed, 31))
    names = tuple(KINDS)
    kinds: tuple[str, ...] = (names[seed % len(names)],)
    if rng.random() < 0.4:
        kinds += (names[int(rng.integers(len(names)))],)
    return kinds, (512 if rng.random() < 0.7 else 1024), float(rng.uniform(0.04, 0.12))


@lru_cache(maxsize=PAINTED_TILES)
def _painted(seed: int) -> Ground:
    rng = np.random.default_rng((seed, 32))
    patches = tuple(
        Patch(
            str(rng.choice(["water", "gravel", "asphalt", "sand", "soil", "concrete", "rows"])),
            float(rng.uniform(-40, 40)),
            float(rng.uniform(-40, 40)),
            float(rng.uniform(3, 10)),
        )
        for _ in range(int(rng.integers(3, 9)))
    )
    kinds: tuple[tuple[str, ...], ...] = (
        ("meadow", "grass"),
        ("grass",),
        ("grass", "soil"),
        ("sand",),
        ("snow",),
        ("soil", "grass"),
    )
    road = None if seed == 4 else float(rng.uniform(-25, 25)) or 1.0
    return Ground(kinds[seed % 6], seed, 1024, 0.1, patches=patches, road_east_m=road, pad=seed % 2 == 0)


def _painted_ground(seed: int, gain: tuple[float, float, float]) -> Ground:
    base = _painted(seed)
    return Ground(
        base.kinds,
        base.seed,
        base.tile_texels,
        base.texel_m,
        0.0,
        (0.0, 0.0),
        base.patches,
        base.road_east_m,
        base.pad,
        gain,
    )


def _random_light(rng: np.random.Generator) -> Light:
    overcast = rng.random() < 0.3
    warm = float(rng.uniform(-0.04, 0.12))
    return Light(
        sun_azimuth_rad=float(rng.uniform(-math.pi, math.pi)),
        sun_elevation_rad=math.radians(float(rng.uniform(18, 80))),
        sun=float(rng.uniform(0.05, 0.25) if overcast else rng.uniform(0.45, 0.8)),
        ambient=float(rng.uniform(0.6, 0.85) if overcast else rng.uniform(0.38, 0.58)),
        tint=(1.0 - warm, 1.0, 1.0 + 0.6 * warm),
        shadow=float(rng.uniform(0.0, 0.2) if overcast else rng.uniform(0.3, 0.65)),
    )


def _random_sky(rng: np.random.Generator) -> Sky:
    grey = float(rng.uniform(0, 1)) ** 2
    bright = float(rng.uniform(0.75, 1.08))
    horizon = np.array((226.0, 216.0, 202.0)) * (1 - grey) + np.array((206.0, 206.0, 204.0)) * grey
    zenith = np.array((196.0, 138.0, 74.0)) * (1 - grey) + np.array((178.0, 172.0, 166.0)) * grey
    far, high = horizon * bright, zenith * bright
    return Sky(
        visibility_m=float(math.exp(rng.uniform(math.log(120.0), math.log(3000.0)))),
        horizon=(float(far[0]), float(far[1]), float(far[2])),
        zenith=(float(high[0]), float(high[1]), float(high[2])),
        clouds=float(rng.uniform(0, 1)),
        seed=int(rng.integers(4)),
    )


def _random_effects(rng: np.random.Generator) -> ImageEffects:
    balance = rng.uniform(0.9, 1.1, 3)
    return ImageEffects(
        blur_sigma_px=float(rng.uniform(0.3, 1.3)) if rng.random() < 0.35 else 0.0,
        motion_px=float(rng.uniform(2, 6)) if rng.random() < 0.12 else 0.0,
        motion_rad=float(rng.uniform(0, math.pi)),
        exposure=float(rng.uniform(0.6, 1.35)),
        white_balance=(float(balance[0]), float(balance[1]), float(balance[2])),
        contrast=float(rng.uniform(0.75, 1.2)),
        gamma=float(rng.uniform(0.8, 1.3)),
        grey=float(rng.uniform(0.3, 1.0)) if rng.random() < 0.08 else 0.0,
        noise_sigma=float(rng.uniform(0.5, 9.0)) if rng.random() < 0.7 else 0.0,
    )


def _random_objects(
    rng: np.random.Generator,
    renderer: Renderer,
    position: tuple[float, float, float],
    attitude: NDArray[np.float64],
    ground: Ground,
    far: bool = False,
    more: tuple[str, ...] = (),
) -> tuple[WorldObject, ...]:
    """Objects placed where they are large enough in the image and not much hidden by each other.

    `far`: equally many at each distance, small ones too, and every kind of distractor. `more`: kinds of
    objects besides the bundled model's classes.
    """
    view = renderer.view(position, attitude)
    empty = rng.random() < EMPTY_SHARE
    wanted = 0 if empty else 1 + int(rng.integers(MAX_OBJECTS))
    clutter = int(rng.integers(2, 16) if far else rng.integers(0, 9))
    water = ground.kinds[0] == "water"
    wanted_names = CLASS_NAMES + more
    of_more = np.ones(len(more))
    weights = np.concatenate([list(CLASS_WEIGHTS.values()), of_more])
    far_weights = np.concatenate([FAR_WEIGHTS, of_more])
    narrow_m = np.concatenate([NARROW_SIDE_M, OTHER_NARROW_SIDE_M * of_more])
    if water:
        weights[CLASS_NAMES.index("boat")] *= 6.0
    placed: list[WorldObject] = []
    boxes: list[NDArray[np.float64]] = []
    depths: list[float] = []
    true_class: list[bool] = []
    found = {True: 0, False: 0}
    for attempt in range(6 * (wanted + clutter)):
        real = attempt % 6 < 4
        if found[real] >= (wanted if real else clutter):
            continue
        pixel = np.array([rng.uniform(0, view.width), rng.uniform(0, view.height), 1.0])
        ray = view.ned_from_pixel @ pixel
        if ray[2] <= 1e-3:
            continue
        depth = float(-view.eye[2] / ray[2])
        if far:
            # The same column, at another distance.
            depth = math.exp(rng.uniform(math.log(3.0), math.log(FARTHEST_M)))
            ahead = ray[:2] / math.hypot(*ray[:2])
            ray = np.array([*ahead, -view.eye[2] / depth])
        if real and far:
            class_name = wanted_names[int(rng.choice(len(wanted_names), p=far_weights / far_weights.sum()))]
        elif real:
            fitting = weights * (narrow_m * view.focal_px / depth > MIN_SIDE_PX)
            if not fitting.any():
                continue
            class_name = wanted_names[int(rng.choice(len(wanted_names), p=fitting / fitting.sum()))]
        else:
            names = DISTRACTOR_NAMES if far else CLUTTER_NAMES
            class_name = names[int(rng.integers(len(names)))]
        appearance = int(rng.integers(2**31))
        scale = float(rng.uniform(0.9, 1.12))
        yaw = float(rng.uniform(-math.pi, math.pi))
        where = view.eye + depth * ray
        item = WorldObject(
            len(placed),
            class_name,
            (float(where[0]), float(where[1]), 0.0),
            yaw,
            scale,
            appearance,
            printed=_random_print(rng) if class_name == "plate" else None,
        )
        if class_name in _SIZES_M:
            item = replace(item, size_m=_SIZES_M[class_name][appearance % len(_SIZES_M[class_name])])
        if class_name == "drone":
            height = float(rng.uniform(0.0, 2.0 * -view.eye[2]))
            item = replace(item, position_ned_m=(*item.position_ned_m[:2], -height))
        outline = _outline(item, view)
        if outline is None:
            continue
        box, inside = outline
        sides = box[2:] - box[:2]
        limit = MIN_SIDE_PX * 1.35
        if far and (inside < 0.3 or sides.min() < (3 if real else 1)):
            continue
        if real and not far and (sides.min() < limit or sides.prod() < 2.2 * MIN_AREA_PX or inside < 0.5):
            continue
        if not real and (inside < 0.2 or sides.prod() > 0.3 * view.width * view.height or sides.max() < 4):
            continue
        if any(_touch(item, other) for other in placed):
            continue
        if _hidden(box, depth, real, boxes, depths, true_class):
            continue
        placed.append(item)
        boxes.append(box)
        depths.append(depth)
        true_class.append(real)
        found[real] += 1
    return tuple(placed)


def _random_print(rng: np.random.Generator) -> Print:
    side = float(rng.choice((0.3, 0.6, 1.0, 2.0)))
    dictionary = ("APRILTAG_36h11", "4X4_50", "6X6_250")[int(rng.integers(3))]
    return Print(dictionary, int(rng.integers(50)), side, standing=bool(rng.random() < 0.4))


def _shadow_casters(
    rng: np.random.Generator, view: View, light: Light, objects: tuple[WorldObject, ...]
) -> tuple[WorldObject, ...]:
    """Objects outside the image whose shadows are in it."""
    casters: list[WorldObject] = []
    sun = np.array(light.towards_sun_ned)
    for _ in range(4):
        pixel = np.array([rng.uniform(0, view.width), rng.uniform(view.height / 2, view.height), 1.0])
        ray = view.ned_from_pixel @ pixel
        if ray[2] <= 0.05:
            continue
        names = ("tree", "autumn_tree", "pole", "shed", "building")
        class_name = names[int(rng.integers(len(names)))]
        shadow = view.eye + ray * float(-view.eye[2] / ray[2])
        appearance, yaw = int(rng.integers(2**31)), float(rng.uniform(-math.pi, math.pi))
        item = WorldObject(1000 + len(casters), class_name, (0.0, 0.0, 0.0), yaw, 1.0, appearance)
        reach = item.height_m * float(rng.uniform(0.5, 1.0)) / max(-sun[2], 0.1)
        viewpoint = (float(shadow[0] + sun[0] * reach), float(shadow[1] + sun[1] * reach), 0.0)
        item = replace(item, position_ned_m=viewpoint)
        outline = _outline(item, view)
        # Behind the lens is outside the image, but not directly above it.
        outside = outline is None or outline[1] < 0.02
        clear = range_to(item, (view.eye[0], view.eye[1])) > 1.0
        if outside and clear and not any(_touch(item, other) for other in (*objects, *casters)):
            casters.append(item)
    return tuple(casters)


def _outline(item: WorldObject, view: View) -> tuple[NDArray[np.float64], float] | None:
    """The box (4,) in the image around the object's bounding box, and its share inside the image."""
    shape = item.shape
    low, high = shape.low * item.scale, shape.high * item.scale
    x, y, z = np.meshgrid((low[0], high[0]), (low[1], high[1]), (low[2], high[2]))
    c, s = math.cos(item.yaw_rad), math.sin(item.yaw_rad)
    x, y, z = x.ravel(), y.ravel(), z.ravel()
    corners = np.column_stack([c * x - s * y, s * x + c * y, z]) + item.position_ned_m
    seen = (corners - view.eye) @ view.pixel_from_ned.T
    if seen[:, 2].min() < BEFORE_LENS_M:
        return None
    points = seen[:, :2] / seen[:, 2:]
    size = (view.width, view.height)
    low_px, high_px = points.min(axis=0), points.max(axis=0)
    inside_low, inside_high = np.clip(low_px, 0, size), np.clip(high_px, 0, size)
    whole = float(np.prod(high_px - low_px))
    inside = float(np.prod(inside_high - inside_low)) / max(whole, 1e-9)
    return np.concatenate([inside_low, inside_high]), inside


def _touch(one: WorldObject, other: WorldObject) -> bool:
    apart = math.hypot(
        one.position_ned_m[0] - other.position_ned_m[0], one.position_ned_m[1] - other.position_ned_m[1]
    )
    reach = 0.0
    for item in (one, other):
        rear, front, left, right = item.footprint_m
        reach += (front - rear + right - left) / 4
    return apart < reach * 1.1


def _hidden(
    box: NDArray[np.float64],
    depth_m: float,
    real: bool,
    boxes: list[NDArray[np.float64]],
    depths: list[float],
    true_class: list[bool],
) -> bool:
    """Whether this object hides, or is hidden by, another by more than about half."""
    area = float(np.prod(box[2:] - box[:2]))
    for other, other_depth, other_real in zip(boxes, depths, true_class, strict=True):
        shared = np.minimum(box[2:], other[2:]) - np.maximum(box[:2], other[:2])
        if shared.min() <= 0.0:
            continue
        common = float(np.prod(shared))
        behind_real = other_real if depth_m < other_depth else real
        hidden_area = float(np.prod(other[2:] - other[:2])) if depth_m < other_depth else area
        if behind_real and common > 0.5 * hidden_area:
            return True
    return False
