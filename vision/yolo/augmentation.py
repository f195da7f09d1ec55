"""Augmentation of labelled training images: mirror, zoom and shift, colour."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

PADDING_GREY = 114
"""Padding value of the letterbox, so that training includes such borders."""

LabelledImage = tuple[NDArray[np.uint8], NDArray[np.float32], NDArray[np.int64]]
"""Image (height, width, 3) uint8 BGR; boxes (N, 4) float32 pixels xyxy; class ids (N,) int64.

An id ~class (negative) marks an object that is neither to be detected nor background."""


@dataclass(frozen=True, slots=True)
class Augmentation:
    """Limits of the changes. Fractions are of the original value.

    Attributes:
        mirror: probability of a left–right mirror.
        zoom_probability: probability of a zoom with a shift.
        zoom_min: smallest zoom; below 1 the image gets grey borders.
        zoom_max: largest zoom.
        hue: largest shift of the hue, as a fraction of the colour circle.
        saturation: largest relative change of the saturation.
        brightness: largest relative change of the brightness.
        visible_fraction: an object with less than this share inside the image is no longer labelled.
        min_side_px: nor is one whose box has a smaller side than this.
        min_area_px: nor one whose box has a smaller area.
    """

    mirror: float = 0.5
    zoom_probability: float = 0.5
    zoom_min: float = 0.75
    zoom_max: float = 1.4
    hue: float = 0.015
    saturation: float = 0.4
    brightness: float = 0.25
    visible_fraction: float = 0.35
    min_side_px: float = 0.0
    min_area_px: float = 0.0


NO_AUGMENTATION = Augmentation(mirror=0, zoom_probability=0, hue=0, saturation=0, brightness=0)


def augment(
    rng: np.random.Generator,
    scene: LabelledImage,
    limits: Augmentation,
    size: tuple[int, int] | None = None,
) -> LabelledImage:
    """An augmented copy. The same `rng` state gives the same change.

    `size` (width, height) of the copy; None: the scene's. A smaller copy shows the whole scene, letterboxed,
    or a part of it, zoomed up to `zoom_max` times the scene's pixels.
    """
    image, boxes, class_ids = scene
    if rng.random() < limits.mirror:
        image, boxes = mirrored(image, boxes)
    own = (image.shape[1], image.shape[0])
    zoomed = rng.random() < limits.zoom_probability
    if zoomed or size not in (None, own):
        image, boxes, class_ids = _zoomed(rng, image, boxes, class_ids, limits, size or own, zoomed)
    if limits.hue or limits.saturation or limits.brightness:
        image = _recoloured(rng, image, limits)
    return np.ascontiguousarray(image), boxes, class_ids


def mirrored(
    image: NDArray[np.uint8], boxes: NDArray[np.float32]
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Mirror left and right. Box edges are continuous coordinates: 0 is the left edge, width the right."""
    width = image.shape[1]
    mirrored_boxes = boxes.copy()
    mirrored_boxes[:, 0], mirrored_boxes[:, 2] = width - boxes[:, 2], width - boxes[:, 0]
    return image[:, ::-1], mirrored_boxes


def _zoomed(
    rng: np.random.Generator,
    image: NDArray[np.uint8],
    boxes: NDArray[np.float32],
    class_ids: NDArray[np.int64],
    limits: Augmentation,
    size: tuple[int, int],
    zoomed: bool,
) -> LabelledImage:
    whole, window = np.array([image.shape[1], image.shape[0]]), np.array(size)
    zoom = float((window / whole).min())
    shift = (window - zoom * whole) / 2
    if zoomed:
        zoom = float(np.exp(rng.uniform(np.log(zoom * limits.zoom_min), np.log(limits.zoom_max))))
        # Zoomed in, the window is anywhere in the image; zoomed out, the image anywhere in the window.
        shift = rng.random(2) * (window - zoom * whole)
        if len(boxes) and (window < whole).any() and rng.random() < 0.7:
            # Most of a large scene is empty: prefer a window with an object.
            centre = boxes[int(rng.integers(len(boxes)))].reshape(2, 2).mean(axis=0) * zoom
            room = window - zoom * whole
            shift = np.clip(
                rng.uniform(0.1, 0.9, 2) * window - centre, np.minimum(room, 0), np.maximum(room, 0)
            )
    # warpAffine counts from pixel centres, boxes from pixel edges: half a pixel each.
    centre_shift = shift + 0.5 * zoom - 0.5
    matrix = np.array([[zoom, 0, centre_shift[0]], [0, zoom, centre_shift[1]]])
    warped = cv2.warpAffine(
        np.ascontiguousarray(image),
        matrix,
        size,
        flags=cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=(PADDING_GREY, PADDING_GREY, PADDING_GREY),
    )
    moved = boxes * zoom + np.tile(shift, 2)
    clipped = np.clip(moved, 0, np.tile(window, 2)).astype(np.float32)
    area = (moved[:, 2:] - moved[:, :2]).prod(1)
    sides = clipped[:, 2:] - clipped[:, :2]
    visible_area = sides.prod(1)
    cut = visible_area < limits.visible_fraction * np.maximum(area, 1e-9)
    small = (sides.min(1, initial=np.inf) < limits.min_side_px) | (visible_area < limits.min_area_px)
    ids = np.where((cut | small) & (class_ids >= 0), ~class_ids, class_ids)
    shown = visible_area > 0
    return warped.astype(np.uint8, copy=False), clipped[shown], ids[shown]


def _recoloured(
    rng: np.random.Generator, image: NDArray[np.uint8], limits: Augmentation
) -> NDArray[np.uint8]:
    hue, saturation, brightness = rng.uniform(-1, 1, 3) * (limits.hue, limits.saturation, limits.brightness)
    levels = np.arange(256)
    # OpenCV's 8-bit hue is half degrees, 0..179.
    hue_table = ((levels + hue * 180) % 180).astype(np.uint8)
    saturation_table = np.clip(levels * (1 + saturation), 0, 255).astype(np.uint8)
    brightness_table = np.clip(levels * (1 + brightness), 0, 255).astype(np.uint8)
    table = np.stack([hue_table, saturation_table, brightness_table], -1)[None]
    coloured = cv2.LUT(cv2.cvtColor(np.ascontiguousarray(image), cv2.COLOR_BGR2HSV), table)
    return cv2.cvtColor(coloured, cv2.COLOR_HSV2BGR).astype(np.uint8, copy=False)
