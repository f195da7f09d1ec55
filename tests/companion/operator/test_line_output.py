"""Standard error with a stalled reader: the service never waits for it."""

from __future__ import annotations

import fcntl
import json
import os
import queue
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from companion.bus.client import client_settings, listen, open_client, send_command
from companion.operator.line_output import LineOutput
from companion.settings import ZenohSection
from mavlink_sim.testing import free_port, running_simulator
from tests.companion.service_process import TWICE

pytestmark = pytest.mark.realtime

Pipe = tuple[int, int]


@pytest.fixture
def pipe() -> Iterator[Pipe]:
    """(reading, writing) ends."""
    ends = os.pipe()
    yield ends
    for end in ends:
        with suppress(OSError):
            os.close(end)


def fill(descriptor: int) -> int:
    """Write until the pipe is full; returns the number of bytes."""
    flags = fcntl.fcntl(descriptor, fcntl.F_GETFL)
    fcntl.fcntl(descriptor, fcntl.F_SETFL, flags | os.O_NONBLOCK)
    taken = 0
    with suppress(BlockingIOError):
        while True:
            taken += os.write(descriptor, b"." * 4096)
    fcntl.fcntl(descriptor, fcntl.F_SETFL, flags)
    return taken


def test_lines_are_written_whole_and_in_order(pipe: Pipe) -> None:
    reading, writing = pipe
    output = LineOutput(writing)
    for number in range(100):
        print("line", number, file=output)
    output.write("no end")
    assert output.end(10.0)
    os.close(writing)
    with open(reading, closefd=False) as reader:
        assert reader.read().splitlines() == [*(f"line {number}" for number in range(100)), "no end"]
    assert output.dropped == 0


def test_stalled_reader_loses_lines_without_blocking(pipe: Pipe) -> None:
    reading, writing = pipe
    before = fill(writing)
    output = LineOutput(writing, capacity_bytes=1000)
    started_s = time.monotonic()
    output.write("line 0000\n")
    while output.queued_bytes:  # until the thread waits for the reader
        time.sleep(0.001)
    for number in range(1, 10_001):
        output.write(f"line {number:04}\n")  # 10 bytes
    assert not output.end(0.1)
    assert time.monotonic() - started_s < 5.0  # a blocking write would never end
    assert output.dropped == 9_900
    read = b""
    while not read.endswith(b"was not read\n"):
        read += os.read(reading, 65536)
    lines = read[before:].decode().splitlines()
    assert lines[:-1] == [f"line {number:04}" for number in range(101)]
    assert "9900 lines" in lines[-1]


def test_lines_without_a_reader_are_counted(pipe: Pipe) -> None:
    reading, writing = pipe
    os.close(reading)
    output = LineOutput(writing)
    output.write("a\nb\n")
    assert output.end(10.0)
    assert output.dropped == 2


def test_non_blocking_descriptor_loses_nothing(pipe: Pipe) -> None:
    reading, writing = pipe
    os.set_blocking(writing, False)
    output = LineOutput(writing)
    lines = [f"{number} {'x' * 1000}" for number in range(200)]  # three times the capacity of a pipe
    for line in lines:
        output.write(f"{line}\n")
    ending = threading.Thread(target=output.end, args=(10.0,))
    ending.start()
    with open(reading, closefd=False) as reader:
        assert [reader.readline().rstrip("\n") for _ in lines] == lines
    ending.join()


ENDS = """
import sys
from companion.operator.line_output import use_for_standard_error
use_for_standard_error()
print("first", file=sys.stderr)
raise SystemExit("last") if sys.argv[1] == "exit" else RuntimeError("last")
"""


@pytest.mark.parametrize("how", ["exit", "traceback"])
def test_errors_at_exit_are_in_order(how: str) -> None:
    ended = subprocess.run([sys.executable, "-c", ENDS, how], stderr=subprocess.PIPE, text=True, check=False)
    lines = ended.stderr.splitlines()
    assert (lines[0], lines[-1][-4:], ended.returncode) == ("first", "last", 1)


def test_program_exits_with_a_full_pipe(pipe: Pipe) -> None:
    fill(pipe[1])
    process = subprocess.Popen([sys.executable, "-c", ENDS, "traceback"], stderr=pipe[1])
    try:
        assert process.wait(20) == 1
    finally:
        process.kill()


def test_service_works_with_an_unread_log(filming: list[str], pipe: Pipe, tmp_path: Path) -> None:
    fill(pipe[1])
    endpoint = f"tcp/127.0.0.1:{free_port(socket.SOCK_STREAM)}"
    settings = client_settings(ZenohSection(listen=(endpoint,)))
    statuses: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
    with running_simulator(**TWICE) as simulator:
        command = [sys.executable, "-m", "companion.cli", "run", *filming, "--source-rate-hz", "2"]
        command += ["--log-level", "debug", "--dashboard-listen", ""]
        command += [f"--vehicle-url=udpin://127.0.0.1:{simulator.onboard_port}", f"--zenoh-listen={endpoint}"]
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=pipe[1], stderr=pipe[1], cwd=tmp_path
        )
        try:
            with open_client(settings, timeout_s=60.0) as session:
                listen(session, "status", lambda _key, text: statuses.put(json.loads(text)))
                status = statuses.get(timeout=60)
                while not status["vehicle"]["connected"] or status["vehicle"]["missing_streams"]:
                    status = statuses.get(timeout=30)
                # Twenty of them are more than the queue holds: each is logged, and refused on the ground.
                path = "follow-path " + " ".join(f"{number}.25,0.250001" for number in range(1, 470))
                while not status["log"]["dropped_lines"]:
                    for _ in range(15):  # twenty a second are accepted
                        send_command(session, "vehicle1", path)
                    status = statuses.get(timeout=30)
                for text in ("takeoff 2.5", "hold"):
                    reply = send_command(session, "vehicle1", text, timeout_s=60.0)
                    assert reply["success"], reply
                while not statuses.empty():
                    statuses.get()
                sent = [statuses.get(timeout=5)["pilot"]["setpoints_sent"] for _ in range(3)]
                assert sent[2] - sent[0] > 20
            process.send_signal(signal.SIGTERM)
            assert process.wait(20) == 0
            simulator.wait_for_event("mode HOLD", since=simulator.events.index("mode OFFBOARD"))
        finally:
            process.kill()
            process.wait()


def read_until(reading: int, end: bytes) -> bytes:
    read = b""
    while not read.endswith(end):
        read += os.read(reading, 65536)
    return read


def test_what_is_shown_stays_below_the_lines(pipe: Pipe) -> None:
    reading, writing = pipe
    output = LineOutput(writing)
    output.show("> hol")
    assert read_until(reading, b"> hol") == b"\r\x1b[K> hol"
    output.print("an event")
    assert read_until(reading, b"> hol") == b"\r\x1b[Kan event\n\r\x1b[K> hol"
    output.redraw()
    assert read_until(reading, b"> hol") == b"\r\x1b[K> hol"
    assert output.end(10.0)
    os.close(writing)
    assert os.read(reading, 100) == b"\r\x1b[K"


def test_stalled_reader_gets_the_newest_that_is_shown(pipe: Pipe) -> None:
    reading, writing = pipe
    before = fill(writing)
    output = LineOutput(writing)
    for number in range(10_000):
        output.show(f"> {number}")
    read = read_until(reading, b"> 9999")[before:]
    assert len(read) < 100  # at most one that was being written before
    assert output.end(10.0)
