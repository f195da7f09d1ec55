"""`companion play` as a process, in real time."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh

from companion.bus.client import send_command
from companion.bus.config import EndpointTakenError
from companion.bus.topics import DETECTIONS
from companion.settings import Settings, ZenohSection
from companion.simulation.play import PlayOptions, play
from companion.simulation.session import SimSessionError
from mavlink_sim.testing import free_port, running_simulator, vehicle
from tests.companion.command_line import QUICK, companion, companion_here
from tests.companion.service_process import TWICE, ServiceProcess

pytestmark = pytest.mark.realtime

READY = "Ctrl-C ends it"


@contextmanager
def playing(folder: Path, *flags: str, quick: bool = True) -> Iterator[ServiceProcess]:
    """A running `companion play` that is ready for commands; not quick: exactly as a user starts it."""
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    program = ("-c", QUICK) if quick else ("-m", "companion.cli")
    process = subprocess.Popen(
        [
            *(sys.executable, *program, "play", "--zenoh-listen", endpoint),
            *("--dashboard-listen", "", *flags),
        ],
        cwd=folder,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
    )
    running = ServiceProcess(process, endpoint)
    try:
        running.wait_for_line(READY, 90.0)
        yield running
    finally:
        running.stop()
        assert process.stdout is not None
        process.stdout.close()


def descendants(pid: int) -> set[int]:
    """Return the process ids of all descendants."""
    parents: dict[int, int] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rpartition(") ")[2].split()
            except OSError:
                continue
            parents[int(entry.name)] = int(fields[1])
    found: set[int] = set()
    newest = {pid}
    while newest:
        newest = {child for child, parent in parents.items() if parent in newest} - found
        found |= newest
    return found


def is_simulator(pid: int) -> bool:
    """Whether a process simulates vehicles, not a camera."""
    words = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
    return b"mavlink_sim" in words and b"camera" not in words


def until_gone(pids: set[int], timeout_s: float = 10.0) -> set[int]:
    deadline_s = time.monotonic() + timeout_s
    while (left := {pid for pid in pids if Path(f"/proc/{pid}").exists()}) and time.monotonic() < deadline_s:
        time.sleep(0.05)
    return left


@pytest.fixture
def small(exported_model: Path, tmp_path: Path) -> list[str]:
    """Flags for a scene and a model that cost little."""
    scene = tmp_path / "small.toml"
    scene.write_text(
        '[ground]\nkinds = ["concrete"]\ntile_texels = 256\ntexel_m = 0.05\n'
        '[[objects]]\nclass = "car"\nplace_m = [30, 0]\n[[objects]]\nclass = "boat"\nplace_m = [0, 30]\n'
        "[camera]\nwidth = 160\nheight = 120\nhorizontal_fov_deg = 80\nrate_hz = 5\n"
    )
    model = ("--model", str(exported_model), "--detector-runtime", "onnxruntime")
    return ["--scene", str(scene), *model, "--detector-image-size", "160"]


def next_detections(session: zenoh.Session, vehicle: str) -> dict[str, Any]:
    seen = session.declare_subscriber(DETECTIONS.key(vehicle), zenoh.handlers.FifoChannel(10))
    message: dict[str, Any] = json.loads(seen.recv().payload.to_string())
    seen.undeclare()  # type: ignore[no-untyped-call]
    return message


def test_play_flies_an_autopilot_at_a_url_and_ends_on_ctrl_c(tmp_path: Path, small: list[str]) -> None:
    """Any autopilot: here a simulated vehicle that has no camera of its own, with system id 7."""
    with ExitStack() as stack:
        simulator = stack.enter_context(running_simulator(system_id=7, **TWICE))
        url = f"udpin://127.0.0.1:{simulator.onboard_port}"
        page = f"127.0.0.1:{free_port(socket.SOCK_STREAM)}"
        flags = ("--vehicle-url", url, "--dashboard-listen", page)
        running = stack.enter_context(playing(tmp_path, *flags, *small, quick=False))
        assert "rendered camera" in running.lines[0]
        assert any(f"http://{page}/" in line for line in running.lines)  # above what to do next
        assert running.lines[-1].endswith(READY)
        assert any(line.endswith(": boat, car") for line in running.lines)
        running.take_off(2.0)
        assert any("armed" in event for event in simulator.events)
        with running.client() as session:
            message = next_detections(session, "vehicle1")
        assert (message["width"], message["height"]) == (160, 120)
        started = descendants(running.pid)
        assert len(started) >= 2  # the camera, perception
        running.signal(signal.SIGINT)
        assert running.process.wait(20) == 0
        assert not until_gone(started)
        assert not list(Path("/dev/shm").glob(f"*companion-play-{running.pid}*"))


def test_demonstration_refuses_an_armed_autopilot(tmp_path: Path) -> None:
    with vehicle(parameters={"COM_DISARM_PRFLT": -1.0}) as simulator:
        simulator.arm()
        url = f"udpin://127.0.0.1:{simulator.onboard_port}"
        done = companion("demo", "--output", tmp_path / "demo", "--vehicle-url", url, cwd=tmp_path)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "armed" in line


def test_play_with_cameras_in_the_air_ends_with_its_simulator(tmp_path: Path, small: list[str]) -> None:
    with playing(tmp_path, "--vehicles", "2", *small) as running:
        with running.client() as session:
            for text in ("takeoff 2", "hold"):
                reply = send_command(session, "vehicle2", text, timeout_s=60.0)
                assert reply["success"], reply
            # It sees by its own camera.
            message = next_detections(session, "vehicle2")
            assert (message["vehicle"], message["width"], message["height"]) == ("vehicle2", 160, 120)
            assert message["localization_error"] == ""
        started = descendants(running.pid)
        assert len(started) >= 4  # the vehicles, their cameras, perception twice
        (simulator,) = [pid for pid in started if is_simulator(pid)]
        os.kill(simulator, signal.SIGKILL)
        running.wait_for_line("companion: the simulator", 30.0)
        assert running.process.wait(30) == 1
        assert not until_gone(started)
        assert not list(Path("/dev/shm").glob(f"*companion-play-{running.pid}*"))


def test_play_without_a_camera_flies_and_ends_on_ctrl_c_in_the_air(tmp_path: Path) -> None:
    with playing(tmp_path, "--source", "none", "--vehicles", "2") as running:
        assert any("no camera" in line for line in running.lines)
        with running.client() as session:
            reply = send_command(session, "vehicle2", "takeoff 2", timeout_s=60.0)
            assert reply["success"], reply
            reply = send_command(session, "vehicle1", "seek car", timeout_s=20.0)
            assert not reply["success"], reply
        (simulator,) = descendants(running.pid)  # no perception
        assert is_simulator(simulator)
        assert not list(Path("/dev/shm").glob(f"*companion-play-{running.pid}*"))
        running.signal(signal.SIGINT)
        assert running.process.wait(20) == 0
        assert not until_gone({simulator})


def test_up_to_four_vehicles_have_a_camera_each() -> None:
    cameras = [PlayOptions(vehicles=count).cameras for count in (1, 2, 4, 5, 8)]
    assert cameras == [1, 2, 4, 1, 1]
    assert [PlayOptions(vehicles=count, with_camera=False).cameras for count in (1, 20)] == [0, 0]


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        (("--source", "photo.jpg"), "source.uri"),
        (("--camera-mount-pitch-deg", "-10"), "camera.mount_pitch_deg"),
        (("--source", "none", "--camera-mount-pitch-deg", "-10"), "camera.mount_pitch_deg"),
        (("--source", "none", "--vehicle-url", "udpin://127.0.0.1:14540"), "--vehicle-url"),
        (("--vehicle-url", "udpin://127.0.0.1:14540", "--vehicles", "2"), "--vehicles"),
    ],
)
@pytest.mark.timeout(20)  # options that are not refused start everything here
def test_play_refuses_invalid_options_in_one_line(tmp_path: Path, flags: tuple[str, ...], named: str) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    done = companion_here("play", "--zenoh-listen", endpoint, *flags, cwd=tmp_path)
    assert done.returncode == 2, done.stdout + done.stderr
    (line,) = done.stderr.splitlines()
    assert named in line


def test_play_that_cannot_start_is_one_line(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    flags = ("--zenoh-listen", endpoint, "--vehicle-url", "tcp://127.0.0.1:5760")
    done = companion("play", *flags, cwd=tmp_path)
    assert done.returncode == 2, done.stdout + done.stderr
    (line,) = done.stderr.splitlines()
    assert "udpin://" in line


@pytest.mark.timeout(20)  # a session that is not refused starts here
def test_unknown_scene_and_busy_port_are_named() -> None:
    with socket.create_server(("127.0.0.1", 0)) as busy:
        endpoint = f"tcp/127.0.0.1:{busy.getsockname()[1]}"
        settings = Settings(zenoh=ZenohSection(listen=(endpoint,)))
        with pytest.raises(EndpointTakenError, match=endpoint):
            play(settings, PlayOptions(), print)
    with pytest.raises(SimSessionError, match="no-such-scene"):
        play(Settings(zenoh=ZenohSection(listen=())), PlayOptions("no-such-scene"), print)


@pytest.mark.slow
def test_sentences_and_a_policy_fly_to_a_car(tmp_path: Path) -> None:
    """As docs/how-to/ask.md and policies.md show it: the bundled model, patterns, the bundled policy."""
    with playing(tmp_path, quick=False) as running:
        connect = ("--connect", running.endpoint)
        for sentence, allowed in (("take off to three metres", "takeoff"), ("find a car", "seek")):
            asked = companion(
                *("ask", *connect, sentence, "--language-may", allowed), cwd=tmp_path, timeout_s=150.0
            )
            assert asked.returncode == 0, asked.stdout + asked.stderr
            assert allowed in asked.stdout
        sent = companion(
            "send", *connect, "policy approach class=car distance=6", cwd=tmp_path, timeout_s=150.0
        )
        assert sent.returncode == 0, sent.stdout + sent.stderr
        (ends_m,) = re.findall(r"([\d.]+) m", sent.stdout.partition("car")[2])[:1]
        assert float(ends_m) == pytest.approx(6.0, abs=0.5)
