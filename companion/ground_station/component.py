"""A MAVLink component without I/O: what it sends by itself, and how it answers commands.

Commands come as COMMAND_LONG or COMMAND_INT (https://mavlink.io/en/services/command.html). A message is asked
for by MAV_CMD_REQUEST_MESSAGE or by an older command of its own; one table serves both.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle.gimbal import Address

Message = Any
"""A message of pymavlink, received or not packed yet."""

_S = 1_000_000_000
ACCEPTED, DENIED = mavlink.MAV_RESULT_ACCEPTED, mavlink.MAV_RESULT_DENIED
UNSUPPORTED, REJECTED = mavlink.MAV_RESULT_UNSUPPORTED, mavlink.MAV_RESULT_TEMPORARILY_REJECTED

# Older command → the message that it asks for, and the index of the parameter with its number.
OLD_REQUESTS: dict[int, tuple[int, int | None]] = {
    mavlink.MAV_CMD_REQUEST_CAMERA_INFORMATION: (mavlink.MAVLINK_MSG_ID_CAMERA_INFORMATION, None),
    mavlink.MAV_CMD_REQUEST_CAMERA_SETTINGS: (mavlink.MAVLINK_MSG_ID_CAMERA_SETTINGS, None),
    mavlink.MAV_CMD_REQUEST_STORAGE_INFORMATION: (mavlink.MAVLINK_MSG_ID_STORAGE_INFORMATION, 0),
    mavlink.MAV_CMD_REQUEST_CAMERA_CAPTURE_STATUS: (mavlink.MAVLINK_MSG_ID_CAMERA_CAPTURE_STATUS, None),
    mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_INFORMATION: (mavlink.MAVLINK_MSG_ID_VIDEO_STREAM_INFORMATION, 0),
    mavlink.MAV_CMD_REQUEST_VIDEO_STREAM_STATUS: (mavlink.MAVLINK_MSG_ID_VIDEO_STREAM_STATUS, 0),
}
# A repeated command arrives within this time; QGroundControl repeats after 3 s.
_REPEATED_NS = 10 * _S
_MOST_SENDERS = 64
SHORTEST_INTERVAL_NS = 50_000_000


class Component(Protocol):
    """A component on the link. Messages are returned in the order in which they are to be sent."""

    component_id: int

    def handle(self, message: Message, now_ns: int) -> Iterable[Message]:
        """Answer a message that is addressed to it, or to all; a station's HEARTBEAT too."""
        ...

    def due(self, now_ns: int) -> Iterable[Message]:
        """Return what is to be sent now. Called at least 20 times a second."""
        ...


@dataclass(frozen=True, slots=True)
class Command:
    """A received command.

    Attributes:
        number: MAV_CMD. parameters: all seven; NaN: not given.
        sender: system and component id. confirmation: how often it was sent before.
        received_ns: CLOCK_MONOTONIC.
    """

    number: int
    parameters: tuple[float, ...]
    sender: Address
    confirmation: int
    received_ns: int

    def whole(self, index: int) -> int:
        """Return a parameter, by its index from 0, as a whole number; 0 if not given, -1 if not finite."""
        value = self.parameters[index]
        return 0 if math.isnan(value) else int(value) if math.isfinite(value) else -1


@dataclass(frozen=True, slots=True)
class Answer:
    """The answer to a command: its MAV_RESULT (None: it is acknowledged later, by `due`), then messages."""

    result: int | None = ACCEPTED
    messages: Sequence[Message] = ()


class Stream:
    """Sends a message at an interval, once for each frame. `interval_ns`: the default; None: not at all."""

    def __init__(self, interval_ns: int | None, shortest_ns: int = SHORTEST_INTERVAL_NS) -> None:
        self._default_ns = self.interval_ns = interval_ns
        self._shortest_ns = shortest_ns
        self._next_ns, self._sequence = 0, -1

    def set_interval(self, interval_us: int) -> None:
        """Set it as MAV_CMD_SET_MESSAGE_INTERVAL does: -1 ends it, 0 is the default."""
        if interval_us < 0:
            self.interval_ns = None
        else:
            self.interval_ns = max(interval_us * 1000, self._shortest_ns) if interval_us else self._default_ns

    def is_due(self, now_ns: int, sequence: int | None) -> bool:
        """Whether to send now. `sequence`: of the frame; None: it is about none."""
        if self.interval_ns is None or now_ns < self._next_ns or sequence == self._sequence:
            return False
        late = now_ns - self._next_ns > self.interval_ns
        self._next_ns = (now_ns if late else self._next_ns) + self.interval_ns
        self._sequence = -1 if sequence is None else sequence
        return True


