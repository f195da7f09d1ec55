"""`companion doctor` and `companion status` as a user runs them: with a service and without."""

from __future__ import annotations

import json
import os
import pty
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.doctor import examine as examination
from companion.doctor.check import Verdict
from companion.doctor.examine import examine, in_parallel
from companion.doctor.listening import listen
from companion.doctor.service_query import is_here
from companion.settings import Settings
from companion.vehicle.link_url import parse_link_url
from mavlink_sim.testing import free_port
from tests.companion.command_line import companion, companion_here
from tests.companion.service_process import heartbeats, running_service

pytestmark = pytest.mark.realtime

HOLD = """
import os, socket, sys
if sys.argv[1] == "udp":
    held = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    held.bind(("127.0.0.1", int(sys.argv[2])))
else:
    os.open(sys.argv[2], os.O_RDWR | os.O_NOCTTY)
print("held", flush=True)
sys.stdin.read()
"""


@contextmanager
def another_program(*what: str) -> Iterator[int]:
    """A program that holds a UDP port or a device; yields its process."""
    command = [sys.executable, "-c", HOLD, *what]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == b"held\n"
        try:
            yield program.pid
        finally:
            program.kill()


def flags(port: int) -> list[str]:
    """Of a doctor whose default ports are nobody's."""
    taken = free_port(socket.SOCK_STREAM)
    return [
        *("--vehicle-url", f"udpin://127.0.0.1:{port}", "--source", "none", "--dashboard-listen", ""),
        *("--zenoh-listen", f"tcp/127.0.0.1:{taken}"),
    ]


def doctor(folder: Path, *arguments: str) -> tuple[int, dict[str, list[dict[str, Any]]]]:
    """Return the exit code, and the results by name."""
    began_s = time.monotonic()
    results = results_of(companion("doctor", "--json", *arguments, cwd=folder, timeout_s=60.0))
    assert time.monotonic() - began_s < 30.0  # 10 s on a computer that is not busy
    return results


def results_of(done: subprocess.CompletedProcess[str]) -> tuple[int, dict[str, list[dict[str, Any]]]]:
    assert done.stderr == ""
    results: dict[str, list[dict[str, Any]]] = {}
    for check in json.loads(done.stdout):
        results.setdefault(check["name"], []).append(check)
    return done.returncode, results


def test_heartbeats_are_listened_to_without_a_service(tmp_path: Path) -> None:
    with heartbeats() as port:
        code, results = doctor(tmp_path, *flags(port))
    assert code in (0, 1)  # warnings of the machine that runs the tests
    (link,) = results["heartbeats"]
    assert link["verdict"] == "ok"
    assert "PX4" in link["found"]
    assert results["vehicle port"][0]["verdict"] == "ok"


def test_nothing_is_sent_while_listening() -> None:
    port = free_port()
    heartbeat = mavlink.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3).pack(mavlink.MAVLink(None, 1, 1))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle, ThreadPoolExecutor() as pool:
        vehicle.bind(("127.0.0.1", 0))
        listening = pool.submit(listen, parse_link_url(f"udpin://127.0.0.1:{port}"), 1.0)
        while not listening.done():
            vehicle.sendto(heartbeat, ("127.0.0.1", port))
            time.sleep(0.05)
        assert listening.result().senders[1, 1].heartbeats > 1
        vehicle.setblocking(False)
        with pytest.raises(BlockingIOError):
            vehicle.recv(1000)


def test_program_on_the_vehicles_port_is_named(tmp_path: Path) -> None:
    port = free_port()
    with another_program("udp", str(port)) as pid:
        code, results = doctor(tmp_path, *flags(port))
    assert code == 2
    (taken,) = results["vehicle port"]
    assert taken["verdict"] == "fault"
    assert str(pid) in taken["found"]
    assert taken["advice"].startswith("kill ")
    assert results["heartbeats"][0]["verdict"] == "unknown"


def test_program_on_the_serial_device_is_named_and_loses_nothing(tmp_path: Path) -> None:
    near, far = pty.openpty()
    try:
        device = os.ttyname(far)
        with another_program("serial", device) as pid:
            url = f"serial://{device}:57600"
            code, results = doctor(tmp_path, *flags(14540), "--vehicle-url", url)
    finally:
        os.close(near)
        os.close(far)
    assert code == 2
    assert any(f"process {pid}" in check["found"] for check in results["serial line"])
    assert results["heartbeats"][0]["verdict"] == "unknown"


