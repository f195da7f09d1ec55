"""What an object of a class looks like: its faces in painting order, its colours, its outline on the ground.

Shapes are in the object's own frame, FRD-like: x forward, y right, z down, the ground at z = 0. A class has a
number of variants (size, build, pose); the colours of an object are drawn from its appearance seed apart from
that, so that two cars of one variant need not look alike.
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
"""COCO's names of what the detector is to find."""

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
"""How much of the sky a slot's surface mirrors at a grazing look; the rest is matt."""

_UPWARDS = np.array([1.0, 1.0, -1.0])


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """One variant of a class, ready to be drawn.

    Attributes:
        tree: painting order of the solids; eye and planes in the shape's frame.
        faces_of: for each solid its faces' numbers, decals last.
        corners: (P, 3) float64, all faces' corners one after another.
        first: (F + 1,) where each face's corners begin.
        normals, offsets: (F, 3), (F,) planes of the faces, outwards.
        slots: names of the palette's colours.
        slot_of: (F,) index into `slots`.
        shade: (F,) brightness of each face.
        gloss: (F,) 0..1.
        solids: (S, 3) corners of the convex solids, one solid after another.
        solid_first: where each solid's corners begin, and where the last one's end.
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
        """The same of a shape that leans, its lowest point on the ground, and how far that lies below z = 0.

        Args:
            sun: (3,) towards the sun, in the frame of the outlines.
            turn: (3, 3) from the shape's frame to that of the outlines.
        """
        corners = self.solids @ turn.T
        lowest = float(corners[:, 2].max())
        corners[:, 2] -= lowest
        return ground_shadows(corners * _UPWARDS, self.solid_first, sun * _UPWARDS), lowest


def variant_of(class_name: str, appearance: int) -> int:
    """Which of its class's variants an object with this appearance seed is."""
    return int(appearance) % VARIANTS.get(class_name, DEFAULT_VARIANTS)


@lru_cache(maxsize=512)
def shape_of(class_name: str, variant: int, size_m: Triple | None = None) -> Shape:
    """The shape of a class's variant; `size_m` (length, width, height) is for those of `structures` alone.

    Raises ValueError for a class that cannot be drawn, and for a size that it cannot have.
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
            # Mirroring z turns the winding round.
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
