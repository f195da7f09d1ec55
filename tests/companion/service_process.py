"""Runs `companion run` as a separate process, for integration tests."""

from __future__ import annotations

import os
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import zenoh
from pymavlink.dialects.v20 import common as mavlink

from companion.bus.client import client_settings, open_client, send_command
from companion.settings import ZenohSection
from mavlink_sim.testing import QUICK_FLIGHT, free_port

# Options of a vehicle at twice real time. Setpoints may be as late as in real time: COM_OF_LOSS_T, 1 s by
# default, is of simulated time. ClockSync does not settle at this speed, so messages are stamped by their
# arrival: test_mavsdk_flight_with_frames_on_standard_input flies in real time, with synchronized stamps.
TWICE: dict[str, Any] = {
    "speed": 2.0,
    "ready_after": 0.0,
    "parameters": {**QUICK_FLIGHT, "COM_OF_LOSS_T": 2.0},
}
START_S = 60.0
LINES_NOTED = 40


class ServiceProcess:
    """A running `companion run` or `play`. `lines`: its output so far."""

    def __init__(self, process: subprocess.Popen[bytes], endpoint: str) -> None:
        self.process = process
        self.endpoint = endpoint
        self.url = ""  # of the dashboard, where a test sets it
        self.lines: list[str] = []
        self._queue: queue.Queue[str | None] = queue.Queue()
        self.output = process.stderr or process.stdout
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @property
    def pid(self) -> int:
        return self.process.pid

    def _read(self) -> None:
        assert self.output is not None
        for line in self.output:
            self._queue.put(line.decode(errors="replace").rstrip("\n"))
        self._queue.put(None)

    def wait_for_line(self, text: str, timeout_s: float = 30.0, *, after: int = 0) -> str:
        """Wait for the first line with `text`, from line number `after` on. Raises TimeoutError."""
        for line in self.lines[after:]:
            if text in line:
                return line
        deadline = time.monotonic() + timeout_s
        while True:
            try:
                new = self._queue.get(timeout=max(0.0, deadline - time.monotonic()))
            except queue.Empty:
                raise TimeoutError(f"no line with {text!r} in {self.lines}") from None
            if new is None:
                raise TimeoutError(f"the service ended without a line with {text!r}: {self.lines}")
            self.lines.append(new)
            if text in new:
                return new

    @contextmanager
    def client(self) -> Iterator[zenoh.Session]:
        with open_client(client_settings(ZenohSection(listen=(self.endpoint,))), timeout_s=15.0) as session:
            yield session

    def command(self, text: str, timeout_s: float = 60.0) -> dict[str, Any]:
        with self.client() as session:
            return send_command(session, "vehicle1", text, timeout_s=timeout_s)

    def take_off(self, altitude_m: float) -> None:
        """Take off, as soon as the required telemetry was received."""
        reply = self.command_when_it_can(f"takeoff {altitude_m:g}")
        assert reply["success"], reply

    def command_when_it_can(self, text: str, timeout_s: float = 60.0) -> dict[str, Any]:
        """As `command`, repeated while it is refused for a missing requirement, for up to 20 s."""
        deadline_s = time.monotonic() + 20.0
        while True:
            reply = self.command(text, timeout_s)
            if reply["success"] or " needs " not in reply["reason"] or time.monotonic() > deadline_s:
                return reply
            time.sleep(0.1)  # twenty commands a second are accepted

    def last_lines(self) -> list[str]:
        """Return the newest lines, including unread ones."""
        with suppress(queue.Empty):
            while (line := self._queue.get_nowait()) is not None:
                self.lines.append(line)
        return self.lines[-LINES_NOTED:]

    def signal(self, number: signal.Signals) -> None:
        os.kill(self.pid, number)

    def stop(self) -> int:
        if self.process.poll() is None:
            self.signal(signal.SIGCONT)
            self.process.terminate()
        try:
            return self.process.wait(45)  # of which 20 for a recorder
        except subprocess.TimeoutExpired:
            self.process.kill()
            raise
        finally:
            self._reader.join(10)


@contextmanager
def heartbeats() -> Iterator[int]:
    """An autopilot that sends heartbeats only: the service connects. Yields the port.

    For tests that neither fly nor read telemetry: a simulator needs as much of the processor as the service.
    """
    port, ended = free_port(), threading.Event()
    codec = mavlink.MAVLink(None, 1, 1)
    message = mavlink.MAVLink_heartbeat_message(
        mavlink.MAV_TYPE_QUADROTOR,
        mavlink.MAV_AUTOPILOT_PX4,
        mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED,
        4 << 16 | 3 << 24,  # PX4's AUTO.LOITER: main mode and sub mode
        mavlink.MAV_STATE_STANDBY,
        3,  # the MAVLink version
    )

    def send() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not ended.wait(0.2):
                sender.sendto(message.pack(codec), ("127.0.0.1", port))

    sending = threading.Thread(target=send, name="heartbeats", daemon=True)
    sending.start()
    try:
        yield port
    finally:
        ended.set()
        sending.join()


@contextmanager
def running_service(
    onboard_port: int,
    flags: Sequence[str],
    *,
    cwd: Path,
    endpoint: str | None = None,
    stdin: int = subprocess.DEVNULL,
) -> Iterator[ServiceProcess]:
    """Start `companion run`, wait until its vehicle and cameras are up, stop it afterwards.

    An exception in between gets the service's last lines as a note.
    """
    command = [sys.executable, "-m", "companion.cli", "run"]
    command += ["--vehicle-url", f"udpin://127.0.0.1:{onboard_port}", "--detector-threads", "1"]
    command += ["--dashboard-listen", "", *flags]
    if endpoint is None:
        endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
        command += ["--zenoh-listen", endpoint]
    process = subprocess.Popen(command, stdin=stdin, stderr=subprocess.PIPE, cwd=cwd)
    service = ServiceProcess(process, endpoint)
    try:
        service.wait_for_line(" up: autopilot", START_S)
        yield service
    except BaseException as error:  # a test's timeout is not an Exception
        error.add_note("\n".join(["last lines of the service:", *service.last_lines()]))
        raise
    finally:
        service.stop()
        assert process.stderr is not None
        process.stderr.close()
