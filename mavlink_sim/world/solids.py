"""Convex solids, the building blocks of objects.

An object's frame: x forward, y right, z up, metres, the ground at z = 0. A solid is a list of faces; a face
is a convex polygon (K, 3). Faces are oriented outwards from their solid's centre.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]
Triple = tuple[float, float, float]


@dataclass(slots=True, eq=False)
class Face:
    """One convex polygon and its colour.

    Attributes:
        points: (K, 3) corners, in the order for which `normal` points outwards.
        slot: name of the colour in the object's palette.
        shade: multiplies that colour's brightness.
    """

    points: Points
    slot: str
    shade: float = 1.0

    def plane(self) -> tuple[Points, float]:
        """(unit normal, offset) with normal · p = offset on the face (Newell's method)."""
        corners: list[list[float]] = self.points.tolist()
        nx = ny = nz = sx = sy = sz = 0.0
        ax, ay, az = corners[-1]
        for bx, by, bz in corners:
            nx += ay * bz - az * by
            ny += az * bx - ax * bz
            nz += ax * by - ay * bx
            sx, sy, sz = sx + bx, sy + by, sz + bz
            ax, ay, az = bx, by, bz
        length = max(math.sqrt(nx * nx + ny * ny + nz * nz), 1e-12)
        normal = np.array([nx, ny, nz]) / length
        return normal, (nx * sx + ny * sy + nz * sz) / length / len(corners)


@dataclass(slots=True, eq=False)
class Solid:
    """A convex solid, or a flat sheet: its faces and their decals."""

    faces: list[Face]
    decals: list[Face] = field(default_factory=list)

    @property
    def corners(self) -> Points:
        """(N, 3) the corners of all faces."""
        return np.concatenate([face.points for face in self.faces])


class _Surface:
    """All faces of solids in arrays: planes, (F, 3) and (F,), the solid of each, the extent of the solids."""

    def __init__(self, solids: list[Solid]) -> None:
        planes = [[face.plane() for face in solid.faces] for solid in solids]
        self.normals = np.array([normal for of_solid in planes for normal, _ in of_solid]).reshape(-1, 3)
        self.offsets = np.array([offset for of_solid in planes for _, offset in of_solid])
        self.solid = np.repeat(np.arange(len(solids)), [len(of_solid) for of_solid in planes])
        self.low = np.array([solid.corners.min(axis=0) for solid in solids]).reshape(-1, 3)
        self.high = np.array([solid.corners.max(axis=0) for solid in solids]).reshape(-1, 3)


@dataclass(slots=True)
class Body:
    """An object under construction."""

    solids: list[Solid] = field(default_factory=list)
    _surface: _Surface | None = field(default=None, init=False, repr=False)

    def add_solid(
        self, polygons: Sequence[Points], slots: str | Sequence[str], shades: Points | None = None
    ) -> None:
        """Add a closed convex solid; its faces are oriented outwards."""
        middle = np.vstack(polygons).mean(axis=0)
        faces = []
        for index, polygon in enumerate(polygons):
            slot = slots if isinstance(slots, str) else slots[index]
            shade = 1.0 if shades is None else float(shades[index])
            face = Face(np.asarray(polygon, np.float64), slot, shade)
            normal, offset = face.plane()
            if float(normal @ middle) > offset:
                face.points = face.points[::-1]
            faces.append(face)
        self.solids.append(Solid(faces))

    def add_decal(self, polygon: Points, slot: str, outwards: Points | Triple) -> None:
        """Add one face on a solid's face, visible from the side that `outwards` points to.

        It belongs to the solid with the nearest surface, and is painted after that solid's faces.
        """
        direction = np.asarray(outwards, np.float64)
        decal = Face(np.asarray(polygon, np.float64), slot)
        if float(decal.plane()[0] @ direction) < 0.0:
            decal.points = decal.points[::-1]
        middle, facing = decal.points.mean(axis=0), decal.plane()[0]
        surface = self._seen_surface()
        beside = np.maximum(surface.low - middle, middle - surface.high).max(axis=1)
        distance = np.abs(surface.normals @ middle - surface.offsets) + np.maximum(beside, 0.0)[surface.solid]
        distance[surface.normals @ facing <= 0.7] = np.inf
        nearest = int(np.argmin(distance)) if len(distance) else -1
        if nearest < 0 or not math.isfinite(distance[nearest]):
            raise ValueError(f"no solid has a face looking along {direction.tolist()} for a decal {slot!r}")
        self.solids[surface.solid[nearest]].decals.append(decal)

    def _seen_surface(self) -> _Surface:
        """The bounds of all solids so far."""
        if self._surface is None or len(self._surface.low) < len(self.solids):
            self._surface = _Surface(self.solids)
        return self._surface

    def add_sheet(self, polygon: Points, slot: str, back_slot: str | None = None) -> None:
        """Add a thin sheet, visible from both sides."""
        points = np.asarray(polygon, np.float64)
        self.solids.append(Solid([Face(points, slot), Face(points[::-1], back_slot or slot)]))

    def box(
        self, centre: Triple, size: Triple, slot: str, yaw_rad: float = 0.0, top_slot: str | None = None
    ) -> None:
        """A box by its centre and its sizes along x, y, z, rotated about the vertical."""
        self.loft(
            rectangle(size[0], size[1]),
            rectangle(size[0], size[1]),
            centre[2] - size[2] / 2,
            centre[2] + size[2] / 2,
            slot,
            offset=(centre[0], centre[1]),
            yaw_rad=yaw_rad,
            top_slot=top_slot,
        )

    def loft(
        self,
        bottom: Points,
        top: Points,
        bottom_z: float,
        top_z: float,
        slot: str,
        offset: tuple[float, float] = (0.0, 0.0),
        yaw_rad: float = 0.0,
        top_slot: str | None = None,
    ) -> list[Points]:
        """A solid between two horizontal polygons (K, 2) of K corners each. Returns the K side polygons.

        Sides of four corners must be nearly flat; slightly bent ones are split in two.
        """
        c, s = math.cos(yaw_rad), math.sin(yaw_rad)
        turn = np.array([[c, s], [-s, c]])
        low = np.column_stack([bottom @ turn + offset, np.full(len(bottom), bottom_z)])
        high = np.column_stack([top @ turn + offset, np.full(len(top), top_z)])
        sides = [
            np.array([low[i], low[(i + 1) % len(low)], high[(i + 1) % len(low)], high[i]])
            for i in range(len(low))
        ]
        flat: list[Points] = []
        for side in sides:
            flat.extend(flat_pieces(side))
        self.add_solid([*flat, low, high], [slot] * (len(flat) + 1) + [top_slot or slot])
        return sides

    def extrude(
        self,
        profile: Points,
        half_width: float,
        slot: str,
        centre_y: float = 0.0,
        slots: Sequence[str] | None = None,
        top_half_width: float | None = None,
    ) -> None:
        """A convex profile (K, 2) in x, z extruded along y; optionally narrower towards its top.

        Args:
            slots: one per profile edge (edge i runs from corner i to corner i + 1).
        """
        z = profile[:, 1]
        share = (z - z.min()) / max(float(np.ptp(z)), 1e-9)
        narrow = half_width if top_half_width is None else top_half_width
        half = half_width + (narrow - half_width) * share
        left = np.column_stack([profile[:, 0], centre_y - half, z])
        right = np.column_stack([profile[:, 0], centre_y + half, z])
        count = len(profile)
        polygons: list[Points] = [left, right]
        names = [slot, slot]
        for i in range(count):
            j = (i + 1) % count
            polygons.append(np.array([left[i], left[j], right[j], right[i]]))
            names.append(slots[i] if slots else slot)
        self.add_solid(polygons, names)

    def tube(
        self,
        start: Triple | Points,
        end: Triple | Points,
        radius: float,
        slot: str,
        sides: int = 6,
        end_radius: float | None = None,
        cap_slot: str | None = None,
        squash: float = 1.0,
    ) -> None:
        """A straight n-sided tube (or cone) between two points; `squash` flattens its section."""
        first, last = np.asarray(start, np.float64), np.asarray(end, np.float64)
        axis = last - first
        axis = axis / max(float(np.linalg.norm(axis)), 1e-9)
        across = np.cross(axis, (0.0, 0.0, 1.0) if abs(axis[2]) < 0.9 else (1.0, 0.0, 0.0))
        across = across / np.linalg.norm(across)
        other = np.cross(axis, across) * squash
        angles = (np.arange(sides) + 0.5) * 2 * math.pi / sides
        ring = np.cos(angles)[:, None] * across + np.sin(angles)[:, None] * other
        low = first + ring * radius
        high = last + ring * (radius if end_radius is None else end_radius)
        polygons: list[Points] = [low, high]
        for i in range(sides):
            j = (i + 1) % sides
            polygons.append(np.array([low[i], low[j], high[j], high[i]]))
        self.add_solid(polygons, [cap_slot or slot] * 2 + [slot] * sides)

    def ellipsoid(
        self,
        centre: Triple,
        radii: Triple,
        slot: str,
        around: int = 8,
        stacked: int = 5,
        rng: np.random.Generator | None = None,
        roughness: float = 0.0,
        shade_spread: float = 0.0,
    ) -> None:
        """A faceted ellipsoid, optionally uneven (`roughness` of the radius) with uneven brightness."""
        points = np.zeros((stacked + 1, around, 3))
        for row in range(stacked + 1):
            polar = math.pi * row / stacked
            azimuth = (np.arange(around) + 0.5 * (row % 2)) * 2 * math.pi / around
            points[row, :, 0] = math.sin(polar) * np.cos(azimuth)
            points[row, :, 1] = math.sin(polar) * np.sin(azimuth)
            points[row, :, 2] = math.cos(polar)
        if rng is not None and roughness > 0.0:
            bump = 1.0 + roughness * rng.uniform(-1, 1, (stacked + 1, around, 1))
            bump[0], bump[-1] = bump[0, 0], bump[-1, 0]
            points *= bump
        points = points * radii + centre
        polygons: list[Points] = []
        for row in range(stacked):
            shift = row % 2
            for i in range(around):
                j = (i + 1) % around
                upper, lower = points[row], points[row + 1]
                if row > 0:
                    below = lower[j] if shift else lower[i]
                    polygons.append(np.array([upper[i], upper[j], below]))
                if row < stacked - 1:
                    above = upper[j] if not shift else upper[i]
                    polygons.append(np.array([lower[i], lower[j], above]))
        spread = None
        if rng is not None and shade_spread > 0.0:
            spread = 1.0 + shade_spread * rng.uniform(-1, 1, len(polygons))
        self.add_solid(polygons, slot, spread)


def flat_pieces(side: Points) -> list[Points]:
    """A polygon of four corners unchanged if flat, else as two triangles."""
    normal = np.cross(side[1] - side[0], side[2] - side[0])
    length = float(np.linalg.norm(normal))
    if length < 1e-12 or abs(float(normal @ (side[3] - side[0]))) / length < 1e-3:
        return [side]
    return [side[[0, 1, 2]], side[[0, 2, 3]]]


def rectangle(length: float, width: float) -> Points:
    """(4, 2) corners around the origin."""
    x, y = length / 2, width / 2
    return np.array([[-x, -y], [x, -y], [x, y], [-x, y]])


def disc(centre: Triple, radius: float, sides: int, normal_axis: int, turn_rad: float = 0.0) -> Points:
    """(sides, 3) regular polygon at right angles to axis 0, 1 or 2."""
    angles = turn_rad + (np.arange(sides) + 0.5) * 2 * math.pi / sides
    points = np.zeros((sides, 3))
    first, second = [axis for axis in range(3) if axis != normal_axis]
    points[:, first] = np.cos(angles) * radius
    points[:, second] = np.sin(angles) * radius
    return points + centre


def inset(side: Points, left: float, right: float, low: float, high: float) -> Points:
    """A smaller quad on a side given as low-left, low-right, high-right, high-left, in 0..1 across and up."""

    def at(across: float, up: float) -> Points:
        bottom = side[0] + (side[1] - side[0]) * across
        top = side[3] + (side[2] - side[3]) * across
        point: Points = bottom + (top - bottom) * up
        return point

    return np.array([at(left, low), at(right, low), at(right, high), at(left, high)])


def between(rng: np.random.Generator, low: float, high: float) -> float:
    """A uniformly distributed number."""
    return float(rng.uniform(low, high))


def ground_shadows(corners: Points, first: Sequence[int], sun: Points) -> list[NDArray[np.float32]]:
    """(K, 2) convex outlines on the ground (x, y) of solids' shadows.

    Args:
        corners: (N, 3) of all solids, in a frame with z up and the ground at z = 0.
        first: start of each solid's corners, and end of the last one's.
        sun: (3,) direction towards the sun in the same frame, above the horizon.
    """
    reach = np.maximum(corners[:, 2], 0.0) / max(float(sun[2]), 0.05)
    fallen = (corners[:, :2] - sun[:2] * reach[:, None]).astype(np.float32)
    return [
        np.asarray(cv2.convexHull(fallen[start:end]), np.float32).reshape(-1, 2)
        for start, end in pairwise(first)
    ]
