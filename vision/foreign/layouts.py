"""Recognises a network exported by another program: from what its file states, and from its shapes.

Ultralytics writes names, stride, task and size into each export. Files of YOLOX, RT-DETR, D-FINE and RF-DETR
state nothing; they are recognised by the names and shapes of their outputs.
"""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from vision.foreign.class_names import NamesError, names_beside
from vision.letterbox import Placement
from vision.plain_yaml import numbered
from vision.runtimes.base import RuntimeUnusableError

Layout = Literal["cells", "rows", "selected", "objectness", "yolox", "queries", "logits", "scored"]
LAYOUTS: dict[Layout, str] = {
    "cells": "boxes and class probabilities of all cells, before NMS",
    "rows": "boxes and class probabilities of all cells, transposed, before NMS",
    "selected": "boxes selected inside the file: iou has no effect",
    "objectness": "boxes, objectness and class probabilities of all cells, before NMS",
    "yolox": "boxes in cells, objectness and class probabilities, before NMS",
    "queries": "boxes and class probabilities of queries, without NMS",
    "logits": "boxes and class logits of queries, without NMS",
    "scored": "labels, boxes and scores, without NMS",
}
_ONLY_BOXES = "only its boxes are used"
TASKS = {
    "detect": "",
    "segment": _ONLY_BOXES,
    "pose": _ONLY_BOXES,
    "obb": "boxes enclose rotated boxes",
}
"""Ultralytics' tasks that have boxes, each with a note."""
YOLOX_STRIDES = (8, 16, 32)
YOLOX_SUFFIX = ".pth"
# 1200 names of 40 characters; to parse one of 1 MiB takes seconds and 200 MB.
_LONGEST_TEXT = 1 << 16
# The parts of the names of Ultralytics' heads, `Segment26` or `v10Detect`, and the task of each.
_HEADS = {
    "RTDETR": "detect",
    "Detect": "detect",
    "Segment": "segment",
    "Pose": "pose",
    "OBB": "obb",
    "Classify": "classify",
}
_IMAGENET = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))


@dataclass(frozen=True, slots=True)
class Port:
    """An input or output: name, shape (None: any length), and type as numpy names it."""

    name: str
    shape: tuple[int | None, ...]
    dtype: str = "float32"

    def __str__(self) -> str:
        return f"{self.name} ({', '.join('?' if n is None else str(n) for n in self.shape)}) {self.dtype}"


@dataclass(frozen=True, slots=True)
class Pixels:
    """How a network takes its image: (1, 3, H, W), each value (pixel / divisor - mean) / deviation.

    Attributes:
        rgb: the order of the colours; False: BGR.
        placement: of the frame in the input.
    """

    rgb: bool = True
    divisor: float = 255.0
    mean: tuple[float, float, float] = (0.0, 0.0, 0.0)
    deviation: tuple[float, float, float] = (1.0, 1.0, 1.0)
    placement: Placement = "centre"


@dataclass(frozen=True, slots=True)
class ForeignFacts:
    """A recognised network.

    Attributes:
        class_names: id → name.
        written_by: the program, as far as known.
        task: `detect`, `segment`, `pose` or `obb`; of all of them only the boxes are used.
        layout: of the outputs.
        stride: the sides of the input are multiples of it.
        fixed_size: (height, width) of the only accepted input; None: any.
        pixels: the input.
        dtype: of the input, `float32` or `float16`.
        precision: the network computes in it.
        names_from: where the class names are from.
        takes_size: a second input takes (width, height), for `scored`.
        boxes_at: index of the boxes among two outputs, for `logits`.
        metadata: licence, version and date, as stated.
    """

    class_names: tuple[str, ...]
    written_by: str
    task: str
    layout: Layout
    stride: int
    fixed_size: tuple[int, int] | None
    pixels: Pixels = Pixels()
    dtype: str = "float32"
    precision: str = "float32"
    names_from: str = "its metadata"
    takes_size: bool = False
    boxes_at: int = 0
    metadata: dict[str, Any] = field(default_factory=dict)


