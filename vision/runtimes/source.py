"""A model file of any kind: its data before a runtime is selected, and its runtime where it is exported."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from vision.extras import install_command
from vision.file_kinds import explained, is_hidden, open_file, wrong_file
from vision.foreign.layouts import YOLOX_SUFFIX, ForeignFacts
from vision.model_files import missing_model_advice
from vision.runtimes.base import (
    Precision,
    Runtime,
    RuntimeMissingError,
    RuntimeName,
    RuntimeUnusableError,
    installed,
    required,
)
from vision.runtimes.exported import SUFFIXES, ExportedFacts, ExportKind, kind_of
from vision.yolo.checkpoint_error import CheckpointError
from vision.yolo.checkpoint_pair import is_pair, pair_paths
from vision.yolo.level_outputs import Head

if TYPE_CHECKING:
    from vision.yolo.architecture import YoloModel
    from vision.yolo.description import ModelDescription

# Runtimes of each kind of file, its default first. All of them run a checkpoint, by an export.
_RUNNERS: dict[ExportKind, tuple[RuntimeName, ...]] = {
    "onnx": ("onnxruntime", "openvino"),
    "openvino": ("openvino",),
    "tensorrt": ("tensorrt",),
    "torchscript": ("torch",),
}

# A TorchScript file is an archive of torch too.
_FITTING = ("is a checkpoint of torch", "is a zip archive")


@dataclass(slots=True)
class ModelSource:
    """Contents of a model file.

    Attributes:
        path: the file.
        kind: of an exported file; None for a checkpoint.
        class_names: id → name.
        metadata: of the file: licence, origin, score.
        strides: one per level, pixels.
        description: architecture of a checkpoint's network.
        facts: metadata of our own exported file.
        foreign: the recognised network of another exporter's file, or of a YOLOX checkpoint.
    """

    path: Path
    kind: ExportKind | None
    class_names: tuple[str, ...]
    metadata: dict[str, Any]
    strides: tuple[int, ...]
    description: ModelDescription | None
    facts: ExportedFacts | None
    foreign: ForeignFacts | None = None
    _model: YoloModel | None = None

    def take_model(self) -> YoloModel:
        """The checkpoint's network, for the caller to modify; later calls read it again."""
        from vision.yolo.checkpoint import load_checkpoint

        model, self._model = self._model, None
        return load_checkpoint(self.path).model if model is None else model

    @property
    def weights_path(self) -> Path:
        """The file that identifies the model: OpenVINO's `.xml` of another exporter has no weights."""
        return self.path.with_suffix(".bin") if self.kind == "openvino" and self.foreign else self.path

    @property
    def fixed_precision(self) -> bool:
        """Whether the precision is the file's, and `auto` the only one to request for every runtime."""
        if self.foreign is not None:
            # OpenVINO computes a file of float16 weights in any precision.
            free = ("float32", "float16") if self.kind == "openvino" else ("float32",)
            return self.foreign.precision not in free
        return self.kind == "tensorrt" or (self.facts is not None and self.facts.precision == "int8")

    def runners(self) -> tuple[RuntimeName, ...]:
        """The runtimes that can run this kind of file, the default first."""
        if self.kind is None:
            return ("torch",) if self.foreign else ("torch", "onnxruntime", "openvino", "tensorrt")
        return _RUNNERS[self.kind]


def read_source(path: Path) -> ModelSource:
    """Read a checkpoint, or the facts of an exported file.

    Raises:
        CheckpointError: a checkpoint that cannot be read, or a name that is not UTF-8.
        RuntimeMissingError: a checkpoint without torch, or an exported file without a runtime that reads it.
        RuntimeUnusableError: an exported file that is damaged or has no metadata.
    """
    if path.is_dir():
        path = _file_in(path)
    try:
        str(path).encode()
    except UnicodeEncodeError:  # the runtimes fail in their own ways
        raise CheckpointError(f"{path}: the name is not UTF-8; rename the file") from None
    kind = kind_of(path)
    if kind is None:
        if not path.exists():  # checked before torch is imported
            raise CheckpointError(f"{path}: no such file; {missing_model_advice(path)}")
        if not installed("torch"):
            raise _needs_torch(path)
        if path.suffix == YOLOX_SUFFIX:
            from vision.foreign.yolox import load_yolox

            if (yolox := load_yolox(path)) is not None:
                facts = yolox[1]
                return ModelSource(path, None, facts.class_names, {}, (facts.stride,), None, None, facts)
        from vision.yolo.checkpoint import load_checkpoint

        loaded = load_checkpoint(path)
        return ModelSource(
            path,
            None,
            loaded.class_names,
            loaded.metadata,
            tuple(loaded.model.strides),
            loaded.description,
            None,
            _model=loaded.model,
        )
    if not path.is_file():
        raise RuntimeUnusableError(f"{path}: no such file; {missing_model_advice(path)}")
    if (what := wrong_file(path, *_FITTING)) is not None:
        raise RuntimeUnusableError(what)
    found = _facts(path, kind)
    if isinstance(found, ForeignFacts):
        strides = (found.stride,)
        return ModelSource(path, kind, found.class_names, found.metadata, strides, None, None, found)
    return ModelSource(path, kind, found.class_names, found.metadata, found.strides, None, found)


