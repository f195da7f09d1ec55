"""What a service tells people of itself."""

from __future__ import annotations

import logging
import time
from collections import deque
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

logger = logging.getLogger(__package__)


@dataclass(frozen=True, slots=True)
class Event:
    """Something a person should know. `level` is info, warning or error."""

    stamp_ns: int
    level: str
    text: str


class EventLog:
    """Every event goes into the log, onto the bus and to a listener.

    Args:
        publish: an event as it is published. on_event: called with every event.

    Attributes:
        newest: the last hundred.
    """

    def __init__(
        self, publish: Callable[[dict[str, Any]], None], on_event: Callable[[Event], None] | None
    ) -> None:
        self._publish, self._on_event = publish, on_event
        self.newest: deque[Event] = deque(maxlen=100)

    def add(self, level: str, text: str) -> None:
        """Something happened. Never raises, whatever the listener does."""
        event = Event(time.monotonic_ns(), level, text)
        self.newest.append(event)
        logger.log(getattr(logging, level.upper()), "%s", text)
        self._publish(asdict(event))
        if self._on_event is not None:
            try:
                self._on_event(event)
            except Exception:
                # A listener must not be able to bring the vehicle down.
                logger.exception("an event listener failed")
