"""Events of the command handler in a flood of commands."""

from __future__ import annotations

import asyncio
import threading
import time
from typing import Any

import pytest

from companion.bus.bodies.service import CommandStateBody
from companion.bus.command_intake import Allowance
from companion.guidance.behaviour import Outcome
from companion.guidance.behaviours.hold import HoldBehaviour
from companion.guidance.behaviours.select import Select
from companion.guidance.behaviours.stop import StopBehaviour
from companion.guidance.command import GrammarError
from companion.guidance.interface import CommandInput, CommandResult
from companion.service import command_handler
from companion.service.command_handler import LONGEST_TEXT, REPORTED_AT_ONCE, REPORTED_PER_S, CommandHandler
from vision.tracking import Selected

FLOOD = 300


async def no_selection(_request: object) -> Selected:
    raise AssertionError("no selection is sent")


class Handler(CommandHandler):
    """A handler that refuses `goto`, at a clock that stands still.

    Attributes:
        lines: the texts of its events. states: of its commands.
    """

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.states: list[CommandStateBody] = []
        super().__init__(
            lambda identifier, text: CommandInput(
                identifier,
                text,
                StopBehaviour() if text == "stop" else HoldBehaviour(),
                endless=text.startswith("orbit"),
            ),
            no_selection,
            lambda: None,
            lambda _level, text: self.lines.append(text),
            check_requirements=lambda command: "refused 7" if "goto" in command.text else None,
            on_state=self.states.append,
            service="s",
        )
        self._reported, self._stops_reported = (
            Allowance(REPORTED_PER_S, REPORTED_AT_ONCE, lambda: 0.0) for _ in range(2)
        )

    def answer(self, identifier: int, outcome: Outcome, *, ended: bool = True) -> None:
        """Answer a command as guidance does. `ended`: else it is in progress."""
        result = CommandResult(identifier, outcome)
        self.on_results([result], [result] if ended else [])

    async def until_started(self, text: str) -> tuple[int, asyncio.Task[dict[str, Any]]]:
        """Execute a command; returns when guidance can take it, with its identifier."""
        answer = asyncio.create_task(self.execute(text))
        while not (commands := self.take_commands()):
            await asyncio.sleep(0)
        return commands[0].identifier, answer


async def flooded() -> Handler:
    handler = Handler()
    for number in range(FLOOD):
        assert (await handler.execute(f"goto {number} 0"))["reason"] == "refused 7"
    return handler


def line_after_flood(text: str) -> str:
    """Of a command that superseded another; `companion.language.control` reads exactly this."""
    return f"command: {text} ({FLOOD - REPORTED_AT_ONCE + 1} before it not logged)"


async def test_validity_counts_from_the_reception_of_the_command() -> None:
    """Before the text is read: a mission's file may take seconds."""
    read_ns: list[int] = []

    def read(identifier: int, text: str) -> CommandInput:
        while time.monotonic_ns() - given_ns < 20_000_000:
            pass
        read_ns.append(time.monotonic_ns())
        return CommandInput(identifier, text, HoldBehaviour())

    handler = Handler()
    handler._read = read
    given_ns = time.monotonic_ns()
    answer = asyncio.create_task(handler.execute("mission demo"))
    while not (commands := handler.take_commands()):
        await asyncio.sleep(0)
    assert commands[0].received_ns is not None
    assert given_ns <= commands[0].received_ns <= read_ns[0] - 10_000_000
    handler.answer(commands[0].identifier, Outcome(True, "done"))
    await answer


async def test_flood_of_refused_commands_is_answered_but_not_logged() -> None:
    handler = await flooded()
    assert len(handler.lines) == 2 * REPORTED_AT_ONCE  # each with its reason


