"""The appearance of an object's class: faces in painting order, colours, outline on the ground.

Shapes are in the object's frame, FRD-like: x forward, y right, z down, the ground at z = 0. A class has
several variants (size, build, pose); the colours of an object are drawn separately from its appearance seed,
so that two cars of one variant may differ.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from mavlink_sim.world import distractors, people_and_animals, vehicles
from mavlink_sim.world.depth_sort import DepthSortTree, depth_sort_tree
from mavlink_sim.world.solids import Body, Points, Triple, ground_shadows
from mavlink_sim.world.structures import DEFAULT_SIZES_M, SIZED_BUILDERS, check_size

CLASS_NAMES = ("person", "bicycle", "car", "truck", "boat", "dog", "chair")
"""COCO's names of the detector's classes."""

BUILDERS: dict[str, Callable[[np.random.Generator], Body]] = {
    "person": people_and_animals.person,
    "bicycle": vehicles.bicycle,
    "car": vehicles.car,
    "truck": vehicles.truck,
    "boat": vehicles.boat,
    "dog": people_and_animals.dog,
    "chair": people_and_animals.chair,
    "tree": distractors.tree,
    "bush": distractors.bush,
    "rock": distractors.rock,
    "pole": distractors.pole,
    "crate": distractors.crate,
    "barrel": distractors.barrel,
    "shed": distractors.shed,
    "fence": distractors.fence,
    "table": distractors.table,
    "bale": distractors.bale,
    "tarpaulin": distractors.tarpaulin,
}
CLUTTER_NAMES = tuple(name for name in BUILDERS if name not in CLASS_NAMES)

VARIANTS = {"person": 40, "car": 24, "truck": 16, "boat": 16, "bicycle": 12, "dog": 16, "chair": 20}
DEFAULT_VARIANTS = 6

GLOSS = {"glass": 0.75, "paint": 0.3, "roof": 0.3, "hub": 0.4, "trim": 0.4, "headlight": 0.6, "panel": 0.7}
"""Reflection of the sky by a slot's surface at grazing angles; the rest is matt."""

_UPWARDS = np.array([1.0, 1.0, -1.0])


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """One variant of a class, prepared for drawing.

    Attributes:
        tree: painting order of the solids; eye and planes in the shape's frame.
        faces_of: for each solid its faces' numbers, decals last.
        corners: (P, 3) float64, the corners of all faces.
        first: (F + 1,) start of each face's corners.
        normals, offsets: (F, 3), (F,) planes of the faces, outwards.
        slots: names of the palette's colours.
        slot_of: (F,) index into `slots`.
        shade: (F,) brightness of each face.
        gloss: (F,) 0..1.
        solids: (S, 3) corners of all convex solids.
        solid_first: start of each solid's corners, and end of the last one's.
        low, high: (3,) the bounding box.
    """

    tree: DepthSortTree
    faces_of: tuple[tuple[int, ...], ...]
    corners: Points
    first: NDArray[np.int64]
    normals: Points
    offsets: Points
    slots: tuple[str, ...]
    slot_of: NDArray[np.int64]
    shade: Points
    gloss: Points
    solids: Points
    solid_first: tuple[int, ...]
    low: Points
    high: Points

    def shadow(self, sun: Points) -> list[NDArray[np.float32]]:
        """Outlines (K, 2) on the ground of each solid's shadow; `sun` (3,) towards the sun, shape's frame."""
        return ground_shadows(self.solids * _UPWARDS, self.solid_first, sun * _UPWARDS)

    def leaning_shadow(self, sun: Points, turn: Points) -> tuple[list[NDArray[np.float32]], float]:
        """The same of a shape that leans, with its lowest point on the ground, and the depth of that below z
        = 0.

        Args:
            sun: (3,) towards the sun, in the frame of the outlines.
            turn: (3, 3) from the shape's frame to the outlines' frame.
        """
        corners = self.solids @ turn.T
        lowest = float(corners[:, 2].max())
        corners[:, 2] -= lowest
        return ground_shadows(corners * _UPWARDS, self.solid_first, sun * _UPWARDS), lowest


def variant_of(class_name: str, appearance: int) -> int:
    """The variant of an object with this appearance seed."""
    return int(appearance) % VARIANTS.get(class_name, DEFAULT_VARIANTS)


@lru_cache(maxsize=512)
def shape_of(class_name: str, variant: int, size_m: Triple | None = None) -> Shape:
    """The shape of a class's variant; `size_m` (length, width, height) is only for those of `structures`.

    Raises ValueError for an unknown class and for an invalid size.
    """
    rng = np.random.default_rng((variant, *class_name.encode()))
    if class_name in SIZED_BUILDERS:
        size = size_m or DEFAULT_SIZES_M[class_name]
        check_size(class_name, size)
        body = SIZED_BUILDERS[class_name](rng, size)
    elif class_name not in BUILDERS:
        raise ValueError(
            f"cannot draw a {class_name!r}; known are {', '.join(sorted((*BUILDERS, *SIZED_BUILDERS)))}"
        )
    elif size_m is not None:
        raise ValueError(
            f"a {class_name} has its own size; size_m is for {', '.join(SIZED_BUILDERS)}: use scale"
        )
    else:
        body = BUILDERS[class_name](rng)
    for solid in body.solids:
        for face in (*solid.faces, *solid.decals):
            # Mirroring z reverses the winding.
            face.points = (face.points * (1.0, 1.0, -1.0))[::-1]
    solids = [solid.corners for solid in body.solids]
    faces = [face for solid in body.solids for face in (*solid.faces, *solid.decals)]
    planes = [face.plane() for face in faces]
    corners = np.concatenate([face.points for face in faces])
    slots = tuple(sorted({face.slot for face in faces}))
    counts = [len(solid.faces) + len(solid.decals) for solid in body.solids]
    ends = np.cumsum(counts).tolist()
    return Shape(
        tree=depth_sort_tree(body.solids),
        faces_of=tuple(tuple(range(end - count, end)) for count, end in zip(counts, ends, strict=True)),
        corners=corners,
        first=np.cumsum([0] + [len(face.points) for face in faces]),
        normals=np.array([normal for normal, _ in planes]),
        offsets=np.array([offset for _, offset in planes]),
        slots=slots,
        slot_of=np.array([slots.index(face.slot) for face in faces]),
        shade=np.array([face.shade for face in faces]),
        gloss=np.array([GLOSS.get(face.slot, 0.0) for face in faces]),
        solids=np.concatenate(solids),
        solid_first=tuple(accumulate(map(len, solids), initial=0)),
        low=corners.min(axis=0),
        high=corners.max(axis=0),
    )
