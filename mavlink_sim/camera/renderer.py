"""Software rendering of a world: colour, depth, and the visible part of each object.

Ground, then shadows, then objects with a depth buffer, then sky and haze. One call is one frame; no state is
kept between frames, so any pose can be drawn at any time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from mavlink_sim.camera.ground_view import Buffers, View, add_haze, draw_ground, draw_sky
from mavlink_sim.camera.image_effects import ImageEffects, Sensor
from mavlink_sim.camera.lens import CameraMotion, Lens, Shutter
from mavlink_sim.camera.object_view import (
    FACE_BITS,
    FAR_PX,
    NEAR_M,
    SUBPIXEL_BITS,
    PlacedObject,
    Sighting,
    within_view,
)
from mavlink_sim.world.depth_sort import clip_polygon
from mavlink_sim.world.textures import Image, Plane, fractal_noise
from mavlink_sim.world.world import World, WorldObject, range_to
from vision.camera_model import CameraModel, CameraMount

MAX_SHADOW_SOLIDS_AT_PX = 14.0
"""A shadow smaller than this is drawn as one outline, not as one per solid."""

Outlines = tuple[NDArray[np.float64], list[int]]
"""(P, 2) corners in pixels of all convex outlines, and the start of each and the end of the last."""


class Shadows:
    """The shadows of these objects."""

    def __init__(self, placed: Sequence[PlacedObject]) -> None:
        self._placed = list(placed)
        spheres = [_around(item) for item in self._placed]
        self._middles = np.array([middle for middle, _ in spheres]).reshape(-1, 3)
        self._radii = np.array([radius_m for _, radius_m in spheres])

    def cast(self, view: View, darkness: float, image: Image) -> None:
        """Darken the ground of `image` by `darkness`, 0..1, in the objects' shadows."""
        if darkness <= 0.0:
            return
        mask: Image | None = None
        left, top, right, bottom = view.width, view.height, 0, 0
        for placed in within_view(self._placed, self._middles, self._radii, view):
            outlines = _in_view(placed, view)
            if outlines is None:
                continue
            if mask is None:
                mask = np.zeros((view.height, view.width), np.uint8)
            points, first = outlines
            low = np.minimum.reduceat(points, first[:-1])
            high = np.maximum.reduceat(points, first[:-1])
            shown = (high >= 0.0).all(axis=1) & (low <= (view.width, view.height)).all(axis=1)
            if not shown.any():
                continue
            left, top = np.minimum((left, top), low[shown].astype(np.int64).min(axis=0)).tolist()
            right, bottom = np.maximum((right, bottom), high[shown].astype(np.int64).max(axis=0)).tolist()
            fixed = np.rint(np.clip(points, -FAR_PX, FAR_PX) * (1 << SUBPIXEL_BITS)).astype(np.int32)
            for index in np.flatnonzero(shown).tolist():
                outline = fixed[first[index] : first[index + 1]]
                cv2.fillConvexPoly(mask, outline, 255, cv2.LINE_8, SUBPIXEL_BITS)
        left, top = max(left - 4, 0), max(top - 4, 0)
        right, bottom = min(right + 5, view.width), min(bottom + 5, view.height)
        if mask is None or right <= left or bottom <= top:
            return
        soft = cv2.blur(mask[top:bottom, left:right], (5, 5))
        factor = cv2.cvtColor(255 - cv2.convertScaleAbs(soft, alpha=darkness), cv2.COLOR_GRAY2BGR)
        part = image[top:bottom, left:right]
        cv2.multiply(part, factor, dst=part, scale=1 / 255)


def _around(placed: PlacedObject) -> tuple[NDArray[np.float64], float]:
    """Centre (3,) NED and radius in metres of a sphere around a shadow, without its outlines.

    The outlines of moving objects are computed for each frame, only for those that may be in view.
    """
    lean = placed.sun[:2] / max(-float(placed.sun[2]), 0.05)
    height_m = max(max(float(placed.origin[2]), 0.0) - float(placed.middle[2]), 0.0)
    north_east = placed.middle[:2] - lean * height_m
    return np.array([*north_east, 0.0]), placed.radius_m * math.hypot(1.0, float(lean[0]), float(lean[1]))


