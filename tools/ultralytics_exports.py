"""Boxes of exported files, ours against Ultralytics' own of the same file; for development only.

Both run the file with the same runtime on the same images, with their default thresholds (confidence 0.25,
IoU 0.7). Reported for each file: boxes, the smallest overlap of a pair, the largest difference of a
confidence, and boxes that only one found (without those within 0.005 of the threshold).

    PYTHONPATH=. OTHER_VENV/bin/python tools/ultralytics_exports.py IMAGES FILE…

Exit code 1 if an overlap is below 0.99, a confidence differs by more than 0.005, or a box is found by only
one.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vision.detections import Detections
from vision.detector import Detector
from vision.evaluation.datasets import image_files, read_image
from vision.runtimes.base import PRECISIONS, Precision
from vision.runtimes.source import read_source
from vision.tracking.association import overlaps

CONFIDENCE, IOU = 0.25, 0.7
LEAST_OVERLAP, LARGEST_DIFFERENCE = 0.99, 0.005


def compare(file: Path, images: list[NDArray[np.uint8]], precision: Precision) -> dict[str, Any]:
    """The differences of one file."""
    from ultralytics import RTDETR, YOLO

    source = read_source(file)
    ours = Detector(file, confidence=CONFIDENCE, iou=IOU, precision=precision)
    assert source.foreign is not None
    theirs = (RTDETR if source.foreign.layout == "queries" else YOLO)(str(file), task=source.foreign.task)
    least, largest, boxes, alone = 1.0, 0.0, 0, 0
    for image in images:
        (result,) = theirs.predict(image, conf=CONFIDENCE, iou=IOU, verbose=False, device="cpu")
        found = result.boxes if result.boxes is not None else result.obb
        expected = Detections(
            found.xyxy.cpu().numpy().astype(np.float32).clip(0, [image.shape[1], image.shape[0]] * 2),
            found.conf.cpu().numpy().astype(np.float32),
            found.cls.cpu().numpy().astype(np.int64),
            ours.class_names,
        )
        detected = ours.detect(image)
        # Of a network with random weights many boxes lie outside of the image.
        expected, detected = expected[_areas(expected) > 1], detected[_areas(detected) > 1]
        pairs = overlaps(expected.xyxy, detected.xyxy)
        pairs = pairs * (expected.class_id[:, None] == detected.class_id[None])
        free = np.ones(len(detected), np.bool_)
        boxes += len(expected)
        for index in range(len(expected)):
            best = int(np.where(free, pairs[index], -1).argmax()) if len(detected) else -1
            if best >= 0 and free[best] and pairs[index, best] > 0.5:
                free[best] = False
                least = min(least, float(pairs[index, best]))
                difference = expected.confidence[index] - detected.confidence[best]
                largest = max(largest, abs(float(difference)))
            else:
                alone += bool(expected.confidence[index] > CONFIDENCE + LARGEST_DIFFERENCE)
        alone += int((detected.confidence[free] > CONFIDENCE + LARGEST_DIFFERENCE).sum())
    return {
        "layout": source.foreign.layout,
        "runtime": f"{ours.runtime} {ours.precision}",
        "boxes": boxes,
        "least_iou": round(least, 4),
        "largest_confidence_difference": round(largest, 5),
        "found_by_one": alone,
    }


def _areas(boxes: Detections) -> NDArray[np.float32]:
    areas: NDArray[np.float32] = np.prod(boxes.xyxy[:, 2:] - boxes.xyxy[:, :2], axis=1)
    return areas


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("images", type=Path)
    parser.add_argument("files", type=Path, nargs="+")
    parser.add_argument("--limit", type=int, default=None, help="number of images")
    parser.add_argument("--precision", choices=PRECISIONS, default="auto", help="of our runtime")
    arguments = parser.parse_args()
    images = [read_image(file) for file in image_files(arguments.images)[: arguments.limit]]
    failed = False
    for file in arguments.files:
        result = compare(file, images, arguments.precision)
        equal = (
            result["least_iou"] >= LEAST_OVERLAP
            and result["largest_confidence_difference"] <= LARGEST_DIFFERENCE
            and not result["found_by_one"]
        )
        failed |= not equal
        print(f"{file.name:<28} {result}{'' if equal else '   DIFFERENT'}", flush=True)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
