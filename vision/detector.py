"""Opens a detector by its kind; YOLO: letterbox → runtime → class filter → suppression → boxes in pixels.

Torch is loaded only where it is needed: an ONNX or OpenVINO file saves its import time and memory.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from vision.detections import Detections
from vision.foreign.engines import ForeignRuntime
from vision.foreign.layouts import TASKS, ForeignFacts
from vision.letterbox import Letterbox, fit
from vision.model_files import find_model
from vision.object_detector import (
    DETECTORS,
    YOLO,
    DetectionsError,
    DetectorSettings,
    ObjectDetector,
    Timing,
    detector,
    resolve_classes,
)
from vision.registry import shown
from vision.runtimes.base import PRECISIONS, Device, Precision, installed
from vision.runtimes.selection import RuntimeChoice, check_runtime, check_runtime_name, start_runtime
from vision.runtimes.source import ModelSource, check_model_file, read_source
from vision.runtimes.stored_choice import forget_choices
from vision.weights import DEFAULT_EXPORT, DEFAULT_WEIGHTS
from vision.yolo.checkpoint_error import CheckpointError
from vision.yolo.checkpoint_pair import weights_sha256
from vision.yolo.postprocess import Boxes, boxes_from, candidates_of, decode_ltrb

if TYPE_CHECKING:
    from vision.yolo.description import ModelDescription

logger = logging.getLogger(__name__)

DEFAULT_MODEL = "default"
USUAL_IOU = 0.7
"""NMS IoU threshold of a model whose metadata gives none; the reference predicts with it."""
RENDERED_SCENES = "scenes drawn by "
"""`trained_on` in the metadata of a model trained on rendered scenes only begins with this."""
# From this confidence on, decoding the few remaining cells one by one is faster than decoding all cells.
_SPARSE_FROM = 0.05


class Detector(ObjectDetector):
    """A YOLO network with its thresholds. Not thread-safe.

    Attributes:
        class_names: id → name, the model's class table.
        class_ids: ids to report, sorted; None for all.
        runtime: `torch`, `onnxruntime`, `openvino` or `tensorrt`.
        runtime_reason: why this runtime, in words.
        precision: of the network, `float32`, `bfloat16` or `float16`.
        precision_reason: why this precision, in words.
        model_name: the value of `model`.
        model_sha256: of the checkpoint, of a pair's weights, or of the exported file.
        description: what the network was built from; None for an exported file.
        foreign: the recognised network of another exporter's file; else None.
        metadata: of the file (licence, origin, score).
        rendered_only: `trained_on` in the metadata begins with RENDERED_SCENES.
        last_timing: of the latest `detect`; None before the first.

    >>> import numpy as np
    >>> from vision import Detector
    >>> detector = Detector(classes=["car"], image_size=160, precision="float32")
    >>> len(detector.detect(np.zeros((120, 160, 3), np.uint8)))
    0
    """

    def __init__(
        self,
        model: str | Path = DEFAULT_MODEL,
        *,
        classes: Sequence[str | int] | None = None,
        confidence: float = 0.25,
        iou: float | None = None,
        image_size: int = 640,
        precision: Precision = "auto",
        threads: int | None = None,
        square: bool = False,
        runtime: RuntimeChoice | None = None,
        device: Device = "cpu",
    ) -> None:
        """Load the model.

        Args:
            model: `default`, the bundled one, of the file that `model_path` says, or the path of a checkpoint
                (our own, or an Ultralytics `.pt`), of a file exported by `vision.exports.export`, or of
                another exporter's that is recognised (`vision.foreign.layouts`).
            classes: names or ids to report; None for all. The network does not compute the others.
            confidence: boxes not above this are dropped, 0..1.
            iou: NMS IoU threshold, 0..1: of two boxes of one class overlapping more, the less confident is
                dropped. None: `nms_iou` of the model's metadata, else 0.7.
            image_size: longer side of the network's input, pixels, a multiple of its largest stride (32). A
                file of a fixed size keeps its own.
            precision: `auto` selects bfloat16 only where the processor supports it (a fifth less time).
            threads: processor threads of the runtime (torch: of the whole process); None: its default.
            square: pad the input to a square rather than to the next multiple of the stride.
            device: `cpu`, or `cuda` for a checkpoint on torch.
            runtime: by name, or `auto` for the fastest installed one (measured once, cached). None: torch for
                a checkpoint and TorchScript, onnxruntime for `.onnx`, openvino for `.xml` or its folder,
                tensorrt for `.engine`.

        Raises:
            CheckpointError: the model cannot be read.
            RuntimeMissingError: the runtime is not installed; the message names its extra.
            RuntimeUnusableError: the runtime cannot run this model, or not in this precision.
            ValueError: an unknown class (the message names the nearest), or a number out of range.
        """
        for name, value in (("confidence", confidence), ("iou", iou)):
            if value is not None and not 0.0 <= value <= 1.0:
                raise ValueError(f"{name} must be in 0..1, got {value}")
        if precision not in PRECISIONS:
            raise ValueError(f"precision must be {', '.join(PRECISIONS)}; got {precision!r}")
        if threads is not None and threads < 1:
            raise ValueError(f"threads must be at least 1, got {threads}")
        check_runtime_name(runtime)  # before torch is imported to read a checkpoint
        fit(image_size, image_size, image_size)  # Rejects a bad size now, not at the first frame.
        source = read_source(model_path(model, runtime, precision, device))
        self._stride = max(source.strides)
        if source.foreign is None or source.foreign.fixed_size is None:
            fit(image_size, image_size, image_size, stride=self._stride)
        self.class_names: tuple[str, ...] = source.class_names
        self.class_ids = None if classes is None else resolve_classes(classes, source.class_names)
        self.description: ModelDescription | None = source.description
        self.metadata: dict[str, Any] = source.metadata
        self.rendered_only = str(self.metadata.get("trained_on")).startswith(RENDERED_SCENES)
        self.model_name, self.model_sha256 = str(model), weights_sha256(source.weights_path)
        self.confidence = confidence
        self.iou = _own_iou(source) if iou is None else iou
        self.image_size = image_size
        self.square = square
        self._letterbox: Letterbox | None = None
        self._boxed: NDArray[np.uint8] | None = None
        started = start_runtime(
            source,
            runtime,
            class_ids=self.class_ids,
            precision=precision,
            threads=threads,
            image_size=image_size,
            sparse_boxes=confidence >= _SPARSE_FROM,
            device=device,
        )
        self._runtime = started.runtime
        # At a lower one thousands of cells would be decoded one by one.
        self.min_confidence = _SPARSE_FROM if confidence >= _SPARSE_FROM else 0.0
        self.foreign: ForeignFacts | None = None
        if not isinstance(started.runtime, ForeignRuntime):
            self.reportable_ids = started.runtime.head.class_ids
        else:
            self.foreign = started.runtime.facts
            box = started.runtime.fit(image_size, image_size, image_size, square=square)
            self.image_size = max(box.width, box.height)
        self.runtime: str = self._runtime.name
        self.runtime_reason = started.reason
        self.precision: str = self._runtime.precision
        self.precision_reason = self._runtime.precision_reason
        self.reason = f"{self.runtime_reason}; {self.precision}: {self.precision_reason}"
        task, _, note = str(self.metadata.get("task", "detect")).partition("; ")
        if self.foreign:
            task, note = self.foreign.task, TASKS[self.foreign.task]
        if task != "detect":
            logger.warning("%s is a network for %s; %s", source.path, task, note)
        logger.info(
            "model %s: %d classes, on %s (%s), in %s (%s)",
            source.path,
            len(self.class_names),
            self.runtime,
            self.runtime_reason,
            self.precision,
            self.precision_reason,
        )

    @property
    def threads(self) -> int:
        """Processor threads of the runtime; 0 if unknown before the first frame."""
        return self._runtime.threads

    def prepare(self, width: int, height: int) -> None:
        """Prepare for frames of one size, so that the first frame is not slower than the rest."""
        box = self._fit(width, height)
        self._runtime.prepare(box.height, box.width)

    def detect(self, image_bgr: NDArray[np.uint8], /) -> Detections:
        """Detect objects in one frame.

        Args:
            image_bgr: (height, width, 3) uint8, BGR.

        Returns:
            Boxes in the frame's pixels, clipped to it, most confident first; at most 300.
        """
        if image_bgr.ndim != 3 or image_bgr.shape[2] != 3 or image_bgr.dtype != np.uint8:
            raise ValueError(
                f"a frame must be (height, width, 3) uint8, got {image_bgr.shape} {image_bgr.dtype}"
            )
        started = time.perf_counter()
        box = self._fit(image_bgr.shape[1], image_bgr.shape[0])
        boxed = box.apply(image_bgr, self._boxed)
        if not (boxed.flags.c_contiguous and boxed.flags.writeable):
            # Runtimes read the memory directly in this order, and some require it to be writable.
            boxed = boxed.copy(order="C")
        prepared = time.perf_counter()
        boxes, network_s = self._boxes(boxed)
        detections = Detections(box.to_frame(boxes.xyxy), boxes.confidence, boxes.class_id, self.class_names)
        done = time.perf_counter()
        self.last_timing = Timing(
            preprocess_ms=(prepared - started) * 1e3,
            inference_ms=network_s * 1e3,
            postprocess_ms=(done - prepared - network_s) * 1e3,
        )
        return detections

    def _boxes(self, boxed: NDArray[np.uint8]) -> tuple[Boxes, float]:
        """The boxes in an input, in its pixels, and the network's share of the time, seconds."""
        started = time.perf_counter()
        if isinstance(self._runtime, ForeignRuntime):
            raw = self._runtime.infer(boxed)
            computed = time.perf_counter()
            size = (boxed.shape[0], boxed.shape[1])
            boxes = self._runtime.decode(raw, size, self.confidence, self.iou, self.class_ids)
            return boxes, computed - started
        head, outputs = self._runtime.head, self._runtime.infer(boxed)
        computed = time.perf_counter()
        candidates = candidates_of(head, outputs, self.confidence, self.class_ids)
        selected = time.perf_counter()
        # The box branch, computed only for the candidate cells.
        sides = decode_ltrb(head, outputs, candidates, self._runtime.product)
        inferred = time.perf_counter()
        boxes = boxes_from(head, outputs, candidates, sides, self.iou)
        return boxes, (computed - started) + (inferred - selected)

    def _fit(self, width: int, height: int) -> Letterbox:
        box = self._letterbox
        if box is None or (box.frame_width, box.frame_height) != (width, height):
            if isinstance(self._runtime, ForeignRuntime):
                box = self._runtime.fit(width, height, self.image_size, square=self.square)
            else:
                box = fit(width, height, self.image_size, square=self.square, stride=self._stride)
            self._letterbox, self._boxed = box, box.blank()
        return box