def _in_view(placed: PlacedObject, view: View) -> Outlines | None:
    """A shadow's outlines, clipped at the near plane, one for all where it is small; None if out of view."""
    corners, first = placed.shadow
    projected = (corners - view.eye) @ view.pixel_from_ned.T
    depth = projected[:, 2]
    if float(depth.max()) < NEAR_M:
        return None
    if float(depth.min()) >= NEAR_M:
        points = projected[:, :2] / projected[:, 2:]
        low, high = points.min(axis=0), points.max(axis=0)
        if high[0] < 0 or high[1] < 0 or low[0] > view.width or low[1] > view.height:
            return None
        if float((high - low).max()) < MAX_SHADOW_SOLIDS_AT_PX:
            hull = cv2.convexHull(points.astype(np.float32)).reshape(-1, 2).astype(np.float64)
            return hull, [0, len(hull)]
        return points, first
    forward = np.array([0.0, 0.0, 1.0])
    cut: list[NDArray[np.float64]] = []
    ends = [0]
    for start, end in pairwise(first):
        piece = projected[start:end]
        nearest = float(piece[:, 2].min())
        kept = piece if nearest >= NEAR_M else clip_polygon(piece, forward, NEAR_M)
        if len(kept) >= 3:
            cut.append(kept[:, :2] / kept[:, 2:])
            ends.append(ends[-1] + len(kept))
    return (np.concatenate(cut), ends) if cut else None


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


DEFAULT_CAMERA = CameraModel.from_horizontal_fov(640, 480, math.radians(70.0))
DEFAULT_MOUNT = CameraMount(forward_m=0.12, pitch_rad=math.radians(-20.0))

LOWEST_EYE_M = 0.05
"""Least height of the camera: a landed vehicle's camera would touch the ground."""


@dataclass(frozen=True, slots=True, eq=False)
class VisibleObject:
    """The visible part of one object.

    Attributes:
        world_object: the object.
        xyxy: edges of the box around its visible pixels: left, top, and right, bottom past the last pixel.
        visible_fraction: visible pixels relative to those without occlusion and beyond the image's edges,
        0..1.
        pixel_count: number of visible pixels.
        range_m: horizontal metres from the camera to its footprint.
    """

    world_object: WorldObject
    xyxy: tuple[float, float, float, float]
    visible_fraction: float
    pixel_count: int
    range_m: float


@dataclass(frozen=True, slots=True, eq=False)
class Rendered:
    """One frame.

    Attributes:
        image: (H, W, 3) uint8 BGR.
        depth_m: (H, W) float32 along the optical axis, NaN in the sky and beyond 10 km.
        objects: those with at least one visible pixel, in the world's order.
        eye_ned_m: (3,) the optical centre, NED.
    """

    image: Image
    depth_m: Plane
    objects: list[VisibleObject]
    eye_ned_m: NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class _Found:
    """The pixels with objects, row by row: the object's number in the order drawn, column, row; (N,) each."""

    numbers: NDArray[np.int32]
    columns: NDArray[np.intp]
    rows: NDArray[np.intp]


_STILL = CameraMotion()


