"""`mavlink-sim` as a process: options, ports, output, exit, truth file, record of the traffic."""

from __future__ import annotations

import errno
import json
import logging
import math
import os
import select
import signal
import socket
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavutil

from mavlink_sim.cli.main import main
from mavlink_sim.realtime.fleet import Fleet
from mavlink_sim.testing import free_port, free_udp_ports, running_simulator
from mavlink_sim.wire.endpoint import PEER_SILENCE_S, PortInUseError, UdpEndpoint
from mavlink_sim.wire.messages import Outgoing, dialect, parser
from mavlink_sim.wire.traffic_log import TrafficLog, recording
from mavlink_sim.world.truth_file import TruthFile
from vision.shared_frame import SharedFrameReader, segment_path

pytestmark = pytest.mark.realtime


def run_main(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    """Run the command in this process; its exit code."""
    monkeypatch.setattr("sys.argv", ["mavlink-sim", *arguments])
    with pytest.raises(SystemExit) as ended:
        main()
    assert isinstance(ended.value.code, int)
    return ended.value.code


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--param", "COM_OF_LOST_T=1"], ["COM_OF_LOST_T"]),
        (["--param", "COM_OF_LOSS_T"], ["COM_OF_LOSS_T", "NAME=NUMBER"]),
        (["--param", "COM_OF_LOSS_T=fast"], ["fast", "NAME=NUMBER"]),
        (["--param", "NAV_RCL_ACT=1.5"], ["NAV_RCL_ACT", "INT32", "1.5"]),
        (["--speed", "0"], ["--speed", "0.05 to 20"]),
        (["--speed", "nan"], ["--speed", "0.05 to 20"]),
        (["--speed", "fast"], ["--speed", "valid"]),  # the rest is worded by typer
        (["--bogus"], ["--bogus"]),
        (["--camera", "a/b"], ["'a/b'"]),
        (["--wind", "-3"], ["--wind", "0 to 8"]),
        (["--gusts", "-1"], ["--gusts", "0 to 4"]),
        (["--gusts", "nan"], ["--gusts", "0 to 4"]),
        (["--onboard-port", "0"], ["--onboard-port", "1 to 65535"]),
        (["--gcs-bind", "70000"], ["--gcs-bind", "0 to 65535"]),
        (["--system-id", "256"], ["--system-id", "1 to 255"]),
        (["--autopilot", "ardupilot", "--px4", "1.14"], ["1.14", "ArduPilot", "--px4"]),
        (["--autopilot", "ardupilot", "--gimbal"], ["ArduPilot", "gimbal"]),
        (["--camera-rate", "10"], ["--camera-rate 10", "no camera", "--camera NAME"]),
        (["--camera-vehicle", "1"], ["--camera-vehicle 1", "no camera"]),
        (["--obstacle-sensor"], ["--obstacle-sensor", "nothing to measure", "--scene FILE"]),
        (["--scene", "no-such-scene"], ["no-such-scene", "village"]),
        (["--vehicles", "0"], ["0 vehicles", "1 to 250"]),
        (["--vehicles", "10", "--system-id", "250"], ["255"]),
        (["--vehicles", "10", "--onboard-port", "65530"], ["--onboard-port", "65535"]),
        (["--vehicles", "2", "--camera-vehicle", "3"], ["camera", "3"]),
        (["--cameras", "2"], ["--cameras 2", "no camera"]),
        (["--camera", "eye", "--cameras", "0"], ["0 cameras", "vehicle 1"]),
        (["--camera", "eye", "--vehicles", "2", "--cameras", "3"], ["3 cameras", "vehicles 1 to 2"]),
        (["--camera-output", "pipe:eye", "--vehicles", "2", "--cameras", "2"], ["2 cameras", "--camera"]),
        (["--spacing", "0"], ["--spacing", "0.6 to 1000"]),
        (["--noise", "some"], ["--noise", "on, off or a scale"]),
        (["--noise", "-1"], ["--noise", "0 to 10"]),
        (["--spacing", "7"], ["--spacing 7", "one vehicle", "--vehicles N"]),
        (["--host", "not.a.host.invalid"], ["not.a.host.invalid"]),
        (["--truth", "/nonexistent/folder/truth.jsonl"], ["truth.jsonl"]),
        (["--fault", "link_dely 1"], ["link_delay"]),
        (["--fault", "link_loss link=usb"], ["all, onboard, gcs"]),
        (["--control", "nonsense"], ["--control nonsense"]),
    ],
    ids=lambda value: "_".join(value) if isinstance(value, list) else str(value),
)
def test_a_bad_value_gives_one_clear_line_and_code_two(
    arguments: list[str],
    words: list[str],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert run_main(monkeypatch, "--onboard-bind", "0", "--gcs-bind", "0", *arguments) == 2
    output = capsys.readouterr()
    assert output.out == ""
    (line,) = output.err.strip().splitlines()
    assert line.startswith("mavlink-sim: ")
    for word in words:
        assert word in line


def test_unwritable_ready_file_is_one_line_and_code_2() -> None:
    command = [sys.executable, "-m", "mavlink_sim", "--onboard-bind", "0", "--gcs-bind", "0"]
    finished = subprocess.run(
        [*command, "--ready-file", "/nonexistent/folder/ready"], capture_output=True, text=True, timeout=60
    )
    assert finished.returncode == 2
    assert len(finished.stderr.strip().splitlines()) == 1
    assert "--ready-file" in finished.stderr


def test_a_taken_port_gives_one_clear_line_and_code_two(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        assert run_main(monkeypatch, "--onboard-bind", str(port), "--gcs-bind", "0") == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert f"UDP port 127.0.0.1:{port} " in line
    assert "in use" in line


def test_version_is_printed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    assert run_main(monkeypatch, "--version") == 0
    assert capsys.readouterr().out == f"mavlink-sim {version('mavlink-companion')}\n"


@pytest.mark.parametrize(
    ("options", "least_m", "most_m"),
    [("--wind=0 --gusts=0", 0.0, 0.001), ("", 0.05, 5.0)],
    ids=["still", "usual wind and gusts"],
)
def test_wind_and_gusts_move_a_holding_vehicle(
    options: str, least_m: float, most_m: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The greatest horizontal distance from its hold position within 10 s."""
    positions: list[tuple[float, ...]] = []

    def hold(fleet: Fleet) -> None:
        vehicle = fleet.simulations[0].vehicle
        vehicle.step(0.1)
        vehicle.autopilot.arm()
        vehicle.autopilot.takeoff(2.5)
        vehicle.step(15.0)
        assert vehicle.autopilot.mode.name == "HOLD"
        for _ in range(200):
            vehicle.step(0.05)
            positions.append(vehicle.airframe.position[:2])

    monkeypatch.setattr("signal.signal", lambda number, handler: None)  # pytest's stay
    monkeypatch.setattr("gc.freeze", lambda: None)  # keep the objects of other tests collectable
    monkeypatch.setattr(Fleet, "run", hold)
    ends = [f"--{name}-port={port}" for name, port in zip(("onboard", "gcs"), free_udp_ports(2), strict=True)]
    ends += ["--onboard-bind=0", "--gcs-bind=0"]
    assert run_main(monkeypatch, *ends, "--ready-after=0", "--noise=off", *options.split()) == 0
    assert least_m <= max(math.dist(position, positions[0]) for position in positions) < most_m


def positions_in(truth: Path) -> list[list[float]]:
    """The positions in a truth file that is still written: without header and unfinished line."""
    lines = truth.read_text().rpartition("\n")[0].splitlines()[1:]
    return [json.loads(line)["position_ned_m"] for line in lines]


def test_setpoint_methods_fly_it_until_they_stop(tmp_path: Path) -> None:
    truth = tmp_path / "truth.jsonl"
    still: dict[str, Any] = {"wind": 0.0, "gusts": 0.0, "noise": False}
    with running_simulator(ready_after=0.0, speed=2.0, truth=truth, **still) as simulator:
        simulator.set_velocity(0.0, 0.0, -1.5)
        simulator.arm()
        simulator.wait_for_event("takeoff")
        assert all(math.hypot(*position[:2]) < 0.001 for position in positions_in(truth))
        simulator.set_position(2.0, 0.0, -2.0, yaw_rad=1.0)
        with pytest.raises(ValueError, match="finite numbers"):
            simulator.set_velocity(math.nan, 0.0, 0.0)
        deadline = time.monotonic() + 40.0
        while not any(math.dist(position, (2.0, 0.0, -2.0)) < 0.5 for position in positions_in(truth)):
            assert time.monotonic() < deadline, simulator.events
            time.sleep(0.1)
        simulator.stop_setpoints()
        simulator.wait_for_event("failsafe: offboard setpoints lost")
    assert [event for event in simulator.events if event.startswith("mode")][:1] == ["mode OFFBOARD"]


def use_until_refused(ready: Path) -> None:
    options: dict[str, Any] = {"system_id": 3, "ready_file": ready, "ready_after": 0.0}
    with running_simulator(faults=["refuse_mode"], **options) as simulator:
        assert json.loads(ready.read_text()) == {
            "pid": simulator.pid,
            "onboard_bind": simulator.onboard_bind,
            "gcs_bind": simulator.gcs_bind,
        }
        for port in (simulator.onboard_port, simulator.gcs_port):
            link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", source_system=245)
            beat = link.wait_heartbeat(timeout=20)
            assert (beat.get_srcSystem(), beat.get_srcComponent()) == (3, 1)
            link.mav.param_request_read_send(3, 1, b"COM_OF_LOSS_T", -1)
            value = link.recv_match(type="PARAM_VALUE", blocking=True, timeout=20)
            assert value.param_value == 1.0
            link.close()
        simulator.fault("wind speed=3 direction=90")
        simulator.wait_for_event("wind", 20.0)
        simulator.set_position(0.0, 0.0, -3.0)


def test_ready_file_both_links_refused_mode_and_failure_note(tmp_path: Path) -> None:
    with pytest.raises(TimeoutError, match="mode OFFBOARD") as failure:
        use_until_refused(tmp_path / "ready.json")
    (note,) = failure.value.__notes__
    first, *lines = note.splitlines()
    assert first.startswith("last events")
    assert any("ready: system 3" in line for line in lines)
    assert any("wind" in line for line in lines)


def test_clock_runs_at_given_speed_and_truth_is_on_record(tmp_path: Path) -> None:
    truth = tmp_path / "truth.jsonl"
    with running_simulator(truth=truth, speed=8.0) as simulator:
        link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{simulator.onboard_port}", source_system=245)
        first = link.recv_match(type="ATTITUDE", blocking=True, timeout=20)
        started = time.monotonic()
        last = first
        while last.time_boot_ms - first.time_boot_ms < 4000:
            last = link.recv_match(type="ATTITUDE", blocking=True, timeout=20)
        # only an upper bound: a busy machine makes it slower, nothing may make it faster
        assert time.monotonic() - started > 0.3
        lines = truth.read_text().splitlines()  # while it runs
        link.close()
    # `running_simulator` sends SIGTERM; Ctrl-C is below, with a camera
    assert (simulator.events[-1], simulator.process.returncode) == ("stopped", 0)
    records = [json.loads(line) for line in lines]
    assert len(records) > 30
    last = records[-1]
    assert set(last) == {
        "stamp_ns",
        "position_ned_m",
        "velocity_ned_mps",
        "yaw_rad",
        "mode",
        "armed",
        "landed",
        "crashed",
        "collisions",
        "last_collision",
        "objects",
    }
    assert (last["crashed"], last["collisions"], last["last_collision"]) == (False, 0, None)
    assert (last["mode"], last["armed"], last["landed"]) == ("HOLD", False, True)
    assert last["objects"]
    assert set(last["objects"][0]) == {"identifier", "class_name", "position_ned_m", "range_m"}
    assert 0 <= time.monotonic_ns() - last["stamp_ns"] < 60e9


def camera_process(pid: int) -> int:
    """The camera process of a simulator."""
    for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
        if b"spawn_main" in Path(f"/proc/{child}/cmdline").read_bytes():
            return int(child)
    raise AssertionError("the simulator has no camera process")


def test_camera_start_and_loss_reported_vehicle_continues(small: str, tmp_path: Path) -> None:
    name = f"camera-{tmp_path.parent.name}-{tmp_path.name}-{os.getpid()}"
    with running_simulator(camera=name, camera_rate=10.0, scene=small) as simulator:
        simulator.wait_for_event(f"camera {name} is on", 60.0)
        with SharedFrameReader(name) as reader:
            frame = reader.latest()
            deadline = time.monotonic() + 20.0
            while frame is None and time.monotonic() < deadline:
                frame = reader.latest()
        assert frame is not None
        assert frame.image.shape == (120, 160, 3)
        assert frame.image.std() > 5.0  # not a blank image
        assert 0 <= time.monotonic_ns() - frame.captured_ns < 60e9
        os.kill(camera_process(simulator.pid), signal.SIGKILL)
        simulator.wait_for_event(f"camera {name} is lost", 20.0)
        link = mavutil.mavlink_connection(f"udpin:127.0.0.1:{simulator.onboard_port}", source_system=245)
        assert link.wait_heartbeat(timeout=20) is not None
        link.close()
    assert not segment_path(name).exists(), "what was killed could not clean up: the simulator did"


def test_ctrl_c_right_after_the_start_with_a_camera_is_quiet(tmp_path: Path) -> None:
    name = f"camera-{tmp_path.parent.name}-{tmp_path.name}-{os.getpid()}"
    ports = [str(port) for port in free_udp_ports(2)]
    ends = ["--onboard-bind", "0", "--gcs-bind", "0", "--onboard-port", ports[0], "--gcs-port", ports[1]]
    with subprocess.Popen(
        [sys.executable, "-m", "mavlink_sim", *ends, "--camera", name, "--no-console"],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    ) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline().startswith("ready: ")
            os.killpg(process.pid, signal.SIGINT)  # as a terminal does it: to every process
            assert process.stdout.read() == "stopped\n"
        finally:
            process.kill()
    assert process.returncode == 0


# ---- the endpoint itself


def test_an_endpoint_says_which_port_is_taken() -> None:
    first = UdpEndpoint("127.0.0.1", 0, 9)
    try:
        with pytest.raises(PortInUseError, match=str(first.port)):
            UdpEndpoint("127.0.0.1", first.port, 9)
    finally:
        first.close()


def test_endpoint_keeps_first_peer_until_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    silent_peer = free_port()
    endpoint = UdpEndpoint("127.0.0.1", 0, silent_peer)
    peers = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2)]
    beat = dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)
    clock = [100.0]
    monkeypatch.setattr("mavlink_sim.wire.endpoint.time.monotonic", lambda: clock[0])
    try:
        for peer in peers:
            peer.bind(("127.0.0.1", 0))
            peer.settimeout(10.0)
        for peer in peers:
            peer.sendto(beat.pack(parser(1, 191)), ("127.0.0.1", endpoint.port))
        deadline = time.perf_counter() + 10.0
        received = 0
        while received < 2 and time.perf_counter() < deadline:
            received += len(endpoint.receive())
        assert endpoint.peer == peers[0].getsockname()
        clock[0] += PEER_SILENCE_S + 0.1
        peers[1].sendto(beat.pack(parser(1, 191)), ("127.0.0.1", endpoint.port))
        while not endpoint.receive() and time.perf_counter() < deadline:
            pass
        endpoint.send([Outgoing(beat, 1, 1)])
        assert peers[1].recv(1000)
    finally:
        for peer in peers:
            peer.close()
        endpoint.close()


def test_garbage_is_skipped_and_the_message_after_it_read() -> None:
    endpoint = UdpEndpoint("127.0.0.1", 0, 9)
    beat = dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
        for datagram in (b"", b"\xfd" * 300, bytes(range(256)), b"hello", b"\x00" * 600):
            peer.sendto(datagram, ("127.0.0.1", endpoint.port))
        for _ in range(8):  # a broken length may swallow some
            peer.sendto(beat.pack(parser(1, 191)), ("127.0.0.1", endpoint.port))
        found: list[str] = []
        deadline = time.perf_counter() + 10.0
        while not found and time.perf_counter() < deadline:
            found += [message.get_type() for message in endpoint.receive()]
    endpoint.close()
    assert set(found) == {"HEARTBEAT"}


def test_without_camera_no_opencv_and_no_zenoh() -> None:
    code = (
        "import sys, mavlink_sim.cli.main, mavlink_sim.testing; from mavlink_sim import LockstepVehicle\n"
        "vehicle = LockstepVehicle(gimbal=True); vehicle.take_off()\n"
        "print(*({'numpy', 'cv2', 'zenoh', 'av'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout.strip()) == (0, ""), done.stderr


def test_vehicle_ends_with_its_program() -> None:
    code = (
        "import os, signal; from mavlink_sim.testing import vehicle\n"
        "one = vehicle().__enter__(); print(one.pid, flush=True); os.kill(os.getpid(), signal.SIGKILL)"
    )
    done = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    try:
        running = os.pidfd_open(int(done.stdout))
    except ProcessLookupError:
        return  # it has ended already
    poll = select.poll()
    poll.register(running, select.POLLIN)
    assert poll.poll(20_000)
    os.close(running)


FULL = Path("/dev/full")
needs_full = pytest.mark.skipif(not FULL.exists(), reason="no /dev/full here")


def test_each_line_is_flushed(tmp_path: Path) -> None:
    file = TruthFile(tmp_path / "truth.jsonl")
    assert file.write(json.dumps({"a": 1})) is None
    assert (tmp_path / "truth.jsonl").read_text() == '{"a": 1}\n'
    file.close()
    file.close()
    assert file.write("more") is None


@needs_full
def test_full_disk_reported_once_and_ends_file() -> None:
    file = TruthFile(FULL)
    assert f"/dev/full: {os.strerror(errno.ENOSPC)}" in (file.write("line") or "")
    assert file.write("line") is None


@needs_full
def test_vehicle_continues_after_truth_write_error() -> None:
    with running_simulator(truth=FULL) as simulator:
        simulator.wait_for_event("/dev/full: No space left on device")
        assert simulator.process.poll() is None


def read(path: Path) -> list[Any]:
    log = mavutil.mavlink_connection(str(path))
    found = []
    while (message := log.recv_match()) is not None:
        found.append(message)
    log.close()
    return found


def test_both_directions_are_recorded_with_the_time_of_day(tmp_path: Path) -> None:
    endpoint = UdpEndpoint("127.0.0.1", 0, 9)
    before = time.time()
    with recording({"onboard": endpoint}, tmp_path / "new" / "folder"):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as peer:
            beat = dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)
            peer.sendto(beat.pack(parser(1, 191)), ("127.0.0.1", endpoint.port))
            deadline = time.monotonic() + 10.0
            while not endpoint.receive():
                assert time.monotonic() < deadline
        endpoint.send([Outgoing(dialect.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3), 1, 1)])
    endpoint.send([Outgoing(dialect.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3), 1, 1)])  # not any more
    endpoint.close()
    messages = read(tmp_path / "new" / "folder" / "onboard.tlog")
    assert [(m.get_type(), m.get_srcComponent()) for m in messages] == [("HEARTBEAT", 191), ("HEARTBEAT", 1)]
    assert before - 1.0 <= messages[0]._timestamp <= messages[1]._timestamp <= time.time() + 1.0


def test_a_folder_that_cannot_be_made_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="file"), recording({}, tmp_path / "file" / "folder"):
        pass


def test_full_disk_ends_record_not_flight(caplog: pytest.LogCaptureFixture) -> None:
    with open("/dev/full", "wb", buffering=0) as full, caplog.at_level(logging.WARNING):
        log = TrafficLog(full)
        log.record(b"packet")
        log.record(b"packet")
    assert len(caplog.records) == 1
    assert "/dev/full" in caplog.text
