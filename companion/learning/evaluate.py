"""`companion learn evaluate`: score a detector on a labelled data set, per class, with its worst misses."""

from __future__ import annotations

import logging
import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from vision.class_names import fold_name
from vision.detections import Detections
from vision.detector import DEFAULT_MODEL, model_path
from vision.evaluation.datasets import Dataset, DatasetError, read_image
from vision.evaluation.metrics import ImageResult, Score, score_detections
from vision.evaluation.misses import WorstMisses
from vision.pipeline import FrameDetector
from vision.runtimes.base import Precision
from vision.runtimes.exported import kind_of
from vision.runtimes.source import read_source

logger = logging.getLogger(__name__)
_LINE_EVERY = 100

# Low enough for the whole precision-recall curve, as in COCO's evaluation.
JUDGED_CONFIDENCE = 0.001


@dataclass(frozen=True, slots=True)
class ClassMapping:
    """Mapping between the classes of the model and of the data set.

    Attributes:
        names: the evaluated classes, by the data set's names.
        of_model: (classes of the model,) int64, index in `names`, -1: not evaluated.
        of_dataset: (classes of the data set,) int64, index in `names`, -1: unknown to the model.
        unknown: names of the data set's classes that are unknown to the model.
    """

    names: tuple[str, ...]
    of_model: NDArray[np.int64]
    of_dataset: NDArray[np.int64]
    unknown: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Evaluation:
    """Result: the score over the evaluated classes, the number of other objects, and the worst misses.

    `results` has each image's detections and true objects, with class ids as in `mapping.names`.
    """

    score: Score
    mapping: ClassMapping
    unjudged_objects: int
    seconds: float
    misses: WorstMisses
    results: tuple[ImageResult, ...]

    def plain(self) -> dict[str, Any]:
        """Return plain values for JSON; NaN (a class without objects) is null."""
        return {
            "map50": _number(self.score.map50),
            "map50_95": _number(self.score.map50_95),
            "images": self.score.images,
            "per_class": {
                name: {"ap50": _number(one.ap50), "ap50_95": _number(one.ap50_95), "objects": one.objects}
                for name, one in self.score.per_class.items()
            },
            "unknown_to_the_model": list(self.mapping.unknown),
            "unjudged_objects": self.unjudged_objects,
            "missed_at_0.25": self.misses.counts["missed"],
            "imagined_at_0.25": self.misses.counts["imagined"],
            "seconds": round(self.seconds, 2),
        }


def usual_precision(model: str) -> Precision:
    """float32, so that figures can be compared; `auto` for an exported file of a fixed precision."""
    path = model_path(model)
    if model == DEFAULT_MODEL or kind_of(path) is None:
        return "float32"
    return "auto" if read_source(path).fixed_precision else "float32"


def map_classes(model_names: Sequence[str], dataset: Dataset) -> ClassMapping:
    """Match classes by name, ignoring case, spaces, `_` and `-`; by id without names.

    Raises:
        DatasetError: no common class, or an id that the model does not have.
    """
    if dataset.class_names is None:
        count = len(model_names)
        for sample in dataset.samples:
            if len(sample.class_ids) and sample.class_ids.max() >= count:
                raise DatasetError(
                    f"{sample.image}: class id {sample.class_ids.max()}, expected 0..{count - 1}; "
                    "add a data.yaml with names to match the classes by name"
                )
        same = np.arange(count)
        return ClassMapping(tuple(model_names), same, same, ())
    known: dict[str, list[int]] = {}
    for index, name in enumerate(model_names):
        known.setdefault(fold_name(name), []).append(index)
    of_model = np.full(len(model_names), -1)
    of_dataset = np.full(len(dataset.class_names), -1)
    names: list[str] = []
    for index, name in enumerate(dataset.class_names):
        indices = known.get(fold_name(name))
        if indices is None:
            continue
        if of_model[indices[0]] < 0:
            of_model[indices] = len(names)
            names.append(name)
        of_dataset[index] = of_model[indices[0]]
    if not names:
        raise DatasetError(
            f"{dataset.root}: no class in common with the model: found {_few(dataset.class_names)}; "
            f"expected some of {_few(model_names)}"
        )
    unknown = [name for index, name in enumerate(dataset.class_names) if of_dataset[index] < 0]
    return ClassMapping(tuple(names), of_model, of_dataset, tuple(unknown))


