"""The messages on the topic `velocity`: checks them and keeps the newest of each sender."""

from __future__ import annotations

from collections.abc import Callable

from pydantic import TypeAdapter, ValidationError

from companion.bus.bodies.vehicle import VelocityBody
from companion.guidance.behaviour import VelocityInput
from companion.vehicle.clock_sync import SenderDelay

MAX_LIFETIME_S = 0.5
# A sender without an accepted message is forgotten after this; until then its clock is known, so that late
# messages are refused.
FORGET_S = 10.0
MAX_SENDERS = 8
LARGEST_BYTES = 1024
# Minimum interval of the warnings of invalid messages.
WARN_INTERVAL_S = 10.0
_BODY = TypeAdapter(VelocityBody)


class VelocitySenders:
    """The programs that send velocities. Stamps are CLOCK_MONOTONIC nanoseconds.

    Args:
        on_event: called with (level, text) for the operator.
    """

    def __init__(self, on_event: Callable[[str, str], None]) -> None:
        self._on_event = on_event
        self._newest: dict[str, VelocityInput] = {}
        self._delays: dict[str, SenderDelay] = {}
        self._stamps_ns: dict[str, int] = {}
        self._warned_ns: int | None = None

    def on_message(self, payload: bytes, receipt_ns: int) -> None:
        """Process a message. Its lifetime counts from when it was sent, as far as its delay is known."""
        try:
            if len(payload) > LARGEST_BYTES:
                raise ValueError(f"expected at most {LARGEST_BYTES} bytes, got {len(payload)}")
            body = _BODY.validate_json(payload, strict=True)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"])) or "message"
            self._warn(f"{where}: {first['msg']}", receipt_ns)
            return
        except ValueError as error:
            self._warn(str(error), receipt_ns)
            return
        self._forget(receipt_ns)
        source = body["source"]
        if source not in self._newest and len(self._newest) >= MAX_SENDERS:
            self._warn(f"{source}: at most {MAX_SENDERS} senders are accepted", receipt_ns)
            return
        older_ns = self._stamps_ns.get(source, body["stamp_ns"]) - body["stamp_ns"]
        if older_ns > 0:  # a newer one arrived before it, or the sender's clock was set back
            self._warn(
                f"{source}: stamp_ns is {older_ns / 1e9:.3f} s older than the newest; "
                f"a restarted sender needs a new source, or {FORGET_S:g} s",
                receipt_ns,
            )
            return
        self._stamps_ns[source] = body["stamp_ns"]
        late_ns = self._delays.setdefault(source, SenderDelay()).update(body["stamp_ns"], receipt_ns)
        lifetime_ns = round(body.get("lifetime_s", MAX_LIFETIME_S) * 1e9)
        if late_ns > lifetime_ns:
            late_s, lifetime_s = late_ns / 1e9, lifetime_ns / 1e9
            self._warn(f"{source}: {late_s:.3f} s late, its lifetime is {lifetime_s:g} s", receipt_ns)
        self._newest[source] = VelocityInput(
            source,
            receipt_ns,
            receipt_ns - late_ns + lifetime_ns,
            body.get("forward_mps", 0.0),
            body.get("right_mps", 0.0),
            body.get("up_mps", 0.0),
            body.get("turn_radps", 0.0),
        )

    def newest(self, now_ns: int) -> tuple[VelocityInput, ...]:
        """Return the newest message of each sender, expired ones included, the first sender first."""
        self._forget(now_ns)
        return tuple(self._newest.values())

    def _forget(self, now_ns: int) -> None:
        for source, message in list(self._newest.items()):
            if now_ns - message.received_ns > FORGET_S * 1e9:
                del self._newest[source], self._delays[source], self._stamps_ns[source]

    def _warn(self, problem: str, now_ns: int) -> None:
        if self._warned_ns is None or now_ns - self._warned_ns > WARN_INTERVAL_S * 1e9:
            self._warned_ns = now_ns
            self._on_event("warning", f"velocity message ignored: {problem}")
