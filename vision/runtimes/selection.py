"""Selects the runtime of a model: by name, or with `auto` the fastest installed one on this board."""

from __future__ import annotations

import hashlib
import json
import logging
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from vision.runtimes.base import (
    RUNTIMES,
    Precision,
    Runtime,
    RuntimeName,
    RuntimeUnusableError,
    installed,
    required,
    version,
)
from vision.runtimes.exported import FORMAT, SUFFIXES, ExportedFacts, ExportKind
from vision.runtimes.source import ModelSource, cannot_run
from vision.yolo.checkpoint_pair import weights_sha256
from vision.yolo.level_outputs import Head

if TYPE_CHECKING:
    from vision.runtimes.network import Network

logger = logging.getLogger(__name__)

RuntimeChoice = Literal["auto", "torch", "onnxruntime", "openvino", "tensorrt"]
# The export format of each runtime.
_EXPORTS: dict[RuntimeName, ExportKind] = {
    "onnxruntime": "onnx",
    "openvino": "openvino",
    "tensorrt": "tensorrt",
}


@dataclass(frozen=True, slots=True)
class SelectedRuntime:
    """A running runtime.

    Attributes:
        reason: why this one, in words.
    """

    runtime: Runtime
    reason: str


def start_runtime(
    source: ModelSource,
    choice: RuntimeChoice,
    *,
    class_ids: Sequence[int] | None = None,
    precision: Precision = "auto",
    threads: int | None = None,
    image_size: int = 640,
    sparse_boxes: bool = False,
) -> SelectedRuntime:
    """Load a model on the requested runtime.

    Args:
        class_ids: sorted; a checkpoint's network computes only these. For an exported file the classes are
            filtered afterwards.
        sparse_boxes: compute a checkpoint's boxes only at candidate cells; for thresholds that few cells
            reach. An exported file computes all.

    Raises:
        RuntimeMissingError: the named runtime is not installed. There is no fallback.
        RuntimeUnusableError: it cannot run this file, or not in this precision.
    """
    if choice != "auto" and choice not in RUNTIMES:
        raise ValueError(f"runtime must be auto, {', '.join(RUNTIMES)}; got {choice!r}")
    check_runtime(source, choice)
    if choice != "auto":
        runtime = _start(source, choice, class_ids, precision, threads, image_size, sparse_boxes)
        return SelectedRuntime(runtime, "as requested")
    from vision.runtimes.autotune import fastest_runtime

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
        _start(source, name, class_ids, precision, threads, image_size, sparse_boxes), reason
    )


def check_runtime(source: ModelSource, choice: RuntimeChoice) -> None:
    """Raise the RuntimeUnusableError or RuntimeMissingError of `start_runtime` without starting anything."""
    if choice == "auto":
        if not any(installed(name) for name in source.runners()):
            required(source.runners()[0])  # raises with what to install
        return
    if choice not in source.runners():
        raise cannot_run(source, choice)
    if choice != "torch":
        required(choice)


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
        from vision.runtimes.torchscript_runtime import TorchScriptRuntime

        return TorchScriptRuntime(path, head, precision=precision, threads=threads)
    if name == "onnxruntime":
        from vision.runtimes.onnx_runtime import OnnxRuntime

        return OnnxRuntime(path, head, precision=precision, threads=threads)
    if name == "openvino":
        from vision.runtimes.openvino_runtime import OpenVinoRuntime

        return OpenVinoRuntime(path, head, precision=precision, threads=threads)
    from vision.runtimes.tensorrt_runtime import TensorRtRuntime

    return TensorRtRuntime(path, head, precision=precision, threads=threads)


def cache_folder() -> Path:
    """Folder of converted networks and cached choices: below `$XDG_CACHE_HOME` or `~/.cache`."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    root = Path(base) if os.path.isabs(base) else Path.home() / ".cache"
    return root / "mavlink-companion" / "runtimes"


def _start(
    source: ModelSource,
    name: RuntimeName,
    class_ids: Sequence[int] | None,
    precision: Precision,
    threads: int | None,
    image_size: int,
    sparse_boxes: bool,
) -> Runtime:
    if source.kind is not None:
        return runtime_of_file(name, source.path, precision=precision, threads=threads)
    # torch builds and runs a checkpoint's network; a file for another runtime does not need it.
    if name == "torch":
        from vision.runtimes.torch_runtime import TorchRuntime

        return TorchRuntime(
            source.take_model(),
            class_ids=class_ids,
            precision=precision,
            threads=threads,
            sparse_boxes=sparse_boxes,
        )
    from vision.runtimes.network import Network

    network = Network(source.take_model(), class_ids, sparse_boxes=sparse_boxes)
    path = _converted(source, network, name, image_size)
    return runtime_of_file(name, path, network.head, precision=precision, threads=threads)


def _converted(source: ModelSource, network: Network, name: RuntimeName, image_size: int) -> Path:
    """The checkpoint's network as a file for another runtime, converted once and cached."""
    import torch

    from vision.runtimes.export import export_network

    assert source.description is not None
    kind = _EXPORTS[name]
    head = network.head
    digest = weights_sha256(source.path)
    # A plan is built for a largest side; the others have a dynamic size.
    side = image_size if kind == "tensorrt" else 640
    plain = source.description.to_plain()
    made_of = [FORMAT, digest, plain, head.class_ids, head.kinds, side]
    key = json.dumps([*made_of, torch.__version__, version(name)])
    stem = f"{source.path.stem}-{hashlib.sha256(key.encode()).hexdigest()[:24]}"
    path = cache_folder() / f"{stem}{SUFFIXES[kind]}"
    facts = ExportedFacts(
        tuple(source.class_names[index] for index in head.class_ids),
        head.strides,
        head.reg_max,
        head.end_to_end,
        max(side, 2 * max(head.strides)),
        digest,
        metadata=source.metadata,
    )
    try:
        if not path.is_file():
            logger.info("converting %s for %s, once; cached at %s", source.path.name, name, path)
            export_network(network, facts, kind, path)
    except OSError as error:
        raise RuntimeUnusableError(
            f"{path}: the converted network cannot be cached ({error.strerror}); "
            "set XDG_CACHE_HOME to a writable folder"
        ) from error
    return path