def _own_iou(source: ModelSource) -> float:
    """The NMS threshold that a model's metadata gives, else USUAL_IOU. Raises CheckpointError."""
    iou = source.metadata.get("nms_iou", USUAL_IOU)
    if isinstance(iou, bool) or not isinstance(iou, int | float) or not 0.0 <= iou <= 1.0:
        raise CheckpointError(f"{source.path}: nms_iou must be a number in 0..1, got {iou!r:.40}")
    return float(iou)


@detector(YOLO, "a YOLO network, by detector.model")
def _open_yolo(settings: DetectorSettings) -> ObjectDetector:
    return Detector(
        settings.model,
        classes=settings.classes,
        confidence=settings.confidence,
        iou=settings.iou,
        image_size=settings.image_size,
        precision=settings.precision,
        threads=settings.threads,
        runtime=settings.runtime,
        device=settings.device,
    )


def open_detector(kind: str, settings: DetectorSettings) -> ObjectDetector:
    """Create a detector.

    Raises:
        ValueError: no such kind (the message lists the known ones), an unknown class, or an error of the kind
            itself: `CheckpointError`, `RuntimeMissingError` and `RuntimeUnusableError` are ValueErrors. Or
            a plug-in's kind gives no `ObjectDetector` with `class_names`.
    """
    if (opener := DETECTORS.get(kind)) is None:
        raise _unknown_kind(kind)
    opened = opener(settings)
    if kind == YOLO:
        return opened
    if not isinstance(opened, ObjectDetector):
        raise ValueError(f"detector.kind {kind!r}: expected an ObjectDetector, got {shown(opened)}")
    names = getattr(opened, "class_names", None)
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        raise ValueError(f"detector.kind {kind!r}: class_names must be a tuple of str, got {shown(names)}")
    return _FilteredDetector(opened, kind, settings)


