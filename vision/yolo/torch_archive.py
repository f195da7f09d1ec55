"""Reads the zip archive that `torch.save` writes, without running code from it.

`data.pkl` describes the value; each storage is a member `data/<key>` of raw little-endian numbers.
"""

from __future__ import annotations

import math
import struct
import zipfile
import zlib
from pathlib import Path, PurePosixPath
from typing import Any, BinaryIO

import torch
from torch import Tensor

from vision.file_kinds import explained, open_file
from vision.model_files import missing_model_advice
from vision.yolo.safe_pickle import (
    AllowedGlobal,
    CheckpointError,
    Stub,
    UnsafeCheckpointError,
    check_key,
    one_line,
    shown,
    unpickle,
)

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
_OLD_SETTINGS = """__builtin__.dict omegaconf.base.ContainerMetadata omegaconf.base.Metadata typing.Any
    omegaconf.dictconfig.DictConfig omegaconf.listconfig.ListConfig omegaconf.nodes.AnyNode"""
_PLAIN_VALUES = """ultralytics.utils.IterableSimpleNamespace ultralytics.yolo.utils.IterableSimpleNamespace
    numpy.core.multiarray.scalar numpy._core.multiarray.scalar numpy.dtype pathlib.PosixPath
    pathlib.PurePosixPath pathlib.WindowsPath _codecs.encode torch.device"""
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


# Genuine names of networks that are not supported, by their class of model.
_UNSUPPORTED_MODELS = {
    "ClassificationModel": "a classification model has no boxes",
    "WorldModel": "YOLO-World is not supported",
    "YOLOEModel": "YOLOE is not supported",
    "YOLOESegModel": "YOLOE is not supported",
    "RTDETRDetectionModel": "RT-DETR checkpoints are not supported; export it to ONNX, which is",
    "SemanticSegmentationModel": "semantic segmentation has no boxes",
    "YOLOSemanticModel": "semantic segmentation has no boxes",
}
_GENUINE = ("ultralytics.nn.", "ultralytics.utils.loss.", "ultralytics.utils.tal.", "torch.nn.modules.")
# Of repositories whose checkpoints name their own package's classes.
_OTHER_PACKAGES = {
    "models.": "checkpoints of the repositories YOLOv5 (not YOLOv5u) and YOLOv7 are not supported; "
    "the ONNX export of YOLOv5 is",
    "yolov6.": "YOLOv6 is not supported",
    "super_gradients.": "YOLO-NAS is not supported",
}


def unsupported(name: str) -> str | None:
    """Why a genuine checkpoint that names this class is not supported; None for any other name."""
    kind = name.rpartition(".")[2]
    if name == f"ultralytics.nn.tasks.{kind}" and kind in _UNSUPPORTED_MODELS:
        return _UNSUPPORTED_MODELS[kind]
    for package, reason in _OTHER_PACKAGES.items():
        if name.startswith(package) and kind[:1].isupper():
            return reason
    # A class, not a function: those are refused as calls.
    if name.startswith(_GENUINE) and (kind[:1].isupper() or kind.startswith("v8")):
        return f"it has the part {name!r:.100}, which is not supported; its ONNX export may be"
    return None


_STORAGES: dict[str, torch.dtype] = {
    "torch.DoubleStorage": torch.float64,
    "torch.FloatStorage": torch.float32,
    "torch.HalfStorage": torch.float16,
    "torch.BFloat16Storage": torch.bfloat16,
    "torch.LongStorage": torch.int64,
    "torch.IntStorage": torch.int32,
    "torch.ShortStorage": torch.int16,
    "torch.CharStorage": torch.int8,
    "torch.ByteStorage": torch.uint8,
    "torch.BoolStorage": torch.bool,
}

