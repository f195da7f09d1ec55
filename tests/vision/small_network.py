"""The network of the tests in which its size and family do not matter: a third of the layers of YOLOv8n."""

from __future__ import annotations

from collections.abc import Sequence

from vision.yolo.architecture import ModelDescription

# Each kind of layer of YOLOv8 once, and a head at three levels.
ROWS = [
    [-1, 1, "Conv", [8, 3, 2]],
    [-1, 1, "Conv", [8, 3, 2]],
    [-1, 1, "Conv", [8, 3, 2]],
    [-1, 1, "C2f", [8, True]],
    [-1, 1, "Conv", [8, 3, 2]],
    [-1, 1, "Conv", [8, 3, 2]],
    [-1, 1, "SPPF", [8, 5]],
    [-1, 1, "nn.Upsample", [None, 2, "nearest"]],
    [[-1, 4], 1, "Concat", [1]],
    [-1, 1, "C2f", [8]],
]
HEAD = [[[3, 9, 6], 1, "Detect", ["nc"]]]


def small_description(names: Sequence[str]) -> ModelDescription:
    return ModelDescription.from_plain({"backbone": ROWS, "head": HEAD}, names)
