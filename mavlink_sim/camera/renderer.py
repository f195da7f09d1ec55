"""Software rendering of a world: colour, depth, and the visible part of each object.

Ground, then shadows, then objects with a depth buffer, then sky and haze. One call is one frame; no state is
kept between frames, so any pose can be drawn at any time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from mavlink_sim.camera.ground_view import Buffers, View, add_haze, draw_ground, draw_sky
from mavlink_sim.camera.image_effects import ImageEffects, Sensor
from mavlink_sim.camera.lens import CameraMotion, Lens, Shutter
from mavlink_sim.camera.object_painter import Painted, paint_objects
from mavlink_sim.camera.object_view import (
    FACE_BITS,
    PlacedObject,
    Sighting,
    within_view,
)
from mavlink_sim.camera.shadows import Shadows
from mavlink_sim.world.textures import Image, Plane
from mavlink_sim.world.world import World, WorldObject, range_to
from vision.camera_model import CameraModel, CameraMount

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
