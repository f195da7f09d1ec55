"""Converts a trained model for inference: raw pixels as input, selected classes, separate outputs.

The changes do not alter the results beyond rounding:

* The first convolution takes the bytes of a BGR image: the division by 255 and the channel order are folded
  into its weights.
* In the last convolution of the class branches only the selected classes' rows are kept.
* Box sides and class logits stay separate, which saves concatenating and splitting them; and with
  `sparse_boxes` the box branches are left out, as `BoxBranch` computes them only for candidate cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np
import torch
from torch import Tensor, nn

from vision.runtimes.base import RuntimeUnusableError
from vision.yolo.architecture import YoloModel
from vision.yolo.heads import OBB, Detect
from vision.yolo.level_outputs import BoxBranch, ClassRows, Head
from vision.yolo.postprocess import head_of


class Network(nn.Module):
    """(1, H, W, 3) uint8 BGR → for each level the outputs of `Head.kinds`.

    All outputs are (1, C, H / stride, W / stride) float32, in one flat tuple. `names` has their names.

    Args:
        model: is modified; do not use it afterwards.
        class_ids: sorted; the classes to compute. None: all.
        sparse_boxes: return the neck's features, from which the candidates' boxes are computed later, instead
            of all sides.
    """

    def __init__(
        self, model: YoloModel, class_ids: Sequence[int] | None = None, *, sparse_boxes: bool = False
    ) -> None:
        super().__init__()
        if model.description.channels != 3:
            raise RuntimeUnusableError(
                f"the model takes {model.description.channels} channels, frames have 3"
            )
        model.fuse().requires_grad_(False)
        self.head = _sliced(head_of(model), model.detect, class_ids)
        if sparse_boxes:
            self.head = replace(self.head, boxes=_box_branches(model.detect, model.description.activation))
        model.model[-1] = _SplitHead(model.detect, self.head.kinds)
        self._folded = _fold_pixels(model)
        self.body = model
        self.dtype = torch.float32
        self.eval()

    @property
    def names(self) -> list[str]:
        """Names of the outputs, in their order."""
        return [f"{kind}_{stride}" for stride in self.head.strides for kind in self.head.kinds]

    def in_precision(self, dtype: torch.dtype) -> Network:
        """Compute in `dtype`, except for the last class convolutions, which decide the class; in place."""
        self.dtype = dtype
        self.body.to(dtype)
        for branch in _branches(self.body.detect.class_branches):
            branch[-1].float()
        return self

    def channels_last(self) -> Network:
        """Store the weights as (out, height, width, in), in place: the faster layout on processors."""
        for parameter in self.parameters():
            if parameter.dim() == 4:
                parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)
        return self

    def forward(self, image_bgr: Tensor) -> tuple[Tensor, ...]:
        # The permuted tensor is already channels-last in memory: no copy except the conversion, which comes
        # first because TensorRT requires it for bytes.
        pixels = image_bgr.to(self.dtype).permute(0, 3, 1, 2)
        if not self._folded:
            pixels = pixels.flip(1) / 255
        outputs: Sequence[Tensor] = self.body(pixels)
        return tuple(outputs)


class _SplitHead(Detect):
    """The head's branches with separate outputs."""

    def __init__(self, head: Detect, kinds: tuple[str, ...]) -> None:
        nn.Module.__init__(self)
        self.whole, self.kinds = head, kinds

    @property
    def class_branches(self) -> nn.ModuleList:
        return self.whole.class_branches

    def forward(self, neck: Sequence[Tensor]) -> list[Tensor]:
        outputs: list[Tensor] = []
        for level, (x, classes) in enumerate(zip(neck, _branches(self.class_branches), strict=True)):
            features = classes[:-1](x).float()
            boxes = x if "neck" in self.kinds else self.whole.sides(level, x)
            outputs += [boxes.float(), classes[-1](features)]
            if "features" in self.kinds:
                outputs.append(features)
        return outputs


def _branches(branches: nn.ModuleList) -> list[nn.Sequential]:
    return [cast(nn.Sequential, branch) for branch in branches]


def _sliced(head: Head, detect: Detect, class_ids: Sequence[int] | None) -> Head:
    """Keep the selected classes' rows of the last convolutions, and `rows` to detect other winners."""
    if class_ids is None or len(class_ids) == head.class_count:
        return head
    rows = []
    index = torch.tensor(list(class_ids))
    for branch in _branches(detect.class_branches):
        last = cast(nn.Conv2d, branch[-1])
        assert last.bias is not None
        weight, bias = last.weight.detach().float(), last.bias.detach().float()
        rows.append(ClassRows.distinct(weight.flatten(1).numpy(), bias.numpy()))
        last.weight.data = weight[index].clone()
        last.bias.data = bias[index].clone()
        last.out_channels = len(index)
    # In an end-to-end head the classes do not compete.
    wins = None if head.end_to_end else tuple(rows)
    return replace(head, class_ids=tuple(int(index) for index in class_ids), rows=wins)


def _box_branches(detect: Detect, activation: str) -> tuple[BoxBranch, ...] | None:
    """The box branches' weights in `BoxBranch`'s layout; None for branches of another structure."""
    if isinstance(detect, OBB):
        return None
    result = []
    for branch in _branches(detect.box_branches):
        layers = [cast(nn.Conv2d, getattr(layer, "conv", layer)) for layer in branch]
        shapes = [(layer.kernel_size, layer.stride, layer.padding, layer.groups) for layer in layers]
        if shapes != [((3, 3), (1, 1), (1, 1), 1)] * 2 + [((1, 1), (1, 1), (0, 0), 1)]:
            return None
        weights = [layer.weight.detach().float().permute(2, 3, 1, 0) for layer in layers]
        first, second, last = (
            np.ascontiguousarray(weight.reshape(-1, weight.shape[-1]).numpy()) for weight in weights
        )
        biases = tuple(cast(Tensor, layer.bias).detach().float().numpy().copy() for layer in layers)
        result.append(BoxBranch((first, second, last), (biases[0], biases[1], biases[2]), activation))
    return tuple(result)


def _fold_pixels(model: YoloModel) -> bool:
    """RGB in 0..1 → BGR in 0..255, in the weights of the one convolution that reads the image.

    False if another layer of the description reads it.
    """
    first = getattr(model.model[0], "conv", None)
    readers = [index for index, sources in enumerate(model._sources) if -1 in sources]
    if readers != [0] or not isinstance(first, nn.Conv2d) or first.groups != 1:
        return False
    first.weight.data = first.weight.data.double().flip(1).div(255).float()
    return True
