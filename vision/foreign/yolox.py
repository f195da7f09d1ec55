"""YOLOX (Ge et al., 2021, arXiv:2107.08430): the network, and its authors' checkpoints.

The backbone is CSPDarknet with a focus layer, the neck a path aggregation network, the head is decoupled: for
each level one branch for the classes, one for box and objectness. Modules have the names of the authors'
weights. Depth, width and depthwise convolutions (nano) are taken from the weights themselves.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from vision.foreign.class_names import NamesError, names_beside
from vision.foreign.layouts import YOLOX_STRIDES, ForeignFacts, Pixels
from vision.yolo.checkpoint import check_weights
from vision.yolo.checkpoint_error import CheckpointError, one_line
from vision.yolo.checkpoint_file import read_archive

# Of the authors' training; torch's default is 1e-5.
_EPSILON = 1e-3
_STEM = "backbone.backbone.stem.conv.conv.weight"
_SCALES = {16: "nano", 24: "tiny", 32: "s", 48: "m", 64: "l", 80: "x"}
_MOST_BLOCKS = 64
_WIDEST = 512


@dataclass(frozen=True, slots=True)
class Shape:
    """What distinguishes the scales: blocks in the first stage, channels of the stem, classes."""

    depth: int
    width: int
    classes: int
    depthwise: bool


class _Conv(nn.Module):
    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int = 1, groups: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, groups=groups, bias=False)
        self.bn: nn.Module = nn.BatchNorm2d(outputs, eps=_EPSILON)
        self.act = nn.SiLU(inplace=True)

    def forward(self, x: Tensor) -> Tensor:
        result: Tensor = self.act(self.bn(self.conv(x)))
        return result


class _Depthwise(nn.Module):
    """A convolution of each channel, then one across the channels."""

    def __init__(self, inputs: int, outputs: int, kernel: int, stride: int = 1) -> None:
        super().__init__()
        self.dconv = _Conv(inputs, inputs, kernel, stride, groups=inputs)
        self.pconv = _Conv(inputs, outputs, 1)

    def forward(self, x: Tensor) -> Tensor:
        result: Tensor = self.pconv(self.dconv(x))
        return result


class _Focus(nn.Module):
    """Every second pixel of four phases as channels: twice the stride without a loss."""

    def __init__(self, outputs: int) -> None:
        super().__init__()
        self.conv = _Conv(12, outputs, 3)

    def forward(self, x: Tensor) -> Tensor:
        phases = [x[..., down::2, across::2] for across in (0, 1) for down in (0, 1)]
        result: Tensor = self.conv(torch.cat(phases, dim=1))
        return result


class _Bottleneck(nn.Module):
    def __init__(self, channels: int, shortcut: bool, depthwise: bool) -> None:
        super().__init__()
        self.conv1 = _Conv(channels, channels, 1)
        self.conv2 = (_Depthwise if depthwise else _Conv)(channels, channels, 3)
        self._shortcut = shortcut

    def forward(self, x: Tensor) -> Tensor:
        result: Tensor = self.conv2(self.conv1(x))
        return result + x if self._shortcut else result


class _Csp(nn.Module):
    """A cross-stage partial layer: half of the channels pass through the blocks."""

    def __init__(
        self, inputs: int, outputs: int, blocks: int, depthwise: bool, shortcut: bool = True
    ) -> None:
        super().__init__()
        half = outputs // 2
        self.conv1 = _Conv(inputs, half, 1)
        self.conv2 = _Conv(inputs, half, 1)
        self.conv3 = _Conv(2 * half, outputs, 1)
        self.m = nn.Sequential(*(_Bottleneck(half, shortcut, depthwise) for _ in range(blocks)))

    def forward(self, x: Tensor) -> Tensor:
        passing, kept = self.conv1(x), self.conv2(x)
        result: Tensor = self.conv3(torch.cat((self.m(passing), kept), dim=1))
        return result


class _Spp(nn.Module):
    """Spatial pyramid pooling: the maximum over three neighbourhoods."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.conv1 = _Conv(channels, channels // 2, 1)
        self.conv2 = _Conv(2 * channels, channels, 1)
        self.m = nn.ModuleList(nn.MaxPool2d(kernel, 1, kernel // 2) for kernel in (5, 9, 13))

    def forward(self, x: Tensor) -> Tensor:
        x = self.conv1(x)
        result: Tensor = self.conv2(torch.cat((x, *(pool(x) for pool in self.m)), dim=1))
        return result


class _Darknet(nn.Module):
    """The features at strides 8, 16 and 32."""

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        width, blocks, deep = shape.width, shape.depth, shape.depthwise
        down = _Depthwise if deep else _Conv

        def stage(inputs: int, repeats: int) -> nn.Sequential:
            return nn.Sequential(down(inputs, 2 * inputs, 3, 2), _Csp(2 * inputs, 2 * inputs, repeats, deep))

        self.stem = _Focus(width)
        self.dark2 = stage(width, blocks)
        self.dark3 = stage(2 * width, 3 * blocks)
        self.dark4 = stage(4 * width, 3 * blocks)
        last = 16 * width
        self.dark5 = nn.Sequential(
            down(8 * width, last, 3, 2), _Spp(last), _Csp(last, last, blocks, deep, shortcut=False)
        )

    def forward(self, x: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        fine = self.dark3(self.dark2(self.stem(x)))
        middle = self.dark4(fine)
        return fine, middle, self.dark5(middle)


class _Neck(nn.Module):
    def __init__(self, shape: Shape) -> None:
        super().__init__()
        width, blocks, deep = shape.width, shape.depth, shape.depthwise
        fine, middle, coarse = 4 * width, 8 * width, 16 * width
        down = _Depthwise if deep else _Conv
        self.backbone = _Darknet(shape)
        self.lateral_conv0 = _Conv(coarse, middle, 1)
        self.C3_p4 = _Csp(2 * middle, middle, blocks, deep, shortcut=False)
        self.reduce_conv1 = _Conv(middle, fine, 1)
        self.C3_p3 = _Csp(2 * fine, fine, blocks, deep, shortcut=False)
        self.bu_conv2 = down(fine, fine, 3, 2)
        self.C3_n3 = _Csp(2 * fine, middle, blocks, deep, shortcut=False)
        self.bu_conv1 = down(middle, middle, 3, 2)
        self.C3_n4 = _Csp(2 * middle, coarse, blocks, deep, shortcut=False)
        self._enlarge = nn.Upsample(scale_factor=2, mode="nearest")

    def forward(self, x: Tensor) -> list[Tensor]:
        fine, middle, coarse = self.backbone(x)
        top = self.lateral_conv0(coarse)
        between = self.reduce_conv1(self.C3_p4(torch.cat((self._enlarge(top), middle), dim=1)))
        first: Tensor = self.C3_p3(torch.cat((self._enlarge(between), fine), dim=1))
        second: Tensor = self.C3_n3(torch.cat((self.bu_conv2(first), between), dim=1))
        third: Tensor = self.C3_n4(torch.cat((self.bu_conv1(second), top), dim=1))
        return [first, second, third]


class _Head(nn.Module):
    def __init__(self, shape: Shape) -> None:
        super().__init__()
        width = 4 * shape.width
        conv = _Depthwise if shape.depthwise else _Conv
        levels = range(len(YOLOX_STRIDES))
        self.stems = nn.ModuleList(_Conv(width << level, width, 1) for level in levels)
        self.cls_convs = nn.ModuleList(
            nn.Sequential(conv(width, width, 3), conv(width, width, 3)) for _ in levels
        )
        self.reg_convs = nn.ModuleList(
            nn.Sequential(conv(width, width, 3), conv(width, width, 3)) for _ in levels
        )
        self.cls_preds = nn.ModuleList(nn.Conv2d(width, shape.classes, 1) for _ in levels)
        self.reg_preds = nn.ModuleList(nn.Conv2d(width, 4, 1) for _ in levels)
        self.obj_preds = nn.ModuleList(nn.Conv2d(width, 1, 1) for _ in levels)

    def forward(self, features: list[Tensor]) -> Tensor:
        found = []
        for level, feature in enumerate(features):
            x = self.stems[level](feature)
            classes, boxes = self.cls_convs[level](x), self.reg_convs[level](x)
            parts = (
                self.reg_preds[level](boxes),
                self.obj_preds[level](boxes).sigmoid(),
                self.cls_preds[level](classes).sigmoid(),
            )
            found.append(torch.cat(parts, dim=1).flatten(2))
        return torch.cat(found, dim=2).transpose(1, 2)


class Yolox(nn.Module):
    """(1, 3, H, W) BGR in 0..255, H and W multiples of 32 → (1, cells, 5 + classes).

    Each row has the box in cells (centre's offset, logarithm of the size), objectness and class
    probabilities.
    """

    def __init__(self, shape: Shape) -> None:
        super().__init__()
        self.classes = shape.classes
        self.backbone = _Neck(shape)
        self.head = _Head(shape)

    def forward(self, image: Tensor) -> Tensor:
        result: Tensor = self.head(self.backbone(image))
        return result

    def fuse(self) -> Yolox:
        """Fold the batch normalisations into the convolutions, in place."""
        for module in self.eval().modules():
            if isinstance(module, _Conv) and isinstance(module.bn, nn.BatchNorm2d):
                module.conv = fuse_conv_bn_eval(module.conv, module.bn)
                module.bn = nn.Identity()
        return self


def load_yolox(path: Path) -> tuple[Yolox, ForeignFacts] | None:
    """Read the authors' checkpoint, or one of their training; None if it is of another kind.

    Raises:
        CheckpointError: it cannot be read, or its weights do not fit the network; UnsafeCheckpointError.
    """
    content = read_archive(path)
    weights = content.get("model") if isinstance(content, dict) else None
    if not isinstance(weights, dict) or _STEM not in weights:
        return None
    try:
        model = _with_weights(weights)
        names, origin = names_beside(path, model.classes)
    except CheckpointError as error:
        raise CheckpointError(one_line(f"{path}: {error}")) from None
    except NamesError as error:
        raise CheckpointError(one_line(str(error))) from None
    width = weights[_STEM].shape[0]
    facts = ForeignFacts(
        names,
        f"YOLOX {_SCALES.get(width, 'of its own size')}",
        "detect",
        "yolox",
        max(YOLOX_STRIDES),
        None,
        Pixels(rgb=False, divisor=1.0, placement="corner"),
        names_from=origin,
    )
    return model, facts


def _with_weights(tensors: dict[str, Tensor]) -> Yolox:
    check_weights(tensors)
    with torch.device("meta"):
        model = Yolox(_shape_of(tensors))
    expected = model.state_dict()
    missing, unknown = sorted(expected.keys() - tensors.keys()), sorted(tensors.keys() - expected.keys())
    if missing or unknown:
        raise CheckpointError(
            f"is not a YOLOX of a known structure: {len(missing)} weights missing "
            f"({', '.join(missing[:3])}), {len(unknown)} unknown ({', '.join(unknown[:3])})"
        )
    converted = {}
    for name, target in expected.items():
        tensor = tensors[name]
        if tensor.shape != target.shape or tensor.is_floating_point() != target.is_floating_point():
            raise CheckpointError(
                f"{name} should be {tuple(target.shape)} of {target.dtype}, it is {tuple(tensor.shape)} of "
                f"{tensor.dtype}"
            )
        if tensor.is_floating_point() and not bool(tensor.isfinite().all()):
            raise CheckpointError(f"{name} has numbers that are not finite")
        converted[name] = tensor.to(target.dtype).contiguous()
    model.load_state_dict(converted, strict=True, assign=True)
    return model.eval().requires_grad_(False)


def _shape_of(tensors: Mapping[str, Tensor]) -> Shape:
    stem, classes = tensors[_STEM], tensors.get("head.cls_preds.0.weight")
    if stem.dim() != 4 or classes is None or classes.dim() != 4 or not 0 < stem.shape[0] <= _WIDEST:
        raise CheckpointError("is not a YOLOX of a known structure: its stem or its class branch is missing")
    blocks = "backbone.backbone.dark2.1.m."
    depth = len({name.split(".")[5] for name in tensors if name.startswith(blocks)})
    if not 0 < depth <= _MOST_BLOCKS:
        raise CheckpointError(f"has {depth} blocks in its first stage, expected 1..{_MOST_BLOCKS}")
    depthwise = "backbone.backbone.dark2.0.dconv.conv.weight" in tensors
    return Shape(depth, stem.shape[0], classes.shape[0], depthwise)
