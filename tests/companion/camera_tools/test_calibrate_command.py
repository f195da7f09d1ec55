"""`companion calibrate` and `mavlink-sim board`, in this process."""

from __future__ import annotations

import itertools
import json
import math
import re
import socket
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import zenoh
from numpy.typing import NDArray
from typer.testing import CliRunner, Result

import vision.sources
from companion.bus.config import zenoh_config
from companion.camera_tools import calibrate as calibrate_module
from companion.camera_tools.calibrate import LiveTilt, collect_views, markers_of, result_lines
from companion.cli.commands import app
from companion.settings.bus import ZenohSection
from mavlink_sim.camera.image_effects import ImageEffects
from mavlink_sim.camera.renderer import Renderer
from mavlink_sim.datasets.board_views import (
    LENSES,
    BoardCamera,
    board_poses,
    write_board_pairs,
    write_board_views,
)
from mavlink_sim.datasets.board_views import app as board_app
from mavlink_sim.testing import free_port
from mavlink_sim.world.fiducials import Print
from mavlink_sim.world.world import Ground, World, WorldObject
from tests.vision.calibration.test_boards import LegacyBoard
from vision.attitude import quaternion_from_euler
from vision.calibration.boards import Board
from vision.calibration.calibrate import CalibrationError
from vision.calibration.calibrate import calibrate as calibrate_views
from vision.calibration_files.camera_info import camera_identity, read_camera_info, write_camera_info
from vision.camera_model import CameraModel, CameraMount
from vision.frame import Frame
from vision.markers import MarkerKind
from vision.rotation import matrix_from_euler
from vision.sources import Source, SourceError, SourceStatistics, open_source

# A small lens and board, so that views are rendered and found fast.
LENS = LENSES["webcam"].scaled(320, 240)
BOARD = Board("chessboard", 7, 5, 0.03)
BOARD_WORDS = ("--board", "chessboard", "7x5", "--square", "0.03")


def calibrate(*arguments: str | Path) -> Result:
    return CliRunner().invoke(app, ["calibrate", *map(str, arguments)])


def one_line_of_bad_input(done: Result) -> str:
    """Return the last line on standard error; check that it is no traceback and the exit code is 2."""
    assert done.exit_code == 2, done.output
    lines = done.stderr.splitlines()
    assert [line for line in lines if not line.startswith("companion: ")] == []
    return lines[-1]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    write_board_views(path := tmp_path_factory.mktemp("views") / "board", BOARD, LENS, 12, 3)
    return path


