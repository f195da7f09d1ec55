"""Solids with a size for scene files: walls, boxes, buildings, trees, plates, other drones.

Frame and units as in `solids`. These names are separate from `shapes.BUILDERS`, from which training scenes
draw at random: an additional name there would change every following image.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from mavlink_sim.world.solids import Body, Triple, disc

PLATE_THICKNESS_M = 0.004


def wall(rng: np.random.Generator, size_m: Triple) -> Body:
    """A wall of (length, thickness, height), its face across x, with a coping if it is high enough."""
    length, thickness, height = size_m
    body = Body()
    coping = 0.08 if height > 0.6 else 0.0
    body.box((0, 0, (height - coping) / 2), (thickness, length, height - coping), "wall")
    if coping:
        body.box((0, 0, height - coping / 2), (thickness + 0.06, length + 0.06, coping), "stone")
    return body


def box(rng: np.random.Generator, size_m: Triple) -> Body:
    """A plain block of (length along x, width, height)."""
    body = Body()
    body.box((0, 0, size_m[2] / 2), size_m, "wall", top_slot="lid")
    return body


def building(rng: np.random.Generator, size_m: Triple) -> Body:
    """A house of (length, width, height) with a flat roof, rows of windows on each side, and a door."""
    length, width, height = size_m
    body = Body()
    body.box((0, 0, height / 2), size_m, "wall", top_slot="roof")
    floors = max(1, round(height / 3.0))
    for half, across, turned in ((width / 2, length, False), (length / 2, width, True)):
        count = max(1, round(across / 3.0))
        for side in (-1.0, 1.0):
            for floor in range(floors):
                for column in range(count):
                    middle = (column + 0.5) * across / count - across / 2
                    low, high = (floor + 0.35) * height / floors, (floor + 0.8) * height / floors
                    pane = [
                        (middle - 0.5, low),
                        (middle + 0.5, low),
                        (middle + 0.5, high),
                        (middle - 0.5, high),
                    ]
                    if floor == 0 and column == count // 2 and side > 0:
                        pane = [(x, z if z > low else 0.0) for x, z in pane]
                    points = [(side * half, x, z) if turned else (x, side * half, z) for x, z in pane]
                    outwards = (side, 0.0, 0.0) if turned else (0.0, side, 0.0)
                    body.add_decal(np.array(points), "glass", outwards)
    return body


def autumn_tree(rng: np.random.Generator, size_m: Triple) -> Body:
    """A tree in autumn colours or in blossom, of (crown length, crown width, height)."""
    length, width, height = size_m
    body = Body()
    body.tube((0, 0, 0), (0, 0, height * 0.6), 0.03 * height, "bark", 6, 0.02 * height)
    for _ in range(int(rng.integers(2, 6))):
        share = float(rng.uniform(0.3, 0.5))
        high = height * float(rng.uniform(0.16, 0.28))
        centre = (
            float(rng.uniform(-1, 1)) * length * (0.5 - share),
            float(rng.uniform(-1, 1)) * width * (0.5 - share),
            float(rng.uniform(0.45 * height, height - high)),
        )
        radii = (length * share, width * share, high)
        body.ellipsoid(centre, radii, "autumn_leaves", 7, 4, rng, 0.16, 0.16)
    return body


def plate(rng: np.random.Generator, size_m: Triple) -> Body:
    """A thin board; `fiducials` paints its print."""
    body = Body()
    body.box((0, 0, size_m[2] / 2), size_m, "board")
    return body


def drone(rng: np.random.Generator, size_m: Triple) -> Body:
    """A quadrotor in X of (length, width, height) over all, its legs on z = 0, propellers as thin discs."""
    length, width, height = size_m
    body = Body()
    arm_z = height * 0.62
    body.box((0, 0, arm_z), (length * 0.42, width * 0.3, height * 0.34), "paint", top_slot="lid")
    body.box((length * 0.24, 0, arm_z - height * 0.1), (length * 0.1, width * 0.12, height * 0.2), "dark")
    for x_side in (-1.0, 1.0):
        for y_side in (-1.0, 1.0):
            tip = (x_side * length * 0.34, y_side * width * 0.34, arm_z)
            body.tube((x_side * length * 0.1, y_side * width * 0.1, arm_z), tip, height * 0.06, "dark", 5)
            body.tube(tip, (tip[0], tip[1], height * 0.93), height * 0.1, "motor", 6)
            rotor = disc((tip[0], tip[1], height * 0.97), min(length, width) * 0.16, 9, 2)
            body.add_sheet(rotor, "dark")
            foot = (x_side * length * 0.16, y_side * width * 0.2, 0.0)
            body.tube(
                (x_side * length * 0.1, y_side * width * 0.1, arm_z - height * 0.1),
                foot,
                height * 0.05,
                "dark",
                4,
            )
    return body


SIZED_BUILDERS: dict[str, Callable[[np.random.Generator, Triple], Body]] = {
    "wall": wall,
    "box": box,
    "building": building,
    "autumn_tree": autumn_tree,
    "drone": drone,
    "plate": plate,
}
DEFAULT_SIZES_M: dict[str, Triple] = {
    "wall": (4.0, 0.24, 2.0),
    "box": (1.0, 1.0, 1.0),
    "building": (10.0, 7.0, 5.0),
    "autumn_tree": (3.0, 3.0, 5.0),
    "drone": (0.5, 0.5, 0.22),
    "plate": (0.5, 0.5, PLATE_THICKNESS_M),
}
"""Length, width (of a wall its thickness) and height."""
STRUCTURE_NAMES = tuple(SIZED_BUILDERS)


def check_size(class_name: str, size_m: Triple) -> None:
    """Raise ValueError unless a size is three valid lengths."""
    if len(size_m) != 3 or not all(math.isfinite(side) and 0.001 <= side <= 500.0 for side in size_m):
        raise ValueError(
            f"a {class_name}'s size must be three lengths of 0.001 to 500 m, got {tuple(size_m)}"
        )
