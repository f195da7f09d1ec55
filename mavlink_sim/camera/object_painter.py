"""Objects painted into an image with a depth buffer."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from mavlink_sim.camera.ground_view import View
from mavlink_sim.camera.object_view import (
    FACE_BITS,
    PlacedObject,
    Sighting,
)
from mavlink_sim.world.textures import Image, Plane, fractal_noise

_FACE = (1 << FACE_BITS) - 1
_TEXELS_PER_M = 90.0
_RIM_PX = 2
"""Around the objects, where their edges are softened."""


@dataclass(frozen=True, slots=True, eq=False)
class Painted:
    """The objects of an image, in the order of their labels: the first one's number is 1.

    Attributes:
        objects: each with its pixels without occlusion.
        labels: (H, W) int32, number << FACE_BITS | face; 0 where there is none.
        part: rows and columns of the image with all of them and a rim, to index with.
    """

    objects: list[tuple[PlacedObject, Sighting]]
    labels: NDArray[np.int32]
    part: tuple[slice, slice]


def paint_objects(seen: list[PlacedObject], view: View, image: Image, inverse_depth: Plane) -> Painted:
    """Draw objects where they are nearer than the present depth.

    Args:
        seen: the objects that may be in view.
        image: (H, W, 3) uint8 BGR, modified.
        inverse_depth: (H, W) float32, 1/m along the optical axis, 0 in the sky; modified.
    """
    labels = np.zeros((view.height, view.width), np.int32)
    objects: list[tuple[PlacedObject, Sighting]] = []
    flat_depth, flat_labels = inverse_depth.reshape(-1), labels.reshape(-1)
    for placed in seen:
        sighting = placed.draw(view)
        if sighting is None:
            continue
        objects.append((placed, sighting))
        nearer = sighting.inverse_depth > flat_depth.take(sighting.pixels)
        pixels = sighting.pixels[nearer]
        flat_depth[pixels] = sighting.inverse_depth[nearer]
        flat_labels[pixels] = sighting.faces[nearer] + (len(objects) << FACE_BITS)
    painted = Painted(objects, labels, _part(objects, view))
    if objects:
        _colour(painted, view, image, inverse_depth)
    return painted


def _part(objects: list[tuple[PlacedObject, Sighting]], view: View) -> tuple[slice, slice]:
    if not objects:
        return slice(0, 0), slice(0, 0)
    left = min(sighting.left for _, sighting in objects) - _RIM_PX
    top = min(sighting.top for _, sighting in objects) - _RIM_PX
    right = max(sighting.right for _, sighting in objects) + _RIM_PX
    bottom = max(sighting.bottom for _, sighting in objects) + _RIM_PX
    return slice(max(top, 0), min(bottom, view.height)), slice(max(left, 0), min(right, view.width))


def _colour(painted: Painted, view: View, image: Image, inverse_depth: Plane) -> None:
    """Give every pixel with an object its face's colour, textured."""
    rows, columns = painted.part
    # numpy searches booleans in an eighth of the time of numbers
    where = np.flatnonzero(painted.labels[rows, columns] != 0)
    down, right = np.divmod(where, columns.stop - columns.start)
    down += rows.start
    right += columns.start
    pixels = down * view.width + right
    labels = painted.labels.reshape(-1).take(pixels)
    number, face = (labels >> FACE_BITS) - 1, labels & _FACE
    tables = [sighting.face_colours for _, sighting in painted.objects]
    first = np.cumsum([0, *(len(table) for table in tables[:-1])])
    colours = np.concatenate(tables).take(first.take(number) + face, axis=0)
    x, y = right.astype(np.float32), down.astype(np.float32)
    depth = np.float32(1.0) / inverse_depth.reshape(-1).take(pixels)
    brightness = _texture([placed for placed, _ in painted.objects], number, view, x, y, depth)
    for index, (placed, _) in enumerate(painted.objects):
        if (printed := placed.item.printed) is not None:
            own = np.flatnonzero(number == index)
            faces = face[own].astype(np.int64)
            brightness[own] *= placed.printed_brightness(printed, view, faces, x[own], y[own])
    colours *= brightness[:, None]
    np.clip(colours, 0.0, 255.0, out=colours)
    image.reshape(-1, 3)[pixels] = colours.astype(np.uint8)


def _texture(
    objects: list[PlacedObject], number: NDArray[np.int32], view: View, x: Plane, y: Plane, depth: Plane
) -> Plane:
    """(N,) brightness of pixels: darker near the ground, a little mottled, fixed to the object."""
    scale = np.array([placed.item.scale for placed in objects], np.float32)
    away = np.array([view.eye[:2] - placed.origin[:2] for placed in objects], np.float32)
    rays = view.ned_from_pixel.astype(np.float32)
    above = -(np.float32(view.eye[2]) + depth * (rays[2, 0] * x + rays[2, 1] * y + rays[2, 2]))
    north = away[:, 0].take(number) + depth * (rays[0, 0] * x + rays[0, 1] * y + rays[0, 2])
    east = away[:, 1].take(number) + depth * (rays[1, 0] * x + rays[1, 1] * y + rays[1, 2])
    texels = (np.float32(_TEXELS_PER_M) / scale).take(number)
    across = ((north + np.float32(0.37) * above) * texels).astype(np.int32) & 255
    along = ((east + np.float32(0.71) * above) * texels).astype(np.int32) & 255
    brightness: Plane = _mottle().take((along << 8) + across)
    above *= (np.float32(1.6) / scale).take(number)
    np.clip(above, 0.0, 1.0, out=above)
    above *= np.float32(0.24)
    above += np.float32(0.76)
    brightness *= above
    return brightness


@lru_cache(maxsize=1)
def _mottle() -> Plane:
    """(65536,) brightness factors around 1: dirt and cloth, a 256 × 256 tile laid flat."""
    rng = np.random.default_rng(12)
    tile = 1.0 + 0.03 * fractal_noise(rng, 256, 8, 5, 0.8)
    return tile.astype(np.float32).ravel()
