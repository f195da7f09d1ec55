"""What a network says of one image, before boxes are made of it; the same from every runtime."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class LevelMaps:
    """One level's raw maps. Any memory order; a reader must not keep them past the next inference.

    Attributes:
        sides: (4 · reg_max, H, W) float32: logits of the distributions of left, top, right, bottom; with
            reg_max 1 the distances themselves, in cells.
        classes: (K, H, W) float32 logits of the head's `class_ids`, in their order.
        features: (F, H, W) float32: what the last convolution of the class branch reads. There where the
            head computes some classes alone, as the others' logits follow from it; else None.
    """

    sides: NDArray[np.float32]
    classes: NDArray[np.float32]
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
class Head:
    """How to read the maps.

    Attributes:
        strides: pixels of the input per cell, one a level.
        reg_max: bins of a box side's distribution; 1: the sides are distances.
        end_to_end: the head speaks once an object; its boxes are selected, not suppressed.
        class_count: of the model.
        class_ids: of the maps' class channels; all of the model's, or some.
        rows: one a level where `class_ids` are not all and the maps bring features; else None.
    """

    strides: tuple[int, ...]
    reg_max: int
    end_to_end: bool
    class_count: int
    class_ids: tuple[int, ...]
    rows: tuple[ClassRows, ...] | None = None

    @property
    def complete(self) -> bool:
        """Whether the maps hold every class."""
        return len(self.class_ids) == self.class_count
