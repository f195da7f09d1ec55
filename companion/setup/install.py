"""Installs the service of systemd, and moves an installation to another version."""

from __future__ import annotations

import os
import shlex
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path

from companion.doctor.facts import group_name, user_of_service
from companion.doctor.serial_line import console_advice
from companion.settings import Settings
from companion.settings.layers import SYSTEM_FILE, user_file
from companion.settings.reading import ConfigurationError
from companion.setup.files import (
    CURRENT,
    INSTALLATIONS,
    SYSUSERS,
    TMPFILES,
    UNIT,
    Entry,
    Link,
    below,
    system_entries,
    user_entries,
)
from companion.setup.flight import check_not_flying, settings_of_unit
from companion.setup.startup import starts_at_boot, wait_until_up
from companion.setup.systemctl import UP_OR_STARTING, Host, SetupError, as_root
from companion.vehicle.link_url import LinkScheme, parse_link_url

GROUPS = ("dialout", "video")
# The unit hides home folders from the service: ProtectHome=.
_HIDDEN = (Path("/home"), Path("/root"), Path("/run/user"))
_CONSOLE = Path("/sys/class/tty/console/active")

Say = Callable[[str], None]


def install(host: Host, say: Say, *, dry_run: bool = False, force: bool = False) -> bool:
    """Install the service from the environment that runs this, and start it; of an older one, replace it.

    Args:
        say: prints a line. dry_run: print what would be done, and change nothing.
        force: also while the vehicle is armed.

    Returns:
        Whether the service is up; what it waits for, or why it is not, was printed.

    Raises:
        SetupError: it cannot be installed from here, now, or by this user.
    """
    environment = Path(sys.prefix).resolve()
    if host.user:
        entries: tuple[Entry, ...] = user_entries()
    else:
        _check_place(environment, Path(sys.executable).resolve())
        entries = system_entries(environment, host.root)
    if not dry_run:
        _check_possible(host)
        if not force:
            check_not_flying(host)
    settings = _settings(host, say)
    changed = [entry for entry in entries if not entry.is_there()]
    is_new = entries[0].found() is None
    for entry in entries:
        _say_entry(entry, say, whole=dry_run)
    instances = [] if host.user else host.instances()
    states = {} if dry_run and not instances else {unit: host.show(unit) for unit in (UNIT, *instances)}
    # Who runs instances alone has disabled the first one.
    starts = not instances or states[UNIT].get("UnitFileState") == "enabled"
    own = [UNIT] if starts else []
    running = [unit for unit in instances if states[unit].get("ActiveState") in UP_OR_STARTING]
    # After an installation that was interrupted nothing is changed, and the process is the former one.
    restarted = [unit for unit in (*own, *running) if changed or _is_outdated(states.get(unit, {}), entries)]
    began_s = time.time()

    def do(commands: Iterable[tuple[str, ...]]) -> None:
        for command in commands:
            say(f"run        {shlex.join(command)}")
            if not dry_run:
                host.run(command)

    def write(written: Iterable[Entry]) -> None:
        for entry in () if dry_run else written:
            entry.write()

    of_service = [entry for entry in changed if isinstance(entry, Link) or entry.path.suffix == ".service"]
    write(entry for entry in changed if entry not in of_service)
    do([*_preparing(host), *_freeing(host, settings, say)])
    enabling = [host.systemctl("enable", unit) for unit in own]
    if not is_new:
        do(enabling)
    if restarted and not dry_run and not force:
        _check_again(host, restarted, of_service)
    write(of_service)
    if of_service or any(state.get("NeedDaemonReload") == "yes" for state in states.values()):
        do([host.systemctl("daemon-reload")])
    if is_new:  # it could not be enabled before; no process of it is stopped
        do(enabling)
    do(_starting(host, own, restarted))
    if host.user:
        for line in _advice_of_user(host):
            say(line)
    if dry_run:
        say("nothing was changed: --dry-run")
        return True
    up = True
    for unit in (*own, *(unit for unit in restarted if unit not in own)):
        replaced = states[unit].get("InvocationID") if unit in restarted else None
        up = wait_until_up(host, unit, _settings_of(host, unit), say, replaced, began_s) and up
    return up


def _is_outdated(state: Mapping[str, str], entries: Iterable[Entry]) -> bool:
    """Whether a unit's process is older than the files, which are all there, or its loaded unit is.

    There is no tolerance: a process starts within a second after its files were written, and the next
    `install` is not to restart it.
    """
    started_us = int(state.get("ExecMainStartTimestampMonotonic") or 0)  # of CLOCK_MONOTONIC
    if state.get("ActiveState") not in UP_OR_STARTING or not started_us:
        return False
    started_s = started_us / 1e6 + time.time() - time.monotonic()
    written_s = max(entry.path.lstat().st_mtime for entry in entries)
    return state.get("NeedDaemonReload") == "yes" or written_s > started_s


def _check_again(host: Host, restarted: Sequence[str], unwritten: Sequence[Entry]) -> None:
    """Raise SetupError if a vehicle was armed in the seconds since the first check."""
    try:
        check_not_flying(host)
    except SetupError as error:
        left = [str(entry.path) for entry in unwritten]
        changed = f"not changed: {', '.join(left)}; " if left else ""
        raise SetupError(f"{error}\n{changed}not restarted: {', '.join(restarted)}") from error


