"""ONNX Runtime: on the processor, or on an NVIDIA GPU where its package is built for one."""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vision.foreign.layouts import ForeignFacts, Port, recognise
from vision.runtimes.base import Precision, RuntimeName, RuntimeUnusableError, required
from vision.runtimes.exported import INPUT, KEY, ExportedFacts, own_facts
from vision.runtimes.load_trial import check_load
from vision.yolo.level_outputs import Head, LevelOutput, Product

# As ONNX Runtime names them. An available provider is used: its package was chosen for it.
_PROVIDERS = ("CUDAExecutionProvider", "CPUExecutionProvider")
_ERRORS_ONLY = 3


class OnnxRuntime:
    """An ONNX file written by `export`. See `base.Runtime`.

    Args:
        path: the file.
        head: layout of its outputs; None: from the file's metadata.
        precision: `auto`, or `float32` for a file that is not int8.
        threads: of the processor; None: ONNX Runtime's default.
    """

    product: Product = staticmethod(np.matmul)
    name: RuntimeName = "onnxruntime"

    def __init__(
        self,
        path: Path,
        head: Head | None = None,
        *,
        precision: Precision = "auto",
        threads: int | None = None,
    ) -> None:
        self._session, provider = open_session(path, threads)
        facts = own_facts(onnx_facts(path, self._session), path)
        if precision not in ("auto", facts.precision):
            raise RuntimeUnusableError(
                f"{path}: onnxruntime computes in {facts.precision}, the precision of the file; "
                f"not in {precision}"
            )
        self.head = head if head is not None else facts.head()
        self.precision, self.precision_reason = facts.precision, f"precision of the file ({provider})"
        self._threads = threads

    @property
    def threads(self) -> int:
        return self._threads or len(os.sched_getaffinity(0))

    def prepare(self, height: int, width: int) -> None:
        self.infer(np.zeros((height, width, 3), np.uint8))

    def infer(self, image_bgr: NDArray[np.uint8]) -> list[LevelOutput]:
        outputs = [level[0] for level in self._session.run(None, {INPUT: image_bgr[None]})]
        return self.head.levels(outputs)


def open_session(path: Path, threads: int | None) -> tuple[Any, str]:
    """An inference session on the best available provider, and the provider's name."""
    onnxruntime = required("onnxruntime")
    options = onnxruntime.SessionOptions()
    options.log_severity_level = _ERRORS_ONLY
    # By default idle threads spin: half as much processor time again, which the flight shares.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    if threads is not None:
        options.intra_op_num_threads = threads
    available = onnxruntime.get_available_providers()
    providers = [provider for provider in _PROVIDERS if provider in available]
    session = _session(onnxruntime, path, options, providers)
    started = session.get_providers()
    if started[:1] != providers[:1]:
        raise RuntimeUnusableError(
            f"onnxruntime cannot start {providers[0]}, which its package is built for; "
            f"started {started}. Install its GPU libraries, or the package for processors"
        )
    return session, str(started[0])


def onnx_facts(path: Path, session: Any = None) -> ExportedFacts | ForeignFacts:
    """Read the metadata of an ONNX file: of our own export, or of a recognised network."""
    if session is None:
        onnxruntime = required("onnxruntime")
        options = onnxruntime.SessionOptions()
        options.log_severity_level = _ERRORS_ONLY
        # Only the metadata is read: no optimisation.
        options.graph_optimization_level = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
        session = _session(onnxruntime, path, options, ["CPUExecutionProvider"])
    stated = session.get_modelmeta().custom_metadata_map
    if KEY in stated:
        return ExportedFacts.from_json(stated[KEY], path)
    return recognise(path, stated, _ports(session.get_inputs()), _ports(session.get_outputs()))


def _ports(nodes: Any) -> list[Port]:
    names = {"float": "float32", "double": "float64"}
    return [
        Port(
            node.name,
            # A dynamic length has a name, or none.
            tuple(length if type(length) is int else None for length in node.shape),
            names.get(kind := node.type.removeprefix("tensor(").removesuffix(")"), kind),
        )
        for node in nodes
    ]


# Of its errors: `[ONNXRuntimeError] : 7 : INVALID_PROTOBUF : Load model from FILE failed:`.
_PREFIX = re.compile(r"^\[ONNXRuntimeError\] : \d+ : \w+ : (?:Load model from .*? failed:)?")
_NO_MODEL = ("Protobuf parsing failed.", "No graph was found in the protobuf.")


def _session(onnxruntime: Any, path: Path, options: Any, providers: list[str]) -> Any:
    if not path.is_file():
        raise RuntimeUnusableError(f"{path}: no such file")
    check_load(path, "onnxruntime")
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=providers)
    # Its errors have no common base class but Exception.
    except Exception as error:
        reason = _PREFIX.sub("", " ".join(str(error).split()))
        if reason in _NO_MODEL:
            reason = "is not an ONNX model, or damaged; export or copy it again"
            raise RuntimeUnusableError(f"{path}: {reason}") from error
        raise RuntimeUnusableError(f"{path}: onnxruntime cannot load it: {reason}") from error
