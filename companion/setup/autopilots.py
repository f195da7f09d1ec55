"""Looks for autopilots on serial lines and network ports. It listens: nothing is sent.

A serial device is opened only if `companion doctor` finds nobody who has it open, and its user may. All
places are listened to at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from companion.doctor import ports, serial_line
from companion.doctor.check import Verdict
from companion.doctor.examine import in_parallel
from companion.doctor.facts import Facts, checks_of
from companion.doctor.listening import Address, Received, Sender, listen
from companion.setup.tried import Report, Tried
from companion.vehicle.link_url import LinkScheme, LinkUrl, parse_link_url
from companion.vehicle.vehicle_type import (
    AUTOPILOT_NAMES,
    MULTICOPTERS,
    VTOLS,
    autopilot_text,
    type_text,
)

BAUDS = (921600, 115200, 57600, 460800, 230400, 500000, 1500000)
"""Of serial lines, in the order in which they are tried: PX4's TELEM2, then common ones."""
# USB has no baud rate: the number has no effect.
_USB_BAUD = 115200
# PX4 sends to a companion computer at 14540, and to a ground station, as ArduPilot does, at 14550.
UDP_PORTS = (14540, 14550)
# ArduPilot's SITL, and a MAVLink router; only where something listens.
TCP_PORTS = (5760, 5762, 5763)
MOST_S = 20.0
# Heartbeats come once a second.
_BAUD_S, _PORT_S = 1.3, 2.2
# So many bytes without a heartbeat are those of another baud rate.
_NOISE_BYTES = 400

Listen = Callable[[LinkUrl, float, Callable[[Received], bool] | None], Received]


@dataclass(frozen=True, slots=True)
class Autopilot:
    """An autopilot on a link.

    Attributes:
        url: that of the service. address: system and component id.
    """

    url: LinkUrl
    address: Address
    sender: Sender

    @property
    def is_flown(self) -> bool:
        """Whether it is of a firmware and of a vehicle type that get flight commands."""
        return self.sender.autopilot in AUTOPILOT_NAMES and self.sender.mav_type in MULTICOPTERS | VTOLS

    def __str__(self) -> str:
        notes = "" if self.is_flown else ", which gets no flight commands"
        signed = ", signed: set vehicle.signing_key_file" if self.sender.signed else ""
        return (
            f"{type_text(self.sender.mav_type)} of {autopilot_text(self.sender.autopilot)}, "
            f"system {self.address[0]}{notes}{signed}"
        )


def find_autopilots(
    facts: Facts,
    report: Report,
    *,
    present: LinkUrl | None = None,
    devices: Iterable[Path] = (),
    listen: Listen = listen,
) -> list[Autopilot]:
    """Listen everywhere at once, for at most `MOST_S`.

    Args:
        present: what a settings file has now; it is listened to as well.
        devices: serial devices that are looked at too.

    Returns:
        Autopilots, the surest first: at `present`; one that is flown; on a serial line, on USB, on the
        network. One that is received at several network ports is there once.
    """
    found: dict[str, list[Autopilot]] = {}
    late: dict[str, bool] = {}
    calls: list[Callable[[], None]] = []

    def look(where: str, search: Callable[[], tuple[list[Autopilot], Tried]]) -> None:
        autopilots, tried = search()
        if late.pop(where, False):
            found[where] = autopilots
            report(tried)

    for where, search in _searches(facts, present, devices, listen):
        late[where] = True
        calls.append(partial(look, where, search))
    in_parallel(calls, MOST_S)
    for where in list(late):
        if late.pop(where, False):
            report(Tried(where, f"no end within {MOST_S:g} s"))
    wanted = facts.settings.vehicle.system_id
    every = sorted(
        (each for some in list(found.values()) for each in some), key=partial(_order, present, wanted)
    )
    return list(_once(every))


def _searches(
    facts: Facts,
    present: LinkUrl | None,
    devices: Iterable[Path],
    listen: Listen,
) -> Iterator[tuple[str, Callable[[], tuple[list[Autopilot], Tried]]]]:
    """Yield where an autopilot may be, and the function that looks there."""
    own = present if present is not None and present.scheme is LinkScheme.SERIAL else None
    named = [facts.machine.path(str(each)) for each in devices]
    if own is not None:
        named.insert(0, facts.machine.path(own.address[0]))
    serial: dict[Path, Path] = {}
    for path in (*named, *serial_line.serial_devices(facts.machine.dev)):
        serial.setdefault(path.resolve(), path)
    for path in serial.values():
        first = None
        if own is not None and facts.machine.path(own.address[0]).resolve() == path.resolve():
            first = own.address[1]
        yield str(path), partial(_on_serial, path, first, facts, listen)
    udp, tcp = dict.fromkeys(UDP_PORTS, "0.0.0.0"), dict[tuple[str, int], None]()
    if present is not None and present.scheme is LinkScheme.UDP_IN:
        host, port = present.address
        udp.setdefault(port, "0.0.0.0" if host in ("127.0.0.1", "localhost") else host)
    for port, host in udp.items():
        url = LinkUrl(LinkScheme.UDP_IN, (host, port))
        yield f"UDP port {port}", partial(_on_udp, url, present, facts, listen)
    if present is not None and present.scheme is LinkScheme.TCP:
        tcp[present.address] = None
    listening = {each.port for each in ports.sockets("tcp", facts.machine.proc)}
    tcp |= {("127.0.0.1", port): None for port in TCP_PORTS if port in listening}
    for host, port in tcp:
        yield f"TCP {host}:{port}", partial(_on_tcp, LinkUrl(LinkScheme.TCP, (host, port)), listen)


