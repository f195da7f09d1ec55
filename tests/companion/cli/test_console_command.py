"""`companion console`: terminals and pipes at a running service, in real time."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import pytest

from companion.bus.topics import STATUS
from companion.host.peer_data import copy_payload, parse_object
from mavlink_sim.testing import QUICK_FLIGHT, free_port, running_simulator
from tests.companion.cli.test_only_vehicle import services
from tests.companion.command_line import QUICK, companion_here
from tests.companion.operator.terminal import CTRL_C, CTRL_D, UP, TerminalProcess, at_terminal
from tests.companion.service_process import ServiceProcess, heartbeats, running_service

pytestmark = pytest.mark.realtime

NO_CAMERA = ("--source", "none")
STUCK_S = 8.0  # longer than zenoh waits for a reader before it closes the connection, 5 s


@contextmanager
def service_on_the_ground(folder: Path) -> Iterator[ServiceProcess]:
    with heartbeats() as port, running_service(port, NO_CAMERA, cwd=folder) as service:
        yield service


def console_at(service: ServiceProcess, folder: Path, *words: str) -> AbstractContextManager[TerminalProcess]:
    environment = {"XDG_STATE_HOME": str(folder / "state")}
    return at_terminal("console", "--connect", service.endpoint, *words, cwd=folder, environment=environment)


def piped(endpoint: str, lines: str, folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "companion.cli", "console", "--connect", endpoint, *words]
    return subprocess.run(
        command, input=lines, capture_output=True, text=True, cwd=folder, timeout=60.0, check=False
    )


def test_pipe_is_answered_in_order_and_ends_with_the_last_failure(tmp_path: Path) -> None:
    with service_on_the_ground(tmp_path) as service:
        wrong = "set guidance.max_altitude_m=high\nhold\nset guidance.max_altitude_m=20\n\nstatus\n"
        done = piped(service.endpoint, wrong, tmp_path)
        assert done.returncode == 1, done.stdout + done.stderr
        words = [line.split()[0] for line in done.stdout.splitlines()]
        assert words == ["set", "hold:", "guidance.max_altitude_m", "vehicle1:"]
        done = piped(service.endpoint, "hold\nset guidance.max_altitude_m\nquit\nhold\n", tmp_path)
        assert (done.returncode, len(done.stdout.splitlines())) == (2, 2)
        done = piped(service.endpoint, "help takeoff\nset\n", tmp_path)
        assert done.returncode == 0, done.stdout + done.stderr
        assert "guidance.max_altitude_m = 20.0 (file: 50.0)" in done.stdout.splitlines()


def test_only_vehicle_needs_no_name_and_several_are_listed(tmp_path: Path) -> None:
    with services("hawk") as (endpoint, received):
        done = piped(endpoint, "hold\n", tmp_path)
        assert (done.returncode, received) == (0, [("hawk", "hold")])
    with services("hawk", "owl") as (endpoint, received):
        done = piped(endpoint, "hold\n", tmp_path)
        assert (done.returncode, received) == (2, [])
        (line,) = done.stderr.splitlines()
        assert all(word in line for word in ("hawk", "owl", "--vehicle-name"))
        done = piped(endpoint, "hold\n", tmp_path, "--vehicle-name", "owl")
        assert (done.returncode, received) == (0, [("owl", "hold")])
        done = piped(endpoint, "hold\n", tmp_path, "--vehicle-name", "crow")
        (line,) = done.stderr.splitlines()
        assert (done.returncode, "'crow'" in line) == (2, True)


def test_without_a_service_it_is_one_line(tmp_path: Path) -> None:
    done = companion_here("console", "--connect", "tcp/127.0.0.1:1", cwd=tmp_path)
    (line,) = done.stderr.splitlines()
    assert (done.returncode, "companion run" in line) == (2, True)


def test_two_consoles_complete_share_a_history_and_show_events(tmp_path: Path) -> None:
    with service_on_the_ground(tmp_path) as service, console_at(service, tmp_path) as first:
        first.until_typed("")
        first.type("ho\t")
        first.until_typed("hold")
        first.type("\n")
        first.until_row("hold: failed")
        assert (tmp_path / "state/companion/console_history").stat().st_mode & 0o777 == 0o600
        first.type("takeoff altitude=1")
        with console_at(service, tmp_path) as second:
            second.until_typed("")
            second.type(UP)
            second.until_typed("hold")
            second.type("\x15set guidance.max_alt\t")
            second.until_typed("set guidance.max_altitude_m=")
            second.type("21\n")
            second.until_row("guidance.max_altitude_m = 21.0 (file: 50.0)")
            # An event while a line is typed, in the other console.
            first.until_row("setting changed: guidance.max_altitude_m")
            first.until_typed("takeoff altitude=1")
            second.type(CTRL_C)
            assert second.process.wait(20) == 0
            assert second.edits
        first.type("\x15status\n")
        assert "vehicle1:" in first.until_row("vehicle1: ")
        first.type(CTRL_D)
        assert first.process.wait(20) == 0
        assert first.edits
        assert service.process.poll() is None


def test_end_and_return_of_the_service_are_said(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    flags = ("--zenoh-listen", endpoint, *NO_CAMERA)
    with heartbeats() as port:
        with running_service(port, flags, cwd=tmp_path, endpoint=endpoint) as service:
            console = console_at(service, tmp_path)
            terminal = console.__enter__()
            try:
                # Its subscriptions are answered by then: a token that was never there cannot go.
                terminal.until_row("earlier: ")
                service.signal(signal.SIGKILL)
                terminal.until_row("has gone")
                terminal.type("hold\n")
                terminal.until_row("no service for vehicle 'vehicle1'")
            except BaseException:
                console.__exit__(*sys.exc_info())
                raise
        with running_service(port, flags, cwd=tmp_path, endpoint=endpoint):
            try:
                terminal.until_row("is back", 40.0)
                terminal.type("status\n")
                terminal.until_row("vehicle1: ")
            finally:
                console.__exit__(*sys.exc_info())


def status_of(service: ServiceProcess) -> dict[str, Any]:
    with service.client() as session:
        for reply in session.get("companion/vehicle1/status", timeout=5.0):
            assert reply.ok is not None
            return parse_object(copy_payload(reply.ok.payload, STATUS.largest_bytes))
    raise TimeoutError("no status")


def test_stuck_console_delays_neither_setpoints_nor_another_console(tmp_path: Path) -> None:
    with (
        running_simulator(ready_after=0.0, parameters=QUICK_FLIGHT) as simulator,
        running_service(simulator.onboard_port, NO_CAMERA, cwd=tmp_path) as service,
        console_at(service, tmp_path) as stuck,
        console_at(service, tmp_path) as other,
    ):
        service.take_off(3.0)
        other.until_typed("")
        stuck.until_typed("")
        stuck.type("goto 50 0 3\n")
        service.wait_for_line("offboard engaged")
        os.kill(stuck.process.pid, signal.SIGSTOP)
        orbit = service.command_when_it_can("orbit radius=3 speed=1")  # ends the other, whose answer waits
        assert orbit["success"], orbit
        began_s, before, longest_s, number = time.monotonic(), status_of(service), 0.0, 0
        while (now_s := time.monotonic()) < began_s + STUCK_S:
            number += 1
            other.type(f"nothing {number}\n")
            other.until_row(f"nothing {number}: failed")
            longest_s = max(longest_s, time.monotonic() - now_s)
        took_s, after = time.monotonic() - began_s, status_of(service)
        sent = after["pilot"]["setpoints_sent"] - before["pilot"]["setpoints_sent"]
        assert sent / took_s > 10.0  # of 50 a second; a send that blocks for 5 s ends OFFBOARD
        assert longest_s < 3.0
        assert after["vehicle"]["mode"] == "offboard"
        os.kill(stuck.process.pid, signal.SIGCONT)
        stuck.until_row("goto 50 0 3: failed")
        # Ctrl-C with a command in progress ends the console alone.
        other.type("orbit radius=3 speed=1\n")
        other.until_row("orbit radius=3 speed=1: accepted")
        other.type(CTRL_C)
        assert other.process.wait(20) == 0
        assert status_of(service)["pilot"]["command"]["command"] == "orbit radius=3 speed=1"
        assert not [line for line in service.last_lines() if "command lost" in line]


def test_terminal_of_play_is_a_console(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    words = ("play", "--source", "none", "--zenoh-listen", endpoint, "--dashboard-listen", "")
    environment = {"XDG_STATE_HOME": str(tmp_path / "state")}
    with at_terminal(*words, cwd=tmp_path, environment=environment, program=("-c", QUICK)) as terminal:
        terminal.until_row("Ctrl-C ends it", 60.0)
        terminal.until_typed("")
        terminal.type("tak\t3\n")
        terminal.type("half a line")
        terminal.until_row("takeoff 3: ", 40.0)
        terminal.until_typed("half a line")
        terminal.type("\x15set guidance.max_altitude_m=20\n")
        terminal.until_row("setting changed")
        terminal.type(CTRL_D)
        terminal.until_row("console ended")
        done = piped(endpoint, "status\n", tmp_path)
        assert done.returncode == 0, done.stderr
        terminal.type(CTRL_C)
        assert terminal.process.wait(30) == 0
        assert terminal.edits


def test_python_prompt_awaits_the_client(tmp_path: Path) -> None:
    lines = """
body = await anext(drone.status())
print("ready:", body["healthy"] in (True, False))
try:
    await drone.hold()
except Exception as error:
    print("error:", type(error).__name__)

"""
    with service_on_the_ground(tmp_path) as service:
        done = piped(service.endpoint, lines, tmp_path, "--python")
        assert done.returncode == 0, done.stderr
    printed = done.stdout + done.stderr
    assert "ready: True" in printed
    assert "error: CommandFailedError" in printed
