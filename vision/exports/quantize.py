"""Quantises an exported network to int8, calibrated on images, with ONNX Runtime's quantiser.

Weights are int8 with a scale per output channel, activations uint8 with the range seen on the calibration
images. The last convolutions of the head stay in float: they give box sides and class logits. What else is
quantised depends on the runtime:

* OpenVINO gives a convolution's output in float if the next layer takes it so: only the inputs of the
  convolutions are quantised.
* ONNX Runtime needs quantised outputs for its int8 convolutions. SiLU is nearly 0 below -6, so that the range
  ends there: outputs far below 0 would take most of the 255 steps.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vision.evaluation.datasets import image_files, read_image
from vision.extras import install_command
from vision.letterbox import fit
from vision.runtimes.base import RuntimeMissingError, RuntimeUnusableError, required
from vision.runtimes.exported import INPUT, ExportKind

FEWEST_IMAGES = 16
# More do not change the ranges much, and each takes an inference in float32.
MOST_IMAGES = 128
_SILU_FROM = -6.0


def calibration_images(folder: Path, image_size: int, stride: int) -> list[NDArray[np.uint8]]:
    """The images of a folder as inputs of the network: (H, W, 3) uint8 BGR; evenly chosen from many.

    Raises:
        RuntimeUnusableError: the folder is missing or has fewer than `FEWEST_IMAGES`.
        DatasetError: an image cannot be read.
    """
    if not folder.is_dir():
        raise RuntimeUnusableError(f"{folder}: is not a folder; int8 is calibrated on a folder of images")
    files = image_files(folder)
    if len(files) < FEWEST_IMAGES:
        raise RuntimeUnusableError(
            f"{folder}: has {len(files)} images; int8 needs at least {FEWEST_IMAGES} for its calibration, "
            "of the kind that the camera will see"
        )
    if len(files) > MOST_IMAGES:
        files = [files[index] for index in np.linspace(0, len(files) - 1, MOST_IMAGES).astype(int)]
    images = (read_image(file) for file in files)
    return [
        np.ascontiguousarray(
            fit(image.shape[1], image.shape[0], image_size, stride=stride).apply(image)
        ).copy()
        for image in images
    ]


def quantize_onnx(source: Path, output: Path, images: Iterable[NDArray[np.uint8]], to: ExportKind) -> None:
    """Write an int8 form of an ONNX file of `export`.

    Args:
        images: inputs for the calibration.
        to: the runtime's kind of file, `onnx` or `openvino`.

    Raises:
        RuntimeMissingError: the quantiser is not installed.
    """
    try:
        import onnx

        required("onnxruntime")  # imports it without its telemetry
        from onnxruntime import quantization
    except ImportError as error:
        raise RuntimeMissingError(
            f"exporting to int8 needs the packages onnx and onnxruntime ({error}): {install_command('onnx')}"
        ) from error

    class Reader(quantization.CalibrationDataReader):  # type: ignore[misc]
        def __init__(self) -> None:
            self._inputs: Iterator[dict[str, Any]] = iter({INPUT: image[None]} for image in images)

        def get_next(self) -> dict[str, Any] | None:
            return next(self._inputs, None)

    model = onnx.load(str(source))
    graph = model.graph
    _name_constants(graph)
    options: dict[str, Any] = {"ActivationSymmetric": False, "WeightSymmetric": True}
    if to == "openvino":
        options["OpTypesToExcludeOutputQuantization"] = ["Conv"]
    else:
        options["TensorQuantOverrides"] = {
            name: [{"rmin": np.float32(_SILU_FROM)}] for name in _before_silu(graph)
        }
    root = logging.getLogger()
    level = root.level
    # The quantiser warns through the root logger that the file was not prepared by its own tool.
    root.setLevel(logging.ERROR)
    try:
        quantization.quantize_static(
            model,
            str(output),
            Reader(),
            quant_format=quantization.QuantFormat.QDQ,
            op_types_to_quantize=["Conv"],
            nodes_to_exclude=_last_convolutions(graph),
            per_channel=True,
            weight_type=quantization.QuantType.QInt8,
            activation_type=quantization.QuantType.QUInt8,
            calibrate_method=quantization.CalibrationMethod.MinMax,
            extra_options=options,
        )
    finally:
        root.setLevel(level)


def _name_constants(graph: Any) -> None:
    """Turn constant nodes into initialisers: only those are quantised as weights, per channel."""
    for node in [node for node in graph.node if node.op_type == "Constant"]:
        value = next((attribute.t for attribute in node.attribute if attribute.name == "value"), None)
        if value is not None:
            value.name = node.output[0]
            graph.initializer.append(value)
            graph.node.remove(node)


def _last_convolutions(graph: Any) -> list[str]:
    """Names of the convolutions that give the outputs; a rotated box comes from those of sides and angle."""
    producers = {name: node for node in graph.node for name in node.output}
    found = []
    names = {output.name for output in graph.output}
    seen: set[str] = set()
    while names:
        seen |= names
        nodes = [producers[name] for name in names if name in producers]
        found += [node.name for node in nodes if node.op_type == "Conv"]
        names = {name for node in nodes if node.op_type != "Conv" for name in node.input} - seen
    return found


def _before_silu(graph: Any) -> list[str]:
    """Names of the convolutions' outputs that a SiLU, x · sigmoid(x), reads."""
    convolved = {node.output[0] for node in graph.node if node.op_type == "Conv"}
    return [node.input[0] for node in graph.node if node.op_type == "Sigmoid" and node.input[0] in convolved]


def mean_probability_difference(
    expected: Sequence[NDArray[np.float32]], found: Sequence[NDArray[np.float32]], cells: int = 20
) -> float:
    """Mean difference of the class probabilities of the cells that are most probable in `expected`.

    Args:
        expected, found: (K, H, W) class logits of each level of one image.
    """
    first, second = (
        1
        / (
            1
            + np.exp(
                -np.concatenate([logits.reshape(len(logits), -1) for logits in levels], axis=1).clip(-60, 60)
            )
        )
        for levels in (expected, found)
    )
    best = np.argsort(first.max(axis=0), kind="stable")[-cells:]
    return float(np.abs(first[:, best].max(axis=0) - second[:, best].max(axis=0)).mean())
