"""One-line explanations of a failed connection or a missing answer, for the person who set it up."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from companion.vehicle.link_url import LinkScheme, LinkUrl
from companion.vehicle.signing import FrameSigner
from companion.vehicle.vehicle_type import ARDUPILOT

_UDP = (LinkScheme.UDP_IN, LinkScheme.UDP_OUT)
_ANSWERS_S = 3.0  # it is asked for the time twice a second
_AUTOPILOT_NAMES = {0: "a generic autopilot", 3: "ArduPilot"}


def no_autopilot_text(
    url: LinkUrl,
    timeout_s: float | None,
    *,
    wanted_system_id: int | None,
    others: Iterable[tuple[Any, ...]],
    signer: FrameSigner | None,
    skipped_bytes: int,
) -> str:
    """Explain a missing autopilot heartbeat by what was received instead.

    Args:
        timeout_s: None: it is still waited for. The text then changes only with the reason.
        others: other senders: system id, component id, further fields.
        signer: checks signatures, if any. skipped_bytes: received bytes that are not MAVLink.
    """
    origin = "" if wanted_system_id is None else f" from system {wanted_system_id}"
    senders = ", ".join(f"{sender[0]}/{sender[1]}" for sender in sorted(others))
    if senders:
        advice = f"received only system/component {senders}; check the system id and what is connected"
    elif signer is not None and signer.refused:
        reasons = ", ".join(
            reason if timeout_s is None else f"{count} {reason}" for reason, count in signer.refused.items()
        )
        advice = f"its frames failed the signature check ({reasons}); both ends need the same key"
    elif skipped_bytes:
        count = "" if timeout_s is None else f"{skipped_bytes} "
        check = "what sends to this port" if url.scheme in _UDP else "the baud rate and the device"
        advice = f"received {count}bytes that are not MAVLink; check {check}"
    elif url.scheme is LinkScheme.UDP_IN:
        advice = "nothing received; check that the vehicle is on and sends to this address and port"
    else:
        advice = "nothing received; check that the vehicle is on, and the address or device"
    within = "" if timeout_s is None else f" within {timeout_s:g} s"
    return f"no autopilot heartbeat{origin} on {url}{within}: {advice}"


def no_answer_advice(
    *, signs: bool, has_key: bool, only_heartbeats: bool, answered_ago_s: float | None
) -> str:
    """Explain a missing answer of a connected autopilot; empty if nothing hints at the reason.

    An autopilot that requires signatures makes them too, with a key of its own: one that does not is not
    suspected of it.

    Args:
        signs: its messages are signed with a key; PX4's key of zeros is none. has_key: ours are signed.
        only_heartbeats: nothing but heartbeats was received.
        answered_ago_s: age of the newest time request of ours that it has answered, since it signs as it
            does; None: it has answered none.
    """
    if answered_ago_s is not None:
        if answered_ago_s < _ANSWERS_S:
            return ""
        return (
            f"it still sends, and its newest answer is {answered_ago_s:.0f} s old: check what is between, "
            "such as a MAVLink router that was restarted or has lost this port, and the wire to the autopilot"
        )
    if signs and not has_key:
        return (
            "the autopilot signs its messages and may ignore unsigned ones: "
            "set vehicle.signing_key_file to a file with its key"
        )
    if only_heartbeats:
        return "only heartbeats received from the autopilot: check that it receives on this link"
    return (
        "it sends, and has answered nothing on this link: check that it receives here, and that no MAVLink "
        "router takes this address for another's: restart the router"
    )


def unsupported_autopilot(url: LinkUrl, system_id: int | None, kind: int | None) -> str:
    """Explain that a driver does not support an autopilot (`kind`: MAV_AUTOPILOT)."""
    name = _AUTOPILOT_NAMES.get(kind or 0, f"MAV_AUTOPILOT {kind}")
    if kind == ARDUPILOT:
        return (
            f"{url}: the mavsdk driver supports PX4 only, system {system_id} is {name}; "
            'set vehicle.driver = "pymavlink"'
        )
    return f"{url}: only PX4 and ArduPilot are supported, system {system_id} is {name}"
