"""The surface of an object as polygons: nearest point, ray intersection, horizontal section.

In the shape's frame: x forward, y right, z down, metres before the object's scale. The polygons are those
that are rendered, without decals, so that rendering, collisions and ranges agree.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from mavlink_sim.world.shapes import Shape, shape_of, variant_of
from mavlink_sim.world.solids import Points, Triple
from mavlink_sim.world.world import WorldObject

# The direction of the ray of `contains`: not along any rectangular edge.
_ASKEW = np.array([0.5413, 0.3127, 0.7805]) / math.sqrt(0.5413**2 + 0.3127**2 + 0.7805**2)
_PARALLEL = 1e-12


@dataclass(frozen=True, slots=True, eq=False)
class Mesh:
    """Flat convex polygons, with outward normals. Edges are in order, face by face.

    Attributes:
        first: (F,) the first edge of each face.
        normals, offsets: (F, 3), (F,) the faces' planes: normal · p = offset.
        face_of: (E,) each edge's face.
        starts, ends: (E, 3) of each edge.
        spans: (E, 3) from start to end; inverse_lengths: (E,) 1 / |span|².
        inwards: (E, 3) in the face's plane, at right angles to the edge, into the face.
    """

    first: NDArray[np.intp]
    normals: Points
    offsets: Points
    face_of: NDArray[np.intp]
    starts: Points
    ends: Points
    spans: Points
    inverse_lengths: Points
    inwards: Points

    def nearest(self, point: Points) -> tuple[Points, float]:
        """The nearest point (3,) of the surface, and its distance."""
        to = point - self.starts
        share = np.clip(np.einsum("ij,ij->i", to, self.spans) * self.inverse_lengths, 0.0, 1.0)
        away = to - share[:, None] * self.spans
        squares = np.einsum("ij,ij->i", away, away)
        edge = int(squares.argmin())
        best = float(squares[edge])
        height = self.normals @ point - self.offsets
        over = np.minimum.reduceat(np.einsum("ij,ij->i", to, self.inwards), self.first) >= 0.0
        heights = np.where(over, np.abs(height), np.inf)
        face = int(heights.argmin())
        if float(heights[face]) ** 2 < best:
            return point - height[face] * self.normals[face], float(heights[face])
        return point - away[edge], math.sqrt(best)

    def contains(self, point: Points) -> bool:
        """Whether a point is inside one of its closed solids."""
        crossed, facing, _ = self._crossings(point, _ASKEW)
        # leaving a solid adds one, entering one subtracts one; the two sides of a sheet cancel
        return float(np.sign(facing[crossed]).sum()) > 0.5

    def along(self, origin: Points, direction: Points) -> float:
        """The distance, in lengths of `direction` (3,), from a point to the first surface; inf: none."""
        crossed, _, lengths = self._crossings(origin, direction)
        return float(lengths[crossed].min()) if crossed.any() else math.inf

    def _crossings(self, origin: Points, direction: Points) -> tuple[NDArray[np.bool_], Points, Points]:
        """Of each face (F,): whether the ray goes through it, normal · direction, lengths to its plane."""
        facing = self.normals @ direction
        flat = np.abs(facing) < _PARALLEL
        lengths = (self.offsets - self.normals @ origin) / np.where(flat, 1.0, facing)
        met = origin + lengths[:, None] * direction
        within = np.einsum("ij,ij->i", met[self.face_of] - self.starts, self.inwards)
        crossed = ~flat & (lengths >= 0.0) & (np.minimum.reduceat(within, self.first) >= 0.0)
        return crossed, facing, lengths

    def cut(self, z: float) -> Points:
        """(S, 2, 2) the segments (x, y) in which the level at z cuts the surface."""
        low, high = self.starts[:, 2], self.ends[:, 2]
        across = np.flatnonzero((low < z) != (high < z))
        share = (z - low[across]) / (high[across] - low[across])
        points = self.starts[across, :2] + share[:, None] * self.spans[across, :2]
        return points.reshape(-1, 2, 2)  # a convex face is cut by two of its edges, which follow each other


@lru_cache(maxsize=512)
def mesh_of(
    class_name: str, variant: int, size_m: Triple | None = None, vertical_stretch: float = 1.0
) -> Mesh:
    """The surface of a class's variant (see `shape_of`), its heights multiplied by `vertical_stretch`."""
    shape = shape_of(class_name, variant, size_m)
    return _mesh([points * (1.0, 1.0, vertical_stretch) for points in _faces(shape)])


def _faces(shape: Shape) -> list[Points]:
    """The corners (K, 3) of each face of each solid, without the decals."""
    found = []
    for faces, (begin, end) in zip(shape.faces_of, pairwise(shape.solid_first), strict=True):
        left = end - begin
        for face in faces:  # decals are last
            if left == 0:
                break
            points = shape.corners[shape.first[face] : shape.first[face + 1]]
            left -= len(points)
            found.append(points)
    return found


def _mesh(faces: list[Points]) -> Mesh:
    counts = [len(points) for points in faces]
    starts = np.concatenate(faces)
    ends = np.concatenate([np.roll(points, -1, axis=0) for points in faces])
    face_of = np.repeat(np.arange(len(faces)), counts)
    first = np.cumsum([0, *counts[:-1]])
    spans = ends - starts
    # Newell's method, as `Face.plane`
    normals = np.add.reduceat(np.cross(starts, ends), first)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    middles = np.add.reduceat(starts, first) / np.array(counts)[:, None]
    offsets = np.einsum("ij,ij->i", normals, middles)
    lengths = np.maximum(np.einsum("ij,ij->i", spans, spans), 1e-18)
    inwards = np.cross(normals[face_of], spans)
    return Mesh(first, normals, offsets, face_of, starts, ends, spans, 1.0 / lengths, inwards)


def surface_range_to(item: WorldObject, position_ned_m: Sequence[float]) -> float:
    """Horizontal metres from a point outside to the nearest point of the object's surface.

    `world.range_to` measures to its footprint, the rectangle around it, which is up to 0.3 m nearer.
    """
    mesh = mesh_of(item.class_name, variant_of(item.class_name, item.appearance), item.size_m)
    cosine, sine = math.cos(item.yaw_rad), math.sin(item.yaw_rad)
    north, east = (position_ned_m[axis] - item.position_ned_m[axis] for axis in (0, 1))
    point = np.array([cosine * north + sine * east, cosine * east - sine * north]) / item.scale
    spans, to = mesh.spans[:, :2], point - mesh.starts[:, :2]
    share = (to * spans).sum(axis=1) / np.maximum((spans * spans).sum(axis=1), 1e-12)
    away = to - np.clip(share, 0.0, 1.0)[:, None] * spans
    return float(np.hypot(away[:, 0], away[:, 1]).min()) * item.scale
