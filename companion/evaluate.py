"""`companion evaluate`: a detector judged on a labelled data set, class by class, its worst misses shown."""

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

from vision.detections import Detections
from vision.evaluation.misses import WorstMisses
from vision.evaluation.samples import Dataset, DatasetError, read_image
from vision.pipeline import FrameDetector
from vision.yolo.metrics import ImageResult, Score, score_detections

logger = logging.getLogger(__name__)
_LINE_EVERY = 100

# So low that the whole curve of precision over recall is judged, as COCO's own judging asks for.
JUDGED_CONFIDENCE = 0.001


@dataclass(frozen=True, slots=True)
class ClassMapping:
    """Which class of the model is which of the data set.

    Attributes:
        names: the judged classes, by the data set's names.
        of_model: (classes of the model,) int64, place in `names`, -1: not judged.
        of_dataset: (classes of the data set,) int64, place in `names`, -1: the model does not know it.
        unknown: names of the data set's classes that the model does not know.
    """

    names: tuple[str, ...]
    of_model: NDArray[np.int64]
    of_dataset: NDArray[np.int64]
    unknown: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Evaluation:
    """What came out: the score over the judged classes, who was not judged, and the mistakes.

    `results` has each image's detections and true objects, numbered as `mapping.names`.
    """

    score: Score
    mapping: ClassMapping
    unjudged_objects: int
    seconds: float
    misses: WorstMisses
    results: tuple[ImageResult, ...]

    def plain(self) -> dict[str, Any]:
        """For JSON: NaN, where a class has no object, is null."""
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


def map_classes(model_names: Sequence[str], dataset: Dataset) -> ClassMapping:
    """Pair the classes by name, whatever the case, spaces, `_` and `-`; by id where the data set has no
    names.

    Raises:
        DatasetError: not one class in common, or an id that the model does not have.
    """
    if dataset.class_names is None:
        count = len(model_names)
        for sample in dataset.samples:
            if len(sample.class_ids) and sample.class_ids.max() >= count:
                raise DatasetError(
                    f"{sample.image}: has the class {sample.class_ids.max()}, the model knows "
                    f"0..{count - 1}; the data set has no names to pair by (a data.yaml would give them)"
                )
        same = np.arange(count)
        return ClassMapping(tuple(model_names), same, same, ())
    known: dict[str, int] = {}
    for index, name in enumerate(model_names):
        known.setdefault(_folded(name), index)
    of_model = np.full(len(model_names), -1)
    of_dataset = np.full(len(dataset.class_names), -1)
    names: list[str] = []
    for index, name in enumerate(dataset.class_names):
        model_index = known.get(_folded(name))
        if model_index is None:
            continue
        if of_model[model_index] < 0:
            of_model[model_index] = len(names)
            names.append(name)
        of_dataset[index] = of_model[model_index]
    if not names:
        raise DatasetError(
            f"{dataset.root}: the model knows none of its classes ({_few(dataset.class_names)}); "
            f"the model's are {_few(model_names)}"
        )
    unknown = [name for index, name in enumerate(dataset.class_names) if of_dataset[index] < 0]
    return ClassMapping(tuple(names), of_model, of_dataset, tuple(unknown))


def evaluate_dataset(dataset: Dataset, detector: FrameDetector, mapping: ClassMapping) -> Evaluation:
    """Detect in every image and judge; the detector's confidence threshold should be `JUDGED_CONFIDENCE`."""
    results: list[ImageResult] = []
    misses = WorstMisses()
    unjudged = 0
    started = time.monotonic()
    with _progress(len(dataset.samples)) as advance:
        for sample in dataset.samples:
            image = read_image(sample.image)
            found = _judged(detector.detect(image), mapping)
            true_ids = mapping.of_dataset[sample.class_ids]
            judged = true_ids >= 0
            unjudged += int((~judged).sum())
            boxes = sample.boxes_in(image.shape[1], image.shape[0])[judged]
            true_ids, ignored = true_ids[judged], sample.ignored[judged]
            results.append(
                ImageResult(found.xyxy, found.confidence, found.class_id, boxes, true_ids, ignored)
            )
            misses.add(sample.image, image, found, boxes, true_ids, ignored)
            advance()
    score = score_detections(results, mapping.names)
    return Evaluation(score, mapping, unjudged, time.monotonic() - started, misses, tuple(results))


def report_lines(evaluation: Evaluation) -> list[str]:
    """The table for a person: every class that occurs, the best first."""
    score = evaluation.score
    seen = {name: one for name, one in score.per_class.items() if one.objects}
    width = max([len("all"), *map(len, seen)])
    lines = [f"{'class':<{width}}  objects  mAP50  mAP50-95"]
    for name, one in sorted(seen.items(), key=lambda item: -item[1].ap50_95):
        lines.append(f"{name:<{width}}  {one.objects:7d}  {one.ap50:5.3f}  {one.ap50_95:8.3f}")
    objects = sum(one.objects for one in seen.values())
    lines.append(f"{'all':<{width}}  {objects:7d}  {score.map50:5.3f}  {score.map50_95:8.3f}")
    lines.append(
        f"{score.images} images in {evaluation.seconds:.1f} s; at confidence 0.25 "
        f"{evaluation.misses.counts['missed']} objects missed, {evaluation.misses.counts['imagined']} "
        "imagined"
    )
    if evaluation.mapping.unknown:
        lines.append(
            f"not judged, as the model does not know them: {_few(evaluation.mapping.unknown)} "
            f"({evaluation.unjudged_objects} objects)"
        )
    return lines


def write_sheet(evaluation: Evaluation, path: Path) -> bool:
    """Write the picture of the worst misses; False if there is none to show. Raises `OSError`."""
    sheet = evaluation.misses.sheet()
    if sheet is None:
        return False
    path.parent.mkdir(parents=True, exist_ok=True)
    done, data = cv2.imencode(".png", sheet)
    if not done:
        raise OSError(f"cannot encode {path}")
    path.write_bytes(data.tobytes())
    return True


def _judged(found: Detections, mapping: ClassMapping) -> Detections:
    """The detections of judged classes, with the data set's names."""
    ids = mapping.of_model[found.class_id]
    kept = ids >= 0
    return Detections(found.xyxy[kept], found.confidence[kept], ids[kept], mapping.names)


def _folded(name: str) -> str:
    return "".join(name.casefold().replace("_", " ").replace("-", " ").split())


def _few(names: Sequence[str], most: int = 8) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


def _number(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 5)


@contextmanager
def _progress(total: int) -> Iterator[Callable[[], None]]:
    """A bar on standard error for a person, a line now and then for a log."""
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
