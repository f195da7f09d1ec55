"""OpenVINO, on Intel, AMD and ARM processors."""

from __future__ import annotations

import collections
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vision.runtimes import base
from vision.runtimes.base import Precision, RuntimeName, RuntimeUnusableError, required
from vision.runtimes.exported import KEY, ExportedFacts, not_ours
from vision.yolo.level_outputs import Head, LevelOutput, Product

_HINTS = {"float32": "f32", "bfloat16": "bf16", "float16": "f16"}
_MOST_SIZES = 2


class OpenVinoRuntime:
    """An OpenVINO or ONNX file written by `export`. See `base.Runtime`.

    The network is compiled for each input size, which is faster than a dynamic size.

    Args:
        path: the `.xml` (its `.bin` beside it) or `.onnx`.
        head: layout of its outputs; None: from the file's metadata.
        precision: `auto`: bfloat16 if the processor supports it, else float32.
        threads: of the processor; None: OpenVINO's default.
    """

    product: Product = staticmethod(np.matmul)
    name: RuntimeName = "openvino"

    def __init__(
        self,
        path: Path,
        head: Head | None = None,
        *,
        precision: Precision = "auto",
        threads: int | None = None,
    ) -> None:
        self._openvino = required("openvino")
        self._core = self._openvino.Core()
        self._model = _read(self._core, path)
        self.head = head if head is not None else openvino_facts(path, self._model).head()
        native = base.bfloat16_instructions()
        self._automatic = precision == "auto"
        if precision == "auto":
            self.precision = "bfloat16" if native else "float32"
            self.precision_reason = (
                f"the processor computes in it ({native})"
                if native
                else "this processor does not compute in bfloat16"
            )
        else:
            self.precision, self.precision_reason = precision, "as requested"
        self._settings: dict[str, Any] = {
            "PERFORMANCE_HINT": "LATENCY",
            "INFERENCE_PRECISION_HINT": _HINTS[self.precision],
        }
        if threads is not None:
            self._settings["INFERENCE_NUM_THREADS"] = threads
        self._threads = threads
        self._requests: collections.OrderedDict[tuple[int, int], Any] = collections.OrderedDict()

    @property
    def threads(self) -> int:
        """As compiled; before the first inference as requested, 0 for unknown."""
        return self._threads or 0

    def prepare(self, height: int, width: int) -> None:
        self.infer(np.zeros((height, width, 3), np.uint8))

    def infer(self, image_bgr: NDArray[np.uint8]) -> list[LevelOutput]:
        size = (image_bgr.shape[0], image_bgr.shape[1])
        request = self._requests.get(size) or self._compiled(size)
        # No copies: the tensor is the image, the outputs are the request's memory.
        request.set_input_tensor(self._openvino.Tensor(image_bgr[None], shared_memory=True))
        request.infer()
        outputs = [request.get_output_tensor(index).data[0] for index in range(len(self._model.outputs))]
        return self.head.levels(outputs)

    def _compiled(self, size: tuple[int, int]) -> Any:
        try:
            sized = self._model.clone()
            sized.reshape([1, *size, 3])
            compiled = self._core.compile_model(sized, "CPU", self._settings)
        except RuntimeError as error:
            raise RuntimeUnusableError(
                f"openvino cannot compile the network for {size[1]}x{size[0]}: {' '.join(str(error).split())}"
            ) from error
        used = str(compiled.get_property("INFERENCE_PRECISION_HINT"))
        if _HINTS[self.precision] not in used.replace("float", "f"):
            if self._automatic and _HINTS["float32"] in used.replace("float", "f"):
                self.precision = "float32"
                self.precision_reason = "openvino does not use this processor's bfloat16"
                self._settings["INFERENCE_PRECISION_HINT"] = _HINTS["float32"]
                return self._compiled(size)
            raise RuntimeUnusableError(
                f"openvino computes in {used} on this processor, not in {self.precision}"
            )
        self._threads = int(compiled.get_property("INFERENCE_NUM_THREADS")) or self._threads
        request = self._requests[size] = compiled.create_infer_request()
        if len(self._requests) > _MOST_SIZES:
            self._requests.popitem(last=False)
        return request


def openvino_facts(path: Path, model: Any = None) -> ExportedFacts:
    """Read the metadata of an exported OpenVINO or ONNX file."""
    if model is None:
        model = _read(required("openvino").Core(), path)
    # The metadata of an ONNX file is under its frontend's.
    for keys in ([KEY], ["framework", KEY]):
        if model.has_rt_info(keys):
            return ExportedFacts.from_json(str(model.get_rt_info(keys).value), path)
    raise not_ours(path)


def _read(core: Any, path: Path) -> Any:
    if not path.is_file():
        raise RuntimeUnusableError(f"{path}: no such file")
    try:
        return core.read_model(str(path))
    except RuntimeError as error:
        raise RuntimeUnusableError(
            f"{path}: openvino cannot load it: {' '.join(str(error).split())}"
        ) from error