class RequestTable:
    """Answers commands and requests for messages.

    Attributes:
        actions: MAV_CMD → what executes it.
        replies: message id → what makes it. Its argument is the number of a stream, storage or image, 0 for
            all or where there is none; nothing is returned for a number that does not exist.
        listeners: type of another message, such as PARAM_EXT_SET → what answers it.
        streams: message id → when its sender, not this class, sends it.
    """

    def __init__(self) -> None:
        self.actions: dict[int, Callable[[Command], Answer]] = {
            mavlink.MAV_CMD_SET_MESSAGE_INTERVAL: self._set_interval
        }
        self.replies: dict[int, Callable[[int], Sequence[Message]]] = {}
        self.listeners: dict[str, Callable[[Message], Iterable[Message]]] = {}
        self._executed: dict[tuple[Address, int], tuple[Command, int]] = {}  # with its result
        self.streams: dict[int, Stream] = {}
        self._timed: dict[int, Stream] = {}

    def handle(self, message: Message, now_ns: int) -> list[Message]:
        """Return the answer to a message. A command has an acknowledgement, then the messages asked for.

        What is sent to all components and unknown here has none: it is for another one.
        """
        if (listener := self.listeners.get(message.get_type())) is not None:
            return list(listener(message))
        if message.get_type() == "COMMAND_LONG":
            values, confirmation = [getattr(message, f"param{n}") for n in range(1, 8)], message.confirmation
        elif message.get_type() == "COMMAND_INT":
            values = [*(getattr(message, f"param{n}") for n in range(1, 5)), message.x, message.y, message.z]
            confirmation = 0
        else:
            return []
        sender = (message.get_srcSystem(), message.get_srcComponent())
        command = Command(message.command, tuple(map(float, values)), sender, confirmation, now_ns)
        answer = self._answer(command)
        if answer.result is None:
            return []
        if answer.result == UNSUPPORTED and message.target_component == 0:
            return []
        return [
            mavlink.MAVLink_command_ack_message(command.number, answer.result, 0, 0, *sender),
            *answer.messages,
        ]

    def due(self, now_ns: int) -> list[Message]:
        """Return the messages whose interval has passed."""
        due = [message_id for message_id, stream in self._timed.items() if stream.is_due(now_ns, None)]
        return [message for message_id in due for message in self.replies[message_id](0)]

    def _answer(self, command: Command) -> Answer:
        if command.number == mavlink.MAV_CMD_REQUEST_MESSAGE:
            return self._request(command.whole(0), command.whole(1))
        if (old := OLD_REQUESTS.get(command.number)) is not None:
            message_id, index = old
            return self._request(message_id, 0 if index is None else command.whole(index))
        action = self.actions.get(command.number)
        if action is None:
            return Answer(UNSUPPORTED)
        key = (command.sender, command.number)
        before = self._executed.pop(key, None)
        if before is not None and _is_repetition(command, before[0]):
            self._executed[key] = before
            return Answer(before[1])
        answer = action(command)
        if answer.result is None:
            return answer
        self._executed[key] = command, answer.result
        if len(self._executed) > _MOST_SENDERS:
            self._executed.pop(next(iter(self._executed)))
        return answer

    def _request(self, message_id: int, number: int) -> Answer:
        reply = self.replies.get(message_id)
        if reply is None:
            return Answer(UNSUPPORTED)
        messages = reply(number)
        return Answer(ACCEPTED, messages) if messages else Answer(DENIED)

    def _set_interval(self, command: Command) -> Answer:
        """Execute MAV_CMD_SET_MESSAGE_INTERVAL."""
        message_id = command.whole(0)
        if message_id not in self.streams and message_id not in self.replies:
            return Answer(UNSUPPORTED)
        stream = self.streams.get(message_id) or self._timed.setdefault(message_id, Stream(None))
        stream.set_interval(command.whole(1))
        return Answer()


def _is_repetition(command: Command, before: Command) -> bool:
    """Whether a command is one that was executed: its acknowledgement was lost.

    MAV_CMD_IMAGE_START_CAPTURE has a number of its own for this, which a restarted station begins again.
    """
    numbered = command.number == mavlink.MAV_CMD_IMAGE_START_CAPTURE and command.parameters[3] > 0
    return (
        (command.confirmation > 0 or numbered)
        and str(command.parameters) == str(before.parameters)  # NaN is not equal to itself
        and command.received_ns - before.received_ns < _REPEATED_NS
    )


def is_addressed(message: Message, system_id: int, component_id: int) -> bool:
    """Whether a message names a component as its target, or all of them."""
    return getattr(message, "target_system", None) in (0, system_id) and getattr(
        message, "target_component", None
    ) in (0, component_id)
