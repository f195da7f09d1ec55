"""Frames in, detections out: letterbox → network → class filter → suppression → the frame's own pixels."""

from __future__ import annotations

import copy
import difflib
import logging
import statistics
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from vision.detections import Detections
from vision.letterbox import Letterbox, fit, to_tensor
from vision.model_files import find_model
from vision.weights import DEFAULT_WEIGHTS
from vision.yolo.architecture import YoloModel
from vision.yolo.checkpoint import CheckpointError, load_checkpoint
from vision.yolo.description import ModelDescription
from vision.yolo.postprocess import select_boxes

logger = logging.getLogger(__name__)

DEFAULT_MODEL = "default"
Precision = Literal["auto", "float32", "bfloat16"]
_DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}


@dataclass(frozen=True, slots=True)
class Timing:
    """How long the parts of one detection took, milliseconds."""

    preprocess_ms: float
    inference_ms: float
    postprocess_ms: float

    @property
    def total_ms(self) -> float:
        return self.preprocess_ms + self.inference_ms + self.postprocess_ms


class Detector:
    """A YOLOv8 network with its thresholds. Not to be shared between threads.

    Attributes:
        class_names: id → name, the model's own table.
        class_ids: those it reports, sorted; None for all.
        precision: what the network computes in, `float32` or `bfloat16`.
        precision_reason: why, in words.
        description: what the network was built from.
        metadata: what the checkpoint tells about itself (licence, origin, score).
        last_timing: of the latest `detect`; None before the first.
    """

    def __init__(
        self,
        model: str | Path = DEFAULT_MODEL,
        *,
        classes: Sequence[str | int] | None = None,
        confidence: float = 0.25,
        iou: float = 0.7,
        image_size: int = 640,
        precision: Precision = "auto",
        threads: int | None = None,
        square: bool = False,
    ) -> None:
        """Load the model and make it ready.

        Args:
            model: `default`, the bundled one, or the path of a checkpoint: our own, or an Ultralytics YOLOv8
                `.pt`.
            classes: names or ids to report; None for all.
            confidence: boxes not above this are dropped, 0..1.
            iou: of two boxes of one class overlapping more than this the less confident is dropped, 0..1.
            image_size: longer side of the network's input, pixels, a multiple of 32.
            precision: `auto` takes bfloat16 only where the processor computes in it and it measures faster.
            threads: processor threads for the whole process's torch; None leaves them as they are.
            square: pad the input to a square rather than to the next multiple of 32.

        Raises:
            CheckpointError: the model cannot be read.
            ValueError: an unknown class (the message names the nearest), or a number out of its range.
        """
        for name, value in (("confidence", confidence), ("iou", iou)):
            if not 0.0 <= value <= 1.0:
                raise ValueError(f"{name} must be in 0..1, got {value}")
        if precision not in ("auto", *_DTYPES):
            raise ValueError(f"precision must be auto, float32 or bfloat16, got {precision!r}")
        if threads is not None:
            if threads < 1:
                raise ValueError(f"threads must be at least 1, got {threads}")
            torch.set_num_threads(threads)
        fit(image_size, image_size, image_size)  # Refuses a bad size now, not at the first frame.
        path = _model_path(model)
        loaded = load_checkpoint(path)
        if loaded.description.channels != 3:
            raise CheckpointError(f"{path}: takes {loaded.description.channels} channels, frames have 3")
        self.class_names: tuple[str, ...] = loaded.class_names
        self.class_ids = None if classes is None else resolve_classes(classes, loaded.class_names)
        self.description: ModelDescription = loaded.description
        self.metadata: dict[str, Any] = loaded.metadata
        self.confidence = confidence
        self.iou = iou
        self.image_size = image_size
        self.square = square
        self.last_timing: Timing | None = None
        self._letterbox: Letterbox | None = None
        self._model = _ready(loaded.model)
        self.precision, self.precision_reason = self._choose_precision(precision)
        self._dtype = _DTYPES[self.precision]
        self._model.to(self._dtype)
        logger.info(
            "model %s: %d classes, %s (%s)",
            path,
            len(self.class_names),
            self.precision,
            self.precision_reason,
        )

    def detect(self, image_bgr: NDArray[np.uint8]) -> Detections:
        """What is in one frame.

        Args:
            image_bgr: (height, width, 3) uint8, BGR.

        Returns:
            The boxes in the frame's pixels, clipped to it, the most confident first; at most 300.
        """
        if image_bgr.ndim != 3 or image_bgr.shape[2] != 3 or image_bgr.dtype != np.uint8:
            raise ValueError(
                f"a frame must be (height, width, 3) uint8, got {image_bgr.shape} {image_bgr.dtype}"
            )
        started = time.perf_counter()
        box = self._fit(image_bgr.shape[1], image_bgr.shape[0])
        pixels = to_tensor(box.apply(image_bgr), self._dtype)
        prepared = time.perf_counter()
        with torch.inference_mode():
            maps = self._model(pixels)
            inferred = time.perf_counter()
            boxes = select_boxes(
                self._model, maps, confidence=self.confidence, iou=self.iou, class_ids=self.class_ids
            )
        detections = Detections(box.to_frame(boxes.xyxy), boxes.confidence, boxes.class_id, self.class_names)
        done = time.perf_counter()
        self.last_timing = Timing(
            (prepared - started) * 1e3, (inferred - prepared) * 1e3, (done - inferred) * 1e3
        )
        return detections

    def _fit(self, width: int, height: int) -> Letterbox:
        box = self._letterbox
        if box is None or (box.frame_width, box.frame_height) != (width, height):
            box = self._letterbox = fit(width, height, self.image_size, square=self.square)
        return box

    def _choose_precision(self, asked: Precision) -> tuple[str, str]:
        native = _bfloat16_instructions()
        if asked == "bfloat16" and not native:
            logger.warning("this processor does not compute in bfloat16; it is emulated, and slow")
        if asked != "auto":
            return asked, "as asked"
        if not native:
            return "float32", "this processor does not compute in bfloat16"
        full, half = self._measure_ms(torch.float32), self._measure_ms(torch.bfloat16)
        chosen = "bfloat16" if half < full else "float32"
        return chosen, f"measured {full:.1f} ms in float32, {half:.1f} ms in bfloat16 ({native})"

    def _measure_ms(self, dtype: torch.dtype) -> float:
        """Median time of one inference at the full input size."""
        model = copy.deepcopy(self._model).to(dtype)
        pixels = torch.zeros(1, self.description.channels, self.image_size, self.image_size, dtype=dtype)
        pixels = pixels.contiguous(memory_format=torch.channels_last)
        times = []
        with torch.inference_mode():
            for _ in range(6):
                started = time.perf_counter()
                model(pixels)
                times.append((time.perf_counter() - started) * 1e3)
        return statistics.median(times[1:])


