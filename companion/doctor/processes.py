"""Programs that hold what the service needs, by /proc: name, process, unit, and the line that ends them."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Collection, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from vision.open_files import processes, processes_with_file, processes_with_open, program_name

# Its last unit in /proc/PID/cgroup: a service of the system, or of a user's manager.
_UNIT = re.compile(r".*/([^/]+)\.service")
_CONTAINER = re.compile(r"(?:docker|libpod)-([0-9a-f]{12})[0-9a-f]*\.scope|/docker/([0-9a-f]{12})")


@dataclass(frozen=True, slots=True)
class Program:
    """A running program.

    Attributes:
        command: its arguments; empty: it has ended, or is a thread of the kernel.
        unit: systemd's, without `.service`; empty: none. user_unit: it is one of a user's manager.
        container: of Docker or Podman; empty: none.
        ours: it is a program of this package, or the child of one.
    """

    pid: int
    name: str
    command: tuple[str, ...] = ()
    unit: str = ""
    user_unit: bool = False
    container: str = ""
    ours: bool = False

    def __str__(self) -> str:
        where = f", {self.unit}.service" if self.unit else ""
        return f"{self.name} (process {self.pid}{where})"

    @property
    def stopping(self) -> str:
        """The line that ends it until the next start."""
        if not self.container and self.unit:
            return f"{self._systemctl} stop {shlex.quote(self.unit)}"
        return self.freeing

    @property
    def _systemctl(self) -> str:
        return "systemctl --user" if self.user_unit else "sudo systemctl"

    @property
    def freeing(self) -> str:
        """The line that ends it."""
        if self.container:
            return f"docker stop {self.container}"
        if self.unit:
            # A getty is started again at the next boot, and ModemManager by its bus: both need `disable`.
            return f"{self._systemctl} disable --now {shlex.quote(self.unit)}"
        return f"kill {self.pid}"


def program(pid: int, proc: Path) -> Program:
    """Return a process as a program."""
    command, cgroup = _command(pid, proc), ""
    with suppress(OSError):  # it has ended
        cgroup = (proc / str(pid) / "cgroup").read_text().strip()
    unit, container = _UNIT.search(cgroup), _CONTAINER.search(cgroup)
    name = "" if unit is None else unit[1]
    # A terminal's programs are in a scope of the user's manager, not in its unit.
    if name.startswith("user@"):
        name = ""
    return Program(
        pid,
        program_name(pid, proc) or "a program",
        command,
        unit=name,
        user_unit=bool(name) and "/user@" in cgroup,
        container="" if container is None else container[1] or container[2],
        ours=_is_ours(command) or _is_ours(_command(_parent(pid, proc), proc)),
    )


def programs(proc: Path) -> Iterator[Program]:
    """Yield all programs with a command line, also those of other users; without those that started this."""
    own, pid = set[int](), os.getpid()
    while pid and pid not in own:
        own.add(pid)
        pid = _parent(pid, proc)
    for each in processes(proc):
        if each not in own and _command(each, proc):
            yield program(each, proc)


def holding_file(path: Path, proc: Path) -> list[Program]:
    """Return the programs that have a file or device open, of other users for root only."""
    return [program(pid, proc) for pid in processes_with_file(path, proc)]


def holding_sockets(inodes: Collection[int], proc: Path) -> list[Program]:
    """Return the programs that have a socket open, of other users for root only."""
    wanted = {f"socket:[{inode}]" for inode in inodes}
    return [program(pid, proc) for pid in processes_with_open(lambda target, _: target in wanted, proc)]


def listed(found: Collection[Program]) -> str:
    """Return programs as text."""
    return ", ".join(map(str, found))


def _command(pid: int, proc: Path) -> tuple[str, ...]:
    try:
        data = (proc / str(pid) / "cmdline").read_bytes()
    except OSError:
        return ()
    return tuple(word.decode(errors="replace") for word in data.split(b"\0") if word)


def _parent(pid: int, proc: Path) -> int:
    try:
        # The name, in brackets, may have spaces and brackets.
        return int((proc / str(pid) / "stat").read_text(errors="replace").rpartition(")")[2].split()[1])
    except (OSError, IndexError, ValueError):
        return 0


def _is_ours(command: tuple[str, ...]) -> bool:
    """Whether it is `companion …` or `python -m companion.…`."""
    return any(Path(word).name == "companion" or word.startswith("companion.") for word in command[:4])
