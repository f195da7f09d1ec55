"""OpenVINO, on Intel, AMD and ARM processors."""

from __future__ import annotations

import collections
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vision.file_kinds import open_file
from vision.foreign.layouts import ForeignFacts, Port, recognise
from vision.plain_yaml import PlainYamlError, load_plain_yaml
from vision.runtimes import base
from vision.runtimes.base import Precision, RuntimeName, RuntimeUnusableError, required
from vision.runtimes.exported import KEY, SUFFIXES, ExportedFacts, own_facts
from vision.runtimes.load_trial import check_load
from vision.text_file import read_text
from vision.yolo.level_outputs import Head, LevelOutput, Product

_HINTS = {"float32": "f32", "bfloat16": "bf16", "float16": "f16"}
_MOST_SIZES = 2
_LARGEST_METADATA_BYTES = 1 << 20
# The beginning of an `.xml` that OpenVINO reads.
_IR_HEAD = re.compile(rb"(\xef\xbb\xbf)?\s*(<\?xml[^>]*>\s*)?(<!--.*?-->\s*)*<net\b", re.DOTALL)


class OpenVinoNetwork:
    """An OpenVINO or ONNX file, compiled for each input size, which is faster than a dynamic size.

    Args:
        path: the `.xml` (its `.bin` beside it) or `.onnx`.
        precision: `auto`: bfloat16 if the processor supports it, else float32; the only one for an int8 file,
            whose other layers compute so.
        threads: of the processor; None: OpenVINO's default.
    """

    name: RuntimeName = "openvino"

    def __init__(self, path: Path, *, precision: Precision = "auto", threads: int | None = None) -> None:
        self._openvino = required("openvino")
        self._core = self._openvino.Core()
        self._model = _read(self._core, path)
        native = base.bfloat16_instructions()
        self._automatic = precision == "auto"
        int8 = any(node.get_type_name() == "FakeQuantize" for node in self._model.get_ops())
        if int8 and precision != "auto":
            raise RuntimeUnusableError(f"{path}: is an int8 file; its precision is auto, not {precision}")
        self._computes = ("bfloat16" if native else "float32") if precision == "auto" else precision
        self.precision: str = self._computes
        if int8:
            self.precision = "int8"
            self.precision_reason = f"precision of the file; its other layers in {self._computes}"
        elif precision == "auto":
            self.precision_reason = (
                f"the processor computes in it ({native})"
                if native
                else "this processor does not compute in bfloat16"
            )
        else:
            self.precision_reason = "as requested"
        self._settings: dict[str, Any] = {
            "PERFORMANCE_HINT": "LATENCY",
            "INFERENCE_PRECISION_HINT": _HINTS[self._computes],
        }
        if threads is not None:
            self._settings["INFERENCE_NUM_THREADS"] = threads
        self._threads = threads
        self._requests: collections.OrderedDict[tuple[int, ...], Any] = collections.OrderedDict()

    @property
    def threads(self) -> int:
        """As compiled; before the first inference as requested, 0 for unknown."""
        return self._threads or 0

    def run(self, *inputs: NDArray[Any]) -> list[NDArray[Any]]:
        """The outputs for one image; they are the network's memory, valid until the next call.

        Args:
            inputs: C-contiguous and writeable; the first is the image. They are not copied.
        """
        shape = inputs[0].shape
        request = self._requests.get(shape) or self._compiled(shape)
        for index, array in enumerate(inputs):
            request.set_input_tensor(index, self._openvino.Tensor(array, shared_memory=True))
        request.infer()
        return [request.get_output_tensor(index).data for index in range(len(self._model.outputs))]

    def _compiled(self, size: tuple[int, ...]) -> Any:
        try:
            sized = self._model.clone()
            if sized.inputs[0].partial_shape != self._openvino.PartialShape(list(size)):
                sized.reshape({sized.inputs[0]: list(size)})
            compiled = self._core.compile_model(sized, "CPU", self._settings)
        except RuntimeError as error:
            raise RuntimeUnusableError(
                f"openvino cannot compile the network for {size}: {' '.join(str(error).split())}"
            ) from error
        used = str(compiled.get_property("INFERENCE_PRECISION_HINT"))
        if _HINTS[self._computes] not in used.replace("float", "f"):
            if self._automatic and _HINTS["float32"] in used.replace("float", "f"):
                self._computes = "float32"
                self.precision_reason = "openvino does not use this processor's bfloat16"
                if self.precision != "int8":
                    self.precision = "float32"
                self._settings["INFERENCE_PRECISION_HINT"] = _HINTS["float32"]
                return self._compiled(size)
            raise RuntimeUnusableError(
                f"openvino computes in {used} on this processor, not in {self._computes}"
            )
        self._threads = int(compiled.get_property("INFERENCE_NUM_THREADS")) or self._threads
        request = self._requests[size] = compiled.create_infer_request()
        if len(self._requests) > _MOST_SIZES:
            self._requests.popitem(last=False)
        return request


