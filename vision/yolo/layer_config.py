"""Builds the module of a description's row: checks its arguments, scales channels and repeats."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from torch import nn

from vision.yolo.attention import CHANNELS_PER_AREA_HEAD, CHANNELS_PER_HEAD
from vision.yolo.description import ArchitectureError, LayerSpec, ModelDescription
from vision.yolo.layer_arguments import LARGEST_KERNEL, LayerArguments
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

HEADS = ("Detect", "v10Detect")


@dataclass(frozen=True, slots=True)
class BuiltLayer:
    """A row's module, its output channels, and the factors by which it reduces and enlarges the size."""

    module: nn.Module
    channels: int
    reduction: int = 1
    enlargement: int = 1


def build_layer(row: LayerSpec, inputs: Sequence[int], description: ModelDescription) -> BuiltLayer:
    """Build the module of `row`, one of `LAYERS`, for inputs with `inputs` channels.

    Raises `ArchitectureError`.
    """
    return _BUILDERS[row.layer](LayerArguments(row, tuple(inputs), description))


def _conv(row: LayerArguments) -> BuiltLayer:
    row.takes(4)
    row.once()
    channels = row.channels()
    kernel = row.number(1, "kernel", LARGEST_KERNEL, 1)
    stride = row.number(2, "stride", 2, 1)
    padding = row.number(3, "padding", LARGEST_KERNEL, None) if len(row.row.arguments) > 3 else None
    if padding is None and kernel % 2 == 0:
        raise ArchitectureError(f"the kernel must be odd where no padding is given, got {kernel}")
    # Keeps every size a whole number of cells: exactly size / stride.
    if (2 * (same_padding(kernel) if padding is None else padding) - kernel) // stride != -1:
        raise ArchitectureError(f"a kernel of {kernel} with padding {padding} does not divide by its stride")
    module = Conv(row.single(), channels, kernel, stride, padding=padding, activation=row.activation)
    return BuiltLayer(module, channels, reduction=stride)


def _depthwise(row: LayerArguments) -> BuiltLayer:
    row.takes(3)
    row.once()
    channels = row.channels()
    kernel, stride = row.odd(1, "kernel", 1), row.number(2, "stride", 2, 1)
    module = DWConv(row.single(), channels, kernel, stride, activation=row.activation)
    return BuiltLayer(module, channels, reduction=stride)


def _scdown(row: LayerArguments) -> BuiltLayer:
    row.takes(3)
    row.once()
    channels = row.channels()
    kernel, stride = row.odd(1, "kernel", 3), row.number(2, "stride", 2, 2)
    module = SCDown(row.single(), channels, kernel, stride, activation=row.activation)
    return BuiltLayer(module, channels, reduction=stride)


def _partial(block: type[C2 | C2f | C3], shortcut: bool) -> Callable[[LayerArguments], BuiltLayer]:
    """The older cross-stage partial blocks, which differ in their default of `shortcut`."""

    def builder(row: LayerArguments) -> BuiltLayer:
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
        return BuiltLayer(module, channels)

    return builder


def _c3k2(row: LayerArguments) -> BuiltLayer:
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
    return BuiltLayer(module, channels)


def _a2c2f(row: LayerArguments) -> BuiltLayer:
    row.takes(8)
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
        activation=row.activation,
    )
    return BuiltLayer(module, channels)


def _c2fcib(row: LayerArguments) -> BuiltLayer:
    row.takes(3)
    channels = row.channels()
    shortcut, large = row.flag(1, "shortcut", False), row.flag(2, "large kernel", False)
    module = C2fCIB(row.single(), channels, row.repeats(), shortcut, large, activation=row.activation)
    return BuiltLayer(module, channels)


def _psa(row: LayerArguments) -> BuiltLayer:
    row.takes(1)
    row.once()
    channels = _attended(row)
    return BuiltLayer(PSA(channels, activation=row.activation), channels)


def _c2psa(row: LayerArguments) -> BuiltLayer:
    row.takes(1)
    channels = _attended(row)
    return BuiltLayer(C2PSA(channels, row.repeats(), activation=row.activation), channels)


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


def _sppf(row: LayerArguments) -> BuiltLayer:
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
    return BuiltLayer(module, channels)


def _upsample(row: LayerArguments) -> BuiltLayer:
    row.once()
    size, factor, mode = (*row.row.arguments, None, None, None)[:3]
    if size not in (None, "None") or type(factor) is not int or factor != 2 or mode != "nearest":
        raise ArchitectureError(
            f"only [None, 2, 'nearest'] is supported, got {list(row.row.arguments)!r:.200}"
        )
    return BuiltLayer(nn.Upsample(scale_factor=2, mode="nearest"), row.single(), enlargement=2)


def _concat(row: LayerArguments) -> BuiltLayer:
    row.once()
    if tuple(row.row.arguments) not in ((), (1,)):
        raise ArchitectureError(f"concatenates channels (axis 1), got {list(row.row.arguments)!r:.200}")
    return BuiltLayer(Concat(1), sum(row.inputs))


def _detect(row: LayerArguments) -> BuiltLayer:
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
    return BuiltLayer(module, 0)


_BUILDERS: dict[str, Callable[[LayerArguments], BuiltLayer]] = {
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
LAYERS = tuple(sorted(_BUILDERS))
"""The supported layer names."""