_LARGEST_PICKLE_BYTES = 16 << 20
# Every member becomes an object; the largest checkpoints have some thousands.
_LARGEST_CONTENTS_BYTES = 1 << 20
_MOST_MEMBERS = 10_000
# The end records of an archive without a comment: zip64 record, its locator, end record.
_ZIP64_BYTES, _LOCATOR_BYTES, _END_BYTES = 56, 20, 22
_MOST_DIMENSIONS = 8
# Views may share a storage (a state dictionary beside its model), up to this limit.
_MOST_VIEWS_PER_ELEMENT = 4
# Memory limit of the pickle's values, in addition to the size of the file. YOLOv9t: few weights in many
# modules, 18 MiB.
_VALUES_BYTES = 22 << 20
_LARGEST_SET = 10_000


def read_archive(path: str | Path) -> Any:
    """Read the value saved at `path`: containers, scalars, CPU tensors, `Stub` records for the rest.

    Raises:
        UnsafeCheckpointError: the file names something that is not allowed.
        CheckpointError: missing, empty, truncated, not an archive of `torch.save`. One line naming the file.
    """
    path = Path(path)
    try:
        return _read(path)
    except CheckpointError as error:
        # A checkpoint is a zip archive: of these the error says more.
        line = explained(path, f"{path}: {error}", "is a checkpoint of torch", "is a zip archive")
        raise type(error)(one_line(line)) from None
    except FileNotFoundError:
        raise CheckpointError(f"{path}: no such file; {missing_model_advice(path)}") from None
    except IsADirectoryError:
        raise CheckpointError(f"{path}: is a folder; give the path of a .pt checkpoint") from None
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error.strerror or error})") from None


def _read(path: Path) -> Any:
    size = path.stat().st_size
    with open_file(path) as file:
        if size == 0:
            raise CheckpointError("the file is empty; copy or download it again")
        if file.read(2) != b"PK":
            raise CheckpointError(
                "not a checkpoint: expected the zip archive that torch.save writes (torch 1.6 or newer)"
            )
        try:
            _check_contents(file, size)
            file.seek(0)
            with zipfile.ZipFile(file) as archive:
                return _Archive(archive, size).value()
        except CheckpointError:
            raise
        # Raised by the zip module for damaged headers, encryption, unknown compression and bad names, and by
        # torch for tensors that cannot be.
        except (
            zipfile.BadZipFile,
            zlib.error,
            struct.error,
            EOFError,
            KeyError,
            RuntimeError,
            ValueError,
            OverflowError,
        ) as error:
            raise CheckpointError(
                f"the archive is truncated or damaged ({error}); copy or download it again"
            ) from None


def _check_contents(file: BinaryIO, size: int) -> None:
    """Check the size of the table of contents before the zip module reads it.

    The end records (APPNOTE 4.3.14 to 4.3.16) must be the last bytes of the file and agree with each other,
    so that the zip module finds the same ones.
    """
    file.seek(max(0, size - _ZIP64_BYTES - _LOCATOR_BYTES - _END_BYTES))
    ending = file.read()
    end = ending[-_END_BYTES:]
    if len(end) != _END_BYTES or not end.startswith(b"PK\x05\x06") or end[-2:] != bytes(2):
        raise CheckpointError(
            "the archive is truncated or damaged (no end record at its end); copy or download it again"
        )
    (contents,) = struct.unpack_from("<L", end, 12)
    last = size - _END_BYTES
    locator = ending[-_LOCATOR_BYTES - _END_BYTES : -_END_BYTES]
    if locator.startswith(b"PK\x06\x07"):
        last -= _LOCATOR_BYTES + _ZIP64_BYTES
        record = ending[: -_LOCATOR_BYTES - _END_BYTES]
        if not record.startswith(b"PK\x06\x06") or struct.unpack_from("<Q", locator, 8) != (last,):
            raise CheckpointError("the archive's zip64 records are damaged; copy or download it again")
        short = contents
        (contents,) = struct.unpack_from("<Q", record, 40)
        if short not in (contents, 0xFFFFFFFF):
            raise CheckpointError(
                f"the archive's end records give its table of contents {short} and {contents} bytes; "
                "it is not a checkpoint"
            )
    if contents > min(_LARGEST_CONTENTS_BYTES, last):
        raise CheckpointError(
            f"the archive's table of contents has {contents} bytes, a checkpoint's at most "
            f"{min(_LARGEST_CONTENTS_BYTES, last)}"
        )


