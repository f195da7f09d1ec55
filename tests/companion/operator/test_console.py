"""The console: a real terminal, a scripted service."""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any

import pytest

from companion.operator.console import Ask, run_console, terminal_is_free


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """The other end of a terminal on standard input."""
    other, ours = os.openpty()
    with open(ours) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        yield other
    with suppress(OSError):  # the test has closed it
        os.close(other)


class Service:
    """Answers every command except "break"."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self.events: list[tuple[str, str]] = []
        self.stopped = False

    async def command(self, text: str) -> dict[str, Any]:
        self.asked.append(text)
        if text == "break":
            raise ZeroDivisionError("no such luck")
        if text == "orbit":  # it has no end
            return {"state": "in_progress", "success": True, "reason": "in progress"}
        return {"success": text != "seek dragon", "reason": f"reason {len(self.asked)}"}

    def stop(self) -> None:
        self.stopped = True

    async def run(self, ask: Ask | None = None) -> None:
        async with asyncio.timeout(20.0):
            await run_console(self.command, self.stop, "HELP", lambda *event: self.events.append(event), ask)


class Sentences:
    """Records what is passed on, and answers with a question."""

    def __init__(self) -> None:
        self.passed: list[str] = []
        self.running = self.closed = False

    async def send(self, line: str, write: Callable[[str], None]) -> None:
        if line == "break":
            raise OSError("process 7")
        self.passed.append(line)
        self.running = True
        write("fly this? ")

    async def close(self) -> None:
        self.closed = True


async def test_commands_are_answered_until_quit(terminal: int, capsys: pytest.CaptureFixture[str]) -> None:
    service = Service()
    assert terminal_is_free("/dev/video0")
    assert not terminal_is_free("-")
    os.write(terminal, b"hold\n  seek dragon \n\nbreak\norbit\nhelp\n")
    running = asyncio.create_task(service.run())
    while len(service.asked) < 4:
        await asyncio.sleep(0.001)
    os.write(terminal, b"quit\nland\n")
    await running
    assert service.asked == ["hold", "seek dragon", "break", "orbit"]
    assert service.stopped
    lines = capsys.readouterr().err.splitlines()
    assert "HELP" in lines
    parts = [line.split(": ") for line in lines]
    assert ["hold", "done", "reason 1"] in parts
    assert ["seek dragon", "failed", "reason 2"] in parts
    assert any(line.startswith("orbit: accepted, ") and line.endswith("progress") for line in lines)
    assert any("ZeroDivisionError" in line for line in lines)
    assert service.events == []


async def test_closed_terminal_ends_the_service(terminal: int) -> None:
    service = Service()
    running = asyncio.create_task(service.run())
    os.write(terminal, b"hold\n")
    while not service.asked:
        await asyncio.sleep(0.001)
    os.close(terminal)
    await running
    assert service.stopped
    assert service.events == []


async def test_sentences_and_their_answers_are_passed_on(
    terminal: int, capsys: pytest.CaptureFixture[str]
) -> None:
    service, sentences = Service(), Sentences()
    os.write(terminal, b"y\nask  find a car\ny\nhold\nvehicle2 stop\nask\nquit\n")
    await service.run(sentences)
    assert sentences.passed == ["find a car", "y", "cancel"]
    assert service.asked == ["y", "hold", "vehicle2 stop", "ask"]
    assert sentences.closed
    assert "fly this? fly this? " in capsys.readouterr().err


async def test_without_aioconsole_one_line_and_the_service_goes_on(
    terminal: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setitem(sys.modules, "aioconsole.stream", None)
    service = Service()
    await service.run()
    assert not service.stopped
    (line,) = capsys.readouterr().err.splitlines()
    assert "'mavlink-companion[service]'" in line


async def test_sentence_that_fails_leaves_the_console(
    terminal: int, capsys: pytest.CaptureFixture[str]
) -> None:
    service = Service()
    os.write(terminal, b"ask break\nstop\nquit\n")
    await service.run(Sentences())
    assert service.asked == ["stop"]
    assert service.events == []
    assert "ask: process 7" in capsys.readouterr().err.splitlines()
