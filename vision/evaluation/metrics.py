"""Average precision by COCO's rules (101 recall points, IoU 0.50 to 0.95).

Implemented here because it is a hundred lines of numpy that training always needs; the tests compare it with
`pycocotools`, COCO's reference, where that is installed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from vision.tracking.association import overlaps

IOU_THRESHOLDS: NDArray[np.float64] = np.linspace(0.5, 0.95, 10)
# k / 100 rounds like a recall of found / objects; multiples of a step would differ in the last bit.
RECALL_POINTS = np.arange(101) / 100
DETECTIONS_PER_IMAGE = 100
WRONG, RIGHT, NEITHER = 0, 1, 2
"""Verdict on a detection: matches no object, matches one, or lies in an ignored region."""


@dataclass(frozen=True, slots=True, eq=False)
class ImageResult:
    """Detections and ground truth of one image. Boxes (N, 4) pixels xyxy, other arrays (N,).

    `ignored` marks ground truth that need not be detected (COCO's crowds); empty: none.
    """

    boxes: NDArray[np.float32]
    confidences: NDArray[np.float32]
    class_ids: NDArray[np.int64]
    true_boxes: NDArray[np.float32]
    true_class_ids: NDArray[np.int64]
    ignored: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, np.bool_))

    def __post_init__(self) -> None:
        if self.ignored.shape == (0,):
            object.__setattr__(self, "ignored", np.zeros(len(self.true_class_ids), np.bool_))


@dataclass(frozen=True, slots=True)
class ClassScore:
    """Average precision of one class: at IoU 0.50, the mean over 0.50:0.95, and the number of objects.

    Both are NaN if there is no object of the class.
    """

    ap50: float
    ap50_95: float
    objects: int


@dataclass(frozen=True, slots=True)
class Score:
    """Means over the classes that occur, each class's score by name, and the number of images."""

    map50: float
    map50_95: float
    per_class: Mapping[str, ClassScore]
    images: int


@dataclass(frozen=True, slots=True)
class OperatingPoint:
    """One class at one confidence and IoU 0.50: true positives, false positives and objects.

    `precision` is NaN without detections, `recall` without objects.
    """

    right: int
    wrong: int
    objects: int

    @property
    def precision(self) -> float:
        return self.right / (self.right + self.wrong) if self.right + self.wrong else float("nan")

    @property
    def recall(self) -> float:
        return self.right / self.objects if self.objects else float("nan")


def score_detections(results: Sequence[ImageResult], class_names: Sequence[str]) -> Score:
    """Mean average precision over images.

    Within a class, detections are processed by descending confidence over all images; each is matched with
    the unmatched object of its image that it overlaps most, and is right if that IoU reaches the threshold.
    At most 100 detections of a class count per image. An unmatched detection in an ignored region is neither
    right nor wrong.

    Raises:
        ValueError: a class id is outside `class_names`.
    """
    for result in results:
        ids = np.concatenate([result.class_ids, result.true_class_ids])
        if len(ids) and not (0 <= ids.min() and ids.max() < len(class_names)):
            raise ValueError(f"class ids must be 0..{len(class_names) - 1}, got {ids.min()}..{ids.max()}")
    per_class = {name: _score_class(results, class_id) for class_id, name in enumerate(class_names)}
    seen = [score for score in per_class.values() if score.objects]
    return Score(
        float(np.mean([score.ap50 for score in seen])) if seen else float("nan"),
        float(np.mean([score.ap50_95 for score in seen])) if seen else float("nan"),
        per_class,
        len(results),
    )


def judge(result: ImageResult, confidence: float) -> NDArray[np.int8]:
    """(N,) verdict on each detection of an image at IoU 0.50; NEITHER below `confidence`."""
    verdict = np.full(len(result.class_ids), NEITHER, np.int8)
    for class_id in np.unique(result.class_ids).tolist():
        selected = np.flatnonzero((result.class_ids == class_id) & (result.confidences >= confidence))
        selected = selected[np.argsort(-result.confidences[selected], kind="stable")]
        true = result.true_class_ids == class_id
        verdict[selected] = _verdicts(result.boxes[selected], result.true_boxes[true], result.ignored[true])[
            0
        ]
    return verdict


def operating_points(
    results: Sequence[ImageResult], class_names: Sequence[str], confidence: float
) -> dict[str, OperatingPoint]:
    """Class name → operating point of the detections of at least this confidence."""
    verdicts = [judge(result, confidence) for result in results]
    points = {}
    for class_id, name in enumerate(class_names):
        of_class = [v[r.class_ids == class_id] for v, r in zip(verdicts, results, strict=True)]
        right, wrong = (sum(int((v == kind).sum()) for v in of_class) for kind in (RIGHT, WRONG))
        objects = sum(int(((r.true_class_ids == class_id) & ~r.ignored).sum()) for r in results)
        points[name] = OperatingPoint(right, wrong, objects)
    return points


def average_precision(confidences: NDArray[np.float32], right: NDArray[np.bool_], objects: int) -> float:
    """Area under the interpolated precision–recall curve, sampled at 101 recalls.

    Args:
        confidences: (N,) of all detections of the class.
        right: (N,) whether each matches an object.
        objects: number of objects, at least 1.

    Raises:
        ValueError: there are no objects, so the precision is undefined.
    """
    if objects < 1:
        raise ValueError(f"average precision needs at least one true object, got {objects}")
    if not len(confidences):
        return 0.0
    order = np.argsort(-confidences, kind="stable")
    found = np.cumsum(right[order])
    recall = found / objects
    precision = found / np.arange(1, len(found) + 1)
    # The best precision at this recall or beyond.
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    at = np.searchsorted(recall, RECALL_POINTS, side="left")
    reached = at < len(envelope)
    return float(np.where(reached, envelope[np.minimum(at, len(envelope) - 1)], 0.0).mean())


def _score_class(results: Sequence[ImageResult], class_id: int) -> ClassScore:
    confidences: list[NDArray[np.float32]] = []
    verdicts: list[NDArray[np.int8]] = []
    objects = 0
    for result in results:
        selected, true = result.class_ids == class_id, result.true_class_ids == class_id
        objects += int((true & ~result.ignored).sum())
        if not selected.any():
            continue
        boxes, confidence = result.boxes[selected], result.confidences[selected]
        counted = np.argsort(-confidence, kind="stable")[:DETECTIONS_PER_IMAGE]
        confidences.append(confidence[counted])
        verdicts.append(_verdicts(boxes[counted], result.true_boxes[true], result.ignored[true]))
    if not objects:
        return ClassScore(float("nan"), float("nan"), 0)
    if not confidences:
        return ClassScore(0.0, 0.0, objects)
    confidence, verdict = np.concatenate(confidences), np.concatenate(verdicts, axis=1)
    precisions = [
        average_precision(confidence[row != NEITHER], row[row != NEITHER] == RIGHT, objects)
        for row in verdict
    ]
    return ClassScore(precisions[0], float(np.mean(precisions)), objects)


def _verdicts(
    boxes: NDArray[np.float32], true_boxes: NDArray[np.float32], ignored: NDArray[np.bool_]
) -> NDArray[np.int8]:
    """(thresholds, N): the verdicts on one image's detections of a class at each IoU threshold.

    `boxes` are sorted by descending confidence.
    """
    verdict = np.full((len(IOU_THRESHOLDS), len(boxes)), WRONG, np.int8)
    if not len(true_boxes):
        return verdict
    overlap = overlaps(boxes, true_boxes[~ignored])
    inside = _share_inside(boxes, true_boxes[ignored]).max(axis=1, initial=0.0)
    for row, threshold in enumerate(IOU_THRESHOLDS):
        free = np.ones(overlap.shape[1], np.bool_)
        for index in range(len(boxes)):
            best = int(np.where(free, overlap[index], -1.0).argmax()) if len(free) else -1
            if best >= 0 and free[best] and overlap[index, best] >= threshold:
                verdict[row, index] = RIGHT
                free[best] = False
            elif inside[index] >= threshold:
                verdict[row, index] = NEITHER
    return verdict


def _share_inside(boxes: NDArray[np.float32], regions: NDArray[np.float32]) -> NDArray[np.float64]:
    """(N, 4) and (M, 4) → (N, M): share of each box inside each region."""
    a, b = boxes.astype(np.float64)[:, None], regions.astype(np.float64)[None]
    inner = np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2])
    area = (a[..., 2:] - a[..., :2]).prod(-1)
    share: NDArray[np.float64] = np.clip(inner, 0, None).prod(-1) / np.maximum(area, 1e-12)
    return share