class _Archive:
    """One open archive; storages are read when the pickle refers to them."""

    def __init__(self, archive: zipfile.ZipFile, size: int) -> None:
        self._archive = archive
        self._size = size
        members = archive.infolist()
        if len(members) > _MOST_MEMBERS:
            raise CheckpointError(f"the archive has {len(members)} members, a checkpoint far fewer")
        self._members = {member.filename: member for member in members}
        if len(self._members) != len(members):
            raise CheckpointError("the archive has two members of one name; it is not a checkpoint")
        pickles = [name for name in self._members if PurePosixPath(name).name == "data.pkl"]
        if len(pickles) != 1:
            raise CheckpointError(f"the archive has {len(pickles)} data.pkl, a checkpoint has one")
        self._root = pickles[0].removesuffix("data.pkl")
        if any(name.startswith(f"{self._root}code/") for name in self._members):
            raise CheckpointError(
                "the file is a TorchScript program, not a checkpoint; rename it to end in .torchscript, "
                "or give the .pt of training"
            )
        if any(member.compress_type != zipfile.ZIP_STORED for member in members):
            raise CheckpointError("the archive is compressed, torch.save never does; save the model again")
        if any(member.compress_size != member.file_size for member in members):
            raise CheckpointError("the archive has a member of two sizes; it is not a checkpoint")
        if sum(member.file_size for member in members) > size:
            raise CheckpointError("the archive's members are larger than the file; it is not a checkpoint")
        order = self._members.get(f"{self._root}byteorder")
        if order is not None and self._bytes(order, 16) != b"little":
            raise CheckpointError("its numbers are big-endian; save it on a little-endian machine")
        self._storages: dict[str, Tensor] = {}
        self._views_left = _MOST_VIEWS_PER_ELEMENT * size

    def value(self) -> Any:
        data = self._bytes(self._members[f"{self._root}data.pkl"], _LARGEST_PICKLE_BYTES)
        return unpickle(data, self._allowed(), self._storage, _VALUES_BYTES + self._size, unsupported)

    def _bytes(self, member: zipfile.ZipInfo, largest: int | None = None) -> bytes:
        if largest is not None and member.file_size > largest:
            raise CheckpointError(f"{member.filename} has {member.file_size} bytes, the limit is {largest}")
        data = self._archive.read(member)
        if len(data) != member.file_size:
            raise CheckpointError(f"{member.filename} has {len(data)} of its {member.file_size} bytes")
        return data

    def _allowed(self) -> dict[str, AllowedGlobal]:
        calls = {
            "torch._utils._rebuild_tensor_v2": self._tensor,
            "torch._utils._rebuild_parameter": _parameter,
            "torch._utils._rebuild_parameter_with_state": _parameter,
            "torch.Size": _size,
            "collections.OrderedDict": _dictionary,
            "collections.defaultdict": _default_dictionary,
            "__builtin__.set": _set,
            "builtins.set": _set,
            "__builtin__.getattr": _folded_forward,
            "builtins.getattr": _folded_forward,
            # Releases from 8.0.200 to 8.2 used dill where it was installed, which names types this way.
            "dill._dill._load_type": _type_by_name,
        }
        return (
            {name: AllowedGlobal(name) for name in (*_STUB_NAMES, *_STORAGES)}
            | {name: AllowedGlobal(name, make) for name, make in calls.items()}
        )  # fmt: skip

    def _storage(self, identity: tuple[Any, ...]) -> Tensor:
        """('storage', type, key, location, number of elements) → these elements, flat."""
        if len(identity) != 5 or identity[0] != "storage":
            raise CheckpointError("its pickle refers to something else than a storage")
        _, kind, key, _, count = identity
        dtype = _STORAGES.get(kind.name) if isinstance(kind, AllowedGlobal) else None
        if dtype is None or not isinstance(key, str) or type(count) is not int or count < 0:
            raise CheckpointError("its pickle refers to a storage in an unknown way")
        stored = self._storages.get(key)
        if stored is None:
            member = self._members.get(f"{self._root}data/{key}")
            if member is None:
                raise CheckpointError(f"storage {shown(key)} is missing from the archive")
            if member.file_size != count * dtype.itemsize:
                raise CheckpointError(
                    f"storage {shown(key)} should have {count} numbers of {dtype.itemsize} bytes, "
                    f"it has {member.file_size} bytes"
                )
            data = bytearray(self._bytes(member))
            stored = torch.frombuffer(data, dtype=dtype) if count else torch.empty(0, dtype=dtype)
            self._storages[key] = stored
        if stored.dtype != dtype or stored.numel() != count:
            raise CheckpointError(f"storage {shown(key)} is described in two ways")
        return stored

    def _tensor(self, arguments: tuple[Any, ...]) -> Tensor:
        """(storage, offset, size, stride, …) → that view of the storage, after a bounds check."""
        if len(arguments) < 4:
            raise CheckpointError("its pickle has a tensor without a shape")
        storage, offset, size, stride = arguments[:4]
        shape_is_sound = (
            isinstance(storage, Tensor)
            and storage.dim() == 1
            and type(offset) is int
            and _are_counts(size)
            and _are_counts(stride)
            and len(size) == len(stride) <= _MOST_DIMENSIONS
            and offset >= 0
        )
        if not shape_is_sound:
            raise CheckpointError("its pickle has a tensor of an impossible shape")
        count = math.prod(size)
        last = offset + sum((n - 1) * step for n, step in zip(size, stride, strict=True)) if count else -1
        if last >= storage.numel() or count > storage.numel():
            raise CheckpointError(
                f"its pickle has a tensor of size {shown(size)} that is larger than its storage "
                f"({storage.numel()})"
            )
        self._views_left -= count
        if self._views_left < 0:
            raise CheckpointError("its tensors repeat the same numbers too often; it is not a checkpoint")
        view: Tensor = storage.as_strided(size, stride, offset) if count else storage.new_empty(size)
        return view