class Renderer:
    """Draws one world through one camera; `rng` draws the sensor's noise if there are effects.

    A camera with lens distortion or a shutter is drawn through `lens`, which takes longer; others are drawn
    directly.

    Raises ValueError for an unsupported distortion, and for buffers of another size.
    """

    def __init__(
        self,
        world: World,
        camera: CameraModel = DEFAULT_CAMERA,
        mount: CameraMount = DEFAULT_MOUNT,
        effects: ImageEffects | None = None,
        buffers: Buffers | None = None,
        rng: np.random.Generator | None = None,
        shutter: Shutter | None = None,
        draw_within_m: float = math.inf,
    ) -> None:
        self.world, self.camera, self.mount = world, camera, mount
        self._draw_within_m = draw_within_m
        self._sensor = None if effects is None else Sensor(effects)
        self._lens = Lens(camera, shutter) if not camera.rectilinear or shutter is not None else None
        self._drawn = camera if self._lens is None else self._lens.drawn
        self._buffers = buffers or Buffers(self._drawn.width, self._drawn.height)
        if (self._buffers.width, self._buffers.height) != (self._drawn.width, self._drawn.height):
            raise ValueError(
                f"buffers must have the drawn image's size {self._drawn.width}x{self._drawn.height}, "
                f"got {self._buffers.width}x{self._buffers.height}"
            )
        self._placed = [PlacedObject(item, world.light, world.sky) for item in world.objects]
        self._middles = np.array([placed.middle for placed in self._placed]).reshape(-1, 3)
        self._radii = np.array([placed.radius_m for placed in self._placed])
        self._shadows = Shadows(self._placed)
        self._rng = rng or np.random.default_rng(0)

    def place(self, objects: Sequence[WorldObject]) -> None:
        """Set the objects; unchanged ones are not prepared again."""
        known = {placed.item: placed for placed in self._placed}
        light, sky = self.world.light, self.world.sky
        if all(placed.item is item for placed, item in zip(self._placed, objects, strict=False)) and len(
            objects
        ) == len(self._placed):
            return
        self.world = replace(self.world, objects=tuple(objects))
        former = {placed.item.identifier: placed for placed in self._placed}
        placed_now = []
        for item in objects:
            placed = known.get(item)
            if placed is None and item.identifier in former:
                placed = former[item.identifier].moved(item)
            placed_now.append(placed or PlacedObject(item, light, sky))
        self._placed = placed_now
        self._middles = np.array([placed.middle for placed in self._placed]).reshape(-1, 3)
        self._radii = np.array([placed.radius_m for placed in self._placed])
        self._shadows = Shadows(self._placed)

    def render(
        self,
        position_ned_m: Sequence[float],
        ned_from_body: NDArray[np.float64],
        mount: CameraMount | None = None,
        motion: CameraMotion = _STILL,
    ) -> Rendered:
        """The frame seen when the body is at `position_ned_m` (3,) with attitude `ned_from_body` (3, 3).

        Args:
            mount: the current one of a camera on a gimbal; by default the renderer's.
            motion: of the camera; only a camera with a shutter shows it.
        """
        view = self.view(position_ned_m, ned_from_body, mount)
        buffers, world = self._buffers, self.world
        inverse_depth = np.empty((view.height, view.width), np.float32)
        image = draw_ground(world, view, buffers, inverse_depth)
        self._shadows.cast(view, world.light.shadow, image)
        seen = within_view(self._placed, self._middles, self._radii, view, self._draw_within_m)
        painted = paint_objects(seen, view, image, inverse_depth)
        add_haze(world.sky, inverse_depth, buffers, image)
        draw_sky(world.sky, world.light, view, inverse_depth, image)
        _soften_edges(image, painted)
        labels = painted.labels
        numbered = [(*item, number) for number, item in enumerate(painted.objects, start=1)]
        objects: list[VisibleObject | None]
        if self._lens is None:
            objects = [
                _visible(placed, sighting, number, labels, view) for placed, sighting, number in numbered
            ]
        else:
            image, inverse_depth, exposed, inside = self._lens.expose(image, inverse_depth, labels, motion)
            found = _found(exposed)
            objects = [
                _visible_through_lens(placed, sighting, number, labels, found, inside, view)
                for placed, sighting, number in numbered
            ]
        if self._sensor is not None:
            image = self._sensor.expose(image, self._rng)
        with np.errstate(divide="ignore"):
            depth_m = np.divide(np.float32(1.0), inverse_depth, out=inverse_depth)
        np.copyto(depth_m, np.nan, where=np.isinf(depth_m))
        return Rendered(image, depth_m, [item for item in objects if item is not None], view.eye)

    def view(
        self,
        position_ned_m: Sequence[float],
        ned_from_body: NDArray[np.float64],
        mount: CameraMount | None = None,
    ) -> View:
        """The camera's pose for a body's pose, with matrices between the drawn image's pixels and NED."""
        mount = mount or self.mount
        ned_from_optical = mount.ned_from_optical(ned_from_body)
        eye = np.asarray(position_ned_m, np.float64) + ned_from_body @ mount.position_frd_m
        eye[2] = min(eye[2], -LOWEST_EYE_M)
        matrix = self._drawn.matrix
        return View(
            eye=eye,
            ned_from_pixel=ned_from_optical @ np.linalg.inv(matrix),
            pixel_from_ned=matrix @ ned_from_optical.T,
            focal_px=(self._drawn.fx + self._drawn.fy) / 2,
            width=self._drawn.width,
            height=self._drawn.height,
        )