def _settings_of(host: Host, unit: str) -> Settings | None:
    try:
        return settings_of_unit(host, unit)
    except (ConfigurationError, OSError):
        return None


def _check_place(environment: Path, python: Path) -> None:
    """Raise SetupError if a service of the system cannot run from this environment."""
    here = f"{INSTALLATIONS}/{version('mavlink-companion')}"
    how = (
        f"sudo /usr/bin/python3 -m venv {here}\nsudo {here}/bin/pip install mavlink-companion\n"
        f"sudo {here}/bin/companion install\nor, for this user alone: companion install --user"
    )
    # /opt may be a link to a larger disk.
    if environment.parent != INSTALLATIONS.resolve() or environment.name == CURRENT.name:
        raise SetupError(
            f"this environment is {environment}; a service of the system needs one of root's in "
            f"{INSTALLATIONS}:\n{how}"
        )
    for what, path in (("environment", environment), (f"Python of {environment}", python)):
        if any(path.is_relative_to(hidden) for hidden in _HIDDEN):
            raise SetupError(f"the {what} is {path}, which the service cannot see:\n{how}")


def _check_possible(host: Host) -> None:
    if not below(host.root, Path("/run/systemd/system")).is_dir():
        raise SetupError("systemd does not run here; start the service yourself: companion run")
    if host.user:
        host.check_manager()
        if "active" in host.run(("systemctl", "show", UNIT, "--property=ActiveState")).split("="):
            raise SetupError(f"{UNIT} of the system runs already: sudo companion uninstall removes it")
    elif os.geteuid() != 0:
        raise SetupError(f"this needs root: {as_root('install')}; or companion install --user")


def _settings(host: Host, say: Say) -> Settings | None:
    """Return the settings that the service will have, and say where they are; None: they are wrong."""
    path = user_file() if host.user else SYSTEM_FILE
    own = path if host.user else below(host.root, path)
    if own.is_file():
        say(f"settings   {path} stays as it is")
    else:
        say(f"settings   no {path}: the defaults; companion init finds autopilot and cameras")
    try:
        return settings_of_unit(host, UNIT)
    except (ConfigurationError, OSError) as error:
        for line in str(error).splitlines():
            say(f"           {line}")
        return None


def _say_entry(entry: Entry, say: Say, *, whole: bool) -> None:
    found = entry.found()
    state = "unchanged" if entry.is_there() else "new" if found is None else "changed"
    say(f"{state:<10} {entry.path}")
    if whole and state != "unchanged":
        for line in entry.lines():
            say(f"    {line}")


def _preparing(host: Host) -> Iterator[tuple[str, ...]]:
    """Yield what makes the user, the folders and the rule effective; each may be repeated."""
    if not host.user:
        yield ("systemd-sysusers", str(below(host.root, SYSUSERS)))
        yield ("systemd-tmpfiles", "--create", str(below(host.root, TMPFILES)))
        if below(host.root, Path("/run/udev/control")).exists():  # not in a container
            yield ("udevadm", "control", "--reload")
            yield ("udevadm", "trigger", "--subsystem-match=usb", "--subsystem-match=tty")


def _freeing(host: Host, settings: Settings | None, say: Say) -> Iterator[tuple[str, ...]]:
    """Yield what ends the login terminals on the autopilot's serial line."""
    if settings is None or host.user:
        return
    for unit in terminals(host, settings):
        state = host.show(unit)
        if state.get("ActiveState") == "active" or state.get("UnitFileState") == "enabled":
            yield host.systemctl("disable", "--now", unit)
    if (line := _console_line(host, settings)) is not None:
        say(line)


def _console_line(host: Host, settings: Settings) -> str | None:
    device = serial_device(host, settings)
    console = below(host.root, _CONSOLE)
    if device is None or not console.is_file() or device.name not in console.read_text().split():
        return None
    return (
        f"warning    the kernel has a console on {device.name}, and with it comes the login terminal at "
        f"every boot: {console_advice(device.name)}"
    )


def serial_device(host: Host, settings: Settings) -> Path | None:
    """Return the serial device of the settings, links resolved; None: the link is another one."""
    url = parse_link_url(settings.vehicle.url)
    return below(host.root, Path(url.address[0])).resolve() if url.scheme is LinkScheme.SERIAL else None


def terminals(host: Host, settings: Settings) -> list[str]:
    """Return the units that may have a login terminal on the autopilot's serial line."""
    device = serial_device(host, settings)
    if device is None:
        return []
    jetson = ["nvgetty.service"] if device.name.startswith("ttyTHS") else []
    return [f"serial-getty@{device.name}.service", *jetson]


def _starting(host: Host, own: Sequence[str], restarted: Sequence[str]) -> Iterator[tuple[str, ...]]:
    # A start may take minutes, for a model that is converted: it is watched.
    if restarted:
        yield host.systemctl("--no-block", "restart", *restarted)
    if started := [unit for unit in own if unit not in restarted]:
        yield host.systemctl("--no-block", "start", *started)


def _advice_of_user(host: Host) -> Iterator[str]:
    """Yield what only root can do for a service of this user."""
    user = user_of_service()
    names = {group_name(gid) for gid in user.groups | user.new_groups}
    if missing := [group for group in GROUPS if group not in names and user.uid]:
        yield f"advice     serial line and camera: sudo usermod -aG {','.join(missing)} {user.name}"
    if not starts_at_boot(host):
        yield f"advice     to start at boot, without a login: sudo loginctl enable-linger {user.name}"