def recognise(
    path: Path, stated: Mapping[str, Any], inputs: Sequence[Port], outputs: Sequence[Port]
) -> ForeignFacts:
    """Recognise the network in `path`.

    Args:
        stated: the file's metadata; values may be texts of Python literals.

    Raises:
        RuntimeUnusableError: not a known layout; one line with what was found.
    """
    try:
        image = _image_input(inputs)
        sides = image.shape[2], image.shape[3]
        fixed = None if sides[0] is None or sides[1] is None else (sides[0], sides[1])
        if "names" in stated and "stride" in stated:
            return _ultralytics(stated, image, fixed, outputs)
        return _by_shapes(path, image, fixed, inputs, outputs)
    except NamesError as error:
        raise RuntimeUnusableError(str(error)) from None
    except ValueError as error:
        raise RuntimeUnusableError(f"{path}: {error}") from None


def recognise_by_metadata(path: Path, stated: Mapping[str, Any]) -> ForeignFacts:
    """Recognise Ultralytics' TorchScript, whose file does not state the shapes of inputs and outputs.

    Raises:
        RuntimeUnusableError: as `recognise`.
    """
    arguments = stated.get("args")
    arguments = arguments if isinstance(arguments, dict) else {}
    sides = stated.get("imgsz")
    size: list[int | None] = [None, None]
    if not arguments.get("dynamic") and isinstance(sides, list) and len(sides) == 2:
        size = [side if type(side) is int and 0 < side < 1 << 14 else None for side in sides]
    names = stated.get("names")
    channels = 4 + (len(names) if isinstance(names, dict | list) else 0)
    more = _further_channels(task, stated, []) if (task := str(stated.get("task", "detect"))) in TASKS else 0
    if stated.get("end2end") or arguments.get("nms"):
        output: tuple[int | None, ...] = (1, None, None if more is None else 6 + more)
    elif "RTDETR" in str(stated.get("head", "")):
        output = (1, None, channels)
    else:
        output = (1, None if more is None else channels + more, None)
    batch = stated.get("batch")
    count = batch if type(batch) is int and not arguments.get("dynamic") else 1
    return recognise(path, stated, [Port("image", (count, 3, *size))], [Port("output", output)])


def _image_input(inputs: Sequence[Port]) -> Port:
    image = inputs[0] if inputs else None
    if (
        image is None
        or len(image.shape) != 4
        or image.shape[0] not in (1, None)
        or image.shape[1] not in (3, None)
        or image.dtype not in ("float32", "float16")
    ):
        raise ValueError(
            f"takes {_listed(inputs)}; expected one image, (1, 3, height, width) of float32 or float16"
        )
    return image


def _ultralytics(
    stated: Mapping[str, Any], image: Port, fixed: tuple[int, int] | None, outputs: Sequence[Port]
) -> ForeignFacts:
    task = str(stated.get("task", "detect"))
    if task not in TASKS:
        raise ValueError(f"is an export for {task!r:.40}; boxes come of {', '.join(TASKS)}")
    head = str(stated.get("head", ""))
    made_for = next((made for part, made in _HEADS.items() if part in head), task)
    if made_for != task:
        raise ValueError(f"states the task {task}, and the head {head:.40}, which is for {made_for}")
    names, stride = _class_names(stated["names"]), _literal(stated["stride"])
    if type(stride) is not int or not 1 <= stride <= 256:
        raise ValueError(f"states the stride {stride!r:.40}, expected a whole number of pixels")
    _compare_input(stated, stride, image)
    arguments = _literal(stated.get("args", {}))
    arguments = arguments if isinstance(arguments, dict) else {}
    ends = _literal(stated.get("end2end")), arguments.get("nms")
    selected = True if any(ends) else False if ends == (False, False) else None
    precision = "float32"
    if image.dtype == "float16" or arguments.get("half") is True or arguments.get("quantize") == 16:
        precision = "float16"
    # ONNX Runtime's quantiser keeps the exporter's metadata and adds a key.
    quantised = stated.get("onnx.infer") == "onnxruntime.quant"
    if quantised or arguments.get("int8") is True or arguments.get("quantize") == 8:
        precision = "int8"
    layout = _cell_layout(outputs, len(names), task, stated, selected, _is_cells(stride, fixed))
    known = {"licence": "license", "version": "version", "date": "date", "about": "description"}
    return ForeignFacts(
        names,
        f"Ultralytics {stated.get('version', '')!s:.40}".strip(),
        task,
        layout,
        stride,
        fixed,
        Pixels(placement="stretch") if layout == "queries" else Pixels(),
        image.dtype,
        precision,
        metadata={key: str(stated[name])[:200] for key, name in known.items() if name in stated},
    )


