"""Runs a recognised network with the runtime of its file: an image in, raw outputs out."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.foreign.class_names import NamesError
from vision.foreign.decoding import boxes_of, is_decoded
from vision.foreign.layouts import YOLOX_SUFFIX, ForeignFacts
from vision.letterbox import Letterbox, fit, fit_into
from vision.runtimes.base import Precision, RuntimeName, RuntimeUnusableError
from vision.yolo.postprocess import Boxes

_Run = Callable[..., Sequence[NDArray[Any]]]


class ForeignRuntime:
    """A network of another exporter, ready for inference. Not thread-safe.

    Attributes:
        facts: of the network; of YOLOX whether its boxes are decoded in the file is known only here.
        name, precision, precision_reason: as of `vision.runtimes.base.Runtime`.
    """

    def __init__(
        self,
        facts: ForeignFacts,
        path: Path,
        name: RuntimeName,
        run: _Run,
        precision: str,
        reason: str,
        threads: int,
    ) -> None:
        self.facts, self._path, self.name, self._run = facts, path, name, run
        self.precision, self.precision_reason, self._threads = precision, reason, threads
        if facts.layout == "yolox" and facts.fixed_size is not None:
            height, width = facts.fixed_size
            (output,) = self.infer(np.full((height, width, 3), 114, np.uint8))
            if (output[..., 4] == 1).all():
                raise RuntimeUnusableError(
                    f"{path}: has the shapes of YOLOX, but objectness 1 in every cell, as YOLOv6, which "
                    "is not supported"
                )
            if is_decoded(output, facts.fixed_size):
                self.facts = replace(facts, layout="objectness")

    @property
    def threads(self) -> int:
        return self._threads

    def prepare(self, height: int, width: int) -> None:
        self.infer(np.zeros((height, width, 3), np.uint8))

    def infer(self, image_bgr: NDArray[np.uint8]) -> Sequence[NDArray[Any]]:
        """(H, W, 3) uint8 BGR, of a size that `fit` gives → the file's outputs, valid until the next call."""
        pixels = self.facts.pixels
        tensor: NDArray[Any] = np.asarray(cv2.dnn.blobFromImage(image_bgr, swapRB=pixels.rgb), np.float32)
        if pixels.divisor != 1:
            # Divided, as exporters do: a product with the inverse differs in half precision.
            tensor /= np.float32(pixels.divisor)
        if any(pixels.mean):
            tensor -= np.array(pixels.mean, np.float32).reshape(1, 3, 1, 1)
            tensor /= np.array(pixels.deviation, np.float32).reshape(1, 3, 1, 1)
        if self.facts.dtype == "float16":
            tensor = tensor.astype(np.float16)
        if not self.facts.takes_size:
            return self._run(tensor)
        return self._run(tensor, np.array([[image_bgr.shape[1], image_bgr.shape[0]]], np.int64))

    def decode(
        self,
        outputs: Sequence[NDArray[Any]],
        size: tuple[int, int],
        confidence: float,
        iou: float,
        class_ids: Sequence[int] | None = None,
    ) -> Boxes:
        """The boxes of `infer`'s outputs. Arguments as of `decoding.boxes_of`."""
        try:
            return boxes_of(self.facts, outputs, size, confidence=confidence, iou=iou, class_ids=class_ids)
        except NamesError as error:
            raise RuntimeUnusableError(f"{self._path}: {error}") from None
        except (IndexError, ValueError) as error:
            shapes = ", ".join(str(output.shape) for output in outputs)
            raise RuntimeUnusableError(
                f"the network gave {shapes}, not what its file states ({self.facts.layout}): {error}"
            ) from error

    def fit(self, frame_width: int, frame_height: int, image_size: int, *, square: bool) -> Letterbox:
        """The letterbox for frames of one size; a file of a fixed size decides, else `image_size`."""
        facts, placement = self.facts, self.facts.pixels.placement
        if facts.fixed_size is None and placement == "centre":
            return fit(frame_width, frame_height, image_size, square=square, stride=facts.stride)
        if facts.fixed_size is None and placement == "corner" and not square:
            box = fit(frame_width, frame_height, image_size, stride=facts.stride)
            return fit_into(frame_width, frame_height, box.width, box.height, placement)
        height, width = facts.fixed_size or (image_size, image_size)
        return fit_into(frame_width, frame_height, width, height, placement)


def start_foreign(
    facts: ForeignFacts,
    path: Path,
    name: RuntimeName,
    *,
    precision: Precision = "auto",
    threads: int | None = None,
) -> ForeignRuntime:
    """Load the file on a runtime.

    Raises:
        RuntimeMissingError: the runtime is not installed.
        RuntimeUnusableError: it cannot load the file, or not in this precision.
    """
    if name == "openvino":
        from vision.runtimes.openvino_runtime import OpenVinoNetwork

        network = OpenVinoNetwork(path, precision=precision, threads=threads)
        started = ForeignRuntime(
            facts, path, name, network.run, network.precision, network.precision_reason, network.threads
        )
        started.precision, started.precision_reason = network.precision, network.precision_reason
        return started
    if precision not in ("auto", facts.precision):
        raise RuntimeUnusableError(
            f"{path}: {name} computes in {facts.precision}, the precision of the file; not in {precision}"
        )
    if name == "torch":
        import torch

        if threads is not None:
            torch.set_num_threads(threads)
        module = _torch_module(path)

        def run_module(tensor: NDArray[Any]) -> Sequence[NDArray[Any]]:
            with torch.inference_mode():
                found = module(torch.from_numpy(tensor))
            # A segmentation network also gives its prototypes of masks.
            found = found if isinstance(found, tuple | list) else (found,)
            return [output.numpy() for output in found if isinstance(output, torch.Tensor)]

        return ForeignRuntime(
            facts, path, name, run_module, facts.precision, "precision of the file", torch.get_num_threads()
        )
    from vision.runtimes.onnx_runtime import open_session

    session, provider = open_session(path, threads)
    names = [node.name for node in session.get_inputs()]

    def run_session(*inputs: NDArray[Any]) -> Sequence[NDArray[Any]]:
        outputs: Sequence[NDArray[Any]] = session.run(None, dict(zip(names, inputs, strict=True)))
        return outputs

    count = threads or len(os.sched_getaffinity(0))
    return ForeignRuntime(
        facts, path, name, run_session, facts.precision, f"precision of the file ({provider})", count
    )


def _torch_module(path: Path) -> Any:
    if path.suffix == YOLOX_SUFFIX:
        from vision.foreign.yolox import load_yolox

        loaded = load_yolox(path)
        assert loaded is not None
        return loaded[0].fuse()
    from vision.runtimes.torch_runtime import load_torchscript

    return load_torchscript(path)
