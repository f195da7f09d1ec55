"""`companion models show` of files of other exporters."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from companion.cli import app
from tests.vision.foreign_files import constant_onnx, stated

pytest.importorskip("onnx", reason="onnx is an optional extra")
pytest.importorskip("onnxruntime", reason="onnxruntime is an optional extra")


def test_info_has_layout_size_and_task_of_an_export(tmp_path: Path) -> None:
    cells = np.zeros((1, 6 + 51, 126), np.float32)
    metadata = stated(("car", "dog"), (64, 96), task="pose")
    path = constant_onnx(tmp_path / "a.onnx", {"output0": cells}, metadata=metadata)
    done = CliRunner().invoke(app, ["models", "show", str(path), "--json"])
    assert done.exit_code == 0, done.output
    plain = json.loads(done.output)
    assert plain["written_by"] == "Ultralytics 8.4.190"
    assert (plain["kind"], plain["task"], plain["layout"]) == ("onnx", "pose", "cells")
    assert (plain["stride"], plain["input_size"], plain["runtime"]) == (32, [64, 96], "onnxruntime")
    assert "default" in plain["runtime_reason"]
    assert plain["classes"] == ["car", "dog"]
    assert plain["licence"].startswith("AGPL-3.0")
    lines = CliRunner().invoke(app, ["models", "show", str(path)]).output.splitlines()
    assert [line.split()[0] for line in lines][:6] == [
        "file",
        "sha256",
        "written",
        "task",
        "outputs",
        "input",
    ]
    assert "only its boxes" in lines[3]


def test_unknown_export_is_bad_input_in_one_line(tmp_path: Path) -> None:
    path = constant_onnx(tmp_path / "a.onnx", {"out": np.zeros((1, 5), np.float32)})
    done = CliRunner().invoke(app, ["models", "show", str(path)])
    assert done.exit_code == 2
    assert done.output.count("\n") == 1
    assert str(path) in done.output
