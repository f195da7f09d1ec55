"""Impairments of packed datagrams: a seeded, deterministic stage between a vehicle and its sockets.

A `Channel` is one direction of one link. Datagrams go in with `push` and come out with `due`, through the
impairments active at that moment, always in this order: rate limit, loss, corruption, duplication, delay,
reordering. Times are seconds of the caller's clock; no clock is read and no socket is used here.
Without `Reorder` a channel keeps the order of datagrams, also when a delay ends.
"""

from __future__ import annotations

import heapq
import random
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

# A telemetry radio buffers about this much before it drops what it cannot send (SiK: a few kB).
RADIO_BUFFER_BYTES = 4096
# A copy of a datagram comes this long after the first, as over a second path of a network.
DUPLICATE_SPACING_S = 0.003


@dataclass(slots=True)
class Counts:
    """Counts of datagrams. Always: entered + duplicated == delivered + lost + waiting."""

    entered: int = 0
    delivered: int = 0
    lost: int = 0
    duplicated: int = 0
    corrupted: int = 0
    held_back: int = 0


@dataclass(frozen=True, slots=True)
class _Transit:
    """One copy of a datagram in the impairments; `at_s` is when it leaves the last one."""

    at_s: float
    data: bytes
    overtaken: bool = False  # held back on purpose: later ones may come before it


class Impairment(ABC):
    """One impairment of a channel. `rank` orders several of them."""

    rank = 0

    @abstractmethod
    def carry(self, transit: _Transit, counts: Counts) -> list[_Transit]:
        """The copies that leave for one datagram that enters: none, one or more, none earlier than it."""


class RateLimit(Impairment):
    """A limit in bytes per second with a small buffer; what does not fit the buffer is lost."""

    rank = 0

    def __init__(self, bytes_per_s: float, buffer_bytes: int = RADIO_BUFFER_BYTES) -> None:
        self._bytes_per_s = bytes_per_s
        self._buffer_bytes = buffer_bytes
        self._free_s = 0.0

    def carry(self, transit: _Transit, counts: Counts) -> list[_Transit]:
        waiting_bytes = max(self._free_s - transit.at_s, 0.0) * self._bytes_per_s
        if waiting_bytes + len(transit.data) > self._buffer_bytes:
            counts.lost += 1
            return []
        self._free_s = max(self._free_s, transit.at_s) + len(transit.data) / self._bytes_per_s
        return [_Transit(self._free_s, transit.data, transit.overtaken)]


class Loss(Impairment):
    """Each datagram is lost with a probability; 1.0 is a dead link."""

    rank = 1

    def __init__(self, probability: float, seed: int | str) -> None:
        self._probability = probability
        self._random = random.Random(seed)

    def carry(self, transit: _Transit, counts: Counts) -> list[_Transit]:
        if self._random.random() < self._probability:
            counts.lost += 1
            return []
        return [transit]


class Corruption(Impairment):
    """With a probability, one to four bytes of a datagram change; its length stays."""

    rank = 2

    def __init__(self, probability: float, seed: int | str) -> None:
        self._probability = probability
        self._random = random.Random(seed)

    def carry(self, transit: _Transit, counts: Counts) -> list[_Transit]:
        chance = self._random
        if not transit.data or chance.random() >= self._probability:
            return [transit]
        damaged = bytearray(transit.data)
        for index in chance.sample(range(len(damaged)), min(chance.randint(1, 4), len(damaged))):
            damaged[index] ^= chance.randint(1, 255)
        counts.corrupted += 1
        return [_Transit(transit.at_s, bytes(damaged), transit.overtaken)]


class Duplication(Impairment):
    """With a probability, a datagram arrives twice."""

    rank = 3

    def __init__(self, probability: float, seed: int | str) -> None:
        self._probability = probability
        self._random = random.Random(seed)

    def carry(self, transit: _Transit, counts: Counts) -> list[_Transit]:
        if self._random.random() >= self._probability:
            return [transit]
        counts.duplicated += 1
        # the copy may fall among the datagrams that follow; those keep their order
        return [transit, _Transit(transit.at_s + DUPLICATE_SPACING_S, transit.data, True)]


