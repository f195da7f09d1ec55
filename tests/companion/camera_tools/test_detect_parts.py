"""`companion detect`: what a source delivers, level images, depth; `companion describe cameras`."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from companion.camera_tools.detect import RateMeter
from companion.host.passing import EXIT_PASSING
from mavlink_sim.testing import free_udp_ports, vehicle
from tests.companion.bus.message_check import check_message
from tests.companion.command_line import companion, companion_here

pytestmark = pytest.mark.realtime

STATUS = ("detect", "--model", "none")
DEPTH = (*STATUS, "--depth")


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
    done = companion_here(*STATUS, image_folder / "2.png", "--save", "out", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (line,) = done.stdout.splitlines()
    assert "480x240  stamp" in line
    assert [path.name for path in (tmp_path / "out" / "detections").iterdir()] == ["2.png"]


@pytest.mark.parametrize(("grey", "shape"), [(False, (240, 480, 3)), (True, (80, 160, 3))])
def test_every_frame_is_saved_with_its_lines(
    image_folder: Path, tmp_path: Path, grey: bool, shape: tuple[int, ...]
) -> None:
    options = ("--save", "out", "--period", "0", "--vehicle-name", "v", *(("--grey",) if grey else ()))
    done = companion_here(*STATUS, image_folder, *options, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == 4
    assert all(f"{image_folder}  companion/v/image  480x240" in line for line in lines)
    assert "Hz" in lines[1]
    saved = sorted((tmp_path / "out" / "detections").iterdir())
    assert [path.name for path in saved] == ["0.png", "1.png", "2.png", "3.png"]
    image = cv2.imread(str(saved[0]))
    assert image is not None
    assert image.shape == shape
    # The panel of lines is at the upper left, the image's colour below it.
    below = image[-1, -1].astype(int)
    assert np.ptp(below) < 8 if grey else abs(below - (200, 40, 40)).max() < 8
    assert image[: shape[0] // 3, : shape[1] // 3].std() > 20


def test_a_grey_image_with_depth_is_saved(image_folder: Path, depth: Path, tmp_path: Path) -> None:
    options = ("--source-depth", depth, "--grey", "--save", "out", "--limit", "1")
    done = companion_here(*STATUS, image_folder, *options, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    (path,) = (tmp_path / "out" / "detections").iterdir()
    image = cv2.imread(str(path))
    assert image is not None
    assert image.shape == (80, 160, 3)


def test_status_of_a_turned_source_is_also_json(image_folder: Path, tmp_path: Path) -> None:
    options = (
        *("--limit", "2", "--period", "0", "--source-rotate-deg", "90", "--source-name", "front"),
        *("--vehicle-name", "alpha"),
    )
    done = companion_here(*STATUS, image_folder, *options, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert len(lines) == 2
    assert lines[0].split()[:5] == ["0.png", "front", f"({image_folder})", "companion/alpha/image", "240x480"]
    messages = map(
        json.loads,
        companion_here(*STATUS, image_folder, *options, "--json", cwd=tmp_path).stdout.splitlines(),
    )
    for message in messages:
        assert (message["topic"], message["width"], message["height"]) == ("companion/alpha/image", 240, 480)
        assert (message["dropped"], message["unreadable"]) == (0, 0)


def test_missing_camera_is_one_line(tmp_path: Path) -> None:
    done = companion_here(*STATUS, "/dev/video98765", cwd=tmp_path)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert line.startswith("companion: /dev/video98765: ")
    assert "such camera" in line


def test_images_are_levelled_by_the_attitude_of_the_vehicle(image_folder: Path, tmp_path: Path) -> None:
    with vehicle() as simulator:
        done = companion(
            *STATUS, image_folder, "--level", "--save", tmp_path / "out", "--period", "0", "--limit", "15",
            "--vehicle-url", simulator.mavsdk_url, "--camera-mount-roll-deg", "30", "--source-rate-hz", "5",
            "--source-loop", "true", cwd=tmp_path,
        )  # fmt: skip
    assert done.returncode == 0, done.stderr
    images = [cv2.imread(str(path)) for path in sorted((tmp_path / "out" / "detections").iterdir())]
    assert len(images) == 4  # the folder is repeated, and an image keeps its name
    # Turned by 30 degrees: the image's blue in the middle, black in the corners. On a busy computer an
    # attitude may be late, so not every one of them.
    turned = [image for image in images if image is not None and image[-1, (0, -1)].max() < 8]
    assert turned
    assert abs(turned[0][120, 300].astype(int) - (200, 40, 40)).max() < 8


def test_images_without_an_autopilot_cannot_be_levelled(image_folder: Path, tmp_path: Path) -> None:
    options = ("--level", "--save", "out", "--vehicle-connect-timeout-s", "0.3")
    url = f"udpin://127.0.0.1:{free_udp_ports(1)[0]}"
    done = companion_here(*STATUS, image_folder, *options, "--vehicle-url", url, cwd=tmp_path)
    assert done.returncode == EXIT_PASSING
    (line,) = done.stderr.splitlines()
    assert "no autopilot heartbeat" in line


def test_cameras_are_one_json_object(tmp_path: Path) -> None:
    done = companion_here("describe", "cameras", "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    listed = json.loads(done.stdout)
    assert set(listed) == {"devices", "csi"}
    assert [device["path"] for device in listed["devices"]] == sorted(
        map(str, Path("/dev").glob("video[0-9]*")), key=lambda path: int(path.removeprefix("/dev/video"))
    )
    assert companion_here("describe", "cameras", cwd=tmp_path).returncode == 0


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


def test_depth_prints_the_messages_of_its_topics(image_folder: Path, depth: Path, tmp_path: Path) -> None:
    done = companion_here(
        *DEPTH, image_folder, "--source-depth", depth, "--json", "--save", tmp_path / "out", cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    messages = [json.loads(line) for line in done.stdout.splitlines()]
    assert [message["depth"]["centre_m"] for message in messages] == [3.42, 3.421, 3.422, 3.423]
    for message in messages:
        check_message("depth", message["depth"])
        check_message("obstacles", message["obstacles"])
        assert message["obstacles"]["distance_m"][0] == pytest.approx(3.42, abs=0.02)
        assert message["depth"]["valid_share"] == 0.75
        assert message["depth"]["boxes"] == []
        assert "detections" not in message
    image = cv2.imread(str(tmp_path / "out" / "detections" / "0.png"))
    assert image is not None
    blue, green, red = image[120, 240].tolist()
    assert red > 200
    assert max(blue, green) < 90


def test_depth_of_detections(image_folder: Path, depth: Path, tmp_path: Path, exported_model: Path) -> None:
    done = companion_here(
        "detect", image_folder, "--source-depth", depth, "--source-depth-scale", "0.002", "--limit", "1",
        "--json", "--depth", "--model", exported_model, "--runtime", "onnxruntime", "--confidence", "0",
        "--image-size", "160", cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    (message,) = map(json.loads, done.stdout.splitlines())
    assert message["depth"]["centre_m"] == 6.84
    assert len(message["depth"]["boxes"]) == len(message["detections"]) > 0
    known = [found["depth_m"] for found in message["detections"] if found["depth_m"] is not None]
    assert known
    assert all(depth_m == pytest.approx(6.84, abs=0.01) for depth_m in known)


def test_source_without_usable_depth_is_one_line(image_folder: Path, depth: Path, tmp_path: Path) -> None:
    small = tmp_path / "small"
    small.mkdir()
    cv2.imwrite(str(small / "0.png"), np.full((24, 48), 1000, np.uint16))
    cv2.imwrite(str(tmp_path / "far.tiff"), np.full((240, 480), 3420.0, np.float32))
    cases: tuple[tuple[list[str | Path], str], ...] = (
        ([], "no depth"),
        (["--source-depth", small], "depth is 48x24, the image 480x240"),
        (["--source-depth", tmp_path / "far.tiff"], "source.depth_scale"),
        (["--source-depth", image_folder], "16-bit integers or floats"),
        (["--source-depth", tmp_path / "nothing"], "no such file"),
    )
    for options, words in cases:
        done = companion_here(*DEPTH, image_folder, *options, cwd=tmp_path)
        assert done.returncode == 2, done.stdout
        (line,) = done.stderr.splitlines()
        assert words in line
    assert depth.is_dir()
