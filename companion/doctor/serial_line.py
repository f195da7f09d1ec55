"""Checks of the serial line to the autopilot: there, permitted, and nobody else's."""

from __future__ import annotations

import re
import stat
from collections.abc import Iterator
from pathlib import Path

from companion.doctor.check import Check, fault, ok, unknown, warning
from companion.doctor.facts import CheckKind, Facts, User, group_name
from companion.doctor.processes import Program, holding_file, listed, programs
from companion.vehicle.link_url import LinkScheme, parse_link_url

# Programs that open serial devices by themselves, and read from them what the service needs.
_OPENERS = ("mavlink-routerd", "mavproxy.py", "mavproxy", "mavp2p", "gpsd", "brltty")
_MODEM_MANAGER = "ModemManager"
_GETTY = re.compile(r"a?getty")
_CANDIDATES = ("serial/by-id/*", "serial[0-9]*", "ttyACM*", "ttyUSB*", "ttyAMA*", "ttyTHS*")
_MOST_CANDIDATES = 4


def serial_device(facts: Facts) -> Path | None:
    """Return the path of `vehicle.url`'s serial device; None: the link is another one, or not valid."""
    try:
        url = parse_link_url(facts.settings.vehicle.url)
    except ValueError:
        return None
    return facts.machine.path(url.address[0]) if url.scheme is LinkScheme.SERIAL else None


def serial_devices(dev: Path) -> list[Path]:
    """Return the serial devices at which an autopilot may be, each once, by its most lasting name."""
    by_device: dict[Path, Path] = {}
    for pattern in _CANDIDATES:
        for path in sorted(dev.glob(pattern)):
            by_device.setdefault(path.resolve(), path)
    return list(by_device.values())


def permission_problem(path: Path, user: User) -> tuple[str, str] | None:
    """Return why a user may not read and write a device, and the line that mends it; None: it may."""
    status = path.stat()
    if user.uid == 0:
        return None
    shift = 6 if status.st_uid == user.uid else 3 if status.st_gid in user.groups else 0
    if status.st_mode >> shift & 0o6 == 0o6:
        return None
    group = group_name(status.st_gid)
    what = f"user {user.name} may not open {path}"
    if status.st_mode & 0o060 != 0o060:
        mode = stat.filemode(status.st_mode)
        return f"{what}: its mode is {mode}, group {group}", f"sudo chmod g+rw {path}"
    if status.st_gid in user.new_groups:
        return f"{what}: it is in the group {group} since its last login only", "log out and in again"
    return f"{what}: it belongs to the group {group}", f"sudo usermod -aG {group} {user.name}"


def possible_holders(path: Path, facts: Facts) -> list[Program]:
    """Return who has a serial device open, or may have, where descriptors of other users are not seen."""
    proc, device = facts.machine.proc, path.resolve().name
    held = holding_file(path, proc)
    if device.isdecimal():  # a pseudo-terminal: many programs have a number as an argument
        return held
    seen = {each.pid for each in held}
    for each in programs(proc):
        words = [Path(word).name for word in each.command if " " not in word]
        # A getty's argument is the device's name; another program's may be its path.
        names_it = any(device == word or word.startswith((f"{device}:", f"{device},")) for word in words)
        if each.pid not in seen and (names_it and not each.ours):
            held.append(each)
    return held


def silent_openers(path: Path, facts: Facts) -> list[Program]:
    """Return the running programs that may have it open without a trace that this user sees."""
    names = (*_OPENERS, _MODEM_MANAGER) if _is_usb(path) else _OPENERS
    return [each for each in programs(facts.machine.proc) if each.name in names]


def _is_usb(path: Path) -> bool:
    return path.resolve().name.startswith(("ttyACM", "ttyUSB"))


def _there(facts: Facts) -> Iterator[Check]:
    path = serial_device(facts)
    if path is None:
        return
    if path.exists():
        real = path.resolve()
        yield ok("serial device", str(path) if real == path else f"{path} is {real}")
        return
    if found := serial_devices(facts.machine.dev):
        here = ", ".join(map(str, found[:_MOST_CANDIDATES]))
        advice = f'set vehicle.url = "serial://{found[0]}:{facts.settings.vehicle.url.rpartition(":")[2]}"'
        yield fault("serial device", f"{path} is not there; there are {here}", advice)
        return
    yield fault(
        "serial device",
        f"{path} is not there, nor another serial device",
        "check cable and power; on a Raspberry Pi: sudo raspi-config nonint do_serial_hw 0",
    )


def _permitted(facts: Facts) -> Iterator[Check]:
    path, user = serial_device(facts), facts.machine.user
    if path is None or not path.exists():
        return
    if (problem := permission_problem(path, user)) is not None:
        yield fault("serial permission", *problem)
    else:
        yield ok("serial permission", f"user {user.name} may open {path}")


def _free(facts: Facts) -> Iterator[Check]:
    path = serial_device(facts)
    if path is None or not path.exists():
        return
    held = possible_holders(path, facts)
    for each in held:
        if each.ours and facts.service is not None:
            continue
        what = (
            "a login terminal reads it too" if _GETTY.fullmatch(each.name) else "is open in another program"
        )
        yield fault("serial line", f"{path}: {what}: {each}", each.freeing)
    if any(not each.ours or facts.service is None for each in held):
        return
    if held:
        yield ok("serial line", f"{path} is open in {listed(held)}, the service")
    else:
        yield ok("serial line", f"no other program is seen to have {path} open")


def _modem_manager(facts: Facts) -> Iterator[Check]:
    path = serial_device(facts)
    if path is None or not _is_usb(path):
        return
    for each in programs(facts.machine.proc):
        if each.name == _MODEM_MANAGER:
            found = f"{each} opens new USB serial devices and writes to them: {path} is one"
            yield warning("ModemManager", found, "sudo systemctl disable --now ModemManager")


def console_advice(name: str) -> str:
    """Return what ends the kernel's console on a serial device, and with it the login terminal there."""
    return (
        f"remove console={name} (serial0) from the kernel's command line; on a Raspberry Pi: sudo "
        "raspi-config nonint do_serial_cons 1"
    )


def _kernel_console(facts: Facts) -> Iterator[Check]:
    path = serial_device(facts)
    if path is None:
        return
    name = path.resolve().name
    if name in facts.machine.text("class", "tty", "console", "active").split():
        yield fault(
            "kernel console",
            f"the kernel prints its messages on {path}",
            console_advice(name),
        )


def _routers(facts: Facts) -> Iterator[Check]:
    path = serial_device(facts)
    if path is None or facts.service is not None:
        return
    for each in silent_openers(path, facts):
        if each.name in _OPENERS and each.pid not in {one.pid for one in possible_holders(path, facts)}:
            yield unknown(
                "serial line",
                f"{each} runs, and may have {path} open",
                "sudo companion doctor sees what other users' programs have open",
            )


def _line(facts: Facts) -> Iterator[Check]:
    yield from _free(facts)
    yield from _routers(facts)


CHECKS = (
    CheckKind("serial device", "a missing device, and which are there", _there),
    CheckKind("serial permission", "a user outside the device's group", _permitted),
    CheckKind("serial line", "another reader: getty, nvgetty, a router, another program", _line),
    CheckKind("ModemManager", "ModemManager beside a USB serial device", _modem_manager),
    CheckKind("kernel console", "the kernel's messages on the autopilot's line", _kernel_console),
)
