"""Queue of commands: one that needs a gimbal, home, detections or the vehicle's type waits for it.

The gimbal manager is asked; PX4 sends home every two seconds; a camera that has just started sends its first
detections within seconds. Whether the vehicle is one that is flown (`vehicle_type`) is not known right after
the link opens: ArduPilot sends EXTENDED_SYS_STATE only when it is requested. After a standstill `stop`,
`land` and `rtl` wait for the next heartbeat, and where it matters for the VTOL state.

A waiting command is superseded by another command, any change of mode or arming, a loss of command, a low
battery, or the end of the service. The mode in the first heartbeat after a standstill supersedes nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from companion.guidance.behaviour import Behaviour, BehaviourContext, Outcome, Requirement
from companion.guidance.behaviours.land import LandBehaviour
from companion.guidance.behaviours.stop import StopBehaviour
from companion.guidance.gimbal.controller import ENDING, FIND_TIMEOUT_S, GimbalController, is_known
from companion.guidance.interface import CommandInput, OutputCollector
from companion.vehicle.state import VehicleState
from companion.vehicle.vehicle_type import NOT_KNOWN_YET

_GIMBAL, _AUTOPILOT = "the gimbal", "the autopilot's next reports"
_TYPE = "the vehicle's type"


@dataclass(frozen=True, slots=True)
class _Waiting:
    command: CommandInput
    until_ns: float
    awaited: str


def ends_flight(behaviour: Behaviour | None) -> bool:
    """Whether it is accepted in every mode, also directly after a standstill."""
    return isinstance(behaviour, StopBehaviour | LandBehaviour)


class CommandQueue:
    """Holds commands until what they need is known; a newer command supersedes them.

    Args:
        gimbal: carries out commands that only point the gimbal.

    Attributes:
        due: to be taken in this step. waiting: for what they need.
        mode_changes: as given to `watch`; None before.
    """

    def __init__(self, gimbal: GimbalController) -> None:
        self._gimbal = gimbal
        self.due: list[CommandInput] = []
        self.waiting: list[_Waiting] = []
        self.mode_changes: int | None = None

    def add(
        self,
        command: CommandInput,
        context: BehaviourContext,
        gimbal_user: str,
        out: OutputCollector,
    ) -> None:
        """Add a new command. `gimbal_user`: name of the behaviour that moves the gimbal now; empty: none."""
        self.supersede(command.text, out)
        if command.mode_changes not in (None, self.mode_changes):
            out.ended(command.identifier, Outcome(False, f"superseded by {_change(context.state)}"))
            return
        if command.aim is not None and gimbal_user:
            reason = f"gimbal: in use by {gimbal_user}; end that behaviour first"
            out.ended(command.identifier, Outcome(False, reason))
            return
        if not (awaited := _awaited(command, context)):
            self.due.append(command)
            return
        self.waiting.append(_Waiting(command, context.now_ns + FIND_TIMEOUT_S * 1e9, awaited))
        if awaited == _GIMBAL:
            self._gimbal.find(out)

    def watch(self, mode_changes: int, state: VehicleState, out: OutputCollector) -> None:
        """Supersede waiting commands after a change of mode or arming."""
        if self.mode_changes is not None and mode_changes != self.mode_changes:
            unknown = [waiting for waiting in self.waiting if waiting.awaited == _AUTOPILOT]
            self.waiting = [waiting for waiting in self.waiting if waiting.awaited != _AUTOPILOT]
            self.supersede(_change(state), out)
            self.waiting += unknown
        self.mode_changes = mode_changes

    def supersede(self, by: str, out: OutputCollector) -> None:
        """Answer waiting behaviours as superseded. `by`: the cause, for the answer."""
        left = []
        for waiting in self.waiting:
            if waiting.command.behaviour is None:  # gimbal only
                left.append(waiting)
            else:
                reason = f"superseded by {by} while waiting for {waiting.awaited}"
                out.ended(waiting.command.identifier, Outcome(False, reason))
        self.waiting = left

    def close(self, out: OutputCollector) -> None:
        """The service ends: answer every waiting command."""
        self.supersede("the end of the service", out)
        for waiting in self.waiting:
            out.ended(waiting.command.identifier, Outcome(False, ENDING))
        self.waiting = []

    def take_due(self, context: BehaviourContext, out: OutputCollector) -> list[CommandInput]:
        """Remove and return the behaviours to begin now, in order. Gimbal commands go to the gimbal."""
        now_ns = context.now_ns
        due, left = list[CommandInput](), list[_Waiting]()
        for waiting in self.waiting:
            awaited = _awaited(waiting.command, context)
            if awaited != waiting.awaited:
                waiting = replace(waiting, awaited=awaited)
                if awaited == _GIMBAL:
                    self._gimbal.find(out)
            found = not awaited or (awaited == _GIMBAL and self._gimbal.not_found)
            if found or now_ns > waiting.until_ns:
                due.append(waiting.command)
            else:
                left.append(waiting)
        self.waiting = left
        due, self.due = [*due, *self.due], []
        for command in due:
            if command.aim is not None:
                self._gimbal.point(command.identifier, command.aim, context, out)
        return [command for command in due if command.behaviour is not None]


def _awaited(command: CommandInput, context: BehaviourContext) -> str:
    """What the command waits for, in words; empty: nothing."""
    behaviour = command.behaviour
    state = context.state
    if ends_flight(behaviour) and (not state.heartbeat_ns or state.not_flown in NOT_KNOWN_YET):
        return _AUTOPILOT
    if behaviour is not None and state.connected(context.now_ns) and state.not_flown in NOT_KNOWN_YET:
        return _TYPE
    needed = {Requirement.GIMBAL} if behaviour is None else set(behaviour.needs)
    for later in () if behaviour is None else behaviour.later:
        needed |= later.needs
    if Requirement.GIMBAL in needed and not is_known(context.state.gimbal, context.now_ns):
        return _GIMBAL
    if Requirement.HOME in needed and context.state.home_fault() is not None:
        return "home"
    if Requirement.PERCEPTION in needed and context.perception_age_s is None:
        return "the first detections"
    return ""


def _change(state: VehicleState) -> str:
    """The change in words, for the answer to a superseded command."""
    now = f"{state.mode.value}, {'armed' if state.armed else 'disarmed'}"
    return f"a change of mode or arming (now {now})"
