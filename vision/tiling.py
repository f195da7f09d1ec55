"""Small objects in large frames: detection in overlapping tiles, and once in the whole frame.

A network's input is 640 pixels wide; a 1920-pixel frame is shrunk threefold for it, and a ten-pixel object
with it. Tiles are not shrunk. Every tile costs as much as a frame (figures: `docs/measurements.md`): use it
at high altitude where latency matters less. Slicing follows SAHI (Akyon et al., 2022, arXiv:2202.06934);
boxes cut by a tile's edge are marked here, so that a whole box is never suppressed by a partial one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vision.detections import Detections
from vision.object_detector import Timing
from vision.pipeline import FrameDetector

# A box nearer than this to an inner edge of its tile counts as cut, pixels.
_CUT_PX = 4.0
# Two boxes of different passes are one object from this overlap on: over the union, or over the smaller one.
_SAME_UNION = 0.5
_SAME_SMALLER = 0.8
# A cut box is a piece of another when this share of it lies inside.
_PIECE = 0.6
_MOST_BOXES = 300


@dataclass(frozen=True, slots=True)
class Tile:
    """A part of the frame, pixels: left, top inclusive; right, bottom exclusive."""

    left: int
    top: int
    right: int
    bottom: int


def tiles_of(width: int, height: int, tile_size: int, overlap: float) -> list[Tile]:
    """Tiles that cover a frame, row by row, evenly spread, overlapping by at least `overlap` of a tile.

    A frame not larger than a tile is one tile.
    """
    return [
        Tile(left, top, min(left + tile_size, width), min(top + tile_size, height))
        for top in _starts(height, tile_size, overlap)
        for left in _starts(width, tile_size, overlap)
    ]


def _starts(length: int, tile_size: int, overlap: float) -> list[int]:
    if length <= tile_size:
        return [0]
    step = tile_size * (1 - overlap)
    count = int(np.ceil((length - tile_size) / step)) + 1
    return [round(index * (length - tile_size) / (count - 1)) for index in range(count)]


class TiledDetector:
    """A detector that runs another one on tiles. Not thread-safe.

    Attributes:
        detector: the detector run on each tile.
        last_timing: of the latest `detect`, all passes together; None before the first.
    """

    def __init__(
        self, detector: FrameDetector, *, tile_size: int = 640, overlap: float = 0.2, whole_frame: bool = True
    ) -> None:
        """
        Args:
            tile_size: side of a tile, pixels of the frame; best the network's input size.
            overlap: of neighbouring tiles, share of a tile; smaller objects are never cut.
            whole_frame: also process the whole frame, for objects larger than a tile.

        Raises:
            ValueError: a number out of range.
        """
        if tile_size < 64:
            raise ValueError(f"tile_size must be at least 64 pixels, got {tile_size}")
        if not 0.0 <= overlap <= 0.8:
            raise ValueError(f"overlap must be in 0..0.8, got {overlap}")
        self.detector = detector
        self._tile_size = tile_size
        self._overlap = overlap
        self._whole_frame = whole_frame
        self.last_timing: Timing | None = None

    @property
    def class_names(self) -> tuple[str, ...]:
        return self.detector.class_names

    def detect(self, image_bgr: NDArray[np.uint8], /) -> Detections:
        """Detect objects in one frame, (height, width, 3) uint8 BGR; boxes in its pixels, most confident
        first.
        """
        height, width = image_bgr.shape[:2]
        tiles = tiles_of(width, height, self._tile_size, self._overlap)
        if len(tiles) == 1:
            found = self.detector.detect(image_bgr)
            self.last_timing = self.detector.last_timing
            return found
        spent = np.zeros(3)
        passes: list[Detections] = []
        cuts: list[NDArray[np.bool_]] = []
        # Tiles first: they have one size, and a detector prepares for a size.
        for tile in tiles:
            found = self._detect_part(image_bgr[tile.top : tile.bottom, tile.left : tile.right], spent)
            cuts.append(_cut(found.xyxy, tile, width, height))
            shifted = found.xyxy + np.array([tile.left, tile.top] * 2, np.float32)
            passes.append(Detections(shifted, found.confidence, found.class_id, found.class_names))
        if self._whole_frame:
            passes.append(self._detect_part(image_bgr, spent))
            cuts.append(np.zeros(len(passes[-1]), np.bool_))
        merged = merge_passes(passes, cuts)
        self.last_timing = Timing(*map(float, spent))
        return merged

    def _detect_part(self, part: NDArray[np.uint8], spent: NDArray[np.float64]) -> Detections:
        found = self.detector.detect(np.ascontiguousarray(part))
        timing = self.detector.last_timing
        if timing is not None:
            spent += (timing.preprocess_ms, timing.inference_ms, timing.postprocess_ms)
        return found


def merge_passes(
    passes: Sequence[Detections], cuts: Sequence[NDArray[np.bool_]], most: int = _MOST_BOXES
) -> Detections:
    """Merge the detections of several passes over one frame.

    Whole boxes come before cut ones, and more confident before less; a box that overlaps an earlier one of
    its class from another pass is dropped. Cut boxes that are pieces of one object on both sides of an edge
    are merged into their bounding box.

    Args:
        passes: each in the frame's pixels, after NMS.
        cuts: for each pass (N,) whether an inner edge cuts the box.
        most: largest number of boxes to keep.
    """
    names = passes[0].class_names
    xyxy = np.concatenate([each.xyxy for each in passes]).astype(np.float64)
    confidence = np.concatenate([each.confidence for each in passes])
    class_id = np.concatenate([each.class_id for each in passes])
    origin = np.repeat(np.arange(len(passes)), [len(each) for each in passes])
    cut = np.concatenate(list(cuts))
    waiting = np.lexsort((-confidence, cut))
    kept: list[int] = []
    while len(waiting):
        first, rest = int(waiting[0]), waiting[1:]
        kept.append(first)
        rivals = (class_id[rest] == class_id[first]) & (origin[rest] != origin[first])
        union, smaller, share = _overlaps(xyxy[first], xyxy[rest])
        same = (union > _SAME_UNION) | np.where(cut[rest], share > _PIECE, smaller > _SAME_SMALLER)
        if cut[first]:  # Then all the rest are cut too, and the merged box may cover more of them.
            pieces = rivals & (smaller > 0) & _continue_each_other(xyxy[first], xyxy[rest])
            around = xyxy[[first, *rest[pieces]]]
            xyxy[first] = (*around[:, :2].min(axis=0), *around[:, 2:].max(axis=0))
            union, _, share = _overlaps(xyxy[first], xyxy[rest])
            same = pieces | (union > _SAME_UNION) | (share > _PIECE)
        waiting = rest[~(rivals & same)]
    best = np.array(kept, np.int64)
    best = best[np.argsort(-confidence[best], kind="stable")][:most]
    return Detections(xyxy[best].astype(np.float32), confidence[best], class_id[best], names)


def _cut(xyxy: NDArray[np.float32], tile: Tile, width: int, height: int) -> NDArray[np.bool_]:
    """(N,) which boxes, in the tile's pixels, touch an edge that is not the frame's."""
    cut = np.zeros(len(xyxy), np.bool_)
    if tile.left > 0:
        cut |= xyxy[:, 0] < _CUT_PX
    if tile.top > 0:
        cut |= xyxy[:, 1] < _CUT_PX
    if tile.right < width:
        cut |= xyxy[:, 2] > tile.right - tile.left - _CUT_PX
    if tile.bottom < height:
        cut |= xyxy[:, 3] > tile.bottom - tile.top - _CUT_PX
    return cut


def _overlaps(
    box: NDArray[np.float64], others: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Overlap of one box with each of (N, 4): over the union, over the smaller, over the other."""
    sides = np.minimum(box[2:], others[:, 2:]) - np.maximum(box[:2], others[:, :2])
    common = sides.clip(0).prod(axis=1)
    area, areas = (box[2:] - box[:2]).prod(), (others[:, 2:] - others[:, :2]).prod(axis=1)
    tiny = 1e-9
    return (
        common / np.maximum(area + areas - common, tiny),
        common / np.maximum(np.minimum(area, areas), tiny),
        common / np.maximum(areas, tiny),
    )


def _continue_each_other(box: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.bool_]:
    """(N,) whether two pieces fit together: along one axis they have the same extent."""
    common = (np.minimum(box[2:], others[:, 2:]) - np.maximum(box[:2], others[:, :2])).clip(0)
    span = np.maximum(box[2:], others[:, 2:]) - np.minimum(box[:2], others[:, :2])
    return np.asarray((common / np.maximum(span, 1e-9) > 0.7).any(axis=1))
