"""The worst errors: which detections count as errors, which are kept, and the sheet."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from vision.detections import Detections
from vision.evaluation.misses import WorstMisses

NAMES = ("car", "dog")
IMAGE = np.zeros((100, 200, 3), np.uint8)


def found(*boxes: tuple[float, float, float, float, float, int]) -> Detections:
    table = np.array(boxes, np.float32).reshape(-1, 6)
    return Detections(table[:, :4], table[:, 4], table[:, 5].astype(np.int64), NAMES)


def add(
    misses: WorstMisses, detections: Detections, *true: tuple[float, float, float, float, int], **crowd: bool
) -> None:
    table = np.array(true, np.float32).reshape(-1, 5)
    ignored = np.full(len(table), crowd.get("ignored", False))
    misses.add(Path("a.jpg"), IMAGE, detections, table[:, :4], table[:, 4].astype(np.int64), ignored)


def test_correct_detections_are_no_errors() -> None:
    misses = WorstMisses()
    add(misses, found((0, 0, 50, 50, 0.9, 0)), (2, 2, 50, 50, 0))
    assert misses.counts == {"missed": 0, "imagined": 0}
    assert misses.sheet() is None


def test_wrong_class_position_or_confidence_is_an_error() -> None:
    misses = WorstMisses()
    add(
        misses,
        found((0, 0, 50, 50, 0.9, 1), (100, 0, 150, 50, 0.1, 0)),
        (0, 0, 50, 50, 0),
        (100, 0, 150, 50, 0),
    )
    assert misses.counts == {"missed": 2, "imagined": 1}
    assert misses.worst("imagined")[0].class_name == "dog"


def test_a_crowd_is_not_missed() -> None:
    misses = WorstMisses()
    add(misses, found(), (0, 0, 50, 50, 0), ignored=True)
    assert misses.counts["missed"] == 0


def test_worst_errors_of_each_kind_are_kept() -> None:
    misses = WorstMisses(keep=2)
    for size in (10, 40, 20, 30):
        add(misses, found((100, 50, 120, 70, size / 100 + 0.3, 0)), (0, 0, size, size, 0))
    assert [miss.box[2] for miss in misses.worst("missed")] == [40, 30]
    assert [round(miss.severity, 1) for miss in misses.worst("imagined")] == [0.7, 0.6]
    assert misses.counts == {"missed": 4, "imagined": 4}
    sheet = misses.sheet()
    assert sheet is not None
    assert sheet.dtype == np.uint8
    assert sheet.shape[1] == 6 * 168
