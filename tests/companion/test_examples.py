"""The examples; those that are plug-ins are installed as packages."""

from __future__ import annotations

import ast
import asyncio
import json
import math
import os
import queue
import re
import runpy
import subprocess
import sys
import time
from collections.abc import Callable, Coroutine, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import pytest

from benchmarks.scenes import MOTIONS, scene_frames
from companion import connect
from companion.bus.client import listen
from mavlink_sim.testing import QUICK_FLIGHT, RunningSimulator
from tests.companion.command_line import companion_here
from tests.companion.service_process import TWICE, running_service

EXAMPLES = Path(__file__).parents[2] / "examples"
CLIENT_PAGE = EXAMPLES.parent / "docs" / "how-to" / "client.md"
PLUGINS = ("--plugins-modules", "red,square")


def main_of(program: str, **constants: float) -> Callable[[str], Coroutine[Any, Any, None]]:
    """Its function `main`, with other values of its constants."""
    names: dict[str, Any] = {"__name__": "example"}
    exec(program, names)
    assert constants.keys() <= names.keys()
    names.update(constants)
    main: Callable[[str], Coroutine[Any, Any, None]] = names["main"]
    return main


def run_example(monkeypatch: pytest.MonkeyPatch, name: str, *arguments: str) -> None:
    """As `python NAME ARGUMENTS`; in this process, which saves its imports."""
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    runpy.run_path(str(EXAMPLES / name), run_name="__main__")


async def wait_until_it_can_take_off(endpoint: str) -> None:
    async with asyncio.timeout(30.0), connect(endpoint) as drone:
        async for state in drone.vehicle():
            known = (state["position_ned_m"], state["home_ned_m"], state["battery_fraction"])
            if None not in known and state["landed"] == "on_ground":
                return


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the plug-ins installed by pip."""
    pytest.importorskip("setuptools")
    folder = tmp_path_factory.mktemp("plugins")
    copies = []
    for name in ("circle", "detector", "source"):
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
    paths = [str(site), str(EXAMPLES.parent), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(paths))


COMMANDS = """
import json, sys
from pathlib import Path
from tests.companion.command_line import companion_here
for arguments in json.load(sys.stdin):
    done = companion_here(*arguments, cwd=Path.cwd())
    print(json.dumps([done.returncode, done.stdout, done.stderr]))
