"""Why a driver is not connected or not answered, in one line for the person who set it up."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from companion.vehicle.autopilot_profile import ARDUPILOT
from companion.vehicle.link_url import LinkScheme, LinkUrl
from companion.vehicle.signing import FrameSigner

_AUTOPILOT_NAMES = {0: "a generic autopilot", 3: "ArduPilot"}


def why_no_autopilot(
    url: LinkUrl,
    timeout_s: float,
    *,
    wanted_system_id: int | None,
    others: Iterable[tuple[Any, ...]],
    signer: FrameSigner | None,
    skipped_bytes: int,
) -> str:
    """No heartbeat of an autopilot came within `timeout_s`; what did come tells the likely reason.

    Args:
        others: who else was heard: system, component, and what more is known of each.
        signer: what checks signatures, if any. skipped_bytes: that were no MAVLink.
    """
    which = "autopilot" if wanted_system_id is None else f"autopilot of system {wanted_system_id}"
    heard = ", ".join(f"{sender[0]}/{sender[1]}" for sender in sorted(others))
    if heard:
        advice = f"heard only system/component {heard}; check the system id and what is connected"
    elif signer is not None and signer.refused:
        reasons = ", ".join(f"{count} {reason}" for reason, count in signer.refused.items())
        advice = f"its frames were refused by signing ({reasons}); check that both ends have the same key"
    elif skipped_bytes:
        advice = f"{skipped_bytes} bytes came that are not MAVLink; check the baud rate and what is connected"
    elif url.scheme is LinkScheme.UDP_IN:
        advice = "nothing came at all; check that the vehicle is on and sends to this address and port"
    else:
        advice = "nothing came at all; check that the vehicle is on, and the address or device"
    return f"no {which} answered on {url} within {timeout_s:g} s: {advice}"


def why_no_answer(*, signs: bool, has_key: bool, only_heartbeats: bool) -> str:
    """What may be behind an autopilot that is heard and does not answer; empty where nothing tells.

    Args:
        signs: its messages are signed. has_key: ours are. only_heartbeats: nothing else of it has come.
    """
    if signs and not has_key:
        return (
            "the autopilot signs its messages and may ignore unsigned ones: "
            "set vehicle.signing_key_file to a file with its key"
        )
    if not only_heartbeats:
        return ""
    if has_key:
        return "nothing but heartbeats comes from the autopilot: check that it hears this link"
    return (
        "nothing but heartbeats comes from the autopilot: check that it hears this link, and whether it "
        "wants signed messages (vehicle.signing_key_file)"
    )


def unsupported_autopilot(url: LinkUrl, system_id: int | None, kind: int | None) -> str:
    """An autopilot of a kind (MAV_AUTOPILOT) that this driver does not fly."""
    name = _AUTOPILOT_NAMES.get(kind or 0, f"MAV_AUTOPILOT {kind}")
    if kind == ARDUPILOT:
        return (
            f"{url}: the mavsdk driver flies PX4 alone, and system {system_id} is {name}; "
            'set vehicle.driver = "pymavlink" or "auto"'
        )
    return f"{url}: only PX4 and ArduPilot are flown, and system {system_id} is {name}"
