"""The network, built row by row from its description.

`build` makes it with fresh weights; the description comes from a checkpoint or from `yolov8_description`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from vision.yolo.description import ArchitectureError, LayerRow, ModelDescription, yolov8_description
from vision.yolo.layers import SPPF, C2f, Concat, Conv, Detect

__all__ = [
    "STRIDES",
    "ArchitectureError",
    "LayerRow",
    "ModelDescription",
    "YoloModel",
    "anchor_points",
    "build",
    "decode_boxes",
    "yolov8_description",
]

STRIDES = (8, 16, 32)
_IMAGE = -1
_LARGEST_CHANNELS = 1 << 14
_MOST_REPEATS = 64


class YoloModel(nn.Module):
    """A built network. `model` holds one module per row of `description`; `strides` one number per level."""

    def __init__(self, description: ModelDescription) -> None:
        super().__init__()
        self.description = description
        layers, self._sources = _build_layers(description)
        self.model = nn.ModuleList(layers)
        self._last_use = {source: index for index, sources in enumerate(self._sources) for source in sources}
        self.strides = STRIDES
        self.detect.initialise_biases(self.strides)

    @property
    def detect(self) -> Detect:
        """The head, the last layer."""
        last = self.model[-1]
        assert isinstance(last, Detect)
        return last

    @property
    def class_names(self) -> tuple[str, ...]:
        return self.description.class_names

    @property
    def reg_max(self) -> int:
        return self.description.reg_max

    def forward(self, x: Tensor) -> list[Tensor]:
        """(B, channels, H, W) RGB in 0..1, H and W multiples of 32 → raw maps, one per stride.

        Each is (B, 4 · reg_max + classes, H / stride, W / stride): first the logits of the four box sides'
        distributions (left, top, right, bottom), then the class logits.
        """
        outputs: dict[int, Tensor] = {_IMAGE: x}
        for index, (layer, sources) in enumerate(zip(self.model, self._sources, strict=True)):
            inputs = [outputs[source] for source in sources]
            for source in set(sources):
                if self._last_use[source] == index:
                    del outputs[source]
            outputs[index] = layer(inputs if isinstance(layer, Concat | Detect) else inputs[0])
        maps: list[Tensor] = list(outputs[len(self.model) - 1])
        return maps

    def decode(self, maps: Sequence[Tensor]) -> Tensor:
        """Raw maps → (B, N, 4 + classes): xyxy in pixels of the network's input, then scores in 0..1."""
        flat = torch.cat([level.flatten(2) for level in maps], dim=2).transpose(1, 2)
        sides, logits = torch.split(flat, [4 * self.reg_max, len(self.class_names)], dim=2)
        centres, strides = anchor_points(maps, self.strides)
        boxes = decode_boxes(self.detect.dfl(sides), centres, strides)
        return torch.cat((boxes, logits.sigmoid()), dim=2)

    def fuse(self) -> YoloModel:
        """Fold every batch normalisation into its convolution, in place, and switch to inference."""
        self.eval()
        for module in self.modules():
            if isinstance(module, Conv):
                module.fuse()
        return self


def build(description: ModelDescription) -> YoloModel:
    """A network with fresh weights. Raises `ArchitectureError` naming the row that cannot be built."""
    return YoloModel(description)


def anchor_points(maps: Sequence[Tensor], strides: Sequence[int]) -> tuple[Tensor, Tensor]:
    """The middle of every cell, level by level and row by row.

    Returns (N, 2) x, y in cells of the point's own level, and (N, 1) the level's stride in pixels.
    """
    centres, steps = [], []
    for level, stride in zip(maps, strides, strict=True):
        height, width = level.shape[-2:]
        y, x = torch.meshgrid(
            torch.arange(height, dtype=torch.float32, device=level.device) + 0.5,
            torch.arange(width, dtype=torch.float32, device=level.device) + 0.5,
            indexing="ij",
        )
        centres.append(torch.stack((x, y), dim=-1).view(-1, 2))
        steps.append(torch.full((height * width, 1), float(stride), device=level.device))
    return torch.cat(centres), torch.cat(steps)


def decode_boxes(distances: Tensor, centres: Tensor, strides: Tensor) -> Tensor:
    """Distances from a cell's middle (…, N, 4: left, top, right, bottom, in cells) → xyxy in pixels."""
    return torch.cat((centres - distances[..., :2], centres + distances[..., 2:]), dim=-1) * strides


def _build_layers(description: ModelDescription) -> tuple[list[nn.Module], list[tuple[int, ...]]]:
    """One module per row, and for each row the numbers of the rows it reads (-1: the image)."""
    layers: list[nn.Module] = []
    sources: list[tuple[int, ...]] = []
    channels = {_IMAGE: description.channels}
    reduction = {_IMAGE: 1}
    last = len(description.rows) - 1
    for index, row in enumerate(description.rows):
        reads = tuple(index + source if source < 0 else source for source in row.source)
        if not all(source in channels for source in reads):
            raise ArchitectureError(f"row {index} ({row.layer}) reads {row.source}, rows before it only")
        if (row.layer == "Detect") != (index == last):
            raise ArchitectureError(
                f"row {index} is {row.layer!r:.100}: the last row, and no other, must be 'Detect'"
            )
        maker = _LAYERS.get(row.layer)
        if maker is None:
            raise ArchitectureError(
                f"row {index}: unknown layer {row.layer!r:.100}; known are {', '.join(sorted(_LAYERS))}"
            )
        inputs = tuple(channels[source] for source in reads)
        if len({reduction[source] for source in reads}) > 1 and row.layer != "Detect":
            raise ArchitectureError(f"row {index} ({row.layer}) joins maps of different sizes")
        if row.layer == "Detect" and tuple(reduction[source] for source in reads) != STRIDES:
            raise ArchitectureError(
                f"row {index}: Detect must read maps reduced by {STRIDES}, "
                f"got {tuple(reduction[source] for source in reads)}"
            )
        try:
            made = maker(inputs, row, description)
        except ArchitectureError as error:
            raise ArchitectureError(f"row {index} ({row.layer}): {error}") from None
        layers.append(made.module)
        sources.append(reads)
        channels[index] = made.channels
        reduction[index] = reduction[reads[0]] * made.reduction // made.enlargement
    return layers, sources


