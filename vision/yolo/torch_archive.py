"""Reads the archive that `torch.save` writes, by `torch.load(weights_only=True)`: nothing in it is run.

Each class that a detection checkpoint may name is read as a `Stub`.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import torch

from vision.yolo.checkpoint_error import UnsafeCheckpointError, shown


class Stub:
    """Stand-in for an object of class `name`: its constructor's arguments and its attributes."""

    name = ""
    arguments: tuple[Any, ...]
    state: dict[Any, Any]

    # Not `__init__`: a pickle makes most objects without it.
    def __new__(cls, *arguments: Any) -> Stub:
        stub = super().__new__(cls)
        stub.arguments, stub.state = arguments, {}
        return stub

    def __setstate__(self, state: Any) -> None:
        # Some classes (numpy.dtype) have a state of another kind; it is not used.
        if isinstance(state, dict):
            self.state.update(state)


# Names that a detection checkpoint may contain: layers and plain values. Each is read as a stub. A name here
# makes the file readable, so that the builder can report an unknown layer; it allows no code to run.
_TORCH_MODULES = """activation.GELU activation.Hardswish activation.LeakyReLU activation.ReLU activation.ReLU6
    activation.SiLU activation.Sigmoid batchnorm.BatchNorm2d container.ModuleList container.Sequential
    conv.Conv2d conv.ConvTranspose2d dropout.Dropout linear.Identity linear.Linear loss.BCEWithLogitsLoss
    module.Module padding.ZeroPad2d pooling.AdaptiveAvgPool2d pooling.MaxPool2d upsampling.Upsample"""
_BLOCKS = """A2C2f AAttn ABlock AConv ADown Attention Bottleneck C2 C2PSA C2f C2fCIB C3 C3k C3k2 CBFuse
    CBLinear CIB DFL ELAN1 PSA PSABlock Proto RepBottleneck RepCSP RepNCSPELAN4 RepVGGDW SCDown SPPELAN
    SPPF"""
_CONVOLUTIONS = "Concat Conv DWConv RepConv"
_HEADS = "Detect OBB Pose Segment v10Detect"
_LAYERS = f"{_BLOCKS} {_CONVOLUTIONS} {_HEADS}"
_MODELS = "DetectionModel OBBModel PoseModel SegmentationModel YOLOv10DetectionModel"
# A model saved during training contains its loss; it is ignored.
_LOSSES = """utils.loss.BboxLoss utils.loss.DFLoss utils.loss.E2EDetectLoss utils.loss.E2ELoss
    utils.loss.v8DetectionLoss utils.tal.TaskAlignedAssigner utils.loss.v8SegmentationLoss
    utils.loss.v8PoseLoss utils.loss.KeypointLoss utils.loss.BCEDiceLoss utils.loss.MultiChannelDiceLoss
    utils.loss.v8OBBLoss utils.loss.RotatedBboxLoss utils.tal.RotatedTaskAlignedAssigner
    yolo.utils.loss.v8SegmentationLoss yolo.utils.loss.v8PoseLoss yolo.utils.loss.BboxLoss
    yolo.utils.loss.v8DetectionLoss yolo.utils.tal.TaskAlignedAssigner yolo.v8.detect.train.Loss"""
# Until 8.0.6 the training settings were omegaconf objects, stored with the model.
_OLD_SETTINGS = """builtins.dict omegaconf.base.ContainerMetadata omegaconf.base.Metadata typing.Any
    omegaconf.dictconfig.DictConfig omegaconf.listconfig.ListConfig omegaconf.nodes.AnyNode"""
_PLAIN_VALUES = """ultralytics.utils.IterableSimpleNamespace ultralytics.yolo.utils.IterableSimpleNamespace
    numpy.core.multiarray.scalar numpy._core.multiarray.scalar numpy.dtype pathlib.PosixPath
    pathlib.PurePosixPath pathlib.WindowsPath"""
_STUB_NAMES: tuple[str, ...] = (
    *(f"torch.nn.modules.{name}" for name in _TORCH_MODULES.split()),
    *(f"ultralytics.nn.modules.block.{name}" for name in _BLOCKS.split()),
    *(f"ultralytics.nn.modules.conv.{name}" for name in _CONVOLUTIONS.split()),
    *(f"ultralytics.nn.modules.head.{name}" for name in _HEADS.split()),
    # Until 8.0.90 all layers were in one file.
    *(f"ultralytics.nn.modules.{name}" for name in _LAYERS.split()),
    *(f"ultralytics.nn.tasks.{name}" for name in _MODELS.split()),
    *(f"ultralytics.{name}" for name in _LOSSES.split()),
    *_OLD_SETTINGS.split(),
    *_PLAIN_VALUES.split(),
)


def _folded_forward(*arguments: Any) -> Stub:
    """A layer saved with folded normalisation names its own method."""
    if len(arguments) != 2 or not isinstance(arguments[0], Stub) or arguments[1] != "forward_fuse":
        raise UnsafeCheckpointError("its pickle calls getattr; nothing was run. Do not use this file")
    return Stub()


def _type_by_name(*arguments: Any) -> type:
    if arguments not in (("set",), ("frozenset",)):
        raise UnsafeCheckpointError(f"its pickle asks for the type {shown(arguments)}; nothing was run")
    return set


# Beside what `torch.load` allows by itself: tensors, storages, `OrderedDict`, `set` and others without code.
_ALLOWED: list[Any] = [
    *((type("Stub", (Stub,), {"name": name}), name) for name in _STUB_NAMES),
    (_folded_forward, "builtins.getattr"),
    # Releases from 8.0.200 to 8.2 used dill where it was installed, which names types this way.
    (_type_by_name, "dill._dill._load_type"),
    # The default factory is not needed; the entries follow one by one.
    (lambda *_: {}, "collections.defaultdict"),
]


def load_archive(path: str | Path) -> Any:
    """Read the value saved at `path`: containers, scalars, CPU tensors, `Stub` records for the rest.

    Has no limits of memory and time, and raises what torch meets in a damaged file; `UnsafeCheckpointError`.
    """
    with warnings.catch_warnings(), torch.serialization.safe_globals(_ALLOWED):
        warnings.simplefilter("ignore")  # of torch, about the file's protocol and TorchScript
        return torch.load(path, map_location="cpu", weights_only=True)
