"""The runtime interface: a letterboxed image in, raw head outputs out."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from vision.extras import install_command
from vision.yolo.level_outputs import Head, LevelOutput, Product

RuntimeName = Literal["torch", "onnxruntime", "openvino", "tensorrt"]
RUNTIMES: tuple[RuntimeName, ...] = ("torch", "onnxruntime", "openvino", "tensorrt")
Precision = Literal["auto", "float32", "bfloat16", "float16"]
Device = Literal["cpu", "cuda"]
DEVICES: tuple[Device, ...] = ("cpu", "cuda")
PRECISIONS: tuple[Precision, ...] = ("auto", "float32", "bfloat16", "float16")

_TELEMETRY = "openvino_telemetry"


class RuntimeUnusableError(ValueError):
    """A runtime cannot do what was requested: the file, the precision or the machine does not allow it."""


class RuntimeMissingError(RuntimeUnusableError):
    """A runtime that was requested, or is a file's default, is not installed. The message names the extra."""


class Runtime(Protocol):
    """A network ready for inference. Not thread-safe.

    Colour order and scaling are part of the network: it takes the pixels as they are.

    Attributes:
        name: of the runtime.
        precision: of the network, `float32`, `bfloat16` or `float16`.
        precision_reason: why, in words.
        threads: processor threads it uses.
        head: layout of its outputs.
    """

    @property
    def name(self) -> RuntimeName: ...
    @property
    def precision(self) -> str: ...
    @property
    def precision_reason(self) -> str: ...
    @property
    def threads(self) -> int: ...
    @property
    def head(self) -> Head: ...

    @property
    def product(self) -> Product:
        """Matrix product of two float32 matrices, on the runtime's own threads if it has any."""

    def prepare(self, height: int, width: int) -> None:
        """Prepare for inputs of one size, so that the first `infer` is not slower than the rest."""

    def infer(self, image_bgr: NDArray[np.uint8]) -> Sequence[LevelOutput]:
        """(H, W, 3) uint8 BGR, C-contiguous, sides multiples of the largest stride → each level's outputs.

        The outputs may be the runtime's own memory: they are valid until the next `infer`.
        """


def installed(runtime: RuntimeName) -> bool:
    """Whether the runtime's package can be imported, without importing it."""
    return importlib.util.find_spec(runtime) is not None


def version(runtime: RuntimeName) -> str:
    """The installed runtime's version; `unknown` if it does not belong to a package."""
    try:
        return importlib.metadata.version(runtime)
    except importlib.metadata.PackageNotFoundError:
        # Another package may provide it, such as onnxruntime-gpu.
        packages = importlib.metadata.packages_distributions().get(runtime, [])
        return importlib.metadata.version(packages[0]) if packages else "unknown"


def required(runtime: RuntimeName, *, also: str | None = None) -> Any:
    """Import the runtime's module. Raises `RuntimeMissingError`, which names the extra to install."""
    for package in filter(None, (runtime, also)):
        try:
            found = importlib.util.find_spec(package) is not None
        except ModuleNotFoundError:  # of a dotted name, when its first part is missing
            found = False
        if not found:
            raise RuntimeMissingError(
                f"the runtime {runtime} is not installed ({package} is missing): {install_command(package)}"
            )
    try:
        return _IMPORTS.get(runtime, importlib.import_module)(runtime)
    except ImportError as error:
        raise RuntimeMissingError(
            f"the runtime {runtime} is installed but cannot be loaded: {error}; "
            f"reinstall it: {install_command(runtime)} --force-reinstall"
        ) from error


def _import_onnxruntime(name: str) -> Any:
    """Import ONNX Runtime so that it does not report its use.

    From 1.32 on it writes a device's identifier below `~/.cache` as it is imported, and reports events to
    Microsoft over the network, unless this variable is set.
    """
    os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
    return importlib.import_module(name)


def _import_openvino(name: str) -> Any:
    """Import OpenVINO so that it does not report its use.

    With its telemetry package it reports its import and each conversion to Intel over the network, and
    stores an identifier in `~/intel`.
    """
    before = {name: sys.modules[name] for name in (_TELEMETRY,) if name in sys.modules}
    sys.modules[_TELEMETRY] = None  # type: ignore[assignment]  # It cannot be imported.
    try:
        openvino = importlib.import_module(name)
    finally:
        del sys.modules[_TELEMETRY]
        sys.modules.update(before)
    # The program may have imported OpenVINO before, with its telemetry.
    for name, module in list(sys.modules.items()):
        telemetry = getattr(module, "tm", None) if name.startswith("openvino.tools.ovc.") else None
        if getattr(telemetry, "__name__", None) == _TELEMETRY:
            module.tm = importlib.import_module("openvino.tools.ovc.telemetry_stub")  # type: ignore[attr-defined]
    return openvino


_IMPORTS: dict[str, Callable[[str], Any]] = {
    "onnxruntime": _import_onnxruntime,
    "openvino": _import_openvino,
}


def bfloat16_instructions() -> str:
    """Names of the processor's bfloat16 instructions, as Linux reports them; empty if it has none."""
    try:
        lines = Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
    except OSError:
        return ""
    # x86 lists `flags`, ARM lists `Features`.
    flags = {flag for line in lines if line.startswith(("flags", "Features")) for flag in line.split()}
    return " ".join(sorted(flags & {"avx512_bf16", "amx_bf16", "bf16"}))
