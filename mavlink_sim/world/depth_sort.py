"""The painting order of an object's solids, so that near ones cover far ones, from any viewpoint.

A binary space partition (Fuchs, Kedem, Naylor 1980, "On visible surface generation by a priori tree
structures") whose leaves are whole convex solids: within a leaf the faces towards the eye never cover each
other. Solids are not split: where two overlap a little (a knee, a bumper), each is assigned to the side of
the plane with most of it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mavlink_sim.world.solids import Points, Solid

TOLERATED_OVERLAP_M = 0.035
TOLERATED_OVERLAP_SHARE = 0.25
"""As a share of a solid's extent along the plane's normal. Tuned visually: joints of limbs stay intact."""


@dataclass(frozen=True, slots=True, eq=False)
class DepthSortTree:
    """A partition tree in arrays; node 0 is the root.

    Attributes:
        normals, offsets: (M, 3), (M,) the nodes' planes (unused at leaves).
        front, behind: (M,) child node on the side the normal points to, and on the other; -1 at leaves.
        leaf: (M,) the leaf's solid, -1 at inner nodes.
    """

    normals: Points
    offsets: Points
    front: list[int]
    behind: list[int]
    leaf: list[int]

    def back_to_front(self, eye: Points) -> list[int]:
        """Numbers of the solids from the farthest to the nearest, as seen from `eye` (3,)."""
        before = (self.normals @ eye > self.offsets).tolist()
        front, behind, leaf = self.front, self.behind, self.leaf
        order: list[int] = []
        stack: list[int] = [0]
        while stack:
            node = stack.pop()
            if leaf[node] >= 0:
                order.append(leaf[node])
            elif before[node]:
                stack += (front[node], behind[node])
            else:
                stack += (behind[node], front[node])
        return order


def depth_sort_tree(solids: list[Solid]) -> DepthSortTree:
    """The partition tree of convex solids. Raises ValueError if there are none."""
    if not solids:
        raise ValueError("an object needs at least one solid")
    extents = _Extents(solids)
    normals: list[Points] = []
    offsets: list[float] = []
    front: list[int] = []
    behind: list[int] = []
    leaf: list[int] = []
    tasks: list[tuple[list[int], list[int] | None, int]] = [(list(range(len(solids))), None, 0)]
    while tasks:
        group, slot, position = tasks.pop()
        node = len(leaf)
        if slot is not None:
            slot[position] = node
        front.append(-1)
        behind.append(-1)
        leaf.append(group[0] if len(group) == 1 else -1)
        if len(group) == 1:
            normals.append(np.zeros(3))
            offsets.append(0.0)
            continue
        normal, offset, ahead = extents.best_plane(group)
        normals.append(normal)
        offsets.append(offset)
        tasks.append(([index for index, side in zip(group, ahead, strict=True) if side], front, node))
        tasks.append(([index for index, side in zip(group, ahead, strict=True) if not side], behind, node))
    return DepthSortTree(np.array(normals), np.array(offsets), front, behind, leaf)


class _Extents:
    """The extent of each solid on either side of each candidate plane; computed once.

    The planes are those of all faces, and those across the axes at the start, centre and end of a solid.
    """

    def __init__(self, solids: list[Solid]) -> None:
        count = len(solids)
        corners = [solid.corners for solid in solids]
        self._corners = corners
        lows = np.array([points.min(axis=0) for points in corners])
        highs = np.array([points.max(axis=0) for points in corners])
        # (S, 3 axes, 3 levels, S): along an axis a solid's extent is its own, less the level of each.
        levels = np.stack([lows, highs, (lows + highs) / 2]).transpose(2, 0, 1)
        across_low = lows[:, :, None, None] - levels
        across_high = highs[:, :, None, None] - levels
        planes = [[face.plane() for face in solid.faces] for solid in solids]
        every = [plane for of_solid in planes for plane in of_solid]
        faces = np.array([normal for normal, _ in every])
        offsets = np.array([offset for _, offset in every])
        reach = [faces @ points.T for points in corners]
        face_low = np.array([along.min(axis=1) for along in reach]) - offsets
        face_high = np.array([along.max(axis=1) for along in reach]) - offsets
        # Planes in columns: those across the axes first.
        self._low = np.concatenate([across_low.reshape(count, -1), face_low], axis=1)
        self._high = np.concatenate([across_high.reshape(count, -1), face_high], axis=1)
        self._normals = np.concatenate([np.repeat(np.eye(3), 3 * count, axis=0), faces])
        self._offsets = np.concatenate([levels.ravel(), offsets])
        of_faces = np.repeat(np.arange(count), [len(of_solid) for of_solid in planes])
        self._solid_of = np.concatenate([np.tile(np.arange(count), 9), of_faces])

    def best_plane(self, group: list[int]) -> tuple[Points, float, list[bool]]:
        """The plane that separates a group with the least overlap, and the solids on its normal's side."""
        columns = np.flatnonzero(np.isin(self._solid_of, group))
        rows = np.array(group)[:, None]
        low, high = self._low[rows, columns], self._high[rows, columns]
        ahead: NDArray[np.bool_] = low + high >= 0.0
        overlap = np.maximum(np.where(ahead, -low, high), 0.0)
        tolerated = np.maximum(TOLERATED_OVERLAP_M, TOLERATED_OVERLAP_SHARE * (high - low))
        count = ahead.sum(axis=0)
        cost = 10.0 * np.maximum(overlap - tolerated, 0.0).sum(axis=0) + 0.3 * overlap.sum(axis=0)
        cost += 0.01 * np.abs(2 * count - len(group))
        cost[(count == 0) | (count == len(group))] = np.inf
        best = int(np.argmin(cost))
        if not np.isfinite(cost[best]):
            # Solids around a common centre: no plane separates them, so split them by number.
            half = [index >= len(group) // 2 for index in range(len(group))]
            middle = np.concatenate([self._corners[index] for index in group])[:, 2].mean()
            return np.array([0.0, 0.0, -1.0]), float(-middle), half
        plane = columns[best]
        return self._normals[plane], float(self._offsets[plane]), ahead[:, best].tolist()


def clip_polygon(points: Points, normal: Points, offset: float) -> Points:
    """The part of a convex polygon (K, D) where normal · p ≥ offset (Sutherland–Hodgman); may be empty."""
    distance = points @ normal - offset
    kept: list[Points] = []
    for index in range(len(points)):
        here, there = float(distance[index]), float(distance[(index + 1) % len(points)])
        if here >= 0.0:
            kept.append(points[index])
        if (here > 0.0 > there) or (here < 0.0 < there):
            following = points[(index + 1) % len(points)]
            kept.append(points[index] + (following - points[index]) * (here / (here - there)))
    return np.array(kept).reshape(-1, points.shape[1])
