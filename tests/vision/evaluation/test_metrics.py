"""Average precision on cases with a known result."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vision.evaluation.metrics import (
    NEITHER,
    RIGHT,
    WRONG,
    ImageResult,
    average_precision,
    judge,
    operating_points,
    score_detections,
)

NAMES = ("car", "boat")
SQUARE = (0.0, 0.0, 10.0, 10.0)
FAR = (50.0, 50.0, 60.0, 60.0)
Box = tuple[float, float, float, float]


def result(found: Sequence[tuple[Box, float, int]] = (), true: Sequence[tuple[Box, int]] = ()) -> ImageResult:
    """found: (box, confidence, class); true: (box, class)."""
    return ImageResult(
        np.array([f[0] for f in found], np.float32).reshape(-1, 4),
        np.array([f[1] for f in found], np.float32),
        np.array([f[2] for f in found], np.int64),
        np.array([t[0] for t in true], np.float32).reshape(-1, 4),
        np.array([t[1] for t in true], np.int64),
    )


def test_finding_everything_exactly_scores_one() -> None:
    score = score_detections([result([(SQUARE, 0.9, 0), (FAR, 0.8, 1)], [(SQUARE, 0), (FAR, 1)])], NAMES)
    assert score.map50 == pytest.approx(1)
    assert score.map50_95 == pytest.approx(1)
    assert score.per_class["boat"].objects == 1
    assert score.images == 1


@pytest.mark.parametrize(
    ("found", "true", "map50"),
    [
        pytest.param([(SQUARE, 0.9, 0)], [(SQUARE, 0), (FAR, 0)], 51 / 101, id="a missed object"),
        pytest.param([(FAR, 0.9, 0), (SQUARE, 0.8, 0)], [(SQUARE, 0)], 0.5, id="a confident false alarm"),
        pytest.param([(FAR, 0.1, 0), (SQUARE, 0.8, 0)], [(SQUARE, 0)], 1, id="a less confident false alarm"),
        pytest.param(
            [(SQUARE, 0.9, 0), (SQUARE, 0.8, 0), (FAR, 0.7, 0)],
            [(SQUARE, 0), (FAR, 0)],
            (51 + 50 * 2 / 3) / 101,
            id="a second box on one object is a false alarm",
        ),
        pytest.param(
            [*[(FAR, 0.9, 0)] * 100, (SQUARE, 0.1, 0)],
            [(SQUARE, 0)],
            0,
            id="the hundred most confident count",
        ),
    ],
)
def test_precision_of_one_image(
    found: list[tuple[Box, float, int]], true: list[tuple[Box, int]], map50: float
) -> None:
    assert score_detections([result(found, true)], NAMES).map50 == pytest.approx(map50)


def test_a_box_of_iou_0_72_counts_at_the_five_lower_thresholds() -> None:
    loose = (0.0, 0.0, 10.0, 7.2)
    score = score_detections([result([(loose, 0.9, 0)], [(SQUARE, 0)])], NAMES)
    assert score.map50 == pytest.approx(1)
    assert score.map50_95 == pytest.approx(0.5)


def test_classes_are_separate_and_absent_ones_ignored() -> None:
    score = score_detections([result([(SQUARE, 0.9, 1)], [(SQUARE, 0)])], NAMES)
    assert score.map50 == 0
    assert math.isnan(score.per_class["boat"].ap50)


def test_an_object_is_not_found_by_a_box_in_another_image() -> None:
    score = score_detections([result([(SQUARE, 0.9, 0)]), result((), [(SQUARE, 0)])], NAMES)
    assert score.map50 == 0


def test_no_images_give_no_score() -> None:
    assert math.isnan(score_detections([], NAMES).map50)


def test_unknown_class_id_is_rejected() -> None:
    with pytest.raises(ValueError, match=r"0\.\.1, got 0\.\.7"):
        score_detections([result([(SQUARE, 0.5, 7)], [(SQUARE, 0)])], NAMES)


def plain_average_precision(confidences: list[float], right: list[bool], objects: int) -> float:
    """The definition, written out: at each recall the best precision at that recall or more."""
    order = sorted(range(len(right)), key=lambda i: -confidences[i])
    curve, found = [], 0
    for rank, index in enumerate(order, 1):
        found += right[index]
        curve.append((found / objects, found / rank))
    points = [max((p for r, p in curve if r >= k / 100 - 1e-12), default=0) for k in range(101)]
    return sum(points) / 101


@settings(deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 10**6), st.booleans()), max_size=30, unique_by=lambda p: p[0]),
    st.integers(0, 5),
)
def test_average_precision_agrees_with_its_definition(pairs: list[tuple[int, bool]], missed: int) -> None:
    confidences = np.array([p[0] / 10**6 for p in pairs], np.float32)
    right = np.array([p[1] for p in pairs], bool)
    objects = int(right.sum()) + missed
    if objects == 0:
        return
    assert average_precision(confidences, right, objects) == pytest.approx(
        plain_average_precision(confidences.tolist(), right.tolist(), objects), abs=1e-6
    )


def test_an_ignored_region_makes_nothing_right_or_wrong() -> None:
    crowd = ImageResult(
        np.array([SQUARE, FAR], np.float32),
        np.array([0.9, 0.8], np.float32),
        np.array([0, 0]),
        np.array([(0, 0, 30, 30), FAR], np.float32),
        np.array([0, 0]),
        np.array([True, False]),
    )
    score = score_detections([crowd], NAMES)
    assert score.per_class["car"].objects == 1
    assert score.map50 == pytest.approx(1)


def test_score_matches_pycocotools() -> None:
    """Random scenes with crowds, duplicate boxes and false positives, compared with pycocotools."""
    coco = pytest.importorskip("pycocotools.coco", reason="pycocotools is not installed")
    cocoeval = pytest.importorskip("pycocotools.cocoeval")
    rng = np.random.default_rng(3)
    results, images, found = [], [], []
    annotations: list[dict[str, object]] = []
    for image in range(40):
        true = rng.uniform(0, 80, (rng.integers(0, 6), 4)).astype(np.float32)
        true[:, 2:] = true[:, :2] + rng.uniform(8, 60, (len(true), 2))
        classes, ignored = rng.integers(0, 2, len(true)), rng.random(len(true)) < 0.15
        near = np.repeat(true, 2, axis=0) + rng.normal(0, 4, (2 * len(true), 4))
        extra = rng.uniform(0, 80, (130 if image == 0 else 3, 4))
        extra[:, 2:] = extra[:, :2] + rng.uniform(5, 40, (len(extra), 2))
        boxes = np.concatenate([near, extra]).astype(np.float32)
        boxes[:, 2:] = np.maximum(boxes[:, 2:], boxes[:, :2] + 1)
        kinds = np.concatenate([np.repeat(classes, 2), rng.integers(0, 2, len(extra))])
        confidences = rng.permutation(len(boxes)).astype(np.float32) / len(boxes) + image * 1e-5
        results.append(ImageResult(boxes, confidences.astype(np.float32), kinds, true, classes, ignored))
        images.append({"id": image + 1, "width": 200, "height": 200})
        for box, kind, crowd in zip(true.tolist(), classes.tolist(), ignored.tolist(), strict=True):
            left, top, right, bottom = box
            size = [right - left, bottom - top]
            annotations.append(
                {"id": len(annotations) + 1, "image_id": image + 1, "category_id": kind + 1}
                | {"bbox": [left, top, *size], "area": size[0] * size[1], "iscrowd": int(crowd)}
            )
        for box, kind, confidence in zip(boxes.tolist(), kinds.tolist(), confidences.tolist(), strict=True):
            left, top, right, bottom = box
            found.append(
                {"image_id": image + 1, "category_id": kind + 1, "score": confidence}
                | {"bbox": [left, top, right - left, bottom - top]}
            )
    truth = coco.COCO()
    truth.dataset = {
        "info": {},
        "images": images,
        "annotations": annotations,
        "categories": [{"id": index + 1, "name": name} for index, name in enumerate(NAMES)],
    }
    truth.createIndex()
    judge = cocoeval.COCOeval(truth, truth.loadRes(found), "bbox")
    judge.evaluate()
    judge.accumulate()
    # (thresholds, recalls, classes, sizes, limits): all sizes, at most 100.
    precision = judge.eval["precision"][:, :, :, 0, -1]
    score = score_detections(results, NAMES)
    for index, name in enumerate(NAMES):
        assert score.per_class[name].ap50 == pytest.approx(precision[0, :, index].mean(), abs=1e-3)
        assert score.per_class[name].ap50_95 == pytest.approx(precision[:, :, index].mean(), abs=1e-3)


def test_precision_and_recall_count_what_is_confident_enough() -> None:
    seen = result([(SQUARE, 0.9, 0), (SQUARE, 0.8, 0), (FAR, 0.7, 0), (FAR, 0.3, 1)], [(SQUARE, 0), (FAR, 1)])
    assert judge(seen, 0.5).tolist() == [RIGHT, WRONG, WRONG, NEITHER]
    assert judge(seen, 0.2).tolist() == [RIGHT, WRONG, WRONG, RIGHT]
    points = operating_points([seen], NAMES, 0.5)
    assert (points["car"].precision, points["car"].recall) == pytest.approx((1 / 3, 1.0))
    assert math.isnan(points["boat"].precision)
    assert points["boat"].recall == 0.0


def test_ignored_object_is_neutral_only_for_its_class() -> None:
    seen = result([(SQUARE, 0.9, 0), (SQUARE, 0.8, 1)], [(SQUARE, 0)])
    ignoring = ImageResult(
        seen.boxes, seen.confidences, seen.class_ids, seen.true_boxes, seen.true_class_ids, np.array([True])
    )
    assert judge(ignoring, 0.5).tolist() == [NEITHER, WRONG]
    assert operating_points([ignoring], NAMES, 0.5)["car"].objects == 0