def _needs_torch(path: Path) -> RuntimeMissingError:
    return RuntimeMissingError(
        f"{path}: reading a checkpoint needs torch: {install_command('torch')}; or give an export "
        "of it, which `companion models export` writes where torch is installed"
    )


def check_model_file(path: Path, runtime: RuntimeName | Literal["auto"] | None) -> None:
    """Check, without importing a runtime, that a model file is there, of a known kind, and has its runtime.

    Raises:
        CheckpointError, RuntimeMissingError, RuntimeUnusableError: as `read_source`, for what is seen so far.
    """
    if path.is_dir():
        path = _file_in(path)
    kind = kind_of(path)
    files = pair_paths(path) if kind is None and is_pair(path) else (path,)
    for file in files:
        if not file.is_file():
            raise CheckpointError(f"{file}: no such file; {missing_model_advice(file)}")
        if not os.access(file, os.R_OK):
            raise CheckpointError(f"{file}: no permission to read it")
    if kind is not None and (what := wrong_file(path, *_FITTING)) is not None:
        raise RuntimeUnusableError(what)
    if kind is None and len(files) == 1:
        with open_file(path) as opened:
            if opened.read(2) != b"PK":  # the zip archive of torch.save
                problem = f"{path}: neither a checkpoint nor an exported model"
                raise CheckpointError(explained(path, problem))
    if kind is None and not installed("torch"):
        raise _needs_torch(path)
    source = ModelSource(path, kind, (), {}, (), None, None)
    needed = source.runners() if runtime is None or runtime == "auto" else (runtime,)
    if needed[0] not in source.runners():
        raise cannot_run(source, needed[0])
    if not any(map(installed, needed)):
        required(needed[0])  # raises with what to install


def _facts(path: Path, kind: ExportKind) -> ExportedFacts | ForeignFacts:
    if kind == "torchscript":
        required("torch")
        from vision.runtimes.torch_runtime import torchscript_facts

        return torchscript_facts(path)
    if kind == "tensorrt":
        from vision.runtimes.tensorrt_runtime import tensorrt_facts

        return tensorrt_facts(path)
    # Without both, the error names the default one.
    if kind == "onnx" and (installed("onnxruntime") or not installed("openvino")):
        from vision.runtimes.onnx_runtime import onnx_facts

        return onnx_facts(path)
    from vision.runtimes.openvino_runtime import openvino_facts

    return openvino_facts(path)


def _file_in(folder: Path) -> Path:
    """The `.xml` in a folder of OpenVINO files."""
    try:
        files = (path for path in folder.iterdir() if not is_hidden(path))
        found = sorted(path for path in files if path.suffix == SUFFIXES["openvino"])
    except OSError as error:
        raise CheckpointError(f"{folder}: cannot be read ({error.strerror or error})") from None
    if len(found) != 1:
        raise CheckpointError(
            f"{folder}: is a folder with {len(found)} .xml files; give the path of a model file, "
            "or a folder with one OpenVINO model"
        )
    return found[0]


def cannot_run(source: ModelSource, runtime: RuntimeName) -> RuntimeUnusableError:
    """The error for a runtime requested by name that does not run this kind of file."""
    suffix = YOLOX_SUFFIX if source.kind is None else SUFFIXES[source.kind]
    return RuntimeUnusableError(
        f"{source.path}: {runtime} cannot run {suffix} files; "
        f"use the runtime {' or '.join(source.runners())}, or auto, or give the checkpoint"
    )


def runtime_of_file(
    name: RuntimeName,
    path: Path,
    head: Head | None = None,
    *,
    precision: Precision = "auto",
    threads: int | None = None,
) -> Runtime:
    """Load an exported file. `head` None: from the file's metadata."""
    if name == "torch":
        from vision.runtimes.torch_runtime import TorchScriptRuntime

        return TorchScriptRuntime(path, head, precision=precision, threads=threads)
    if name == "onnxruntime":
        from vision.runtimes.onnx_runtime import OnnxRuntime

        return OnnxRuntime(path, head, precision=precision, threads=threads)
    if name == "openvino":
        from vision.runtimes.openvino_runtime import OpenVinoRuntime

        return OpenVinoRuntime(path, head, precision=precision, threads=threads)
    from vision.runtimes.tensorrt_runtime import TensorRtRuntime

    return TensorRtRuntime(path, head, precision=precision, threads=threads)
