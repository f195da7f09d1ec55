"""One row of a network's description, and the values that older or shorter tables imply."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

_LARGEST_REPEATS = 64


class ArchitectureError(ValueError):
    """A description that cannot be built; the message names the row."""


@dataclass(frozen=True, slots=True)
class LayerSpec:
    """One layer: the rows it reads (-1 is the row before), how often it repeats, its name, its arguments."""

    source: tuple[int, ...]
    repeats: int
    layer: str
    arguments: tuple[Any, ...] = ()

    @classmethod
    def from_plain(cls, row: object, index: int) -> LayerSpec:
        """From `[from, repeats, layer, arguments]`; raises `ArchitectureError` naming row `index`."""
        if not isinstance(row, list | tuple) or len(row) != 4:
            raise ArchitectureError(
                f"row {index} must be [from, repeats, layer, arguments], got {row!r:.200}"
            )
        source, repeats, layer, arguments = row
        sources = tuple(source) if isinstance(source, list | tuple) else (source,)
        if not sources or not all(type(value) is int for value in sources):
            raise ArchitectureError(f"row {index}: 'from' must be row numbers, got {source!r:.200}")
        if type(repeats) is not int or not 1 <= repeats <= _LARGEST_REPEATS:
            raise ArchitectureError(
                f"row {index}: repeats must be 1..{_LARGEST_REPEATS}, got {repeats!r:.200}"
            )
        if not isinstance(layer, str) or not isinstance(arguments, list | tuple):
            raise ArchitectureError(f"row {index}: expected a layer's name and arguments, got {row!r:.99}")
        return cls(sources, repeats, layer, tuple(arguments))

    def to_plain(self) -> list[Any]:
        source = self.source[0] if len(self.source) == 1 else list(self.source)
        return [source, self.repeats, self.layer, list(self.arguments)]

    def with_argument(self, position: int, value: Any, defaults: Sequence[Any]) -> LayerSpec:
        """The row with one argument set; omitted arguments before it are filled from `defaults`.

        A row that already has the value, explicitly or by `defaults`, stays unchanged.
        """
        if value == (*self.arguments, *defaults[len(self.arguments) :])[position]:
            return self
        arguments = [*self.arguments, *defaults[len(self.arguments) :]]
        arguments[position] = value
        return replace(self, arguments=tuple(arguments[: max(len(self.arguments), position + 1)]))


# Defaults of omitted arguments; the first, the channels, has none.
C3K2_DEFAULTS = (None, False, 0.5, False, 1, True)
A2C2F_DEFAULTS = (None, True, 1, False, 2.0, 0.5, 1, True)
PUBLISHED_MLP_RATIOS = (2.0, 1.2)
SPPF_DEFAULTS = (None, 5, 3, False, True)


def apply_scale(row: LayerSpec, scale: str) -> LayerSpec:
    """Make explicit what a table shared by all scales (YOLO11, 12 and 26) implies for the larger ones.

    From m on, every C3k2 consists of C3k blocks; from l on, area attention has a residual and a narrower
    feed-forward network.
    """
    if row.layer == "C3k2" and scale in ("m", "l", "x"):
        return row.with_argument(1, True, C3K2_DEFAULTS)
    attends = row.layer == "A2C2f" and row.arguments[1:2] != (False,)
    if attends and scale in ("l", "x") and len(row.arguments) <= 3:
        return row.with_argument(3, True, A2C2F_DEFAULTS).with_argument(
            4, PUBLISHED_MLP_RATIOS[1], A2C2F_DEFAULTS
        )
    return row


def apply_pooling_form(row: LayerSpec) -> LayerSpec:
    """An SPPF row with more than a kernel is YOLO26's form: no activation after its first convolution."""
    if row.layer == "SPPF" and 2 < len(row.arguments) < len(SPPF_DEFAULTS):
        return row.with_argument(4, False, SPPF_DEFAULTS)
    return row
