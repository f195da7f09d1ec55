"""Draws detections onto an image."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.camera_model import CameraModel
from vision.depth import centre_depth
from vision.detections import NO_TRACK, Detections
from vision.frame import Frame
from vision.labels import Rectangle, place_label
from vision.levelling import Levelling
from vision.markers import Marker

_FONT = cv2.FONT_HERSHEY_SIMPLEX
_GOLDEN_RATIO = 0.618033988749895
_DARK = (24, 22, 20)
_LIGHT = (250, 250, 250)
_AXIS_COLOURS = ((40, 40, 230), (60, 200, 60), (230, 120, 40))
_SHIFT = 4
_RED = (0, 0, 255)

NOT_LEVEL = "not level: no attitude at the capture"

Colour = tuple[int, int, int]


@dataclass(frozen=True, slots=True)
class _Sizes:
    """Dimensions of the drawing, in pixels, scaled by the image's size: 1 at 640x480."""

    line: int
    font_scale: float
    stroke: int
    padding: int

    @classmethod
    def of(cls, width: int, height: int) -> _Sizes:
        scale = max((width * height / (640 * 480)) ** 0.5, 0.3)
        return cls(
            max(1, round(2 * scale)), max(0.3, 0.47 * scale), max(1, round(scale)), max(2, round(4 * scale))
        )


def annotate_level(
    frame: Frame,
    detections: Detections,
    level: Levelling | None,
    *,
    lines: Sequence[str] = (),
    highlight: int | None = None,
) -> NDArray[np.uint8]:
    """Draw on a frame's image, with the depth at its centre, and level it before the lines are written.

    Without an attitude at its capture the image stays as it is, and a line says so.
    """
    centre_m = None if frame.depth_m is None else centre_depth(frame.depth_m)
    if level is None:
        return annotate(frame.image, detections, lines=lines, highlight=highlight, centre_m=centre_m)
    drawn = annotate(frame.image, detections, highlight=highlight, centre_m=centre_m)
    levelled = level(frame, drawn)
    if levelled is None:
        levelled, lines = drawn, (*lines, NOT_LEVEL)
    return annotate(levelled, Detections.empty(()), lines=lines)


def class_colour(class_id: int) -> Colour:
    """Colour of a class, BGR: distinct hues for neighbouring ids, visible on any background."""
    hue = (0.33 + class_id * _GOLDEN_RATIO) % 1.0
    saturation = (0.80, 0.60, 0.95)[class_id % 3]
    red, green, blue = colorsys.hsv_to_rgb(hue, saturation, 1.0)
    return round(blue * 255), round(green * 255), round(red * 255)


def annotate(
    image: NDArray[np.uint8],
    detections: Detections,
    *,
    lines: Sequence[str] = (),
    highlight: int | None = None,
    centre_m: float | None = None,
    faint_below: float = 0.0,
) -> NDArray[np.uint8]:
    """A copy of the image with boxes, labels and a panel of text.

    Args:
        image: (height, width, 3) uint8, BGR. Lines and letters scale with its size.
        detections: each gets a box in its class's colour and a label: name, track and range where known,
            confidence. A label covers no other one; where there is no space for it, it is left out.
        lines: text for a panel at the top left.
        highlight: index of the detection to highlight: drawn last, tinted, with bracketed corners.
        centre_m: depth at the image's centre, metres, drawn beside a red point there; NaN: unknown; None: no
            point.
        faint_below: boxes and labels of a lower confidence are drawn half transparent.

    Returns:
        (height, width, 3) uint8, BGR.

    Raises:
        IndexError: `highlight` is not one of the detections.
    """
    if highlight is not None and not 0 <= highlight < len(detections):
        raise IndexError(f"highlight must be 0..{len(detections) - 1}, got {highlight}")
    drawn = image.copy()
    height, width = drawn.shape[:2]
    sizes = _Sizes.of(width, height)
    # The most confident last, on top; the highlighted one on top of all.
    order = sorted(range(len(detections)), key=lambda index: float(detections.confidence[index]))
    if highlight is not None:
        order.remove(highlight)
        order.append(highlight)
    boxes = {index: _pixels(detections.xyxy[index], width, height) for index in order}
    occupied: list[Rectangle] = []

    def draw_boxes(indices: Sequence[int]) -> None:
        for index in indices:
            colour = class_colour(int(detections.class_id[index]))
            _draw_box(drawn, boxes[index], colour, sizes, marked=index == highlight)

    def draw_labels(indices: Sequence[int]) -> None:
        for index in reversed(indices):  # the most confident choose their label's position first
            _draw_label(drawn, boxes[index], detections, index, sizes, occupied)

    def draw_texts(image: NDArray[np.uint8]) -> list[Rectangle]:
        panel = [_draw_panel(image, lines, sizes)] if lines else []
        return panel if centre_m is None else [*panel, _draw_centre(image, centre_m, sizes)]

    faint = [index for index in order if float(detections.confidence[index]) < faint_below]
    if faint:
        occupied += draw_texts(drawn.copy())  # they come on top
        draw_boxes(faint)
        draw_labels(faint)
        cv2.addWeighted(image, 0.5, drawn, 0.5, 0.0, dst=drawn)
    strong = [index for index in order if index not in faint]
    draw_boxes(strong)
    occupied += draw_texts(drawn)
    draw_labels(strong)
    return drawn


