"""Exports a checkpoint's network for another runtime, as numbers of 32 bits or quantised to int8."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from vision.exports.quantize import calibration_images, mean_probability_difference, quantize_onnx
from vision.runtimes.base import RuntimeUnusableError, required
from vision.runtimes.conversion import READER, complete_file, convert_network, write_onnx
from vision.runtimes.exported import KEY, SUFFIXES, ExportedFacts, ExportKind
from vision.runtimes.network import Network
from vision.runtimes.source import runtime_of_file
from vision.yolo.checkpoint import load_checkpoint
from vision.yolo.checkpoint_pair import weights_sha256

logger = logging.getLogger(__name__)

# Largest mean difference of the probabilities of an int8 file's best cells; YOLOv8n has 0.02.
_INT8_TOLERANCE = 0.1
_INT8_CHECKED_IMAGES = 8


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
    required(READER[to])
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
    if calibrate is None:
        convert_network(Network(model), facts, to, path)
    else:
        images = calibration_images(calibrate, image_size, max(facts.strides))
        _export_int8(Network(model), facts, to, path, images)
    logger.info("%s: written for %s", path, to)
    return path


def _export_int8(
    network: Network, facts: ExportedFacts, to: ExportKind, path: Path, images: Sequence[NDArray[np.uint8]]
) -> None:
    with complete_file(path) as partial:
        _write_int8(network, facts, to, partial, images)
        _check_int8(network, to, partial, images[:_INT8_CHECKED_IMAGES])


def _write_int8(
    network: Network,
    facts: ExportedFacts,
    to: ExportKind,
    path: Path,
    calibration: Sequence[NDArray[np.uint8]],
) -> None:
    with tempfile.TemporaryDirectory(prefix="companion-int8-") as folder:
        plain, quantised = Path(folder) / "float32.onnx", Path(folder) / "int8.onnx"
        write_onnx(network, facts, plain)
        if to == "onnx":
            quantize_onnx(plain, path, calibration, to)
            return
        quantize_onnx(plain, quantised, calibration, to)
        openvino = required("openvino")
        exported = openvino.convert_model(str(quantised))
    exported.set_rt_info(facts.to_json(), [KEY])
    openvino.save_model(exported, str(path), compress_to_fp16=False)


def _check_int8(network: Network, to: ExportKind, path: Path, images: Sequence[NDArray[np.uint8]]) -> None:
    """Compare the probabilities of the best cells with torch's."""
    runtime = runtime_of_file(READER[to], path, network.head)
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