def check_detector(kind: str, settings: DetectorSettings) -> None:
    """Check what is known of a detector before it is loaded: its kind, and of `yolo` its file and runtime.

    Raises:
        ValueError: no such kind. CheckpointError, RuntimeMissingError, RuntimeUnusableError: ValueErrors too.
    """
    if DETECTORS.get(kind) is None:
        raise _unknown_kind(kind)
    if kind == YOLO:
        check_runtime_name(settings.runtime)
        path = model_path(settings.model, settings.runtime, settings.precision, settings.device)
        check_model_file(path, settings.runtime)


def _unknown_kind(kind: str) -> ValueError:
    return ValueError(
        f"detector.kind: unknown kind {kind!r}; known: {DETECTORS.known()}. Kinds of a plug-in "
        "are known once its module is loaded (plugins.modules, --plugins-modules)"
    )


class _FilteredDetector(ObjectDetector):
    """Applies `classes` and `confidence` to a plug-in's detector."""

    def __init__(self, inner: ObjectDetector, kind: str, settings: DetectorSettings) -> None:
        self.class_names = tuple(inner.class_names)
        self.model_name, self.model_sha256 = inner.model_name or kind, inner.model_sha256
        self.runtime, self.precision, self.reason = inner.runtime, inner.precision, inner.reason
        self._inner, self._kind = inner, kind
        wanted = settings.classes
        self.class_ids = None if wanted is None else resolve_classes(wanted, self.class_names)
        # It may have used them itself.
        self.confidence = self.min_confidence = settings.confidence
        self.reportable_ids = self.class_ids

    def detect(self, image_bgr: NDArray[np.uint8], /) -> Detections:
        started = time.perf_counter()
        found = self._inner.detect(image_bgr)
        elapsed_ms = (time.perf_counter() - started) * 1e3
        self.last_timing = self._inner.last_timing or Timing(0.0, elapsed_ms, 0.0)
        if not isinstance(found, Detections):
            raise DetectionsError(
                f"detector.kind {self._kind!r}: detect must return Detections, got {shown(found)}"
            )
        if tuple(found.class_names) != self.class_names:
            raise DetectionsError(
                f"detector.kind {self._kind!r}: detections must have its class names {self.class_names}, "
                f"got {found.class_names}"
            )
        kept = found.confidence >= self.confidence
        if self.class_ids is not None:
            kept &= np.isin(found.class_id, self.class_ids)
        return found[kept]


