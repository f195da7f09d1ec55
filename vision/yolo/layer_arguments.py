"""The arguments of a description's row, checked on access."""

from __future__ import annotations

import math
from dataclasses import dataclass

from vision.yolo.description import ArchitectureError, LayerSpec, ModelDescription

LARGEST_KERNEL = 31
_LARGEST_CHANNELS = 1 << 14
_MOST_REPEATS = 64


@dataclass(frozen=True, slots=True)
class LayerArguments:
    """A row being built. Every method raises `ArchitectureError` for an invalid argument.

    Attributes:
        inputs: channels of the rows it reads.
    """

    row: LayerSpec
    inputs: tuple[int, ...]
    description: ModelDescription

    @property
    def activation(self) -> str:
        return self.description.activation

    def takes(self, most: int) -> None:
        if len(self.row.arguments) > most:
            raise ArchitectureError(f"takes at most {most} arguments, got {list(self.row.arguments)!r:.200}")

    def once(self) -> None:
        if self.row.repeats != 1:
            raise ArchitectureError(f"cannot repeat, got repeats {self.row.repeats}")

    def single(self) -> int:
        """The channels of the one row it reads."""
        if len(self.inputs) != 1:
            raise ArchitectureError(f"reads one row, got {self.row.source}")
        return self.inputs[0]

    def number(self, position: int, name: str, largest: int, default: int | None = None) -> int:
        value = self._argument(position, default)
        if type(value) is not int or not 1 <= value <= largest:
            raise ArchitectureError(f"{name} must be a whole number in 1..{largest}, got {value!r:.100}")
        return value

    def odd(self, position: int, name: str, default: int) -> int:
        value = self.number(position, name, LARGEST_KERNEL, default)
        if value % 2 == 0:
            raise ArchitectureError(f"the {name} must be odd, got {value}")
        return value

    def flag(self, position: int, name: str, default: bool) -> bool:
        value = self._argument(position, default)
        if not isinstance(value, bool):
            raise ArchitectureError(f"the {name} must be true or false, got {value!r:.100}")
        return value

    def ratio(self, position: int, name: str, default: float, largest: float = 1.0) -> float:
        value = self._argument(position, default)
        if not isinstance(value, int | float) or isinstance(value, bool) or not 0 < value <= largest:
            raise ArchitectureError(f"the {name} must be a number in 0..{largest:g}, got {value!r:.100}")
        return float(value)

    def ungrouped(self, position: int) -> None:
        if self._argument(position, 1) != 1:
            raise ArchitectureError(f"does not support groups, got {self._argument(position, 1)!r:.100}")

    def _argument(self, position: int, default: object) -> object:
        return self.row.arguments[position] if position < len(self.row.arguments) else default

    def channels(self) -> int:
        """The first argument, scaled."""
        count = self.number(0, "channels", _LARGEST_CHANNELS)
        description = self.description
        if count in description.unscaled_channels:
            return count
        limited = count if description.max_channels is None else min(count, description.max_channels)
        return max(8, math.ceil(limited * description.width_multiple / 8) * 8)

    def repeats(self) -> int:
        if self.row.repeats == 1:
            return 1
        repeats = max(1, round(self.row.repeats * self.description.depth_multiple))
        if repeats > _MOST_REPEATS:
            raise ArchitectureError(f"would repeat {repeats} times, the limit is {_MOST_REPEATS}")
        return repeats
