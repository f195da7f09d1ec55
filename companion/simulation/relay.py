"""Shares one autopilot on a UDP port among several programs of this computer: its service and its camera.

Each program listens on its own port. The autopilot's messages go to all of them, theirs go to the autopilot.
Nothing is queued: what cannot be sent at once is dropped (`companion.vehicle.byte_link`).
"""

from __future__ import annotations

import asyncio
import logging
import struct
import time
from collections.abc import Sequence
from typing import NamedTuple

from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle.byte_link import ByteLink, Source, open_link
from companion.vehicle.driver import LinkError, LinkUnavailableError
from companion.vehicle.link_url import LinkScheme, LinkUrl, parse_link_url
from companion.vehicle.reception import Reception
from companion.vehicle.state import HEARTBEAT_MAX_AGE_S
from companion.vehicle.vehicle_type import AUTOPILOT_NAMES, MULTICOPTERS, autopilot_text, type_text

logger = logging.getLogger(__name__)

_HEARTBEAT = struct.Struct("<IBBBBB")  # custom_mode, type, autopilot, base_mode, system_status, version
_FIRST_HEARTBEAT_S = 10.0
# Heartbeats are sent once a second: a second autopilot on the port is received in this time.
_LISTEN_S = 1.5


class AutopilotHeartbeat(NamedTuple):
    """Fields of an autopilot's HEARTBEAT: system id, MAV_TYPE, MAV_AUTOPILOT and MAV_MODE_FLAG."""

    system_id: int
    vehicle_type: int
    autopilot: int
    base_mode: int


class Relay:
    """An open relay.

    Attributes:
        url: the address the autopilot sends to.
        heartbeat: the newest heartbeat before the check; None before the first.
        others: addresses of further autopilots; their messages are dropped.
    """

    def __init__(self, url: LinkUrl) -> None:
        self.url = url
        self.heartbeat: AutopilotHeartbeat | None = None
        self.others: set[Source] = set()
        self._reception = Reception()
        self._source: Source = None
        self._received_s = 0.0
        self._checked = False
        self._first_heartbeat = asyncio.Event()
        self._vehicle: ByteLink | None = None
        self._programs: list[ByteLink] = []

    @classmethod
    async def open(cls, url: str, ports: Sequence[int]) -> Relay:
        """Open a relay between the autopilot that sends to `url` and programs on loopback `ports`.

        Raises:
            LinkError: the url is not `udpin://HOST:PORT`, or the port is not available.
        """
        parsed = parse_link_url(url)
        if parsed.scheme is not LinkScheme.UDP_IN:
            raise LinkError(f"{url}: expected udpin://HOST:PORT, the UDP port the autopilot sends to")
        relay = cls(parsed)
        try:
            relay._vehicle = await open_link(parsed, relay._from_vehicle)
            for port in ports:
                program = LinkUrl(LinkScheme.UDP_OUT, ("127.0.0.1", port))
                relay._programs.append(await open_link(program, relay._from_program))
        except BaseException:
            await relay.close()
            raise
        return relay

    async def close(self) -> None:
        """Release the ports."""
        for link in (self._vehicle, *self._programs):
            if link is not None:
                await link.close()

    async def check_autopilot(self) -> AutopilotHeartbeat:
        """Wait for the autopilot and check that it is one multirotor, disarmed.

        Raises:
            LinkUnavailableError: no autopilot.
            ValueError: several, not PX4 or ArduPilot, not a multirotor, or armed; one line.
        """
        try:
            async with asyncio.timeout(_FIRST_HEARTBEAT_S):
                await self._first_heartbeat.wait()
        except TimeoutError:
            raise LinkUnavailableError(
                f"{self.url}: no autopilot heartbeat within {_FIRST_HEARTBEAT_S:g} s; "
                "check that it is running and sends to this port"
            ) from None
        await asyncio.sleep(_LISTEN_S)
        assert self.heartbeat is not None
        system_id, vehicle_type, autopilot, base_mode = self.heartbeat
        if self.others:
            senders = ", ".join(f"{host}:{port}" for host, port, *_ in (self._source, *self.others))
            raise ValueError(f"{self.url}: two autopilots send to this port ({senders}); end one of them")
        if autopilot not in AUTOPILOT_NAMES:
            name = autopilot_text(autopilot)
            raise ValueError(f"{self.url}: system {system_id} is {name}; expected PX4 or ArduPilot")
        if vehicle_type not in MULTICOPTERS:
            name = type_text(vehicle_type)
            raise ValueError(f"{self.url}: system {system_id} is {name}; expected a multirotor")
        if base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED:
            raise ValueError(f"{self.url}: system {system_id} is armed; it must be disarmed on the ground")
        self._checked = True
        return self.heartbeat

    def _from_vehicle(self, data: bytes, source: Source) -> None:
        # The checked autopilot's messages are not parsed, which would delay them.
        known = source == self._source and self._checked
        heartbeat = None if known else self._heartbeat_in(data, source)
        if heartbeat is not None and source != self._source:
            self._on_new_sender(source, heartbeat)
        if source != self._source:
            return
        if heartbeat is not None:
            self.heartbeat = heartbeat
            self._first_heartbeat.set()
        self._received_s = time.monotonic()
        for program in self._programs:
            program.send(data)

    def _on_new_sender(self, source: Source, heartbeat: AutopilotHeartbeat) -> None:
        """Select the first autopilot, or the same one after a restart on another port.

        Another autopilot never replaces it: it was not checked, and setpoints are not meant for it.
        """
        silent_s = time.monotonic() - self._received_s
        same = self.heartbeat is None or heartbeat.system_id == self.heartbeat.system_id
        restarted = same and source not in self.others and silent_s > HEARTBEAT_MAX_AGE_S
        if self._source is None or restarted:
            if self._source is not None:
                logger.warning("%s: the autopilot now sends from %s:%s", self.url, *source[:2])
            self._source = source
            assert self._vehicle is not None
            self._vehicle.answer_to(source)
        elif source not in self.others:
            self.others.add(source)
            if self._checked:  # else the check refuses it
                logger.warning(
                    "%s: a second autopilot sends from %s:%s: its messages are dropped", self.url, *source[:2]
                )

    def _from_program(self, data: bytes, _source: Source) -> None:
        if self._vehicle is not None:
            self._vehicle.send(data)

    def _heartbeat_in(self, data: bytes, source: Source) -> AutopilotHeartbeat | None:
        """Return an autopilot's heartbeat that a datagram completes; None if there is none."""
        for frame in self._reception.feed(data, source, datagram=True, keep=self._source):
            if (
                frame.message_id == mavlink.MAVLINK_MSG_ID_HEARTBEAT
                and frame.component_id == mavlink.MAV_COMP_ID_AUTOPILOT1
            ):
                _, vehicle_type, autopilot, base_mode, _, _ = _HEARTBEAT.unpack(frame.padded(_HEARTBEAT.size))
                if autopilot != mavlink.MAV_AUTOPILOT_INVALID:
                    return AutopilotHeartbeat(frame.system_id, vehicle_type, autopilot, base_mode)
        return None
