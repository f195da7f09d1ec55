"""The examples; those that are plug-ins are installed as packages."""

from __future__ import annotations

import ast
import asyncio
import json
import math
import os
import queue
import re
import subprocess
import sys
from collections.abc import Callable, Coroutine
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import pytest

from benchmarks.scenes import MOTIONS, scene_frames
from companion import connect
from companion.bus.client import listen
from mavlink_sim.testing import QUICK_FLIGHT, RunningSimulator
from tests.companion.command_line import companion
from tests.companion.service_process import TWICE, running_service

pytestmark = pytest.mark.realtime

EXAMPLES = Path(__file__).parents[2] / "examples"
CLIENT_PAGE = EXAMPLES.parent / "docs" / "how-to" / "client.md"
PLUGINS = ("--plugins-modules", "red,square")


def main_of(page: Path) -> Callable[[str], Coroutine[Any, Any, None]]:
    """The function `main` of the page's first program."""
    names: dict[str, Any] = {}
    block = page.read_text().partition("```python\n")[2].partition("```")[0]
    exec(compile(block, page.name, "exec"), names)
    main: Callable[[str], Coroutine[Any, Any, None]] = names["main"]
    return main


def run_python(*arguments: str | Path, cwd: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, *map(str, arguments)]
    return subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=100, check=False)