@dataclass(frozen=True, slots=True)
class _Made:
    module: nn.Module
    channels: int
    reduction: int = 1
    enlargement: int = 1


def _scaled_channels(count: int, description: ModelDescription) -> int:
    if count in description.unscaled_channels:
        return count
    limited = count if description.max_channels is None else min(count, description.max_channels)
    return max(8, math.ceil(limited * description.width_multiple / 8) * 8)


def _scaled_repeats(row: LayerRow, description: ModelDescription) -> int:
    if row.repeats == 1:
        return 1
    repeats = max(1, round(row.repeats * description.depth_multiple))
    if repeats > _MOST_REPEATS:
        raise ArchitectureError(f"would repeat {repeats} times, at most {_MOST_REPEATS} make sense")
    return repeats


def _single(inputs: tuple[int, ...], row: LayerRow) -> int:
    if len(inputs) != 1:
        raise ArchitectureError(f"reads one row, got {row.source}")
    return inputs[0]


def _number(row: LayerRow, position: int, name: str, largest: int, default: int | None = None) -> int:
    value = row.arguments[position] if position < len(row.arguments) else default
    if type(value) is not int or not 1 <= value <= largest:
        raise ArchitectureError(f"{name} must be a whole number in 1..{largest}, got {value!r:.100}")
    return value


def _arguments(row: LayerRow, most: int) -> None:
    if len(row.arguments) > most:
        raise ArchitectureError(f"takes at most {most} arguments, got {list(row.arguments)!r:.200}")


def _once(row: LayerRow) -> None:
    if row.repeats != 1:
        raise ArchitectureError(f"cannot repeat, got repeats {row.repeats}")


def _conv(inputs: tuple[int, ...], row: LayerRow, description: ModelDescription) -> _Made:
    _arguments(row, 3)
    _once(row)
    channels = _scaled_channels(_number(row, 0, "channels", _LARGEST_CHANNELS), description)
    kernel = _number(row, 1, "kernel", 31, 1)
    stride = _number(row, 2, "stride", 2, 1)
    if kernel % 2 == 0:
        raise ArchitectureError(f"the kernel must be odd, got {kernel}")
    module = Conv(_single(inputs, row), channels, kernel, stride, activation=description.activation)
    return _Made(module, channels, reduction=stride)


def _c2f(inputs: tuple[int, ...], row: LayerRow, description: ModelDescription) -> _Made:
    _arguments(row, 2)
    channels = _scaled_channels(_number(row, 0, "channels", _LARGEST_CHANNELS), description)
    shortcut = row.arguments[1] if len(row.arguments) > 1 else False
    if not isinstance(shortcut, bool):
        raise ArchitectureError(f"the shortcut must be true or false, got {shortcut!r:.100}")
    repeats = _scaled_repeats(row, description)
    module = C2f(_single(inputs, row), channels, repeats, shortcut, activation=description.activation)
    return _Made(module, channels)


def _sppf(inputs: tuple[int, ...], row: LayerRow, description: ModelDescription) -> _Made:
    _arguments(row, 2)
    _once(row)
    channels = _scaled_channels(_number(row, 0, "channels", _LARGEST_CHANNELS), description)
    kernel = _number(row, 1, "kernel", 31, 5)
    if kernel % 2 == 0:
        raise ArchitectureError(f"the kernel must be odd, got {kernel}")
    return _Made(SPPF(_single(inputs, row), channels, kernel, activation=description.activation), channels)


def _upsample(inputs: tuple[int, ...], row: LayerRow, description: ModelDescription) -> _Made:
    _once(row)
    size, factor, mode = (*row.arguments, None, None, None)[:3]
    if size not in (None, "None") or type(factor) is not int or factor != 2 or mode != "nearest":
        raise ArchitectureError(f"only [None, 2, 'nearest'] is known, got {list(row.arguments)!r:.200}")
    return _Made(nn.Upsample(scale_factor=2, mode="nearest"), _single(inputs, row), enlargement=2)


def _concat(inputs: tuple[int, ...], row: LayerRow, description: ModelDescription) -> _Made:
    _once(row)
    if tuple(row.arguments) not in ((), (1,)):
        raise ArchitectureError(f"joins channels (axis 1), got {list(row.arguments)!r:.200}")
    return _Made(Concat(1), sum(inputs))


def _detect(inputs: tuple[int, ...], row: LayerRow, description: ModelDescription) -> _Made:
    _once(row)
    if tuple(row.arguments) not in (("nc",), (len(description.class_names),)):
        raise ArchitectureError(
            f"takes the number of classes, {len(description.class_names)}, got {list(row.arguments)!r:.200}"
        )
    module = Detect(
        len(description.class_names), inputs, description.reg_max, activation=description.activation
    )
    return _Made(module, 0)


_LAYERS: dict[str, Callable[[tuple[int, ...], LayerRow, ModelDescription], _Made]] = {
    "Conv": _conv,
    "C2f": _c2f,
    "SPPF": _sppf,
    "nn.Upsample": _upsample,
    "Upsample": _upsample,
    "Concat": _concat,
    "Detect": _detect,
}