def class_names_of(
    model: str | Path = DEFAULT_MODEL, runtime: RuntimeChoice | None = None
) -> tuple[str, ...]:
    """Class names of a model, id → name, without loading it into a runtime.

    Raises:
        CheckpointError: the model cannot be read.
        RuntimeMissingError, RuntimeUnusableError: the runtime is not installed, or cannot run such a file.
    """
    source = read_source(model_path(model, runtime))
    check_runtime(source, runtime)
    return source.class_names


def forget_measurements(model: str | Path) -> None:
    """Let the next start of a model measure runtime and precision again on this board.

    Raises:
        CheckpointError: there is no such model.
        OSError: a stored measurement cannot be deleted.
    """
    bundled = str(model) == DEFAULT_MODEL
    for path in (
        (DEFAULT_EXPORT, DEFAULT_WEIGHTS) if bundled else (read_source(find_model(model)).weights_path,)
    ):
        forget_choices(weights_sha256(path))


def model_path(
    model: str | Path,
    runtime: RuntimeChoice | None = None,
    precision: Precision = "auto",
    device: Device = "cpu",
) -> Path:
    """The file of a model. The bundled one has two: its export, and its checkpoint where that is needed.

    The checkpoint is for what the export cannot do, and needs torch: the runtimes torch and tensorrt, another
    device, and half precision of no named runtime. `auto` measures all runtimes where torch is installed.
    Arguments as of `Detector`.

    Raises:
        CheckpointError: a file of the bundled model is missing.
    """
    if str(model) != DEFAULT_MODEL:
        return find_model(model)
    needs_checkpoint = (
        runtime in ("torch", "tensorrt")
        or device != "cpu"
        or (runtime is None and precision in ("bfloat16", "float16"))
        or (runtime == "auto" and installed("torch"))
    )
    path = DEFAULT_WEIGHTS if needs_checkpoint else DEFAULT_EXPORT
    if not path.is_file():
        raise CheckpointError(
            f"{path}: the bundled model is missing from this installation; "
            "reinstall the package, train one with `companion learn train`, or give the path of another"
        )
    return path