async def test_command_flown_in_a_flood_is_logged(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(command_handler, "LASTING_S", 0.02)
    handler = await flooded()
    before = len(handler.lines)
    short, superseded = await handler.until_started("hold")
    long, flown = await handler.until_started("orbit")
    handler.answer(short, Outcome(False, "superseded by orbit"))
    assert not (await superseded)["success"]
    while len(handler.lines) == before:
        await asyncio.sleep(0.005)
    handler.answer(long, Outcome(True, "flown"))
    assert (await flown)["success"]
    assert handler.lines[before:] == [line_after_flood("orbit"), "orbit: flown"]


async def test_endless_command_flown_in_a_flood_is_logged(monkeypatch: pytest.MonkeyPatch) -> None:
    """It is answered as soon as it is flown; one that another supersedes at once is not logged."""
    monkeypatch.setattr(command_handler, "LASTING_S", 0.02)
    handler = await flooded()
    before = len(handler.lines)
    for text in ("orbit radius=6", "orbit radius=7"):
        identifier, answer = await handler.until_started(text)
        handler.answer(identifier, Outcome(True, "in progress"), ended=False)
        assert (await answer)["success"]
    while len(handler.lines) == before:
        await asyncio.sleep(0.005)
    assert handler.lines[before:] == [line_after_flood("orbit radius=7"), "orbit radius=7: in progress"]


async def test_stop_in_a_flood_is_logged_at_once() -> None:
    handler = await flooded()
    before = len(handler.lines)
    identifier, answer = await handler.until_started("stop")
    assert handler.lines[before].startswith("command: stop")
    handler.answer(identifier, Outcome(True, "holding"))
    assert (await answer)["success"]
    assert handler.lines[before + 1 :] == ["stop: holding"]


class ReadingHandler(Handler):
    """A handler whose missions are read until `release` is set. `threads`: where each command was read."""

    def __init__(self) -> None:
        super().__init__()
        self.release, self.begun = threading.Event(), threading.Event()
        self.threads: dict[str, str] = {}
        read = self._read

        def slow(identifier: int, text: str) -> CommandInput | Select:
            self.threads[text.split()[0]] = threading.current_thread().name
            if text.startswith("mission"):
                self.begun.set()
                assert self.release.wait(20)
            return read(identifier, text)

        self._read = slow


async def test_mission_is_read_outside_the_loop_and_a_stop_wins() -> None:
    handler = ReadingHandler()
    mission = asyncio.create_task(handler.execute("mission far"))
    await asyncio.to_thread(handler.begun.wait, 20)
    stop, stopping = await handler.until_started("stop")  # the loop goes on
    assert not (await handler.execute("mission other"))["success"]  # one at a time
    handler.release.set()
    assert not (await mission)["success"]
    assert handler.take_commands() == ()  # the mission is not flown after the stop
    handler.answer(stop, Outcome(True, "stopped"))
    assert (await stopping)["success"]
    assert handler.threads["stop"] == threading.main_thread().name
    assert handler.threads["mission"] != threading.main_thread().name
    identifier, flying = await handler.until_started("mission far")
    handler.answer(identifier, Outcome(True, "done"))
    assert (await flying)["success"]


async def test_mission_that_is_read_at_the_end_is_not_flown() -> None:
    handler = ReadingHandler()
    mission = asyncio.create_task(handler.execute("mission far"))
    await asyncio.to_thread(handler.begun.wait, 20)
    handler.close("the service ends")
    handler.release.set()
    assert not (await mission)["success"]
    assert handler.take_commands() == ()


async def test_mission_that_is_read_across_a_suspend_is_not_flown(monkeypatch: pytest.MonkeyPatch) -> None:
    handler, suspended_ns = ReadingHandler(), [0]
    monkeypatch.setattr(command_handler, "boottime_ns", lambda: suspended_ns[0])
    mission = asyncio.create_task(handler.execute("mission far"))
    await asyncio.to_thread(handler.begun.wait, 20)
    suspended_ns[0] = 30_000_000_000
    handler.release.set()
    assert not (await mission)["success"]
    assert handler.take_commands() == ()


def states_of(handler: Handler) -> list[tuple[str, str, bool | None, str]]:
    return [(one["id"], one["state"], one["success"], one["reason"]) for one in handler.states]


async def test_every_command_has_one_last_state_with_its_reason() -> None:
    handler = Handler()
    refused = await handler.execute("goto 1 0")
    first, flown = await handler.until_started("orbit")
    handler.answer(first, Outcome(True, "in progress"), ended=False)
    second, _ = await handler.until_started("hold")
    handler.on_results([], [CommandResult(first, Outcome(False, "replaced by hold"))])
    handler.close("the service ends")
    assert states_of(handler) == [
        (refused["id"], "ended", False, "refused 7"),
        ((await flown)["id"], "accepted", None, ""),
        (f"s-{first}", "in_progress", None, "in progress"),
        (f"s-{second}", "accepted", None, ""),
        (f"s-{first}", "ended", False, "replaced by hold"),
        (f"s-{second}", "ended", False, "the service ends"),
    ]


async def test_unreadable_command_and_selection_end_too() -> None:
    handler = Handler()

    def read(_identifier: int, text: str) -> CommandInput | Select:
        if text == "select":
            return Select()
        raise GrammarError("unknown 9")

    async def selected(_request: object) -> Selected:
        return Selected(True, "following it", 4, "car")

    handler._read, handler._select = read, selected
    assert (await handler.execute("dance"))["id"] == "s-1"
    assert (await handler.execute("select"))["track"] == 4
    assert states_of(handler) == [
        ("s-1", "ended", False, "unknown 9"),
        ("s-2", "ended", True, "following it"),
    ]


async def test_text_of_a_refused_command_is_kept_in_part() -> None:
    handler = Handler()
    reply = await handler.execute("goto " * 32_000)
    assert len(reply["command"]) > LONGEST_TEXT
    (state,) = [one for one in handler.states if one["state"] == "ended"]
    assert len(state["command"]) == LONGEST_TEXT