def test_wrong_settings_are_results_and_no_error(tmp_path: Path) -> None:
    done = companion_here("doctor", "--json", "--detector-confidence", "3", cwd=tmp_path)
    code, results = results_of(done)
    assert code == 2
    assert "detector.confidence" in results["settings"][0]["found"]
    assert "camera device" not in results


def test_unknown_settings_file_is_a_result(tmp_path: Path) -> None:
    code, results = results_of(companion_here("doctor", "--json", "--config", "absent.toml", cwd=tmp_path))
    assert code == 2
    assert "absent.toml" in results["settings"][0]["found"]


def test_running_service_is_asked_and_its_port_is_its_own(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(examination, "listen", lambda *_: pytest.fail("the link was opened"))
    monkeypatch.setattr(examination, "open_source", lambda *_: pytest.fail("a camera was opened"))
    with heartbeats() as port, running_service(port, ["--source", "none"], cwd=tmp_path) as service:
        settings = Settings.from_json({"zenoh": {"listen": [service.endpoint]}})
        checks = examine(settings, None)
        results = {check.name: check for check in checks}
        # The port is in the settings of the service alone.
        assert str(port) in results["vehicle port"].found
        assert results["vehicle port"].verdict is Verdict.OK
        assert results["zenoh port"].verdict is Verdict.OK
        assert results["autopilot"].verdict is Verdict.OK
        assert "heartbeats" not in results
        assert "camera device" not in results

        done = companion_here("status", "--connect", service.endpoint, cwd=tmp_path)
        assert (done.returncode, done.stderr) == (0, "")
        assert "vehicle1" in done.stdout
        assert "PX4" in done.stdout
        assert "\x1b" not in done.stdout
        assert max(map(len, done.stdout.splitlines())) <= 80

        service.signal(signal.SIGSTOP)
        try:
            code, hung = doctor(tmp_path, *flags(port), "--zenoh-listen", service.endpoint)
        finally:
            service.signal(signal.SIGCONT)
        assert code == 2
        assert hung["service"][0]["verdict"] == "fault"
        assert str(service.pid) in hung["vehicle port"][0]["found"]


def test_service_warns_of_a_misspelt_variable(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COMPANION_DETECTR__CONFIDENCE", "0.5")
    with heartbeats() as port, running_service(port, ["--source", "none"], cwd=tmp_path) as service:
        line = service.wait_for_line("COMPANION_DETECTOR_CONFIDENCE?")
    assert line.startswith("WARNING")


def test_status_redraws_until_ctrl_c(tmp_path: Path) -> None:
    with heartbeats() as port, running_service(port, ["--source", "none"], cwd=tmp_path) as service:
        command = [sys.executable, "-m", "companion.cli", "status", "--watch", "--connect", service.endpoint]
        with subprocess.Popen(
            command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        ) as watching:
            try:
                assert watching.stdout is not None
                screens = 0
                for line in watching.stdout:
                    screens += line.startswith("vehicle ")
                    if screens == 3:
                        break
                watching.send_signal(signal.SIGINT)
                _, errors = watching.communicate(timeout=30)
            finally:
                watching.kill()
    assert (watching.returncode, errors) == (0, "")


def test_status_without_a_service_is_one_line_and_code_1(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    done = companion_here("status", "--connect", endpoint, cwd=tmp_path)
    assert (done.returncode, done.stdout) == (1, "")
    (line,) = done.stderr.splitlines()
    assert endpoint in line


def test_slow_trial_does_not_hold_up_the_others() -> None:
    finished: list[str] = []
    began_s = time.monotonic()
    in_parallel([lambda: time.sleep(60), lambda: finished.append("quick")], 0.3)
    assert time.monotonic() - began_s < 5.0
    assert finished == ["quick"]


def test_addresses_of_this_computer_are_known() -> None:
    assert is_here("tcp/127.0.0.1:7447")
    assert is_here("tcp/localhost:7447")
    assert is_here("tls/[::1]:7447") or not socket.has_ipv6
    assert not is_here("tcp/192.0.2.1:7447")  # TEST-NET-1 of RFC 5737
