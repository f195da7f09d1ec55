"""What a network says of one image, before boxes are made of it; the same from every runtime."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

# Cells whose boxes are computed at once: bounds the memory of a frame with thousands.
_MOST_CELLS = 512

Product = Callable[[NDArray[np.float32], NDArray[np.float32]], NDArray[np.float32]]


@dataclass(frozen=True, slots=True, eq=False)
class LevelOutput:
    """One level's raw maps. Any memory order; a reader must not keep them past the next inference.

    Attributes:
        classes: (K, H, W) float32 logits of the head's `class_ids`, in their order.
        sides: (4 · reg_max, H, W) float32: logits of the distributions of left, top, right, bottom; with
            reg_max 1 the distances themselves, in cells. None where `neck` is there instead.
        neck: (C, H, W) float32: what the head reads. The few cells that matter get their sides from it.
        features: (F, H, W) float32: what the last convolution of the class branch reads. There where the
            head computes some classes alone, as the others' logits follow from it; else None.
    """

    classes: NDArray[np.float32]
    sides: NDArray[np.float32] | None = None
    neck: NDArray[np.float32] | None = None
    features: NDArray[np.float32] | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ClassRows:
    """One level's last class convolution (1×1), of all classes, for a few cells at a time.

    Classes with the very same weights tie always, and the lowest id wins; so each distinct row is kept once,
    by its lowest id, and rounding cannot decide between equals.

    Attributes:
        weight: (R, F) float32. bias: (R,) float32.
        class_id: (R,) int64, rising: the lowest class with this row.
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
        """(F, N) features of N cells → (N,) their most probable classes, of equals the lowest."""
        logits = self.weight @ features + self.bias[:, None]
        best: NDArray[np.int64] = self.class_id[logits.argmax(axis=0)]
        return best


@dataclass(frozen=True, slots=True, eq=False)
class BoxBranch:
    """One level's box branch, for a few cells at a time: 3×3, 3×3 and 1×1 convolutions.

    A frame has thousands of cells and boxes in dozens; run over the whole map this branch is a sixth of the
    smallest networks' time. A cell's sides hang on the 5×5 cells around it alone.

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
        """(C, H, W) map and N cells, row by row → (4 · reg_max, N) as the branch gives at these cells.

        Args:
            product: of two matrices.
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
        # Beyond the map's edge the second convolution sees nothing, not what the first would make of nothing.
        hidden = hidden.reshape(count, 3, 3, -1) * inside[:, 1:4, 1:4]
        hidden = self._activated(product(hidden.reshape(count, -1), self.weights[1]) + self.biases[1])
        found: NDArray[np.float32] = product(hidden, self.weights[2]) + self.biases[2]
        return found

    def _activated(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        if self.activation == "ReLU":
            return np.maximum(values, 0)
        # A logistic of -90 is 0 in float32; beyond, the exponential would overflow.
        activated: NDArray[np.float32] = values / (1 + np.exp(-values.clip(-80, None)))
        return activated


@dataclass(frozen=True, slots=True, eq=False)
class Head:
    """How to read the maps.

    Attributes:
        strides: pixels of the input per cell, one a level.
        reg_max: bins of a box side's distribution; 1: the sides are distances.
        end_to_end: the head speaks once an object; its boxes are selected, not suppressed.
        class_count: of the model.
        class_ids: of the maps' class channels; all of the model's, or some.
        rows: one a level where `class_ids` are not all and the maps bring features; else None.
        boxes: one a level where the maps bring the neck instead of the sides; else None.
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
        """Whether the maps hold every class."""
        return len(self.class_ids) == self.class_count

    @property
    def kinds(self) -> tuple[str, ...]:
        """Of the maps of one level, in the order in which networks give them."""
        boxes = ("sides",) if self.boxes is None else ("neck",)
        return (*boxes, "classes") if self.rows is None else (*boxes, "classes", "features")

    def levels(self, maps: Sequence[NDArray[Any]]) -> list[LevelOutput]:
        """A network's flat list of maps, each (C, H, W), level by level."""
        kinds = self.kinds
        return [
            LevelOutput(**dict(zip(kinds, maps[first : first + len(kinds)], strict=True)))
            for first in range(0, len(maps), len(kinds))
        ]
