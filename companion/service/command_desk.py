"""From a command's text to its outcome: read, flown by the pilot, answered."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from companion.guidance import grammar
from companion.guidance.arguments import GrammarError
from companion.guidance.behaviour import Behaviour, Outcome, Requirement
from companion.guidance.commands import Command, Gimbal, Mission
from companion.guidance.gimbal_hand import GimbalHand
from companion.guidance.pilot import Pilot
from companion.guidance.registry import behaviour_for
from companion.guidance.search_pattern import Footprint
from companion.guidance.sequence import SequenceBehaviour
from companion.missions.mission_file import MissionError, mission_behaviour
from companion.perception.views import View


class CommandDesk:
    """The one place where commands are taken.

    Args:
        pilot: flies them. steering: the view whose classes they may name and whose camera searches.
        gimbal: moves the gimbal. camera_pitch_rad: of the steering camera above the horizon, now.
        on_event: called with (level, text) for what a person should know.
    """

    def __init__(
        self,
        pilot: Pilot,
        steering: View,
        gimbal: GimbalHand,
        on_event: Callable[[str, str], None],
        camera_pitch_rad: Callable[[], float],
    ) -> None:
        self._pilot, self._steering, self._on_event = pilot, steering, on_event
        self._gimbal, self._camera_pitch_rad = gimbal, camera_pitch_rad
        self._awaited: tuple[Behaviour, asyncio.Future[None]] | None = None
        # Counts what a command that still waits must not outlive, and what the last of it was.
        self._overtakings, self._overtaken_by = 0, ""

    async def do(self, text: str) -> dict[str, Any]:
        """Do what a command says; the reply tells how it ended. See `Service.command`."""
        # Of a mission that is not on this computer the text may follow its name.
        text, _, enclosed = text.strip().partition("\n")
        try:
            command = grammar.parse(text, self._steering.class_names)
            behaviour = self._behaviour_for(command, enclosed)
        except (GrammarError, MissionError) as error:
            return {"command": text, "success": False, "reason": "; ".join(str(error).splitlines())}
        self._on_event("info", f"command: {command}")
        self.overtake(str(command))
        given = self._overtakings
        if isinstance(command, Gimbal):
            outcome = await self._gimbal.point(command.aim, self._pilot.behaviour)
        else:
            if Requirement.GIMBAL in behaviour.requirements:
                await self._gimbal.find()
            if given == self._overtakings:
                outcome = await self._outcome_of(command, behaviour)
            else:
                why = f"overtaken by {self._overtaken_by} while the gimbal was looked for"
                outcome = Outcome(False, why)
        more: dict[str, Any] = {}
        if isinstance(behaviour, SequenceBehaviour):
            outcome, more = behaviour.told(outcome), {"steps": [asdict(step) for step in behaviour.records]}
        self._on_event("info" if outcome.success else "warning", f"{command}: {outcome.reason}")
        return {"command": str(command), **asdict(outcome), **more}

    def overtake(self, by: str) -> None:
        """A command that has not begun yet shall not begin any more: what it was given for is past.

        Args:
            by: what has happened since, for the answer.
        """
        self._overtakings += 1
        self._overtaken_by = by

    def _behaviour_for(self, command: Command, enclosed: str) -> Behaviour:
        """Raises GrammarError or MissionError with what is wrong, a line for each."""
        camera = self._steering.settings.camera
        footprint = Footprint(camera.field_rad, -self._camera_pitch_rad())
        if isinstance(command, Mission):
            names = self._steering.class_names
            return mission_behaviour(command, enclosed, names, self._pilot.refusal_of, footprint)
        if enclosed:
            raise GrammarError(f"{command}: one command at a time; only a mission may have more lines")
        return behaviour_for(command, footprint)

    async def _outcome_of(self, command: Command, behaviour: Behaviour) -> Outcome:
        ended = self._pilot.command(behaviour)
        if ended.done() or not command.endless:
            return await asyncio.shield(ended)
        under_way: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._awaited = (behaviour, under_way)
        waited: set[asyncio.Future[Any]] = {ended, under_way}
        await asyncio.wait(waited, return_when=asyncio.FIRST_COMPLETED)
        return ended.result() if ended.done() else Outcome(True, "under way")

    def answer_under_way(self, flown: bool) -> None:
        """A command without an end counts as done when the vehicle flies it."""
        if self._awaited is None:
            return
        behaviour, under_way = self._awaited
        if self._pilot.behaviour is behaviour and flown and not under_way.done():
            under_way.set_result(None)
