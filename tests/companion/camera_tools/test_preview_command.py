"""`companion cameras`, `companion preview` and `companion depth`."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from companion.camera_tools.preview import PreviewOptions, RateMeter, preview_source
from mavlink_sim.testing import free_udp_ports, vehicle
from tests.companion.bus.message_check import check_message
from tests.companion.command_line import companion, companion_here
from vision.sources import SourceSettings, open_source

pytestmark = pytest.mark.realtime


@pytest.fixture
def image_folder(tmp_path: Path) -> Path:
    folder = tmp_path / "images"
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


def test_rate_of_a_slow_source_is_of_its_last_two_frames() -> None:
    meter = RateMeter()
    meter.add(0, 0)
    for index in range(1, 4):
        assert meter.add(index * 5_000_000_000, index) == pytest.approx(0.2)


def test_single_image_is_shown_and_saved(image_folder: Path, tmp_path: Path) -> None:
    lines: list[str] = []
    with open_source(str(image_folder / "2.png")) as source:
        assert preview_source(source, PreviewOptions("v/image", tmp_path / "out"), lines.append) == 1
    assert len(lines) == 1
    assert "480x240  stamp" in lines[0]
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["000000.jpg"]


@pytest.mark.parametrize(("grey", "shape"), [(False, (240, 480, 3)), (True, (80, 160, 3))])
def test_every_frame_is_saved_with_its_lines(
    image_folder: Path, tmp_path: Path, grey: bool, shape: tuple[int, ...]
) -> None:
    lines: list[str] = []
    with open_source(str(image_folder)) as source:
        options = PreviewOptions("companion/v/image", tmp_path / "out", grey, period_s=0.0)
        assert preview_source(source, options, lines.append) == 4
    assert len(lines) == 4
    assert all(f"{image_folder}  companion/v/image  480x240" in line for line in lines)
    assert "Hz" in lines[1]
    saved = sorted((tmp_path / "out").iterdir())
    assert [path.name for path in saved] == ["000000.jpg", "000001.jpg", "000002.jpg", "000003.jpg"]
    image = cv2.imread(str(saved[0]))
    assert image is not None
    assert image.shape == shape
    # The panel of lines is at the upper left, the image's colour below it.
    below = image[-1, -1].astype(int)
    assert np.ptp(below) < 8 if grey else abs(below - (200, 40, 40)).max() < 8
    assert image[: shape[0] // 3, : shape[1] // 3].std() > 20


def test_a_grey_image_with_depth_is_saved(tmp_path: Path) -> None:
    (tmp_path / "colour").mkdir()
    (tmp_path / "depth").mkdir()
    assert cv2.imwrite(str(tmp_path / "colour" / "0.png"), np.full((240, 480, 3), 90, np.uint8))
    assert cv2.imwrite(str(tmp_path / "depth" / "0.png"), np.full((240, 480), 4000, np.uint16))
    settings = SourceSettings(depth=str(tmp_path / "depth"))
    with open_source(str(tmp_path / "colour"), settings) as source:
        options = PreviewOptions("v/image", tmp_path / "out", True, period_s=0.0)
        assert preview_source(source, options, lambda _: None) == 1
    image = cv2.imread(str(tmp_path / "out" / "000000.jpg"))
    assert image is not None
    assert image.shape == (80, 160, 3)


def test_preview_of_a_rotated_source(image_folder: Path, tmp_path: Path) -> None:
    done = companion_here(
        "preview", image_folder, "--limit", "2", "--period", "0", "--source-rotate-deg", "90",
        "--source-name", "front", "--vehicle-name", "alpha", cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == 2
    assert lines[0].startswith(f"front ({image_folder})  companion/alpha/image  240x480")


def test_bad_source_of_preview_is_one_line(tmp_path: Path) -> None:
    done = companion_here("preview", "/dev/video98765", cwd=tmp_path)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("companion: /dev/video98765: ")
    assert "such camera" in line


def test_preview_is_levelled_by_the_attitude_of_the_vehicle(image_folder: Path, tmp_path: Path) -> None:
    with vehicle() as simulator:
        done = companion(
            "preview", image_folder, "--level", "--save", tmp_path / "out", "--period", "0", "--limit", "15",
            "--vehicle-url", simulator.mavsdk_url, "--camera-mount-roll-deg", "30", "--source-rate-hz", "5",
            "--source-loop", "true", cwd=tmp_path,
        )  # fmt: skip
    assert done.returncode == 0, done.stderr
    images = [cv2.imread(str(path)) for path in sorted((tmp_path / "out").iterdir())]
    assert len(images) == 15
    # Turned by 30 degrees: the image's blue in the middle, black in the corners. On a busy computer an
    # attitude may be late, so not every one of them.
    turned = [image for image in images if image is not None and image[-1, (0, -1)].max() < 8]
    assert turned
    assert abs(turned[0][120, 300].astype(int) - (200, 40, 40)).max() < 8


@pytest.mark.parametrize(
    ("options", "part", "code"),
    [
        (("--level",), "--save DIR", 2),
        (("--level", "--save", "out", "--vehicle-connect-timeout-s", "0.3"), "no autopilot heartbeat", 75),
    ],
)
def test_preview_that_cannot_be_levelled_is_one_line(
    image_folder: Path, tmp_path: Path, options: tuple[str, ...], part: str, code: int
) -> None:
    url = f"udpin://127.0.0.1:{free_udp_ports(1)[0]}"
    done = companion_here("preview", image_folder, *options, "--vehicle-url", url, cwd=tmp_path)
    assert done.returncode == code
    (line,) = done.stderr.splitlines()
    assert part in line


def test_cameras_are_one_json_object(tmp_path: Path) -> None:
    done = companion("cameras", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    listed = json.loads(done.stdout)
    assert set(listed) == {"devices", "csi"}
    assert [device["path"] for device in listed["devices"]] == sorted(
        map(str, Path("/dev").glob("video[0-9]*")), key=lambda path: int(path.removeprefix("/dev/video"))
    )
    assert companion_here("cameras", cwd=tmp_path).returncode == 0


@pytest.fixture
def depth(image_folder: Path) -> Path:
    """Depth of the images: 3.42 m and more, with a hole of a quarter."""
    folder = image_folder.parent / "depth"
    folder.mkdir()
    for index in range(4):
        image = np.full((240, 480), 3420 + index, np.uint16)
        image[:, :120] = 0
        cv2.imwrite(str(folder / f"{index}.png"), image)
    return folder


def test_depth_prints_the_messages_of_its_topic(image_folder: Path, depth: Path, tmp_path: Path) -> None:
    done = companion(
        "depth", image_folder, "--source-depth", depth, "--json", "--save", tmp_path / "out", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    messages = [json.loads(line) for line in done.stdout.splitlines()]
    assert [message["centre_m"] for message in messages] == [3.42, 3.421, 3.422, 3.423]
    for message in messages:
        check_message("depth", message)
        assert message["valid_share"] == 0.75
        assert message["boxes"] == []
    image = cv2.imread(str(tmp_path / "out" / "000000.jpg"))
    assert image is not None
    blue, green, red = image[120, 240].tolist()
    assert red > 200
    assert max(blue, green) < 90


def test_depth_of_detections(image_folder: Path, depth: Path, tmp_path: Path, exported_model: Path) -> None:
    done = companion(
        "depth", image_folder, "--source-depth", depth, "--source-depth-scale", "0.002", "--limit", "1",
        "--json", "--detect", "--detector-model", exported_model, "--detector-runtime", "onnxruntime",
        "--detector-confidence", "0",
        "--detector-image-size", "160", "--tracker-enabled", "false", cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    (message,) = map(json.loads, done.stdout.splitlines())
    assert message["centre_m"] == 6.84
    assert message["boxes"]
    known = [box["depth_m"] for box in message["boxes"] if box["depth_m"] is not None]
    assert known
    assert all(depth_m == pytest.approx(6.84, abs=0.01) for depth_m in known)


def test_source_without_usable_depth_is_one_line(image_folder: Path, depth: Path, tmp_path: Path) -> None:
    small = tmp_path / "small"
    small.mkdir()
    cv2.imwrite(str(small / "0.png"), np.full((24, 48), 1000, np.uint16))
    cv2.imwrite(str(tmp_path / "far.tiff"), np.full((240, 480), 3420.0, np.float32))
    cases: tuple[tuple[list[str | Path], str], ...] = (
        ([], "delivers no depth"),
        (["--source-depth", small], "depth is 48x24, the image 480x240"),
        (["--source-depth", tmp_path / "far.tiff"], "source.depth_scale"),
        (["--source-depth", image_folder], "16-bit integers or floats"),
        (["--source-depth", tmp_path / "nothing"], "no such file"),
    )
    for options, words in cases:
        done = companion_here("depth", image_folder, *options, cwd=tmp_path)
        assert done.returncode == 2, done.stdout
        (line,) = done.stderr.splitlines()
        assert words in line
    assert depth.is_dir()