"""


def run_commands(*commands: Sequence[str], cwd: Path) -> Iterator[tuple[int, str, str]]:
    """Exit code, output and errors of `companion` with each of the arguments, in one process of its own."""
    program = [sys.executable, "-c", COMMANDS]
    done = subprocess.run(
        program, cwd=cwd, input=json.dumps(commands), capture_output=True, text=True, timeout=100, check=False
    )
    assert done.returncode == 0, done.stderr
    for line in done.stdout.splitlines():
        code, output, errors = json.loads(line)
        yield code, output, errors


@pytest.mark.parametrize("path", sorted(EXAMPLES.rglob("*.py")), ids=lambda path: path.name)
def test_example_is_short(path: Path) -> None:
    assert len(path.read_text().splitlines()) <= (45 if path.stem == "companion_circle_object" else 40)


@pytest.mark.realtime
@pytest.mark.usefixtures("installed")
def test_commands_find_the_square_and_classes_of_the_plugins(tmp_path: Path) -> None:
    kind = ("--detector-kind", "red", *PLUGINS)
    detect = ("detect", "square://320x240?rate=5", *kind, "--limit", "4", "--track", "--json")
    missions = []
    for name in ("blob", "car"):
        (tmp_path / f"{name}.toml").write_text(f"[[step]]\ndo = 'takeoff 3'\n[[step]]\ndo = 'seek {name}'\n")
        missions.append(("send", "--file", f"{name}.toml", "--check", *kind))
    (code, output, errors), *checks = run_commands(detect, *missions, cwd=tmp_path)
    assert code == 0, errors
    # The warning of the bundled model is about the built-in kind: the summary alone.
    (summary,) = [line for line in errors.splitlines() if "frames dropped" not in line]  # by a busy machine
    assert summary.startswith("companion: 4 frames, ")
    frames = [json.loads(line) for line in output.splitlines()]
    assert [(frame["width"], frame["height"]) for frame in frames] == [(320, 240)] * 4
    for frame in frames:
        (record,) = frame["detections"]
        left, top, right, bottom = record["xyxy"]
        assert (record["class_name"], right - left, bottom - top) == ("blob", 40, 40)
    assert frames[-1]["detections"][0]["track_state"] == "confirmed"
    assert frames[0]["detections"][0]["xyxy"] != frames[-1]["detections"][0]["xyxy"]
    assert [code for code, _, _ in checks] == [0, 2], checks


@pytest.mark.realtime
@pytest.mark.usefixtures("installed")
def test_invalid_plugin_options_are_one_line(tmp_path: Path) -> None:
    cases = [
        (("square://320x240", "--detector-kind", "red"), "'red'; known: yolo "),  # before red is loaded
        (("square://10x10", "--detector-kind", "red", *PLUGINS), "square://10x10: expected square://WIDTH"),
        (("circle://10x10", "--detector-kind", "red", *PLUGINS), "circle://; known: .* square"),
        (("square://320x240", "--detector-kind", "blue", *PLUGINS), "'blue'; known: yolo .* red "),
        (
            ("square://320x240", "--detector-kind", "red", "--classes", "car", *PLUGINS),
            "unknown class 'car'.*blob",
        ),
        (("square://320x240", "--plugins-modules", "rad"), "no module 'rad'.* red, square"),
    ]
    runs = run_commands(*(("detect", *arguments) for arguments, _ in cases), cwd=tmp_path)
    for (code, _, errors), (_, words) in zip(runs, cases, strict=True):
        assert code == 2
        assert len(errors.splitlines()) == 1
        assert re.search(words, errors), errors


@pytest.mark.realtime
@pytest.mark.usefixtures("installed")
@pytest.mark.vehicle.with_args(**TWICE)
@pytest.mark.timeout(200)
def test_service_detects_and_flies_by_plugins(
    vehicle: RunningSimulator,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    page = CLIENT_PAGE.read_text().partition("```python\n")[2].partition("```")[0]
    flags = ["--source", "square://320x240?rate=10", "--detector-kind", "red"]
    flags += ["--plugins-modules", "red,square,circle"]
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
        asyncio.run(main_of(page)(service.endpoint))
        names = ast.literal_eval(capsys.readouterr().out)
        run_example(monkeypatch, "subscribe.py", service.endpoint, "takeoff 2")
        # `send` does not know the command: the service does.
        sent = companion_here("send", "circle radius=4", "--connect", service.endpoint, cwd=tmp_path)
        assert sent.returncode == 0, sent.stdout + sent.stderr
        assert "accepted" in sent.stdout
        with service.client() as session:
            listen(session, "status", lambda _key, text: statuses.put(json.loads(text)))
            until_s = time.monotonic() + 30
            while (behaviour := statuses.get(timeout=30)["pilot"]["behaviour"]) != "circle":
                assert time.monotonic() < until_s, behaviour
    assert set(names) <= {"blob"}
    *lines, reply = capsys.readouterr().out.splitlines()
    assert reply.startswith("takeoff 2: done")
    assert lines
    pattern = re.compile(r"vehicle1 frame \d+: blob 0\.82 at \d+, \d+ px, track \d+")
    assert all(pattern.match(line) for line in lines)


@pytest.mark.realtime
@pytest.mark.vehicle(parameters=QUICK_FLIGHT)  # real time: it closes a loop of yaw at 10 Hz
@pytest.mark.timeout(200)
def test_square_is_flown_by_velocities(
    vehicle: RunningSimulator, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    # Twice as fast as the example: most of the time it flies.
    main = main_of((EXAMPLES / "steer.py").read_text(), SPEED_MPS=2.0, TURN_RADPS=1.6)
    with running_service(vehicle.onboard_port, ["--source", "none"], cwd=tmp_path) as service:
        asyncio.run(wait_until_it_can_take_off(service.endpoint))
        asyncio.run(main(service.endpoint))
    lines = capsys.readouterr().out.splitlines()
    corners = [ast.literal_eval(line.removeprefix("corner at ")) for line in lines]
    sides_m = [math.dist(one[:2], other[:2]) for one, other in pairwise(corners)]
    assert sides_m == pytest.approx([3.0] * 3, abs=0.6)
    assert math.hypot(*corners[-1][:2]) < 0.6  # where it began
    assert math.dist(corners[0][:2], corners[2][:2]) == pytest.approx(3.0 * math.sqrt(2), abs=0.6)


def test_video_is_detected_and_tracked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = str(tmp_path / "video.avi")
    video = cv2.VideoWriter(path, cv2.VideoWriter.fourcc(*"MJPG"), 5.0, (640, 480))
    for frame in scene_frames(MOTIONS[0], seconds=1.0, rate_hz=5.0):
        video.write(frame.image)
    video.release()
    run_example(monkeypatch, "detect_video.py", path)
    output = capsys.readouterr().out
    found = re.findall(r"^ +([\d.]+) s  (\w+) #(\d+) \d\.\d\d at \d", output, re.MULTILINE)
    assert {name for _, name, _ in found} & {"car", "person", "truck", "dog"}
    # The same track id in several frames.
    assert len({(name, number) for _, name, number in found}) < len(found)


def test_example_of_tests_passes() -> None:
    tests = runpy.run_path(str(EXAMPLES / "test_with_vehicle.py"))
    flights = [test for name, test in tests.items() if name.startswith("test_")]
    assert len(flights) == 2
    for flight in flights:
        flight()
