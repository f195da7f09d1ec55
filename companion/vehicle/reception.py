"""Received bytes as frames, for each sender of a link, and how many were split or lost."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from time import monotonic
from typing import Any

from companion.vehicle.framing import Frame, Framer

MAX_SENDERS = 32
# The rest of a split frame follows at once; after this time it is lost, and must not hold back what follows.
MAX_REST_AGE_S = 0.5


@dataclass(frozen=True, slots=True)
class ReceptionCounts:
    """Counts of a link since it was opened.

    Attributes:
        frames: of the autopilot.
        split: frames of any sender that were spread over several datagrams.
        lost: frames of the autopilot that are missing in its sequence numbers. A router that filters messages
            leaves gaps too.
        skipped_bytes: of any sender, in no frame: not MAVLink, damaged, or rests of lost datagrams.
    """

    frames: int = 0
    split: int = 0
    lost: int = 0
    skipped_bytes: int = 0


class Reception:
    """Separates the bytes of each sender into frames. A frame may be cut at any byte over its datagrams.

    What waits for its rest is bounded in number of senders, bytes (one frame each) and time; no sender can
    displace the rest of the autopilot's frame, nor that of one that has sent frames while others have not.
    """

    def __init__(self, clock_s: Callable[[], float] = monotonic) -> None:
        self._clock_s = clock_s
        self._senders: dict[Any, tuple[Framer, float]] = {}
        self._forgotten = ReceptionCounts()
        self._frames = self._lost = 0
        self._sequence: int | None = None

    def feed(self, data: bytes, source: object, *, datagram: bool, keep: object = None) -> list[Frame]:
        """Return the frames that `data` completes.

        Args:
            source: the sender's address; the same for all bytes of a stream.
            datagram: `data` is one.
            keep: the autopilot's address, which is never forgotten.
        """
        now_s = self._clock_s()
        framer, fed_s = self._senders.pop(source, (None, now_s))
        if framer is None:
            self._make_room(keep)
            framer = Framer()
        self._senders[source] = (framer, now_s)  # the newest last
        late = framer.flush() if datagram and now_s - fed_s > MAX_REST_AGE_S else []
        return late + framer.feed(data, datagram=datagram)

    def autopilot(self, frame: Frame) -> None:
        """Count a frame of the autopilot."""
        self._frames += 1
        if self._sequence is not None:
            missing = (frame.sequence - self._sequence - 1) % 256
            if missing > 127:  # out of order, or a duplicate
                return
            self._lost += missing
        self._sequence = frame.sequence

    def discard_received(self) -> None:
        """Forget what waits for its rest, which is not received any more; the counts stay."""
        for framer, _ in self._senders.values():
            framer.flush()
        self._sequence = None

    @property
    def counts(self) -> ReceptionCounts:
        """The counts so far."""
        framers = [framer for framer, _ in self._senders.values()]
        return ReceptionCounts(
            self._frames,
            self._forgotten.split + sum(framer.split_frames for framer in framers),
            self._lost,
            self._forgotten.skipped_bytes + sum(framer.skipped_bytes for framer in framers),
        )

    def _make_room(self, keep: object) -> None:
        if len(self._senders) < MAX_SENDERS:
            return
        others = [source for source in self._senders if source != keep]
        oldest = next((each for each in others if not self._senders[each][0].has_framed), others[0])
        framer, _ = self._senders.pop(oldest)
        self._forgotten = ReceptionCounts(
            split=self._forgotten.split + framer.split_frames,
            skipped_bytes=self._forgotten.skipped_bytes + framer.skipped_bytes + framer.waiting_bytes,
        )
