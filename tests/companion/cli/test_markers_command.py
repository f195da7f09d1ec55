"""`companion detect --markers` and `companion markers`: output, images and exit codes."""

from __future__ import annotations

import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from companion.cli.commands import app
from mavlink_sim.camera.renderer import Renderer
from mavlink_sim.world.fiducials import Print
from mavlink_sim.world.structures import PLATE_THICKNESS_M
from mavlink_sim.world.world import Ground, World, WorldObject
from vision.calibration_files.camera_info import write_camera_info
from vision.camera_model import CameraModel, CameraMount
from vision.marker_boards import ned_from_marker
from vision.rotation import matrix_from_euler, matrix_from_quaternion

LENS = ("--camera-horizontal-fov-deg", "70", "--camera-mount-pitch-deg", "-60")
PRINTED = ("--model", "none", "--markers", "APRILTAG_36h11", "--markers-size-m", "0.5")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two images of a marker on the ground, 2 m ahead and 0.5 m to the right of a camera 3 m up."""
    plate = WorldObject(0, "plate", (2.0, 0.5, 0.0), 0.4, printed=Print("APRILTAG_36h11", 7, 0.5))
    camera = CameraModel.from_horizontal_fov(640, 480, math.radians(70.0))
    renderer = Renderer(World((plate,), Ground(("concrete",), 0, 256, 0.05)), camera, CameraMount())
    image = renderer.render((0.0, 0.0, -3.0), matrix_from_euler(0.0, math.radians(-60.0), 0.0)).image
    folder = tmp_path_factory.mktemp("images")
    for name in ("0.png", "1.png"):
        assert cv2.imwrite(str(folder / name), image)
    return folder


def test_one_json_object_per_frame_with_the_true_pose(folder: Path, tmp_path: Path) -> None:
    done = CliRunner().invoke(
        app, ["detect", str(folder), *PRINTED, *LENS, "--json", "--save", str(tmp_path / "saved")]
    )
    assert done.exit_code == 0, done.output
    messages = [json.loads(line) for line in done.stdout.splitlines()]
    assert [message["sequence"] for message in messages] == [0, 1]
    for message in messages:
        assert set(message) == {"file", "sequence", "captured_ns", "width", "height", "markers", "boards"}
        (marker,) = message["markers"]
        assert marker["id"] == 7
        assert marker["position_body_m"] == pytest.approx([2.0, 0.5, 3.0 - PLATE_THICKNESS_M], abs=0.01)
        assert marker["bearing_rad"] == pytest.approx(math.atan2(0.5, 2.0), abs=0.005)
        assert marker["heading_rad"] == pytest.approx(0.4, abs=0.02)
        assert 0.0 < marker["range_sigma_m"] < 0.02
        assert 0.0 < marker["angle_sigma_rad"] < 0.1
        assert marker["resolved"] is True
    image, drawn = (
        cv2.imread(str(folder / "0.png")),
        cv2.imread(str(tmp_path / "saved" / "detections" / "0.png")),
    )
    assert image is not None
    assert drawn is not None
    assert sorted(path.name for path in (tmp_path / "saved" / "detections").iterdir()) == ["0.png", "1.png"]
    assert cv2.absdiff(image, drawn).max() > 100


def test_one_readable_line_per_marker_and_board(folder: Path, tmp_path: Path) -> None:
    board = tmp_path / "dock.toml"
    board.write_text(
        '[[boards]]\nname = "dock"\n[[boards.markers]]\nid = 7\nsize_m = 0.5\nposition_m = [0, 0, 0]\n'
    )
    done = CliRunner().invoke(
        app, ["detect", str(folder), *PRINTED, *LENS, "--limit", "1", "--markers-boards-file", str(board)]
    )
    assert done.exit_code == 0, done.output
    marker, dock = done.stdout.splitlines()
    assert marker.split()[:3] == ["0.png", "id", "7"]
    assert dock.split()[:3] == ["0.png", "board", "dock"]
    for line in (marker, dock):
        assert float(line.split()[3]) == pytest.approx(3.64, abs=0.02)
    none = CliRunner().invoke(app, ["detect", str(folder), *PRINTED, "--markers", "6X6_50", "--limit", "1"])
    assert none.stdout == "0.png  no markers\n"


def test_unrelated_images_are_judged_by_themselves(tmp_path: Path) -> None:
    """The last ones show the marker in about the second pose of the first ones."""
    camera, rng, truth = (
        CameraModel.from_horizontal_fov(640, 480, math.radians(70.0)),
        np.random.default_rng(5),
        [],
    )
    plate = WorldObject(0, "plate", (0.0, 0.0, 0.0), 0.4, printed=Print("APRILTAG_36h11", 7, 0.5))
    renderer = Renderer(World((plate,), Ground(("concrete",), 0, 256, 0.05)), camera, CameraMount())
    lens = matrix_from_euler(0.0, math.radians(-60.0), 0.0)
    for index in range(10):
        turned = rng.uniform(0.5, 0.7) * (1.0 if index < 7 else -1.0)
        attitude = matrix_from_euler(0.0, -math.pi / 2, 0.0) @ matrix_from_euler(0.0, 0.0, turned)
        body = attitude @ lens.T
        offset = lens @ [2.5, *rng.uniform(-0.1, 0.1, 2)]
        eye = (0.0, 0.0, -PLATE_THICKNESS_M) - body @ offset
        image = renderer.render(tuple(eye), attitude).image
        assert cv2.imwrite(str(tmp_path / f"{index:02d}.png"), image)
        truth.append((offset, body.T @ ned_from_marker(0.4, False)))
    done = CliRunner().invoke(app, ["detect", str(tmp_path), *PRINTED, *LENS, "--json"])
    assert done.exit_code == 0, done.output
    messages = [json.loads(line) for line in done.stdout.splitlines()]
    for message, (offset, rotation) in zip(messages, truth, strict=True):
        (marker,) = message["markers"]
        assert marker["position_body_m"] == pytest.approx(offset, abs=0.02)
        found = matrix_from_quaternion(tuple(marker["rotation_body_wxyz"]))
        assert np.trace(found.T @ rotation) > 1.0 + 2.0 * math.cos(math.radians(3.0))
        assert marker["resolved"] is True


def test_print_setting_turns_the_heading_by_180_degrees(folder: Path) -> None:
    headings = []
    for printed in ("opencv", "apriltag"):
        words = ["detect", str(folder), *PRINTED, *LENS, "--json", "--limit", "1"]
        done = CliRunner().invoke(app, [*words, "--markers-print", printed])
        (marker,) = json.loads(done.stdout)["markers"]
        headings.append(marker["heading_rad"])
    assert headings == pytest.approx([0.4, 0.4 - math.pi], abs=0.02)


def test_sheets_are_written_to_a_pdf_file(tmp_path: Path) -> None:
    output = tmp_path / "sheets.pdf"
    words = [
        "markers",
        "0..3,7",
        "--dictionary",
        "APRILTAG_36h11",
        "--size",
        "0.16",
        "-o",
        str(output),
    ]
    done = CliRunner().invoke(app, words)
    assert (done.exit_code, done.stdout) == (0, f"written: {output}, 5 markers\n")
    sheets = output.read_bytes()
    assert sheets.startswith(b"%PDF-1.4\n")
    for identifier in (0, 1, 2, 3, 7):
        assert b"APRILTAG_36h11 id %d 160 mm print opencv" % identifier in sheets


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["0", "--size", "0.1"], ["--dictionary"]),
        (["0..50", "--dictionary", "4X4_50"], ["0..50", "from 0 to 49"]),
        (["0..99999999999", "--dictionary", "4X4_50"], ["from 0 to 49"]),
        (["1,1", "--dictionary", "4X4_50", "--size", "0.1"], ["1 is given twice"]),
        (["x", "--dictionary", "4X4_50", "--size", "0.1"], ["'x'"]),
        (["0", "--dictionary", "4X4_50", "--size", "2"], ["2000 mm", "needs a paper"]),
        (["0", "--dictionary", "4X4_50", "--size", "nan"], ["nan"]),
        (["0", "--dictionary", "4X4_50", "--paper", "A7"], ["'A7'", "WIDTHxHEIGHT"]),
        (["0", "--dictionary", "4X4_50", "--markers-print", "apriltag"], ["4X4_50", "'opencv'"]),
        (["0", "--dictionary", "4X4_50", "-o", "none/a.pdf"], ["none/a.pdf", "no such folder"]),
    ],
)
def test_sheets_that_cannot_be_are_one_line(
    arguments: list[str], words: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, ["markers", *arguments])
    assert (done.exit_code, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith("companion: ")
    assert all(word in line for word in words), line
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--markers"], ["--markers DICTIONARY"]),
        (["--markers", "4x4"], ["'4x4'", "4X4_50"]),
        (["--markers", "4X4_50", "--markers-size-m", "-1"], ["-1"]),
        (["--markers", "4X4_50", "--markers-boards-file", "none.toml"], ["none.toml"]),
        (["--markers", "4X4_50", "--camera-on-gimbal", "true"], ["camera.on_gimbal"]),
    ],
)
def test_bad_input_is_one_line_and_exit_code_2(arguments: list[str], words: list[str], folder: Path) -> None:
    done = CliRunner().invoke(app, ["detect", "--model", "none", str(folder), *arguments])
    assert (done.exit_code, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith("companion: ")
    assert all(word in line for word in words), line


def test_dictionary_of_the_settings_needs_no_value(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COMPANION_MARKERS_DICTIONARY", "APRILTAG_36h11")
    done = CliRunner().invoke(app, ["detect", "--model", "none", "--limit", "1", str(folder), "--markers"])
    assert done.stdout.split()[:3] == ["0.png", "id", "7"], done.output


def test_missing_and_empty_sources_exit_with_code_2(tmp_path: Path) -> None:
    for source in (tmp_path / "none.png", tmp_path):
        done = CliRunner().invoke(app, ["detect", str(source), *PRINTED])
        assert (done.exit_code, done.stdout) == (2, "")
        assert str(source) in done.stderr
        assert len(done.stderr.splitlines()) == 1


def test_lens_of_images_of_another_aspect_is_one_line(folder: Path, tmp_path: Path) -> None:
    file = tmp_path / "camera.yaml"
    write_camera_info(file, CameraModel(300, 300, 300.0, 300.0, 150.0, 150.0), "camera")
    lens = ("--camera-calibration-file", str(file))
    done = CliRunner().invoke(app, ["detect", str(folder), *PRINTED, *lens])
    assert done.exit_code == 2
    (line,) = done.stderr.splitlines()
    assert "300x300" in line
    assert "640x480" in line
