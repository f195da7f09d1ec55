"""Gives an autopilot its signing key by SETUP_SIGNING, and checks what it does with signed messages then.

https://mavlink.io/en/messages/common.html#SETUP_SIGNING: to one component, never broadcast, over a wire. The
key travels as it is.
"""

from __future__ import annotations

import asyncio
import contextlib
import struct
import time
from collections.abc import Callable
from dataclasses import dataclass

from companion.vehicle.byte_link import ByteLink, Source, open_link
from companion.vehicle.driver import LinkError
from companion.vehicle.framing import MAGIC_V1, Frame, Framer, pack_frame
from companion.vehicle.kept_timestamp import KeptTimestamp
from companion.vehicle.link_url import LinkScheme, LinkUrl
from companion.vehicle.signing import (
    KEY_LENGTH,
    NO_KEY,
    FrameSigner,
    is_radio_message,
    is_signed_with,
    is_signed_with_a_key,
)
from companion.vehicle.vehicle_type import AUTOPILOT_NAMES, PX4

# MAVLink common
_HEARTBEAT_ID, _TIMESYNC_ID, _SETUP_SIGNING_ID = 0, 111, 256
_HEARTBEAT = struct.Struct("<IBBBBB")  # custom_mode, type, autopilot, base_mode, system_status, version
_TIMESYNC = struct.Struct("<qqBB")  # tc1, ts1, target system and component
_SETUP_SIGNING = struct.Struct(f"<QBB{KEY_LENGTH}s")  # initial_timestamp, target system and component, key
_ARMED = 128  # MAV_MODE_FLAG_SAFETY_ARMED
_AUTOPILOT_COMPONENT, _OWN_COMPONENT = 1, 191
_ONBOARD_CONTROLLER, _INVALID, _ACTIVE = 18, 8, 4  # MAV_TYPE, MAV_AUTOPILOT, MAV_STATE

_OPEN_S, _HEARTBEAT_S = 5.0, 10.0
_RADIO_S = 2.0  # a radio reports itself about once a second
_ATTEMPTS, _ATTEMPT_S, _ASK_S = 3, 3.0, 0.5
_UNSIGNED_S = 2.0
_FRESH_S = 3.0


class SigningSetupError(LinkError):
    """The autopilot has not taken the key. One line: what was seen, and what to do."""


@dataclass(frozen=True, slots=True)
class SigningSetup:
    """What an autopilot does after it was given a key, or after signing was ended.

    Attributes:
        autopilot: MAV_AUTOPILOT. takes_unsigned: it has answered an unsigned message on this link.
    """

    system_id: int
    autopilot: int
    takes_unsigned: bool


async def set_up_signing(
    url: LinkUrl,
    key: bytes | None,
    *,
    system_id: int | None = None,
    present_key: bytes | None = None,
    kept: KeptTimestamp | None = None,
) -> SigningSetup:
    """Give a disarmed autopilot a signing key, and check that it signs with it and answers what is signed.

    Args:
        url: of a wire. A link on which a radio reports itself is refused.
        key: 32 bytes; None: signing ends. What is unsigned must be answered then.
        system_id: the autopilot's; None: that of the first one received.
        present_key: with which the autopilot's present setting asks messages to be signed.
        kept: as of `FrameSigner`.

    Raises:
        LinkError: the link cannot be opened, there is no autopilot, or it is armed.
        SigningSetupError: it does not behave so.
    """
    exchange = _Exchange(url, system_id, FrameSigner(present_key or key or NO_KEY, kept))
    await exchange.open()
    try:
        await exchange.find_autopilot(signed=present_key is not None)
        for _ in range(_ATTEMPTS):
            exchange.check_disarmed()
            exchange.use_key(present_key)
            exchange.send_key(key, signed=present_key is not None)
            exchange.use_key(key)
            if await exchange.is_answered(_ATTEMPT_S, key, signed=key is not None):
                break
        else:
            raise SigningSetupError(exchange.not_taken(key))
        unsigned = key is None or await exchange.is_answered(_UNSIGNED_S, key, signed=False)
        return SigningSetup(exchange.system_id or 0, exchange.autopilot, unsigned)
    finally:
        await exchange.close()


