"""The layout of an export's outputs: what the file states and the shapes of its tensors must agree."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.vision.foreign_files import constant_onnx, stated
from vision.detector import Detector
from vision.foreign.layouts import Port, recognise, recognise_by_metadata
from vision.runtimes.base import RuntimeUnusableError

SIZE = (96, 96)
CELLS = 144 + 36 + 9
"""Of an input of 96x96 pixels at the strides 8, 16 and 32."""
CENTRES = ((20.0, 20.0), (60.0, 40.0), (40.0, 75.0))
BOXES = [[x - 12, y - 12, x + 12, y + 12] for x, y in CENTRES]
Shape = tuple[int | None, ...]


def names(count: int) -> tuple[str, ...]:
    return tuple(f"c{number}" for number in range(count))


def three_objects(classes: int, cells: int = CELLS, further: int = 0) -> NDArray[np.float32]:
    """(1, 4 + classes + further, cells): objects of 24 pixels, of the classes 0 to 2, each in 3 cells."""
    found = np.zeros((1, 4 + classes + further, cells), np.float32)
    for number, (x, y) in enumerate(CENTRES):
        for cell in range(3):
            at = (10 + 7 * (3 * number + cell)) % cells
            found[0, :4, at] = x + 0.5 * cell, y, 24, 24
            found[0, 4 + number, at] = 0.9 - 0.1 * cell
            found[0, 4 + classes :, at] = 0.25
    return found


def detect(path: Path) -> Any:
    pytest.importorskip("onnx", reason="onnx is an optional extra")
    pytest.importorskip("onnxruntime", reason="onnxruntime is an optional extra")
    return Detector(path, runtime="onnxruntime").detect(np.full((*SIZE, 3), 90, np.uint8))


@pytest.mark.parametrize("transposed", [False, True])
@pytest.mark.parametrize(
    ("classes", "further", "others"),
    [
        (5, 0, {}),
        (5, 0, {"head": "Detect"}),
        (2 + 1, 0, {"head": "Detect", "args": {"nms": False}}),
        (80, 0, {"head": "Detect"}),
        (200, 0, {"head": "Detect"}),  # more channels than cells
        (5, 51, {"task": "pose", "head": "Pose", "kpt_shape": [17, 3]}),
        (5, 1, {"task": "obb", "head": "OBB26"}),
    ],
)
def test_cells_in_rows_are_the_same_boxes(
    tmp_path: Path, classes: int, further: int, others: dict[str, Any], transposed: bool
) -> None:
    pytest.importorskip("onnx", reason="onnx is an optional extra")
    cells = three_objects(classes, further=further)
    if transposed:
        cells = np.ascontiguousarray(cells.transpose(0, 2, 1))
    metadata = stated(names(classes), SIZE, **others)
    found = detect(constant_onnx(tmp_path / "a.onnx", {"o": cells}, size=SIZE, metadata=metadata))
    expected = np.array(BOXES)
    if others.get("task") == "obb":
        expected = expected + np.array([-1, -1, 1, 1]) * 12 * (np.cos(0.25) + np.sin(0.25) - 1)
    np.testing.assert_allclose(sorted(found.xyxy.tolist()), sorted(expected.tolist()), rtol=1e-5)
    assert sorted(found.class_id.tolist()) == [0, 1, 2]


def recognised(shape: Shape | Sequence[Shape], classes: int, others: dict[str, Any], size: Any = SIZE) -> str:
    shapes = [shape] if not shape or not isinstance(shape[0], tuple) else shape
    metadata = {
        "names": dict(enumerate(names(classes))),
        "stride": 32,
        "task": "detect",
        **others,
    }
    outputs = [Port(f"output{index}", tuple(each)) for index, each in enumerate(shapes)]  # type: ignore[arg-type]
    return recognise(Path("a.onnx"), metadata, [Port("images", (1, 3, *size))], outputs).layout


FREE = (None, None)
DETECT = {"head": "Detect", "end2end": False, "args": {"nms": False}}
RTDETR = {"head": "RTDETRDecoder", "end2end": False, "args": {"nms": False}}


@pytest.mark.parametrize(
    ("shape", "classes", "others", "size", "layout"),
    [
        ((1, 9, 189), 5, DETECT, SIZE, "cells"),
        ((1, 9, 1000), 5, DETECT, SIZE, "cells"),
        ((1, 84, 21), 80, DETECT, (32, 32), "cells"),
        ((1, 189, 9), 5, DETECT, SIZE, "rows"),
        ((1, 189, 9), 5, {}, SIZE, "rows"),
        ((1, 189, 6), 2, DETECT, SIZE, "rows"),
        ((1, 45, 9), 5, DETECT, SIZE, "rows"),  # the strides 16 and 32
        ((1, None, 9), 5, DETECT, FREE, "rows"),
        ((None, 9, None), 5, DETECT, FREE, "cells"),
        ((1, 300, 9), 5, RTDETR, SIZE, "queries"),
        ((1, 300, None), 5, RTDETR, FREE, "queries"),
        ((1, None, 6), 2, RTDETR, FREE, "queries"),
        ((1, 300, 9), 5, {}, SIZE, "queries"),
        ((1, 300, 6), 2, {"head": "Detect", "end2end": True}, SIZE, "selected"),
        ((1, 300, 6), 2, {"head": "Detect", "args": "{'nms': True}"}, SIZE, "selected"),
        ((1, 300, 6), 5, {}, SIZE, "selected"),
        ((1, 300, 6), 5, {"head": "v10Detect", "end2end": False}, SIZE, "selected"),
        ((1, 300, 7), 2, {"task": "obb", "head": "OBB", "end2end": True}, SIZE, "selected"),
        ([(1, 41, 189), (1, 32, 24, 24)], 5, {"task": "segment", "head": "Segment"}, SIZE, "cells"),
        ([(1, 189, 41), (1, 32, 24, 24)], 5, {"task": "segment", "head": "Segment"}, SIZE, "rows"),
        ((1, 60, 189), 5, {"task": "pose", "kpt_shape": "[17, 3]"}, SIZE, "cells"),
        ((1, 60, 189), 5, {"task": "pose"}, SIZE, "cells"),
    ],
)
def test_layout_is_what_metadata_and_shapes_agree_on(
    shape: Any, classes: int, others: dict[str, Any], size: Any, layout: str
) -> None:
    assert recognised(shape, classes, others, size) == layout


@pytest.mark.parametrize(
    ("shape", "classes", "others", "size", "named"),
    [
        # Head, or what it implies, and the output.
        ((1, 300, 9), 5, DETECT, SIZE, ("Detect", "(1, 300, 9)")),
        ((1, None, 9), 5, {}, FREE, ("(1, ?, 9)", "5 classes")),
        ((1, 300, 9), 6, RTDETR, SIZE, ("RTDETRDecoder", "(1, 300, 9)", "6 classes")),
        ((1, 9, 189), 5, RTDETR, SIZE, ("RTDETRDecoder", "(1, 9, 189)")),
        ((1, 9, 189), 5, {"head": "Detect", "end2end": True}, SIZE, ("end2end", "(1, 9, 189)")),
        ((1, 9, 189), 5, {"args": {"nms": True}}, SIZE, ("nms", "(1, 9, 189)")),
        ((1, 300, 6), 5, DETECT, SIZE, ("end2end", "False", "(1, 300, 6)")),
        # The number of names and of channels.
        ((1, 9, 189), 80, DETECT, SIZE, ("80 classes", "(1, 9, 189)")),
        ((1, 189, 9), 4, DETECT, SIZE, ("4 classes", "(1, 189, 9)")),
        ((1, 189, 9), 4, {}, SIZE, ("4 classes", "(1, 189, 9)")),
        ((1, 60, 189), 5, {"task": "pose", "kpt_shape": [5, 3]}, SIZE, ("pose", "(1, 60, 189)")),
        ((1, 9, 189), 5, {"task": "obb"}, SIZE, ("obb", "(1, 9, 189)")),
        ([(1, 41, 189), (1, 16, 24, 24)], 5, {"task": "segment"}, SIZE, ("segment", "(1, 41, 189)")),
        # Task and head.
        ((1, 9, 189), 5, {"task": "pose", "head": "Detect"}, SIZE, ("pose", "Detect")),
        ((1, 9, 189), 5, {"head": "Segment26"}, SIZE, ("detect", "Segment26")),
        ((1, 5), 5, {"task": "classify", "head": "Classify"}, SIZE, ("classify",)),
        ((1, 5), 5, {"head": "Classify"}, SIZE, ("Classify", "detect")),
        # The input.
        ((1, 9, 189), 5, {"imgsz": [640, 640]}, SIZE, ("640x640", "(1, 3, 96, 96)")),
        ((1, 9, 189), 5, {"imgsz": "640"}, SIZE, ("640x640", "(1, 3, 96, 96)")),
        ((1, 9, 189), 5, {"channels": 1}, SIZE, ("1 channel", "(1, 3, 96, 96)")),
        ((1, 9, 189), 5, {"stride": 64}, SIZE, ("64", "(1, 3, 96, 96)")),
    ],
)
def test_contradiction_is_an_error_that_names_both(
    shape: Any, classes: int, others: dict[str, Any], size: Any, named: tuple[str, ...]
) -> None:
    with pytest.raises(RuntimeUnusableError) as caught:
        recognised(shape, classes, others, size)
    line = str(caught.value)
    assert line.startswith("a.onnx: ")
    assert line.isprintable()
    assert [word for word in named if word not in line] == []


@pytest.mark.parametrize(
    ("others", "layout"),
    [
        ({"imgsz": [640, 480]}, "cells"),
        ({"imgsz": 640}, "cells"),
        ({"imgsz": None}, "cells"),
        ({"channels": None}, "cells"),
    ],
)
def test_input_of_any_size_agrees_with_every_size(others: dict[str, Any], layout: str) -> None:
    assert recognised((1, 9, None), 5, others, FREE) == layout


def test_boxes_in_pixels_are_not_taken_for_queries(tmp_path: Path) -> None:
    """A file that states no head: the numbers of its boxes are the last to compare."""
    pytest.importorskip("onnx", reason="onnx is an optional extra")
    rows = np.ascontiguousarray(three_objects(5, cells=300).transpose(0, 2, 1))
    path = constant_onnx(tmp_path / "a.onnx", {"o": rows}, size=SIZE, metadata=stated(names(5), SIZE))
    with pytest.raises(RuntimeUnusableError, match=r"queries.*0\.\.1, got 75"):
        detect(path)


@pytest.mark.parametrize(("key", "value"), [("channels", 1), ("batch", 4)])
def test_torchscript_of_another_input_is_refused_at_load(key: str, value: int) -> None:
    table = stated(names(5), SIZE, **{key: value})
    with pytest.raises(RuntimeUnusableError, match=str(value)):
        recognise_by_metadata(Path("a.torchscript"), table)
    assert recognise_by_metadata(Path("a.torchscript"), stated(names(5), SIZE)).layout == "cells"


@pytest.mark.parametrize("task", ["segment", "pose", "obb"])
def test_torchscript_of_other_tasks_is_recognised(task: str) -> None:
    for others in ({}, {"end2end": True}, {"kpt_shape": [17, 3]}):
        table = stated(names(5), SIZE, task=task, **others)
        layout = recognise_by_metadata(Path("a.torchscript"), table).layout
        assert layout == ("selected" if others.get("end2end") else "cells")
