"""Writes a network as a file for another runtime, with its metadata, and compares both before keeping it."""

from __future__ import annotations

import contextlib
import copy
import logging
import os
import tempfile
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from vision.extras import install_command
from vision.runtimes.base import RuntimeMissingError, RuntimeName, RuntimeUnusableError, required
from vision.runtimes.exported import INPUT, KEY, ExportedFacts, ExportKind, with_facts
from vision.runtimes.network import Network
from vision.runtimes.source import runtime_of_file
from vision.runtimes.torch_runtime import traced

logger = logging.getLogger(__name__)

# The lowest opset that supports these networks, for the oldest readers.
_OPSET = 17
# Largest difference of the exported file's outputs from torch's, in logits; rounding is far less.
_TOLERANCE = 0.02
# Logits of trained networks stay within this; the tolerance scales with larger ones.
_USUAL_LARGEST = 20.0
# What reads the file back.
READER: dict[ExportKind, RuntimeName] = {
    "onnx": "onnxruntime",
    "openvino": "openvino",
    "tensorrt": "tensorrt",
    "torchscript": "torch",
}


def convert_network(network: Network, facts: ExportedFacts, to: ExportKind, path: Path) -> None:
    """Write a network as a file for another runtime, and compare its outputs with torch's.

    Raises:
        RuntimeMissingError: the target runtime is not installed.
        RuntimeUnusableError: it cannot be converted, or the file's outputs differ from the network's.
    """
    with complete_file(path) as partial:
        if to == "onnx":
            write_onnx(network, facts, partial)
        elif to == "openvino":
            _write_openvino(network, facts, partial)
        elif to == "torchscript":
            _write_torchscript(network, facts, partial)
        else:
            _write_tensorrt(network, facts, partial)
        _check(network, facts, to, partial)


@contextlib.contextmanager
def complete_file(path: Path) -> Iterator[Path]:
    """Yield a path to write to; the file appears complete or not at all (OpenVINO's `.xml` last)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        yield Path(folder) / path.name
        for written in sorted(Path(folder).iterdir(), key=lambda file: file.name == path.name):
            os.replace(written, path.with_name(written.name))


def _example(side: int, *, height: int | None = None, seed: int = 0) -> torch.Tensor:
    """A smooth random image: (1, H, W, 3) uint8, so that every layer has varied input."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand((1, 3, 8, 8), generator=generator)
    shape = (side if height is None else height, side)
    fine = torch.nn.functional.interpolate(coarse, shape, mode="bilinear")
    return (fine * 255).to(torch.uint8).permute(0, 2, 3, 1).contiguous()


@contextlib.contextmanager
def _without_warnings() -> Iterator[None]:
    """Suppress exporters' warnings: deprecations, and sizes fixed by the tracer."""
    with torch.no_grad(), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def write_onnx(network: Network, facts: ExportedFacts, path: Path) -> None:
    """Write ONNX with the facts in its metadata. Raises RuntimeMissingError: the package onnx is missing."""
    try:
        import onnx
    except ImportError as error:
        raise RuntimeMissingError(f"exporting needs the package onnx: {install_command('onnx')}") from error
    with _without_warnings():
        example = _example(facts.image_size)
        graph: Any = traced(network, example)
        torch.onnx.export(
            graph,
            (example,),
            str(path),
            input_names=[INPUT],
            output_names=network.names,
            dynamic_axes={INPUT: {1: "height", 2: "width"}}
            | {name: {2: f"{name}_height", 3: f"{name}_width"} for name in network.names},
            opset_version=_OPSET,
            # The tracing exporter: the other one needs another package.
            dynamo=False,
        )
    exported = onnx.load(str(path))
    entry = exported.metadata_props.add()
    entry.key, entry.value = KEY, facts.to_json()
    onnx.save(exported, str(path))


def _write_openvino(network: Network, facts: ExportedFacts, path: Path) -> None:
    openvino = required("openvino")
    with _without_warnings():
        any_size = openvino.PartialShape([1, -1, -1, 3])
        example = _example(facts.image_size)
        # Traced here: OpenVINO would trace the module twice, which takes several times as long.
        exported = openvino.convert_model(
            traced(network, example), example_input=(example,), input=[any_size]
        )
    exported.inputs[0].get_tensor().set_names({INPUT})
    for output, name in zip(exported.outputs, network.names, strict=True):
        output.get_tensor().set_names({name})
    exported.set_rt_info(facts.to_json(), [KEY])
    openvino.save_model(exported, str(path), compress_to_fp16=False)


def _write_torchscript(network: Network, facts: ExportedFacts, path: Path) -> None:
    with _without_warnings():
        trace: Any = torch.jit.trace
        traced = trace(network, _example(facts.image_size), check_trace=False)
        torch.jit.save(traced, str(path), _extra_files={KEY: facts.to_json()})


def _write_tensorrt(network: Network, facts: ExportedFacts, path: Path) -> None:
    from vision.runtimes.tensorrt_runtime import build_plan

    onnx_path = path.with_suffix(".onnx")
    # TensorRT computes in the types of the file.
    write_onnx(copy.deepcopy(network).in_precision(torch.float16), facts, onnx_path)
    plan = build_plan(onnx_path, largest_side=facts.image_size, stride=max(facts.strides))
    path.write_bytes(with_facts(facts, plan))
    onnx_path.unlink()


def _check(network: Network, facts: ExportedFacts, to: ExportKind, path: Path) -> None:
    """Compare the file's outputs with torch's, for a square and another input: sizes must be dynamic."""
    head = network.head
    runtime = runtime_of_file(READER[to], path, head, precision="auto" if to == "tensorrt" else "float32")
    stride = max(facts.strides)
    square = _example(facts.image_size)
    other = _example(facts.image_size, height=max(stride, facts.image_size // 2 // stride * stride), seed=1)
    for image in (square, other):
        with torch.inference_mode():
            expected = [level[0].numpy() for level in network(image)]
        found: list[Any] = []
        try:
            for level in runtime.infer(image[0].numpy()):
                found += [getattr(level, kind) for kind in head.kinds]
        except (RuntimeError, RuntimeUnusableError) as error:
            raise _mismatch(to, image.shape, str(error)) from error
        worst = _largest_difference(expected, found)
        # Half precision rounds every layer; `companion models show --compare` compares the boxes.
        if not worst <= (_TOLERANCE if runtime.precision == "float32" else 50 * _TOLERANCE):
            raise _mismatch(to, image.shape, f"largest difference {worst:.3g}")


def _largest_difference(expected: Sequence[Any], found: Sequence[Any]) -> float:
    if [a.shape for a in expected] != [b.shape for b in found]:
        return float("inf")
    return max(
        float(np.abs(a - b).max()) / max(1.0, float(np.abs(a).max()) / _USUAL_LARGEST)
        for a, b in zip(expected, found, strict=True)
    )


def _mismatch(to: str, shape: Sequence[int], reason: str) -> RuntimeUnusableError:
    return RuntimeUnusableError(
        f"the network cannot be exported to {to}: for an image of {shape[2]}x{shape[1]} the file's outputs "
        f"differ from the network's ({' '.join(reason.split())[:300]})"
    )
