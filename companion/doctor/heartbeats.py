"""Checks of the vehicle's link without a service: whose heartbeats arrive, and whether they can be used."""

from __future__ import annotations

from collections.abc import Iterator

from companion.doctor.check import Check, fault, ok, unknown, warning
from companion.doctor.facts import CheckKind, Facts
from companion.doctor.listening import Address, Sender
from companion.vehicle.connection_advice import no_autopilot_text
from companion.vehicle.link_url import parse_link_url
from companion.vehicle.vehicle_type import (
    AUTOPILOT_NAMES,
    MULTICOPTERS,
    VTOLS,
    autopilot_text,
    type_text,
)

NAME = "heartbeats"
_LEAST_RATE_HZ = 0.5


def _heartbeats(facts: Facts) -> Iterator[Check]:
    if facts.service is not None or not facts.settings.vehicle.expected:
        return
    received = facts.received
    if received is None:
        yield unknown(NAME, f"not listened to: {facts.not_received}")
        return
    if received.problem:
        yield fault(NAME, received.problem, "correct vehicle.url, or start what it names")
        return
    wanted = facts.settings.vehicle.system_id
    autopilots = {
        address: sender
        for address, sender in received.senders.items()
        if address[0] == wanted and sender.is_autopilot
    }
    if not autopilots:
        text = no_autopilot_text(
            parse_link_url(facts.settings.vehicle.url),
            None,
            wanted_system_id=wanted,
            others=received.senders,
            signer=None,
            skipped_bytes=received.skipped_bytes,
        )
        yield fault(NAME, text, _advice(facts, wanted))
        return
    for address, sender in autopilots.items():
        yield from _autopilot(address, sender, facts)
    if len(autopilots) > 1 or any(len(sender.sources) > 1 for sender in autopilots.values()):
        sources = sorted({source for sender in autopilots.values() for source in sender.sources})
        found = f"several autopilots have system id {wanted}: {', '.join(sources) or 'on one line'}"
        yield fault(NAME, found, "give each its own MAV_SYS_ID (PX4) or MAV_SYSID, SYSID_THISMAV (ArduPilot)")


def _autopilot(address: Address, sender: Sender, facts: Facts) -> Iterator[Check]:
    received = facts.received
    assert received is not None
    rate_hz = sender.heartbeats / received.seconds if received.seconds else 0.0
    signed = "signed" if sender.signed else "without a signing key"
    text = (
        f"system {address[0]}, component {address[1]}: {type_text(sender.mav_type)} of "
        f"{autopilot_text(sender.autopilot)}, {rate_hz:.1f} a second, {signed}"
    )
    has_key = facts.settings.vehicle.signing_key_file is not None
    if sender.autopilot not in AUTOPILOT_NAMES or sender.mav_type not in MULTICOPTERS | VTOLS:
        yield fault(NAME, f"{text}: gets no flight commands", "docs/safety.md, Which vehicles are flown")
    elif sender.signed and not has_key:
        yield warning(NAME, text, "set vehicle.signing_key_file to a file with its key")
    elif has_key and not sender.signed:
        yield fault(NAME, f"{text}: vehicle.signing_key_file refuses them", "companion signing send")
    elif rate_hz < _LEAST_RATE_HZ:
        yield warning(NAME, text, "a second reader of the line, or a link that loses data")
    elif received.skipped_bytes:
        yield warning(
            NAME,
            f"{text}; {received.skipped_bytes} bytes between them are not MAVLink",
            "check the baud rate, the wiring, and who else sends to this port",
        )
    else:
        yield ok(NAME, text)


def _advice(facts: Facts, wanted: int) -> str:
    received = facts.received
    assert received is not None
    systems = sorted({address[0] for address, sender in received.senders.items() if sender.is_autopilot})
    if systems:
        return f"set vehicle.system_id = {systems[0]}, not {wanted}"
    if facts.settings.vehicle.url.startswith("serial"):
        return "PX4: MAV_1_CONFIG 102 (TELEM2), SER_TEL2_BAUD; ArduPilot: SERIAL2_PROTOCOL 2, SERIAL2_BAUD"
    return "mavlink-sim is a simulated vehicle, docs/how-to/sitl.md has autopilots"


CHECKS = (
    CheckKind(
        NAME,
        "without a service: nothing received, another system id, several autopilots, a wrong baud rate, "
        "a signature without a key",
        _heartbeats,
    ),
)
