"""A vehicle in its own process, for integration tests.

>>> with running_simulator(seed=3, speed=4.0) as simulator:      # doctest: +SKIP
...     connect(simulator.mavsdk_url)

In asyncio code `async with vehicle(seed=3) as simulator:` does the same without blocking the loop.
"""

from __future__ import annotations

import asyncio
import os
import random
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

READY = re.compile(r"^ready: system (\d+), onboard \S+:(\d+) -> (\d+), ground station \S+:(\d+) -> (\d+)")

FLEET_READY = re.compile(r"^ready: \d+ vehicles")

# PX4 parameters with which a flight in real time takes half as long: it is at 2.5 m after 2.9 s instead of
# 6.6 s, and on the ground and disarmed after 3.9 s instead of 8.4 s.
QUICK_FLIGHT = {
    "COM_SPOOLUP_TIME": 0.0,
    "MPC_TKO_RAMP_T": 0.3,
    "MPC_JERK_AUTO": 40.0,
    "MPC_LAND_SPEED": 2.0,
    "MPC_LAND_CRWL": 1.0,
    "COM_DISARM_LAND": 0.2,
}

# Between the choice of a port and its use another program may request any; Linux assigns those from 32768 on.
_NOT_GIVEN_AWAY = range(16384, 32768)
_LINES_NOTED = 30
# Of real time: still enough for the autopilot's timeout of a simulator at `speed` 20.
_SETPOINT_PERIOD_S = 0.02
_ARM_DISARM, _SET_MODE = 400, 176
_GROUND_STATION = (255, 190)
# The mode for setpoints, and DO_SET_MODE's parameter 2 for it.
_SETPOINT_MODES = {"px4": ("OFFBOARD", 6.0), "ardupilot": ("GUIDED", 4.0)}
_chance = random.SystemRandom()  # parallel tests may all have the same seed


def start_simulator(arguments: Sequence[str]) -> subprocess.Popen[str]:
    """Start `mavlink-sim`. On Linux it ends when this program does. Its input and output are text pipes.

    Raises:
        OSError: it cannot be started.
    """
    parent = ["--parent-pid", str(os.getpid())] if hasattr(os, "pidfd_open") else []
    return subprocess.Popen(
        [sys.executable, "-m", "mavlink_sim", *arguments, *parent],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )


def free_udp_port_range(count: int, host: str = "127.0.0.1") -> int:
    """The first of `count` consecutive UDP ports that are free now.

    Raises:
        OSError: none were found in a hundred attempts.
    """
    for _ in range(100):
        start = free_port(host=host)
        try:
            with ExitStack() as stack:
                for port in range(start, start + count):
                    candidate = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
                    candidate.bind((host, port))
        except (OSError, OverflowError):
            continue
        return start
    raise OSError(f"no {count} consecutive UDP ports are free on {host}")


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM, host: str = "127.0.0.1") -> int:
    """A port (UDP by default) that is free now, outside the range that the system assigns.

    Raises:
        OSError: none was found in a thousand attempts.
    """
    return _free_ports(1, kind, host)[0]


def free_udp_ports(count: int, host: str = "127.0.0.1") -> list[int]:
    """UDP ports as `free_port` finds them, no two the same.

    Raises:
        OSError: fewer were found in a thousand attempts.
    """
    return _free_ports(count, socket.SOCK_DGRAM, host)


def _free_ports(count: int, kind: socket.SocketKind, host: str) -> list[int]:
    ports: list[int] = []
    with ExitStack() as stack:
        for _ in range(1000):
            if len(ports) == count:
                return ports
            port = _chance.choice(_NOT_GIVEN_AWAY)
            candidate = stack.enter_context(socket.socket(socket.AF_INET, kind))
            try:
                candidate.bind((host, port))
            except OSError:
                continue
            ports.append(port)
    first, last = _NOT_GIVEN_AWAY[0], _NOT_GIVEN_AWAY[-1]
    raise OSError(f"found {len(ports)} of {count} free ports on {host} between {first} and {last}")


@dataclass(frozen=True, slots=True)
class FleetMember:
    """One vehicle of a running fleet: its system id, and the ports as `RunningSimulator` names them."""

    system_id: int
    onboard_bind: int
    onboard_port: int
    gcs_bind: int
    gcs_port: int


