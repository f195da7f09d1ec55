"""`companion cameras` and `companion preview`."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from companion.preview import PreviewOptions, RateMeter, preview_source
from tests.companion.command_line import companion
from vision.sources import open_source

pytestmark = pytest.mark.realtime


@pytest.fixture
def pictures(tmp_path: Path) -> Path:
    folder = tmp_path / "pictures"
    folder.mkdir()
    for index in range(4):
        image = np.full((240, 480, 3), (200, 40, 40), np.uint8)
        cv2.imwrite(str(folder / f"{index}.png"), image)
    return folder


def test_rate_counts_lost_frames() -> None:
    meter = RateMeter()
    assert meter.add(1_000_000_000, 10) is None
    assert meter.add(1_100_000_000, 13) == pytest.approx(30.0)
    for index in range(100):  # a slower rate after the window
        rate_hz = meter.add(1_200_000_000 + index * 100_000_000, 14 + index)
    assert rate_hz == pytest.approx(10.0)


@pytest.mark.parametrize(("grey", "shape"), [(False, (240, 480, 3)), (True, (80, 160, 3))])
def test_every_frame_is_saved_with_its_lines(
    pictures: Path, tmp_path: Path, grey: bool, shape: tuple[int, ...]
) -> None:
    lines: list[str] = []
    with open_source(str(pictures)) as source:
        options = PreviewOptions("companion/v/image", tmp_path / "out", grey, period_s=0.0)
        assert preview_source(source, options, lines.append) == 4
    assert len(lines) == 4
    assert all(f"{pictures}  companion/v/image  480x240" in line for line in lines)
    assert "Hz" in lines[1]
    saved = sorted((tmp_path / "out").iterdir())
    assert [path.name for path in saved] == ["000000.jpg", "000001.jpg", "000002.jpg", "000003.jpg"]
    image = cv2.imread(str(saved[0]))
    assert image is not None
    assert image.shape == shape
    # The panel of lines is at the upper left, the picture's colour below it.
    below = image[-1, -1].astype(int)
    assert np.ptp(below) < 8 if grey else abs(below - (200, 40, 40)).max() < 8
    assert image[: shape[0] // 3, : shape[1] // 3].std() > 20


def test_preview_of_a_rotated_source(pictures: Path, tmp_path: Path) -> None:
    done = companion(
        "preview", pictures, "--limit", "2", "--period", "0", "--source-rotate-deg", "90",
        "--source-name", "front", "--vehicle-name", "alpha", cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == 2
    assert lines[0].startswith(f"front ({pictures})  companion/alpha/image  240x480")


def test_bad_source_of_preview_is_one_line(tmp_path: Path) -> None:
    done = companion("preview", "/dev/video98765", cwd=tmp_path)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("companion: /dev/video98765: no such camera")


def test_cameras_are_one_json_object(tmp_path: Path) -> None:
    done = companion("cameras", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    listed = json.loads(done.stdout)
    assert set(listed) == {"devices", "csi"}
    assert [device["path"] for device in listed["devices"]] == sorted(
        map(str, Path("/dev").glob("video[0-9]*")), key=lambda path: int(path.removeprefix("/dev/video"))
    )
    assert companion("cameras", cwd=tmp_path).returncode == 0
