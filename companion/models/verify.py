"""`companion models show --compare`: an exported model and its source on sample images."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mavlink_sim.datasets.training_scenes import random_scene
from vision.evaluation.datasets import image_files, read_image
from vision.foreign.engines import ForeignRuntime
from vision.letterbox import fit
from vision.runtimes.base import Precision, Runtime, RuntimeUnusableError
from vision.runtimes.exported import KEY
from vision.runtimes.selection import start_runtime
from vision.runtimes.source import ModelSource, read_source
from vision.tracking.association import overlaps
from vision.yolo.checkpoint_pair import weights_sha256
from vision.yolo.level_outputs import LevelOutput
from vision.yolo.postprocess import Boxes, Candidates, boxes_of, decode_ltrb

CONFIDENCE = 0.25
# A box this close to the threshold may be found by only one of them without significance.
_CONFIDENCE_MARGIN = 0.02
_SAMPLE_SIZE = (640, 480)


@dataclass(frozen=True, slots=True)
class Parity:
    """Differences between an exported model and its source.

    Attributes:
        images: number of compared images.
        runtime, precision: of the exported model.
        map_difference: largest absolute difference of the raw maps, logits.
        score_difference: largest difference of a class probability, 0..1.
        box_difference_px: largest difference of a side of a matched box, pixels of the input.
        boxes: number of boxes of the source above confidence 0.25.
        unmatched: number of boxes found by only one of the two, except those close to the threshold.
        same_source: whether the export names this file as its source.
    """

    images: int
    runtime: str
    precision: str
    map_difference: float
    score_difference: float
    box_difference_px: float
    boxes: int
    unmatched: int
    same_source: bool

    def plain(self) -> dict[str, Any]:
        return asdict(self)

    def holds(self, map_tolerance: float, box_tolerance_px: float) -> bool:
        """Return whether the differences are within the tolerances and all boxes match."""
        return (
            self.map_difference <= map_tolerance
            and self.box_difference_px <= box_tolerance_px
            and not self.unmatched
        )


def sample_images(folder: Path | None, count: int) -> Iterator[NDArray[np.uint8]]:
    """Return the first images of a folder, or as many rendered scenes, created lazily.

    Raises:
        ValueError: immediately, for an empty folder.
    """
    if folder is None:
        rng = np.random.default_rng(0)
        return (random_scene(rng, *_SAMPLE_SIZE)[0] for _ in range(count))
    files = image_files(folder)[:count]
    if not files:
        raise ValueError(f"{folder}: contains no images")
    return (read_image(file) for file in files)


def verify(
    source_path: Path,
    exported_path: Path,
    images: Iterable[NDArray[np.uint8]],
    image_size: int = 640,
    *,
    threads: int | None = None,
) -> Parity:
    """Run both on the same images: the source with torch in float32, the export with its runtime.

    Raises:
        CheckpointError, RuntimeUnusableError: one of the two cannot be read or run; checked before the first
            image is created.
    """
    source, exported = read_source(source_path), read_source(exported_path)
    if exported.kind is None:
        raise RuntimeUnusableError(f"{exported_path}: is a checkpoint, expected a file from `models export`")
    if source.kind is not None:
        raise RuntimeUnusableError(f"{source_path}: is an export, expected its checkpoint")
    if exported.facts is None:
        raise RuntimeUnusableError(
            f"{exported_path}: is of another exporter, expected a file from `models export`"
        )
    _check_same_kind(source, exported)
    original = _levels(
        start_runtime(source, "torch", precision="float32", threads=threads, image_size=image_size).runtime
    )
    runner = exported.runners()[0]
    precision: Precision = "auto" if exported.fixed_precision else "float32"
    other = _levels(
        start_runtime(exported, runner, precision=precision, threads=threads, image_size=image_size).runtime
    )
    largest = _Largest()
    for image in images:
        box = fit(image.shape[1], image.shape[0], image_size, stride=max(source.strides))
        pixels = np.ascontiguousarray(box.apply(image)).copy()
        largest.compare(_maps(original, pixels), _maps(other, pixels), original, other)
    return Parity(
        images=largest.images,
        runtime=other.name,
        precision=other.precision,
        map_difference=largest.maps,
        score_difference=largest.scores,
        box_difference_px=largest.boxes_px,
        boxes=largest.boxes,
        unmatched=largest.unmatched,
        same_source=exported.facts.source_sha256 == weights_sha256(source_path),
    )


def parity_lines(parity: Parity, map_tolerance: float, box_tolerance_px: float) -> list[str]:
    """Return the comparison as text lines."""
    lines = [
        f"{parity.images} images, {parity.runtime} in {parity.precision} against torch in float32",
        f"raw maps       differ by at most {parity.map_difference:.2e} (tolerance {map_tolerance:g})",
        f"probabilities  differ by at most {parity.score_difference:.2e}",
        f"boxes          {parity.boxes} found, sides differ by at most {parity.box_difference_px:.3g} px "
        f"(tolerance {box_tolerance_px:g}), {parity.unmatched} found by only one",
    ]
    if not parity.same_source:
        lines.append("note: the export names another source file")
    return lines


def _levels(runtime: Runtime | ForeignRuntime) -> Runtime:
    assert not isinstance(runtime, ForeignRuntime)
    return runtime


def _check_same_kind(source: ModelSource, exported: ModelSource) -> None:
    if source.class_names != exported.class_names or source.strides != exported.strides:
        raise RuntimeUnusableError(
            f"{exported.path}: {len(exported.class_names)} classes at strides {exported.strides} "
            f"(its {KEY}), expected {len(source.class_names)} at {source.strides} as {source.path}"
        )


def _maps(runtime: Runtime, pixels: NDArray[np.uint8]) -> list[LevelOutput]:
    """Run inference and compute the sides of all cells, which a runtime may compute only for candidates."""
    levels = runtime.infer(pixels)
    everywhere = [
        Candidates(np.arange(cells), np.zeros(cells, np.float32), np.zeros(cells, np.int64))
        for cells in (level.classes[0].size for level in levels)
    ]
    sides = decode_ltrb(runtime.head, levels, everywhere)
    return [
        LevelOutput(level.classes.copy(), np.asarray(side).reshape(-1, *level.classes.shape[1:]))
        for level, side in zip(levels, sides, strict=True)
    ]


class _Largest:
    """The largest differences so far."""

    def __init__(self) -> None:
        self.images = self.boxes = self.unmatched = 0
        self.maps = self.scores = self.boxes_px = 0.0

    def compare(
        self, first: Sequence[LevelOutput], second: Sequence[LevelOutput], one: Runtime, other: Runtime
    ) -> None:
        self.images += 1
        for a, b in zip(first, second, strict=True):
            assert a.sides is not None
            assert b.sides is not None
            for expected, found in ((a.sides, b.sides), (a.classes, b.classes)):
                # NaN differs from everything.
                self.maps = max(self.maps, _worst(expected, found))
            self.scores = max(self.scores, _worst(_probability(a.classes), _probability(b.classes)))
        self._compare_boxes(
            boxes_of(one.head, first, confidence=CONFIDENCE),
            boxes_of(other.head, second, confidence=CONFIDENCE),
        )

    def _compare_boxes(self, first: Boxes, second: Boxes) -> None:
        self.boxes += len(first)
        overlap = overlaps(first.xyxy, second.xyxy) * (first.class_id[:, None] == second.class_id[None])
        free = np.ones(len(second), np.bool_)
        for index in range(len(first)):
            best = int(np.where(free, overlap[index], -1).argmax()) if len(second) else -1
            if best >= 0 and free[best] and overlap[index, best] > 0.5:
                free[best] = False
                self.boxes_px = max(self.boxes_px, _worst(first.xyxy[index], second.xyxy[best]))
            elif first.confidence[index] > CONFIDENCE + _CONFIDENCE_MARGIN:
                self.unmatched += 1
        self.unmatched += int((second.confidence[free] > CONFIDENCE + _CONFIDENCE_MARGIN).sum())


def _worst(first: NDArray[Any], second: NDArray[Any]) -> float:
    if first.shape != second.shape or not np.isfinite(second).all():
        return float("inf")
    return float(np.abs(first - second).max(initial=0.0))


def _probability(logits: NDArray[np.float32]) -> NDArray[np.float32]:
    probability: NDArray[np.float32] = 1 / (1 + np.exp(-logits.clip(-60, 60)))
    return probability
