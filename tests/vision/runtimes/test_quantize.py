"""int8 exports: they detect as the checkpoint does, name their precision, and need images to calibrate."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from companion.cli import app
from tests.vision.runtimes.conftest import lively_model, make_image, needs
from vision.detector import Detector
from vision.exports import export as export_module
from vision.exports.export import export
from vision.exports.quantize import calibration_images, mean_probability_difference
from vision.runtimes.base import RuntimeName, RuntimeUnusableError
from vision.runtimes.exported import SUFFIXES
from vision.runtimes.source import read_source, runtime_of_file
from vision.runtimes.torch_runtime import TorchRuntime

pytest.importorskip("onnx", reason="onnx is an optional extra")
pytest.importorskip("onnxruntime", reason="onnxruntime is an optional extra")

SIDE = 96


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("photographs")
    for number in range(16):
        assert cv2.imwrite(str(folder / f"{number:02}.png"), make_image(72, SIDE, seed=number))
    return folder


KINDS = [("onnx", "onnxruntime"), ("openvino", "openvino")]


@pytest.fixture(scope="module", params=KINDS)
def quantised(
    request: pytest.FixtureRequest,
    checkpoint: Path,
    photographs: Path,
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Path, RuntimeName]:
    kind, runtime = request.param
    needs(runtime)
    path = tmp_path_factory.mktemp("int8") / f"net{SUFFIXES[kind]}"
    return export(checkpoint, kind, path, SIDE, calibrate=photographs), runtime


@pytest.fixture(scope="module")
def reference() -> TorchRuntime:
    return TorchRuntime(lively_model(), precision="float32")


def test_int8_file_gives_nearly_the_probabilities_of_torch(
    quantised: tuple[Path, RuntimeName], reference: TorchRuntime
) -> None:
    path, name = quantised
    found = runtime_of_file(name, path)
    for size in ((96, 96), (64, 160)):  # any size, as of a float file
        image = make_image(*size, seed=99)
        wanted, got = (
            [level.classes.copy() for level in runtime.infer(image)] for runtime in (reference, found)
        )
        difference = mean_probability_difference(wanted, got)
        assert 0 < difference < 0.1


def test_int8_file_states_its_precision(quantised: tuple[Path, RuntimeName]) -> None:
    path, name = quantised
    facts = read_source(path).facts
    assert facts is not None
    assert facts.precision == "int8"
    detector = Detector(path, runtime=name, image_size=SIDE)
    assert detector.precision == "int8"
    with pytest.raises(RuntimeUnusableError, match=r"net\..*int8.*float32"):
        Detector(path, runtime=name, image_size=SIDE, precision="float32")


@pytest.mark.parametrize(
    "quantised", [KINDS[0], pytest.param(KINDS[1], marks=pytest.mark.slow)], indirect=True
)
def test_evaluation_of_int8_file_needs_no_precision(
    quantised: tuple[Path, RuntimeName], tmp_path: Path
) -> None:
    path, name = quantised
    assert cv2.imwrite(str(tmp_path / "a.png"), make_image(72, SIDE))
    (tmp_path / "a.txt").write_text("0 0.5 0.5 0.5 0.5\n")
    options = ["--model", str(path), "--runtime", name, "--image-size", str(SIDE), "--json"]
    arguments = ["learn", "evaluate", str(tmp_path), *options, "--misses", str(tmp_path / "misses.png")]
    result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout)["precision"] == "int8"
    result = CliRunner().invoke(app, [*arguments, "--precision", "float32"])
    assert result.exit_code == 2


@pytest.mark.parametrize("count", [0, 15])
def test_too_few_calibration_images_are_refused(tmp_path: Path, photographs: Path, count: int) -> None:
    for file in sorted(photographs.iterdir())[:count]:
        (tmp_path / file.name).write_bytes(file.read_bytes())
    with pytest.raises(RuntimeUnusableError, match=rf" {count} images.* 16"):
        calibration_images(tmp_path, SIDE, 32)


@pytest.mark.parametrize("quantised", KINDS[:1], indirect=True)
def test_int8_that_differs_too_much_is_not_kept(
    quantised: tuple[Path, RuntimeName],
    checkpoint: Path,
    photographs: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(export_module, "_INT8_TOLERANCE", 0.0)

    def write(network: object, facts: object, to: str, path: Path, calibration: object) -> None:
        shutil.copy(quantised[0], path)

    monkeypatch.setattr(export_module, "_write_int8", write)
    with pytest.raises(RuntimeUnusableError, match=r"quantised: .* \d\.\d+ .* 0\.0 "):
        export(checkpoint, "onnx", tmp_path / "net.onnx", SIDE, calibrate=photographs)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["--to", "onnx", "--precision", "int8"], "--calibrate"),
        (["--to", "onnx", "--calibrate", "PHOTOGRAPHS"], "--precision int8"),
        (["--to", "onnx", "--precision", "int4"], "int4"),
        (["--to", "torchscript", "--precision", "int8", "--calibrate", "PHOTOGRAPHS"], "torchscript"),
        (["--to", "onnx", "--precision", "int8", "--calibrate", "nowhere"], "nowhere: "),
    ],
)
def test_wrong_int8_requests_end_in_one_line(
    checkpoint: Path, photographs: Path, arguments: list[str], named: str
) -> None:
    given = [str(photographs) if word == "PHOTOGRAPHS" else word for word in arguments]
    result = CliRunner().invoke(app, ["models", "export", str(checkpoint), *given])
    assert result.exit_code == 2
    assert named in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_unreadable_calibration_image_is_named(tmp_path: Path, photographs: Path) -> None:
    for file in photographs.iterdir():
        (tmp_path / file.name).write_bytes(file.read_bytes())
    (tmp_path / "broken.jpg").write_bytes(b"\xff\xd8 not an image")
    with pytest.raises(ValueError, match=r"broken\.jpg"):
        calibration_images(tmp_path, SIDE, 32)


def test_many_calibration_images_are_chosen_evenly(tmp_path: Path) -> None:
    for number in range(300):
        cv2.imwrite(str(tmp_path / f"{number:03}.png"), np.full((6, 8, 3), number // 2, np.uint8))
    chosen = calibration_images(tmp_path, 32, 32)
    assert len(chosen) == 128
    shades = [int(image[16, 16, 0]) for image in chosen]
    assert shades == sorted(shades)
    assert shades[0] == 0
    assert shades[-1] == 149
