"""Names that a detection checkpoint may contain: layers and plain values.

Each is read as a stub. A name in this list makes the file readable, so that the builder can report an unknown
layer; it does not allow any code to run.
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
# A model saved during training contains its loss; it is ignored.
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

# Until 8.0.6 the training settings were omegaconf objects, stored with the model.
_OLD_SETTINGS = (
    "__builtin__.dict",
    "omegaconf.base.ContainerMetadata",
    "omegaconf.base.Metadata",
    "omegaconf.dictconfig.DictConfig",
    "omegaconf.listconfig.ListConfig",
    "omegaconf.nodes.AnyNode",
    "typing.Any",
)

STUB_NAMES: tuple[str, ...] = (
    *(f"torch.nn.modules.{name}" for name in _TORCH_MODULES),
    *(f"ultralytics.nn.modules.block.{name}" for name in _BLOCKS),
    *(f"ultralytics.nn.modules.conv.{name}" for name in _CONVOLUTIONS),
    *(f"ultralytics.nn.modules.head.{name}" for name in _HEADS),
    # Until 8.0.90 all layers were in one file.
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