class _Exchange:
    """The messages of one link with an autopilot."""

    def __init__(self, url: LinkUrl, system_id: int | None, signer: FrameSigner) -> None:
        self.url, self.system_id = url, system_id
        self.autopilot = 0
        # One for both keys: an autopilot compares timestamps whatever the key is.
        self._signer = signer
        self._link: ByteLink | None = None
        self._received = asyncio.Event()
        self._armed = False
        self._heartbeat: Frame | None = None
        self._heartbeat_s = -_FRESH_S
        self._source: Source = None
        self._others: set[str] = set()
        self._second = self._radio = ""
        self._framers: dict[Source, Framer] = {}
        self._sequence = 0
        self._asked: set[int] = set()
        self._answers: list[Frame] = []

    async def open(self) -> None:
        try:
            async with asyncio.timeout(_OPEN_S):
                self._link = await open_link(self.url, self._on_bytes)
        except TimeoutError as error:
            raise LinkError(f"{self.url}: could not be opened within {_OPEN_S:g} s") from error

    async def close(self) -> None:
        if self._link is not None:
            await self._link.close()

    def use_key(self, key: bytes | None) -> None:
        if key is not None:
            self._signer.key = key

    def _on_bytes(self, data: bytes, source: Source) -> None:
        framer = self._framers.setdefault(source, Framer())
        for frame in framer.feed(data, datagram=source is not None):
            if is_radio_message(frame):
                self._radio = f"{frame.system_id}/{frame.component_id}"
            elif frame.component_id == _AUTOPILOT_COMPONENT and self.system_id in (None, frame.system_id):
                self._from_autopilot(frame, source)
            elif frame.message_id == _HEARTBEAT_ID:
                self._others.add(f"{frame.system_id}/{frame.component_id}")
        self._received.set()

    def _from_autopilot(self, frame: Frame, source: Source) -> None:
        if frame.message_id == _HEARTBEAT_ID:
            _, _, autopilot, base_mode, _, _ = _HEARTBEAT.unpack(frame.padded(_HEARTBEAT.size))
            if autopilot == _INVALID:
                return
            if self._heartbeat is not None and source != self._source:
                self._second = f"{frame.system_id}/{frame.component_id}"
                return
            self.system_id, self.autopilot, self._source = frame.system_id, autopilot, source
            self._armed = bool(base_mode & _ARMED)
            self._heartbeat, self._heartbeat_s = frame, time.monotonic()
            if self._link is not None:
                self._link.answer_to(source)
        if source != self._source or self._heartbeat is None:
            return
        if is_signed_with(frame.raw, self._signer.key):
            self._signer.follow(frame)
        if frame.message_id == _TIMESYNC_ID:
            boot_ns, asked_ns, _, _ = _TIMESYNC.unpack(frame.padded(_TIMESYNC.size))
            if boot_ns and asked_ns in self._asked:
                self._answers.append(frame)

    async def find_autopilot(self, *, signed: bool) -> None:
        began_s = time.monotonic()
        while self._heartbeat is None and time.monotonic() - began_s < _HEARTBEAT_S:
            if self.url.scheme is not LinkScheme.UDP_IN:
                heartbeat = _HEARTBEAT.pack(0, _ONBOARD_CONTROLLER, _INVALID, 0, _ACTIVE, 3)
                self._send(_HEARTBEAT_ID, heartbeat, signed=signed)
            await self._until(lambda: self._heartbeat is not None, 1.0)
        if self._heartbeat is None:
            others = f"; received only {', '.join(sorted(self._others))}" if self._others else ""
            wanted = "" if self.system_id is None else f" of system {self.system_id}"
            raise LinkError(f"{self.url}: no autopilot heartbeat within {_HEARTBEAT_S:g} s{wanted}{others}")
        await self._until(lambda: bool(self._radio), _RADIO_S)
        if self._radio:
            raise SigningSetupError(
                f"{self.url}: a telemetry radio ({self._radio}) is on this link: no key is sent; use a wire"
            )
        if self._second:
            raise SigningSetupError(f"{self.url}: two autopilots {self._second}: give each its own system id")

    def check_disarmed(self) -> None:
        if time.monotonic() - self._heartbeat_s > _FRESH_S:
            raise LinkError(f"{self.url}: no heartbeat of system {self.system_id} for {_FRESH_S:g} s")
        if self._armed:
            raise LinkError(f"{self.url}: system {self.system_id} is armed: a key is sent on the ground only")

    def send_key(self, key: bytes | None, *, signed: bool) -> None:
        timestamp = 0 if key is None else self._signer.next_timestamp()
        payload = _SETUP_SIGNING.pack(timestamp, self.system_id or 0, _AUTOPILOT_COMPONENT, key or NO_KEY)
        self._send(_SETUP_SIGNING_ID, payload, signed=signed)

    async def is_answered(self, seconds: float, key: bytes | None, *, signed: bool) -> bool:
        """Whether TIMESYNC, sent signed or not, is answered with a signature of this key.

        Args:
            key: None: the answer must be unsigned, or signed with PX4's key of zeros.
        """

        def answered() -> bool:
            return any(
                not is_signed_with_a_key(frame.raw) if key is None else is_signed_with(frame.raw, key)
                for frame in self._answers
            )

        self._asked.clear()
        self._answers.clear()
        until_s = time.monotonic() + seconds
        while not answered() and time.monotonic() < until_s:
            now_ns = time.monotonic_ns()
            self._asked.add(now_ns)
            request = _TIMESYNC.pack(0, now_ns, self.system_id or 0, _AUTOPILOT_COMPONENT)
            self._send(_TIMESYNC_ID, request, signed=signed)
            await self._until(answered, _ASK_S)
        return answered()

    def not_taken(self, key: bytes | None) -> str:
        """What was seen of an autopilot that has not taken a key, and what to do."""
        assert self._heartbeat is not None
        name = AUTOPILOT_NAMES.get(self.autopilot, f"MAV_AUTOPILOT {self.autopilot}")
        raw = self._heartbeat.raw
        if key is not None and is_signed_with(raw, key):
            what = "signs with this key and answers nothing that is signed with it"
            advice = "restart it, then send again: it may have seen later timestamps"
        elif raw[0] == MAGIC_V1:
            what = "sends MAVLink 1, which has no signatures"
            advice = (
                "PX4: MAV_PROTO_VER 2"
                if self.autopilot == PX4
                else "ArduPilot: 2 as SERIALx_PROTOCOL of this port"
            )
            advice += ", and restart it"
        elif self.autopilot == PX4:
            what = "goes on as before"
            advice = (
                "PX4 takes a key by its USB port alone, from 1.17 on (serial:///dev/ttyACM0:57600); with "
                "MAV_SIGN_CFG 2 it needs --present-key-file"
            )
        elif is_signed_with_a_key(raw):
            what = "signs with another key"
            advice = "give the file of that one as --present-key-file, or use its USB port"
        else:
            what = "does not sign"
            advice = "check that it receives on this link, and that its firmware has signing"
        return f"{self.url}: system {self.system_id}, {name}, {what}: {advice}"

    def _send(self, message_id: int, payload: bytes, *, signed: bool) -> None:
        if self._link is None:
            return
        frame = pack_frame(
            message_id,
            payload,
            system_id=self.system_id or 1,
            component_id=_OWN_COMPONENT,
            sequence=self._sequence,
        )
        self._sequence = (self._sequence + 1) % 256
        self._link.send(self._signer.signed(frame) if signed else frame)

    async def _until(self, condition: Callable[[], bool], seconds: float) -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(seconds):
                while not condition():
                    self._received.clear()
                    await self._received.wait()