def evaluate_dataset(dataset: Dataset, detector: FrameDetector, mapping: ClassMapping) -> Evaluation:
    """Detect in every image and score; the detector's threshold should be `JUDGED_CONFIDENCE`."""
    results: list[ImageResult] = []
    misses = WorstMisses()
    unjudged = 0
    started = time.monotonic()
    with _progress(len(dataset.samples)) as advance:
        for sample in dataset.samples:
            image = read_image(sample.image)
            found = _evaluated(detector.detect(image), mapping)
            true_ids = mapping.of_dataset[sample.class_ids]
            known = true_ids >= 0
            unjudged += int((~known).sum())
            boxes = sample.boxes_in(image.shape[1], image.shape[0])[known]
            true_ids, ignored = true_ids[known], sample.ignored[known]
            results.append(
                ImageResult(found.xyxy, found.confidence, found.class_id, boxes, true_ids, ignored)
            )
            misses.add(sample.image, image, found, boxes, true_ids, ignored)
            advance()
    score = score_detections(results, mapping.names)
    return Evaluation(score, mapping, unjudged, time.monotonic() - started, misses, tuple(results))


def report_lines(evaluation: Evaluation) -> list[str]:
    """Return the table as text: every class that occurs, the best first."""
    score = evaluation.score
    present = {name: one for name, one in score.per_class.items() if one.objects}
    width = max([len("all"), *map(len, present)])
    lines = [f"{'class':<{width}}  objects  mAP50  mAP50-95"]
    for name, one in sorted(present.items(), key=lambda item: -item[1].ap50_95):
        lines.append(f"{name:<{width}}  {one.objects:7d}  {one.ap50:5.3f}  {one.ap50_95:8.3f}")
    objects = sum(one.objects for one in present.values())
    lines.append(f"{'all':<{width}}  {objects:7d}  {score.map50:5.3f}  {score.map50_95:8.3f}")
    lines.append(
        f"{score.images} images in {evaluation.seconds:.1f} s; at confidence 0.25 "
        f"{evaluation.misses.counts['missed']} objects missed, {evaluation.misses.counts['imagined']} "
        "false positives"
    )
    if evaluation.mapping.unknown:
        lines.append(
            f"not evaluated, unknown to the model: {_few(evaluation.mapping.unknown)} "
            f"({evaluation.unjudged_objects} objects)"
        )
    return lines


def write_sheet(evaluation: Evaluation, path: Path) -> bool:
    """Write the image of the worst misses; return False if there are none. Raises `OSError`."""
    sheet = evaluation.misses.sheet()
    if sheet is None:
        return False
    path.parent.mkdir(parents=True, exist_ok=True)
    done, data = cv2.imencode(".png", sheet)
    if not done:
        raise OSError(f"cannot encode {path}")
    path.write_bytes(data.tobytes())
    return True


def _evaluated(found: Detections, mapping: ClassMapping) -> Detections:
    """Return the detections of the evaluated classes, with the data set's names."""
    ids = mapping.of_model[found.class_id]
    kept = ids >= 0
    return Detections(found.xyxy[kept], found.confidence[kept], ids[kept], mapping.names)


def _few(names: Sequence[str], most: int = 8) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _number(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 5)


@contextmanager
def _progress(total: int) -> Iterator[Callable[[], None]]:
    """Show a progress bar on a terminal, else log a line per 100 images."""
    if sys.stderr.isatty():
        columns = (TextColumn("evaluating"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task("evaluating", total=total)
            yield lambda: bar.advance(task)
        return
    done = 0

    def advance() -> None:
        nonlocal done
        done += 1
        if done % _LINE_EVERY == 0 or done == total:
            logger.info("%d of %d images", done, total)

    yield advance
