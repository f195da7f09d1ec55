"""Selects the runtime of a model: by name, or with `auto` the fastest installed one on this board."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from vision.foreign.engines import ForeignRuntime
from vision.runtimes.autotune import fastest_runtime
from vision.runtimes.base import (
    DEVICES,
    RUNTIMES,
    Device,
    Precision,
    Runtime,
    RuntimeMissingError,
    RuntimeUnusableError,
    installed,
    required,
)
from vision.runtimes.source import ModelSource, cannot_run
from vision.runtimes.start import start_named

RuntimeChoice = Literal["auto", "torch", "onnxruntime", "openvino", "tensorrt"]


@dataclass(frozen=True, slots=True)
class SelectedRuntime:
    """A running runtime.

    Attributes:
        reason: why this one, in words.
    """

    runtime: Runtime | ForeignRuntime
    reason: str


def start_runtime(
    source: ModelSource,
    choice: RuntimeChoice | None,
    *,
    class_ids: Sequence[int] | None = None,
    precision: Precision = "auto",
    threads: int | None = None,
    image_size: int = 640,
    sparse_boxes: bool = False,
    device: Device = "cpu",
) -> SelectedRuntime:
    """Load a model on the requested runtime.

    Args:
        choice: None: the first of `source.runners()`, installed or not.
        class_ids: sorted; a checkpoint's network computes only these. For an exported file the classes are
            filtered afterwards.
        sparse_boxes: compute a checkpoint's boxes only at candidate cells; for thresholds that few cells
            reach. An exported file computes all.
        device: `cuda` for a checkpoint on torch; the other runtimes choose theirs.

    Raises:
        RuntimeMissingError: the named runtime, or the one of None, is not installed. There is no fallback.
        RuntimeUnusableError: it cannot run this file, or not in this precision.
    """
    check_runtime_name(choice)
    if device not in DEVICES:
        raise ValueError(
            f"device must be {' or '.join(DEVICES)}, got {device!r}; CUDA_VISIBLE_DEVICES selects one of "
            "several GPUs"
        )
    check_runtime(source, choice)
    reason = "as requested"
    if choice is None:
        choice, reason = source.runners()[0], "the default for this kind of file"
    if device != "cpu" and (choice != "torch" or source.kind is not None or source.foreign is not None):
        raise RuntimeUnusableError(
            f"{source.path}: the device {device} is for a checkpoint with the runtime torch, not for this "
            f"file with {choice}; onnxruntime uses an NVIDIA GPU with the package onnxruntime-gpu"
        )
    if choice != "auto":
        runtime = start_named(source, choice, class_ids, precision, threads, image_size, sparse_boxes, device)
        return SelectedRuntime(runtime, reason)
    candidates = [name for name in source.runners() if installed(name)]
    if len(candidates) == 1:
        name, reason = candidates[0], "the only installed runtime for this model"
    else:
        name, reason = fastest_runtime(
            source,
            candidates,
            class_ids=class_ids,
            precision=precision,
            threads=threads,
            image_size=image_size,
        )
    return SelectedRuntime(
        start_named(source, name, class_ids, precision, threads, image_size, sparse_boxes), reason
    )


def check_runtime_name(choice: str | None) -> None:
    """Raise ValueError unless it is a `RuntimeChoice` or None."""
    if choice not in (None, "auto", *RUNTIMES):
        raise ValueError(f"runtime must be auto, {', '.join(RUNTIMES)}; got {choice!r}")


def check_runtime(source: ModelSource, choice: RuntimeChoice | None) -> None:
    """Raise the RuntimeUnusableError or RuntimeMissingError of `start_runtime` without starting anything."""
    if choice == "auto":
        if not any(installed(name) for name in source.runners()):
            required(source.runners()[0])  # raises with what to install
        return
    by_default = choice is None
    choice = choice or source.runners()[0]
    if choice not in source.runners():
        raise cannot_run(source, choice)
    if choice == "torch":
        return
    try:
        required(choice)
    except RuntimeMissingError as error:
        others = [name for name in source.runners() if by_default and installed(name)]
        if not others:
            raise
        raise RuntimeMissingError(f"{error}, or use the runtime {others[0]}") from None
