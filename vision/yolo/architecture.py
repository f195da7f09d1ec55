"""The network, built row by row from its description.

`build` creates it with random weights. A description comes from a checkpoint, or from
`vision.training.published`.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from vision.yolo.checkpoint_error import shown
from vision.yolo.description import ArchitectureError, LayerSpec, ModelDescription
from vision.yolo.gelan import CBFuse, RepConv
from vision.yolo.heads import Detect
from vision.yolo.layer_config import HEADS, LAYERS, build_layer
from vision.yolo.layers import ACTIVATIONS, Concat, Conv, LargeKernelDWConv

__all__ = ["ArchitectureError", "LayerSpec", "ModelDescription", "YoloModel", "build", "build_shapes"]

_IMAGE = -1
# The deepest published network repeats 48 blocks; far more is not a valid description.
_MAX_TOTAL_REPEATS = 256
_LARGEST_STRIDE = 128


class YoloModel(nn.Module):
    """A built network. `model` holds one module per row of `description`; `strides` one number per level.

    Sides of the input must be multiples of the largest stride.
    """

    def __init__(self, description: ModelDescription) -> None:
        super().__init__()
        self.description = description
        layers, self._sources, self.strides = _build_layers(description)
        self.model = nn.ModuleList(layers)
        for module in self.modules():
            if isinstance(module, Conv | RepConv) and isinstance(module.act, nn.SiLU):
                module.act = ACTIVATIONS[description.activation](inplace=True)
        self._last_use = {source: index for index, sources in enumerate(self._sources) for source in sources}
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
        """Bins of a box side in the outputs; 1: distances in cells."""
        return self.detect.reg_max

    @property
    def end_to_end(self) -> bool:
        """Whether the head predicts each object once: its boxes need no NMS."""
        return self.detect.end_to_end

    def forward(self, x: Tensor) -> list[Tensor]:
        """(B, channels, H, W) RGB in 0..1, H and W multiples of the largest stride → one output per stride.

        Each is (B, 4 · reg_max + classes, H / stride, W / stride): first the four box sides (left, top,
        right, bottom), as logits of their distributions or, with `reg_max` 1, distances in cells; then the
        class logits. An end-to-end head returns its one-to-one outputs in evaluation, the others in training.
        """
        outputs: dict[int, Tensor] = {_IMAGE: x}
        for index, (layer, sources) in enumerate(zip(self.model, self._sources, strict=True)):
            inputs = [outputs[source] for source in sources]
            for source in set(sources):
                if self._last_use[source] == index:
                    del outputs[source]
            outputs[index] = layer(inputs if isinstance(layer, Concat | CBFuse | Detect) else inputs[0])
        levels: list[Tensor] = list(outputs[len(self.model) - 1])
        return levels

    def fuse(self) -> YoloModel:
        """Fold every batch normalisation into its convolution, in place, and switch to inference.

        Branches that inference does not use are dropped.
        """
        self.eval()
        for module in list(self.modules()):
            if isinstance(module, Conv | LargeKernelDWConv | RepConv | Detect):
                module.fuse()
        return self


def build(description: ModelDescription) -> YoloModel:
    """Build a network with random weights. Raises `ArchitectureError` naming the row that cannot be built."""
    return YoloModel(description)


def build_shapes(description: ModelDescription) -> YoloModel:
    """Build the network on the meta device, which needs no memory for weights. Raises as `build` does."""
    with torch.device("meta"):
        return YoloModel(description)


def _build_layers(
    description: ModelDescription,
) -> tuple[list[nn.Module], list[tuple[int, ...]], tuple[int, ...]]:
    """One module per row; for each row the indices of the rows it reads (-1: the image); the strides."""
    layers: list[nn.Module] = []
    sources: list[tuple[int, ...]] = []
    channels = {_IMAGE: description.channels}
    reduction = {_IMAGE: 1}
    parts: dict[int, tuple[int, ...]] = {}
    last = len(description.rows) - 1
    if sum(row.repeats for row in description.rows if row.repeats > 1) * description.depth_multiple > (
        _MAX_TOTAL_REPEATS
    ):
        raise ArchitectureError(f"repeats more than {_MAX_TOTAL_REPEATS} blocks in total")
    for index, row in enumerate(description.rows):
        reads = tuple(index + source if source < 0 else source for source in row.source)
        if not all(source in channels for source in reads):
            raise ArchitectureError(f"row {index} ({row.layer}) reads {row.source}, rows before it only")
        if (row.layer in HEADS) != (index == last):
            raise ArchitectureError(
                f"row {index} is {shown(row.layer)}: the last row, and no other, must be 'Detect'"
            )
        if len({reduction[source] for source in reads}) > 1 and row.layer not in (*HEADS, "CBFuse"):
            raise ArchitectureError(f"row {index} ({row.layer}) joins inputs of different sizes")
        if row.layer not in LAYERS:
            raise ArchitectureError(
                f"row {index}: unknown layer {shown(row.layer)}; known: {', '.join(LAYERS)}"
            )
        try:
            _check_padding(row, [description.rows[source].layer for source in reads if source >= 0])
            widths = [channels[source] for source in reads]
            built = build_layer(row, widths, description, [parts.get(source, ()) for source in reads])
        except ArchitectureError as error:
            raise ArchitectureError(f"row {index} ({row.layer}): {error}") from None
        layers.append(built.module)
        sources.append(reads)
        channels[index] = built.channels
        parts[index] = built.parts
        reduction[index] = reduction[reads[-1]] * built.reduction // built.enlargement
    strides = tuple(reduction[source] for source in sources[-1])
    if strides[0] < 2 or strides[-1] > _LARGEST_STRIDE or list(strides) != sorted(set(strides)):
        raise ArchitectureError(
            f"row {last}: Detect must read inputs each smaller than the one before, got strides {strides}"
        )
    return layers, sources, strides


def _check_padding(row: LayerSpec, read: list[str]) -> None:
    """YOLOv3-tiny's only padding keeps the size in a pooling at stride 1: neither may stand alone."""
    if (row.layer == "nn.MaxPool2d" and tuple(row.arguments) == (2, 1, 0)) != ("nn.ZeroPad2d" in read):
        raise ArchitectureError("a pooling at stride 1 must read a padding by one, and nothing else may")