class OpenVinoRuntime(OpenVinoNetwork):
    """An OpenVINO or ONNX file written by `export`. See `base.Runtime`, and `OpenVinoNetwork`.

    Args:
        head: layout of its outputs; None: from the file's metadata.
    """

    product: Product = staticmethod(np.matmul)

    def __init__(
        self,
        path: Path,
        head: Head | None = None,
        *,
        precision: Precision = "auto",
        threads: int | None = None,
    ) -> None:
        super().__init__(path, precision=precision, threads=threads)
        self.head = head if head is not None else own_facts(openvino_facts(path, self._model), path).head()

    def prepare(self, height: int, width: int) -> None:
        self.infer(np.zeros((height, width, 3), np.uint8))

    def infer(self, image_bgr: NDArray[np.uint8]) -> list[LevelOutput]:
        return self.head.levels([output[0] for output in self.run(image_bgr[None])])


def openvino_facts(path: Path, model: Any = None) -> ExportedFacts | ForeignFacts:
    """Read the metadata of an OpenVINO or ONNX file: of our own export, or of a recognised network."""
    if model is None:
        _check_head(path)
        model = _read(required("openvino").Core(), path)
    # The metadata of an ONNX file is under its frontend's.
    for keys in ([KEY], ["framework", KEY]):
        if model.has_rt_info(keys):
            return ExportedFacts.from_json(str(model.get_rt_info(keys).value), path)
    return recognise(path, _stated(path, model), _ports(model.inputs), _ports(model.outputs))


def _stated(path: Path, model: Any) -> dict[str, Any]:
    """Metadata of another exporter: `metadata.yaml` beside an OpenVINO file, an ONNX file's own."""
    beside = path.with_name("metadata.yaml")
    if path.suffix == ".onnx":
        if not model.has_rt_info(["framework"]):
            return {}
        return {key: str(value.value) for key, value in dict(model.get_rt_info(["framework"])).items()}
    if not beside.is_file():
        return {}
    try:
        if beside.stat().st_size > _LARGEST_METADATA_BYTES:
            raise PlainYamlError(f"has more than {_LARGEST_METADATA_BYTES} bytes")
        stated = load_plain_yaml(read_text(beside))
    except (PlainYamlError, UnicodeDecodeError, OSError) as error:
        raise RuntimeUnusableError(f"{beside}: cannot be read ({error})") from None
    return {str(key): value for key, value in stated.items()} if isinstance(stated, dict) else {}


def _ports(nodes: Any) -> list[Port]:
    names = {"f32": "float32", "f16": "float16", "i64": "int64", "i32": "int32"}
    return [
        Port(
            node.get_any_name() if node.get_names() else "",
            tuple(int(length.to_string()) if length.is_static else None for length in node.partial_shape),
            names.get(node.element_type.get_type_name(), node.element_type.get_type_name()),
        )
        for node in nodes
    ]


def _check_head(path: Path) -> None:
    """Refuse an `.xml` that is no IR: OpenVINO would try its other readers, which print to standard error."""
    if path.suffix != SUFFIXES["openvino"]:
        return
    try:
        with open_file(path) as file:
            head = file.read(1024)
    except OSError as error:
        raise RuntimeUnusableError(f"{path}: cannot be read ({error.strerror or error})") from None
    if not _IR_HEAD.match(head):
        raise RuntimeUnusableError(
            f"{path}: is not an OpenVINO model: expected an XML document that begins with <net; "
            "export or copy it again"
        )


def _read(core: Any, path: Path) -> Any:
    if not path.is_file():
        raise RuntimeUnusableError(f"{path}: no such file")
    check_load(path, "openvino")
    try:
        return core.read_model(str(path))
    except RuntimeError as error:
        raise RuntimeUnusableError(
            f"{path}: openvino cannot load it: {' '.join(str(error).split())}"
        ) from error
