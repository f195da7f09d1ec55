"""Checks of the ports that the service listens on: free, or which program has them."""

from __future__ import annotations

import ipaddress
import pwd
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from companion.doctor.check import Check, fault, ok, warning
from companion.doctor.facts import CheckKind, Facts
from companion.doctor.processes import Program, holding_sockets
from companion.vehicle.link_url import LinkScheme, parse_link_url

_TCP_LISTEN = "0A"
_PAGES = ("page port", "Foxglove port", "metrics port")


@dataclass(frozen=True, slots=True)
class Socket:
    """An open socket of /proc/net/udp or tcp.

    Attributes:
        address: it is bound to; `0.0.0.0` and `::` are all.
        user: that opened it. drops: datagrams that did not fit into its buffer.
    """

    address: str
    port: int
    user: int
    inode: int
    drops: int = 0


def sockets(protocol: str, proc: Path) -> list[Socket]:
    """Return the sockets of a protocol, `udp` or `tcp`; of TCP those that listen."""
    found = []
    for name in (protocol, f"{protocol}6"):
        try:
            lines = (proc / "net" / name).read_text().splitlines()[1:]
        except OSError:
            continue
        for line in lines:
            words = line.split()
            if protocol == "tcp" and words[3] != _TCP_LISTEN:
                continue
            address, _, port = words[1].rpartition(":")
            drops = int(words[12]) if protocol == "udp" and len(words) > 12 else 0
            found.append(Socket(_address(address), int(port, 16), int(words[7]), int(words[9]), drops))
    return found


def _address(digits: str) -> str:
    # Words of 32 bits in the order of the processor: little-endian on all that we run on.
    data = bytes.fromhex(digits)
    data = b"".join(data[at : at + 4][::-1] for at in range(0, len(data), 4))
    address = ipaddress.ip_address(data)
    mapped = getattr(address, "ipv4_mapped", None)
    return str(mapped or address)


@dataclass(frozen=True, slots=True)
class _Port:
    """A port of ours: the setting that names it, protocol, host and number."""

    name: str
    setting: str
    protocol: str
    host: str
    number: int

    def taken_by(self, other: Socket) -> bool:
        """Whether this port cannot be opened beside a socket."""
        wild = ("0.0.0.0", "::", "")
        host = "127.0.0.1" if self.host == "localhost" else self.host.strip("[]")
        return self.number == other.port and (host in wild or other.address in wild or host == other.address)


def _ports(facts: Facts) -> Iterator[_Port]:
    settings = facts.settings
    try:
        url = parse_link_url(settings.vehicle.url)
    except ValueError:
        pass
    else:
        if url.scheme is LinkScheme.UDP_IN:
            yield _Port("vehicle port", "vehicle.url", "udp", *url.address)
    ours = settings.zenoh.mode == "peer" and settings.zenoh.config_file is None
    for endpoint in settings.zenoh.listen if ours else ():
        if match := re.fullmatch(r"(tcp|tls|ws|udp|quic)/(.+):(\d+)", endpoint.partition("?")[0]):
            protocol = "udp" if match[1] in ("udp", "quic") else "tcp"
            yield _Port("zenoh port", "zenoh.listen", protocol, match[2], int(match[3]))
    for name, setting, listen in (
        ("page port", "dashboard.listen", settings.dashboard.listen),
        ("Foxglove port", "foxglove.listen", settings.foxglove.listen),
        ("metrics port", "metrics.listen", settings.metrics.listen),
    ):
        if listen:
            host, _, number = listen.rpartition(":")
            yield _Port(name, setting, "tcp", host, int(number))


def _free(facts: Facts, names: Collection[str]) -> Iterator[Check]:
    for port in _ports(facts):
        if port.name in names:
            yield from _check_port(port, facts)


def is_free(facts: Facts, name: str) -> bool:
    """Whether no socket is bound where a port of this name would be."""
    return not any(
        port.taken_by(each)
        for port in _ports(facts)
        if port.name == name
        for each in sockets(port.protocol, facts.machine.proc)
    )


def held_by(facts: Facts, name: str) -> list[Program]:
    """Return the programs with a socket where a port of this name would be, of other users for root only."""
    taken = [
        each.inode
        for port in _ports(facts)
        if port.name == name
        for each in sockets(port.protocol, facts.machine.proc)
        if port.taken_by(each)
    ]
    return holding_sockets(taken, facts.machine.proc)


def _check_port(port: _Port, facts: Facts) -> Iterator[Check]:
    proc = facts.machine.proc
    taken = [each for each in sockets(port.protocol, proc) if port.taken_by(each)]
    where = f"{port.protocol.upper()} port {port.number}"
    if not taken:
        if facts.service is None:
            yield ok(port.name, f"{where} is free")
        else:
            yield warning(port.name, f"{where}: the service does not listen there", "journalctl -u companion")
        return
    holders = holding_sockets([each.inode for each in taken], proc)
    if facts.service is not None and (not holders or all(each.ours for each in holders)):
        yield ok(port.name, f"{where} is the service's")
    elif holders:
        for each in holders:
            if not each.ours or facts.service is None:
                yield fault(port.name, f"{where} is taken by {_whose(each)}", _advice(port, each))
    else:
        names = sorted({_user_name(each.user) for each in taken})
        found = f"{where} is taken by a program of user {', '.join(names)}"
        yield fault(port.name, found, f"sudo ss -{port.protocol[0]}lnp 'sport = :{port.number}' names it")


def _whose(holder: Program) -> str:
    return f"{holder}, another service or one that hangs" if holder.ours else str(holder)


def _advice(port: _Port, holder: Program) -> str:
    if holder.ours:  # it may fly another vehicle
        return f"another port in {port.setting}; or on the ground: {holder.freeing}"
    return f"{holder.freeing}, or another port in {port.setting}"


def _user_name(uid: int) -> str:
    try:
        return pwd.getpwuid(uid).pw_name
    except KeyError:
        return str(uid)


def _drops(facts: Facts) -> Iterator[Check]:
    for port in _ports(facts):
        if port.name == "vehicle port":
            drops = sum(each.drops for each in sockets("udp", facts.machine.proc) if port.taken_by(each))
            if drops:
                yield warning(
                    "UDP buffer",
                    f"{drops} datagrams of the vehicle did not fit into the socket's buffer",
                    "sudo sysctl net.core.rmem_default=1048576, and restart the service",
                )


VEHICLE_PORT = CheckKind(
    "vehicle port",
    "the UDP port of `vehicle.url` taken, and by which program",
    partial(_free, names=("vehicle port",)),
)
CHECKS = (
    VEHICLE_PORT,
    CheckKind("zenoh port", "the same of `zenoh.listen`", partial(_free, names=("zenoh port",))),
    CheckKind(
        "page port", "the same of `dashboard.listen`, Foxglove and metrics", partial(_free, names=_PAGES)
    ),
    CheckKind("UDP buffer", "datagrams that the kernel dropped", _drops),
)
