"""The description of a network: rows of (from, repeats, layer, arguments) and three multipliers.

A checkpoint contains its description; `vision.training.published` has the published ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from vision.yolo.checkpoint_error import shown
from vision.yolo.layers import ACTIVATIONS

_LARGEST_REPEATS = 64
# Defaults of omitted arguments; the first, the channels, has none.
C3K2_DEFAULTS = (None, False, 0.5, False, 1, True)
A2C2F_DEFAULTS = (None, True, 1, False, 2.0, 0.5, 1, True)
PUBLISHED_MLP_RATIOS = (2.0, 1.2)
SPPF_DEFAULTS = (None, 5, 3, False, True)
_LARGEST_ROWS = 128
_LARGEST_CLASS_WIDTH = 1 << 14
# Families with these layers have depthwise class branches in the head.
_LIGHT_CLASS_LAYERS = frozenset({"C3k2", "A2C2f", "C2fCIB", "v10Detect"})


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
                f"row {index} must be [from, repeats, layer, arguments], got {shown(row)}"
            )
        source, repeats, layer, arguments = row
        sources = tuple(source) if isinstance(source, list | tuple) else (source,)
        if not sources or not all(type(value) is int for value in sources):
            raise ArchitectureError(f"row {index}: 'from' must be row numbers, got {shown(source)}")
        if type(repeats) is not int or not 1 <= repeats <= _LARGEST_REPEATS:
            raise ArchitectureError(
                f"row {index}: repeats must be 1..{_LARGEST_REPEATS}, got {shown(repeats)}"
            )
        if not isinstance(layer, str) or not isinstance(arguments, list | tuple):
            raise ArchitectureError(f"row {index}: expected a layer's name and arguments, got {shown(row)}")
        return cls(sources, repeats, layer, tuple(arguments))

    def to_plain(self) -> list[Any]:
        source = self.source[0] if len(self.source) == 1 else list(self.source)
        return [source, self.repeats, self.layer, list(self.arguments)]

    def with_argument(self, position: int, value: Any, defaults: Sequence[Any]) -> LayerSpec:
        """The row with one argument set; omitted arguments before it are filled from `defaults`.

        A row that already has the value, explicitly or by `defaults`, stays unchanged.
        """
        arguments = [*self.arguments, *defaults[len(self.arguments) :]]
        if arguments[position] == value:
            return self
        arguments[position] = value
        return replace(self, arguments=tuple(arguments[: max(len(self.arguments), position + 1)]))


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


@dataclass(frozen=True, slots=True)
class ModelDescription:
    """Everything needed to build a network except its weights.

    Attributes:
        class_names: id → name.
        backbone, head: the rows, numbered consecutively from backbone to head.
        depth_multiple: multiplies the repeats of every row that has more than one.
        width_multiple: multiplies channel counts, rounded up to a multiple of 8.
        max_channels: limit of channel counts before the width multiple; None for no limit.
        channels: of the input image.
        reg_max: bins of the distribution over each box side; 1: the sides are predicted directly.
        activation: `SiLU` or `ReLU`.
        unscaled_channels: channel counts that the width multiple does not apply to. (Ultralytics' networks do
            not scale a row whose channel count equals the number of classes.)
        light_classes: the head's class branches are depthwise (YOLOv10, YOLO11 and later).
        class_width: channels within the head's class branches; None for the default.
        end_to_end: the head predicts each object once and needs no NMS.
    """

    class_names: tuple[str, ...]
    backbone: tuple[LayerSpec, ...]
    head: tuple[LayerSpec, ...]
    depth_multiple: float = 1.0
    width_multiple: float = 1.0
    max_channels: int | None = None
    channels: int = 3
    reg_max: int = 16
    activation: str = "SiLU"
    unscaled_channels: tuple[int, ...] = ()
    light_classes: bool = False
    class_width: int | None = None
    end_to_end: bool = False

    def __post_init__(self) -> None:
        if not self.class_names or not all(isinstance(name, str) for name in self.class_names):
            raise ArchitectureError(f"a model needs the names of its classes, got {shown(self.class_names)}")
        for name in self.class_names:
            if not name or not name.isprintable():
                raise ArchitectureError(f"a class name must be printable text, got {shown(name)}")
        for name in ("depth_multiple", "width_multiple"):
            value = getattr(self, name)
            if type(value) not in (int, float) or not 0 < value <= 16:
                raise ArchitectureError(f"{name} must be a number in 0..16, got {shown(value)}")
        limits = {"channels": 64, "reg_max": 256, "max_channels": None, "class_width": _LARGEST_CLASS_WIDTH}
        for name, largest in limits.items():
            value = getattr(self, name)
            if name in ("max_channels", "class_width") and value is None:
                continue
            if type(value) is not int or value < 1 or (largest is not None and value > largest):
                raise ArchitectureError(f"{name} must be a whole number from 1, got {shown(value)}")
        if not all(type(count) is int for count in self.unscaled_channels):
            raise ArchitectureError(
                f"unscaled_channels must be whole numbers, got {shown(self.unscaled_channels)}"
            )
        for name in ("light_classes", "end_to_end"):
            if not isinstance(getattr(self, name), bool):
                raise ArchitectureError(f"{name} must be true or false, got {shown(getattr(self, name))}")
        if not isinstance(self.activation, str) or self.activation not in ACTIVATIONS:
            raise ArchitectureError(
                f"unknown activation {shown(self.activation)}; known: {', '.join(ACTIVATIONS)}"
            )
        if not 1 <= len(self.rows) <= _LARGEST_ROWS:
            raise ArchitectureError(f"a network needs 1..{_LARGEST_ROWS} rows, got {len(self.rows)}")

    @property
    def rows(self) -> tuple[LayerSpec, ...]:
        """The rows of backbone and head, in execution order."""
        return self.backbone + self.head

    def to_plain(self) -> dict[str, Any]:
        """The description as plain dicts, lists, strings and numbers; the inverse of `from_plain`."""
        return {
            "nc": len(self.class_names),
            "names": list(self.class_names),
            "depth_multiple": self.depth_multiple,
            "width_multiple": self.width_multiple,
            "max_channels": self.max_channels,
            "channels": self.channels,
            "reg_max": self.reg_max,
            "activation": self.activation,
            "unscaled_channels": list(self.unscaled_channels),
            "light_classes": self.light_classes,
            "class_width": self.class_width,
            "end2end": self.end_to_end,
            "backbone": [row.to_plain() for row in self.backbone],
            "head": [row.to_plain() for row in self.head],
        }

    @classmethod
    def from_plain(
        cls, plain: Mapping[Any, Any], class_names: Sequence[str] | None = None
    ) -> ModelDescription:
        """Read a model table: our own (`to_plain`) or one with a `scales` table and a `scale` letter in it.

        Values that such a table implies by its scale or its layers are made explicit. `class_names` overrides
        the table's `names`. Raises `ArchitectureError`.
        """
        names = plain.get("names") if class_names is None else class_names
        if isinstance(names, str) or not isinstance(names, Sequence):
            raise ArchitectureError(f"a model needs a list of class names, got {shown(names)}")
        letter, depth, width, max_channels = _scale(plain)
        plain_rows = [*_list(plain, "backbone"), *_list(plain, "head")]
        rows = tuple(
            apply_scale(apply_pooling_form(LayerSpec.from_plain(row, index)), letter)
            for index, row in enumerate(plain_rows)
        )
        layers = {row.layer for row in rows}
        in_backbone = len(_list(plain, "backbone"))
        return cls(
            class_names=tuple(names),
            backbone=rows[:in_backbone],
            head=rows[in_backbone:],
            depth_multiple=depth,
            width_multiple=width,
            max_channels=max_channels,
            channels=_first(plain, 3, "channels", "ch"),
            reg_max=_first(plain, 16, "reg_max"),
            activation=_activation_name(_first(plain, "SiLU", "activation")),
            unscaled_channels=tuple(_list(plain, "unscaled_channels")),
            light_classes=_first(plain, not _LIGHT_CLASS_LAYERS.isdisjoint(layers), "light_classes"),
            class_width=plain.get("class_width"),
            end_to_end=_first(plain, "v10Detect" in layers, "end2end"),
        )


def _first(plain: Mapping[Any, Any], default: Any, *keys: str) -> Any:
    return next((plain[key] for key in keys if plain.get(key) is not None), default)


def _list(plain: Mapping[Any, Any], key: str) -> Sequence[Any]:
    value = plain.get(key, ())
    if not isinstance(value, list | tuple):
        raise ArchitectureError(f"`{key}` must be a list, got {shown(value)}")
    return value


def _activation_name(value: Any) -> Any:
    """`nn.SiLU()`, `torch.nn.SiLU` and `SiLU` name the same activation."""
    if not isinstance(value, str):
        return value
    return value.removesuffix("()").removeprefix("torch.").removeprefix("nn.")


def _scale(plain: Mapping[Any, Any]) -> tuple[str, Any, Any, Any]:
    """(letter or an empty text, depth multiple, width multiple, largest channel count)."""
    scales, letter = plain.get("scales"), plain.get("scale")
    if not scales:
        multiples = (_first(plain, 1.0, key) for key in ("depth_multiple", "width_multiple"))
        return (letter if isinstance(letter, str) else "", *multiples, plain.get("max_channels"))
    if not isinstance(scales, Mapping):
        raise ArchitectureError(f"`scales` must be a table, got {shown(scales)}")
    letter = letter or next(iter(scales))
    if not isinstance(letter, str) or letter not in scales:
        raise ArchitectureError(f"scale {shown(letter)} is not in the table {shown(list(scales))}")
    row = scales[letter]
    if not isinstance(row, list | tuple) or len(row) != 3:
        raise ArchitectureError(
            f"scale {shown(letter)} must be [depth, width, max_channels], got {shown(row)}"
        )
    return (letter, *row)
