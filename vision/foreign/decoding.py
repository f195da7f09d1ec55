"""Boxes of the raw outputs of a recognised network (`layouts`)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vision.foreign.class_names import NamesError
from vision.foreign.layouts import YOLOX_STRIDES, ForeignFacts
from vision.yolo.postprocess import MOST_BOXES, Boxes, suppress

Floats = NDArray[np.float32]

_FARTHEST_FRACTION = 2.0  # a query's box may reach over the edge, but is no larger than twice the image


def boxes_of(
    facts: ForeignFacts,
    outputs: Sequence[NDArray[Any]],
    size: tuple[int, int],
    *,
    confidence: float,
    iou: float,
    class_ids: Sequence[int] | None = None,
) -> Boxes:
    """One image's outputs → its boxes above `confidence`, in pixels of the input, most confident first.

    Args:
        outputs: in the file's order, each with the batch of one.
        size: (height, width) of the input.
        iou: NMS threshold; without effect for layouts whose boxes are selected already.
        class_ids: to report; None for all.

    Raises:
        NamesError: a class without a name; without the file's name.
        ValueError: channels that do not fit the layout.
    """
    classes = len(facts.class_names)
    _check_channels(facts, outputs[0].shape, classes)
    if facts.layout == "logits":
        xyxy, score, class_id = _query_logits(facts, outputs, size, confidence)
    elif facts.layout == "scored":
        xyxy, score, class_id = _scored(outputs)
        if (highest := class_id.max(initial=0)) >= classes:
            raise NamesError(f"has class {highest}, {classes} names; write all into NAME.txt beside it")
    elif facts.layout == "selected":
        rows = outputs[0][0].astype(np.float32, copy=False)
        xyxy = _enclosing(rows[:, :4], rows[:, -1]) if facts.task == "obb" else rows[:, :4]
        score, class_id = rows[:, 4], rows[:, 5].astype(np.int64)
    else:
        rows = outputs[0][0] if facts.layout != "cells" else outputs[0][0].T
        xyxy, score, class_id = _best_of_rows(facts, rows, size, classes, confidence)
    kept = (score > confidence) & (class_id >= 0) & (class_id < classes)
    if class_ids is not None:
        kept &= np.isin(class_id, class_ids)
    xyxy, score, class_id = xyxy[kept], score[kept], class_id[kept]
    if facts.layout in ("cells", "rows", "objectness", "yolox"):
        order = suppress(xyxy, score, class_id, iou, MOST_BOXES)
    else:
        order = np.argsort(-score, kind="stable")[:MOST_BOXES]
    return Boxes(xyxy[order].astype(np.float32), score[order].astype(np.float32), class_id[order])


def _check_channels(facts: ForeignFacts, shape: tuple[int, ...], classes: int) -> None:
    """The file may state less than the shapes, or what it does not do."""
    plain = 4 + classes
    least = {"cells": plain, "rows": plain, "selected": 6, "objectness": 1 + plain, "queries": plain}
    expected = least.get(facts.layout)
    if expected is None:
        return
    found = shape[1 if facts.layout == "cells" else 2]
    if found < expected or (facts.task == "detect" and found != expected):
        raise ValueError(f"expected {expected} channels, got {found}")


def _best_of_rows(
    facts: ForeignFacts, rows: NDArray[Any], size: tuple[int, int], classes: int, confidence: float
) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """(N, 4 or 5 + classes …): the best class of each row above `confidence`."""
    first = 5 if facts.layout in ("objectness", "yolox") else 4
    best = rows[:, first : first + classes].max(axis=1)
    if first == 5:
        best = best * rows[:, 4]
    some = np.flatnonzero(best > confidence)
    found = rows[some].astype(np.float32, copy=False)
    class_id = found[:, first : first + classes].argmax(axis=1)
    centred = found[:, :4]
    if facts.layout == "yolox":
        cell, stride = _yolox_cells(size)
        centred = np.concatenate(
            ((centred[:, :2] + cell[some]) * stride[some], np.exp(centred[:, 2:]) * stride[some]), axis=1
        )
    elif facts.layout == "queries":
        if (np.abs(centred) > _FARTHEST_FRACTION).any():
            raise ValueError(f"expected boxes in 0..1, got {np.abs(centred).max():.0f}, as of pixels")
        centred = centred * np.array([size[1], size[0]] * 2, np.float32)
    angle = found[:, 4 + classes] if facts.task == "obb" else None
    return _enclosing(centred, angle), best[some].astype(np.float32), class_id


def _query_logits(
    facts: ForeignFacts, outputs: Sequence[NDArray[Any]], size: tuple[int, int], confidence: float
) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """Boxes (1, N, 4), centre and size in 0..1, and logits (1, N, K), in either order."""
    boxes, logits = outputs[facts.boxes_at], outputs[1 - facts.boxes_at]
    with np.errstate(over="ignore"):
        probability = 1 / (1 + np.exp(-logits[0].astype(np.float32)))
    query, class_id = np.nonzero(probability > confidence)
    centred = boxes[0][query].astype(np.float32) * np.array([size[1], size[0]] * 2, np.float32)
    return _enclosing(centred), probability[query, class_id], class_id


def _scored(outputs: Sequence[NDArray[Any]]) -> tuple[Floats, Floats, NDArray[np.int64]]:
    """labels (1, N), boxes (1, N, 4) xyxy in pixels and scores (1, N), of which only the boxes are 3-D."""
    (boxes,) = (output for output in outputs if output.ndim == 3)
    flat = [output for output in outputs if output.ndim == 2]
    (labels,) = (output for output in flat if np.issubdtype(output.dtype, np.integer))
    (scores,) = (output for output in flat if not np.issubdtype(output.dtype, np.integer))
    return boxes[0].astype(np.float32), scores[0].astype(np.float32), labels[0].astype(np.int64)


def _enclosing(centred: Floats, angle: Floats | None = None) -> Floats:
    """(N, 4) centre and size → xyxy; of a box turned by `angle`, radians, the enclosing one."""
    half_width, half_height = centred[:, 2] / 2, centred[:, 3] / 2
    if angle is not None:
        cos, sin = np.abs(np.cos(angle)), np.abs(np.sin(angle))
        half_width, half_height = half_width * cos + half_height * sin, half_width * sin + half_height * cos
    x, y = centred[:, 0], centred[:, 1]
    return np.stack((x - half_width, y - half_height, x + half_width, y + half_height), axis=1)


def _yolox_cells(size: tuple[int, int]) -> tuple[Floats, Floats]:
    """(N, 2) column and row, and (N, 1) stride, of every cell, level by level, row by row."""
    cells, strides = [], []
    for stride in YOLOX_STRIDES:
        row, column = np.divmod(np.arange((size[0] // stride) * (size[1] // stride)), size[1] // stride)
        cells.append(np.stack((column, row), axis=1).astype(np.float32))
        strides.append(np.full((len(row), 1), stride, np.float32))
    return np.concatenate(cells), np.concatenate(strides)


def is_decoded(output: NDArray[Any], size: tuple[int, int]) -> bool:
    """Whether the boxes of a YOLOX network, (1, N, 5 + classes), are in pixels; else they are in cells.

    In pixels the centres of a level's cells follow the grid over the whole input; in cells each is near 0.
    """
    cell, stride = _yolox_cells(size)
    expected = (cell + 0.5) * stride
    centre = output[0][:, :2].astype(np.float32)
    in_pixels = np.abs(centre - expected).mean()
    in_cells = np.abs((centre + cell) * stride - expected).mean()
    return bool(in_pixels < in_cells)
