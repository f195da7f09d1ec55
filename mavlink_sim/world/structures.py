"""The solids of what a scene file can add to a world: walls and boxes of a given size, plates, other drones.

Frame and units as in `solids`. These names are apart from `shapes.BUILDERS`, from which training scenes draw
at random: a name more there would change every picture that follows.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from mavlink_sim.world.solids import Body, Triple, disc

PLATE_THICKNESS_M = 0.004


def wall(rng: np.random.Generator, size_m: Triple) -> Body:
    """A wall of (length, thickness, height), its face across x, with a coping on top if it is high enough."""
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


def plate(rng: np.random.Generator, size_m: Triple) -> Body:
    """A thin board; what is printed on it is painted by `plates`."""
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
    "drone": drone,
    "plate": plate,
}
DEFAULT_SIZES_M: dict[str, Triple] = {
    "wall": (4.0, 0.24, 2.0),
    "box": (1.0, 1.0, 1.0),
    "drone": (0.5, 0.5, 0.22),
    "plate": (0.5, 0.5, PLATE_THICKNESS_M),
}
"""Length, width (of a wall its thickness) and height."""
STRUCTURE_NAMES = tuple(SIZED_BUILDERS)


def check_size(class_name: str, size_m: Triple) -> None:
    """Raise ValueError unless a size is three lengths that can be drawn."""
    if len(size_m) != 3 or not all(math.isfinite(side) and 0.001 <= side <= 500.0 for side in size_m):
        raise ValueError(
            f"a {class_name}'s size must be three lengths of 0.001 to 500 m, got {tuple(size_m)}"
        )