class Delay(Impairment):
    """Every datagram is delayed by `delay_s` plus a random time up to `jitter_s`."""

    rank = 4

    def __init__(self, delay_s: float, jitter_s: float = 0.0, seed: int | str = 0) -> None:
        self._delay_s = delay_s
        self._jitter_s = jitter_s
        self._random = random.Random(seed)

    def carry(self, transit: _Transit, counts: Counts) -> list[_Transit]:
        late_s = self._delay_s + (self._random.random() * self._jitter_s if self._jitter_s else 0.0)
        return [_Transit(transit.at_s + late_s, transit.data, transit.overtaken)]


class Reorder(Impairment):
    """With a probability, a datagram is held back for `hold_s`, so that later ones overtake it."""

    rank = 5

    def __init__(self, probability: float, hold_s: float, seed: int | str) -> None:
        self._probability = probability
        self._hold_s = hold_s
        self._random = random.Random(seed)

    def carry(self, transit: _Transit, counts: Counts) -> list[_Transit]:
        if self._random.random() >= self._probability:
            return [transit]
        counts.held_back += 1
        return [_Transit(transit.at_s + self._hold_s, transit.data, True)]


class Channel:
    """One direction of a link.

    Attributes:
        counts: of the datagrams that passed while it was engaged.
    """

    def __init__(self) -> None:
        self.counts = Counts()
        self._impairments: list[Impairment] = []
        self._waiting: list[tuple[float, int, bytes, Any]] = []
        self._pushed = 0
        self._newest_due_s = 0.0

    @property
    def engaged(self) -> bool:
        """Whether an impairment is active or datagrams wait in it; else it can be bypassed."""
        return bool(self._impairments or self._waiting)

    @property
    def waiting(self) -> int:
        """Datagrams in transit."""
        return len(self._waiting)

    def impair(self, impairment: Impairment) -> None:
        """Add an impairment; datagrams in transit are not affected."""
        self._impairments.append(impairment)
        self._impairments.sort(key=lambda one: one.rank)

    def clear(self, impairment: Impairment) -> None:
        """Remove an impairment. Does nothing if it is not active."""
        if impairment in self._impairments:
            self._impairments.remove(impairment)

    def drop_waiting(self) -> None:
        """Drop the datagrams in transit, as a link that breaks does."""
        self.counts.lost += len(self._waiting)
        self._waiting.clear()
        self._newest_due_s = 0.0

    def push(self, now_s: float, data: bytes, tag: Any = None) -> None:
        """A datagram enters; `tag` (its sender, say) comes out with it."""
        counts = self.counts
        counts.entered += 1
        copies = [_Transit(now_s, data)]
        for impairment in self._impairments:
            copies = [out for copy in copies for out in impairment.carry(copy, counts)]
        for copy in copies:
            due_s = copy.at_s
            if not copy.overtaken:
                due_s = self._newest_due_s = max(due_s, self._newest_due_s)
            self._pushed += 1
            heapq.heappush(self._waiting, (due_s, self._pushed, copy.data, tag))

    def due(self, now_s: float) -> list[tuple[bytes, Any]]:
        """Remove and return what has arrived by `now_s`, in the order of arrival, as (datagram, tag)."""
        arrived: list[tuple[bytes, Any]] = []
        while self._waiting and self._waiting[0][0] <= now_s + 1e-9:
            _, _, data, tag = heapq.heappop(self._waiting)
            arrived.append((data, tag))
        self.counts.delivered += len(arrived)
        return arrived


class LinkStage:
    """Both directions of one link: `outbound` from the vehicle, `inbound` to it."""

    def __init__(self) -> None:
        self.outbound = Channel()
        self.inbound = Channel()
