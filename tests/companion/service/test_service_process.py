"""The service as a user runs it: real processes, sockets, zenoh sessions and signals."""

from __future__ import annotations

import contextlib
import json
import os
import queue
import signal
import socket
import subprocess
import threading
import time
from pathlib import Path
from typing import Any

import imageio_ffmpeg  # type: ignore[import-untyped]
import pytest
import zenoh

from companion.bus.client import listen, send_command
from companion.bus.topics import command_key
from mavlink_sim.testing import QUICK_FLIGHT, free_port, running_simulator
from tests.companion.command_line import companion_here
from tests.companion.service_process import TWICE, ServiceProcess, running_service

pytestmark = pytest.mark.realtime

# COM_OF_LOSS_T of the simulated vehicle (PX4's default), and the tolerance.
LOSS_S, ALLOWED_S = 1.0, 0.5
NO_CAMERA = ("--source", "none")


def truth(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines() if line.endswith("}")]


def wait_for_truth(path: Path, condition: Any, timeout_s: float = 30.0) -> dict[str, Any]:
    """Wait for the first row that meets the condition."""
    deadline = time.monotonic() + timeout_s
    with path.open() as file:
        text = ""
        while time.monotonic() < deadline:
            # Only the new part: rereading the whole file would keep a processor busy.
            *lines, text = (text + file.read()).split("\n")
            for line in lines:
                row: dict[str, Any] = json.loads(line)
                if condition(row):
                    return row
            time.sleep(0.02)
    raise TimeoutError(f"never true; the last row: {truth(path)[-1:]}")


def fly(service: ServiceProcess) -> None:
    """Take off and enter OFFBOARD."""
    service.take_off(2.5)
    reply = service.command("hold")
    assert (reply["state"], reply["success"], reply["reason"]) == ("in_progress", True, "in progress")


def test_ardupilot_is_recognized_by_a_service_without_a_camera(tmp_path: Path) -> None:
    with (
        running_simulator(autopilot="ardupilot", ready_after=0.0) as simulator,
        running_service(simulator.onboard_port, NO_CAMERA, cwd=tmp_path) as service,
        service.client() as session,
    ):
        received: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        listen(session, "status", lambda _key, text: received.put(json.loads(text)))
        service.wait_for_line("GUID_TIMEOUT is 3 s")
        service.wait_for_line("heartbeat received: ArduPilot, pymavlink driver")
        vehicle = received.get(timeout=10)["vehicle"]
        assert (vehicle["autopilot"], vehicle["driver"]) == ("ArduPilot", "pymavlink")
        while vehicle["missing_streams"]:
            vehicle = received.get(timeout=10)["vehicle"]


