"""Faults typed on a console: pipes, files and a real terminal."""

from __future__ import annotations

import os
import pty
import select
import tty
from collections.abc import Callable
from pathlib import Path

import pytest

from mavlink_sim.faults.console import FaultConsole
from mavlink_sim.faults.schedule import Outcome
from mavlink_sim.vehicles.vehicle import Vehicle


@pytest.fixture
def lines() -> list[str]:
    return []


@pytest.fixture
def command() -> Callable[[str], Outcome]:
    vehicle = Vehicle()
    vehicle.add_link("onboard")
    return vehicle.faults.command


def test_lines_executed_when_complete(command: Callable[[str], Outcome], lines: list[str]) -> None:
    reading, writing = os.pipe()
    console = FaultConsole(reading, command, lines.append)
    console.poll()  # nothing typed: nothing waits
    os.write(writing, b"link_del")
    console.poll()
    assert lines == []
    os.write(writing, b"ay 0.2\n\n# a remark\nwind\nlist\n")
    console.poll()
    assert lines[0] == "fault 1 link_delay 0.2"
    assert lines[1].startswith("not done: wind")
    assert lines[2].startswith("1 link_delay 0.2: since")
    os.write(writing, b"end all")
    os.close(writing)
    console.poll()
    console.poll()
    assert lines[3] == "ended 1"
    console.poll()  # the end was reached: nothing more happens
    assert len(lines) == 4
    console.close()
    os.close(reading)


def test_file_is_read_completely(command: Callable[[str], Outcome], lines: list[str], tmp_path: Path) -> None:
    path = tmp_path / "faults"
    path.write_text("link_loss for=3\nstall at=9")
    descriptor = os.open(path, os.O_RDONLY)
    console = FaultConsole(descriptor, command, lines.append)
    for _ in range(3):
        console.poll()
    assert lines == ["fault 1 link_loss for=3", "fault 2 stall at 9 s"]
    console.close()
    os.close(descriptor)


def test_terminal_is_read_and_may_close(command: Callable[[str], Outcome], lines: list[str]) -> None:
    controller, terminal = pty.openpty()
    tty.setraw(terminal)
    console = FaultConsole(terminal, command, lines.append)
    os.write(controller, b"gust 5\n")
    assert select.select([terminal], [], [], 10.0)[0]  # the terminal hands it on in its own time
    console.poll()
    assert lines == ["fault 1 gust 5"]
    os.close(controller)
    console.poll()
    console.poll()
    console.close()
    os.close(terminal)


def test_binary_and_endless_lines_are_harmless(command: Callable[[str], Outcome], lines: list[str]) -> None:
    reading, writing = os.pipe()
    console = FaultConsole(reading, command, lines.append)
    os.write(writing, b"\xff\xfe\x00\n")
    console.poll()
    assert lines[0].startswith("not done: ")
    for _ in range(8):
        os.write(writing, b"x" * 4096)
        console.poll()
    os.write(writing, b"\nlist\n")
    console.poll()
    assert lines[-1] == "no faults"
    console.close()
    os.close(reading)
    os.close(writing)
