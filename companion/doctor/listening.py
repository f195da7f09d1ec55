"""Listens on the vehicle's link as the service does before it answers: nothing is sent."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle.byte_link import Source, open_link
from companion.vehicle.driver import LinkError
from companion.vehicle.framing import Framer
from companion.vehicle.link_url import LinkUrl
from companion.vehicle.signing import is_signed_with_a_key

_HEARTBEAT = mavlink.MAVLINK_MSG_ID_HEARTBEAT
Address = tuple[int, int]
"""System id and component id."""


@dataclass(frozen=True, slots=True)
class Sender:
    """One sender of heartbeats.

    Attributes:
        mav_type, autopilot: MAV_TYPE and MAV_AUTOPILOT of the newest heartbeat.
        heartbeats: how many. sources: network addresses that they came from.
        signed: the newest was, and not with the key of zeros that PX4 has without one.
    """

    mav_type: int
    autopilot: int
    heartbeats: int
    signed: bool
    sources: frozenset[str] = frozenset()

    @property
    def is_autopilot(self) -> bool:
        """Whether it is an autopilot: others have MAV_AUTOPILOT_INVALID."""
        return self.autopilot != int(mavlink.MAV_AUTOPILOT_INVALID)


@dataclass(frozen=True, slots=True)
class Received:
    """What was received in `seconds`.

    Attributes:
        senders: of heartbeats. frames: of any message. skipped_bytes: that are in no frame.
        problem: why the link could not be opened; empty: it was.
    """

    seconds: float = 0.0
    senders: Mapping[Address, Sender] = field(default_factory=dict)
    frames: int = 0
    skipped_bytes: int = 0
    problem: str = ""


def listen(url: LinkUrl, seconds: float, enough: Callable[[Received], bool] | None = None) -> Received:
    """Receive for a time. Never raises for the link.

    Args:
        enough: ends it earlier when it returns True for what was received so far.
    """
    return asyncio.run(_listen(url, seconds, enough))


async def _listen(url: LinkUrl, seconds: float, enough: Callable[[Received], bool] | None) -> Received:
    framers: dict[Source, Framer] = {}
    senders: dict[Address, Sender] = {}
    frames = 0
    ended = asyncio.Event()
    began_s = time.monotonic()

    def received() -> Received:
        skipped = sum(framer.skipped_bytes for framer in framers.values())
        return Received(time.monotonic() - began_s, senders, frames, skipped)

    def receive(data: bytes, source: Source) -> None:
        nonlocal frames
        framer = framers.setdefault(source, Framer())
        for frame in framer.feed(data, datagram=source is not None):
            frames += 1
            if frame.message_id != _HEARTBEAT:
                continue
            address, payload = (frame.system_id, frame.component_id), frame.padded(9)
            before = senders.get(address)
            sources = frozenset() if before is None else before.sources
            senders[address] = Sender(
                payload[4],
                payload[5],
                (0 if before is None else before.heartbeats) + 1,
                is_signed_with_a_key(frame.raw),
                sources if source is None else sources | {f"{source[0]}:{source[1]}"},
            )
        if enough is not None and enough(received()):
            ended.set()

    try:
        async with asyncio.timeout(seconds + 1.0):
            link = await open_link(url, receive)
    except (LinkError, TimeoutError) as error:
        return Received(problem=str(error) or f"{url}: no connection within {seconds + 1.0:g} s")
    began_s = time.monotonic()
    try:
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(ended.wait(), seconds)
    finally:
        await link.close()
    return received()
