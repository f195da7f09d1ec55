"""Check of the autopilot's serial ports, by its parameters, which a running service reads on the ground."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

from companion.doctor.check import Check, ok, unknown, warning
from companion.doctor.facts import CheckKind, Facts
from companion.vehicle.link_url import LinkScheme, parse_link_url
from companion.vehicle.port_parameters import (
    ARDUPILOT_MAVLINK,
    ARDUPILOT_PORTS,
    PX4_INSTANCES,
    PX4_ONBOARD,
    PX4_PORTS,
    ardupilot_baud,
)

NAME = "autopilot port"
_MODES = {0: "Normal", 1: "Custom", PX4_ONBOARD: "Onboard", 7: "Minimal", 11: "Onboard Low Bandwidth"}


class _Port(NamedTuple):
    """A serial port with MAVLink. `problem` and `advice`: why a companion should not use it as it is."""

    text: str
    baud: int
    problem: str = ""
    advice: str = ""


def _ports(facts: Facts) -> Iterator[Check]:
    if facts.service is None or (body := facts.service.ports) is None:
        return
    if body["not_read"]:
        yield unknown(NAME, f"its parameters are not read: {body['not_read']}")
        return
    parameters = body["parameters"]
    ports = [*_px4(parameters), *_ardupilot(parameters)]
    baud = _serial_baud(facts)
    # Which port the cable is at is not known: those with the baud rate of our line.
    ours = [port for port in ports if port.baud == baud]
    if len(ours) == 1 and ours[0].problem:
        yield warning(NAME, f"{ours[0].text}: {ours[0].problem}", ours[0].advice)
    elif ports:
        yield ok(NAME, "; ".join(port.text for port in ports))


def _serial_baud(facts: Facts) -> int | None:
    try:
        url = parse_link_url(facts.settings.vehicle.url)
    except ValueError:
        return None
    return int(url.address[1]) if url.scheme is LinkScheme.SERIAL else None


def _px4(parameters: Mapping[str, float]) -> Iterator[_Port]:
    for number in PX4_INSTANCES:
        port = PX4_PORTS.get(round(parameters.get(f"MAV_{number}_CONFIG", 0)))
        if port is None or (value := parameters.get(f"SER_{port}_BAUD")) is None:
            continue
        baud, mode = round(value), round(parameters.get(f"MAV_{number}_MODE", PX4_ONBOARD))
        forwards = "forwards" if parameters.get(f"MAV_{number}_FORWARD") else "does not forward"
        rate = round(parameters.get(f"MAV_{number}_RATE", 0))
        limit = f", at most {rate} B/s" if rate else ""
        text = f"MAV_{number} at {port}: {_MODES.get(mode, f'mode {mode}')}, {baud} baud{limit}, {forwards}"
        if mode == PX4_ONBOARD:
            yield _Port(text, baud)
        else:
            advice = f"MAV_{number}_MODE {PX4_ONBOARD} (Onboard), and restart the autopilot"
            yield _Port(text, baud, "a mode without the streams of a companion", advice)


def _ardupilot(parameters: Mapping[str, float]) -> Iterator[_Port]:
    for number in ARDUPILOT_PORTS:
        protocol = round(parameters.get(f"SERIAL{number}_PROTOCOL", 0))
        if protocol not in ARDUPILOT_MAVLINK or (value := parameters.get(f"SERIAL{number}_BAUD")) is None:
            continue
        baud = ardupilot_baud(value)
        text = f"SERIAL{number}: {ARDUPILOT_MAVLINK[protocol]}, {baud} baud"
        if protocol == 1:
            yield _Port(text, baud, "MAVLink 1", f"SERIAL{number}_PROTOCOL 2, and restart the autopilot")
        else:
            yield _Port(text, baud)


CHECKS = (
    CheckKind(
        NAME,
        "a port without the streams of a companion (`MAV_x_MODE`), or with MAVLink 1 (`SERIALx_PROTOCOL`)",
        _ports,
    ),
)
