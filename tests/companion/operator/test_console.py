"""The console: a real terminal, a scripted service."""

from __future__ import annotations

import asyncio
import json
import os
import sys
import termios
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, redirect_stderr, suppress
from pathlib import Path
from typing import Any

import pytest

from companion.guidance.grammar import json_schema
from companion.operator.command_history import CommandHistory, history_file
from companion.operator.console import Answer, Ask, Console, Target, run_console, terminal_is_free
from companion.operator.line_output import LineOutput
from tests.companion.operator.terminal import LEFT, UP, screen


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
        self.set: list[bytes] = []
        self.stopped = False
        self.target = Target(self.command, self.settings, self.status, self.commands)

    async def command(self, text: str) -> dict[str, Any]:
        self.asked.append(text)
        if text == "break":
            raise ZeroDivisionError("no such luck")
        if text == "nobody":
            raise TimeoutError("nobody answers")
        if text == "orbit":  # it has no end
            return {"state": "in_progress", "success": True, "reason": "in progress"}
        return {"success": text != "seek dragon", "reason": f"reason {len(self.asked)}"}

    async def settings(self, payload: bytes) -> dict[str, Any]:
        self.set.append(payload)
        if b"200" in payload:
            raise RuntimeError("wider")
        return {
            "guidance.max_altitude_m": {"value": 20.0, "file": 50.0},
            "detector.classes": {"value": ["car"], "file": []},
        }

    async def status(self) -> dict[str, Any]:
        raise TimeoutError("no status")

    async def commands(self) -> dict[str, Any]:
        return json_schema(("person", "car"))

    def stop(self) -> None:
        self.stopped = True

    async def run(self, ask: Ask | None = None) -> None:
        async with asyncio.timeout(20.0):
            await run_console({"": self.target}, self.stop, lambda *event: self.events.append(event), ask)


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
    assert any(line.split()[:1] == ["takeoff"] for line in lines)
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


async def test_end_of_input_ends_the_console_and_not_the_service(terminal: int) -> None:
    service = Service()
    os.write(terminal, b"hold\n\x04")
    await service.run()
    assert (service.asked, service.stopped, service.events) == (["hold"], False, [])


async def test_sentence_that_fails_leaves_the_console(
    terminal: int, capsys: pytest.CaptureFixture[str]
) -> None:
    service = Service()
    os.write(terminal, b"ask break\nstop\nquit\n")
    await service.run(Sentences())
    assert service.asked == ["stop"]
    assert service.events == []
    assert "ask: process 7" in capsys.readouterr().err.splitlines()


@pytest.mark.parametrize(
    ("line", "code", "words"),
    [
        ("hold", 0, "hold: done"),
        ("orbit", 0, "accepted"),
        ("seek dragon", 1, "failed"),
        ("break", 1, "ZeroDivisionError"),
        ("nobody", 2, "nobody answers"),
        ("status", 2, "no status"),
        ("help", 0, "takeoff"),
        ("help orbit", 0, "radius"),
        ("help dragon", 2, "dragon"),
        ("set", 0, "detector.classes"),
        ("set guidance.max_altitude_m=20", 0, "20.0"),
        ("set guidance.max_altitude_m=200", 1, "wider"),
        ("set guidance.max_altitude_m=high", 2, "high"),
        ("set guidance.max_altitude_m", 2, "KEY=VALUE"),
        ("set vehicle.url=none", 2, "vehicle.url"),
    ],
)
async def test_answers_have_the_codes_of_the_command_line(line: str, code: int, words: str) -> None:
    answer = await Console({"": Service().target}).answer(line)
    assert (answer.code, words in answer.text) == (code, True), answer


async def test_control_characters_of_an_answer_do_not_reach_the_terminal() -> None:
    async def command(text: str) -> Mapping[str, Any]:
        return {"success": False, "reason": "PX4: \x1b]0;title\x07\x9b2J no"}

    service = Service().target
    target = Target(command, service.settings, service.status, service.commands)
    answer = await Console({"": target}).answer("takeoff")
    assert answer.text == "takeoff: failed: PX4: ?]0;title??2J no"
    assert "\n" in (await Console({"": target}).answer("help")).text


@pytest.mark.parametrize("reply", [{}, {"success": True}, {"reason": "done"}, {"success": True, "reason": 3}])
async def test_reply_of_another_version_is_a_failure(reply: dict[str, Any]) -> None:
    async def command(text: str) -> Mapping[str, Any]:
        return reply

    service = Service().target
    target = Target(command, service.settings, service.status, service.commands)
    answer = await Console({"": target}).answer("takeoff")
    assert answer.code == 1
    assert answer.text.startswith("takeoff: failed: ")


async def test_values_are_set_together_and_may_be_quoted() -> None:
    service = Service()
    line = 'set guidance.max_altitude_m=20 detector.classes="traffic light,car"'
    answer = await Console({"": service.target}).answer(line)
    assert [json.loads(payload) for payload in service.set] == [
        {"guidance.max_altitude_m": 20.0, "detector.classes": ["traffic light", "car"]}
    ]
    assert answer.text.splitlines() == [
        "guidance.max_altitude_m = 20.0 (file: 50.0)",
        'detector.classes = ["car"] (file: [])',
    ]


