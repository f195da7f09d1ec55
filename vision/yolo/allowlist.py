"""What a detection checkpoint may name: the layers and plain values that stand in one.

Each becomes an inert record. That a name stands here lets the file be read, so that the builder can name the
layer it does not know; it does not let anything run.
"""

from __future__ import annotations

_TORCH_MODULES = (
    "activation.GELU",
    "activation.Hardswish",
    "activation.LeakyReLU",
    "activation.ReLU",
    "activation.ReLU6",
    "activation.SiLU",
    "activation.Sigmoid",
    "batchnorm.BatchNorm2d",
    "container.ModuleList",
    "container.Sequential",
    "conv.Conv2d",
    "conv.ConvTranspose2d",
    "dropout.Dropout",
    "linear.Identity",
    "linear.Linear",
    "loss.BCEWithLogitsLoss",
    "module.Module",
    "pooling.AdaptiveAvgPool2d",
    "pooling.MaxPool2d",
    "upsampling.Upsample",
)
_BLOCKS = (
    "A2C2f",
    "AAttn",
    "ABlock",
    "Attention",
    "Bottleneck",
    "C2",
    "C2PSA",
    "C2f",
    "C2fCIB",
    "C3",
    "C3k",
    "C3k2",
    "CIB",
    "DFL",
    "PSA",
    "PSABlock",
    "Proto",
    "RepVGGDW",
    "SCDown",
    "SPPF",
)
_CONVOLUTIONS = ("Concat", "Conv", "DWConv")
_HEADS = ("Classify", "Detect", "OBB", "Pose", "Segment", "v10Detect")
_MODELS = (
    "ClassificationModel",
    "DetectionModel",
    "OBBModel",
    "PoseModel",
    "SegmentationModel",
    "YOLOv10DetectionModel",
)
# A model saved in the middle of its training carries its loss along; it is not looked at.
_LOSSES = (
    "ultralytics.utils.loss.BboxLoss",
    "ultralytics.utils.loss.DFLoss",
    "ultralytics.utils.loss.E2EDetectLoss",
    "ultralytics.utils.loss.E2ELoss",
    "ultralytics.utils.loss.v8DetectionLoss",
    "ultralytics.utils.tal.TaskAlignedAssigner",
    "ultralytics.yolo.utils.loss.BboxLoss",
    "ultralytics.yolo.utils.loss.v8DetectionLoss",
    "ultralytics.yolo.utils.tal.TaskAlignedAssigner",
    "ultralytics.yolo.v8.detect.train.Loss",
)

# Until 8.0.6 the settings of the training were omegaconf's, and the model kept them.
_OLD_SETTINGS = (
    "__builtin__.dict",
    "omegaconf.base.ContainerMetadata",
    "omegaconf.base.Metadata",
    "omegaconf.dictconfig.DictConfig",
    "omegaconf.listconfig.ListConfig",
    "omegaconf.nodes.AnyNode",
    "typing.Any",
)

INERT: tuple[str, ...] = (
    *(f"torch.nn.modules.{name}" for name in _TORCH_MODULES),
    *(f"ultralytics.nn.modules.block.{name}" for name in _BLOCKS),
    *(f"ultralytics.nn.modules.conv.{name}" for name in _CONVOLUTIONS),
    *(f"ultralytics.nn.modules.head.{name}" for name in _HEADS),
    # Until 8.0.90 all layers lay in one file.
    *(f"ultralytics.nn.modules.{name}" for name in (*_BLOCKS, *_CONVOLUTIONS, *_HEADS)),
    *(f"ultralytics.nn.tasks.{name}" for name in _MODELS),
    *_LOSSES,
    *_OLD_SETTINGS,
    "ultralytics.utils.IterableSimpleNamespace",
    "ultralytics.yolo.utils.IterableSimpleNamespace",
    "numpy.core.multiarray.scalar",
    "numpy._core.multiarray.scalar",
    "numpy.dtype",
    "pathlib.PosixPath",
    "pathlib.PurePosixPath",
    "pathlib.WindowsPath",
    "_codecs.encode",
    "torch.device",
)
