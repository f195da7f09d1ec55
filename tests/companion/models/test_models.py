"""`companion models`: list, info, export and verify."""

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
from vision.weights import DEFAULT_EXPORT
from vision.yolo.checkpoint import load_checkpoint, save_checkpoint
from vision.yolo.checkpoint_pair import weights_sha256


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    kept = tmp_path / "kept"
    monkeypatch.setenv("COMPANION_MODELS_FOLDER", str(kept))
    monkeypatch.setattr("vision.runtimes.torch_runtime._TRIAL_S", 0.05)
    return kept


def run(*arguments: object) -> str:
    result = CliRunner().invoke(app, ["models", *map(str, arguments)])
    assert result.exit_code == 0, result.stderr
    return result.stdout


def test_list_has_bundled_local_and_official_models(folder: Path, small_model: Path) -> None:
    folder.mkdir()
    shutil.copy(small_model, folder / "mine.pt")
    (folder / "yolov8n.pt").write_bytes(b"x")
    listed = json.loads(run("show", "--json"))
    states = {row["name"]: row["state"] for row in listed["models"]}
    assert (states["default"], states["mine.pt"]) == ("bundled", "here")
    assert states["yolov8n"] == "here"
    assert states["yolo26x"] == "can be pulled"
    assert "yolo11n" in run("show")
    assert [path.name for path in kept_models()] == ["mine.pt", "yolov8n.pt"]


def test_list_has_permissive_licences_first(folder: Path) -> None:
    licences = [row["licence"] for row in json.loads(run("show", "--json"))["models"]]
    assert licences == sorted(licences, key=lambda licence: licence != "Apache-2.0")
    assert licences.count("Apache-2.0") == 4
    assert run("show").splitlines()[1].startswith("Apache-2.0")


@pytest.mark.parametrize(
    ("arguments", "command"),
    [
        (["detect", "photo.jpg", "--model", "yolov8n"], "companion models pull yolov8n"),
        (["detect", "photo.jpg", "--model", "yolov8n.pt"], "companion models pull yolov8n"),
        (["detect", "photo.jpg", "--model", "yolox_s.onnx"], "companion models pull yolox_s"),
        (["detect", "photo.jpg", "--model", "other"], "companion models show"),
        (["models", "show", "yolo11n", "--compare", "yolo11n.onnx"], "companion models pull yolo11n"),
    ],
)
def test_missing_name_says_how_to_get_a_model(folder: Path, arguments: list[str], command: str) -> None:
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2
    assert re.findall(r"`(companion .*?)`", result.stderr) == [command]
    assert str(folder) in result.stderr


def test_bare_name_is_found_in_models_folder(folder: Path, small_model: Path) -> None:
    folder.mkdir()
    shutil.copy(small_model, folder / "mine.pt")
    assert models_folder() == folder
    assert find_model("mine") == find_model("mine.pt") == folder / "mine.pt"
    assert find_model(small_model) == small_model
    assert find_model("other") == Path("other")
    assert find_model("./mine.pt") == Path("mine.pt")
    assert json.loads(run("show", "mine", "--json"))["file"] == str(folder / "mine.pt")


@pytest.fixture
def two_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """The user's folder and the system's, which do not exist yet."""
    monkeypatch.delenv("COMPANION_MODELS_FOLDER")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setattr("vision.model_files.SYSTEM_FOLDER", tmp_path / "system" / "models")
    return tmp_path / "data" / "mavlink-companion" / "models", tmp_path / "system" / "models"


def test_model_in_system_folder_is_found_by_all(two_folders: tuple[Path, Path]) -> None:
    own, system = two_folders
    system.mkdir(parents=True)
    for name in ("pulled.pt", "both.pt"):
        (system / name).write_bytes(b"system")
    assert find_model("pulled") == system / "pulled.pt"
    assert find_model("both") == system / "both.pt"
    own.mkdir(parents=True)
    for name in ("both.pt", "own.onnx"):
        (own / name).write_bytes(b"own")
    assert find_model("both") == own / "both.pt"
    assert kept_models() == [own / "both.pt", own / "own.onnx", system / "pulled.pt"]
    rows = json.loads(run("show", "--json"))["models"]
    assert {row["path"] for row in rows if row["state"] == "here"} == set(map(str, kept_models()))


