"""The messages on the topic `velocity`: checks them and keeps the newest of each sender."""

from __future__ import annotations

from dataclasses import replace

from pydantic import TypeAdapter, ValidationError

from companion.bus.bodies.vehicle import VelocityBody
from companion.guidance.behaviour import VelocityInput
from companion.host.peer_data import PeerDataError, parse_object
from companion.vehicle.clock_sync import SenderDelay

MAX_LIFETIME_S = 0.5
# A sender without an accepted message is forgotten after this; until then its clock is known, so that late
# messages are refused.
FORGET_S = 10.0
MAX_SENDERS = 8
_BODY = TypeAdapter(VelocityBody)


class VelocitySenders:
    """The programs that send velocities. Stamps are CLOCK_MONOTONIC nanoseconds.

    Attributes:
        received: a message was accepted, at any time.
    """

    def __init__(self) -> None:
        self._newest: dict[str, VelocityInput] = {}
        self._delays: dict[str, SenderDelay] = {}
        self._stamps_ns: dict[str, int] = {}
        self._valid_from_ns, self.received = 0, False

    def discard_received(self, now_ns: int) -> None:
        """What was received until now is outdated, also where it is processed later."""
        self._valid_from_ns = now_ns
        self._newest = {source: replace(each, expires_ns=0) for source, each in self._newest.items()}

    def on_message(self, payload: bytes, receipt_ns: int) -> None:
        """Process a message. Its lifetime counts from when it was sent, as far as its delay is known.

        Raises:
            PeerDataError: the message is not valid, is superseded by a newer one, or has arrived expired.
        """
        if receipt_ns < self._valid_from_ns:
            return
        message = parse_object(payload)
        try:
            body = _BODY.validate_python(message, strict=True)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"])) or "message"
            raise PeerDataError(f"{where}: {first['msg']}") from None
        self._forget(receipt_ns)
        source = body["source"]
        if source not in self._newest and len(self._newest) >= MAX_SENDERS:
            raise PeerDataError(f"{source}: at most {MAX_SENDERS} senders are accepted")
        older_ns = self._stamps_ns.get(source, body["stamp_ns"]) - body["stamp_ns"]
        if older_ns > 0:  # a newer one arrived before it, or the sender's clock was set back
            raise PeerDataError(
                f"{source}: stamp_ns is {older_ns / 1e9:.3f} s older than the newest; "
                f"a restarted sender needs a new source, or {FORGET_S:g} s"
            )
        self._stamps_ns[source], self.received = body["stamp_ns"], True
        late_ns = self._delays.setdefault(source, SenderDelay()).update(body["stamp_ns"], receipt_ns)
        lifetime_ns = round(body.get("lifetime_s", MAX_LIFETIME_S) * 1e9)
        self._newest[source] = VelocityInput(
            source,
            receipt_ns,
            receipt_ns - late_ns + lifetime_ns,
            body.get("forward_mps", 0.0),
            body.get("right_mps", 0.0),
            body.get("up_mps", 0.0),
            body.get("turn_radps", 0.0),
        )
        if late_ns > lifetime_ns:
            late_s, lifetime_s = late_ns / 1e9, lifetime_ns / 1e9
            raise PeerDataError(f"{source}: {late_s:.3f} s late, its lifetime is {lifetime_s:g} s")

    def newest(self, now_ns: int) -> tuple[VelocityInput, ...]:
        """Return the newest message of each sender, expired ones included, the first sender first."""
        self._forget(now_ns)
        return tuple(self._newest.values())

    def _forget(self, now_ns: int) -> None:
        for source, message in list(self._newest.items()):
            if now_ns - message.received_ns > FORGET_S * 1e9:
                del self._newest[source], self._delays[source], self._stamps_ns[source]