def _are_counts(values: object) -> bool:
    return isinstance(values, tuple) and all(type(value) is int and 0 <= value < 1 << 40 for value in values)


def _parameter(arguments: tuple[Any, ...]) -> Tensor:
    tensor = arguments[0] if arguments else None
    if not isinstance(tensor, Tensor):
        raise CheckpointError("its pickle has a parameter without a tensor")
    return tensor


def _size(arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    if len(arguments) != 1 or not isinstance(arguments[0], list | tuple):
        raise CheckpointError("its pickle has a size without numbers")
    return tuple(arguments[0])


def _dictionary(arguments: tuple[Any, ...]) -> dict[Any, Any]:
    if arguments:
        raise UnsafeCheckpointError("its pickle fills an ordered dictionary by a call; nothing was run")
    return {}


def _default_dictionary(arguments: tuple[Any, ...]) -> dict[Any, Any]:
    """The default factory is not needed; the entries follow one by one."""
    if (
        any(not isinstance(argument, AllowedGlobal | None) for argument in arguments[:1])
        or len(arguments) > 1
    ):
        raise UnsafeCheckpointError("its pickle fills a default dictionary by a call; nothing was run")
    return {}


def _set(arguments: tuple[Any, ...]) -> frozenset[Any]:
    values = arguments[0] if len(arguments) == 1 else None
    if not isinstance(values, list) or len(values) > _LARGEST_SET:
        raise CheckpointError("its pickle has a set of something else than names and numbers")
    for value in values:
        check_key(value, "member of a set")
    return frozenset(values)


def _folded_forward(arguments: tuple[Any, ...]) -> Stub:
    """A layer saved with folded normalisation names its own method; it becomes a stub."""
    if len(arguments) != 2 or not isinstance(arguments[0], Stub) or arguments[1] != "forward_fuse":
        raise UnsafeCheckpointError("its pickle calls getattr; nothing was run. Do not use this file")
    return Stub("forward_fuse")


def _type_by_name(arguments: tuple[Any, ...]) -> AllowedGlobal:
    if arguments not in (("set",), ("frozenset",)):
        raise UnsafeCheckpointError(f"its pickle asks for the type {shown(arguments)}; nothing was run")
    return AllowedGlobal(f"builtins.{arguments[0]}", _set)
