"""The detector interface, and the registry of kinds: a decorator adds one, built in or from a plug-in."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from vision.class_names import class_named, joined_names
from vision.detections import Detections
from vision.registry import Registry

if TYPE_CHECKING:
    from vision.runtimes.base import Device, Precision
    from vision.runtimes.selection import RuntimeChoice

YOLO = "yolo"
"""The built-in kind, of `vision.detector`."""


@dataclass(frozen=True, slots=True)
class DetectorSettings:
    """Settings of a detector. A kind ignores what does not apply to it.

    Attributes:
        model: for `yolo` as in `vision.detector.Detector`; a plug-in may give it any meaning.
        classes: names or ids to report; None for all.
        confidence: boxes below this are dropped, 0..1.
        iou: NMS IoU threshold, 0..1; None: the model's own.
        image_size: longer side of a network's input, pixels.
        precision: of the network, or `auto`.
        threads: processor threads; None: the detector's default.
        runtime: of the network, or `auto`; None: the default for the file of `model`.
        device: of torch, `cpu` or `cuda`.

    >>> from vision import DetectorSettings
    >>> DetectorSettings(classes=("car",)).image_size
    640
    """

    model: str = "default"
    classes: tuple[str | int, ...] | None = None
    confidence: float = 0.25
    iou: float | None = None
    image_size: int = 640
    precision: Precision = "auto"
    threads: int | None = None
    runtime: RuntimeChoice | None = None
    device: Device = "cpu"


@dataclass(frozen=True, slots=True)
class Timing:
    """Durations of the stages of one detection, milliseconds."""

    preprocess_ms: float
    inference_ms: float
    postprocess_ms: float

    @property
    def total_ms(self) -> float:
        return self.preprocess_ms + self.inference_ms + self.postprocess_ms


class ObjectDetector(ABC):
    """Detects objects in single frames. Create and use it in one thread.

    A detector needs `class_names` and `detect`; the other attributes are for status and log.

    Attributes:
        class_names: id → name, all that it can report; constant after construction.
        last_timing: of the latest `detect`; None if not measured: all its time then counts as inference.
        model_name: for messages; empty: the name of its kind.
        model_sha256: of its model's file, 64 hexadecimal digits; None without one.
        runtime: of its network; None where there is no choice.
        precision: `float32` for example; None where it does not apply.
        reason: why this runtime and precision, in words.
        rendered_only: its network was trained on rendered scenes only, as far as its file says.
        confidence, class_ids: what the detector of `vision.detector.open_detector` reports: boxes from this
            confidence on, of these classes, sorted; None: of all. May be set between two frames, within
            `min_confidence` and `reportable_ids` (None: all), for which it was loaded.

    >>> import numpy as np
    >>> from vision import Detections, ObjectDetector
    >>> class Nothing(ObjectDetector):
    ...     class_names = ("car",)
    ...
    ...     def detect(self, image_bgr: np.ndarray, /) -> Detections:
    ...         return Detections.empty(self.class_names)
    >>> Nothing().detect(np.zeros((120, 160, 3), np.uint8)).names
    []
    """

    class_names: tuple[str, ...]
    last_timing: Timing | None = None
    model_name: str = ""
    model_sha256: str | None = None
    runtime: str | None = None
    precision: str | None = None
    reason: str = ""
    rendered_only: bool = False
    confidence: float = 0.0
    class_ids: tuple[int, ...] | None = None
    min_confidence: float = 0.0
    reportable_ids: tuple[int, ...] | None = None

    @abstractmethod
    def detect(self, image_bgr: NDArray[np.uint8], /) -> Detections:
        """Detect objects in one frame.

        Args:
            image_bgr: (height, width, 3) uint8, BGR. Its size may change from frame to frame. It is the
                frame's own memory: do not write to it or keep it.

        Returns:
            Boxes in the frame's pixels (left, top, right, bottom; origin at the upper left corner), with this
            detector's `class_names`; `Detections.empty(self.class_names)` for none.
        """


class DetectionsError(TypeError):
    """`detect` of a plug-in returned something invalid. The message is one line that names its kind."""


OpenDetector = Callable[[DetectorSettings], ObjectDetector]
"""Creates a detector. Raises ValueError, in one line, if it cannot."""

DETECTORS: Registry[OpenDetector] = Registry(
    "kind of detector", r"[a-z][a-z0-9-]*", "lower-case letters, digits and `-`"
)
"""Kind → factory."""

_Opener = TypeVar("_Opener", bound=OpenDetector)


def detector(kind: str, help_text: str) -> Callable[[_Opener], _Opener]:
    """Decorator: register a class or function for `detector.kind = "…"`.

    It is called with the `DetectorSettings` and returns an `ObjectDetector`. Detections of a plug-in outside
    of `classes` or below `confidence` are dropped by the caller.

        @detector("bright", "everything that is white")
        class Bright(ObjectDetector):
            class_names = ("bright",)

            def __init__(self, settings: DetectorSettings) -> None: ...
            def detect(self, image_bgr: NDArray[np.uint8], /) -> Detections: ...

    Args:
        kind: lower-case letters, digits and hyphens.
        help_text: what it detects and how, one line without a full stop.

    Raises:
        ValueError: the kind does not match the pattern, or is already registered.
    """

    def register(opener: _Opener) -> _Opener:
        DETECTORS.add(kind, help_text, opener)
        return opener

    return register


def resolve_classes(classes: Sequence[str | int], class_names: Sequence[str]) -> tuple[int, ...]:
    """Class names or ids (also ids as text) → sorted ids; names as `class_named` reads them.

    Raises `ValueError` for an unknown or ambiguous one; the message names the closest matches.
    """
    if isinstance(classes, str) or not classes:
        raise ValueError(f"classes must be a list of names or ids, or None for all; got {classes!r}")
    ids: set[int] = set()
    for number in (wanted for wanted in classes if not isinstance(wanted, str)):
        if not 0 <= number < len(class_names):
            raise ValueError(f"the model has classes 0..{len(class_names) - 1}, not {number}")
        ids.add(number)
    for wanted in joined_names([wanted for wanted in classes if isinstance(wanted, str)], class_names):
        try:
            name = class_named(wanted, class_names)
        except ValueError as error:
            if not wanted.isdecimal():
                raise ValueError(f"{error} (the model has {len(class_names)} classes)") from None
            if not int(wanted) < len(class_names):
                raise ValueError(f"the model has classes 0..{len(class_names) - 1}, not {wanted}") from None
            ids.add(int(wanted))
        else:
            ids.update(index for index, each in enumerate(class_names) if each == name)
    return tuple(sorted(ids))
