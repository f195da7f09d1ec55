"""Exports a checkpoint for another runtime, with its metadata, and verifies the file before keeping it."""

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
from numpy.typing import NDArray

from vision.extras import install_command
from vision.runtimes.base import RuntimeMissingError, RuntimeName, RuntimeUnusableError, required
from vision.runtimes.exported import INPUT, KEY, SUFFIXES, ExportedFacts, ExportKind, with_facts
from vision.runtimes.network import Network
from vision.runtimes.quantize import calibration_images, mean_probability_difference, quantize_onnx
from vision.runtimes.source import runtime_of_file
from vision.runtimes.torch_runtime import traced
from vision.yolo.checkpoint import load_checkpoint
from vision.yolo.checkpoint_pair import weights_sha256

logger = logging.getLogger(__name__)

# The lowest opset that supports these networks, for the oldest readers.
_OPSET = 17
# Largest difference of the exported file's outputs from torch's, in logits; rounding is far less.
_TOLERANCE = 0.02
# Largest mean difference of the probabilities of an int8 file's best cells; YOLOv8n has 0.02.
_INT8_TOLERANCE = 0.1
_INT8_CHECKED_IMAGES = 8
# Logits of trained networks stay within this; the tolerance scales with larger ones.
_USUAL_LARGEST = 20.0
_READER: dict[ExportKind, RuntimeName] = {
    "onnx": "onnxruntime",
    "openvino": "openvino",
    "tensorrt": "tensorrt",
    "torchscript": "torch",
}


def export(
    model_path: Path,
    to: ExportKind,
    output: Path | None = None,
    image_size: int = 640,
    *,
    folder: Path | None = None,
    model_family: str = "",
    calibrate: Path | None = None,
) -> Path:
    """Export a checkpoint's network for another runtime.

    The file takes (1, H, W, 3) uint8 BGR, H and W any multiples of the largest stride, and returns for each
    level (stride S) `sides_S` and `classes_S`, see `LevelOutput`. It contains its `ExportedFacts`.

    Args:
        output: file to write; None: the checkpoint's name with the kind's suffix (`SUFFIXES`), in `folder`.
        image_size: size for tuning and verification; for a TensorRT plan the largest side.
        folder: None: the checkpoint's.
        model_family: of the network, stored in the facts.
        calibrate: a folder of images; the file is then quantised to int8 (`onnx` and `openvino`).

    Raises:
        CheckpointError: the checkpoint cannot be read.
        RuntimeMissingError: the target runtime or the quantiser is not installed.
        RuntimeUnusableError: the network cannot be exported, the file's outputs differ from the network's, or
            the calibration folder has too few images.
        DatasetError: an image of it cannot be read.
    """
    if to not in SUFFIXES:
        raise RuntimeUnusableError(f"can export to {', '.join(SUFFIXES)}, not to {to!r:.50}")
    if calibrate is not None and to not in ("onnx", "openvino"):
        raise RuntimeUnusableError(f"int8 can be exported to onnx and openvino, not to {to}")
    required(_READER[to])
    loaded = load_checkpoint(model_path)
    model = loaded.model
    facts = ExportedFacts(
        class_names=loaded.class_names,
        strides=tuple(model.strides),
        reg_max=model.reg_max,
        end_to_end=model.end_to_end,
        image_size=image_size,
        source_sha256=weights_sha256(model_path),
        precision="float32" if calibrate is None else "int8",
        model_family=model_family,
        metadata=loaded.metadata,
    )
    if image_size < 2 * max(facts.strides) or image_size % max(facts.strides):
        raise RuntimeUnusableError(f"image_size must be a multiple of {max(facts.strides)}, got {image_size}")
    path = output
    if path is None:
        path = (model_path.parent if folder is None else folder) / f"{model_path.stem}{SUFFIXES[to]}"
    if path.suffix != SUFFIXES[to]:
        raise RuntimeUnusableError(f"{path}: a file for {to} must end in {SUFFIXES[to]}")
    calibration = calibration_images(calibrate, image_size, max(facts.strides)) if calibrate else ()
    return export_network(Network(model), facts, to, path, calibration)


