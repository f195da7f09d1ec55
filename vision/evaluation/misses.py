"""The worst errors of a detector, collected during evaluation and shown on one sheet.

Missed: ground truth objects without a detection of their class, largest first. Imagined: detections without
an object, most confident first.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.detections import Detections
from vision.tracking.association import overlaps

_TILE = 168
_CAPTION = 34
_COLUMNS = 6
_BACKGROUND = (40, 40, 40)
_TEXT = (235, 235, 235)
_COLOURS = {"missed": (80, 200, 255), "imagined": (90, 90, 255)}
Kind = Literal["missed", "imagined"]


@dataclass(frozen=True, slots=True, eq=False)
class Miss:
    """One error with its position, class, severity and image crop.

    Attributes:
        severity: missed: share of the image area; imagined: confidence. Comparable only within a kind.
        box: xyxy in pixels of `image`.
        crop: (168, 168, 3) uint8 BGR, with the box drawn.
    """

    kind: Kind
    severity: float
    image: Path
    class_name: str
    box: tuple[float, float, float, float]
    crop: NDArray[np.uint8]


class WorstMisses:
    """Keeps the worst errors of each kind; memory does not grow with the data set.

    Attributes:
        counts: total number of each kind.
    """

    def __init__(self, keep: int = 18, *, confidence: float = 0.25, iou: float = 0.5) -> None:
        """
        Args:
            keep: number to keep of each kind.
            confidence: detections below it are ignored.
            iou: overlap from which a detection matches an object.
        """
        self._keep = keep
        self._confidence = confidence
        self._iou = iou
        self._heaps: dict[Kind, list[tuple[float, int, Miss]]] = {"missed": [], "imagined": []}
        self.counts: dict[Kind, int] = {"missed": 0, "imagined": 0}

    def add(
        self,
        path: Path,
        image: NDArray[np.uint8],
        found: Detections,
        true_boxes: NDArray[np.float32],
        true_class_ids: NDArray[np.int64],
        ignored: NDArray[np.bool_],
    ) -> None:
        """Compare the detections of one image with its ground truth; class ids of both are those of
        `found.class_names`.
        """
        detected = found[found.confidence >= self._confidence]
        matches = (overlaps(detected.xyxy, true_boxes) >= self._iou) & (
            detected.class_id[:, None] == true_class_ids[None, :]
        )
        height, width = image.shape[:2]
        for index in np.flatnonzero(~matches.any(axis=0) & ~ignored):
            left, top, right, bottom = map(float, true_boxes[index])
            share = (right - left) * (bottom - top) / (width * height)
            self._add(
                "missed", share, path, image, found.class_names[true_class_ids[index]], true_boxes[index]
            )
        for index in np.flatnonzero(~matches.any(axis=1)):
            name = found.class_names[detected.class_id[index]]
            self._add("imagined", float(detected.confidence[index]), path, image, name, detected.xyxy[index])

    def worst(self, kind: Kind) -> list[Miss]:
        """The kept errors, worst first."""
        return [miss for _, _, miss in sorted(self._heaps[kind], reverse=True)]

    def sheet(self) -> NDArray[np.uint8] | None:
        """Both kinds in one image, (H, W, 3) uint8 BGR; None if there is no error."""
        rows: list[NDArray[np.uint8]] = []
        for kind, title in (
            ("missed", "missed, the largest first"),
            ("imagined", "imagined, the most confident first"),
        ):
            shown = self.worst(kind)  # type: ignore[arg-type]
            if shown:
                rows.append(_title(f"{title} ({self.counts[kind]})"))  # type: ignore[index]
                rows += [_row(shown[start : start + _COLUMNS]) for start in range(0, len(shown), _COLUMNS)]
        return np.concatenate(rows) if rows else None

    def _add(
        self,
        kind: Kind,
        severity: float,
        path: Path,
        image: NDArray[np.uint8],
        name: str,
        box: NDArray[np.float32],
    ) -> None:
        self.counts[kind] += 1
        heap = self._heaps[kind]
        if len(heap) >= self._keep and severity <= heap[0][0]:
            return
        left, top, right, bottom = map(float, box)
        crop = _crop(image, box, _COLOURS[kind])
        miss = Miss(kind, severity, path, name, (left, top, right, bottom), crop)
        entry = (severity, -self.counts[kind], miss)
        if len(heap) < self._keep:
            heapq.heappush(heap, entry)
        else:
            heapq.heapreplace(heap, entry)


def _crop(
    image: NDArray[np.uint8], box: NDArray[np.float32], colour: tuple[int, int, int]
) -> NDArray[np.uint8]:
    """A square crop around the box with a margin of 30 % on each side, scaled to a tile."""
    left, top, right, bottom = map(float, box)
    side = max(right - left, bottom - top, 16.0) * 1.6
    scale = _TILE / side
    x0, y0 = (left + right - side) / 2, (top + bottom - side) / 2
    matrix = np.array([[scale, 0, -x0 * scale], [0, scale, -y0 * scale]])
    shrink = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    tile = cv2.warpAffine(
        image, matrix, (_TILE, _TILE), flags=shrink, borderMode=cv2.BORDER_CONSTANT, borderValue=_BACKGROUND
    )
    corners = [round((left - x0) * scale), round((top - y0) * scale)]
    opposite = [round((right - x0) * scale), round((bottom - y0) * scale)]
    cv2.rectangle(tile, corners, opposite, colour, 1)
    return tile.astype(np.uint8, copy=False)


def _row(misses: list[Miss]) -> NDArray[np.uint8]:
    row = np.full((_TILE + _CAPTION, _COLUMNS * _TILE, 3), _BACKGROUND, np.uint8)
    for column, miss in enumerate(misses):
        left = column * _TILE
        row[:_TILE, left : left + _TILE] = miss.crop
        severity = f"{miss.severity:.2f}" if miss.kind == "imagined" else f"{100 * miss.severity:.1f} %"
        _write(row, f"{miss.class_name} {severity}", left + 4, _TILE + 14)
        _write(row, miss.image.name[-26:], left + 4, _TILE + 28)
    return row


def _title(text: str) -> NDArray[np.uint8]:
    row = np.full((_CAPTION, _COLUMNS * _TILE, 3), _BACKGROUND, np.uint8)
    _write(row, text, 6, 22, size=0.6)
    return row


def _write(canvas: NDArray[np.uint8], text: str, x: int, y: int, size: float = 0.38) -> None:
    # The built-in font has only ASCII characters.
    plain = text.encode("ascii", "replace").decode()
    cv2.putText(canvas, plain, (x, y), cv2.FONT_HERSHEY_SIMPLEX, size, _TEXT, 1, cv2.LINE_AA)
