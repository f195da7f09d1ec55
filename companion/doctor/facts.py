"""The facts that checks are made from: this computer, the settings, and what was received of a service."""

from __future__ import annotations

import grp
import os
import pwd
import re
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import companion
from companion.bus.bodies.service import EventBody, PortParametersBody, StatusBody
from companion.bus.bodies.vehicle import VehicleBody
from companion.doctor.check import Check, unknown
from companion.doctor.listening import Received
from companion.host.tasks import error_text
from companion.settings import Settings
from companion.settings.layers import NO_FILES, SettingsFiles

_PROGRAM_S = 3.0


@dataclass(frozen=True, slots=True)
class User:
    """A user and the groups whose devices its programs may open.

    Attributes:
        new_groups: granted, but not effective in this login session.
    """

    name: str
    uid: int
    groups: frozenset[int]
    new_groups: frozenset[int] = frozenset()


def user_of_service(etc: Path = Path("/etc")) -> User:
    """Return the user that runs the service: the unit's if root asks and there is one, else this one."""
    uid, unit = os.geteuid(), etc / "systemd" / "system" / "companion.service"
    if uid == 0 and unit.is_file():
        found = re.search(r"^User=(\S+)$", unit.read_text(errors="replace"), re.MULTILINE)
        try:
            entry = pwd.getpwnam(found[1] if found else "root")
        except KeyError:
            entry = pwd.getpwuid(0)
        return User(entry.pw_name, entry.pw_uid, frozenset(os.getgrouplist(entry.pw_name, entry.pw_gid)))
    effective = frozenset((*os.getgroups(), os.getegid()))
    try:
        entry = pwd.getpwuid(uid)
    except KeyError:  # of a container
        return User(str(uid), uid, effective)
    granted = frozenset(os.getgrouplist(entry.pw_name, entry.pw_gid))
    return User(entry.pw_name, uid, effective, granted - effective)


def group_name(gid: int) -> str:
    """Return the name of a group."""
    try:
        return grp.getgrgid(gid).gr_name
    except KeyError:
        return str(gid)


def output_of(command: Sequence[str]) -> str | None:
    """Return what a program prints; None: it is not there, fails, or takes too long."""
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=_PROGRAM_S, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout


@dataclass(frozen=True, slots=True)
class Machine:
    """Where this computer is looked at. A test has folders of its own.

    Attributes:
        log: where journald keeps its files. output_of: runs a program.
        wall_s: the time of day, seconds since 1970. built_s: when this package was made.
    """

    proc: Path = Path("/proc")
    sys: Path = Path("/sys")
    dev: Path = Path("/dev")
    etc: Path = Path("/etc")
    log: Path = Path("/var/log/journal")
    environment: Mapping[str, str] = field(default_factory=lambda: dict(os.environ))
    user: User = field(default_factory=user_of_service)
    output_of: Callable[[Sequence[str]], str | None] = output_of
    wall_s: float = field(default_factory=time.time)
    built_s: float = field(default_factory=lambda: Path(companion.__file__).stat().st_mtime)

    def path(self, device: str) -> Path:
        """Return a device's path, which settings give below /dev."""
        path = Path(device)
        return self.dev / path.relative_to("/dev") if path.is_relative_to("/dev") else path

    def text(self, *parts: str) -> str:
        """Return the text of a file below `sys`, without spaces at its ends; empty: it cannot be read."""
        try:
            return self.sys.joinpath(*parts).read_text(errors="replace").strip("\0 \n")
        except OSError:
            return ""


@dataclass(frozen=True, slots=True)
class Service:
    """What a running service has published.

    Attributes:
        vehicle: its name. here: it runs on this computer.
        statuses: the newest of each second, oldest first; empty: it is there and silent.
        events: kept ones, oldest first.
        ports: parameters of the autopilot's serial ports; None: not requested, or no answer.
    """

    vehicle: str
    here: bool
    statuses: tuple[StatusBody, ...] = ()
    state: VehicleBody | None = None
    events: tuple[EventBody, ...] = ()
    ports: PortParametersBody | None = None

    @property
    def status(self) -> StatusBody | None:
        """The newest one."""
        return self.statuses[-1] if self.statuses else None


@dataclass(frozen=True, slots=True)
class CameraTrial:
    """A camera was opened for a moment.

    Attributes:
        frames, seconds: read after the first frame. problem: why there is none.
    """

    frames: int = 0
    seconds: float = 0.0
    width: int = 0
    height: int = 0
    problem: str = ""


@dataclass(frozen=True, slots=True)
class Facts:
    """Everything that checks look at.

    Attributes:
        settings: those of the running service, else those that it would start with.
        settings_known: False: they could not be read, and `settings` are the defaults.
        files: of the settings that a service would start with.
        service: None: none was reached.
        reached: what was found while a service was looked for.
        wrong, missing: what is wrong with the settings, and what they name and is not there.
        received: on the vehicle's link; None: it was not listened to, for the reason `not_received`.
        cameras: name of a camera, None the first → what it delivered; those that were opened.
    """

    settings: Settings
    machine: Machine
    service: Service | None = None
    reached: Check | None = None
    wrong: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    settings_known: bool = True
    files: SettingsFiles = NO_FILES
    received: Received | None = None
    not_received: str = ""
    cameras: Mapping[str | None, CameraTrial] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class CheckKind:
    """One kind of check, for the table of `docs/how-to/troubleshooting.md`.

    Attributes:
        name: of its results, before the name of a camera, if any.
        finds: the faults that it finds, for people.
        examine: returns the results; none where it does not apply.
    """

    name: str
    finds: str
    examine: Callable[[Facts], Iterable[Check]]


def checks_of(facts: Facts, kinds: Iterable[CheckKind]) -> Iterator[Check]:
    """Make checks. A fault of ours in one of them is a result, not the end."""
    for kind in kinds:
        try:
            yield from kind.examine(facts)
        except Exception as error:
            yield unknown(kind.name, f"the check failed: {error_text(error)}", "please report it")