async def wait_until_it_can_take_off(endpoint: str) -> None:
    async with asyncio.timeout(30.0), connect(endpoint) as drone:
        async for state in drone.vehicle():
            known = (state["position_ned_m"], state["home_ned_m"], state["battery_fraction"])
            if None not in known and state["landed"] == "on_ground":
                return


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the source and the detector installed by pip."""
    pytest.importorskip("setuptools")
    folder = tmp_path_factory.mktemp("plugins")
    copies = []
    for name in ("detector", "source"):
        (folder / name).mkdir()
        for file in (EXAMPLES / name).iterdir():
            if file.is_file():
                (folder / name / file.name).write_bytes(file.read_bytes())
        copies.append(str(folder / name))
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, "--no-index", "--target", str(folder / "site"), *copies], check=True, timeout=100)
    return folder / "site"


@pytest.fixture
def installed(site: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make them importable in processes of the test."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(site), os.environ.get("PYTHONPATH", "")]))


@pytest.mark.parametrize("path", sorted(EXAMPLES.rglob("*.py")), ids=lambda path: path.name)
def test_example_has_at_most_forty_lines(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= 40


@pytest.mark.usefixtures("installed")
def test_detect_finds_the_square_of_the_plugins(tmp_path: Path) -> None:
    options = ("--detector-kind", "red", *PLUGINS, "--limit", "4", "--track", "--json")
    done = companion("detect", "square://320x240?rate=20", *options, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    # The warning of the bundled model is about the built-in kind: the summary alone.
    (summary,) = done.stderr.splitlines()
    assert summary.startswith("companion: 4 frames, ")
    frames = [json.loads(line) for line in done.stdout.splitlines()]
    assert [(frame["width"], frame["height"]) for frame in frames] == [(320, 240)] * 4
    for frame in frames:
        (record,) = frame["detections"]
        left, top, right, bottom = record["xyxy"]
        assert (record["class_name"], right - left, bottom - top) == ("blob", 40, 40)
    assert frames[-1]["detections"][0]["track_state"] == "confirmed"
    assert frames[0]["detections"][0]["xyxy"] != frames[-1]["detections"][0]["xyxy"]


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("square://10x10", "--detector-kind", "red", *PLUGINS), "square://10x10: expected square://WIDTH"),
        (("circle://10x10", "--detector-kind", "red", *PLUGINS), "circle://; known: .* square"),
        (("square://320x240", "--detector-kind", "blue", *PLUGINS), "'blue'; known: yolo .* red "),
        (("square://320x240", "--detector-kind", "red"), "'red'; known: yolo "),
        (
            ("square://320x240", "--detector-kind", "red", "--classes", "car", *PLUGINS),
            "no class 'car'.*blob",
        ),
        (("square://320x240", "--plugins-modules", "rad"), "no module 'rad'.* red, square"),
    ],
)
def test_invalid_plugin_options_are_one_line(arguments: tuple[str, ...], words: str, tmp_path: Path) -> None:
    done = companion("detect", *arguments, cwd=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert re.search(words, done.stderr), done.stderr


@pytest.mark.usefixtures("installed")
def test_mission_is_checked_for_the_classes_of_the_plugin(tmp_path: Path) -> None:
    options = ("--check", "--detector-kind", "red", *PLUGINS)
    for name, code in (("blob", 0), ("car", 2)):
        (tmp_path / "m.toml").write_text(f"[[step]]\ndo = 'takeoff 3'\n[[step]]\ndo = 'seek {name}'\n")
        done = companion("mission", "m.toml", *options, cwd=tmp_path)
        assert done.returncode == code, done.stderr


@pytest.mark.usefixtures("installed")
@pytest.mark.vehicle.with_args(**TWICE)
@pytest.mark.timeout(200)
def test_service_publishes_detections_of_plugins(
    vehicle: RunningSimulator, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    flags = [*("--source", "square://320x240?rate=10", "--detector-kind", "red"), *PLUGINS]
    with running_service(vehicle.onboard_port, flags, cwd=tmp_path) as service:
        with service.client() as session:
            detections: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
            statuses: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
            listen(session, "detections", lambda _key, text: detections.put(json.loads(text)))
            listen(session, "status", lambda _key, text: statuses.put(json.loads(text)))
            frame = detections.get(timeout=30)
            perception = statuses.get(timeout=30)["perception"]
        assert [record["class_name"] for record in frame["detections"]] == ["blob"]
        assert frame["timing_ms"]["inference"] > 0
        assert (perception["state"], perception["runtime"]) == ("running", None)
        assert perception["class_names"] == ["blob"]
        assert "1 classes" in service.wait_for_line("model red ")
        asyncio.run(wait_until_it_can_take_off(service.endpoint))
        asyncio.run(main_of(CLIENT_PAGE)(service.endpoint))
        names = ast.literal_eval(capsys.readouterr().out)
        done = run_python(EXAMPLES / "subscribe.py", service.endpoint, "takeoff 2", cwd=tmp_path)
    assert set(names) <= {"blob"}
    assert done.returncode == 0, done.stderr
    *lines, reply = done.stdout.splitlines()
    assert reply.startswith("takeoff 2: done")
    assert lines
    pattern = re.compile(r"vehicle1 frame \d+: blob 0\.82 at \d+, \d+ px, track \d+")
    assert all(pattern.match(line) for line in lines)


@pytest.mark.vehicle(parameters=QUICK_FLIGHT)  # real time: it closes a loop of yaw at 10 Hz
@pytest.mark.timeout(200)
def test_square_is_flown_by_velocities(vehicle: RunningSimulator, tmp_path: Path) -> None:
    with running_service(vehicle.onboard_port, ["--source", "none"], cwd=tmp_path) as service:
        asyncio.run(wait_until_it_can_take_off(service.endpoint))
        done = run_python(EXAMPLES / "steer.py", service.endpoint, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    corners = [ast.literal_eval(line.removeprefix("corner at ")) for line in done.stdout.splitlines()]
    sides_m = [math.dist(one[:2], other[:2]) for one, other in pairwise(corners)]
    assert sides_m == pytest.approx([3.0] * 3, abs=0.6)
    assert math.hypot(*corners[-1][:2]) < 0.6  # where it began
    assert math.dist(corners[0][:2], corners[2][:2]) == pytest.approx(3.0 * math.sqrt(2), abs=0.6)


def test_video_is_detected_and_tracked(tmp_path: Path) -> None:
    video = cv2.VideoWriter(str(tmp_path / "video.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 5.0, (640, 480))
    for frame in scene_frames(MOTIONS[0], seconds=1.6, rate_hz=5.0):
        video.write(frame.image)
    video.release()
    done = run_python(EXAMPLES / "detect_video.py", "video.avi", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    found = re.findall(r"^ +([\d.]+) s  (\w+) #(\d+) \d\.\d\d at \d", done.stdout, re.MULTILINE)
    assert {name for _, name, _ in found} & {"car", "person", "truck", "dog"}
    # The same track id in several frames.
    assert len({(name, number) for _, name, number in found}) < len(found)


def test_example_of_tests_passes(tmp_path: Path) -> None:
    copy = tmp_path / "test_with_vehicle.py"
    copy.write_bytes((EXAMPLES / copy.name).read_bytes())
    done = run_python("-m", "pytest", "-q", "-p", "no:cacheprovider", copy, cwd=tmp_path)
    assert done.returncode == 0, done.stdout
    assert "2 passed" in done.stdout