def test_model_is_put_where_the_service_finds_it(
    two_folders: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    own, system = two_folders
    assert models_folder() == system
    writable = {own.parent.parent.parent}
    monkeypatch.setattr("os.access", lambda path, _mode: path in writable)
    system.mkdir(parents=True)
    assert models_folder() == own
    writable.add(system)
    assert models_folder() == system


def test_unreadable_folder_does_not_hide_the_next(two_folders: tuple[Path, Path]) -> None:
    own, system = two_folders
    system.mkdir(parents=True)
    (system / "pulled.pt").write_bytes(b"system")
    own.parent.parent.mkdir()
    own.parent.write_bytes(b"no folder")  # as root may read every folder
    assert find_model("pulled") == system / "pulled.pt"
    assert kept_models() == [system / "pulled.pt"]


def test_info_describes_model() -> None:
    facts = json.loads(run("show", "default", "--runtime", "torch", "--json"))
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
    output = run("show", "default", "--runtime", "torch")
    # It is measured again; with equal timings the choice may differ.
    assert re.search(r"\b(float32|bfloat16) \((measured|this processor)", output)
    assert "Apache-2.0" in output
    assert facts["sha256"] in output


def test_info_of_the_bundled_model_is_that_of_its_export() -> None:
    facts = json.loads(run("show", "default", "--json"))
    assert (facts["kind"], facts["runtime"], facts["licence"]) == ("onnx", "onnxruntime", "Apache-2.0")
    assert facts["sha256"] == weights_sha256(DEFAULT_EXPORT)


@pytest.mark.timeout(300)
def test_export_of_the_bundled_model_goes_to_the_models_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COMPANION_MODELS_FOLDER", str(tmp_path / "models"))
    before = package_files()
    run("export", "default", "--to", "onnx", "--image-size", "64")
    assert [path.name for path in (tmp_path / "models").iterdir()] == ["default.onnx"]
    assert package_files() == before
    assert find_model("default.onnx").parent == tmp_path / "models"


def package_files() -> set[tuple[str, int]]:
    """The files beside the bundled weights, with the time of the last change."""
    return {
        (path.name, path.stat().st_mtime_ns) for path in DEFAULT_EXPORT.parent.iterdir() if path.is_file()
    }


def test_unknown_runtime_is_an_error() -> None:
    result = CliRunner().invoke(app, ["models", "show", "default", "--runtime", "abacus"])
    assert result.exit_code == 2
    assert "runtime" in result.stderr
    assert "torch" in result.stderr


def test_missing_model_or_unknown_format_is_an_error(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["models", "show", str(tmp_path / "none.pt")])
    assert result.exit_code == 2
    assert f"{tmp_path / 'none.pt'}: " in result.stderr
    assert "such file" in result.stderr
    result = CliRunner().invoke(app, ["models", "export", "default", "--to", "caffe"])
    assert result.exit_code == 2
    assert " to 'caffe'" in result.stderr


@pytest.mark.parametrize("to", ["onnx", "openvino"])
@pytest.mark.parametrize("name", ["foreign.onnx", "foreign.torchscript"])
def test_export_of_exported_file_asks_for_checkpoint(tmp_path: Path, name: str, to: str) -> None:
    (tmp_path / name).write_bytes(b"\x08\x08")
    options = ["--to", to, "--precision", "int8", "--calibrate", str(tmp_path)]
    result = CliRunner().invoke(app, ["models", "export", str(tmp_path / name), *options])
    assert result.exit_code == 2
    assert f"{tmp_path / name}: " in result.stderr
    assert "exported file" in result.stderr
    assert "a checkpoint " in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_verify_compares_export_with_source(
    tmp_path: Path, small_model: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    exported = tmp_path / "small.torchscript"
    run("export", small_model, "--to", "torchscript", "--output", exported, "--image-size", 64)
    options = ["--image-size", "96", "--count", "1", "--json"]
    parity = json.loads(run("show", small_model, "--compare", exported, *options))
    assert parity["holds"]
    assert parity["same_source"]
    assert parity["images"] == 1
    assert parity["map_difference"] < 1e-3
    # The same network with other weights differs from the export.
    loaded = load_checkpoint(small_model)
    with torch.no_grad():
        for parameter in loaded.model.parameters():
            parameter.mul_(1.1)
    other = tmp_path / "other.safetensors"
    save_checkpoint(other, loaded.model, metadata={})
    result = CliRunner().invoke(app, ["models", "show", str(other), "--compare", str(exported), *options])
    assert result.exit_code == 1
    parity = json.loads(result.stdout)
    assert not parity["holds"]
    assert not parity["same_source"]
    # Models that cannot be compared are refused before scenes are rendered.
    monkeypatch.setattr(companion.models.verify, "random_scene", None)
    result = CliRunner().invoke(app, ["models", "show", "default", "--compare", str(exported), *options])
    assert result.exit_code == 2
    assert "strides" in result.stderr
    result = CliRunner().invoke(app, ["models", "show", str(small_model), "--compare", str(small_model)])
    assert result.exit_code == 2
    assert "models export" in result.stderr