class RunningSimulator:
    """A running `mavlink-sim`.

    Attributes:
        onboard_port: the UDP port a companion listens on (`udpin:127.0.0.1:<port>`); the vehicle sends there.
        gcs_port: the same for a ground station.
        onboard_bind, gcs_bind: the ports that the vehicle is bound to.
        vehicles: every vehicle of a fleet in order (the ports above are the first one's).
        events: every line it printed so far, in order, without the ready line.
        transcript: every line it printed, each after the seconds since it was started.

    >>> from mavlink_sim import running_simulator
    >>> with running_simulator(ready_after=0.0) as simulator:
    ...     simulator.arm()
    >>> "armed" in simulator.events
    True
    """

    def __init__(self, process: subprocess.Popen[str], count: int = 1, autopilot: str = "px4") -> None:
        self.process = process
        self.vehicles: list[FleetMember] = []
        self._count = count
        self.events: list[str] = []
        self.transcript: list[str] = []
        self._started_s = time.monotonic()
        self.onboard_port = self.onboard_bind = self.gcs_port = self.gcs_bind = 0
        self._ready = False
        self._ended = False
        self._changed = threading.Condition()
        self._autopilot = autopilot
        self._client: _Client | None = None
        self._reader = threading.Thread(target=self._read, name="simulator-output", daemon=True)
        self._reader.start()

    @property
    def pid(self) -> int:
        return self.process.pid

    @property
    def mavsdk_url(self) -> str:
        """What MAVSDK's `add_any_connection` takes, for a companion."""
        return f"udpin://127.0.0.1:{self.onboard_port}"

    @property
    def pymavlink_device(self) -> str:
        """What pymavlink's `mavlink_connection` takes, for a companion."""
        return f"udpin:127.0.0.1:{self.onboard_port}"

    @property
    def gcs_pymavlink_device(self) -> str:
        """What pymavlink and MAVProxy's `--master` take, for a ground station."""
        return f"udpin:127.0.0.1:{self.gcs_port}"

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._on_line(line.rstrip("\n"))
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def _on_line(self, line: str) -> None:
        found = READY.match(line)
        with self._changed:
            self.transcript.append(f"{time.monotonic() - self._started_s:9.3f} {line}")
            if found:
                self.vehicles.append(FleetMember(*map(int, found.groups())))
                first = self.vehicles[0]
                self.onboard_bind, self.onboard_port = first.onboard_bind, first.onboard_port
                self.gcs_bind, self.gcs_port = first.gcs_bind, first.gcs_port
                self._ready = len(self.vehicles) == self._count
            elif FLEET_READY.match(line):
                pass  # every vehicle has printed it
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
            raise TimeoutError(f"no {what} of the simulator in {timeout_s:g} s; events: {self.events}")

    def wait_until_ready(self, timeout_s: float) -> None:
        self._wait(lambda: self._ready, "ready line", timeout_s)

    def wait_for_event(self, text: str, timeout_s: float = 30.0, since: int = 0) -> str:
        """Wait for the first printed line that contains `text`, and return it.

        Args:
            since: search from this index of `events` on (`len(simulator.events)`: only new lines).

        Raises TimeoutError or, if the simulator ended, RuntimeError.
        """

        def found() -> list[str]:
            return [line for line in self.events[since:] if text in line]

        self._wait(lambda: bool(found()), f"line with {text!r}", timeout_s)
        return found()[0]

    def kill(self) -> None:
        """Kill it (SIGKILL), as if the vehicle vanished."""
        self.process.kill()
        self.process.wait()

    def suspend(self) -> None:
        self.process.send_signal(signal.SIGSTOP)

    def resume(self) -> None:
        self.process.send_signal(signal.SIGCONT)

    def fault(self, line: str) -> None:
        """Send a line of the fault grammar to the simulator's console: `link_loss for=3`, `end all`…"""
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    # ---- flying it, on the ground station's link; a client under test has the onboard link ---------------

    def arm(self, timeout_s: float = 5.0) -> None:
        """Arm the (first) vehicle. Raises TimeoutError if it refuses."""
        since = len(self.events)
        self._own_client().command(_ARM_DISARM, 1.0)
        self.wait_for_event("armed", timeout_s, since)

    def set_velocity(
        self, north_mps: float, east_mps: float, down_mps: float, yaw_rad: float | None = None
    ) -> None:
        """Set a velocity over ground of the (first) vehicle, local NED, metres per second.

        SET_POSITION_TARGET_LOCAL_NED is sent 50 times per second in OFFBOARD (ArduPilot: GUIDED), until
        another of these three is called. An ArduPilot on the ground has to take off first.

        >>> with running_simulator(ready_after=0.0) as simulator:
        ...     simulator.set_velocity(0.0, 0.0, -1.0)
        ...     simulator.arm()
        ...     simulator.wait_for_event("takeoff")
        'takeoff'

        Args:
            yaw_rad: heading, clockwise from north; None: unchanged.

        Raises:
            TimeoutError: the mode is not available now; no setpoints are sent.
            ValueError: a number is not finite.
        """
        from mavlink_sim.wire.setpoints import velocity_setpoint

        system_id = self.vehicles[0].system_id
        self._stream(velocity_setpoint(north_mps, east_mps, down_mps, yaw_rad, system_id=system_id))

    def set_position(
        self, north_m: float, east_m: float, down_m: float, yaw_rad: float | None = None
    ) -> None:
        """Set a position, local NED, metres. Otherwise as `set_velocity`."""
        from mavlink_sim.wire.setpoints import position_setpoint

        system_id = self.vehicles[0].system_id
        self._stream(position_setpoint(north_m, east_m, down_m, yaw_rad, system_id=system_id))

    def stop_setpoints(self) -> None:
        """Stop the setpoints; the vehicle reacts to their end (PX4: COM_OBL_RC_ACT)."""
        if self._client is not None:
            self._client.setpoint = None

    def _own_client(self) -> _Client:
        if self._client is None:
            self._client = _Client(self.gcs_bind, self.vehicles[0].system_id)
        return self._client

    def _stream(self, message: Any) -> None:
        client = self._own_client()
        if client.setpoint is None:
            client.setpoint = message
            time.sleep(5 * _SETPOINT_PERIOD_S)  # PX4 accepts OFFBOARD only with a setpoint stream
        client.setpoint = message
        name, number = _SETPOINT_MODES[self._autopilot]
        if self._mode() != name:
            since = len(self.events)
            client.command(_SET_MODE, 1.0, number)
            try:
                self.wait_for_event(f"mode {name}", 5.0, since)
            except TimeoutError:
                client.setpoint = None
                raise

    def _mode(self) -> str:
        """The mode of the (first) vehicle by its newest event; empty before the first change."""
        lines = (line.removeprefix("vehicle 1: ") for line in reversed(self.events))
        return next((line.removeprefix("mode ") for line in lines if line.startswith("mode ")), "")

    def stop(self, timeout_s: float = 10.0) -> int:
        """Stop it (SIGTERM, then SIGKILL). Returns the exit code."""
        if self.process.poll() is None:
            self.resume()
            self.process.terminate()
            try:
                self.process.wait(timeout_s)
            except subprocess.TimeoutExpired:
                self.process.kill()
        code = self.process.wait()
        self._reader.join(timeout_s)
        if self._client is not None:
            self._client.close()
        return code