@pytest.fixture(scope="module")
def few(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first of the views, just enough for a calibration."""
    return first_views(folder, 6, tmp_path_factory.mktemp("few") / "views")


def first_views(folder: Path, count: int, path: Path) -> Path:
    """A folder at a path with the first of the views: a board that is not found takes long."""
    path.mkdir()
    for image in sorted(folder.glob("*.png"))[:count]:
        (path / image.name).symlink_to(image)
    return path


def test_folder_gives_a_calibration_and_a_report(folder: Path, tmp_path: Path) -> None:
    output, report = tmp_path / "camera.yaml", tmp_path / "report"
    done = calibrate(folder, *BOARD_WORDS, "-o", output, "--report", report, "--name", "front")
    assert done.exit_code == 0, done.output
    lens = read_camera_info(output).model
    assert (lens.width, lens.height, lens.distortion_model) == (320, 240, "plumb_bob")
    assert (lens.fx, lens.fy) == pytest.approx((LENS.fx, LENS.fy), rel=0.01)
    assert "camera_name: front" in output.read_text()
    assert "12 views" in done.stdout
    rms = re.search(r"reprojection ([0-9.]+) px", done.stdout)
    assert rms is not None
    assert 0.0 < float(rms[1]) < 0.2
    page = (report / "index.html").read_text()
    files = set(re.findall(r'src="([^"]+)"', page))
    assert {"corners.png", "undistorted.jpg", "view00.jpg", "view11.jpg"} <= files
    for file in files:
        assert cv2.imread(str(report / file)) is not None
    assert all(f"view{number:02d}.png" in page for number in range(12))
    done = CliRunner().invoke(app, ["describe", "settings", "--camera-calibration-file", str(output)])
    assert done.exit_code == 0, done.output
    assert f'calibration_file = "{output}"' in done.stdout


def test_result_names_where_the_lens_folds_the_image(few: Path) -> None:
    with open_source(str(few)) as source:
        found = calibrate_views(collect_views(source, BOARD, lambda _: None).collector.chosen())
    folded = CameraModel(320, 240, 150.0, 150.0, 160.0, 120.0, (-0.4, 0.0, 0.0, 0.0))
    whole = CameraModel(320, 240, 250.0, 250.0, 160.0, 120.0, (-0.1, 0.0, 0.0, 0.0))
    counts = [len(result_lines(replace(found, model=model))) for model in (whole, folded)]
    assert counts[1] == counts[0] + 1
    assert "folds the image" in result_lines(replace(found, model=folded))[-1]


def test_video_gives_a_calibration(tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    camera, poses = BoardCamera(BOARD, LENS), board_poses(BOARD, LENS, rng)
    writer = cv2.VideoWriter(
        str(tmp_path / "views.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, (LENS.width, LENS.height)
    )
    for _ in range(7):
        grey = camera.render(next(poses), rng)
        for _ in range(2):
            writer.write(cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR))
    writer.release()
    done = calibrate(tmp_path / "views.avi", *BOARD_WORDS, "--every", "2", "-o", tmp_path / "camera.yaml")
    assert done.exit_code == 0, done.output
    assert "7 images, 7 with " in done.stderr
    assert "7 different views" in done.stderr
    assert "missing" in done.stderr
    assert read_camera_info(tmp_path / "camera.yaml").model.fx == pytest.approx(LENS.fx, rel=0.02)


def test_calibration_of_turned_images_says_so(few: Path, marker_images: Path, tmp_path: Path) -> None:
    output = tmp_path / "camera.yaml"
    assert calibrate(few, *BOARD_WORDS, "-o", output, "--rotate", "180", "--mirror").exit_code == 0
    assert {"rotate_deg: 180", "mirror: true"} <= set(output.read_text().splitlines())
    flags = ("--camera-calibration-file", str(output))
    done = CliRunner().invoke(app, ["describe", "settings", *flags])
    assert "rotate_deg is 0" in one_line_of_bad_input(done)
    turned = ("--source-rotate-deg", "180", "--source-mirror", "true")
    assert CliRunner().invoke(app, ["describe", "settings", *flags, *turned]).exit_code == 0
    done = calibrate("mount", marker_images, "--marker", "7", "--size", "0.6", "--calibration", output)
    assert "rotate_deg" in one_line_of_bad_input(done)


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Views of a colour camera and of an infrared camera of half its size beside it."""
    path = tmp_path_factory.mktemp("pairs") / "pairs"
    write_board_pairs(path, BOARD, LENS, LENSES["plain"].scaled(280, 210), 9, 3)
    return path


def first_pairs(pairs: Path, count: int, path: Path) -> tuple[Path, Path]:
    """Folders at a path with the first of the views of both cameras."""
    for camera in ("colour", "infrared"):
        (path / camera).mkdir(parents=True)
        for image in sorted((pairs / camera).iterdir())[:count]:
            (path / camera / image.name).symlink_to(image)
    return path / "colour", path / "infrared"


def extrinsics(pairs: Path, *options: str | Path, **files: Path) -> Result:
    lenses = {"colour": pairs / "colour.yaml", "infrared": pairs / "depth.yaml"} | files
    sources = (pairs / "colour", "--depth-source", pairs / "infrared")
    return calibrate(*sources, *BOARD_WORDS, *_lenses(lenses["colour"], lenses["infrared"]), *options)


def test_folders_of_two_cameras_give_their_places(pairs: Path, tmp_path: Path) -> None:
    output = tmp_path / "depth.yaml"
    done = extrinsics(pairs, "-o", output)
    assert done.exit_code == 0, done.output
    assert "9 pairs of " in done.stderr
    assert ", 9 with " in done.stderr
    assert "image's" not in done.stderr  # the board need not reach the image's corners
    found, true = read_camera_info(output).registration, read_camera_info(pairs / "depth.yaml").registration
    assert found is not None
    assert true is not None
    np.testing.assert_allclose(found.position_m, true.position_m, atol=0.002)
    np.testing.assert_allclose(found.rotation, true.rotation, atol=0.002)
    assert (found.depth, found.colour) == (true.depth, true.colour)
    right = re.search(r"depth camera at (\S+) mm right", done.stdout)
    assert right is not None
    assert float(right[1]) == pytest.approx(true.position_m[0] * 1000, abs=2.0)
    flags = ("--source-depth", "depth/", "--source-depth-calibration-file", str(output))
    assert CliRunner().invoke(app, ["describe", "settings", *flags]).exit_code == 0
    turned = CliRunner().invoke(app, ["describe", "settings", *flags, "--source-mirror", "true"])
    assert "mirror" in one_line_of_bad_input(turned)


def test_wrong_files_of_two_cameras_are_refused(pairs: Path, few: Path, tmp_path: Path) -> None:
    line = one_line_of_bad_input(extrinsics(pairs, infrared=pairs / "none.yaml"))
    assert "none.yaml" in line
    write_camera_info(other := tmp_path / "other.yaml", LENSES["plain"].scaled(640, 360), "other")
    folders = first_pairs(pairs, 2, tmp_path)
    lenses = {"colour": pairs / "colour.yaml", "infrared": other}
    line = one_line_of_bad_input(extrinsics(tmp_path, "-o", tmp_path / "depth.yaml", **lenses))
    assert "640x360" in line
    assert "280x210" in line
    words = ("--depth-source", few, *_lenses(pairs / "colour.yaml", pairs / "depth.yaml"))
    line = one_line_of_bad_input(calibrate(pairs / "colour", *BOARD_WORDS, *words))
    assert "not determine" in line
    empty = ("--board", "chessboard", "8x5", "--square", "0.03")
    words = ("--depth-source", folders[1], *_lenses(pairs / "colour.yaml", pairs / "depth.yaml"))
    line = one_line_of_bad_input(calibrate(folders[0], *empty, *words))
    assert "no board " in line
    assert " of 2 pairs" in line
    flags = ("--source-depth", "depth/", "--source-depth-calibration-file", str(pairs / "colour.yaml"))
    done = CliRunner().invoke(app, ["describe", "settings", *flags])
    assert "colour_from_depth" in one_line_of_bad_input(done)
    done = CliRunner().invoke(app, ["describe", "settings", *flags[2:]])
    assert "set depth" in one_line_of_bad_input(done)


def test_live_cameras_are_paired_by_their_stamps() -> None:
    board = next(Live()._frames).image
    blank = np.zeros_like(board)

    class Camera(Live):
        def __init__(self, times_ms: list[int], image: NDArray[np.uint8]) -> None:
            super().__init__(interrupt_after=len(times_ms))
            self._frames = (Frame(image, ms * 1_000_000, number) for number, ms in enumerate(times_ms))

    colour = Camera([0, 33, 66, 99, 133], board)
    collected = collect_views(colour, BOARD, lambda _: None, 1, Camera([40, 73, 140, 200], board))
    assert (collected.frames, collected.found) == (3, 3)  # 33-40, 66-73, 133-140
    assert len(collected.pairs) == 1  # the board did not move
    with pytest.raises(CalibrationError, match=r"no board .* 1 pairs"):
        collect_views(Camera([0], board), BOARD, lambda _: None, 1, Camera([10], blank))
    recorded = Camera([0], board)
    recorded.live = False
    with pytest.raises(ValueError, match="common time"):
        collect_views(Camera([0], board), BOARD, lambda _: None, 1, recorded)


def test_no_board_in_any_view(folder: Path, tmp_path: Path) -> None:
    words = ("--board", "chessboard", "8x5", "--square", "0.03")
    views = first_views(folder, 2, tmp_path / "views")
    line = one_line_of_bad_input(calibrate(views, *words, "-o", tmp_path / "camera.yaml"))
    assert "no board " in line
    assert " of 2 images" in line
    assert "8x5" in line
    assert not (tmp_path / "camera.yaml").exists()


def charuco_words(size: str, dictionary: str = "4X4_50", marker: str = "0.022") -> tuple[str, ...]:
    return ("--board", "charuco", size, "--square", "0.03", "--marker", marker, "--dictionary", dictionary)


@pytest.fixture(scope="module")
def legacy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Views of a board of calib.io, 8 columns and 6 rows."""
    board = LegacyBoard("charuco", 8, 6, 0.03, 0.022, "4X4_50")
    path = tmp_path_factory.mktemp("legacy") / "views"
    write_board_views(path, board, LENSES["webcam"], 8, 3)
    return path


def test_board_of_before_opencv_4_6_gives_a_calibration(legacy: Path, tmp_path: Path) -> None:
    done = calibrate(legacy, *charuco_words("8x6", "DICT_4X4"), "-o", tmp_path / "camera.yaml")
    assert done.exit_code == 0, done.output
    assert "8 images, 8 with " in done.stderr
    assert "calib.io" in done.stderr
    assert "upper-left" in done.stderr
    lens = read_camera_info(tmp_path / "camera.yaml").model
    assert (lens.fx, lens.fy) == pytest.approx((LENSES["webcam"].fx, LENSES["webcam"].fy), rel=0.02)


@pytest.mark.parametrize(
    ("words", "given"),
    [
        (charuco_words("6x8"), "6x8"),
        (charuco_words("8x5"), "8x5"),
        (charuco_words("9x6"), "9x6"),
        (charuco_words("8x6", "5X5_50"), "5X5_50"),
        (charuco_words("8x6", "tag36h11"), "APRILTAG_36h11"),
        (charuco_words("8x6", "4X4_50", "0.015"), "0.50"),
        (("--board", "chessboard", "9x6", "--square", "0.03"), "chessboard of 9x6"),
    ],
)
def test_other_charuco_than_the_given_is_named(
    legacy: Path, words: tuple[str, ...], given: str, tmp_path: Path
) -> None:
    views = first_views(legacy, 3, tmp_path / "views")
    line = one_line_of_bad_input(calibrate(views, *words, "-o", tmp_path / "camera.yaml"))
    assert "8 columns" in line
    assert "6 rows" in line
    assert "4X4" in line
    assert given in line


def test_squares_given_as_inner_corners_are_named(folder: Path, tmp_path: Path) -> None:
    words = ("--board", "chessboard", "8x6", "--square", "0.03")
    views = first_views(folder, 2, tmp_path / "views")
    line = one_line_of_bad_input(calibrate(views, *words, "-o", tmp_path / "camera.yaml"))
    assert "7x5 inner corners" in line
    assert "8x6 inner corners" in line


def test_too_few_views(folder: Path, tmp_path: Path) -> None:
    fewer = first_views(folder, 5, tmp_path / "fewer")
    done = calibrate(fewer, *BOARD_WORDS, "-o", tmp_path / "camera.yaml")
    line = one_line_of_bad_input(done)
    assert done.stderr.splitlines() == [line]
    assert "few views" in line
    assert ": 5 different" in line
    assert "more views" in line


def test_too_few_pairs(pairs: Path, tmp_path: Path) -> None:
    colour, infrared = first_pairs(pairs, 5, tmp_path)
    words = ("--depth-source", infrared, *_lenses(pairs / "colour.yaml", pairs / "depth.yaml"))
    done = calibrate(colour, *BOARD_WORDS, *words, "-o", tmp_path / "depth.yaml")
    line = one_line_of_bad_input(done)
    assert done.stderr.splitlines() == [line]
    assert "few views" in line
    assert "both cameras" in line
    assert "more views" in line


def test_calibration_of_another_camera_is_refused(folder: Path, tmp_path: Path) -> None:
    """A camera with an address of its own needs no `--name`."""
    own, other = "/dev/v4l/by-id/usb-front-video-index0", "/dev/v4l/by-id/usb-rear-video-index0"
    file = tmp_path / "camera.yaml"
    write_camera_info(file, LENS, own)
    flags = ("--camera-calibration-file", str(file))
    size, words = ("--size", "0.6"), ("--calibration", file)
    for refused in (
        calibrate("mount", other, "--marker", "7", *size, *words),
        calibrate(other, "--depth-source", "infrared", *BOARD_WORDS, *_lenses(file, folder / "truth.yaml")),
        calibrate("colour", "--depth-source", other, *BOARD_WORDS, *_lenses(folder / "truth.yaml", file)),
        CliRunner().invoke(app, ["detect", other, "--markers", "4X4_50", *flags]),
        CliRunner().invoke(app, ["describe", "settings", "--source", other, *flags]),
    ):
        line = one_line_of_bad_input(refused)
        assert own in line
        assert other in line
    for fits in (("--source", own, "--source-name", "front"), ("--source", "/dev/video0")):
        assert CliRunner().invoke(app, ["describe", "settings", *fits, *flags]).exit_code == 0


CONFIG = ("--config", "companion.toml")
# By name: command and options.
_READERS = {
    "status": ("detect", "--model", "none"),
    "depth": ("detect", "--model", "none", "--depth"),
    "markers": ("detect", "--model", "none", "--markers", "4X4_50"),
    "cloud": ("detect", "--model", "none", "--cloud", "cloud.ply"),
    "mount": ("calibrate", "mount", "--marker", "7", "--size", "0.6"),
}


@pytest.fixture
def opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The addresses that are opened; there is nothing at any of them. The current folder is empty."""
    uris: list[str] = []

    def open_source(uri: str, _: object) -> Source:
        uris.append(uri)
        raise SourceError(f"{uri}: nothing")

    monkeypatch.setattr("vision.sources.open_source", open_source)
    monkeypatch.chdir(tmp_path)
    return uris


@pytest.mark.parametrize("reader", _READERS)
@pytest.mark.parametrize(
    ("source", "settings"),
    [
        ("shm://front", '[source]\nshare = "front"'),
        ("/dev/video2", '[cameras.rear.source]\nuri = "/dev/video2"'),
    ],
)
def test_source_of_the_service_is_read_by_a_command(
    reader: str, source: str, settings: str, opened: list[str]
) -> None:
    Path("companion.toml").write_text(settings)
    done = CliRunner().invoke(app, [*_READERS[reader], source, *CONFIG])
    assert opened == [source], done.output


def test_lens_must_fit_the_source_that_is_read(opened: list[str]) -> None:
    own, other = "/dev/v4l/by-id/usb-front-video-index0", "/dev/v4l/by-id/usb-rear-video-index0"
    write_camera_info(Path("camera.yaml"), LENS, own)
    lens = ("--camera-calibration-file", "camera.yaml")
    for reader in ("depth", "markers", "cloud"):
        Path("companion.toml").write_text(
            f'[source]\nuri = "{own}"\n[camera]\ncalibration_file = "camera.yaml"'
        )
        assert own in one_line_of_bad_input(CliRunner().invoke(app, [*_READERS[reader], other, *CONFIG]))
        Path("companion.toml").write_text(f'[source]\nuri = "{other}"')
        CliRunner().invoke(app, [*_READERS[reader], own, *CONFIG, *lens])
    assert opened == [own] * 3


def test_command_that_uses_no_lens_reads_another_camera(opened: list[str]) -> None:
    own, other = "/dev/v4l/by-id/usb-front-video-index0", "/dev/v4l/by-id/usb-rear-video-index0"
    write_camera_info(Path("camera.yaml"), LENS, own)
    Path("companion.toml").write_text(f'[source]\nuri = "{own}"\n[camera]\ncalibration_file = "camera.yaml"')
    for reader in ("status", "mount"):
        CliRunner().invoke(app, [*_READERS[reader], other, *CONFIG])
    assert opened == [other] * 2
    words = [*_READERS["status"], other, *CONFIG, "--level", "--save", "images"]
    levelled = CliRunner().invoke(app, words)
    assert own in one_line_of_bad_input(levelled)


def _lenses(colour: Path, infrared: Path) -> tuple[str | Path, ...]:
    return ("--calibration", colour, "--depth-calibration", infrared)


def test_address_of_one_camera_is_its_name(
    few: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = vision.sources.open_source
    monkeypatch.setattr("vision.sources.open_source", lambda _, settings: opened(str(few), settings))
    own = "/dev/v4l/by-id/usb-front-video-index0"
    for source, name in ((own, own), ("oak://", None)):
        assert calibrate(source, *BOARD_WORDS, "-o", tmp_path / "camera.yaml").exit_code == 0
        assert read_camera_info(tmp_path / "camera.yaml").name == name
    assert camera_identity("realsense://0123") == "realsense://0123"
    assert camera_identity("/dev/video0") is None


def test_images_of_different_sizes(folder: Path, tmp_path: Path) -> None:
    mixed = tmp_path / "mixed"
    mixed.mkdir()
    for number in range(3):
        image = cv2.imread(str(folder / f"view{number:02d}.png"))
        assert image is not None
        if number == 2:
            image = cv2.resize(image, (640, 480))
        cv2.imwrite(str(mixed / f"{number}.png"), image)
    line = one_line_of_bad_input(calibrate(mixed, *BOARD_WORDS, "-o", tmp_path / "camera.yaml"))
    assert "320x240" in line
    assert "2.png 640x480" in line


@pytest.mark.parametrize(
    ("words", "fact"),
    [
        (("--board", "circles", "7x5", "--square", "0.03"), "circles"),
        (("--board", "charuco", "7x5", "--square", "0.03"), "markers"),
        (("--board", "chessboard", "7by5", "--square", "0.03"), "7by5"),
    ],
)
def test_impossible_board(folder: Path, words: tuple[str, ...], fact: str) -> None:
    assert fact in one_line_of_bad_input(calibrate(folder, *words))


def test_missing_source(tmp_path: Path) -> None:
    assert "none" in one_line_of_bad_input(calibrate(tmp_path / "none", *BOARD_WORDS))


class Live(Source):
    """A live source of rendered views, without end."""

    uri, live = "test://board", True

    def __init__(self, interrupt_after: int | None = None) -> None:
        self.read_count, self._interrupt_after = 0, interrupt_after
        self._frames = self._rendered()

    def _rendered(self) -> Iterator[Frame]:
        rng = np.random.default_rng(1)  # a seed that covers the image soon
        camera, poses = BoardCamera(BOARD, LENS), board_poses(BOARD, LENS, rng)
        while True:
            grey = camera.render(next(poses), rng)
            yield Frame(np.repeat(grey[:, :, None], 3, axis=2), self.read_count, self.read_count)

    def read(self, timeout_s: float = 1.0) -> Frame | None:
        if self.read_count == self._interrupt_after:
            raise KeyboardInterrupt
        self.read_count += 1
        return next(self._frames)

    @property
    def statistics(self) -> SourceStatistics:
        return SourceStatistics(self.read_count)

    def close(self) -> None:
        pass


def test_live_source_is_read_until_nothing_is_missing() -> None:
    lines: list[str] = []
    collected = collect_views(source := Live(), BOARD, lines.append)
    assert collected.collector.missing() == []
    assert source.read_count == collected.frames >= 15
    assert len(lines) == 1 + len(collected.collector.views)
    assert "tilted" in lines[1]
    assert lines[-1].endswith("nothing")


def test_interrupt_keeps_the_views_of_a_live_source() -> None:
    collected = collect_views(Live(interrupt_after=4), BOARD, lambda _: None)
    assert len(collected.collector.views) == 4


def test_simulator_writes_views_with_their_truth(tmp_path: Path) -> None:
    write_camera_info(tmp_path / "small.yaml", LENS, "small")
    words = [str(tmp_path / "out"), "--lens", str(tmp_path / "small.yaml"), "--views", "2", "--seed", "5"]
    charuco = ["--board", "charuco", "7x5", "--square", "0.03", "--marker", "0.02", "--dictionary", "4X4_50"]
    done = CliRunner().invoke(board_app, words + charuco)
    assert done.exit_code == 0, done.output
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["truth.json", "truth.yaml", "view00.png", "view01.png"]
    assert read_camera_info(tmp_path / "out" / "truth.yaml").model == LENS
    again = CliRunner().invoke(board_app, words)
    assert again.exit_code == 2
    assert "empty" in again.stderr
    pairs = [str(tmp_path / "pairs"), *words[1:], "--infrared", "plain"]
    done = CliRunner().invoke(board_app, pairs)
    assert done.exit_code == 0, done.output
    rig = read_camera_info(tmp_path / "pairs" / "depth.yaml").registration
    assert rig is not None
    assert (rig.depth.width, rig.colour) == (640, LENS)
    for camera in ("colour", "infrared"):
        assert len(list((tmp_path / "pairs" / camera).iterdir())) == 2


@pytest.fixture(scope="module")
def marker_images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A level marker before a level vehicle; the camera looks 30 degrees down, 4 aside, rolled by 2."""
    folder = tmp_path_factory.mktemp("marker")
    lens = CameraModel.from_horizontal_fov(640, 480, 1.2)
    write_camera_info(folder / "lens.yaml", lens, "lens")
    mount = CameraMount(roll_rad=np.radians(2.0), pitch_rad=np.radians(-30.0), yaw_rad=np.radians(4.0))
    plate = WorldObject(0, "plate", (2.0, 0.1, 0.0), 0.0, printed=Print("4X4_50", 7, 0.6))
    world = World((plate,), Ground(("concrete",), 0, 256, 0.05))
    renderer = Renderer(world, lens, mount, ImageEffects(noise_sigma=2.0), rng=np.random.default_rng(1))
    for number in range(5):
        image = renderer.render((0.0, 0.0, -1.2), matrix_from_euler(0.0, 0.0, 0.0)).image
        cv2.imwrite(str(folder / f"{number}.png"), image)
    return folder


def test_mount_is_printed_as_settings(marker_images: Path) -> None:
    words = ("--marker", "7", "--size", "0.6", "--calibration", marker_images / "lens.yaml")
    done = calibrate("mount", marker_images, *words)
    assert done.exit_code == 0, done.output
    values = dict(re.findall(r"^mount_(\w+)_deg = (\S+)$", done.stdout, re.MULTILINE))
    assert {key: float(value) for key, value in values.items()} == pytest.approx(
        {"roll": 2.0, "pitch": -30.0, "yaw": 4.0}, abs=0.3
    )


@pytest.mark.parametrize(("printed", "turned_deg"), [("opencv", 0.0), ("apriltag", 180.0)])
def test_mount_from_either_print_of_an_apriltag(tmp_path: Path, printed: str, turned_deg: float) -> None:
    """The simulated plate is OpenCV's print: AprilRobotics' with its upper edge aft."""
    lens = CameraModel.from_horizontal_fov(640, 480, 1.2)
    write_camera_info(tmp_path / "lens.yaml", lens, "lens")
    yaw = math.radians(turned_deg)
    plate = WorldObject(0, "plate", (2.0, 0.1, 0.0), yaw, printed=Print("APRILTAG_36h11", 7, 0.6))
    mount = CameraMount(pitch_rad=np.radians(-30.0), yaw_rad=np.radians(4.0))
    renderer = Renderer(World((plate,), Ground(("concrete",), 0, 256, 0.05)), lens, mount)
    image = renderer.render((0.0, 0.0, -1.2), matrix_from_euler(0.0, 0.0, 0.0)).image
    cv2.imwrite(str(tmp_path / "0.png"), image)
    words = ("--marker", "7", "--size", "0.6", "--calibration", tmp_path / "lens.yaml")
    done = calibrate("mount", tmp_path, *words, "--dictionary", "APRILTAG_36h11", "--print", printed)
    values = dict(re.findall(r"^mount_(\w+)_deg = (\S+)$", done.stdout, re.MULTILINE))
    assert float(values["yaw"]) == pytest.approx(4.0, abs=0.5)


def test_mount_without_its_marker_or_lens(marker_images: Path) -> None:
    lens = ("--calibration", marker_images / "lens.yaml")
    assert "none" in one_line_of_bad_input(
        calibrate("mount", marker_images, "--marker", "9", "--size", "0.6", *lens)
    )
    line = one_line_of_bad_input(calibrate("mount", marker_images, "--marker", "7", "--size", "0.6"))
    assert "--calibration" in line
    write_camera_info(other := marker_images / "other.yaml", LENSES["plain"].scaled(640, 360), "other")
    wide = ("--calibration", other)
    line = one_line_of_bad_input(calibrate("mount", marker_images, "--marker", "7", "--size", "0.6", *wide))
    assert "640x360" in line
    assert "640x480" in line


@pytest.mark.parametrize("flag", ["--heading", "--roll", "--pitch"])
def test_angle_that_is_no_number_is_refused(flag: str) -> None:
    done = calibrate("mount", "none", "--marker", "7", "--size", "0.6", flag, "nan")
    assert one_line_of_bad_input(done).startswith(f"companion: {flag} ")


def test_missing_output_folder_is_refused_before_source_opens(tmp_path: Path) -> None:
    output = tmp_path / "no" / "camera.yaml"
    line = one_line_of_bad_input(calibrate("none", *BOARD_WORDS, "-o", output))
    assert f" write {output}: " in line
    assert line.endswith("such folder")


def test_live_camera_without_the_marker_says_what_it_sees(
    marker_images: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(calibrate_module, "_MISSING_S", 0.0)
    image = cv2.imread(str(marker_images / "0.png"))
    assert image is not None
    frames = iter([np.zeros_like(image, np.uint8), np.asarray(image, np.uint8)])
    live = Live()
    live._frames = (Frame(image, number, number) for number, image in enumerate(frames))
    live._interrupt_after = 2
    kind, lens = MarkerKind("4X4_50", 0.6), read_camera_info(marker_images / "lens.yaml").model
    lines: list[str] = []
    assert markers_of(live, kind, 9, lens, 1, lines.append) == ([], [])
    assert ["marker 9" in line for line in lines] == [True] * 3
    assert [line.rpartition(": ")[2] for line in lines[1:]] == ["no marker", "7"]


def live_marker(marker_images: Path) -> Live:
    """A live source of the marker, without end."""
    image = np.asarray(cv2.imread(str(marker_images / "0.png")), np.uint8)
    live = Live()
    live._frames = (Frame(image, number, number) for number in itertools.count())
    return live


def vehicle_text(roll: float, pitch: float) -> str:
    return json.dumps({"attitude_wxyz": quaternion_from_euler(roll, pitch, 1.0)})


def test_live_tilt_is_the_newest_attitude_until_it_is_stale() -> None:
    now_s = 10.0
    tilt = LiveTilt(lambda: now_s)
    assert tilt() is None
    tilt.on_message("companion/alpha/vehicle", vehicle_text(0.2, -0.1))
    assert tilt() == pytest.approx((0.2, -0.1))
    tilt.on_message("companion/alpha/vehicle", '{"attitude_wxyz": null}')
    now_s = 10.4
    assert tilt() == pytest.approx((0.2, -0.1))
    now_s = 10.6
    assert tilt() is None


def test_frames_without_an_attitude_are_not_used(
    marker_images: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(calibrate_module, "_MISSING_S", 0.0)
    tilts = iter([None, (0.1, 0.0), None, (0.0, 0.1)])
    kind, lens = MarkerKind("4X4_50", 0.6), read_camera_info(marker_images / "lens.yaml").model
    lines: list[str] = []
    found = markers_of(live_marker(marker_images), kind, 7, lens, 2, lines.append, lambda: next(tilts))
    assert [marker.identifier for marker in found[0]] == [7, 7]
    assert found[1] == [(0.1, 0.0), (0.0, 0.1)]
    assert ["attitude" in line for line in lines] == [False, True, True]


@pytest.mark.realtime
def test_mount_uses_the_attitude_of_the_running_service(
    marker_images: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    ended = threading.Event()

    def publish(session: zenoh.Session) -> None:
        while not ended.wait(0.05):
            session.put("companion/alpha/vehicle", vehicle_text(0.0, math.radians(6.0)))

    monkeypatch.setattr("vision.sources.open_source", lambda *_: live_marker(marker_images))
    words = ("--marker", "7", "--size", "0.6", "--calibration", marker_images / "lens.yaml", "--frames", "5")
    with zenoh.open(zenoh_config(ZenohSection(listen=(endpoint,)))) as session:
        publisher = threading.Thread(target=publish, args=(session,))
        publisher.start()
        try:
            done = calibrate(
                "mount", "test://board", *words, "--live", "--connect", endpoint, "--vehicle-name", "alpha"
            )
        finally:
            ended.set()
            publisher.join()
    assert done.exit_code == 0, done.output
    values = dict(re.findall(r"^mount_(\w+)_deg = (\S+)$", done.stdout, re.MULTILINE))
    # Nose up by 6 degrees: the camera looks down by as much more on the body.
    assert float(values["pitch"]) == pytest.approx(-36.0, abs=0.4)


@pytest.mark.parametrize(
    ("flags", "named"),
    [(("--live",), "--pitch"), (("--live", "--roll", "2"), "--roll"), (("--connect", "tcp/x"), "--live")],
)
def test_live_attitude_where_there_is_none_is_refused(
    marker_images: Path, flags: tuple[str, ...], named: str
) -> None:
    done = calibrate("mount", marker_images, "--marker", "7", "--size", "0.6", *flags)
    assert named in one_line_of_bad_input(done)
