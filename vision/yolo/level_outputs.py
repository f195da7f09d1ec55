"""Raw network outputs of one image, before decoding; the same for every runtime."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Cells whose boxes are computed at once: limits the memory for a frame with thousands.
_MOST_CELLS = 512

Product = Callable[[NDArray[np.float32], NDArray[np.float32]], NDArray[np.float32]]


@dataclass(frozen=True, slots=True, eq=False)
class LevelOutput:
    """Raw outputs of one level. Any memory order; valid until the next inference.

    Attributes:
        classes: (K, H, W) float32 logits of the head's `class_ids`, in their order.
        sides: (4 · reg_max, H, W) float32: logits of the distributions of left, top, right, bottom; with
            reg_max 1 the distances themselves, in cells. None if `neck` is given instead.
        neck: (C, H, W) float32: input of the head, from which the sides of candidate cells are computed.
        features: (F, H, W) float32: input of the class branch's last convolution. Only if the head computes
            some of the classes, to derive the others' logits; else None.
    """

    classes: NDArray[np.float32]
    sides: NDArray[np.float32] | None = None
    neck: NDArray[np.float32] | None = None
    features: NDArray[np.float32] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ClassRows:
    """One level's last class convolution (1×1), for all classes, applied to a few cells at a time.

    Classes with identical weights always tie, and the lowest id wins; so each distinct row is kept once, by
    its lowest id, and rounding cannot decide between equals.

    Attributes:
        weight: (R, F) float32. bias: (R,) float32.
        class_id: (R,) int64, ascending: the lowest class with this row.
    """

    weight: NDArray[np.float32]
    bias: NDArray[np.float32]
    class_id: NDArray[np.int64]

    @classmethod
    def distinct(cls, weight: NDArray[np.float32], bias: NDArray[np.float32]) -> ClassRows:
        """From (classes, F) weights and (classes,) biases."""
        _, first = np.unique(np.column_stack([weight, bias]), axis=0, return_index=True)
        first.sort()
        return cls(np.ascontiguousarray(weight[first]), bias[first], first.astype(np.int64))

    def best_class(self, features: NDArray[np.float32]) -> NDArray[np.int64]:
        """(F, N) features of N cells → (N,) their most probable classes; the lowest of equals."""
        logits = self.weight @ features + self.bias[:, None]
        best: NDArray[np.int64] = self.class_id[logits.argmax(axis=0)]
        return best


@dataclass(frozen=True, slots=True, eq=False)
class BoxBranch:
    """One level's box branch, applied to a few cells at a time: 3×3, 3×3 and 1×1 convolutions.

    A frame has thousands of cells and dozens of boxes; over the whole map this branch takes a sixth of the
    smallest networks' time. A cell's sides depend only on the 5×5 cells around it.

    Attributes:
        weights: (9 · C, M), (9 · M, M) and (M, 4 · reg_max) float32, kernels' rows, columns, then channels.
        biases: (M,), (M,) and (4 · reg_max,) float32.
        activation: `SiLU` or `ReLU`.
    """

    weights: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]
    biases: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]
    activation: str

    def sides(
        self, neck: NDArray[np.float32], cells: NDArray[np.int64], product: Product = np.matmul
    ) -> NDArray[np.float32]:
        """(C, H, W) features and N cells, row by row → (4 · reg_max, N) output of the branch at these cells.

        Args:
            product: matrix product.
        """
        parts = [
            self._sides(neck, cells[first : first + _MOST_CELLS], product)
            for first in range(0, len(cells), _MOST_CELLS)
        ]
        if not parts:
            return np.zeros((len(self.biases[2]), 0), np.float32)
        return np.concatenate(parts).T

    def _sides(
        self, neck: NDArray[np.float32], cells: NDArray[np.int64], product: Product
    ) -> NDArray[np.float32]:
        count = len(cells)
        _, height, width = neck.shape
        around = np.arange(-2, 3)
        row, column = np.divmod(cells, width)
        rows, columns = row[:, None] + around, column[:, None] + around
        row_inside, column_inside = (rows >= 0) & (rows < height), (columns >= 0) & (columns < width)
        inside = (row_inside[:, :, None] & column_inside[:, None, :])[..., None].astype(np.float32)
        rows, columns = rows.clip(0, height - 1), columns.clip(0, width - 1)
        patches = neck.transpose(1, 2, 0)[rows[:, :, None], columns[:, None, :]]
        patches *= inside
        windows = np.lib.stride_tricks.sliding_window_view(patches, (3, 3), axis=(1, 2))
        flat = windows.transpose(0, 1, 2, 4, 5, 3).reshape(count * 9, -1)
        hidden = self._activated(product(flat, self.weights[0]) + self.biases[0])
        # The second convolution is zero-padded at the map's edge.
        hidden = hidden.reshape(count, 3, 3, -1) * inside[:, 1:4, 1:4]
        hidden = self._activated(product(hidden.reshape(count, -1), self.weights[1]) + self.biases[1])
        sides: NDArray[np.float32] = product(hidden, self.weights[2]) + self.biases[2]
        return sides

    def _activated(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        if self.activation == "ReLU":
            return np.maximum(values, 0)
        # A logistic of -90 is 0 in float32; beyond, the exponential would overflow.
        activated: NDArray[np.float32] = values / (1 + np.exp(-values.clip(-80, None)))
        return activated


@dataclass(frozen=True, slots=True, eq=False)
class Head:
    """Layout of the outputs.

    Attributes:
        strides: pixels of the input per cell, one per level.
        reg_max: bins of a box side's distribution; 1: the sides are distances.
        end_to_end: the head predicts each object once; its boxes need no NMS.
        class_count: of the model.
        class_ids: of the class channels; all of the model's, or some.
        rows: one per level if `class_ids` are not all and the outputs have features; else None.
        boxes: one per level if the outputs have the neck instead of the sides; else None.
    """

    strides: tuple[int, ...]
    reg_max: int
    end_to_end: bool
    class_count: int
    class_ids: tuple[int, ...]
    rows: tuple[ClassRows, ...] | None = None
    boxes: tuple[BoxBranch, ...] | None = None

    @property
    def complete(self) -> bool:
        """Whether the outputs contain every class."""
        return len(self.class_ids) == self.class_count

    @property
    def kinds(self) -> tuple[str, ...]:
        """Kinds of the outputs of one level, in the order of the network's outputs."""
        boxes = ("sides",) if self.boxes is None else ("neck",)
        return (*boxes, "classes") if self.rows is None else (*boxes, "classes", "features")

    def levels(self, outputs: Sequence[NDArray[Any]]) -> list[LevelOutput]:
        """Group a network's flat list of outputs, each (C, H, W), by level."""
        kinds = self.kinds
        return [
            LevelOutput(**dict(zip(kinds, outputs[first : first + len(kinds)], strict=True)))
            for first in range(0, len(outputs), len(kinds))
        ]