class _Client:
    """Sends commands, and a setpoint at a rate from a thread of its own, to one port of a vehicle.

    Attributes:
        setpoint: the message to repeat; None: none.
    """

    def __init__(self, port: int, system_id: int) -> None:
        from mavlink_sim.wire.messages import parser

        self.setpoint: Any = None
        self._system_id = system_id
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", port))
        self._codec = parser(*_GROUND_STATION)
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._repeat, name="setpoints", daemon=True)
        self._thread.start()

    def command(self, identifier: int, *parameters: float) -> None:
        """Send COMMAND_LONG; its effect is an event of the vehicle."""
        from mavlink_sim.wire.messages import dialect

        values = (*parameters, *[0.0] * (7 - len(parameters)))
        self._send(dialect.MAVLink_command_long_message(self._system_id, 1, identifier, 0, *values))

    def close(self) -> None:
        self._closed.set()
        self._thread.join()
        self._socket.close()

    def _repeat(self) -> None:
        while not self._closed.wait(_SETPOINT_PERIOD_S):
            if (setpoint := self.setpoint) is not None:
                self._send(setpoint)

    def _send(self, message: Any) -> None:
        with self._lock, suppress(ConnectionRefusedError):  # the vehicle has just ended
            self._socket.send(message.pack(self._codec))


