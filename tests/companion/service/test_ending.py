"""Everything that ends the service ends it alike: HOLD, the pending command answered, exit code 0."""

from __future__ import annotations

import asyncio
import os
import pty
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from companion.vehicle.state import LandedState
from mavlink_sim.testing import RunningSimulator, running_simulator
from tests.companion.live_flight import LiveFlight
from tests.companion.service_process import TWICE, ServiceProcess, running_service

pytestmark = pytest.mark.realtime

LOW_M = 2.0  # flown by setpoints from the ground
NO_CAMERA = ("--source", "none")
# Ends as a program that flies, when its reader or a signal says so; 7: it was ended in order.
PROGRAM = """
import asyncio, sys
from companion.service.ending import EndedError, until_ended
async def work():
    print("working", flush=True)
    try:
        await asyncio.Event().wait()
    finally:
        await asyncio.sleep(1.0)  # a hold, say: a second signal does not skip it
        open(sys.argv[1], "w").close()
try:
    asyncio.run(until_ended(work()))
except EndedError:
    sys.exit(7)
"""


@pytest.fixture(autouse=True)
def default_signals() -> Iterator[None]:
    """Programs inherit what is ignored: under nohup, SIGHUP would be."""
    before = {number: signal.signal(number, signal.SIG_DFL) for number in (signal.SIGHUP, signal.SIGTERM)}
    before[signal.SIGINT] = signal.signal(signal.SIGINT, signal.default_int_handler)  # of "&" in a shell
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.fixture(scope="module")
def simulator() -> Iterator[RunningSimulator]:
    """One for all ways: each finds it on the ground, or in the air where the one before has left it."""
    with running_simulator(**TWICE) as running:
        yield running


def in_the_air(simulator: RunningSimulator) -> bool:
    changes = [event for event in simulator.events if event.startswith(("takeoff", "disarmed"))]
    return changes[-1:] == ["takeoff"]


def end(service: ServiceProcess, way: str, terminal: int) -> None:
    if way == "terminal":
        os.close(terminal)
        return
    for name in way.split():
        service.signal(signal.Signals[name])


@pytest.mark.parametrize("way", ["SIGINT", "SIGTERM", "SIGHUP", "SIGTERM SIGINT SIGHUP", "terminal"])
def test_ending_in_flight_requests_hold(way: str, simulator: RunningSimulator, tmp_path: Path) -> None:
    terminal, console = pty.openpty()
    replies: list[dict[str, Any]] = []
    with running_service(simulator.onboard_port, NO_CAMERA, cwd=tmp_path, stdin=console) as service:
        os.close(console)
        since = len(simulator.events)
        if not in_the_air(simulator):
            service.take_off(2.0)

        def fly() -> None:
            replies.append(service.command_when_it_can("goto forward=60 right=0"))

        asking = threading.Thread(target=fly)
        asking.start()
        service.wait_for_line("command: goto")
        simulator.wait_for_event("mode OFFBOARD", since=since)
        offboard = simulator.events.index("mode OFFBOARD", since)
        end(service, way, terminal)
        assert service.process.wait(20) == 0
        simulator.wait_for_event("mode HOLD", since=offboard)
        last = service.wait_for_line("ends, its vehicle is armed: ", 5.0)
        assert last.startswith("WARNING ")
        assert "hold mode" in last
        asking.join(20)
    assert [reply["success"] for reply in replies] == [False]
    if way != "terminal":
        os.close(terminal)


@pytest.mark.parametrize("altitude_m", [LOW_M, 6.0])
@pytest.mark.parametrize("arming", [True, False], ids=["arming", "armed"])
async def test_ending_on_the_ground_disarms_what_it_armed(altitude_m: float, arming: bool) -> None:
    """PX4 would disarm by itself after COM_DISARM_PRFLT, 10 s."""
    with running_simulator(ready_after=0.0) as simulator:
        flight = LiveFlight("pymavlink", simulator.onboard_port)
        async with flight.running():
            await flight.until(lambda: flight.driver.state.ready_to_arm)
            asking = asyncio.create_task(flight.fly(f"takeoff {altitude_m}"))
            if arming:
                await flight.until(lambda: flight.guidance.armed_on_ground)
            else:
                await flight.until(lambda: flight.driver.state.armed)
            await asyncio.wait_for(flight.loop.shut_down(), 5.0)
            await flight.until(lambda: not flight.driver.state.armed, 2.0)
            assert flight.driver.state.landed is LandedState.ON_GROUND
            assert not (await asking).success
        assert [text for level, text in flight.events if level == "error" or "is armed" in text] == []


@pytest.mark.parametrize("way", ["SIGINT", "SIGTERM", "SIGHUP", "reader"])
def test_work_ends_in_order_by_each_way(way: str, tmp_path: Path) -> None:
    ended = tmp_path / "ended"
    program = [sys.executable, "-c", PROGRAM, str(ended)]
    with subprocess.Popen(program, stdout=subprocess.PIPE) as running:
        try:
            assert running.stdout is not None
            assert running.stdout.readline() == b"working\n"
            if way == "reader":
                running.stdout.close()
            else:
                for _ in range(2):
                    running.send_signal(signal.Signals[way])
            assert running.wait(20) == 7
        finally:
            running.kill()
    assert ended.exists()


@pytest.mark.parametrize("journal", ["output", "terminal"])
def test_reader_counts_unless_it_is_the_journal(journal: str, tmp_path: Path) -> None:
    """A terminal of the desktop, a unit itself, passes its own JOURNAL_STREAM on."""
    ours, outputs = socket.socketpair()
    stream = os.fstat(outputs.fileno())
    name = f"{stream.st_dev}:{stream.st_ino}" if journal == "output" else "8:1"
    program = [sys.executable, "-c", PROGRAM, str(tmp_path / "ended")]
    environment = {**os.environ, "JOURNAL_STREAM": name}
    with subprocess.Popen(program, stdout=outputs.fileno(), env=environment) as running:
        try:
            outputs.close()
            with ours, ours.makefile("rb") as reader:
                assert reader.readline() == b"working\n"
            if journal == "output":
                with pytest.raises(subprocess.TimeoutExpired):
                    running.wait(2.0)  # four looks at the readers
                running.terminate()
            assert running.wait(20) == 7
        finally:
            running.kill()
