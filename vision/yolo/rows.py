"""From a row of the description to its module: arguments checked, channels and repeats scaled."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import nn

from vision.yolo.attention import CHANNELS_PER_AREA_HEAD, CHANNELS_PER_HEAD
from vision.yolo.description import ArchitectureError, LayerRow, ModelDescription
from vision.yolo.layers import (
    C2,
    C2PSA,
    C3,
    PSA,
    SPPF,
    A2C2f,
    C2f,
    C2fCIB,
    C3k2,
    Concat,
    Conv,
    Detect,
    DWConv,
    SCDown,
    same_padding,
)

_LARGEST_CHANNELS = 1 << 14
_MOST_REPEATS = 64
_LARGEST_KERNEL = 31
HEADS = ("Detect", "v10Detect")


@dataclass(frozen=True, slots=True)
class Made:
    """A row's module, the channels it gives, and by how much it makes the map smaller and larger."""

    module: nn.Module
    channels: int
    reduction: int = 1
    enlargement: int = 1


def make(row: LayerRow, inputs: Sequence[int], description: ModelDescription) -> Made:
    """The module of `row`, one of `LAYERS`, which reads maps of `inputs` channels.

    Raises `ArchitectureError`.
    """
    return _MAKERS[row.layer](_Row(row, tuple(inputs), description))


@dataclass(frozen=True, slots=True)
class _Row:
    """A row while it is being made: what it reads and its arguments, each checked when asked for."""

    row: LayerRow
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
        value = self.number(position, name, _LARGEST_KERNEL, default)
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
            raise ArchitectureError(f"knows no groups, got {self._argument(position, 1)!r:.100}")

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
            raise ArchitectureError(f"would repeat {repeats} times, at most {_MOST_REPEATS} make sense")
        return repeats


def _conv(row: _Row) -> Made:
    row.takes(4)
    row.once()
    channels = row.channels()
    kernel = row.number(1, "kernel", _LARGEST_KERNEL, 1)
    stride = row.number(2, "stride", 2, 1)
    padding = row.number(3, "padding", _LARGEST_KERNEL, None) if len(row.row.arguments) > 3 else None
    if padding is None and kernel % 2 == 0:
        raise ArchitectureError(f"the kernel must be odd where no padding is given, got {kernel}")
    # What keeps every size a whole number of cells: size / stride, neither more nor less.
    if (2 * (same_padding(kernel) if padding is None else padding) - kernel) // stride != -1:
        raise ArchitectureError(f"a kernel of {kernel} with padding {padding} does not divide by its stride")
    module = Conv(row.single(), channels, kernel, stride, padding=padding, activation=row.activation)
    return Made(module, channels, reduction=stride)


def _depthwise(row: _Row) -> Made:
    row.takes(3)
    row.once()
    channels = row.channels()
    kernel, stride = row.odd(1, "kernel", 1), row.number(2, "stride", 2, 1)
    module = DWConv(row.single(), channels, kernel, stride, activation=row.activation)
    return Made(module, channels, reduction=stride)


def _scdown(row: _Row) -> Made:
    row.takes(3)
    row.once()
    channels = row.channels()
    kernel, stride = row.odd(1, "kernel", 3), row.number(2, "stride", 2, 2)
    module = SCDown(row.single(), channels, kernel, stride, activation=row.activation)
    return Made(module, channels, reduction=stride)


def _partial(block: type[C2 | C2f | C3], shortcut: bool) -> Callable[[_Row], Made]:
    """The older cross-stage partial blocks, which differ in whether they have shortcuts unless told."""

    def maker(row: _Row) -> Made:
        row.takes(4)
        row.ungrouped(2)
        channels = row.channels()
        module = block(
            row.single(),
            channels,
            row.repeats(),
            row.flag(1, "shortcut", shortcut),
            expansion=row.ratio(3, "expansion", 0.5),
            activation=row.activation,
        )
        return Made(module, channels)

    return maker


def _c3k2(row: _Row) -> Made:
    row.takes(6)
    row.ungrouped(4)
    channels, expansion = row.channels(), row.ratio(2, "expansion", 0.5)
    attention = row.flag(3, "attention", False)
    if attention:
        _divides_into_heads(int(channels * expansion))
    module = C3k2(
        row.single(),
        channels,
        row.repeats(),
        row.flag(1, "choice of C3k", False),
        expansion,
        attention,
        row.flag(5, "shortcut", True),
        activation=row.activation,
    )
    return Made(module, channels)