def _soften_edges(image: Image, painted: Painted) -> None:
    """Antialias: blend pixels along the edges of faces with their neighbours."""
    if not painted.objects:
        return
    part, label = image[painted.part], painted.labels[painted.part]
    across = label[:, 1:] != label[:, :-1]
    along = label[1:] != label[:-1]
    edge = np.zeros(label.shape, np.bool_)
    edge[:, 1:] |= across
    edge[:, :-1] |= across
    edge[1:] |= along
    edge[:-1] |= along
    blurred = cv2.GaussianBlur(part, (3, 3), 0.6)
    cv2.copyTo(blurred, edge.view(np.uint8), part)


def _visible(
    placed: PlacedObject, sighting: Sighting, number: int, labels: NDArray[np.int32], view: View
) -> VisibleObject | None:
    box = labels[sighting.top : sighting.bottom, sighting.left : sighting.right]
    own = (box >> FACE_BITS) == number
    columns, rows = np.flatnonzero(own.any(axis=0)), np.flatnonzero(own.any(axis=1))
    if not len(columns):
        return None
    count = int(np.count_nonzero(own))
    xyxy = (
        float(sighting.left + columns[0]),
        float(sighting.top + rows[0]),
        float(sighting.left + columns[-1] + 1),
        float(sighting.top + rows[-1] + 1),
    )
    fraction = count / len(sighting.pixels) * sighting.inside_share
    return VisibleObject(
        placed.item, xyxy, min(1.0, fraction), count, range_to(placed.item, (view.eye[0], view.eye[1]))
    )


def _found(exposed: NDArray[np.int32]) -> _Found:
    """The pixels of an exposed image with an object."""
    where = np.flatnonzero(exposed != 0)
    rows, columns = np.divmod(where, exposed.shape[1])
    return _Found(exposed.reshape(-1)[where] >> FACE_BITS, columns, rows)


def _visible_through_lens(
    placed: PlacedObject,
    sighting: Sighting,
    number: int,
    labels: NDArray[np.int32],
    found: _Found,
    inside: NDArray[np.bool_],
    view: View,
) -> VisibleObject | None:
    """The box in the exposed image; the fraction in the drawn one, where all pixels have the same size."""
    own = found.numbers == number
    columns, rows = found.columns[own], found.rows[own]
    if not len(rows):
        return None
    xyxy = (float(columns.min()), float(rows[0]), float(columns.max() + 1), float(rows[-1] + 1))
    drawn = (slice(sighting.top, sighting.bottom), slice(sighting.left, sighting.right))
    seen = ((labels[drawn] >> FACE_BITS) == number) & inside[drawn]
    fraction = float(np.count_nonzero(seen)) / len(sighting.pixels) * sighting.inside_share
    range_m = range_to(placed.item, (view.eye[0], view.eye[1]))
    return VisibleObject(placed.item, xyxy, min(1.0, fraction), len(rows), range_m)