def export_network(
    network: Network,
    facts: ExportedFacts,
    to: ExportKind,
    path: Path,
    calibration: Sequence[NDArray[np.uint8]] = (),
) -> Path:
    """Export a network. The file appears complete or not at all (OpenVINO's `.xml` last).

    Args:
        calibration: inputs of the network; if there are any, the file is quantised to int8.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
        partial = Path(folder) / path.name
        if calibration:
            _write_int8(network, facts, to, partial, calibration)
        elif to == "onnx":
            _write_onnx(network, facts, partial)
        elif to == "openvino":
            _write_openvino(network, facts, partial)
        elif to == "torchscript":
            _write_torchscript(network, facts, partial)
        else:
            _write_tensorrt(network, facts, partial)
        if calibration:
            _check_int8(network, to, partial, calibration[:_INT8_CHECKED_IMAGES])
        else:
            _check(network, facts, to, partial)
        for exported in sorted(Path(folder).iterdir(), key=lambda exported: exported.name == path.name):
            os.replace(exported, path.with_name(exported.name))
    logger.info("%s: written for %s", path, to)
    return path


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


def _write_onnx(network: Network, facts: ExportedFacts, path: Path) -> None:
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


def _write_int8(
    network: Network,
    facts: ExportedFacts,
    to: ExportKind,
    path: Path,
    calibration: Sequence[NDArray[np.uint8]],
) -> None:
    with tempfile.TemporaryDirectory(prefix="companion-int8-") as folder:
        plain, quantised = Path(folder) / "float32.onnx", Path(folder) / "int8.onnx"
        _write_onnx(network, facts, plain)
        if to == "onnx":
            quantize_onnx(plain, path, calibration, to)
            return
        quantize_onnx(plain, quantised, calibration, to)
        openvino = required("openvino")
        exported = openvino.convert_model(str(quantised))
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
    _write_onnx(copy.deepcopy(network).in_precision(torch.float16), facts, onnx_path)
    plan = build_plan(onnx_path, largest_side=facts.image_size, stride=max(facts.strides))
    path.write_bytes(with_facts(facts, plan))
    onnx_path.unlink()


def _check(network: Network, facts: ExportedFacts, to: ExportKind, path: Path) -> None:
    """Compare the file's outputs with torch's, for a square and another input: sizes must be dynamic."""
    head = network.head
    runtime = runtime_of_file(_READER[to], path, head, precision="auto" if to == "tensorrt" else "float32")
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
        # Half precision rounds every layer; `companion models verify` compares the boxes.
        if not worst <= (_TOLERANCE if runtime.precision == "float32" else 50 * _TOLERANCE):
            raise _mismatch(to, image.shape, f"largest difference {worst:.3g}")


def _check_int8(network: Network, to: ExportKind, path: Path, images: Sequence[NDArray[np.uint8]]) -> None:
    """Compare the probabilities of the best cells with torch's."""
    runtime = runtime_of_file(_READER[to], path, network.head)
    differences = []
    for image in images:
        with torch.inference_mode():
            levels = network.head.levels(
                [output[0].numpy() for output in network(torch.from_numpy(image[None]))]
            )
        found = runtime.infer(image)
        differences.append(
            mean_probability_difference(
                [level.classes for level in levels], [level.classes for level in found]
            )
        )
    worst = float(np.mean(differences))
    if not worst <= _INT8_TOLERANCE:
        raise RuntimeUnusableError(
            f"the network cannot be quantised: the probabilities of its best cells differ by {worst:.3f} "
            f"on average, at most {_INT8_TOLERANCE} is accepted; calibrate with images of the kind it detects"
        )
    logger.info("%s: int8, the probabilities of the best cells differ by %.3f on average", path.name, worst)


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
