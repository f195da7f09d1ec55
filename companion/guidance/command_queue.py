"""Commands on their way to guidance: one that needs a gimbal waits, briefly, until the gimbal is known.

A command that waits does not begin any more once something newer has happened: another command, a change of
mode or arming whoever made it, a loss of command, a low battery, the end of the service.
"""

from __future__ import annotations

from dataclasses import dataclass

from companion.guidance.behaviour import Outcome, Requirement
from companion.guidance.gimbal.controller import ENDING, FIND_TIMEOUT_S, GimbalController, is_known
from companion.guidance.interface import CommandInput, OutputCollector
from companion.vehicle.state import VehicleState


@dataclass(frozen=True, slots=True)
class _Waiting:
    command: CommandInput
    until_ns: float


class CommandQueue:
    """Part of the guidance core.

    Args:
        gimbal: points the gimbal for commands that only do that.
    """

    def __init__(self, gimbal: GimbalController) -> None:
        self._gimbal = gimbal
        self._due: list[CommandInput] = []
        self._waiting: list[_Waiting] = []
        self._mode_changes: int | None = None

    def add(
        self,
        command: CommandInput,
        now_ns: int,
        state: VehicleState,
        gimbal_user: str,
        out: OutputCollector,
    ) -> None:
        """A new command. `gimbal_user`: name of the behaviour that moves the gimbal now; empty: none does."""
        self.supersede(command.text, out)
        if command.mode_changes not in (None, self._mode_changes):
            out.result(command.identifier, Outcome(False, f"superseded by {_change(state)}"))
            return
        if command.aim is not None and gimbal_user:
            reason = f"gimbal: {gimbal_user} moves it; end that first"
            out.result(command.identifier, Outcome(False, reason))
            return
        behaviour = command.behaviour
        needs_gimbal = behaviour is None or Requirement.GIMBAL in behaviour.requirements
        if needs_gimbal and not is_known(state.gimbal, now_ns):
            self._waiting.append(_Waiting(command, now_ns + FIND_TIMEOUT_S * 1e9))
            self._gimbal.find(out)
        else:
            self._due.append(command)

    def watch(self, mode_changes: int, state: VehicleState, out: OutputCollector) -> None:
        """A change of mode or arming: it is not the vehicle that a waiting command was given to."""
        if self._mode_changes is not None and mode_changes != self._mode_changes:
            self.supersede(_change(state), out)
        self._mode_changes = mode_changes

    def supersede(self, by: str, out: OutputCollector) -> None:
        """A behaviour that waits does not begin any more. `by`: what has happened, for the answer."""
        left = []
        for waiting in self._waiting:
            if waiting.command.behaviour is None:  # it moves no vehicle
                left.append(waiting)
            else:
                reason = f"superseded by {by} while waiting for the gimbal"
                out.result(waiting.command.identifier, Outcome(False, reason))
        self._waiting = left

    def close(self, out: OutputCollector) -> None:
        """The service ends: nothing that waits begins any more."""
        self.supersede("the end of the service", out)
        for waiting in self._waiting:
            out.result(waiting.command.identifier, Outcome(False, ENDING))
        self._waiting = []

    def take_due(self, now_ns: int, state: VehicleState, out: OutputCollector) -> list[CommandInput]:
        """The behaviours that are to begin now, in their order. Gimbal commands go to the gimbal."""
        known = is_known(state.gimbal, now_ns)
        over = [w for w in self._waiting if known or now_ns > w.until_ns or self._gimbal.not_found]
        self._waiting = [w for w in self._waiting if w not in over]
        due, self._due = [*(w.command for w in over), *self._due], []
        for command in due:
            if command.aim is not None:
                self._gimbal.point(command.identifier, command.aim, now_ns, state, out)
        return [command for command in due if command.behaviour is not None]


def _change(state: VehicleState) -> str:
    """What has changed, for the answer of a command that was given before."""
    now = f"{state.mode.value}, {'armed' if state.armed else 'disarmed'}"
    return f"a change of the vehicle (now {now})"