def _compare_input(stated: Mapping[str, Any], stride: int, image: Port) -> None:
    """What the metadata says about the input against its shape. Raises ValueError."""
    channels, size = _literal(stated.get("channels", 3)), _literal(stated.get("imgsz"))
    if type(channels) is int and channels != 3:
        raise ValueError(f"states {channels} channels and takes {image}; an image has 3")
    sides = [size, size] if type(size) is int else size if isinstance(size, list | tuple) else []
    if len(sides) == 2 and any(
        type(side) is int and found not in (side, None)
        for side, found in zip(sides, image.shape[2:], strict=True)
    ):
        raise ValueError(f"states images of {sides[0]}x{sides[1]} pixels (imgsz), and takes {image}")
    if any(found is not None and found % stride for found in image.shape[2:]):
        raise ValueError(f"states the stride {stride}, and takes {image}: no multiples of it")


def _is_cells(stride: int, fixed: tuple[int, int] | None) -> Callable[[int | None], bool | None]:
    """Whether a length is the number of all cells of some levels, the coarsest of `stride`; None: unknown."""

    def is_cells(length: int | None) -> bool | None:
        if fixed is None or length is None:
            return None
        counts = {(fixed[0] // stride) * (fixed[1] // stride)}
        finer = stride // 2
        while finer >= 2:
            counts |= {count + (fixed[0] // finer) * (fixed[1] // finer) for count in counts}
            finer //= 2
        return length in counts

    return is_cells


def _cell_layout(
    outputs: Sequence[Port],
    classes: int,
    task: str,
    stated: Mapping[str, Any],
    selected: bool | None,
    is_cells: Callable[[int | None], bool | None],
) -> Layout:
    """The layout of an output of Ultralytics, or of YOLOv5's and YOLOv9's repositories, which state no task.

    Args:
        selected: whether the file states that boxes are selected inside; None: it does not say.
    """
    shape = outputs[0].shape if outputs else ()
    gives = f"gives {_listed(outputs)}"
    if len(shape) != 3 or shape[0] not in (1, None):
        raise ValueError(f"{gives}, which is no known layout for {classes} classes")
    rows, columns = shape[1], shape[2]
    head, more = str(stated.get("head", "")), _further_channels(task, stated, outputs)
    found_for = f"for {classes} classes ({task})"

    def fits(length: int | None, least: int) -> bool:
        return length is not None and (length >= least if more is None else length == least + more)

    if "RTDETR" in head:
        if columns is None or fits(columns, 4 + classes):
            return "queries"
        raise ValueError(f"states the head {head:.40} {found_for}, and {gives}")
    if selected:
        if columns is None or fits(columns, 6):
            return "selected"
        raise ValueError(f"states selected boxes (end2end or nms) {found_for}, and {gives}")
    if rows is None and columns is None:
        return "cells"  # `decoding` checks the length.
    as_cells, as_rows = fits(rows, 4 + classes), fits(columns, 4 + classes)
    if as_cells and (more is not None or columns is None or columns >= (rows or 0)):
        return "cells"
    known_head = any(part in head for part in _HEADS)
    if as_rows and (is_cells(rows) or (known_head and selected is False and rows is None)):
        return "rows"
    if task == "detect" and "task" not in stated and columns == 5 + classes:
        return "objectness"
    if columns == 6 and task == "detect":
        if as_rows and not known_head:
            raise ValueError(
                f"{gives}, selected boxes or queries of {classes} classes: its head is "
                "not stated; export it with a later release"
            )
        if selected is False and "v10" not in head:
            raise ValueError(f"states that no boxes are selected (end2end, nms: False), and {gives}")
        if "task" in stated:
            return "selected"
    # RT-DETR of releases that state no head; its number of queries is fixed.
    if as_rows and task == "detect" and "task" in stated and not known_head and rows is not None:
        return "queries"
    stated_head = f" of the head {head:.40}" if head else ""
    raise ValueError(f"{gives}, which is no known layout {found_for}{stated_head}")


def _further_channels(task: str, stated: Mapping[str, Any], outputs: Sequence[Port]) -> int | None:
    """The channels after boxes and classes; None: not known from the file."""
    if task == "segment":  # the coefficients of the masks, as many as prototypes
        return outputs[1].shape[1] if len(outputs) == 2 and len(outputs[1].shape) == 4 else None
    if task == "pose":
        shape = _literal(stated.get("kpt_shape"))
        if isinstance(shape, list | tuple) and len(shape) == 2 and all(type(n) is int for n in shape):
            return int(shape[0] * shape[1])
        return None
    return {"detect": 0, "obb": 1}[task]


def _by_shapes(
    path: Path,
    image: Port,
    fixed: tuple[int, int] | None,
    inputs: Sequence[Port],
    outputs: Sequence[Port],
) -> ForeignFacts:
    by_name = {port.name: port for port in outputs}
    shapes = [port.shape for port in outputs]
    if by_name.keys() == {"labels", "boxes", "scores"} and [port.name for port in inputs[1:]] == [
        "orig_target_sizes"
    ]:
        # The number of classes is not in the file.
        names, origin = names_beside(path, None)
        return ForeignFacts(
            names,
            "RT-DETR or D-FINE",
            "detect",
            "scored",
            32,
            fixed,
            Pixels(placement="stretch"),
            image.dtype,
            image.dtype,
            origin,
            takes_size=True,
        )
    normalised = by_name.keys() == {"dets", "labels"}
    if (
        # By the names alone: YOLO-NAS has outputs of the same shapes, in other units.
        (normalised or by_name.keys() == {"pred_boxes", "logits"})
        and all(len(shape) == 3 for shape in shapes)
        and len(inputs) == 1
    ):
        at = int(outputs[0].name not in ("dets", "pred_boxes"))
        boxes, logits = outputs[at], outputs[1 - at]
        if boxes.shape[2] == 4 and logits.shape[2] is not None and boxes.shape[1] == logits.shape[1]:
            names, origin = names_beside(path, logits.shape[2])
            mean, deviation = _IMAGENET if normalised else ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
            return ForeignFacts(
                names,
                "RF-DETR" if normalised else "a DETR",
                "detect",
                "logits",
                32,
                fixed,
                Pixels(mean=mean, deviation=deviation, placement="stretch"),
                image.dtype,
                image.dtype,
                origin,
                boxes_at=at,
            )
    if len(shapes) == 1 and len(shapes[0]) == 3 and len(inputs) == 1 and fixed is not None:
        cells = sum((fixed[0] // stride) * (fixed[1] // stride) for stride in YOLOX_STRIDES)
        channels = shapes[0][2]
        if shapes[0][1] == cells and channels is not None and channels > 5:
            names, origin = names_beside(path, channels - 5)
            return ForeignFacts(
                names,
                "YOLOX",
                "detect",
                "yolox",
                32,
                fixed,
                Pixels(rgb=False, divisor=1.0, placement="corner"),
                image.dtype,
                image.dtype,
                origin,
            )
    raise ValueError(
        f"has no metadata of a known exporter, and gives {_listed(outputs)}, which is no known layout; "
        "export it from the checkpoint with `companion models export`"
    )


def _listed(ports: Sequence[Port]) -> str:
    return ", ".join(map(str, ports[:4])) + (", …" if len(ports) > 4 else "") or "nothing"


def _literal(value: Any) -> Any:
    """The value of a text that is a Python literal; any other text or value as it is."""
    if not isinstance(value, str):
        return value
    if len(value) > _LONGEST_TEXT:
        raise ValueError(
            f"has a text of {len(value)} characters in its metadata, the limit is {_LONGEST_TEXT}"
        )
    try:
        return ast.literal_eval(value)
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError):
        return value


def _class_names(stated: Any) -> tuple[str, ...]:
    names = _literal(stated)
    if isinstance(names, dict):
        names = numbered(names)
    if (
        not isinstance(names, list)
        or not names
        or not all(isinstance(name, str) and name and name.isprintable() for name in names)
    ):
        raise ValueError("its class names are not a table of printable texts numbered from 0")
    return tuple(names)