async def test_line_goes_to_the_vehicle_it_begins_with() -> None:
    first, second = Service(), Service()
    console = Console({"vehicle1": first.target, "vehicle2": second.target})
    assert await console.answer("hold") == Answer("hold: done: reason 1")
    assert await console.answer("vehicle2 takeoff 5") == Answer("vehicle2 takeoff 5: done: reason 1")
    await console.answer("vehicle2 set guidance.max_altitude_m=20")
    assert (first.asked, second.asked) == (["hold"], ["takeoff 5"])
    assert (len(first.set), len(second.set)) == (0, 1)


class Edited:
    """A console at a terminal whose lines it edits."""

    def __init__(self, terminal: int) -> None:
        self._terminal, self._output = terminal, b""
        self.service = Service()

    async def __aenter__(self) -> Edited:
        asyncio.get_running_loop().add_reader(self._terminal, self._read)
        self._standard_error = ExitStack()
        self._lines = LineOutput(sys.stdin.fileno())
        self._standard_error.enter_context(redirect_stderr(self._lines))
        self._running = asyncio.create_task(self.service.run())
        return self

    async def __aexit__(self, *_: object) -> None:
        self._running.cancel()
        await asyncio.gather(self._running, return_exceptions=True)
        self._standard_error.close()
        asyncio.get_running_loop().remove_reader(self._terminal)
        self._lines.end(0.1)

    def _read(self) -> None:
        self._output += os.read(self._terminal, 65536)

    @property
    def rows(self) -> list[str]:
        return [row.rstrip() for row in screen(self._output.decode())]

    async def type(self, keys: str, *rows: str) -> None:
        """Type keys, and wait until the last rows are these."""
        os.write(self._terminal, keys.encode())
        try:
            async with asyncio.timeout(10.0):
                while rows and self.rows[-len(rows) :] != list(rows):
                    await asyncio.sleep(0.005)
        except TimeoutError as error:
            error.add_note("\n".join(self.rows))
            raise

    async def ended(self) -> None:
        await self._running


@pytest.fixture
def edited(terminal: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Edited:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.setenv("TERM", "xterm")
    return Edited(terminal)


async def test_typed_line_stays_below_what_is_printed(edited: Edited) -> None:
    async with edited as console:
        await console.type("", ">")
        await console.type("takeof 3", "> takeof 3")
        print("an event", file=sys.stderr)
        await console.type("", "an event", "> takeof 3")
        await console.type(f"{LEFT}{LEFT}f", "an event", "> takeoff 3")
        await console.type("\n", "> takeoff 3", "takeoff 3: done: reason 1", ">")
        assert console.service.asked == ["takeoff 3"]
        await console.type("\n\nquit\n", "> quit", "")
        await console.ended()
    assert console.service.stopped


async def test_tab_completes_and_lists(edited: Edited) -> None:
    async with edited as console:
        await console.type("", ">")
        await console.type("or\tp\t", "> orbit person")
        await console.type("dire\t", "> orbit person direction=")
        await console.type("\t", "> orbit person direction=c")
        listed = "direction=clockwise  direction=counterclockwise"
        await console.type("\t", listed, "> orbit person direction=c")
        await console.type("o\t", "> orbit person direction=counterclockwise")
        await console.type("\x15set guidance.max_a\t", "> set guidance.max_altitude_m=")
        await console.type("\t\tx", "> set guidance.max_altitude_m=x")


@pytest.mark.parametrize("schema", [{"$defs": {"goto": {}}}, {"$defs": ["goto"]}, {"$defs": {"goto": 5}}])
async def test_schema_of_another_version_completes_nothing(schema: dict[str, Any]) -> None:
    async def commands() -> Mapping[str, Any]:
        return schema

    async def recent() -> list[str]:
        return []

    service = Service().target
    console = Console({"": Target(service.command, service.settings, service.status, commands)})
    assert await console.completions("goto n", recent) == (6, [])


async def test_history_is_that_of_the_console_before(edited: Edited, terminal: int) -> None:
    async with edited as console:
        await console.type("hold\n", "hold: done: reason 1", ">")
    async with Edited(terminal) as console:
        await console.type("", ">")
        await console.type(UP, "> hold")
        # Of another console meanwhile.
        await asyncio.to_thread(CommandHistory(history_file()).add, "land")
        await console.type("\x15\n", ">", ">")
        await console.type(UP, "> land")


async def test_terminal_is_as_before_after_the_console(edited: Edited, terminal: int) -> None:
    before = termios.tcgetattr(sys.stdin)
    async with edited as console:
        await console.type("", ">")
        assert termios.tcgetattr(sys.stdin) != before
        await console.type("\x04")
        await console.ended()
    assert termios.tcgetattr(sys.stdin) == before
    assert not console.service.stopped


async def test_terminal_that_is_not_read_blocks_no_command(edited: Edited, terminal: int) -> None:
    async with edited as console:
        await console.type("", ">")
        asyncio.get_running_loop().remove_reader(terminal)
        for number in range(2000):
            os.write(terminal, f"goto {number} 0 5\n".encode())
            async with asyncio.timeout(10.0):
                while len(console.service.asked) <= number:
                    await asyncio.sleep(0)
