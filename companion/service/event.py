"""Events of the service for the operator."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from companion.bus.bodies.service import EventBody
from companion.host.load import with_load
from vision.redaction import redacted

logger = logging.getLogger(__package__)


@dataclass(frozen=True, slots=True)
class Event:
    """A message for the operator. `level` is info, warning or error."""

    stamp_ns: int
    level: str
    text: str


class EventLog:
    """Sends every event to the log, the bus and a listener.

    Args:
        publish: publishes an event's message. on_event: called with every event.

    Attributes:
        newest: the last hundred events.
    """

    def __init__(
        self, publish: Callable[[EventBody], None], on_event: Callable[[Event], None] | None
    ) -> None:
        self._publish, self._on_event = publish, on_event
        self.newest: deque[Event] = deque(maxlen=100)

    def add(self, level: str, text: str) -> None:
        """Add an event, without secrets. Never raises, whatever the listener does."""
        text = with_load(redacted(text))
        event = Event(time.monotonic_ns(), level, text)
        self.newest.append(event)
        logger.log(getattr(logging, level.upper()), "%s", text)
        self._publish({"stamp_ns": event.stamp_ns, "level": event.level, "text": event.text})
        if self._on_event is not None:
            try:
                self._on_event(event)
            except Exception:
                # A listener's error must not end the service.
                logger.exception("an event listener failed")
