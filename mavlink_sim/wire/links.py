"""The vehicle's MAVLink connections: what is sent on each, which components it has, what is forwarded."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable
from typing import Any, Protocol

from mavlink_sim.px4.parameters import Parameter
from mavlink_sim.wire.announcements import Text
from mavlink_sim.wire.messages import Outgoing, dialect
from mavlink_sim.wire.signing import Signing
from mavlink_sim.wire.streams import Streams

AUTOPILOT_COMPONENT = 1  # MAV_COMP_ID_AUTOPILOT1
GROUND_STATION_TIMEOUT_S = 2.5
# PX4's CURRENT_MODE reports its vehicle_status, which is published when it changes and every half second.
STATUS_PERIOD_S = 0.5
STATUS_TEXT_LENGTH = 50


class FileServer(Protocol):
    """A MAVLink FTP session with a client of the link (`services.file_transfer.Server`)."""

    @property
    def idle(self) -> bool: ...

    def answer(self, payload: bytes, source: tuple[int, int], now_s: float) -> bytes | None: ...

    def burst(self, now_s: float) -> list[tuple[tuple[int, int], bytes]]: ...


class Link:
    """One connection: its streams, its outbox, and the components received on it."""

    def __init__(self, name: str, system_id: int, streams: Streams) -> None:
        self.name = name
        self.streams = streams
        self.outbox: deque[Outgoing] = deque()
        self.components: set[tuple[int, int]] = set()
        self.ground_station_seen_s = -math.inf
        self.parameters_left: deque[Parameter] = deque()
        self.parameter_credit = 0.0
        self.file_transfer: FileServer | None = None  # made with the first request
        self.signing = Signing()
        self.has_parameter_errors = True
        self.sent = 0
        self.received = 0
        self.gate: Callable[[Link, Any], Any] | None = None  # may change or drop what is sent
        self._system_id = system_id
        self._text_identifier = 0
        self.status_is_due = False  # CURRENT_MODE was requested and has had nothing to report yet
        self._status_sent: object = None
        self._status_sent_s = -math.inf

    def send(self, message: Any) -> None:
        """Queue a message of the vehicle's own."""
        if self.gate is not None:
            message = self.gate(self, message)
            if message is None:
                return
        self.sent += 1
        self.outbox.append(Outgoing(message, self._system_id, AUTOPILOT_COMPONENT))

    def is_new_status(self, status: object, now_s: float) -> bool:
        """Whether CURRENT_MODE is due on this link with this status, however often it is requested."""
        if status == self._status_sent and now_s - self._status_sent_s < STATUS_PERIOD_S - 1e-6:
            return False
        self._status_sent, self._status_sent_s = status, now_s
        return True

    def send_text(self, text: Text, now_s: float) -> None:
        """STATUSTEXT, in chunks where it is long, if a ground station's heartbeat arrives on this link."""
        if not text.text or now_s - self.ground_station_seen_s >= GROUND_STATION_TIMEOUT_S:
            return
        encoded = text.text.encode()
        if len(encoded) <= STATUS_TEXT_LENGTH:
            self.send(dialect.MAVLink_statustext_message(text.severity, encoded))
            return
        self._text_identifier = self._text_identifier % 65535 + 1
        for sequence, start in enumerate(range(0, len(encoded), STATUS_TEXT_LENGTH)):
            chunk = encoded[start : start + STATUS_TEXT_LENGTH]
            self.send(
                dialect.MAVLink_statustext_message(text.severity, chunk, self._text_identifier, sequence)
            )

    def reset(self) -> None:
        """A reboot: no component received, no transfer in progress, default stream rates."""
        self.streams.restart(0)
        self.sent = self.received = self._text_identifier = 0
        self.status_is_due, self._status_sent = False, None
        self.parameter_credit = 0.0
        self.outbox.clear()
        self.components.clear()
        self.ground_station_seen_s = -math.inf
        self.parameters_left.clear()
        self.file_transfer = None

    def has_component(self, system: int, component: int) -> bool:
        """Whether a message to this target is worth sending here (PX4's `component_was_seen`)."""
        if system == 0:
            return bool(self.components)
        return any(
            system == seen_system and component in (0, seen_component)
            for seen_system, seen_component in self.components
        )


def target_of(message: Any) -> tuple[int, int]:
    """(system, component) that a message is addressed to; (0, 0) where it has no address."""
    return getattr(message, "target_system", 0), getattr(message, "target_component", 0)


def forward(message: Any, source: Link, links: Iterable[Link], system_id: int) -> None:
    """PX4's forwarding: broadcasts, and messages to a component, go to the links it was received on."""
    system, component = target_of(message)
    if system not in (0, system_id) or component == AUTOPILOT_COMPONENT:
        return
    if message.get_type() == "SETUP_SIGNING":
        return  # a key is for its addressee only
    for link in links:
        if link is not source and link.has_component(system, component):
            link.outbox.append(Outgoing(message, message.get_srcSystem(), message.get_srcComponent(), True))
