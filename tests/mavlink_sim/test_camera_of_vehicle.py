"""`mavlink-sim camera` as a process: frames from another autopilot's pose, and usage errors."""

from __future__ import annotations

import json
import math
import os
import secrets
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from mavlink_sim.camera import cli
from mavlink_sim.camera.autopilot_link import AutopilotLink, LinkError
from mavlink_sim.cli.main import main
from mavlink_sim.testing import free_port, vehicle
from mavlink_sim.wire.endpoint import UdpEndpoint
from mavlink_sim.wire.messages import Outgoing, dialect, parser
from vision.shared_frame import SHARED_MEMORY_DIRECTORY, SharedFrameReader, segment_path

pytestmark = [
    pytest.mark.skipif(not SHARED_MEMORY_DIRECTORY.is_dir(), reason="needs Linux's /dev/shm"),
    pytest.mark.realtime,
]
DEADLINE_S = 120.0
LOWEST_EYE_M = -0.05
"""The renderer's least height of the camera (NED)."""


@pytest.fixture
def name() -> Iterator[str]:
    chosen = f"test-camera-{os.getpid()}-{secrets.token_hex(4)}"
    yield chosen
    segment_path(chosen).unlink(missing_ok=True)


def heartbeat(system: int) -> Outgoing:
    message = dialect.MAVLink_heartbeat_message(
        dialect.MAV_TYPE_QUADROTOR, dialect.MAV_AUTOPILOT_PX4, 0, 0, dialect.MAV_STATE_STANDBY, 3
    )
    return Outgoing(message, system, dialect.MAV_COMP_ID_AUTOPILOT1)


def test_a_tcp_connection_that_ends_is_an_error_at_once() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = AutopilotLink(f"tcp://127.0.0.1:{server.getsockname()[1]}")
        accepted, _ = server.accept()
        with accepted:
            accepted.sendall(heartbeat(7).pack(parser()))
            accepted.shutdown(socket.SHUT_WR)
            while not link.receive(1.0):
                pass
            assert link.systems == {7: False}
            with pytest.raises(ConnectionError, match="closed"):
                link.receive(1.0)
        link.close()


