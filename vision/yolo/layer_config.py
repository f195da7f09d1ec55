"""Builds the module of a description's row: checks its arguments, scales channels and repeats."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import nn

from vision.yolo.checkpoint_error import shown
from vision.yolo.description import ArchitectureError, LayerSpec, ModelDescription
from vision.yolo.gelan import ELAN1, SPPELAN, AConv, ADown, CBFuse, CBLinear, RepNCSPELAN4
from vision.yolo.heads import OBB, Detect
from vision.yolo.layers import (
    C2,
    C2PSA,
    C3,
    CHANNELS_PER_AREA_HEAD,
    CHANNELS_PER_HEAD,
    PSA,
    SPPF,
    A2C2f,
    C2f,
    C2fCIB,
    C3k2,
    Concat,
    Conv,
    DWConv,
    SCDown,
    same_padding,
)

LARGEST_KERNEL = 31
_LARGEST_CHANNELS = 1 << 14
_MOST_REPEATS = 64
# Published: 1 to 3. Each is a dozen modules, in two stages of a row.
_MOST_STAGE_REPEATS = 4
_MOST_MAPS = 8
HEADS = ("Detect", "v10Detect", "OBB")


@dataclass(frozen=True, slots=True)
class LayerArguments:
    """A row being built. Every method raises `ArchitectureError` for an invalid argument.

    Attributes:
        inputs: channels of the rows it reads.
        parts: of each of those rows the channels of its maps; empty for a single map.
    """

    row: LayerSpec
    inputs: tuple[int, ...]
    description: ModelDescription
    parts: tuple[tuple[int, ...], ...] = ()

    def single(self) -> int:
        """The channels of the one row it reads."""
        if len(self.inputs) != 1:
            raise ArchitectureError(f"reads one row, got {self.row.source}")
        return self.inputs[0]

    def number(self, position: int, name: str, largest: int, default: int | None = None) -> int:
        value = self._argument(position, default)
        if type(value) is not int or not 1 <= value <= largest:
            raise ArchitectureError(f"{name} must be a whole number in 1..{largest}, got {shown(value)}")
        return value

    def odd(self, position: int, name: str, default: int) -> int:
        value = self.number(position, name, LARGEST_KERNEL, default)
        if value % 2 == 0:
            raise ArchitectureError(f"the {name} must be odd, got {value}")
        return value

    def flag(self, position: int, name: str, default: bool) -> bool:
        value = self._argument(position, default)
        if not isinstance(value, bool):
            raise ArchitectureError(f"the {name} must be true or false, got {shown(value)}")
        return value

    def ratio(self, position: int, name: str, default: float, largest: float = 1.0) -> float:
        value = self._argument(position, default)
        if not isinstance(value, int | float) or isinstance(value, bool) or not 0 < value <= largest:
            raise ArchitectureError(f"the {name} must be a number in 0..{largest:g}, got {shown(value)}")
        return float(value)

    def ungrouped(self, position: int) -> None:
        if self._argument(position, 1) != 1:
            raise ArchitectureError(f"does not support groups, got {shown(self._argument(position, 1))}")

    def numbers(self, position: int, name: str, smallest: int) -> tuple[int, ...]:
        value = self._argument(position, None)
        if not isinstance(value, list | tuple) or not 1 <= len(value) <= _MOST_MAPS:
            raise ArchitectureError(f"{name} must be a list of 1..{_MOST_MAPS} numbers, got {shown(value)}")
        if not all(type(item) is int and smallest <= item <= _LARGEST_CHANNELS for item in value):
            raise ArchitectureError(f"{name} must be whole numbers from {smallest}, got {shown(value)}")
        return tuple(value)

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


@dataclass(frozen=True, slots=True)
class BuiltLayer:
    """A row's module, its output channels, and the factors by which it reduces and enlarges the size.

    `parts` has the channels of each map if they are several.
    """

    module: nn.Module
    channels: int
    reduction: int = 1
    enlargement: int = 1
    parts: tuple[int, ...] = ()


_Builder = Callable[["LayerArguments"], BuiltLayer]
_BUILDERS: dict[str, tuple[_Builder, int | None, bool]] = {}


def build_layer(
    row: LayerSpec,
    inputs: Sequence[int],
    description: ModelDescription,
    parts: Sequence[tuple[int, ...]] = (),
) -> BuiltLayer:
    """Build the module of `row`, one of `LAYERS`, for inputs with `inputs` channels, in these `parts`.

    Raises `ArchitectureError`.
    """
    builder, most_arguments, repeats = _BUILDERS[row.layer]
    if most_arguments is not None and len(row.arguments) > most_arguments:
        raise ArchitectureError(f"takes at most {most_arguments} arguments, got {shown(list(row.arguments))}")
    if row.repeats != 1 and not repeats:
        raise ArchitectureError(f"cannot repeat, got repeats {row.repeats}")
    return builder(LayerArguments(row, tuple(inputs), description, tuple(parts)))


def _builds(
    *names: str, most_arguments: int | None = None, repeats: bool = False
) -> Callable[[_Builder], _Builder]:
    """Decorator: register the builder of these layers, by default for any number of arguments."""

    def register(builder: _Builder) -> _Builder:
        for name in names:
            _BUILDERS[name] = builder, most_arguments, repeats
        return builder

    return register


@_builds("Conv", most_arguments=4)
def _conv(row: LayerArguments) -> BuiltLayer:
    channels = row.channels()
    kernel = row.number(1, "kernel", LARGEST_KERNEL, 1)
    stride = row.number(2, "stride", 2, 1)
    padding = row.number(3, "padding", LARGEST_KERNEL, None) if len(row.row.arguments) > 3 else None
    if padding is None and kernel % 2 == 0:
        raise ArchitectureError(f"the kernel must be odd where no padding is given, got {kernel}")
    # Keeps every size a whole number of cells: exactly size / stride.
    if (2 * (same_padding(kernel) if padding is None else padding) - kernel) // stride != -1:
        raise ArchitectureError(f"a kernel of {kernel} with padding {padding} does not divide by its stride")
    module = Conv(row.single(), channels, kernel, stride, padding=padding)
    return BuiltLayer(module, channels, reduction=stride)


@_builds("DWConv", most_arguments=3)
def _depthwise(row: LayerArguments) -> BuiltLayer:
    channels = row.channels()
    kernel, stride = row.odd(1, "kernel", 1), row.number(2, "stride", 2, 1)
    module = DWConv(row.single(), channels, kernel, stride)
    return BuiltLayer(module, channels, reduction=stride)


@_builds("SCDown", most_arguments=3)
def _scdown(row: LayerArguments) -> BuiltLayer:
    channels = row.channels()
    kernel, stride = row.odd(1, "kernel", 3), row.number(2, "stride", 2, 2)
    module = SCDown(row.single(), channels, kernel, stride)
    return BuiltLayer(module, channels, reduction=stride)


def _partial(name: str, block: type[C2 | C2f | C3], shortcut: bool) -> None:
    """The older cross-stage partial blocks, which differ in their default of `shortcut`."""

    @_builds(name, most_arguments=4, repeats=True)
    def builder(row: LayerArguments) -> BuiltLayer:
        row.ungrouped(2)
        channels = row.channels()
        module = block(
            row.single(),
            channels,
            row.repeats(),
            row.flag(1, "shortcut", shortcut),
            expansion=row.ratio(3, "expansion", 0.5),
        )
        return BuiltLayer(module, channels)


_partial("C2", C2, shortcut=True)
_partial("C2f", C2f, shortcut=False)
_partial("C3", C3, shortcut=True)


@_builds("C3k2", most_arguments=6, repeats=True)
def _c3k2(row: LayerArguments) -> BuiltLayer:
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
    )
    return BuiltLayer(module, channels)


@_builds("A2C2f", most_arguments=8, repeats=True)
def _a2c2f(row: LayerArguments) -> BuiltLayer:
    row.ungrouped(6)
    channels, expansion = row.channels(), row.ratio(5, "expansion", 0.5)
    area_attention = row.flag(1, "area attention", True)
    # Without area attention the number of areas is unused; the published tables write -1.
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
    )
    return BuiltLayer(module, channels)


@_builds("C2fCIB", most_arguments=3, repeats=True)
def _c2fcib(row: LayerArguments) -> BuiltLayer:
    channels = row.channels()
    shortcut, large = row.flag(1, "shortcut", False), row.flag(2, "large kernel", False)
    module = C2fCIB(row.single(), channels, row.repeats(), shortcut, large)
    return BuiltLayer(module, channels)


@_builds("PSA", most_arguments=1)
def _psa(row: LayerArguments) -> BuiltLayer:
    channels = _attended(row)
    return BuiltLayer(PSA(channels), channels)


@_builds("C2PSA", most_arguments=1, repeats=True)
def _c2psa(row: LayerArguments) -> BuiltLayer:
    channels = _attended(row)
    return BuiltLayer(C2PSA(channels, row.repeats()), channels)


def _attended(row: LayerArguments) -> int:
    """The channels of a block in which half pass attention: output channels equal input channels."""
    channels = row.channels()
    if row.single() != channels:
        raise ArchitectureError(f"needs as many output channels as inputs, {row.single()}, got {channels}")
    _divides_into_heads(channels // 2)
    return channels


def _divides_into_heads(channels: int) -> None:
    if channels < 2 or channels % (2 * max(channels // CHANNELS_PER_HEAD, 1)):
        raise ArchitectureError(f"cannot divide {channels} channels into heads of {CHANNELS_PER_HEAD}")


@_builds("SPPF", most_arguments=5)
def _sppf(row: LayerArguments) -> BuiltLayer:
    channels = row.channels()
    module = SPPF(
        row.single(),
        channels,
        row.odd(1, "kernel", 5),
        row.number(2, "pools", 16, 3),
        row.flag(3, "shortcut", False),
        row.flag(4, "first activation", True),
    )
    return BuiltLayer(module, channels)


@_builds("Upsample", "nn.Upsample")
def _upsample(row: LayerArguments) -> BuiltLayer:
    size, factor, mode = (*row.row.arguments, None, None, None)[:3]
    if size not in (None, "None") or type(factor) is not int or factor != 2 or mode != "nearest":
        raise ArchitectureError(
            f"only [None, 2, 'nearest'] is supported, got {shown(list(row.row.arguments))}"
        )
    return BuiltLayer(nn.Upsample(scale_factor=2, mode="nearest"), row.single(), enlargement=2)


@_builds("Concat")
def _concat(row: LayerArguments) -> BuiltLayer:
    if tuple(row.row.arguments) not in ((), (1,)):
        raise ArchitectureError(f"concatenates channels (axis 1), got {shown(list(row.row.arguments))}")
    return BuiltLayer(Concat(1), sum(row.inputs))


@_builds(*HEADS)
def _detect(row: LayerArguments) -> BuiltLayer:
    description = row.description
    classes = len(description.class_names)
    rotated = row.row.layer == "OBB"
    # An angle is the one further number of a rotated box.
    further = (1,) if rotated else ()
    if tuple(row.row.arguments) not in (("nc", *further), (classes, *further)):
        raise ArchitectureError(
            f"takes the number of classes, {classes}{', and 1' if rotated else ''}, "
            f"got {shown(list(row.row.arguments))}"
        )
    if rotated and description.end_to_end:
        raise ArchitectureError("an end-to-end head of rotated boxes is not supported")
    module = (OBB if rotated else Detect)(
        classes,
        row.inputs,
        description.reg_max,
        light=description.light_classes,
        end_to_end=description.end_to_end,
        class_width=description.class_width,
    )
    return BuiltLayer(module, 0)


@_builds("RepNCSPELAN4", "ELAN1", most_arguments=4)
def _elan(row: LayerArguments) -> BuiltLayer:
    channels = row.channels()
    hidden = row.number(1, "hidden channels", _LARGEST_CHANNELS)
    width = row.number(2, "width of the stages", _LARGEST_CHANNELS)
    repeats = row.number(3, "repeats", _MOST_STAGE_REPEATS, 1)
    if hidden % 2 or width % 2:
        raise ArchitectureError(f"needs even channels, got {hidden} and {width}")
    if row.row.layer == "ELAN1":
        return BuiltLayer(ELAN1(row.single(), channels, hidden, width), channels)
    return BuiltLayer(RepNCSPELAN4(row.single(), channels, hidden, width, repeats), channels)


@_builds("AConv", "ADown", most_arguments=1)
def _averaging_down(row: LayerArguments) -> BuiltLayer:
    channels, inputs = row.channels(), row.single()
    if inputs % 2 or channels % 2:
        raise ArchitectureError(f"needs even channels, got {inputs} and {channels}")
    block = AConv if row.row.layer == "AConv" else ADown
    return BuiltLayer(block(inputs, channels), channels, reduction=2)


@_builds("SPPELAN", most_arguments=3)
def _sppelan(row: LayerArguments) -> BuiltLayer:
    channels, hidden = row.channels(), row.number(1, "hidden channels", _LARGEST_CHANNELS)
    return BuiltLayer(SPPELAN(row.single(), channels, hidden, row.odd(2, "kernel", 5)), channels)


@_builds("CBLinear", most_arguments=1)
def _cblinear(row: LayerArguments) -> BuiltLayer:
    widths = row.numbers(0, "channels of the maps", 1)
    return BuiltLayer(CBLinear(row.single(), widths), sum(widths), parts=widths)


@_builds("CBFuse", most_arguments=1)
def _cbfuse(row: LayerArguments) -> BuiltLayer:
    *others, channels = row.inputs
    chosen = row.numbers(0, "maps of the inputs", 0)
    if len(chosen) != len(others) or any(
        index >= len(parts) or parts[index] != channels
        for index, parts in zip(chosen, row.parts, strict=False)
    ):
        raise ArchitectureError(f"needs a map of {channels} channels of each input, got {list(chosen)}")
    starts = [sum(parts[:index]) for index, parts in zip(chosen, row.parts, strict=False)]
    return BuiltLayer(CBFuse(starts), channels)


@_builds("nn.Identity", most_arguments=0)
def _identity(row: LayerArguments) -> BuiltLayer:
    return BuiltLayer(nn.Identity(), row.single())


@_builds("nn.ZeroPad2d", most_arguments=1)
def _zero_pad(row: LayerArguments) -> BuiltLayer:
    if row.numbers(0, "padding", 0) != (0, 1, 0, 1):
        raise ArchitectureError(f"pads right and bottom by one, got {shown(list(row.row.arguments))}")
    return BuiltLayer(nn.ZeroPad2d((0, 1, 0, 1)), row.single())


@_builds("nn.MaxPool2d", most_arguments=3)
def _max_pool(row: LayerArguments) -> BuiltLayer:
    if tuple(row.row.arguments) not in ((2, 2, 0), (2, 1, 0)):
        raise ArchitectureError(f"pools 2×2 at stride 2 or 1, got {shown(list(row.row.arguments))}")
    stride = row.number(1, "stride", 2)
    return BuiltLayer(nn.MaxPool2d(2, stride), row.single(), reduction=stride)


LAYERS = tuple(sorted(_BUILDERS))
"""The supported layer names."""
