"""How good a detector is: average precision after COCO's rules (101 recall points, IoU 0.50 to 0.95)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

IOU_THRESHOLDS: NDArray[np.float64] = np.linspace(0.5, 0.95, 10)
# k / 100 rounds as a recall of found / objects does; multiples of a step would not, and miss by one bit.
RECALL_POINTS = np.arange(101) / 100
DETECTIONS_PER_IMAGE = 100


@dataclass(frozen=True, slots=True, eq=False)
class ImageResult:
    """What was found in one image and what is there. Boxes (N, 4) pixels xyxy, other arrays (N,)."""

    boxes: NDArray[np.float32]
    confidences: NDArray[np.float32]
    class_ids: NDArray[np.int64]
    true_boxes: NDArray[np.float32]
    true_class_ids: NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class ClassScore:
    """Average precision of one class: at IoU 0.50, the mean over 0.50:0.95, and the number of true objects.

    Both are NaN when there is no true object of the class.
    """

    ap50: float
    ap50_95: float
    objects: int


@dataclass(frozen=True, slots=True)
class Score:
    """Means over the classes that occur, each class's own score by name, and how many images were judged."""

    map50: float
    map50_95: float
    per_class: Mapping[str, ClassScore]
    images: int


def box_iou(first: NDArray[np.float32], second: NDArray[np.float32]) -> NDArray[np.float64]:
    """(N, 4) and (M, 4) boxes xyxy → (N, M) intersection over union."""
    a, b = first.astype(np.float64)[:, None], second.astype(np.float64)[None]
    inner = np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2])
    intersection = np.clip(inner, 0, None).prod(-1)
    union = (a[..., 2:] - a[..., :2]).prod(-1) + (b[..., 2:] - b[..., :2]).prod(-1) - intersection
    ratio: NDArray[np.float64] = intersection / np.maximum(union, 1e-12)
    return ratio


def score_detections(results: Sequence[ImageResult], class_names: Sequence[str]) -> Score:
    """Mean average precision over images.

    Within a class, detections are taken in falling confidence over all images; each takes the true box of its
    image that it overlaps most among those not taken yet, and is right if that IoU reaches the threshold. At
    most 100 detections of an image count.

    Raises:
        ValueError: a class id is outside `class_names`.
    """
    for result in results:
        ids = np.concatenate([result.class_ids, result.true_class_ids])
        if len(ids) and not (0 <= ids.min() and ids.max() < len(class_names)):
            raise ValueError(f"class ids must be 0..{len(class_names) - 1}, got {ids.min()}..{ids.max()}")
    limited = [_most_confident(result, DETECTIONS_PER_IMAGE) for result in results]
    per_class = {name: _score_class(limited, class_id) for class_id, name in enumerate(class_names)}
    seen = [score for score in per_class.values() if score.objects]
    return Score(
        float(np.mean([score.ap50 for score in seen])) if seen else float("nan"),
        float(np.mean([score.ap50_95 for score in seen])) if seen else float("nan"),
        per_class,
        len(results),
    )


def average_precision(confidences: NDArray[np.float32], right: NDArray[np.bool_], objects: int) -> float:
    """Area under the interpolated precision–recall curve, sampled at 101 recalls.

    Args:
        confidences: (N,) of all detections of the class.
        right: (N,) which of them found a true object.
        objects: how many true objects there are, at least 1.

    Raises:
        ValueError: there are no true objects; the precision is not defined then.
    """
    if objects < 1:
        raise ValueError(f"average precision needs at least one true object, got {objects}")
    if not len(confidences):
        return 0.0
    order = np.argsort(-confidences, kind="stable")
    found = np.cumsum(right[order])
    recall = found / objects
    precision = found / np.arange(1, len(found) + 1)
    # The best precision still to be had at this recall or beyond.
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    at = np.searchsorted(recall, RECALL_POINTS, side="left")
    reached = at < len(envelope)
    return float(np.where(reached, envelope[np.minimum(at, len(envelope) - 1)], 0.0).mean())


def _most_confident(result: ImageResult, count: int) -> ImageResult:
    if len(result.confidences) <= count:
        return result
    kept = np.argsort(-result.confidences, kind="stable")[:count]
    return ImageResult(
        result.boxes[kept],
        result.confidences[kept],
        result.class_ids[kept],
        result.true_boxes,
        result.true_class_ids,
    )


def _score_class(results: Sequence[ImageResult], class_id: int) -> ClassScore:
    confidences: list[NDArray[np.float32]] = []
    rights: list[NDArray[np.bool_]] = []
    objects = 0
    for result in results:
        mine, true = result.class_ids == class_id, result.true_class_ids == class_id
        objects += int(true.sum())
        confidences.append(result.confidences[mine])
        rights.append(_right(result.boxes[mine], result.confidences[mine], result.true_boxes[true]))
    if not objects:
        return ClassScore(float("nan"), float("nan"), 0)
    confidence, right = np.concatenate(confidences), np.concatenate(rights, axis=1)
    precisions = [average_precision(confidence, row, objects) for row in right]
    return ClassScore(precisions[0], float(np.mean(precisions)), objects)


def _right(
    boxes: NDArray[np.float32], confidences: NDArray[np.float32], true_boxes: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """(thresholds, N): which of one image's detections of a class find an object, at each IoU threshold."""
    right = np.zeros((len(IOU_THRESHOLDS), len(boxes)), np.bool_)
    if not len(boxes) or not len(true_boxes):
        return right
    overlap = box_iou(boxes, true_boxes)
    for row, threshold in enumerate(IOU_THRESHOLDS):
        free = np.ones(len(true_boxes), np.bool_)
        for index in np.argsort(-confidences, kind="stable"):
            candidates = np.where(free, overlap[index], -1.0)
            best = int(candidates.argmax())
            if candidates[best] >= threshold:
                right[row, index] = True
                free[best] = False
    return right