def received(endpoint: UdpEndpoint, link: AutopilotLink, count: int) -> list[Any]:
    """The messages received at the vehicle's end while the link is served, until there are `count`."""
    messages: list[Any] = []
    deadline_s = time.monotonic() + 20.0
    while len(messages) < count:
        assert time.monotonic() < deadline_s, messages
        link.receive(0.02)
        messages += endpoint.receive()
    return messages


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([], ["--vehicle-url"]),
        (["--vehicle-url", "udp://127.0.0.1:14540", "--camera", "x"], ["udpin://HOST:PORT", "'udp://"]),
        (["--vehicle-url", "udpin://127.0.0.1:0", "--camera", "x"], ["udpin://127.0.0.1:0"]),
        (["--vehicle-url", "udpout://127.0.0.1:1", "--listen-only", "--camera", "x"], ["udpout"]),
        (["--vehicle-url", "tcp://127.0.0.1:1", "--camera", "x"], ["tcp://127.0.0.1:1", "refused"]),
        (["--vehicle-url", "udpin://127.0.0.1:14540"], ["no output"]),
        (["--vehicle-url", "udpin://127.0.0.1:14540", "--scene", "no-such"], ["no-such", "village"]),
        (["--vehicle-url", "udpin://127.0.0.1:14540", "--camera", "a/b"], ["'a/b'"]),
        (["--vehicle-url", "udpin://127.0.0.1:1", "--camera", "x", "--camera-rate", "0"], ["0", "1 to 120"]),
        (["--vehicle-url", "udpin://127.0.0.1:1", "--camera", "x", "--origin", "1,2"], ["'1,2'", "N,E,D"]),
    ],
    ids=lambda value: "_".join(value)[:60] if isinstance(value, list) else str(value),
)
def test_a_bad_camera_option_is_one_line_and_code_two(
    arguments: list[str],
    words: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("sys.argv", ["mavlink-sim", "camera", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    for word in words:
        assert word in line


def test_a_port_in_use_is_refused(
    name: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    taken = UdpEndpoint("127.0.0.1", 0, 1)
    arguments = ["--vehicle-url", f"udpin://127.0.0.1:{taken.port}", "--camera", name]
    monkeypatch.setattr("sys.argv", ["mavlink-sim", "camera", *arguments])
    try:
        with pytest.raises(SystemExit) as ended:
            main()
    finally:
        taken.close()
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "in use" in line


def test_no_autopilot_is_refused_after_ten_seconds(
    name: str, small: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    assert cli.VEHICLE_TIMEOUT_S == 10.0
    monkeypatch.setattr(cli, "VEHICLE_TIMEOUT_S", 0.3)
    url = f"udpin://127.0.0.1:{free_port()}"
    arguments = ["--vehicle-url", url, "--camera", name, "--scene", small]
    monkeypatch.setattr("sys.argv", ["mavlink-sim", "camera", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    output = capfd.readouterr()  # also of the process that renders
    (line,) = output.err.splitlines()
    assert "within 0.3 s" in line
    assert "HEARTBEAT" in line
    assert output.out == ""


@pytest.mark.parametrize("systems", [(4, 9), (4, 4)])
def test_two_autopilots_on_one_port_are_refused(
    name: str,
    small: str,
    systems: tuple[int, int],
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    port = free_port()
    ends = [UdpEndpoint("127.0.0.1", 0, port) for _ in range(2)]
    stopped = threading.Event()

    def send() -> None:
        while not stopped.wait(0.05):
            for system, end in zip(systems, ends, strict=True):
                end.receive()
                end.send([heartbeat(system)])

    sending = threading.Thread(target=send)
    arguments = ["--vehicle-url", f"udpin://127.0.0.1:{port}", "--camera", name, "--scene", small]
    monkeypatch.setattr("sys.argv", ["mavlink-sim", "camera", *arguments])
    sending.start()
    try:
        with pytest.raises(SystemExit) as ended:
            main()
    finally:
        stopped.set()
        sending.join()
        ports = [end.port for end in ends]
        for end in ends:
            end.close()
    assert ended.value.code == 2
    (line,) = capfd.readouterr().err.splitlines()
    for word in ("4 and 9",) if systems == (4, 9) else ("system id 4", *(f":{port}" for port in ports)):
        assert word in line


def test_missing_pose_messages_are_requested() -> None:
    port = free_port()
    vehicle = UdpEndpoint("127.0.0.1", 0, port)
    link = AutopilotLink(f"udpin://127.0.0.1:{port}")
    try:
        vehicle.send([heartbeat(7)])
        requests = received(vehicle, link, 4)
    finally:
        vehicle.close()
        link.close()
    assert link.systems == {7: False}
    assert {message.get_type() for message in requests} == {"COMMAND_LONG"}
    for message in requests:
        assert message.command == dialect.MAV_CMD_SET_MESSAGE_INTERVAL
        assert (message.target_system, message.target_component) == (7, dialect.MAV_COMP_ID_AUTOPILOT1)
        assert (message.get_srcSystem(), message.get_srcComponent()) == (7, dialect.MAV_COMP_ID_CAMERA)
    wanted = {(int(message.param1), round(1e6 / message.param2)) for message in requests}
    assert wanted == {
        (dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION, 50),
        (dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED, 30),
    }


def test_listen_only_sends_nothing() -> None:
    port = free_port()
    vehicle = UdpEndpoint("127.0.0.1", 0, port)
    link = AutopilotLink(f"udpin://127.0.0.1:{port}", listen_only=True)
    try:
        vehicle.send([heartbeat(7)])
        end_s = time.monotonic() + 2.5
        while time.monotonic() < end_s:
            link.receive(0.05)
        assert link.systems == {7: False}
        assert vehicle.receive() == []
    finally:
        vehicle.close()
        link.close()
    with pytest.raises(LinkError):
        AutopilotLink("udpout://127.0.0.1:14540", listen_only=True)


@pytest.mark.parametrize("autopilot", ["px4", pytest.param("ardupilot", marks=pytest.mark.slow)])
def test_frames_are_drawn_from_another_autopilots_pose(
    name: str, small: str, tmp_path: Path, autopilot: str
) -> None:
    """Where each frame's eye is, against the simulator's own truth at the frame's stamp; then a lost pose."""
    seen, flight = tmp_path / "seen.jsonl", tmp_path / "flown.jsonl"
    with vehicle(truth=tmp_path / "truth.jsonl", autopilot=autopilot, noise="off", gusts=0.0) as sim:
        command = [sys.executable, "-m", "mavlink_sim", "camera", "--camera", name, "--camera-rate", "10"]
        command += ["--scene", small]
        command += ["--vehicle-url", f"udpin://127.0.0.1:{sim.gcs_port}", "--origin", "0,0,0"]
        command += ["--camera-truth", str(seen), "--truth", str(flight)]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        try:
            assert process.stdout is not None
            lines = iter(process.stdout.readline, "")
            ready = next(line for line in lines if line.startswith("ready: "))
            assert "0.000,0.000,0.000" in ready
            with SharedFrameReader(name) as reader:
                frame = reader.latest()
                assert frame is not None
                assert frame.depth_m is not None
                assert reader.calibration is not None
                count, deadline_s = frame.sequence, time.monotonic() + DEADLINE_S
                while (frame := reader.latest()) is None or frame.sequence < count + 10:
                    assert time.monotonic() < deadline_s
                    time.sleep(0.02)
            os.kill(sim.pid, signal.SIGSTOP)
            try:
                _, events = process.communicate(timeout=DEADLINE_S)
            finally:
                os.kill(sim.pid, signal.SIGCONT)
        finally:
            process.kill()
    assert process.returncode == 1
    assert f"stopped {cli.POSE_LOST_S:g} s ago" in events.splitlines()[-1]
    assert not segment_path(name).exists()
    true = [json.loads(line) for line in (tmp_path / "truth.jsonl").read_text().splitlines()]
    for line in seen.read_text().splitlines():
        captured = json.loads(line)
        nearest = min(true, key=lambda entry: abs(entry["stamp_ns"] - captured["stamp_ns"]))
        yaw_rad = nearest["yaw_rad"]
        # the lens of the demo's camera is 0.12 m ahead of the vehicle
        north, east, down = nearest["position_ned_m"]
        eye = (north + 0.12 * math.cos(yaw_rad), east + 0.12 * math.sin(yaw_rad), min(down, LOWEST_EYE_M))
        assert math.dist(captured["camera_ned_m"], eye) < 0.05
    assert {"stamp_ns", "position_ned_m", "velocity_ned_mps", "yaw_rad", "armed", "objects"} == set(
        json.loads(flight.read_text().splitlines()[0])
    )


def test_help_lists_the_commands(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr("sys.argv", ["mavlink-sim", "--help"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0
    listed = capsys.readouterr().out.partition("Commands:")[2].splitlines()[1:]
    assert [line.split()[0] for line in listed if line] == ["camera", "dataset", "board", "bench"]


@pytest.mark.parametrize("command", ["camera", "dataset", "board", "bench"])
def test_help_of_a_command_is_plain_text(
    command: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["mavlink-sim", command, "--help"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 0
    assert "Options:" in capsys.readouterr().out.splitlines()  # no drawn box


def test_option_before_a_command_is_refused(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("sys.argv", ["mavlink-sim", "--seed", "3", "bench"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert {"--seed", "bench"} <= set(line.split())
