"""Listens to topics of other programs: what arrives is bounded before it reaches the loop.

The size is checked on zenoh's thread, before the payload is copied. A limited number of messages of a topic
waits for the loop, the newest ones. One that cannot be used is counted, and logged now and then.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from companion.bus.topics import Topic
from companion.host.peer_data import Payload, PeerDataError, copy_payload

logger = logging.getLogger(__name__)

MAX_WAITING = 256
"""Messages of one topic; of more, the oldest is ignored."""
BATCH = 16
"""Messages that are handled at once; then other work of the loop has its turn."""
WARN_INTERVAL_S = 10.0
_LONGEST_REASON = 200


@dataclass(frozen=True, slots=True)
class Listener:
    """Who listens to a topic.

    Attributes:
        topic: its `largest_bytes` limits the messages.
        on_message: called in the loop with the payload and its time of receipt (CLOCK_MONOTONIC nanoseconds);
            raises PeerDataError for a message that is not valid.
        vehicle: whose messages; "*": those of all.
    """

    topic: Topic
    on_message: Callable[[bytes, int], None]
    vehicle: str = "*"


class ListenerQueue:
    """The messages of one listener on their way to the loop.

    Args:
        call_soon: schedules a call in the loop, from any thread.
        on_event: called in the loop with (level, text).

    Attributes:
        topic: of the listener. ignored: messages that were not used.
    """

    def __init__(
        self,
        listener: Listener,
        call_soon: Callable[..., object],
        on_event: Callable[[str, str], None],
        clock_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self.topic = listener.topic
        self._listener, self._call_soon, self._on_event = listener, call_soon, on_event
        self._clock_s = clock_s
        self._waiting: deque[tuple[bytes, int]] = deque()
        self._lock, self._scheduled = threading.Lock(), False
        self.ignored = self._unreported = 0
        self._warned_s = -WARN_INTERVAL_S

    def offer(self, payload: Payload, received_ns: int) -> None:
        """Add a message, from any thread. `payload`: copied only if its size is accepted."""
        try:
            data = copy_payload(payload, self.topic.largest_bytes)
        except PeerDataError as error:
            self._ignore(str(error))
            return
        with self._lock:
            full = len(self._waiting) >= MAX_WAITING
            if full:
                self._waiting.popleft()
            self._waiting.append((data, received_ns))
            wake, self._scheduled = not self._scheduled, True
        if full:
            self._ignore(f"more than {MAX_WAITING} wait for the loop")
        if wake:
            self._call_soon(self._handle)

    def _handle(self) -> None:
        for _ in range(BATCH):
            with self._lock:
                if not self._waiting:
                    self._scheduled = False
                    return
                data, received_ns = self._waiting.popleft()
            try:
                self._listener.on_message(data, received_ns)
            except PeerDataError as error:
                self._ignore(str(error))
            except Exception as error:  # no message may end the loop's callback
                logger.debug("a message on %s", self.topic.name, exc_info=True)
                self._ignore(f"{type(error).__name__}: {error}")
        self._call_soon(self._handle)

    def _ignore(self, reason: str) -> None:
        """Count a message, and report it if none was for a while."""
        with self._lock:
            self.ignored += 1
            self._unreported += 1
            now_s = self._clock_s()
            if now_s - self._warned_s < WARN_INTERVAL_S:
                return
            self._warned_s, count, self._unreported = now_s, self._unreported, 0
        more = f" ({count - 1} more before)" if count > 1 else ""
        short = " ".join(reason[:_LONGEST_REASON].split())
        text = f"{self.topic.name} message ignored: {short}{more}"
        self._call_soon(self._on_event, "warning", text)