def annotate_markers(
    image: NDArray[np.uint8], markers: Sequence[Marker], camera: CameraModel
) -> NDArray[np.uint8]:
    """A copy of the image with each marker's outline, axes (right red, upper edge green, out blue) and range.

    Args:
        image: (height, width, 3) uint8, BGR.
    """
    drawn = image.copy()
    sizes = _Sizes.of(drawn.shape[1], drawn.shape[0])
    occupied: list[Rectangle] = []
    for marker in markers:
        outline = _subpixels(marker.corners_px)
        cv2.polylines(drawn, [outline], True, _LIGHT, sizes.line, cv2.LINE_AA, _SHIFT)
        ends = marker.position_camera_m + np.vstack([np.zeros(3), marker.rotation.T * marker.size_m / 2])
        seen = camera.project(ends)
        centre, *tips = _subpixels(np.nan_to_num(seen))
        for tip, colour in zip(tips, _AXIS_COLOURS, strict=True):
            if np.isfinite(seen).all():  # else one is beyond the lens's fold
                cv2.line(drawn, centre, tip, colour, sizes.line, cv2.LINE_AA, _SHIFT)
        text = f"{marker.identifier}  {float(np.linalg.norm(marker.position_camera_m)):.2f} m"
        (width, height), baseline = cv2.getTextSize(text, _FONT, sizes.font_scale, sizes.stroke)
        outlined = np.array([marker.corners_px.min(axis=0), marker.corners_px.max(axis=0)], np.float32)
        box = _pixels(outlined.reshape(4), drawn.shape[1], drawn.shape[0])
        size = width + 2 * sizes.padding, height + baseline + sizes.padding
        place = place_label(box, size, (drawn.shape[1], drawn.shape[0]), occupied)
        if place is None:
            continue
        occupied.append(place)
        left, top, right, bottom = place
        cv2.rectangle(drawn, (left, top), (right, bottom), _DARK, cv2.FILLED)
        at = (left + sizes.padding, top + sizes.padding // 2 + height)
        cv2.putText(drawn, text, at, _FONT, sizes.font_scale, _LIGHT, sizes.stroke, cv2.LINE_AA)
    return drawn


def _subpixels(points: NDArray[np.float64]) -> NDArray[np.int32]:
    """Fixed-point coordinates for OpenCV's drawing, with `_SHIFT` fractional bits."""
    return np.round(points * (1 << _SHIFT)).astype(np.int32)


def _pixels(xyxy: NDArray[np.float32], width: int, height: int) -> Rectangle:
    limits = np.array([width - 1, height - 1, width - 1, height - 1], np.float32)
    left, top, right, bottom = np.clip(np.rint(xyxy), 0, limits).astype(int).tolist()
    return left, top, right, bottom


def _draw_box(
    image: NDArray[np.uint8], box: Rectangle, colour: Colour, sizes: _Sizes, *, marked: bool
) -> None:
    left, top, right, bottom = box
    if marked:
        _blend(image, box, colour, 0.18)
    # A dark outline keeps a bright box visible on a bright background.
    cv2.rectangle(image, (left, top), (right, bottom), _DARK, sizes.line + 2, cv2.LINE_AA)
    cv2.rectangle(image, (left, top), (right, bottom), colour, sizes.line, cv2.LINE_AA)
    if marked:
        _draw_corners(image, box, sizes)


def _draw_corners(image: NDArray[np.uint8], box: Rectangle, sizes: _Sizes) -> None:
    left, top, right, bottom = box
    gap = sizes.line * 2
    reach = max(gap * 2, min(right - left, bottom - top) // 4)
    for x, y, across, down in (
        (left - gap, top - gap, 1, 1),
        (right + gap, top - gap, -1, 1),
        (left - gap, bottom + gap, 1, -1),
        (right + gap, bottom + gap, -1, -1),
    ):
        bracket = np.array([[x, y + down * reach], [x, y], [x + across * reach, y]], np.int32)
        cv2.polylines(image, [bracket], False, _DARK, sizes.line + 2, cv2.LINE_AA)
        cv2.polylines(image, [bracket], False, _LIGHT, sizes.line, cv2.LINE_AA)


def _draw_label(
    image: NDArray[np.uint8],
    box: Rectangle,
    detections: Detections,
    index: int,
    sizes: _Sizes,
    occupied: list[Rectangle],
) -> None:
    """Draw a label where there is space, and note its place in `occupied`."""
    class_id = int(detections.class_id[index])
    text = f"{detections.class_names[class_id]}{_identity(detections, index)} "
    text += f"{float(detections.confidence[index]):.2f}"
    depth_m = float(detections.depth_m[index])
    if not np.isnan(depth_m):
        text += f"  depth {depth_m:.1f} m"
    (text_width, text_height), baseline = cv2.getTextSize(text, _FONT, sizes.font_scale, sizes.stroke)
    size = text_width + 2 * sizes.padding, text_height + baseline + sizes.padding
    label = place_label(box, size, (image.shape[1], image.shape[0]), occupied)
    if label is None:
        return
    occupied.append(label)
    colour = class_colour(class_id)
    left, top, right, bottom = label
    cv2.rectangle(image, (left, top), (right - 1, bottom - 1), colour, cv2.FILLED)
    at = (left + sizes.padding, top + sizes.padding // 2 + text_height)
    cv2.putText(image, text, at, _FONT, sizes.font_scale, _ink_on(colour), sizes.stroke, cv2.LINE_AA)


def _identity(detections: Detections, index: int) -> str:
    """` #7`; ` #7?` while the track is not confirmed; empty without a track."""
    if detections.track_id is None or detections.track_id[index] == NO_TRACK:
        return ""
    confirmed = detections.track_confirmed is not None and bool(detections.track_confirmed[index])
    return f" #{int(detections.track_id[index])}{'' if confirmed else '?'}"


def _draw_panel(image: NDArray[np.uint8], lines: Sequence[str], sizes: _Sizes) -> Rectangle:
    height, width = image.shape[:2]
    scale = sizes.font_scale
    margin, inside = 2 * sizes.padding, 2 * sizes.padding
    widest = max(cv2.getTextSize(line, _FONT, scale, sizes.stroke)[0][0] for line in lines)
    available = width - 2 * margin - 2 * inside
    if widest > available > 0:  # a long line is scaled down, not cut
        scale *= available / widest
        widest = available
    (_, text_height), baseline = cv2.getTextSize("Ag", _FONT, scale, sizes.stroke)
    pitch = text_height + baseline + sizes.padding
    panel = (
        margin,
        margin,
        min(margin + widest + 2 * inside, width),
        min(margin + len(lines) * pitch + 2 * inside - sizes.padding, height),
    )
    _blend(image, panel, _DARK, 0.62)
    for row, line in enumerate(lines):
        at = (margin + inside, margin + inside + row * pitch + text_height)
        cv2.putText(image, line, at, _FONT, scale, _LIGHT, sizes.stroke, cv2.LINE_AA)
    return panel


def _draw_centre(image: NDArray[np.uint8], centre_m: float, sizes: _Sizes) -> Rectangle:
    height, width = image.shape[:2]
    x, y = width // 2, height // 2
    radius = 2 * sizes.line
    cv2.circle(image, (x, y), radius + 1, _LIGHT, cv2.FILLED, cv2.LINE_AA)
    cv2.circle(image, (x, y), radius, _RED, cv2.FILLED, cv2.LINE_AA)
    text = "no depth" if np.isnan(centre_m) else f"{centre_m:.2f} m"
    (text_width, text_height), baseline = cv2.getTextSize(text, _FONT, sizes.font_scale, sizes.stroke)
    left, bottom = x + 2 * radius, y + text_height // 2
    panel = (
        left,
        bottom - text_height - sizes.padding,
        left + text_width + 2 * sizes.padding,
        bottom + baseline,
    )
    _blend(image, panel, _DARK, 0.62)
    at = (left + sizes.padding, bottom)
    cv2.putText(image, text, at, _FONT, sizes.font_scale, _LIGHT, sizes.stroke, cv2.LINE_AA)
    return x - radius, panel[1], panel[2], panel[3]


def _blend(image: NDArray[np.uint8], area: Rectangle, colour: Colour, opacity: float) -> None:
    left, top, right, bottom = area
    part = image[top:bottom, left:right]
    if part.size:
        part[:] = cv2.addWeighted(part, 1.0 - opacity, np.full_like(part, colour), opacity, 0.0)


def _ink_on(colour: Colour) -> Colour:
    blue, green, red = colour
    return _DARK if 0.114 * blue + 0.587 * green + 0.299 * red > 110 else _LIGHT
