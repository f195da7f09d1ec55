"""What the vehicle does when a part of the companion hangs or dies in flight, timed by the simulator's truth.

The service is a process of its own, as in use. It flies an orbit, or towards a car, at 2 m/s; then a process
is stopped or killed (signal(7)), and the true velocity and mode give the rest. Real time: a busy machine
shows.
"""

from __future__ import annotations

import asyncio
import json
import math
import os
import signal
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zenoh
from rich.table import Table

from companion.bus.client import client_settings, listen, open_client, send_command
from companion.bus.topics import command_key
from companion.settings import Settings
from companion.settings.layers import SYSTEM_VARIABLE
from companion.settings.reading import to_toml
from companion.simulation.session import (
    ALTITUDE_M,
    SimOptions,
    SimSessionError,
    session_settings,
    simulator,
    with_lens,
)

SPEED_MPS = 2.0
# The speed has begun to fall below this share of the median of the second before; standing is below this.
BRAKING_SHARE, STANDING_MPS = 0.8, 0.3
_READY_S, _COMMAND_S, _WATCHED_S, _STEADY_S = 40.0, 60.0, 8.0, 2.0
_SETPOINTS = f"orbit radius=8 speed={SPEED_MPS:g}"
_BY_SIGHT = f"approach car distance=5 speed={SPEED_MPS:g}"


@dataclass(frozen=True, slots=True)
class Fault:
    """What is done to which process, during which command."""

    name: str
    command: str
    process: str
    number: signal.Signals


FAULTS = (
    Fault("the service is stopped", _SETPOINTS, "service", signal.SIGSTOP),
    Fault("the service is killed", _SETPOINTS, "service", signal.SIGKILL),
    Fault("perception is stopped", _BY_SIGHT, "perception", signal.SIGSTOP),
    Fault("perception is killed", _BY_SIGHT, "perception", signal.SIGKILL),
)


@dataclass(frozen=True, slots=True)
class Reaction:
    """Seconds from the fault until the speed falls, the vehicle stands, OFFBOARD ends; None: never."""

    braking_s: float | None
    standing_s: float | None
    failsafe_s: float | None


