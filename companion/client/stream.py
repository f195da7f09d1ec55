"""Messages of a topic as an asynchronous iterator: bounded, and the oldest is dropped."""

from __future__ import annotations

import asyncio
import math
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from typing import Generic, TypeVar

import zenoh

from companion.bus.client import subscribe_kept
from companion.bus.topics import Topic
from companion.host.peer_data import PeerDataError, copy_payload

T = TypeVar("T")


class _Queue:
    """Bytes from zenoh's threads to the loop, with their time of arrival, seconds."""

    def __init__(self, size: int, largest_bytes: int) -> None:
        self._largest_bytes = largest_bytes
        self._items: deque[tuple[bytes, float]] = deque(maxlen=size)
        self._loop, self._lock = asyncio.get_running_loop(), threading.Lock()
        self._arrived, self._waking = asyncio.Event(), False
        self.dropped = 0

    def put(self, sample: zenoh.Sample) -> None:
        """Add a message, from any thread. The loop is woken once, however many arrive meanwhile."""
        try:
            item = copy_payload(sample.payload, self._largest_bytes), time.monotonic()
        except PeerDataError:
            with self._lock:
                self.dropped += 1
            return
        with self._lock:
            self.dropped += len(self._items) == self._items.maxlen
            self._items.append(item)
            wake, self._waking = not self._waking, True
        if wake:
            with suppress(RuntimeError):  # the loop is closed
                self._loop.call_soon_threadsafe(self._arrived.set)

    async def get(self) -> tuple[bytes, float]:
        """Wait for the oldest message."""
        while True:
            with self._lock:
                if self._items:
                    return self._items.popleft()
                self._arrived.clear()
                self._waking = False
            await self._arrived.wait()


class Stream(AsyncIterator[T], Generic[T]):
    """The messages of one topic, the oldest first, until it is closed or deleted.

    Args:
        decode: raises PeerDataError for a message that is dropped.
        size: messages that may wait; when one more arrives, the oldest is dropped.
        max_age_s: those that wait longer are dropped; None: any age.

    Attributes:
        dropped: number of messages that were not delivered.
    """

    def __init__(
        self,
        session: zenoh.Session,
        topic: Topic,
        key: str,
        decode: Callable[[bytes], T],
        *,
        size: int,
        max_age_s: float | None,
    ) -> None:
        if size < 1:
            raise ValueError(f"size must be at least 1, got {size}")
        self._decode, self._max_age_s = decode, max_age_s
        self._queue, self._unused = _Queue(size, topic.largest_bytes), 0
        self._arrived_s = -math.inf
        # The callback refers to the queue alone, so that a stream that nobody reads any more is deleted.
        put = self._queue.put
        self._subscriber = (
            subscribe_kept(session, key, put) if topic.cached else session.declare_subscriber(key, put)
        )

    def __aiter__(self) -> Stream[T]:
        return self

    async def __anext__(self) -> T:
        while True:
            data, self._arrived_s = await self._queue.get()
            if self._max_age_s is None or self.age_s <= self._max_age_s:
                with suppress(PeerDataError):
                    return self._decode(data)
            self._unused += 1

    @property
    def age_s(self) -> float:
        """Seconds since the newest delivered message has arrived; infinite before the first."""
        return time.monotonic() - self._arrived_s

    @property
    def dropped(self) -> int:
        return self._queue.dropped + self._unused

    def close(self) -> None:
        """End the subscription, as deleting the stream does."""
        with suppress(zenoh.ZError):  # the connection is closed
            self._subscriber.undeclare()  # type: ignore[no-untyped-call]

    def __del__(self) -> None:
        if hasattr(self, "_subscriber"):
            self.close()