def test_mavsdk_flight_with_frames_on_standard_input(exported_model: Path, tmp_path: Path) -> None:
    writer = subprocess.Popen(
        [
            *(imageio_ffmpeg.get_ffmpeg_exe(), "-re", "-f", "lavfi", "-i", "testsrc=size=64x48:rate=5"),
            *("-f", "rawvideo", "-pix_fmt", "bgr24", "-"),
        ],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    assert writer.stdout is not None
    flags = [
        *("--source", "-", "--source-pixel-format", "bgr24", "--source-width", "64", "--source-height", "48"),
        *("--model", str(exported_model), "--detector-runtime", "onnxruntime", "--detector-image-size", "64"),
        *("--guidance-perception-max-age-s", "3", "--driver", "mavsdk"),
    ]
    try:
        with (
            running_simulator(ready_after=0.0, parameters=QUICK_FLIGHT) as simulator,
            running_service(
                simulator.onboard_port, flags, cwd=tmp_path, stdin=writer.stdout.fileno()
            ) as service,
            service.client() as session,
        ):
            detections: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
            service.take_off(2.5)
            assert service.command("orbit radius=3 speed=1")["success"]
            listen(session, "detections", lambda _key, text: detections.put(json.loads(text)))
            messages = [detections.get(timeout=20) for _ in range(3)]
    finally:
        writer.kill()
        writer.wait()
        writer.stdout.close()
    found = {(message["vehicle"], message["width"], message["height"]) for message in messages}
    assert found == {("vehicle1", 64, 48)}


def test_lost_vehicle_is_reconnected_and_no_command_retaken(tmp_path: Path) -> None:
    path = tmp_path / "truth.jsonl"
    with (
        running_simulator(**TWICE) as first,
        running_service(first.onboard_port, NO_CAMERA, cwd=tmp_path) as service,
    ):
        fly(service)
        first.kill()
        service.wait_for_line("autopilot heartbeat lost")
        count = len(service.lines)
        with running_simulator(
            onboard_port=first.onboard_port,
            onboard_bind=first.onboard_bind,
            truth=path,
            ready_after=0.0,
            parameters=QUICK_FLIGHT,
        ) as second:
            service.wait_for_line("autopilot heartbeat received", after=count)
            fly(service)
            second.wait_for_event("takeoff")
            stopped_ns = time.monotonic_ns()
            service.signal(signal.SIGSTOP)
            row = wait_for_truth(path, lambda r: r["stamp_ns"] > stopped_ns and r["mode"] != "OFFBOARD")
            assert row["armed"]
            assert (row["stamp_ns"] - stopped_ns) / 1e9 <= LOSS_S + ALLOWED_S
            count = len(service.lines)
            service.signal(signal.SIGCONT)
            service.wait_for_line("command lost", after=count)
            landed = wait_for_truth(path, lambda r: r["stamp_ns"] > stopped_ns and not r["armed"], 60.0)
            between = [r for r in truth(path) if row["stamp_ns"] <= r["stamp_ns"] < landed["stamp_ns"]]
            back = [r["stamp_ns"] for r in between if r["mode"] == "OFFBOARD"]
            times_s = [(at - row["stamp_ns"]) / 1e9 for at in (*back[:1], *back[-1:])]
            assert not back, f"in OFFBOARD again at {times_s} s: {service.lines}"


def test_process_stopped_while_arming_does_not_arm_afterwards(tmp_path: Path) -> None:
    with (
        running_simulator(ready_after=0.0) as simulator,
        running_service(simulator.onboard_port, NO_CAMERA, cwd=tmp_path) as service,
        service.client() as session,
    ):
        service.wait_for_line("autopilot heartbeat received")
        with pytest.raises(TimeoutError):
            service.wait_for_line("never", 2.5)  # home and the pre-arm checks are known by then
        lost = len(simulator.events)
        simulator.fault("link_loss")
        simulator.wait_for_event("link_loss begins", since=lost)
        replies: list[dict[str, Any]] = []
        takeoff = threading.Thread(
            target=lambda: replies.append(send_command(session, "vehicle1", "takeoff 3", timeout_s=40.0))
        )
        takeoff.start()
        service.wait_for_line("command: takeoff")
        with pytest.raises(TimeoutError):
            service.wait_for_line("takeoff altitude=3:", 0.3)  # not refused: arming is requested
        service.signal(signal.SIGSTOP)
        simulator.fault("end all")
        simulator.wait_for_event("link_loss ends", since=lost)
        time.sleep(4.0)
        service.signal(signal.SIGCONT)
        takeoff.join(40.0)
        assert not replies[0]["success"]
        assert "paused" in replies[0]["reason"]
        time.sleep(3.0)  # longer than arming is repeated
        assert "armed" not in simulator.events


MISSION = """
name = "around"

[[step]]
name = "wait"
do = "hold"
timeout_s = 1

[[step]]
name = "look"
do = "seek boat laps=0.25 rate=1 confidence=1"
on_failure = "continue"

[[step]]
do = "orbit radius=3 speed=1"
timeout_s = 1
"""


def test_mission_is_flown_and_flight_survives_a_killed_worker(seeing: list[str], tmp_path: Path) -> None:
    path = tmp_path / "truth.jsonl"
    (tmp_path / "here").mkdir()
    (tmp_path / "here" / "short.toml").write_text(MISSION)
    with (
        running_simulator(truth=path, **TWICE) as simulator,
        running_service(simulator.onboard_port, seeing, cwd=tmp_path) as service,
        service.client() as session,
    ):
        statuses: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        listen(session, "status", lambda _key, text: statuses.put(json.loads(text)))
        received: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        listen(session, "detections", lambda _key, text: received.put(json.loads(text)))
        reply = service.command("mission short")
        assert not reply["success"]
        assert "mission 'short' " in reply["reason"]
        assert "bundled missions: " in reply["reason"]
        reply = service.command("mission broken\n[[step]]\ndo = 'seek zebra'\n")
        assert reply["reason"].startswith("broken: step 1")
        reply = service.command("hold\n[[step]]\ndo = 'land'\n")
        assert reply["reason"].startswith("hold: ")
        assert "one line" in reply["reason"]
        # From the ground its first step is refused, and with it the mission.
        ground, until_s = "mission ground\n[[step]]\ndo = 'hold 3'", time.monotonic() + 20
        while "the air" not in (reply := service.command(ground))["reason"]:
            assert time.monotonic() < until_s, reply
            time.sleep(0.1)  # an estimate that is not there yet is named first
        assert reply["steps"] == []
        service.take_off(2.5)
        # The service cannot access the file: its text is sent with the command.
        done = companion_here(
            "send", "--file", "short.toml", "--connect", service.endpoint, cwd=tmp_path / "here"
        )
        assert done.returncode == 0, done.stdout + done.stderr
        assert done.stdout.splitlines()[-1] == "done: flown, 3 steps"
        service.wait_for_line("mission around: step 3 of 3: orbit", 5.0)
        assert any("step 1 of 3: hold" in line for line in service.lines)

        assert service.command("orbit radius=3 speed=1")["success"]
        before = statuses.get(timeout=10)["perception"]
        while not statuses.empty():
            before = statuses.get()["perception"]
        count, killed_ns = len(service.lines), time.monotonic_ns()
        os.kill(before["pid"], signal.SIGKILL)
        service.wait_for_line("perception", after=count)
        deadline = time.monotonic() + 40
        while True:
            after = statuses.get(timeout=max(0.1, deadline - time.monotonic()))["perception"]
            if (
                after["state"] == "running"
                and after["pid"] != before["pid"]
                and after["results"] > before["results"]
            ):
                break
        assert after["restarts"] == 1
        assert truth(path)[-1]["mode"] == "OFFBOARD"
        messages = [received.get(timeout=10)]
        while len(messages) < 30 or messages[-1]["captured_ns"] < killed_ns:
            messages.append(received.get(timeout=10))
        offboard = simulator.events.index("mode OFFBOARD")
        service.signal(signal.SIGINT)
        assert service.process.wait(20) == 0
        simulator.wait_for_event("mode HOLD", since=offboard)
    messages += [received.get() for _ in range(received.qsize())]
    published = [message["published_ns"] for message in messages]
    assert published == sorted(published)
    # Numbers may be skipped (newest frame wins) but never repeat.
    sequences = [message["sequence"] for message in messages]
    assert sequences == sorted(set(sequences))
    assert all(m["captured_ns"] <= m["inferred_ns"] <= m["published_ns"] for m in messages)


def test_failure_notes_the_services_last_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "python"
    program.write_text("#!/bin/sh\necho line 6 >&2\necho service: up: autopilot >&2\nexec sleep 60\n")
    program.chmod(0o700)
    monkeypatch.setattr("sys.executable", str(program))
    with (
        pytest.raises(TimeoutError, match="line 7") as failure,
        running_service(14540, [], cwd=tmp_path) as service,
    ):
        service.wait_for_line("line 7", 0.1)
    (note,) = failure.value.__notes__
    assert " up: " in note
    assert "line 6" in note


def test_two_services_detect_each_other_and_one_flies(tmp_path: Path) -> None:
    second_endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    statuses: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
    with contextlib.ExitStack() as running:
        simulator = running.enter_context(running_simulator(**TWICE))
        first = running.enter_context(running_service(simulator.onboard_port, NO_CAMERA, cwd=tmp_path))
        session = running.enter_context(first.client())
        listen(session, "status", lambda _key, text: statuses.put(json.loads(text)))
        # Started within 2 s of each other, neither would be the first.
        while statuses.get(timeout=20)["uptime_s"] < 3.0:
            pass
        flags = [*NO_CAMERA, "--zenoh-connect", first.endpoint, "--zenoh-listen", second_endpoint]
        second = running.enter_context(
            running_service(simulator.gcs_port, flags, cwd=tmp_path, endpoint=second_endpoint)
        )
        # The second one has another id, or, where a heartbeat of the first came late, the first takes one.
        for service in (first, second):
            service.wait_for_line("by mavlink, not in command")
            service.wait_for_line("by zenoh, not in command")
        # A status from before the second detection may still arrive: the next one has both.
        complete: set[str] = set()
        while len(complete) < 2:
            status = statuses.get(timeout=10)
            if {other["via"] for other in status["vehicle"]["other_commanders"]} == {"mavlink", "zenoh"}:
                complete.add(status["service"])
        # Both have this name, so both are queried. The first may still wait for the vehicle's position.
        while True:
            asked = session.get(
                command_key("vehicle1"),
                payload="takeoff 2.5",
                timeout=60.0,
                consolidation=zenoh.ConsolidationMode.NONE,  # else only one answer is returned
            )
            answers = [json.loads(reply.ok.payload.to_string()) for reply in asked if reply.ok]
            refused = ["allow_other_commander" in answer["reason"] for answer in answers]
            assert sorted(refused) == [False, True], answers
            if any(answer["success"] for answer in answers):
                break
            time.sleep(0.2)  # twenty commands a second are accepted
        second.wait_for_line("allow_other_commander", 5.0)