@contextmanager
def running_simulator(
    *,
    onboard_port: int | None = None,
    gcs_port: int | None = None,
    onboard_bind: int = 0,
    gcs_bind: int = 0,
    parameters: dict[str, float] | None = None,
    faults: Sequence[str] = (),
    timeout_s: float = 60.0,
    **options: float | str | Path | None,
) -> Iterator[RunningSimulator]:
    """Start a vehicle, wait until it runs, stop it afterwards; on Linux at the latest when this program ends.

    An exception while it runs gets its last events as a note (PEP 678).

    Args:
        onboard_port, gcs_port: where it sends to; None for free ports.
        onboard_bind, gcs_bind: what it binds; pass a former run's port to restart at the same address.
        parameters: PX4 parameters.
        faults: each as for `mavlink-sim --fault`; `RunningSimulator.fault` adds more while it runs.
        timeout_s: for the ready line.
        options: the other options of `mavlink-sim`, with underscores (`seed=1`, `speed=4.0`, `camera="name"`,
            `truth=path`, `wind=3.0`, `gusts=0.0`, `system_id=2`, `vehicles=3`); True for an option without a
            value, None for none.

    >>> from mavlink_sim import QUICK_FLIGHT, running_simulator
    >>> with running_simulator(seed=3, speed=4.0, parameters=QUICK_FLIGHT) as simulator:
    ...     simulator.pymavlink_device.startswith("udpin:127.0.0.1:")
    True
    """
    count = int(options.get("vehicles") or 1)  # type: ignore[arg-type]
    ports = free_udp_ports(2)
    if count > 1 and onboard_port is None:
        ports[0] = free_udp_port_range(count)
    arguments = {
        "onboard_port": ports[0] if onboard_port is None else onboard_port,
        "gcs_port": ports[1] if gcs_port is None else gcs_port,
        "onboard_bind": onboard_bind,
        "gcs_bind": gcs_bind,
        **options,
    }
    if isinstance(options.get("noise"), bool):  # the only option with the values on and off
        arguments["noise"] = "on" if options["noise"] else "off"
    command = []
    for name, value in arguments.items():
        if value is None or value is False:
            continue
        command += [f"--{name.replace('_', '-')}", *([] if value is True else [str(value)])]
    for name, value in (parameters or {}).items():
        command += ["--param", f"{name}={value}"]
    for fault in faults:
        command += ["--fault", fault]
    command += ["--console"]
    with start_simulator(command) as process:
        try:
            simulator = RunningSimulator(process, count, str(options.get("autopilot") or "px4"))
        except BaseException:
            process.kill()
            raise
        try:
            simulator.wait_until_ready(timeout_s)
            yield simulator
        except BaseException as error:  # a test's timeout is no Exception
            error.add_note("\n".join(["last events of the vehicle:", *simulator.transcript[-_LINES_NOTED:]]))
            raise
        finally:
            simulator.stop()
            assert process.stdin is not None
            with suppress(BrokenPipeError):
                process.stdin.close()


class vehicle:  # noqa: N801 - used as a function, like the context managers of the standard library
    """A running vehicle that can be armed at once: `with vehicle() as v:` or `async with vehicle() as v:`.

    Args:
        options: those of `running_simulator`. `ready_after` is 0 here: no wait for the estimator.
    """

    def __init__(self, **options: Any) -> None:
        self._running = running_simulator(**{"ready_after": 0.0, **options})

    def __enter__(self) -> RunningSimulator:
        return self._running.__enter__()

    def __exit__(self, *exception: Any) -> None:
        self._running.__exit__(*exception)

    async def __aenter__(self) -> RunningSimulator:
        return await asyncio.to_thread(self.__enter__)

    async def __aexit__(self, *exception: Any) -> None:
        await asyncio.to_thread(self.__exit__, *exception)