def resolve_classes(classes: Sequence[str | int], class_names: Sequence[str]) -> tuple[int, ...]:
    """Class names or ids (also ids as text) → sorted ids.

    Raises `ValueError` for an unknown one; the message names the nearest names.
    """
    if isinstance(classes, str) or not classes:
        raise ValueError(f"classes must be a list of names or ids, or None for all; got {classes!r}")
    ids: set[int] = set()
    for wanted in classes:
        named = [index for index, name in enumerate(class_names) if name == wanted]
        if not named and isinstance(wanted, str) and not wanted.isdecimal():
            near = difflib.get_close_matches(wanted.lower(), class_names, n=3, cutoff=0.0)
            raise ValueError(
                f"the model has no class {wanted!r}; nearest of its {len(class_names)}: {', '.join(near)}"
            )
        identity = int(wanted) if not named else named[0]
        if not 0 <= identity < len(class_names):
            raise ValueError(f"the model has classes 0..{len(class_names) - 1}, not {wanted}")
        ids.update(named or [identity])
    return tuple(sorted(ids))


def _ready(model: YoloModel) -> YoloModel:
    """Normalisation folded in, no gradients, weights laid out channels-last (the faster layout here)."""
    model.fuse().requires_grad_(False)
    for parameter in model.parameters():
        if parameter.dim() == 4:
            parameter.data = parameter.data.contiguous(memory_format=torch.channels_last)
    return model


def _model_path(model: str | Path) -> Path:
    if str(model) != DEFAULT_MODEL:
        return find_model(model)
    if not DEFAULT_WEIGHTS.is_file():
        raise CheckpointError(
            f"{DEFAULT_WEIGHTS}: the bundled model is missing from this installation; "
            "install the package again, make one with `companion train`, or give the path of another"
        )
    return DEFAULT_WEIGHTS


def _bfloat16_instructions() -> str:
    """The processor's own bfloat16 arithmetic, as Linux names it; empty where it has none."""
    try:
        lines = Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
    except OSError:
        return ""
    # x86 lists `flags`, ARM lists `Features`.
    flags = {flag for line in lines if line.startswith(("flags", "Features")) for flag in line.split()}
    return " ".join(sorted(flags & {"avx512_bf16", "amx_bf16", "bf16"}))