def _a2c2f(row: _Row) -> Made:
    row.takes(8)
    row.ungrouped(6)
    channels, expansion = row.channels(), row.ratio(5, "expansion", 0.5)
    area_attention = row.flag(1, "area attention", True)
    # Without area attention the number of areas means nothing; the published tables write -1.
    areas = row.number(2, "number of areas", 64, 1) if area_attention else 1
    residual = row.flag(3, "residual", False)
    if int(channels * expansion) % CHANNELS_PER_AREA_HEAD:
        raise ArchitectureError(
            f"works on multiples of {CHANNELS_PER_AREA_HEAD} channels, got {int(channels * expansion)}"
        )
    if residual and area_attention and row.single() != channels:
        raise ArchitectureError(f"cannot add {row.single()} channels to {channels}")
    module = A2C2f(
        row.single(),
        channels,
        row.repeats(),
        area_attention,
        areas,
        residual,
        row.ratio(4, "width of the feed-forward network", 2.0, 8.0),
        expansion,
        row.flag(7, "shortcut", True),
        activation=row.activation,
    )
    return Made(module, channels)


def _c2fcib(row: _Row) -> Made:
    row.takes(3)
    channels = row.channels()
    shortcut, large = row.flag(1, "shortcut", False), row.flag(2, "large kernel", False)
    module = C2fCIB(row.single(), channels, row.repeats(), shortcut, large, activation=row.activation)
    return Made(module, channels)


def _psa(row: _Row) -> Made:
    row.takes(1)
    row.once()
    channels = _attended(row)
    return Made(PSA(channels, activation=row.activation), channels)


def _c2psa(row: _Row) -> Made:
    row.takes(1)
    channels = _attended(row)
    return Made(C2PSA(channels, row.repeats(), activation=row.activation), channels)


def _attended(row: _Row) -> int:
    """The channels of a block whose half passes attention: as many as it reads."""
    channels = row.channels()
    if row.single() != channels:
        raise ArchitectureError(f"gives as many channels as it reads, {row.single()}, got {channels}")
    _divides_into_heads(channels // 2)
    return channels


def _divides_into_heads(channels: int) -> None:
    if channels < 2 or channels % (2 * max(channels // CHANNELS_PER_HEAD, 1)):
        raise ArchitectureError(f"cannot divide {channels} channels into heads of {CHANNELS_PER_HEAD}")


def _sppf(row: _Row) -> Made:
    row.takes(5)
    row.once()
    channels = row.channels()
    module = SPPF(
        row.single(),
        channels,
        row.odd(1, "kernel", 5),
        row.number(2, "pools", 16, 3),
        row.flag(3, "shortcut", False),
        row.flag(4, "first activation", True),
        activation=row.activation,
    )
    return Made(module, channels)


def _upsample(row: _Row) -> Made:
    row.once()
    size, factor, mode = (*row.row.arguments, None, None, None)[:3]
    if size not in (None, "None") or type(factor) is not int or factor != 2 or mode != "nearest":
        raise ArchitectureError(f"only [None, 2, 'nearest'] is known, got {list(row.row.arguments)!r:.200}")
    return Made(nn.Upsample(scale_factor=2, mode="nearest"), row.single(), enlargement=2)


def _concat(row: _Row) -> Made:
    row.once()
    if tuple(row.row.arguments) not in ((), (1,)):
        raise ArchitectureError(f"joins channels (axis 1), got {list(row.row.arguments)!r:.200}")
    return Made(Concat(1), sum(row.inputs))


def _detect(row: _Row) -> Made:
    row.once()
    description = row.description
    classes = len(description.class_names)
    if tuple(row.row.arguments) not in (("nc",), (classes,)):
        raise ArchitectureError(
            f"takes the number of classes, {classes}, got {list(row.row.arguments)!r:.200}"
        )
    module = Detect(
        classes,
        row.inputs,
        description.reg_max,
        light=description.light_classes,
        end_to_end=description.end_to_end,
        class_width=description.class_width,
        activation=description.activation,
    )
    return Made(module, 0)


_MAKERS: dict[str, Callable[[_Row], Made]] = {
    "A2C2f": _a2c2f,
    "C2PSA": _c2psa,
    "C2": _partial(C2, shortcut=True),
    "C2f": _partial(C2f, shortcut=False),
    "C2fCIB": _c2fcib,
    "C3": _partial(C3, shortcut=True),
    "C3k2": _c3k2,
    "Concat": _concat,
    "Conv": _conv,
    "DWConv": _depthwise,
    "Detect": _detect,
    "PSA": _psa,
    "SCDown": _scdown,
    "SPPF": _sppf,
    "Upsample": _upsample,
    "nn.Upsample": _upsample,
    "v10Detect": _detect,
}
LAYERS = tuple(sorted(_MAKERS))
"""The layers that a row may name."""
