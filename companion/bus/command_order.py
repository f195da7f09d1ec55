"""The order in which a program's commands are sent to a vehicle, where each is sent from a thread of its own.

Before it sends, such a thread waits for the service's liveliness token, so a `stop` could overtake the `goto`
before it. Therefore the caller takes the command's turn at once, and the thread waits for those before it.
"""

from __future__ import annotations

import math
import threading
import time
from types import TracebackType
from typing import Self

# Longer than `send_command` waits for the service's liveliness token.
_LONGEST_TURN_S = 3.0
# A command that is being sent takes less than a millisecond, unless the network is congested.
_STOP_WAITS_S = 0.5

STOPPED = "not sent: stop was commanded after it"
TOO_LATE = "not sent: a later command was sent before it, since this one was not ready to be sent"
WITHDRAWN = "not sent: its sender does not wait for it any more"


def is_stop(text: str) -> bool:
    """Whether a command is `stop`: as the service reads it, without case and surrounding spaces."""
    return text.strip().lower() == "stop"


class CommandOrder:
    """The turns of all commands that are sent by one zenoh session: to each vehicle in the order of `turn`.

    A `stop` waits for no turn, except for a command that is being sent just then: that one could arrive after
    it otherwise. The commands that wait then are not sent. Later ones are sent after the `stop`.

    From any thread. Nothing here waits but `Turn.wait`.

    Args:
        longest_s: a command waits for the one before it no longer, from when that one is the first.
        stop_waits_s: a `stop` waits no longer for a command that is being sent.
    """

    def __init__(self, longest_s: float = _LONGEST_TURN_S, stop_waits_s: float = _STOP_WAITS_S) -> None:
        self._longest_s, self._stop_waits_s = longest_s, stop_waits_s
        self._changed = threading.Condition()
        self._turns: dict[str, list[Turn]] = {}  # by vehicle, those that have not ended, in their order

    def turn(self, vehicle: str, text: str | None) -> Turn:
        """Take the next turn.

        Args:
            text: of the command; None: a change of settings, which a `stop` leaves in its turn.
        """
        turn = Turn(self, vehicle, text)
        with self._changed:
            if turn.is_stop:
                for other in self._turns.get(vehicle, ())[:]:
                    if other.is_command and not other.is_stop and not other.sending:
                        self._end(other, STOPPED)
            self._turns.setdefault(vehicle, []).append(turn)
            self._note_first(vehicle)
        return turn

    def wait(self, turn: Turn) -> str | None:
        """See `Turn.wait`."""
        with self._changed:
            stop_until_s = time.monotonic() + self._stop_waits_s
            while turn in (turns := self._turns.get(turn.vehicle, [])):
                before = turns[: turns.index(turn)]
                if turn.is_stop:
                    before = [other for other in before if other.sending and other.is_command]
                    until_s = stop_until_s
                else:
                    until_s = turns[0].first_s + self._longest_s
                left_s = until_s - time.monotonic()
                if not before or (turn.is_stop and left_s <= 0.0):
                    turn.sending = not turn.is_stop
                    return None
                if left_s <= 0.0:
                    self._end(before[0], TOO_LATE)
                else:
                    self._changed.wait(left_s)
            return turn.not_sent

    def end(self, turn: Turn, reason: str) -> None:
        """End a turn; the reason is that of a command that has not been sent."""
        with self._changed:
            self._end(turn, reason)

    def _end(self, turn: Turn, reason: str) -> None:
        turns = self._turns.get(turn.vehicle, [])
        if turn not in turns:
            return
        turns.remove(turn)
        if not turn.is_stop:
            turn.not_sent = reason
        if turns:
            self._note_first(turn.vehicle)
        else:
            del self._turns[turn.vehicle]
        self._changed.notify_all()

    def _note_first(self, vehicle: str) -> None:
        first = self._turns[vehicle][0]
        first.first_s = min(first.first_s, time.monotonic())


class Turn:
    """The place of one command in the order; ended at the end of a `with` statement, however that ends.

    Attributes:
        sending: it is being sent. first_s: when no other was before it any more, by the monotonic clock.
        not_sent: why it is not sent; None: it is.
    """

    def __init__(self, order: CommandOrder, vehicle: str, text: str | None) -> None:
        self._order, self.vehicle = order, vehicle
        self.is_command = text is not None
        self.is_stop = text is not None and is_stop(text)
        self.sending = False
        self.first_s = math.inf
        self.not_sent: str | None = None

    def wait(self) -> str | None:
        """Wait for the turns before this one; returns why it must not be sent. None: send it now.

        Of turns that do not end, each delays those after it by at most `longest_s`; a command whose turn has
        ended so, before it was sent, is not sent any more.
        """
        return self._order.wait(self)

    def end(self) -> None:
        """Let the next one be sent. Before this one is sent: it is not sent any more, unless it is `stop`."""
        self._order.end(self, WITHDRAWN)

    def withdraw(self) -> None:
        """Do not send it any more, unless it is being sent, or is `stop`."""
        if not self.sending and not self.is_stop:
            self.end()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.end()
