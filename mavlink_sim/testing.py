"""A vehicle in a process of its own, for integration tests.

>>> with running_simulator(seed=3, speed=4.0) as simulator:      # doctest: +SKIP
...     connect(f"udpin://127.0.0.1:{simulator.onboard_port}")
"""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

READY = re.compile(r"^ready: system (\d+), onboard \S+:(\d+) -> (\d+), ground station \S+:(\d+) -> (\d+)")


def free_udp_ports(count: int, host: str = "127.0.0.1") -> list[int]:
    """UDP ports that nobody is bound to at this moment."""
    with ExitStack() as stack:
        ports = []
        for _ in range(count):
            candidate = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
            candidate.bind((host, 0))
            ports.append(int(candidate.getsockname()[1]))
        return ports


class RunningSimulator:
    """A `python -m mavlink_sim` that is up.

    Attributes:
        onboard_port: the UDP port a companion listens on (`udpin:127.0.0.1:<port>`); the vehicle sends there.
        gcs_port: the same for a ground station.
        onboard_bind, gcs_bind: the ports the vehicle itself is bound to.
        events: every line it printed so far, in order, without the ready line.
    """

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process
        self.events: list[str] = []
        self.onboard_port = self.onboard_bind = self.gcs_port = self.gcs_bind = 0
        self._ready = False
        self._ended = False
        self._changed = threading.Condition()
        self._reader = threading.Thread(target=self._read, name="simulator-output", daemon=True)
        self._reader.start()

    @property
    def pid(self) -> int:
        return self.process.pid

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._take(line.rstrip("\n"))
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def _take(self, line: str) -> None:
        found = READY.match(line)
        with self._changed:
            if found:
                _, self.onboard_bind, self.onboard_port, self.gcs_bind, self.gcs_port = map(
                    int, found.groups()
                )
                self._ready = True
            else:
                self.events.append(line)
            self._changed.notify_all()

    def _wait(self, condition: Callable[[], bool], what: str, timeout_s: float) -> None:
        with self._changed:
            self._changed.wait_for(lambda: condition() or self._ended, timeout_s)
            if condition():
                return
            if self._ended:
                code = self.process.wait()
                raise RuntimeError(f"the simulator ended with code {code} before {what}: {self.events}")
            raise TimeoutError(f"no {what} of the simulator in {timeout_s:g} s; it said {self.events}")

    def wait_until_ready(self, timeout_s: float) -> None:
        self._wait(lambda: self._ready, "ready line", timeout_s)

    def wait_for_event(self, text: str, timeout_s: float = 30.0, since: int = 0) -> str:
        """The first printed line that contains `text`, already printed or yet to come.

        Args:
            since: look only from this index of `events` on (`len(simulator.events)` for the future alone).

        Raises TimeoutError or, if the simulator ended, RuntimeError.
        """

        def found() -> list[str]:
            return [line for line in self.events[since:] if text in line]

        self._wait(lambda: bool(found()), f"line with {text!r}", timeout_s)
        return found()[0]

    def kill(self) -> None:
        """SIGKILL, as when the vehicle vanishes."""
        self.process.kill()
        self.process.wait()

    def suspend(self) -> None:
        os.kill(self.pid, signal.SIGSTOP)

    def resume(self) -> None:
        os.kill(self.pid, signal.SIGCONT)

    def stop(self, timeout_s: float = 10.0) -> int:
        """End it in good order (SIGTERM; SIGKILL if it does not). Returns the exit code."""
        if self.process.poll() is None:
            self.resume()
            self.process.terminate()
            try:
                self.process.wait(timeout_s)
            except subprocess.TimeoutExpired:
                self.process.kill()
        code = self.process.wait()
        self._reader.join(timeout_s)
        return code


@contextmanager
def running_simulator(
    *,
    onboard_port: int | None = None,
    gcs_port: int | None = None,
    onboard_bind: int = 0,
    gcs_bind: int = 0,
    parameters: dict[str, float] | None = None,
    timeout_s: float = 60.0,
    **options: float | str | Path,
) -> Iterator[RunningSimulator]:
    """Start a vehicle, wait until it is up, end it afterwards.

    Args:
        onboard_port, gcs_port: where it sends to; None for ports that are free now.
        onboard_bind, gcs_bind: what it binds; give a former run's port to start it anew in the same place.
        parameters: PX4 parameters.
        timeout_s: for the ready line.
        options: the other options of `mavlink-sim`, with underscores (`seed=1`, `speed=4.0`, `camera="name"`,
            `truth=path`, `wind=3.0`, `system_id=2`).
    """
    ports = free_udp_ports(2)
    arguments = {
        "onboard_port": ports[0] if onboard_port is None else onboard_port,
        "gcs_port": ports[1] if gcs_port is None else gcs_port,
        "onboard_bind": onboard_bind,
        "gcs_bind": gcs_bind,
        **options,
    }
    flags = [name for name, value in arguments.items() if value is True]
    arguments = {name: value for name, value in arguments.items() if not isinstance(value, bool)}
    command = [sys.executable, "-m", "mavlink_sim"]
    for name, value in arguments.items():
        command += [f"--{name.replace('_', '-')}", str(value)]
    command += [f"--{name.replace('_', '-')}" for name in flags]
    for name, value in (parameters or {}).items():
        command += ["--param", f"{name}={value}"]
    process = subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    simulator = RunningSimulator(process)
    try:
        simulator.wait_until_ready(timeout_s)
        yield simulator
    finally:
        simulator.stop()
        assert process.stdout is not None
        process.stdout.close()
