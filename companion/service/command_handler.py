"""Parses command texts, passes them to guidance, returns their results and publishes their states."""

from __future__ import annotations

import asyncio
import itertools
import time
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import asdict, replace
from typing import Any

from companion.bus.bodies.service import CommandStateBody
from companion.bus.command_intake import Allowance
from companion.bus.topics import command_id
from companion.guidance.behaviour import Outcome
from companion.guidance.behaviours.select import Select
from companion.guidance.behaviours.stop import StopBehaviour
from companion.guidance.command import COMMANDS, GrammarError
from companion.guidance.interface import CommandInput, CommandResult
from companion.guidance.missions.sequence import SequenceBehaviour
from companion.host.clock import boottime_ns
from companion.host.load import with_load
from vision.tracking import Selected

# Commands reported as events: so many a second, and so many at once, which is more than a person sends.
# `stop` has a separate allowance of the same size.
REPORTED_PER_S, REPORTED_AT_ONCE = 1.0, 20
# A command that is not reported at once is reported when it has lasted this long.
LASTING_S = 1.0
# A mission of 100 kB takes up to 0.5 s.
READING_S = 5.0
# Of a command and a reason in its states, which are kept; a valid command is not longer.
LONGEST_TEXT = 8000


class CommandHandler:
    """The entry point of all commands.

    In a flood of commands most are not reported as events: only one a second, and those that last a second.

    Args:
        read: parses a command from an identifier and a text; raises GrammarError.
        select: selects an object in a camera's images.
        on_command: called when a command waits for guidance's next step.
        on_event: called with (level, text) for the operator.
        check_requirements: returns why a command may not go to guidance, or None.
        on_state: called with every state of every command; the last one of each is its end.
        service: begins the identifiers in those states.
    """

    def __init__(
        self,
        read: Callable[[int, str], CommandInput | Select],
        select: Callable[[Select], Awaitable[Selected]],
        on_command: Callable[[], None],
        on_event: Callable[[str, str], None],
        *,
        check_requirements: Callable[[CommandInput], str | None],
        on_state: Callable[[CommandStateBody], None],
        service: str,
    ) -> None:
        self._read, self._on_command, self._on_event = read, on_command, on_event
        self._select = select
        self._check_requirements = check_requirements
        self._on_state, self._service = on_state, service
        self._identifiers = itertools.count(1)
        self._new: list[CommandInput] = []
        self._awaited: dict[int, asyncio.Future[dict[str, Any]]] = {}
        self._open: dict[int, CommandInput] = {}
        self._reported, self._stops_reported = (Allowance(REPORTED_PER_S, REPORTED_AT_ONCE) for _ in range(2))
        self._unreported = 0
        self._reading = self._closed = False
        self._newest = 0
        self._succeeded: CommandInput | None = None

    async def execute(self, text: str) -> dict[str, Any]:
        """Execute a command and return its result. See `Service.command`."""
        received_ns = time.monotonic_ns()  # a file is read for up to `READING_S`
        identifier = next(self._identifiers)
        try:
            command = await self._parse(identifier, text)
        except GrammarError as error:
            first_line = text.strip().partition("\n")[0]
            return self._ended(identifier, first_line, Outcome(False, "; ".join(str(error).splitlines())))
        if isinstance(command, Select):
            return await self._select_object(identifier, command)
        command = replace(command, received_ns=received_ns)
        is_stop = isinstance(command.behaviour, StopBehaviour)
        reported = (self._stops_reported if is_stop else self._reported).take()
        if reported:
            self._report(command)
        else:
            self._unreported += 1
        if (reason := self._check_requirements(command)) is not None:
            if reported:
                self._on_event("warning", f"{command.text}: {reason}")
            return self._ended(identifier, command.text, Outcome(False, reason))
        answered: asyncio.Future[dict[str, Any]] = asyncio.get_running_loop().create_future()
        self._newest = max(self._newest, identifier)
        self._awaited[identifier], self._open[identifier] = answered, command
        self._publish(identifier, command.text, "accepted", None)
        self._new.append(command)
        self._on_command()
        if not reported:
            await asyncio.wait({answered}, timeout=LASTING_S)
            if not answered.done():  # it is active, and no newer one has superseded it
                reported, self._unreported = True, self._unreported - 1
                self._report(command)
        # A cancelled caller does not stop the behaviour.
        reply = await asyncio.shield(answered)
        success, text = reply["success"], f"{command.text}: {reply['reason']}"
        if reported:
            self._on_event("info" if success else "warning", text)
        if success and command.behaviour is not None:
            self._succeeded = command
            if command.endless and not reported:  # it is active from now on
                asyncio.get_running_loop().call_later(LASTING_S, self._report_lasting, command, text)
        return reply

    async def _parse(self, identifier: int, text: str) -> CommandInput | Select:
        """Parse a command; one with a file in a thread, since that may take longer than the loop may wait.

        Raises:
            GrammarError: it is not valid, or a newer command came while its file was read.
        """
        word = text.split(maxsplit=1)[:1]
        kind = COMMANDS.get(word[0].lower()) if word else None
        if kind is None or not kind.takes_attachment:
            return self._read(identifier, text)
        if self._reading:
            raise GrammarError(f"{kind.word}: another file is being read")
        self._reading, begun_ns = True, boottime_ns()
        try:
            async with asyncio.timeout(READING_S):
                command = await asyncio.to_thread(self._read, identifier, text)
        except TimeoutError:
            raise GrammarError(f"{kind.word}: its file was not read within {READING_S:g} s") from None
        finally:
            self._reading = False
        # The time-out does not count a suspend.
        if boottime_ns() - begun_ns > (READING_S + 1.0) * 1e9:
            raise GrammarError(f"{kind.word}: the computer stood still while its file was read")
        if self._newest > identifier or self._closed:
            raise GrammarError(f"{kind.word}: superseded while its file was read")
        return command

    def _report(self, command: CommandInput) -> None:
        before, self._unreported = self._unreported, 0
        skipped = f" ({before} before it not logged)" if before else ""
        self._on_event("info", f"command: {command.text}{skipped}")

    def _report_lasting(self, command: CommandInput, text: str) -> None:
        """Report an endless command, unless another one has succeeded since."""
        if self._succeeded is command:
            self._unreported -= 1
            self._report(command)
            self._on_event("info", text)

    async def _select_object(self, identifier: int, command: Select) -> dict[str, Any]:
        """Guidance is not asked: the active behaviour goes on."""
        answer = await self._select(command)
        if self._reported.take():
            self._on_event("info" if answer.success else "warning", f"{command}: {answer.reason}")
        track = {"track": answer.track_id, "class": answer.class_name}
        outcome = Outcome(answer.success, with_load(answer.reason))
        return {**self._ended(identifier, str(command), outcome), **track}

    def take_commands(self) -> tuple[CommandInput, ...]:
        """Return the commands received since the last call."""
        commands, self._new = tuple(self._new), []
        return commands

    def on_results(self, results: Sequence[CommandResult], endings: Sequence[CommandResult]) -> None:
        """Pass on what guidance has answered and ended in one step."""
        results, endings = _with_load(results), _with_load(endings)
        ended = {ending.identifier for ending in endings}
        for result in results:
            if (command := self._open.get(result.identifier)) is None:
                continue
            state = "ended" if result.identifier in ended else "in_progress"
            if state == "in_progress":
                self._publish(result.identifier, command.text, state, result.outcome)
            awaited = self._awaited.pop(result.identifier, None)
            if awaited is not None and not awaited.done():
                reply = self._reply(
                    result.identifier, command.text, state, _with_step(command, result.outcome)
                )
                awaited.set_result(reply | _steps(command))
        for ending in endings:
            if (command := self._open.pop(ending.identifier, None)) is not None:
                self._ended(ending.identifier, command.text, _with_step(command, ending.outcome))

    def close(self, reason: str) -> None:
        """End every command that has not ended."""
        self._succeeded, self._closed = None, True
        outcome = Outcome(False, reason)
        self.on_results(
            [CommandResult(identifier, outcome) for identifier in self._awaited],
            [CommandResult(identifier, outcome) for identifier in self._open],
        )

    def _ended(self, identifier: int, text: str, outcome: Outcome) -> dict[str, Any]:
        """Publish the end of a command; returns its reply, if it was not answered before."""
        self._publish(identifier, text, "ended", outcome)
        return self._reply(identifier, text, "ended", outcome)

    def _reply(self, identifier: int, text: str, state: str, outcome: Outcome) -> dict[str, Any]:
        return {
            "id": command_id(self._service, identifier),
            "command": text,
            "state": state,
            "success": outcome.success,
            "reason": outcome.reason,
        }

    def _publish(self, identifier: int, text: str, state: str, outcome: Outcome | None) -> None:
        self._on_state(
            {
                "stamp_ns": time.monotonic_ns(),
                "id": command_id(self._service, identifier),
                "command": text[:LONGEST_TEXT],
                "state": state,
                "success": outcome.success if outcome is not None and state == "ended" else None,
                "reason": "" if outcome is None else outcome.reason[:LONGEST_TEXT],
            }
        )


def _with_load(results: Sequence[CommandResult]) -> list[CommandResult]:
    """Results that are about slowness get the load here: replays compare what guidance itself gives."""
    return [
        replace(result, outcome=replace(result.outcome, reason=with_load(result.outcome.reason)))
        for result in results
    ]


def _with_step(command: CommandInput, outcome: Outcome) -> Outcome:
    """An outcome, of a mission with the step in which it ended."""
    behaviour = command.behaviour
    return behaviour.with_step(outcome) if isinstance(behaviour, SequenceBehaviour) else outcome


def _steps(command: CommandInput) -> dict[str, Any]:
    behaviour = command.behaviour
    if not isinstance(behaviour, SequenceBehaviour):
        return {}
    return {"steps": [asdict(step) for step in behaviour.records]}
