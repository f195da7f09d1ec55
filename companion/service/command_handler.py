"""Parses command texts, passes them to guidance and returns their results."""

from __future__ import annotations

import asyncio
import itertools
from collections.abc import Awaitable, Callable
from dataclasses import asdict
from typing import Any

from companion.guidance.behaviour import Outcome
from companion.guidance.behaviours.select import Select
from companion.guidance.command import GrammarError
from companion.guidance.interface import CommandInput, CommandResult
from companion.guidance.missions.sequence import SequenceBehaviour
from vision.tracking import Selected


class CommandHandler:
    """The entry point of all commands.

    Args:
        read: parses a command from an identifier and a text; raises GrammarError.
        select: selects an object in a camera's images.
        on_command: called when a command waits for guidance's next step.
        on_event: called with (level, text) for the operator.
        check_requirements: returns why a command may not go to guidance, or None.
    """

    def __init__(
        self,
        read: Callable[[int, str], CommandInput | Select],
        select: Callable[[Select], Awaitable[Selected]],
        on_command: Callable[[], None],
        on_event: Callable[[str, str], None],
        *,
        check_requirements: Callable[[CommandInput], str | None],
    ) -> None:
        self._read, self._on_command, self._on_event = read, on_command, on_event
        self._select = select
        self._refusal = check_requirements
        self._identifiers = itertools.count(1)
        self._new: list[CommandInput] = []
        self._awaited: dict[int, asyncio.Future[Outcome]] = {}

    async def execute(self, text: str) -> dict[str, Any]:
        """Execute a command and return its result. See `Service.command`."""
        try:
            command = self._read(next(self._identifiers), text)
        except GrammarError as error:
            first_line = text.strip().partition("\n")[0]
            return {"command": first_line, "success": False, "reason": "; ".join(str(error).splitlines())}
        if isinstance(command, Select):
            return await self._select_object(command)
        self._on_event("info", f"command: {command.text}")
        if (reason := self._refusal(command)) is not None:
            self._on_event("warning", f"{command.text}: {reason}")
            return {"command": command.text, "success": False, "reason": reason}
        ended: asyncio.Future[Outcome] = asyncio.get_running_loop().create_future()
        self._awaited[command.identifier] = ended
        self._new.append(command)
        self._on_command()
        # A cancelled caller does not stop the behaviour.
        outcome = await asyncio.shield(ended)
        more: dict[str, Any] = {}
        if isinstance(command.behaviour, SequenceBehaviour):
            outcome = command.behaviour.with_step(outcome)
            more = {"steps": [asdict(step) for step in command.behaviour.records]}
        self._on_event("info" if outcome.success else "warning", f"{command.text}: {outcome.reason}")
        answer = {"success": outcome.success, "reason": outcome.reason}
        return {"command": command.text, **answer, **more}

    async def _select_object(self, command: Select) -> dict[str, Any]:
        """Guidance is not asked: what is flown goes on."""
        answer = await self._select(command)
        self._on_event("info" if answer.success else "warning", f"{command}: {answer.reason}")
        track = {"track": answer.track_id, "class": answer.class_name}
        return {"command": str(command), "success": answer.success, "reason": answer.reason, **track}

    def take_commands(self) -> tuple[CommandInput, ...]:
        """Return the commands received since the last call."""
        commands, self._new = tuple(self._new), []
        return commands

    def on_result(self, result: CommandResult) -> None:
        """Pass on a result from guidance."""
        ended = self._awaited.pop(result.identifier, None)
        if ended is not None and not ended.done():
            ended.set_result(result.outcome)

    def close(self, reason: str) -> None:
        """Fail every command that is still pending."""
        for identifier in list(self._awaited):
            self.on_result(CommandResult(identifier, Outcome(False, reason)))
