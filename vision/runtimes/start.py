"""Starts a model on a named runtime; a checkpoint is converted once for each, and cached."""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from vision.foreign.engines import ForeignRuntime, start_foreign
from vision.runtimes.base import Device, Precision, Runtime, RuntimeName, RuntimeUnusableError, version
from vision.runtimes.exported import FORMAT, SUFFIXES, ExportedFacts, ExportKind
from vision.runtimes.source import ModelSource, runtime_of_file
from vision.runtimes.stored_choice import cache_folder
from vision.yolo.checkpoint_pair import weights_sha256

if TYPE_CHECKING:
    from vision.runtimes.network import Network

logger = logging.getLogger(__name__)

# The export format of each runtime.
_EXPORTS: dict[RuntimeName, ExportKind] = {
    "onnxruntime": "onnx",
    "openvino": "openvino",
    "tensorrt": "tensorrt",
}


def start_named(
    source: ModelSource,
    name: RuntimeName,
    class_ids: Sequence[int] | None,
    precision: Precision,
    threads: int | None,
    image_size: int,
    sparse_boxes: bool,
    device: Device = "cpu",
) -> Runtime | ForeignRuntime:
    """Load a model on this runtime, which is installed. Arguments and errors as of `start_runtime`."""
    if source.foreign is not None:
        return start_foreign(source.foreign, source.path, name, precision=precision, threads=threads)
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
            model_sha256=weights_sha256(source.weights_path),
            device=device,
        )
    from vision.runtimes.network import Network

    network = Network(source.take_model(), class_ids, sparse_boxes=sparse_boxes)
    path = _converted(source, network, name, image_size)
    return runtime_of_file(name, path, network.head, precision=precision, threads=threads)


def _converted(source: ModelSource, network: Network, name: RuntimeName, image_size: int) -> Path:
    """The checkpoint's network as a file for another runtime, converted once and cached."""
    import torch

    from vision.runtimes.conversion import convert_network

    assert source.description is not None
    kind = _EXPORTS[name]
    head = network.head
    digest = weights_sha256(source.weights_path)
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
            convert_network(network, facts, kind, path)
    except OSError as error:
        raise RuntimeUnusableError(
            f"{path}: the converted network cannot be cached ({error.strerror}); "
            "set XDG_CACHE_HOME to a writable folder"
        ) from error
    return path