def _on_serial(path: Path, first: int | None, facts: Facts, listen: Listen) -> tuple[list[Autopilot], Tried]:
    where = str(path)
    if not path.exists():
        return [], Tried(where, "no such device", "check cable and power")
    name = path
    if path.is_relative_to(facts.machine.dev):
        name = Path("/dev") / path.relative_to(facts.machine.dev)
    is_usb = path.resolve().name.startswith("ttyACM")
    bauds = [each for each in (first, *((_USB_BAUD,) if is_usb else BAUDS)) if each is not None]
    if (refused := _not_opened(where, LinkUrl(LinkScheme.SERIAL, (str(name), bauds[0])), facts)) is not None:
        return [], refused
    noisy: list[int] = []  # the others were silent
    for baud in dict.fromkeys(bauds):
        url = LinkUrl(LinkScheme.SERIAL, (str(path), baud))
        received = listen(url, _PORT_S if is_usb else _BAUD_S, _is_noise)
        if received.problem:
            return [], Tried(where, received.problem)
        if received.senders:
            at = "" if is_usb else f" at {baud} baud"
            return _received_at(where, replace(url, address=(str(name), baud)), received, at)
        if received.skipped_bytes:
            noisy.append(baud)
    if noisy:
        return [], Tried(
            where,
            f"bytes that are not MAVLink at {', '.join(map(str, noisy))} baud",
            "PX4: MAV_1_CONFIG and SER_TEL2_BAUD, ArduPilot: SERIAL2_PROTOCOL 2 and SERIAL2_BAUD; or another "
            "device is connected here",
        )
    return [], Tried(
        where,
        "silent" if is_usb else f"silent at {', '.join(map(str, bauds))} baud",
        "check power, and RX to TX; PX4: MAV_1_CONFIG 102 (TELEM2), ArduPilot: SERIAL2_PROTOCOL 2",
    )


def _is_noise(received: Received) -> bool:
    return not received.senders and received.skipped_bytes > max(_NOISE_BYTES, 20 * received.frames)


def _on_udp(
    url: LinkUrl, present: LinkUrl | None, facts: Facts, listen: Listen
) -> tuple[list[Autopilot], Tried]:
    port = url.address[1]
    where = f"UDP port {port}"
    if (refused := _not_opened(where, url, facts)) is not None:
        return [], refused
    received = listen(url, _PORT_S, None)
    if present is not None and present.scheme is LinkScheme.UDP_IN and present.address[1] == port:
        kept = present
    else:
        sources = {source for sender in received.senders.values() for source in sender.sources}
        here = all(source.startswith("127.") for source in sources)
        kept = LinkUrl(LinkScheme.UDP_IN, ("127.0.0.1" if here else "0.0.0.0", port))
    return _received_at(where, kept, received, "")


def _on_tcp(url: LinkUrl, listen: Listen) -> tuple[list[Autopilot], Tried]:
    received = listen(url, _PORT_S, None)
    return _received_at(f"TCP {url.address[0]}:{url.address[1]}", url, received, "")


def _received_at(where: str, url: LinkUrl, received: Received, at: str) -> tuple[list[Autopilot], Tried]:
    """Return the autopilots of what was received, and the result for people."""
    if received.problem:
        return [], Tried(where, received.problem)
    found = [
        Autopilot(url, address, sender)
        for address, sender in sorted(received.senders.items())
        if sender.is_autopilot
    ]
    if found:
        return found, Tried(where, "; ".join(map(str, found)) + at)
    if received.senders:
        others = ", ".join(f"{system}/{component}" for system, component in sorted(received.senders))
        text = f"MAVLink{at} of system/component {others}, no autopilot"
        return [], Tried(where, text)
    return [], Tried(where, "bytes that are not MAVLink" if received.skipped_bytes else "silent")


def _not_opened(where: str, url: LinkUrl, facts: Facts) -> Tried | None:
    """Return why a link is not opened, as doctor says it; None: it may be."""
    vehicle = facts.settings.vehicle.model_copy(update={"url": str(url)})
    settings = facts.settings.model_copy(update={"vehicle": vehicle})
    for check in checks_of(replace(facts, settings=settings), (*serial_line.CHECKS, ports.VEHICLE_PORT)):
        if check.verdict in (Verdict.FAULT, Verdict.UNKNOWN):
            return Tried(where, f"not opened: {check.found.removeprefix(f'{where}: ')}", check.advice)
    return None


def _order(present: LinkUrl | None, system_id: int, autopilot: Autopilot) -> tuple[object, ...]:
    scheme, (name, number) = autopilot.url.scheme, autopilot.url.address
    usb = "usb" in name.lower() or "ttyACM" in name
    kind = (2 if usb else 1) if scheme is LinkScheme.SERIAL else 3 if scheme is LinkScheme.UDP_IN else 4
    return (
        autopilot.url != present,
        not autopilot.is_flown,
        kind,
        number if kind > 2 else 0,
        name,
        autopilot.address[0] != system_id,
        autopilot.address,
    )


def _once(autopilots: Iterable[Autopilot]) -> Iterator[Autopilot]:
    """Leave out what is received at another network port too."""
    seen = set()
    for each in autopilots:
        if each.url.scheme is not LinkScheme.SERIAL:
            if each.address in seen:
                continue
            seen.add(each.address)
        yield each


def url_of(text: str) -> LinkUrl | None:
    """Return a link's address; None: it is not valid, or there is to be no vehicle."""
    try:
        url = parse_link_url(text)
    except ValueError:
        return None
    return None if url.scheme is LinkScheme.NONE else url
