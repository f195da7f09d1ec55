"""The MAVLink address of our messages, and the signs that another program uses it too.

mavlink-router never forwards a message to an endpoint that has sent with its system and component id. So two
services with one address behind a router do not see each other, while both command the vehicle. Each
therefore waits for the heartbeats of others before it sends its own, and takes a free address. If two have
the same nevertheless, the autopilot's answers to the other one show it: to its TIMESYNC requests, where they
name their receiver, and to its commands.
"""

from __future__ import annotations

import random
from collections import deque
from collections.abc import Sequence

from companion.vehicle.byte_link import Source
from companion.vehicle.framing import Frame
from companion.vehicle.gimbal import Address

# Heartbeats are sent once a second. The jitter separates services that start at the same time.
LISTEN_S, LISTEN_JITTER_S = 1.2, 0.6
# A component that was not received for so long does not use its id any more.
_GONE_AFTER_S = 5.0
_MOST_SENDERS = 64
# MAV_CMD: NAV_RETURN_TO_LAUNCH, NAV_LAND, NAV_TAKEOFF, DO_SET_MODE, DO_REPOSITION, DO_PAUSE_CONTINUE,
# COMPONENT_ARM_DISARM
_MOTION = frozenset({20, 21, 22, 176, 192, 193, 400})
# Later than this no acknowledgement of a command of ours arrives.
_ACK_S = 10.0
# Answers to others' TIMESYNC requests: so many in so short a time. After a restart, an answer to the program
# before may still arrive.
_FOREIGN_ANSWERS, _FOREIGN_S = 3, 3.0


class OwnAddress:
    """The address, and what was received of others. Stamps are CLOCK_MONOTONIC nanoseconds.

    Args:
        system_id, component_id: of our messages. others: component ids to use instead, in their order.

    Attributes:
        address: system and component id of our messages. others: as given.
    """

    def __init__(self, system_id: int, component_id: int, others: Sequence[int]) -> None:
        self.address: Address = (system_id, component_id)
        self.others = tuple(others)
        self._all = (component_id, *self.others)
        self._left: set[int] = set()
        self.forget()

    def forget(self) -> None:
        """Forget what was received: the link is opened again."""
        self._received_ns: dict[tuple[Source, int], int] = {}
        self._source: Source = None
        self._sent: deque[tuple[int, int, int]] = deque(maxlen=16)  # component, sequence number, custom_mode
        self._foreign_ns: deque[int] = deque(maxlen=_FOREIGN_ANSWERS)
        self._asked_ns: dict[int, int] = {}

    @property
    def last(self) -> int:
        """The component id that would be used last."""
        return self._all[-1]

    def only_from(self, source: Source) -> None:
        """From now on only what the autopilot's link brings counts."""
        if source != self._source or len(self._received_ns) > len(self._all):
            self._source = source
            self._received_ns = {key: ns for key, ns in self._received_ns.items() if key[0] == source}

    # --- what we send ------------------------------------------------------------------------------------

    def sent(self, sequence: int, custom_mode: int) -> None:
        """Note our heartbeat, which may come back."""
        self._sent.append((self.address[1], sequence, custom_mode))

    def asked(self, command: int, now_ns: int) -> None:
        """Note our command, at its beginning and at its end."""
        self._asked_ns[command] = now_ns

    # --- what is received --------------------------------------------------------------------------------

    def is_echo(self, frame: Frame, custom_mode: int) -> bool:
        """Whether a heartbeat is one that we sent."""
        sent = (frame.component_id, frame.sequence, custom_mode) in self._sent
        return sent and frame.system_id == self.address[0]

    def on_heartbeat(self, frame: Frame, source: Source, custom_mode: int, now_ns: int) -> bool:
        """Note another component's heartbeat. Returns whether it has our address."""
        if frame.system_id != self.address[0] or frame.component_id not in self._all:
            return False
        if self.is_echo(frame, custom_mode):
            return False
        key = (source, frame.component_id)
        if key in self._received_ns or len(self._received_ns) < _MOST_SENDERS:
            self._received_ns[key] = now_ns
        return frame.component_id == self.address[1]

    def is_foreign_ack(self, command: int, now_ns: int) -> bool:
        """Whether an acknowledgement to our address is of a motion command that we did not send."""
        asked_ns = self._asked_ns.get(command)
        return command in _MOTION and (asked_ns is None or now_ns - asked_ns > _ACK_S * 1e9)

    def is_foreign_timesync(self, now_ns: int) -> bool:
        """Note an answer to our address, to a TIMESYNC request that we did not send; whether more arrive."""
        self._foreign_ns.append(now_ns)
        enough = len(self._foreign_ns) == _FOREIGN_ANSWERS
        return enough and now_ns - self._foreign_ns[0] <= _FOREIGN_S * 1e9

    # --- another address ---------------------------------------------------------------------------------

    def is_taken(self, now_ns: int) -> bool:
        """Whether another component with our id was received lately."""
        return self.address[1] in self._taken(now_ns)

    def change(self, now_ns: int, *, at_random: bool = False) -> bool:
        """Take a free component id, the next one or any; False: there is none.

        At random where the other program may be a service that changes its own at the same time. An id that
        was shared is not used again: a router delivers nothing with it to whoever has sent with it.
        """
        own = self._all.index(self.address[1])
        in_turn = (*self._all[own + 1 :], *self._all[:own])
        free = [number for number in in_turn if number not in self._taken(now_ns) | self._left]
        if not free:
            return False
        if at_random:
            self._left.add(self.address[1])
        self.address = (self.address[0], random.choice(free) if at_random else free[0])
        self._foreign_ns.clear()
        return True

    def _taken(self, now_ns: int) -> set[int]:
        return {
            component
            for (source, component), received_ns in self._received_ns.items()
            if source == self._source and now_ns - received_ns <= _GONE_AFTER_S * 1e9
        }
