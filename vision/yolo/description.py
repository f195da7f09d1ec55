"""The description of a network: rows of (from, repeats, layer, arguments) and three multipliers.

A checkpoint contains its description; `yolov8_description` and `published_description` return the published
ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from vision.yolo.convolution import ACTIVATIONS
from vision.yolo.layer_spec import ArchitectureError, LayerSpec, apply_pooling_form, apply_scale

__all__ = ["YOLOV8_SCALES", "ArchitectureError", "LayerSpec", "ModelDescription", "yolov8_description"]

# scale → depth multiple, width multiple, largest channel count before the width multiple (published table).
YOLOV8_SCALES: dict[str, tuple[float, float, int]] = {
    "n": (0.33, 0.25, 1024),
    "s": (0.33, 0.50, 1024),
    "m": (0.67, 0.75, 768),
    "l": (1.0, 1.00, 512),
    "x": (1.0, 1.25, 512),
}
_LARGEST_ROWS = 128
_LARGEST_CLASS_WIDTH = 1 << 14
# Families with these layers have depthwise class branches in the head.
_LIGHT_CLASS_LAYERS = frozenset({"C3k2", "A2C2f", "C2fCIB", "v10Detect"})


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
            raise ArchitectureError(f"a model needs the names of its classes, got {self.class_names!s:.200}")
        for name in self.class_names:
            if not name or not name.isprintable():
                raise ArchitectureError(f"a class name must be printable text, got {name!r:.100}")
        for name in ("depth_multiple", "width_multiple"):
            value = getattr(self, name)
            if type(value) not in (int, float) or not 0 < value <= 16:
                raise ArchitectureError(f"{name} must be a number in 0..16, got {value!r:.200}")
        limits = {"channels": 64, "reg_max": 256, "max_channels": None, "class_width": _LARGEST_CLASS_WIDTH}
        for name, largest in limits.items():
            value = getattr(self, name)
            if name in ("max_channels", "class_width") and value is None:
                continue
            if type(value) is not int or value < 1 or (largest is not None and value > largest):
                raise ArchitectureError(f"{name} must be a whole number from 1, got {value!r:.200}")
        if not all(type(count) is int for count in self.unscaled_channels):
            raise ArchitectureError(
                f"unscaled_channels must be whole numbers, got {self.unscaled_channels!r:.99}"
            )
        for name in ("light_classes", "end_to_end"):
            if not isinstance(getattr(self, name), bool):
                raise ArchitectureError(f"{name} must be true or false, got {getattr(self, name)!r:.200}")
        if not isinstance(self.activation, str) or self.activation not in ACTIVATIONS:
            raise ArchitectureError(
                f"unknown activation {self.activation!r:.200}; known: {', '.join(ACTIVATIONS)}"
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
            raise ArchitectureError(f"a model needs a list of class names, got {names!r:.200}")
        depth, width, max_channels = _multiples(plain)
        plain_rows = [*_list(plain, "backbone"), *_list(plain, "head")]
        rows = tuple(
            apply_scale(apply_pooling_form(LayerSpec.from_plain(row, index)), _scale(plain))
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
            channels=_first(plain, ("channels", "ch"), 3),
            reg_max=_first(plain, ("reg_max",), 16),
            activation=_activation_name(_first(plain, ("activation",), "SiLU")),
            unscaled_channels=tuple(_list(plain, "unscaled_channels")),
            light_classes=_first(plain, ("light_classes",), not _LIGHT_CLASS_LAYERS.isdisjoint(layers)),
            class_width=plain.get("class_width"),
            end_to_end=_first(plain, ("end2end",), "v10Detect" in layers),
        )


def yolov8_description(scale: str | tuple[float, float, int], class_names: Sequence[str]) -> ModelDescription:
    """The published YOLOv8 network.

    Args:
        scale: `n`, `s`, `m`, `l`, `x`, or (depth multiple, width multiple, largest channel count).
        class_names: id → name.
    """
    if isinstance(scale, str):
        if scale not in YOLOV8_SCALES:
            raise ArchitectureError(f"unknown scale {scale!r}; known: {', '.join(YOLOV8_SCALES)}")
        scale = YOLOV8_SCALES[scale]
    depth, width, max_channels = scale
    previous = (-1,)

    def down(channels: int) -> LayerSpec:
        return LayerSpec(previous, 1, "Conv", (channels, 3, 2))

    upsample = LayerSpec(previous, 1, "nn.Upsample", (None, 2, "nearest"))
    backbone = (
        down(64),
        down(128),
        LayerSpec(previous, 3, "C2f", (128, True)),
        down(256),
        LayerSpec(previous, 6, "C2f", (256, True)),
        down(512),
        LayerSpec(previous, 6, "C2f", (512, True)),
        down(1024),
        LayerSpec(previous, 3, "C2f", (1024, True)),
        LayerSpec(previous, 1, "SPPF", (1024, 5)),
    )
    head = (
        upsample,
        LayerSpec((-1, 6), 1, "Concat", (1,)),
        LayerSpec(previous, 3, "C2f", (512,)),
        upsample,
        LayerSpec((-1, 4), 1, "Concat", (1,)),
        LayerSpec(previous, 3, "C2f", (256,)),
        down(256),
        LayerSpec((-1, 12), 1, "Concat", (1,)),
        LayerSpec(previous, 3, "C2f", (512,)),
        down(512),
        LayerSpec((-1, 9), 1, "Concat", (1,)),
        LayerSpec(previous, 3, "C2f", (1024,)),
        LayerSpec((15, 18, 21), 1, "Detect", ("nc",)),
    )
    return ModelDescription(tuple(class_names), backbone, head, depth, width, max_channels)


def _first(plain: Mapping[Any, Any], keys: Sequence[str], default: Any) -> Any:
    for key in keys:
        if plain.get(key) is not None:
            return plain[key]
    return default


def _list(plain: Mapping[Any, Any], key: str) -> Sequence[Any]:
    value = plain.get(key, ())
    if not isinstance(value, list | tuple):
        raise ArchitectureError(f"`{key}` must be a list, got {value!r:.200}")
    return value


def _activation_name(value: Any) -> Any:
    """`nn.SiLU()`, `torch.nn.SiLU` and `SiLU` name the same activation."""
    if not isinstance(value, str):
        return value
    return value.removesuffix("()").removeprefix("torch.").removeprefix("nn.")


def _multiples(plain: Mapping[Any, Any]) -> tuple[float, float, int | None]:
    """(depth multiple, width multiple, largest channel count) of a model table."""
    scales = plain.get("scales")
    if not scales:
        return (
            _first(plain, ("depth_multiple",), 1.0),
            _first(plain, ("width_multiple",), 1.0),
            plain.get("max_channels"),
        )
    if not isinstance(scales, Mapping):
        raise ArchitectureError(f"`scales` must be a table, got {scales!r:.200}")
    scale = plain.get("scale") or next(iter(scales))
    if not isinstance(scale, str) or scale not in scales:
        raise ArchitectureError(f"scale {scale!r:.100} is not in the table {', '.join(map(str, scales))}")
    row = scales[scale]
    if not isinstance(row, list | tuple) or len(row) != 3:
        raise ArchitectureError(f"scale {scale!r} must be [depth, width, max_channels], got {row!r:.200}")
    depth, width, max_channels = row
    return depth, width, max_channels


def _scale(plain: Mapping[Any, Any]) -> str:
    """The letter of the scale; empty if the table has none. `_multiples` rejects invalid ones."""
    scales = plain.get("scales")
    first = next(iter(scales)) if isinstance(scales, Mapping) and scales else ""
    scale = plain.get("scale") or first
    return scale if isinstance(scale, str) else ""
