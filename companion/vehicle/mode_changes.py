"""The one sender of commands that change the mode or the arming: DO_SET_MODE, NAV_TAKEOFF, ARM_DISARM.

It is a state machine on what the vehicle *reports* (HEARTBEAT, CURRENT_MODE), without a clock or I/O. MAVLink
repeats a command until it is acknowledged; a command that arrives a second time takes the vehicle from a
pilot who has changed the mode in between. The rules:

1. A change notes the report that it was decided on. It is sent only if that is still the newest report.
2. It is repeated only if it was lost: no acknowledgement has come, a TIMESYNC that was sent after it has been
   answered, and after that answer the same mode as at the request is reported. A link keeps the order, so
   then nothing of it is in transit; at most one message of a change ever is, whatever the delay. Without
   TIMESYNC answers, and after the link was lost or the autopilot has restarted, nothing is repeated.
3. It ends once the wanted mode is reported. Any other report than the one at the request ends it as well:
   someone else has changed the mode, or the autopilot has by itself. An ended change is never repeated.
4. The one message that is in transit when a pilot changes the mode cannot be called back. So a change is
   watched for `IN_FLIGHT_S` after its last message. If another report is followed by an acknowledgement of
   ours and then by the wanted mode, our message has arrived after that change: the mode that was reported
   before is requested again, once, by the same rules. Without that acknowledgement the wanted mode is the
   pilot's own choice, and stays. A failsafe of the autopilot is not restored, and nothing is armed again.

PX4 sends one acknowledgement, since 1.16 two to DO_SET_MODE (the first always accepts); both leave before the
report of the mode. What is not restored: a pilot's change that our message overrides before it has been
reported, which is known to nobody, and one whose report or our acknowledgement is lost. Where our
acknowledgement comes twice and a pilot changes away and back to our mode within `IN_FLIGHT_S`, it looks like
a request that came twice: his first mode is requested again. CURRENT_MODE (PX4 since 1.15) reports a change
at once, but no second one within 0.1 s; HEARTBEAT alone reports it within 1 s on PX4 1.14, and within 0.2 s
on ArduPilot.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum, auto

from companion.vehicle.mav_result import ACCEPTED, IN_PROGRESS, result_name
from companion.vehicle.state import FlightMode, VehicleState

DO_SET_MODE, NAV_TAKEOFF, ARM_DISARM = 176, 22, 400  # MAV_CMD
MODE_FLAG_CUSTOM = 1  # MAV_MODE_FLAG_CUSTOM_MODE_ENABLED

ATTEMPTS, ATTEMPT_S = 5, 0.5
# PX4's Commander answers up to 15 ms after its MAVLink receiver, which answers TIMESYNC.
ANSWER_S = 0.1
PROGRESS_S = 10.0  # after IN_PROGRESS
SHOWN_TIMEOUT_S = 3.0  # HEARTBEAT is sent once a second
# Longest time from sending to the report of the effect: a second there, a second back, a heartbeat's period.
IN_FLIGHT_S = 3.0


class Ending(Enum):
    """How a change ended."""

    DONE = auto()
    REJECTED = auto()
    NO_ANSWER = auto()
    NOT_SHOWN = auto()
    TAKEN_OVER = auto()  # someone else, or the autopilot by itself, has changed the mode or the arming
    DROPPED = auto()  # by us


@dataclass(eq=False)
class ModeChange:
    """One change, from its request until nothing of it can be in transit.

    Attributes:
        what: for messages, such as "mode hold".
        before: the state that it was decided on.
        mode: the custom_mode that it leads to; None: of arming, and of a take-off that does not change it.
        armed: for arming, what it leads to.
        done_by_acknowledgement: else by the report.
        timeout_s: for the report.
        valid_until_ns: nothing is sent or repeated after it; None: no limit.
        ending: None while it is pending. why: in words, unless it is done.
        result: MAV_RESULT of a rejection.
    """

    what: str
    command: int
    parameters: tuple[float, ...]
    before: VehicleState
    mode: int | None
    armed: bool | None = None
    done_by_acknowledgement: bool = False
    timeout_s: float = SHOWN_TIMEOUT_S
    valid_until_ns: int | None = None
    ending: Ending | None = None
    why: str = ""
    result: int | None = None
    attempts: int = 0
    begun_ns: int = 0
    sent_ns: int = 0
    acknowledged_ns: int | None = None
    in_progress: bool = False
    lost: bool = False  # its last message was
    shown: bool = False
    other: VehicleState | None = None  # the newest report of someone else's change
    arrived_since: bool = False  # an acknowledgement has come since that report

    def shows(self, state: VehicleState) -> bool:
        """Whether a report shows the wanted mode or arming."""
        return state.custom_mode == self.mode if self.armed is None else state.armed is self.armed

    @property
    def arrived(self) -> bool:
        """Whether its effect was seen. In the wanted mode already, only an acknowledgement shows it."""
        return self.shown and (self.acknowledged_ns is not None or not self.shows(self.before))

    def shows_before(self, state: VehicleState) -> bool:
        """Whether a report is the one at the request, or how the autopilot goes on from it by itself."""
        if state.armed is not self.before.armed:
            return False
        ended_takeoff = self.before.mode is FlightMode.TAKEOFF and state.mode is FlightMode.HOLD
        return state.custom_mode == self.before.custom_mode or ended_takeoff


class ModeChanges:
    """See the module's docstring. One change is pending at a time; a new one replaces it.

    Args:
        send: sends one COMMAND_LONG: command, parameters, confirmation.
        mode_parameters: parameters 2 and 3 of DO_SET_MODE for a custom_mode.
        on_restored: called with the change that requests a pilot's mode again, and with words about it.
    """

    def __init__(
        self,
        send: Callable[[int, tuple[float, ...], int], None],
        mode_parameters: Callable[[int], tuple[int, int]],
        on_restored: Callable[[ModeChange, str], None],
    ) -> None:
        self._send, self._mode_parameters, self._on_restored = send, mode_parameters, on_restored
        self._newest: ModeChange | None = None
        self._reported: VehicleState | None = None
        self._dropped: list[tuple[int, float]] = []  # (custom_mode, until): it may still show
        self._sent_ns: int | None = None  # the last message of any change

    @property
    def pending(self) -> bool:
        """Whether a change has not ended."""
        return self._newest is not None and self._newest.ending is None

    def in_transit(self, now_ns: int) -> bool:
        """Whether a change is pending, or an acknowledgement may still arrive."""
        sent_ns = self._sent_ns
        return self.pending or (sent_ns is not None and now_ns - sent_ns <= IN_FLIGHT_S * 1e9)

    def begin(self, change: ModeChange, state: VehicleState, now_ns: int) -> None:
        """Begin a change. `state`: the newest; where it differs from `change.before`, nothing is sent."""
        last = self._newest
        if last is not None:
            self.drop(last, f"superseded by {change.what}")
            self._dropped = [(mode, until) for mode, until in self._dropped if now_ns <= until]
            if not last.arrived and last.mode is not None:
                self._dropped.append((last.mode, last.sent_ns + IN_FLIGHT_S * 1e9))
        self._newest, self._reported = change, state
        change.begun_ns = now_ns
        if not (change.shows_before(state) or change.shows(state)):
            self._end(change, Ending.TAKEN_OVER, _taken_over(change, state))
        else:
            self._transmit(change, now_ns)

    def drop(self, change: ModeChange, why: str) -> None:
        """Nobody waits for it any more: it is not repeated. Its last message may still take effect."""
        if change.ending is not None:
            return
        self._end(change, Ending.DROPPED, why)
        now = self._reported
        if now is not None and now.custom_mode != change.before.custom_mode and change.shows_before(now):
            change.other = now  # the end of a take-off, or else a pilot's hold

    def forget(self) -> None:
        """The newest change, which has ended, is not watched any more."""
        self._newest = None

    def settled(self, now_ns: int, answered_ns: int) -> bool:
        """Whether nothing is pending, and no message of ours can arrive after another's change."""
        change = self._newest
        if change is None or change.other is None:
            return change is None or change.ending is not None
        arrived = answered_ns >= change.sent_ns + ANSWER_S * 1e9 and not change.arrived_since
        late = now_ns - change.sent_ns > IN_FLIGHT_S * 1e9
        return change.ending is not None and (arrived or late or not change.attempts)

    # --- what the vehicle sends ---------------------------------------------------------------------

    def on_report(self, state: VehicleState, now_ns: int, answered_ns: int) -> None:
        """Process the state after a HEARTBEAT or CURRENT_MODE.

        Args:
            answered_ns: when the newest answered TIMESYNC was sent, CLOCK_MONOTONIC.
        """
        last, self._reported = self._reported, state
        change = self._newest
        if change is None or not change.attempts:
            return
        if change.ending is not None and now_ns - change.sent_ns > IN_FLIGHT_S * 1e9:
            self._newest = None
        elif not change.shows(state):
            change.lost = answered_ns >= change.sent_ns + ANSWER_S * 1e9
            self._on_another(change, state, now_ns)
        elif change.other is None:
            change.shown = True
            if change.arrived:
                self._end(change, Ending.DONE)
        elif last is not None and not change.shows(last):
            if change.arrived_since:
                self._restore(change, change.other, state, now_ns)
            else:
                change.other = state

    def _on_another(self, change: ModeChange, state: VehicleState, now_ns: int) -> None:
        if change.other is None and not change.shown and change.shows_before(state):
            return
        ours = any(mode == state.custom_mode and now_ns <= until for mode, until in self._dropped)
        if ours and change.armed is None and state.armed is change.before.armed:
            return  # of an earlier change, which was in transit
        if not _by_itself(change, state) and not (change.other is not None and _same(change.other, state)):
            change.other, change.arrived_since = state, False
        self._end(change, Ending.TAKEN_OVER, _taken_over(change, state))

    def on_acknowledgement(self, command: int, result: int, now_ns: int) -> None:
        """Process a COMMAND_ACK for us."""
        change = self._newest
        if change is None or change.command != command or not change.attempts:
            return
        change.arrived_since = change.other is not None and result in (ACCEPTED, IN_PROGRESS)
        if change.ending is not None:
            return
        change.acknowledged_ns, change.in_progress = now_ns, result == IN_PROGRESS
        if result == ACCEPTED:
            if change.done_by_acknowledgement or change.shown:
                self._end(change, Ending.DONE)
        elif result != IN_PROGRESS:
            change.result = result
            self._end(change, Ending.REJECTED, f"the vehicle refused {change.what} ({result_name(result)})")

    def _restore(self, change: ModeChange, other: VehicleState, state: VehicleState, now_ns: int) -> None:
        """Our message has overridden someone else's change: request that again."""
        if change.armed is False:
            return  # never arms
        if change.armed:
            again = ModeChange("disarming", ARM_DISARM, (0.0,), state, None, armed=False)
        else:
            parameters = (MODE_FLAG_CUSTOM, *self._mode_parameters(other.custom_mode))
            again = ModeChange(f"mode {other.mode}", DO_SET_MODE, parameters, state, other.custom_mode)
        self._newest = None
        self.begin(again, state, now_ns)
        text = f"{change.what} of ours arrived after the pilot's change: {again.what} requested again"
        self._on_restored(again, text)

    # --- time ---------------------------------------------------------------------------------------

    def tick(self, now_ns: int) -> None:
        """Repeat or end the pending change."""
        change = self._newest
        if change is None or change.ending is not None:
            return
        if change.acknowledged_ns is None and not change.shown:
            since_s = (now_ns - change.sent_ns) / 1e9
            if now_ns - change.begun_ns >= ATTEMPTS * ATTEMPT_S * 1e9:
                repeated = f"{change.attempts} attempts in {ATTEMPTS * ATTEMPT_S:g} s"
                self._end(change, Ending.NO_ANSWER, f"no answer to command {change.command} ({repeated})")
            elif since_s >= ATTEMPT_S and change.lost:
                self._transmit(change, now_ns)
        elif change.in_progress:
            if now_ns - (change.acknowledged_ns or 0) > PROGRESS_S * 1e9:
                text = f"command {change.command} in progress, but no further answer for {PROGRESS_S:g} s"
                self._end(change, Ending.NO_ANSWER, text)
        else:
            since_ns = change.begun_ns if change.armed is None else change.acknowledged_ns or change.begun_ns
            if now_ns - since_ns >= change.timeout_s * 1e9:
                if change.shown:
                    self._end(change, Ending.DONE)
                else:
                    text = f"the vehicle did not report {change.what} within {change.timeout_s:g} s"
                    if self._reported is not None:
                        text += f": its mode is {self._reported.mode}"
                    self._end(change, Ending.NOT_SHOWN, text)

    def _transmit(self, change: ModeChange, now_ns: int) -> None:
        if change.valid_until_ns is not None and now_ns > change.valid_until_ns:
            if not change.attempts:
                self._end(change, Ending.DROPPED, f"{change.what} not sent: the request has expired")
            return
        change.sent_ns = self._sent_ns = now_ns
        change.lost = False
        change.attempts += 1
        self._send(change.command, change.parameters, change.attempts - 1)

    def _end(self, change: ModeChange, ending: Ending, why: str = "") -> None:
        if change.ending is None:
            change.ending, change.why = ending, why


def _same(one: VehicleState, two: VehicleState) -> bool:
    return one.custom_mode == two.custom_mode and one.armed is two.armed


def _by_itself(change: ModeChange, state: VehicleState) -> bool:
    """Whether a failsafe of the autopilot has changed the mode: the intended one is still ours."""
    if state.intended_beside is state.mode:
        return state.intended_mode is not state.mode
    return state.failsafe


def _taken_over(change: ModeChange, state: VehicleState) -> str:
    shown, by_itself = f"{state.mode.value.replace('_', ' ')} mode", _by_itself(change, state)
    if state.armed is not change.before.armed and state.custom_mode == change.before.custom_mode:
        shown = "armed" if state.armed else "disarmed"
        if not state.armed and not by_itself:  # a pilot, or PX4 on the ground after COM_DISARM_PRFLT
            return f"the vehicle was disarmed, while {change.what} was requested"
    who = "autopilot failsafe" if by_itself else "the pilot took over"
    return f"{who}: {shown}, while {change.what} was requested"
