"""`companion models` as it is typed: what there is, what a file is, exported and verified."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest
import torch
from typer.testing import CliRunner

import companion.models.verify
from companion.cli import app
from vision.model_files import find_model, kept_models, models_folder
from vision.yolo.checkpoint import load_checkpoint, save_checkpoint


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    kept = tmp_path / "kept"
    monkeypatch.setenv("COMPANION_MODELS_FOLDER", str(kept))
    return kept


def run(*arguments: object) -> str:
    result = CliRunner().invoke(app, ["models", *map(str, arguments)])
    assert result.exit_code == 0, result.stderr
    return result.stdout


def test_the_list_has_what_is_bundled_kept_and_known(folder: Path, small_model: Path) -> None:
    folder.mkdir()
    shutil.copy(small_model, folder / "mine.pt")
    (folder / "yolov8n.pt").write_bytes(b"x")
    listed = json.loads(run("list", "--json"))
    states = {row["name"]: row["state"] for row in listed["models"]}
    assert (states["default"], states["mine.pt"]) == ("bundled", "here")
    assert (states["yolov8n"], states["yolo26x"]) == ("here", "can be pulled")
    assert "yolo11n" in run("list")
    assert [path.name for path in kept_models()] == ["mine.pt", "yolov8n.pt"]


def test_a_bare_name_is_looked_for_in_the_models_folder(folder: Path, small_model: Path) -> None:
    folder.mkdir()
    shutil.copy(small_model, folder / "mine.pt")
    assert models_folder() == folder
    assert find_model("mine") == find_model("mine.pt") == folder / "mine.pt"
    assert find_model(small_model) == small_model
    assert find_model("other") == Path("other")
    assert find_model("./mine.pt") == Path("mine.pt")
    assert json.loads(run("info", "mine", "--json"))["file"] == str(folder / "mine.pt")


def test_info_tells_what_a_model_is() -> None:
    facts = json.loads(run("info", "default", "--json"))
    assert facts["model_family"] == "YOLOv8"
    assert facts["licence"] == "Apache-2.0"
    assert facts["classes"][0] == "person"
    assert facts["parameters"] > 100_000
    assert facts["gflops"] > 0.1
    assert not facts["end_to_end"]
    assert len(facts["sha256"]) == 64
    assert facts["official"] is None
    assert facts["runtime"] == "torch"
    assert facts["precision"] in ("float32", "bfloat16")
    told = run("info", "default")
    # It is measured anew, and where both are as fast may come out otherwise.
    assert re.search(r"\b(float32|bfloat16) \((measured|this processor)", told)
    assert "Apache-2.0" in told
    assert facts["sha256"] in told


def test_info_of_a_runtime_that_there_is_not_is_one_line() -> None:
    result = CliRunner().invoke(app, ["models", "info", "default", "--runtime", "abacus"])
    assert result.exit_code == 2
    assert "runtime must be auto, torch" in result.stderr


def test_what_is_no_model_is_one_line(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["models", "info", str(tmp_path / "none.pt")])
    assert result.exit_code == 2
    assert "no such file" in result.stderr
    result = CliRunner().invoke(app, ["models", "export", "default", "--to", "caffe"])
    assert result.exit_code == 2
    assert "not to 'caffe'" in result.stderr


def test_an_export_says_what_its_source_says_until_it_does_not(
    tmp_path: Path, small_model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    exported = tmp_path / "small.torchscript"
    run("export", small_model, "--to", "torchscript", "--output", exported, "--image-size", 64)
    options = ["--image-size", "96", "--count", "2", "--json"]
    parity = json.loads(run("verify", small_model, exported, *options))
    assert parity["holds"]
    assert parity["same_source"]
    assert parity["images"] == 2
    assert parity["map_difference"] < 1e-3
    # The same network with other numbers is not what was exported.
    loaded = load_checkpoint(small_model)
    with torch.no_grad():
        for parameter in loaded.model.parameters():
            parameter.mul_(1.1)
    other = tmp_path / "other.safetensors"
    save_checkpoint(other, loaded.model, metadata={})
    result = CliRunner().invoke(app, ["models", "verify", str(other), str(exported), *options])
    assert result.exit_code == 1
    parity = json.loads(result.stdout)
    assert not parity["holds"]
    assert not parity["same_source"]
    # What cannot be compared is refused before pictures are drawn for it.
    monkeypatch.setattr(companion.models.verify, "random_scene", None)
    result = CliRunner().invoke(app, ["models", "verify", "default", str(exported), *options])
    assert result.exit_code == 2
    assert "it is another model" in result.stderr
    result = CliRunner().invoke(app, ["models", "verify", str(small_model), str(small_model)])
    assert result.exit_code == 2
    assert "is a checkpoint" in result.stderr