def reaction(rows: Sequence[dict[str, Any]], fault_ns: int) -> Reaction:
    """Read it from the simulator's truth.

    Args:
        rows: with `stamp_ns`, `velocity_ned_mps` and `mode`, in order, from a second before the fault on.

    Raises:
        ValueError: there is no record of the second before the fault.
    """
    speeds = [math.hypot(*row["velocity_ned_mps"][:2]) for row in rows]
    before = sorted(
        speed
        for row, speed in zip(rows, speeds, strict=True)
        if fault_ns - 1_000_000_000 <= row["stamp_ns"] < fault_ns
    )
    if not before:
        raise ValueError("no record of the second before the fault")
    slow_mps = BRAKING_SHARE * before[len(before) // 2]
    after = [
        ((row["stamp_ns"] - fault_ns) / 1e9, speed, row["mode"])
        for row, speed in zip(rows, speeds, strict=True)
        if row["stamp_ns"] >= fault_ns
    ]
    return Reaction(
        next((seconds for seconds, speed, _ in after if speed < slow_mps), None),
        next((seconds for seconds, speed, _ in after if speed < STANDING_MPS), None),
        next((seconds for seconds, _, mode in after if mode != "OFFBOARD"), None),
    )


def measure_deadman(runs: int, faults: Sequence[Fault] = FAULTS) -> dict[str, dict[str, list[float | None]]]:
    """Fly every fault so many times: its name → `braking_s`, `standing_s`, `failsafe_s` of each flight.

    Raises:
        SimSessionError: the vehicle did not get as far as the fault.
    """
    figures: dict[str, dict[str, list[float | None]]] = {}
    for fault in faults:
        reactions = [asyncio.run(_measure(fault, seed)) for seed in range(1, runs + 1)]
        figures[fault.name] = {
            name: [getattr(one, name) for one in reactions]
            for name in ("braking_s", "standing_s", "failsafe_s")
        }
    return figures


def deadman_table(figures: dict[str, dict[str, list[float | None]]]) -> Table:
    """The figures as a table: the longest of each."""
    runs = max((len(values["braking_s"]) for values in figures.values()), default=0)
    table = Table(title=f"seconds after the fault, the longest of {runs}")
    table.add_column("fault")
    for heading in ("brakes", "stands", "leaves OFFBOARD"):
        table.add_column(heading, justify="right")
    for name, values in figures.items():
        table.add_row(name, *(_longest(values[key]) for key in ("braking_s", "standing_s", "failsafe_s")))
    return table


def _longest(values: Sequence[float | None]) -> str:
    known = [value for value in values if value is not None]
    if not known:
        return "never"
    never = len(values) - len(known)
    return f"{max(known):.2f}" + (f" (never in {never})" if never else "")


async def _measure(fault: Fault, seed: int) -> Reaction:
    with tempfile.TemporaryDirectory(prefix="companion-bench-") as name:
        folder = Path(name)
        camera = f"companion-bench-{os.getpid()}-{seed}"
        truth = folder / "truth.jsonl"
        async with simulator(SimOptions(camera, seed, truth_path=truth)) as vehicle:
            await vehicle.until_ready()
            settings = with_lens(session_settings(vehicle.port, camera))
            (folder / "companion.toml").write_text(to_toml(settings))
            with (folder / "service.log").open("wb") as log:
                service = await asyncio.create_subprocess_exec(
                    *(sys.executable, "-m", "companion.cli", "run"),
                    *("--config", str(folder / "companion.toml")),
                    stdin=asyncio.subprocess.DEVNULL,
                    stderr=log,
                    start_new_session=True,
                    # No other file of this computer: what is unset here stays so.
                    env={**os.environ, SYSTEM_VARIABLE: name + "/none", "XDG_CONFIG_HOME": name},
                )
            try:
                fault_ns = await asyncio.to_thread(_fly_into, fault, settings, service.pid, truth)
                await asyncio.sleep(_WATCHED_S)
            finally:
                await _end(service)
        rows = [
            row for row in _rows(truth) if -1.5e9 <= row["stamp_ns"] - fault_ns <= _WATCHED_S * 1_000_000_000
        ]
        return reaction(rows, fault_ns)


def _fly_into(fault: Fault, settings: Settings, service_pid: int, truth: Path) -> int:
    """Fly until the vehicle moves steadily, then do it; the moment, CLOCK_MONOTONIC nanoseconds."""
    statuses: list[dict[str, Any]] = []
    with open_client(client_settings(settings.zenoh), timeout_s=_READY_S) as session:
        listen(session, "status", lambda _, text: statuses.append(json.loads(text)))
        _command(session, settings, f"takeoff {ALTITUDE_M:g}", patient=True)
        if fault.command is _BY_SIGHT:
            _command(session, settings, "seek car")
        # Not waited for: an approach answers when it is there.
        session.get(
            command_key(settings.vehicle.name), lambda _: None, payload=fault.command, timeout=_COMMAND_S
        )
        deadline_s = time.monotonic() + _COMMAND_S
        while not (statuses and _steady(truth)):
            if time.monotonic() > deadline_s:
                raise SimSessionError(
                    f"the vehicle did not fly {fault.command!r} steadily within {_COMMAND_S:g} s"
                )
            time.sleep(0.1)
        pid = service_pid if fault.process == "service" else statuses[-1]["perception"]["pid"]
        fault_ns = time.monotonic_ns()
        os.kill(pid, fault.number)
        return fault_ns


def _command(session: zenoh.Session, settings: Settings, text: str, *, patient: bool = False) -> None:
    """Send it; `patient`: again while something is missing that a start brings."""
    deadline_s = time.monotonic() + _READY_S
    while True:
        reply = send_command(session, settings.vehicle.name, text, timeout_s=_COMMAND_S)
        if reply["success"]:
            return
        if not patient or time.monotonic() > deadline_s:
            raise SimSessionError(f"cannot measure in flight: {text}: {reply['reason']}")
        time.sleep(0.5)


def _steady(truth: Path) -> bool:
    """Whether the vehicle has been near its commanded speed for the last seconds."""
    since_ns = time.monotonic_ns() - round(_STEADY_S * 1e9)
    speeds = [math.hypot(*row["velocity_ned_mps"][:2]) for row in _rows(truth) if row["stamp_ns"] > since_ns]
    return len(speeds) > 10 and min(speeds) > BRAKING_SHARE * SPEED_MPS


def _rows(truth: Path) -> list[dict[str, Any]]:
    # The last line may be half written.
    return [json.loads(line) for line in truth.read_text().splitlines() if line.endswith("}")]


async def _end(service: asyncio.subprocess.Process) -> None:
    """End the service and the processes it started, whatever was done to them."""
    for number in (signal.SIGCONT, signal.SIGKILL):
        try:
            os.killpg(service.pid, number)
        except ProcessLookupError:
            break
    await service.wait()
