"""Creates the driver of a given kind."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Literal, get_args

from companion.vehicle.driver import Driver, OnBytes
from companion.vehicle.link_url import parse_link_url
from companion.vehicle.signing import FrameSigner

if TYPE_CHECKING:
    from companion.vehicle.autopilot_driver import AutopilotDriver

DriverKind = Literal["pymavlink", "mavsdk", "auto"]


def open_driver(
    kind: DriverKind,
    url: str,
    *,
    system_id: int | None = None,
    own_system_id: int = 1,
    own_component_id: int = 191,
    other_component_ids: Sequence[int] = (),
    signer: FrameSigner | None = None,
    range_finder_height: bool = False,
    on_bytes: OnBytes | None = None,
) -> Driver:
    """Create a driver, not connected yet.

    Args:
        kind: the MAVLink library. Both have the same contract; "mavsdk" supports PX4 only, so "auto", which
            fits every supported autopilot, is "pymavlink".
        url: `udpin://HOST:PORT`, `udpout://HOST:PORT`, `tcp://HOST:PORT` or `serial:///dev/X:BAUD`.
        system_id: the autopilot's MAVLink system id; None: the first autopilot received.
        own_system_id, own_component_id: of our messages; 191 is MAV_COMP_ID_ONBOARD_COMPUTER.
        other_component_ids: used instead where another program has our component id. With any, `connect`
            waits for other programs' heartbeats, for up to 2 s after the link has opened.
        signer: of MAVLink 2 signing; None: nothing is signed and everything is accepted.
        range_finder_height: as in `VehicleState`.
        on_bytes: called in the loop with everything received and sent.

    Raises:
        LinkUrlError: the url has none of these forms (a ValueError and a LinkError).
        ValueError: unknown kind, or an id outside 1..255.
    """
    if kind not in get_args(DriverKind):
        raise ValueError(f"unknown driver {kind!r}; expected one of {', '.join(get_args(DriverKind))}")
    for name, number in (("system_id", system_id), ("own_system_id", own_system_id)):
        if number is not None and not 1 <= number <= 255:
            raise ValueError(f"{name} must be 1..255, got {number}")
    for number in (own_component_id, *other_component_ids):
        if not 1 <= number <= 255:
            raise ValueError(f"own_component_id must be 1..255, got {number}")
    link_url = parse_link_url(url)

    # Imported here: each library is slow to load, and one of them is enough.
    driver_class: type[AutopilotDriver]
    if kind == "mavsdk":
        from companion.vehicle.mavsdk_driver import MavsdkDriver

        driver_class = MavsdkDriver
    else:
        from companion.vehicle.pymavlink_driver import PymavlinkDriver

        driver_class = PymavlinkDriver
    return driver_class(
        link_url,
        system_id=system_id,
        own_system_id=own_system_id,
        own_component_id=own_component_id,
        other_component_ids=other_component_ids,
        signer=signer,
        range_finder_height=range_finder_height,
        on_bytes=on_bytes,
    )
