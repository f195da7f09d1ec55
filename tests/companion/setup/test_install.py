"""`companion install` and `uninstall` in a folder in place of `/`: files, commands, and what they refuse."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace

import pytest

from companion.doctor.serial_line import console_advice
from companion.doctor.service_query import Found
from companion.setup import flight, install, uninstall
from companion.setup.files import (
    CURRENT,
    INSTALLATIONS,
    RULES,
    SYSTEM_UNITS,
    TEMPLATE,
    UNIT,
    Link,
    TextFile,
    packaged,
    system_entries,
    user_entries,
    user_unit,
)
from companion.setup.startup import wait_until_up
from companion.setup.systemctl import Host, SetupError, run_program
from tests.companion.doctor.computer import service

OLD, NEW = INSTALLATIONS / "1.0", INSTALLATIONS / "1.1"
SETTINGS = '[vehicle]\nurl = "serial:///dev/ttyTHS1:921600"\n'


class Computer:
    """A computer in a folder. `commands`: what was run. `said`: what was printed."""

    def __init__(self, root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.root, self._patch = root, monkeypatch
        self.commands: list[tuple[str, ...]] = []
        self.said: list[str] = []
        self.states: dict[str, str] = {}
        self.failing = ""
        self.host = Host(root=root, run=self._run)
        for folder in ("run/systemd/system", "run/udev", "opt/companion", "dev", "etc/companion"):
            (root / folder).mkdir(parents=True)
        for name in ("run/udev/control", "dev/ttyTHS1"):
            (root / name).touch()
        self.settings = root / "etc/companion/companion.toml"
        self.settings.write_text(SETTINGS)
        monkeypatch.setattr("os.geteuid", lambda: 0)
        monkeypatch.setattr(sys, "executable", "/usr/bin/python3")
        monkeypatch.setattr(install, "wait_until_up", lambda *_: True)
        self.home = "/var/lib/companion"
        users = SimpleNamespace(getpwnam=lambda _: SimpleNamespace(pw_dir=self.home))
        monkeypatch.setattr(uninstall, "pwd", users)
        self.version(OLD)

    def version(self, environment: Path) -> None:
        """Be called from an environment."""
        self._patch.setattr(sys, "prefix", str(environment))

    def _run(self, command: Sequence[str]) -> str:
        words = tuple(command)
        if self.failing in (words[0], words[-1]):
            raise SetupError(self.failing)
        if words[1] == "show":
            return self.states.get(words[2], "ActiveState=inactive")
        if words[1:3] == ("--user", "show"):
            return self.states.get(f"--user {words[3]}", "ActiveState=inactive")
        if words[1] != "list-units":
            self.commands.append(words)
        return ""

    def install(self, **options: bool) -> None:
        install.install(self.host, self.said.append, **options)

    def install_for_user(self) -> None:
        install.install(Host(user=True, root=self.root, run=self._run), self.said.append)

    def runs(self, unit: str, age_s: float, state: str = "ActiveState=active") -> None:
        """Have a unit whose process was started some time ago."""
        started_us = (time.monotonic() - age_s) * 1e6
        self.states[unit] = f"{state}\nExecMainStartTimestampMonotonic={started_us:.0f}\nInvocationID=former"

    def uninstall(self, **options: bool) -> None:
        uninstall.uninstall(self.host, self.said.append, **options)

    def ran(self, *words: str) -> bool:
        return words in self.commands

    def files(self) -> dict[str, str]:
        return {
            str(path): str(path.readlink()) if path.is_symlink() else path.read_text()
            for path in sorted(self.root.rglob("*"))
            if path.is_symlink() or path.is_file()
        }


@pytest.fixture
def computer(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Computer:
    return Computer(tmp_path, monkeypatch)


def test_install_writes_its_files_and_starts(computer: Computer) -> None:
    computer.install()
    assert all(entry.is_there() for entry in system_entries(OLD, computer.root))
    assert (computer.root / "opt/companion/current").readlink() == OLD
    assert computer.settings.read_text() == SETTINGS
    names = [" ".join(words[:2]) for words in computer.commands]
    assert names[0].startswith("systemd-sysusers ")
    assert names[1] == "systemd-tmpfiles --create"
    assert names[2:] == [
        *("udevadm control", "udevadm trigger", "systemctl daemon-reload", "systemctl enable"),
        "systemctl --no-block",
    ]
    assert computer.ran("systemctl", "--no-block", "restart", UNIT)


def test_second_install_writes_and_restarts_nothing(computer: Computer) -> None:
    computer.install()
    before = computer.files()
    computer.commands.clear()
    computer.install()
    assert computer.files() == before
    assert computer.ran("systemctl", "--no-block", "start", UNIT)
    assert not any("restart" in words for words in computer.commands)
    assert not any("daemon-reload" in words for words in computer.commands)


@pytest.fixture
def disarmed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flight, "find_service", lambda *_: Found(service({"vehicle.armed": False})))


@pytest.fixture
def waited(monkeypatch: pytest.MonkeyPatch) -> dict[str, str | None]:
    """The units that are waited for, each with the InvocationID that is replaced."""
    found: dict[str, str | None] = {}

    def wait(_: Host, unit: str, __: object, ___: object, replaced: str | None, _s: float) -> bool:
        found[unit] = replaced
        return True

    monkeypatch.setattr(install, "wait_until_up", wait)
    return found


@pytest.mark.usefixtures("disarmed")
@pytest.mark.parametrize(("age_s", "restarts"), [(100.0, True), (-0.05, False)])
@pytest.mark.parametrize("name", [f"etc/systemd/system/{UNIT}", "opt/companion/current"])
def test_process_older_than_the_files_is_replaced(
    computer: Computer, waited: dict[str, str | None], name: str, age_s: float, restarts: bool
) -> None:
    computer.install()
    for path in computer.files():
        os.utime(path, (0, 0), follow_symlinks=False)
    os.utime(computer.root / name, follow_symlinks=False)
    computer.runs(UNIT, age_s)
    computer.commands.clear()
    computer.install()
    assert computer.ran("systemctl", "--no-block", "restart", UNIT) is restarts
    assert computer.ran("systemctl", "--no-block", "start", UNIT) is not restarts
    assert waited == {UNIT: "former" if restarts else None}


@pytest.mark.usefixtures("disarmed")
def test_unit_that_was_not_loaded_after_its_change_is_restarted(computer: Computer) -> None:
    computer.install()
    computer.runs(UNIT, -1.0, "ActiveState=active\nNeedDaemonReload=yes")
    computer.commands.clear()
    computer.install()
    assert computer.commands[-2:] == [
        ("systemctl", "daemon-reload"),
        ("systemctl", "--no-block", "restart", UNIT),
    ]


@pytest.mark.usefixtures("disarmed")
def test_interrupted_update_of_a_user_is_completed(
    computer: Computer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, waited: dict[str, str | None]
) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "own"))
    computer.install_for_user()
    computer.runs(f"--user {UNIT}", 1.0)
    monkeypatch.setattr(sys, "executable", "/opt/other/bin/python3")
    computer.failing = "daemon-reload"
    with pytest.raises(SetupError):
        computer.install_for_user()
    computer.failing = ""
    computer.commands.clear()
    waited.clear()
    computer.install_for_user()
    assert computer.ran("systemctl", "--user", "--no-block", "restart", UNIT)
    assert waited == {UNIT: "former"}


def test_vehicle_of_a_user_that_is_armed_meanwhile_is_not_left(
    computer: Computer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "own"))
    computer.install_for_user()
    unit = tmp_path / "own/systemd/user" / UNIT
    before = unit.read_text()
    computer.runs(f"--user {UNIT}", 1.0)
    computer.commands.clear()
    monkeypatch.setattr(
        flight, "find_service", lambda *_: Found(service({"vehicle.armed": bool(computer.commands)}))
    )
    monkeypatch.setattr(sys, "executable", "/opt/other/bin/python3")
    monkeypatch.setattr(Host, "check_manager", lambda _: None)
    with pytest.raises(SetupError) as raised:
        computer.install_for_user()
    assert f"not changed: {unit}" in str(raised.value)
    assert unit.read_text() == before


def test_nothing_but_a_reload_lies_between_check_and_restart(
    computer: Computer, monkeypatch: pytest.MonkeyPatch
) -> None:
    computer.install()
    computer.version(NEW)
    (computer.root / SYSTEM_UNITS.relative_to("/") / UNIT).write_text("[Unit]\n")
    computer.runs(UNIT, 1.0)
    checked: list[int] = []

    def find(*_: object) -> Found:
        checked.append(len(computer.commands))
        return Found(service({"vehicle.armed": False}))

    monkeypatch.setattr(flight, "find_service", find)
    computer.install()
    assert computer.commands[checked[-1] :] == [
        ("systemctl", "daemon-reload"),
        ("systemctl", "--no-block", "restart", UNIT),
    ]
    assert ("systemctl", "enable", UNIT) in computer.commands[checked[0] : checked[-1]]


def test_update_after_an_interrupted_one_restarts(computer: Computer) -> None:
    computer.install()
    computer.version(NEW)
    computer.failing = "systemd-tmpfiles"
    with pytest.raises(SetupError):
        computer.install()
    computer.failing = ""
    computer.commands.clear()
    computer.install()
    assert (computer.root / CURRENT.relative_to("/")).readlink() == NEW
    assert computer.ran("systemctl", "--no-block", "restart", UNIT)


def test_dry_run_prints_and_changes_nothing(computer: Computer) -> None:
    before = computer.files()
    computer.install(dry_run=True)
    assert (computer.files(), computer.commands) == (before, [])
    printed = "\n".join(computer.said)
    for name in (UNIT, TEMPLATE, "sysusers.conf", "tmpfiles.conf", "70-companion.rules"):
        assert all(line in printed for line in packaged(name).splitlines())
    assert f"+{OLD}" in printed
    assert "systemctl daemon-reload" in printed


def test_dry_run_shows_what_changes_in_a_file(computer: Computer) -> None:
    computer.install()
    unit = computer.root / SYSTEM_UNITS.relative_to("/") / UNIT
    unit.write_text(unit.read_text().replace("WatchdogSec=5", "WatchdogSec=50"))
    computer.said.clear()
    computer.install(dry_run=True)
    lines = [line.strip() for line in computer.said]
    assert {"-WatchdogSec=50", "+WatchdogSec=5"} <= set(lines)
    assert "WatchdogSec=50" in unit.read_text()


def test_update_and_rollback_move_the_link_and_restart(computer: Computer) -> None:
    computer.install()
    for version in (NEW, OLD):
        computer.commands.clear()
        computer.version(version)
        computer.install()
        assert (computer.root / CURRENT.relative_to("/")).readlink() == version
        assert computer.ran("systemctl", "--no-block", "restart", UNIT)


@pytest.mark.parametrize(
    ("armed", "force", "installed"), [(True, False, False), (True, True, True), (False, False, True)]
)
def test_armed_vehicle_is_not_left(
    computer: Computer, monkeypatch: pytest.MonkeyPatch, armed: bool, force: bool, installed: bool
) -> None:
    found = Found(service({"vehicle.armed": armed}))
    monkeypatch.setattr(flight, "find_service", lambda *_: found)
    computer.states[UNIT] = "ActiveState=active"
    for act in (computer.install, computer.uninstall):
        if installed:
            act(force=force)
        else:
            with pytest.raises(SetupError, match="--force"):
                act(force=force)
            assert not computer.commands


def test_vehicle_that_is_armed_meanwhile_is_not_left(
    computer: Computer, monkeypatch: pytest.MonkeyPatch
) -> None:
    computer.install()
    computer.version(NEW)
    computer.commands.clear()
    computer.states[UNIT] = "ActiveState=active"

    def find(*_: object) -> Found:
        return Found(service({"vehicle.armed": ("systemctl", "enable", UNIT) in computer.commands}))

    monkeypatch.setattr(flight, "find_service", find)
    unit = computer.root / SYSTEM_UNITS.relative_to("/") / UNIT
    unit.write_text("[Unit]\n")
    with pytest.raises(SetupError, match="--force") as raised:
        computer.install()
    assert all(str(path) in str(raised.value) for path in (unit, computer.root / CURRENT.relative_to("/")))
    assert unit.read_text() == "[Unit]\n"
    assert not any("restart" in words for words in computer.commands)
    assert (computer.root / CURRENT.relative_to("/")).readlink() == OLD


@pytest.mark.parametrize("state", ["active", "activating", "reloading", "deactivating"])
def test_silent_service_is_not_taken_for_disarmed(
    computer: Computer, monkeypatch: pytest.MonkeyPatch, state: str
) -> None:
    monkeypatch.setattr(flight, "find_service", lambda *_: Found())
    computer.states[UNIT] = f"ActiveState={state}"
    for act in (computer.install, computer.uninstall):
        with pytest.raises(SetupError, match="--force"):
            act()


@pytest.mark.usefixtures("disarmed")
def test_instance_that_is_starting_is_restarted_too(
    computer: Computer, waited: dict[str, str | None]
) -> None:
    (wants := computer.root / "etc/systemd/system/multi-user.target.wants").mkdir(parents=True)
    for name in ("east", "north", "south"):
        (wants / f"companion@{name}.service").touch()
        (computer.root / f"etc/companion/{name}.toml").touch()
    computer.runs("companion@north.service", 1.0, "ActiveState=activating")
    computer.runs("companion@south.service", 1.0, "ActiveState=active")
    computer.install()
    units = ("companion@north.service", "companion@south.service")
    assert computer.ran("systemctl", "--no-block", "restart", *units)
    assert waited == dict.fromkeys(units, "former")


@pytest.mark.parametrize(
    ("prefix", "python"),
    [
        ("/home/pi/venv", "/usr/bin/python3.11"),
        (str(INSTALLATIONS), "/usr/bin/python3.11"),
        (str(CURRENT), "/usr/bin/python3.11"),
        (str(OLD), "/home/pi/python/bin/python3.11"),
    ],
)
def test_environment_that_the_service_cannot_use_is_named(
    computer: Computer, monkeypatch: pytest.MonkeyPatch, prefix: str, python: str
) -> None:
    before = computer.files()
    monkeypatch.setattr(sys, "prefix", prefix)
    monkeypatch.setattr(sys, "executable", python)
    with pytest.raises(SetupError) as raised:
        computer.install()
    assert "companion install --user" in str(raised.value)
    assert f"python3 -m venv {INSTALLATIONS}/" in str(raised.value)
    assert computer.files() == before


def test_opt_may_be_a_link(computer: Computer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (disk := tmp_path / "disk/companion").mkdir(parents=True)
    (tmp_path / "link").symlink_to(disk)
    monkeypatch.setattr(install, "INSTALLATIONS", tmp_path / "link")
    computer.version(tmp_path / "link/1.0")
    computer.install()
    assert (computer.root / CURRENT.relative_to("/")).readlink() == disk / "1.0"


def test_of_instances_alone_only_these_are_waited_for(
    computer: Computer, monkeypatch: pytest.MonkeyPatch
) -> None:
    waited: list[str] = []

    def wait(_: Host, unit: str, *__: object) -> bool:
        waited.append(unit)
        return True

    monkeypatch.setattr(install, "wait_until_up", wait)
    monkeypatch.setattr(flight, "find_service", lambda *_: Found(service({"vehicle.armed": False})))
    wants = computer.root / "etc/systemd/system/multi-user.target.wants"
    wants.mkdir(parents=True)
    for name in ("north", "south"):
        (wants / f"companion@{name}.service").touch()
        (computer.root / f"etc/companion/{name}.toml").touch()
    computer.states["companion@north.service"] = "ActiveState=active\nUnitFileState=enabled"
    computer.states[UNIT] = "ActiveState=inactive\nUnitFileState=disabled"
    computer.install()
    assert waited == ["companion@north.service"]
    assert not computer.ran("systemctl", "enable", UNIT)


@pytest.mark.parametrize(
    ("program", "line"),
    [
        ("/opt/companion/1 0/bin/companion", "sudo '/opt/companion/1 0/bin/companion' install"),
        ("/usr/lib/python3/companion/cli/__main__.py", "sudo /usr/bin/python3 -m companion.cli install"),
    ],
)
def test_line_for_root_can_be_copied(
    computer: Computer, monkeypatch: pytest.MonkeyPatch, program: str, line: str
) -> None:
    monkeypatch.setattr("os.geteuid", lambda: 1000)
    monkeypatch.setattr(sys, "argv", [program])
    with pytest.raises(SetupError) as raised:
        computer.install()
    assert line in str(raised.value)


def test_output_of_a_program_may_be_any_bytes() -> None:
    assert run_program(("printf", r"\303\274\377")) == "ü\ufffd"


def test_log_of_a_start_begins_before_it() -> None:
    commands: list[Sequence[str]] = []

    def run(words: Sequence[str]) -> str:
        commands.append(words)
        return ""

    Host(run=run).journal(UNIT, 100.9, 5)
    assert "--since=@100" in commands[0]


@pytest.mark.parametrize(
    ("code", "how"), [(0, "resources"), (1, "exit code 9"), (2, "signal 9"), (3, "signal 9")]
)
def test_end_is_said_as_systemd_names_it(code: int, how: str) -> None:
    state = f"ActiveState=failed\nExecMainCode={code}\nExecMainStatus=9\nResult=resources"
    said: list[str] = []
    assert not wait_until_up(Host(run=lambda _: state), UNIT, None, said.append, None, 0.0)
    assert [each for each in ("resources", "exit code 9", "signal 9") if each in said[0]] == [how]


@pytest.mark.parametrize("missing", ["root", "systemd"])
def test_install_needs_root_and_systemd(
    computer: Computer, monkeypatch: pytest.MonkeyPatch, missing: str
) -> None:
    if missing == "root":
        monkeypatch.setattr("os.geteuid", lambda: 1000)
    else:
        (computer.root / "run/systemd/system").rmdir()
    with pytest.raises(SetupError, match=missing):
        computer.install()
    assert not computer.commands


@pytest.mark.parametrize("change", [install.install, uninstall.uninstall])
def test_missing_manager_of_the_user_is_one_line(
    computer: Computer, change: Callable[..., object], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "own"))

    def refused(command: Sequence[str]) -> str:
        if "--user" in command:
            raise SetupError(f"{' '.join(command)}: Failed to connect to bus: No medium found")
        return ""

    with pytest.raises(SetupError) as raised:
        change(Host(user=True, root=computer.root, run=refused), computer.said.append)
    (line,) = str(raised.value).splitlines()
    assert all(word in line for word in ("No medium found", "libpam-systemd", "loginctl enable-linger"))
    assert not (tmp_path / "own").exists()


def test_login_terminals_of_the_serial_line_are_disabled(computer: Computer) -> None:
    computer.states["serial-getty@ttyTHS1.service"] = "ActiveState=active"
    computer.states["nvgetty.service"] = "ActiveState=inactive\nUnitFileState=enabled"
    computer.states["serial-getty@ttyS0.service"] = "ActiveState=active"
    computer.install()
    disabled = [words[-1] for words in computer.commands if words[1] == "disable"]
    assert disabled == ["serial-getty@ttyTHS1.service", "nvgetty.service"]


def test_console_of_the_kernel_is_named_as_doctor_names_it(computer: Computer) -> None:
    (active := computer.root / "sys/class/tty/console/active").parent.mkdir(parents=True)
    active.write_text("tty0 ttyTHS1\n")
    computer.install()
    (line,) = [line for line in computer.said if line.startswith("warning")]
    assert console_advice("ttyTHS1") in line


def test_no_login_terminal_is_disabled_for_a_network_link(computer: Computer) -> None:
    computer.settings.write_text('[vehicle]\nurl = "udpin://127.0.0.1:14540"\n')
    computer.states["serial-getty@ttyTHS1.service"] = "ActiveState=active"
    computer.install()
    assert not any(words[1] == "disable" for words in computer.commands)


def test_wrong_settings_do_not_stop_the_installation(computer: Computer) -> None:
    computer.settings.write_text("[vehicle]\nurl = 5\n")
    computer.install()
    assert any("vehicle.url" in line for line in computer.said)
    assert computer.ran("systemctl", "enable", UNIT)


def test_uninstall_removes_what_install_wrote(computer: Computer) -> None:
    before = computer.files()
    computer.install()
    (computer.root / "opt/companion/1.0").mkdir()
    computer.commands.clear()
    computer.uninstall()
    assert computer.files() == before
    assert computer.ran("systemctl", "disable", "--now", UNIT)
    assert not computer.ran("userdel", "companion")
    kept = [line for line in computer.said if line.startswith("kept")]
    assert any("/etc/companion" in line and "--purge" in line for line in kept)
    assert any("sudo rm -r" in line and line.endswith("companion/1.0") for line in kept)


def test_purge_removes_settings_recordings_and_user(computer: Computer) -> None:
    computer.install()
    for folder in ("var/lib/companion/flights", "var/cache/companion"):
        (computer.root / folder).mkdir(parents=True)
    computer.uninstall(purge=True)
    for folder in ("etc/companion", "var/lib/companion", "var/cache/companion"):
        assert not (computer.root / folder).exists()
    assert computer.ran("userdel", "companion")


def test_purge_leaves_the_user_of_a_person(computer: Computer) -> None:
    computer.install()
    computer.home = "/home/companion"
    computer.uninstall(purge=True)
    assert not any(words[0] == "userdel" for words in computer.commands)
    assert not any("user companion" in line for line in computer.said)


def test_line_that_removes_an_environment_is_quoted(computer: Computer) -> None:
    computer.install()
    (computer.root / "opt/companion/1.0 alt").mkdir()
    computer.uninstall()
    (line,) = [line for line in computer.said if "1.0 alt" in line]
    assert shlex.split(line.partition(": ")[2])[3:] == [str(computer.root / "opt/companion/1.0 alt")]


def test_uninstall_of_a_user_names_what_it_keeps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    monkeypatch.delenv("STATE_DIRECTORY", raising=False)
    said: list[str] = []
    host = Host(user=True, root=tmp_path, run=lambda _: "ActiveState=inactive")
    kept = [tmp_path / name for name in ("config/companion", "state/companion")]
    for folder in kept:
        folder.mkdir(parents=True)
    for entry in user_entries():
        entry.write()
    uninstall.uninstall(host, said.append)
    assert not (tmp_path / "config/systemd").exists()
    assert all(folder.is_dir() and any(f"rm -r {folder}" in line for line in said) for folder in kept)
    with pytest.raises(SetupError, match="--purge"):
        uninstall.uninstall(host, said.append, purge=True)


def test_uninstall_names_what_it_does_not_change_back(computer: Computer) -> None:
    computer.install()
    computer.states["nvgetty.service"] = "UnitFileState=disabled"
    drop_in = computer.root / "etc/systemd/system/companion.service.d"
    drop_in.mkdir()
    computer.uninstall()
    kept = [line for line in computer.said if line.startswith("kept")]
    assert any("systemctl enable --now nvgetty.service" in line for line in kept)
    assert any(str(drop_in) in line for line in kept)


def test_uninstall_without_an_installation_changes_nothing(computer: Computer) -> None:
    before = computer.files()
    computer.uninstall()
    assert computer.files() == before
    assert computer.commands == [("systemctl", "daemon-reload")]


def test_unit_of_a_user_asks_for_no_privileges() -> None:
    lines = user_unit(Path("/home/a b/100%/bin/python")).splitlines()
    keys = [line.partition("=")[0] for line in lines if re.match(r"\w+=", line)]
    system = packaged(UNIT).splitlines()
    for line in system:
        if re.match(r"(Watchdog|Restart|Timeout|Kill|Type|UMask|NoNew)\w*=", line):
            assert line in lines
    assert not {"User", "SupplementaryGroups", "Nice", "CapabilityBoundingSet", "StateDirectory"} & set(keys)
    assert 'ExecStart="/home/a b/100%%/bin/python" -m companion.cli run' in lines
    assert "WantedBy=default.target" in lines
    assert "WantedBy=multi-user.target" not in lines


def test_files_are_written_whole_whatever_their_text_is(tmp_path: Path) -> None:
    file = TextFile(tmp_path / UNIT, user_unit(Path("/home/jürgen/\udcfc/bin/python")))
    file.write()
    assert file.is_there()
    assert b"/home/j\xc3\xbcrgen/\xfc/bin" in file.path.read_bytes()
    for entry in (TextFile(tmp_path / "folder", ""), Link(tmp_path / "folder", tmp_path)):
        (tmp_path / "folder").mkdir(exist_ok=True)
        with pytest.raises(OSError, match="folder"):
            entry.write()
    assert sorted(each.name for each in tmp_path.iterdir()) == [UNIT, "folder"]


@pytest.mark.needs("systemd-analyze")
def test_unit_of_a_user_is_valid(tmp_path: Path) -> None:
    unit = tmp_path / UNIT
    unit.write_text(user_unit(Path(sys.executable)))
    done = subprocess.run(
        ["systemd-analyze", "verify", "--user", unit], capture_output=True, text=True, timeout=60, check=False
    )
    assert UNIT not in done.stderr, done.stderr


@pytest.mark.parametrize("vendor", ["26ac", "3185", "3643", "3162", "3163", "2dae", "1209", "0483"])
def test_rule_names_the_vendors_of_flight_controllers(vendor: str) -> None:
    rules = [line for line in packaged(RULES.name).splitlines() if not line.startswith("#")]
    assert any(vendor in line and 'ENV{ID_MM_DEVICE_IGNORE}="1"' in line for line in rules)
    # Never for a device of any vendor.
    assert all("idVendor" in line for line in rules if "ID_MM_DEVICE_IGNORE" in line)
