"""The installed service under a systemd that boots: ready, frozen, stopped, updated, removed.

Devices are not here: udev, serial lines and login terminals are in tests/companion/setup, with folders.
"""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from companion.doctor.check import Verdict
from tests.systemd.container import (
    NEW,
    OLD,
    SETTINGS,
    SETTINGS_FILE,
    TRUTH,
    Container,
    start_simulator,
    wait_for,
)

pytestmark = [pytest.mark.systemd, pytest.mark.needs("systemd container"), pytest.mark.timeout(1200)]

# Promises of docs/safety.md and docs/how-to/systemd.md, seconds.
FAILSAFE_S, WATCHDOG_S, HOLD_S, AGAIN_S, BOOT_S = 1.5, 6.0, 5.0, 15.0, 60.0
EXPOSURE = 2.0
LINES_OF_A_START = 20
# Of a file tree: what programs that manage users and units leave beside their files.
BESIDE = ("etc/.pwd.lock", "etc/passwd-", "etc/shadow-", "etc/group-", "etc/gshadow-")
KEPT = ("etc/companion", "var/lib/companion", "var/cache/companion")


def rows(container: Container) -> list[dict[str, Any]]:
    """The simulated vehicle, twenty times a second."""
    text = (container.root / TRUTH).read_text()
    return [json.loads(line) for line in text.splitlines() if line.endswith("}")]


def mode(container: Container) -> str:
    return str(rows(container)[-1]["mode"])


def until_row(
    container: Container, since_ns: int, condition: Callable[[dict[str, Any]], bool], within_s: float
) -> float:
    """Wait for the first row after a time that meets a condition, and return its time after, seconds."""
    found: list[int] = []

    def look() -> bool:
        found[:] = [
            row["stamp_ns"] for row in rows(container) if row["stamp_ns"] > since_ns and condition(row)
        ][:1]
        return bool(found)

    wait_for(look, f"the vehicle as it is to be, now {mode(container)}", within_s)
    return (found[0] - since_ns) / 1e9


def ready(container: Container) -> bool:
    return container.result("/opt/companion/current/bin/companion", "status")[0] == 0


@pytest.fixture
def flight(installed: Container) -> Iterator[Container]:
    """In flight, in OFFBOARD, under the command `hold`."""
    installed.run("systemctl", "stop", "companion")
    start_simulator(installed)
    installed.run("systemctl", "start", "companion")
    wait_for(lambda: ready(installed), "a service that is ready", 60.0)
    wait_for(
        lambda: installed.result("/opt/companion/current/bin/companion", "send", "takeoff 2.5")[0] == 0,
        "a flight",
        60.0,
    )
    installed.companion("send", "hold")
    wait_for(lambda: mode(installed) == "OFFBOARD", "OFFBOARD", 10.0)
    yield installed
    installed.run("systemctl", "stop", "simulator", check=False)
    installed.run("systemctl", "restart", "companion")


def test_installed_service_is_ready(installed: Container) -> None:
    wait_for(lambda: ready(installed), "a service that is ready", 60.0)
    assert installed.show("UnitFileState") == "enabled"
    assert installed.run("readlink", "/opt/companion/current").strip() == OLD
    read = installed.run("udevadm", "test", "/sys/devices/virtual/mem/null", check=False)
    assert "/etc/udev/rules.d/70-companion.rules" in read
    assert "70-companion.rules:" not in read  # a line that udev cannot read
    checks = json.loads(installed.result("/opt/companion/current/bin/companion", "doctor", "--json")[1])
    faults = [check for check in checks if check["verdict"] == Verdict.FAULT]
    assert not faults


def test_second_install_changes_nothing(installed: Container) -> None:
    before = installed.show("InvocationID")
    output = installed.companion("install", environment=OLD)
    assert installed.show("InvocationID") == before
    assert {line.split()[0] for line in output.splitlines()} >= {"unchanged", "run", "ready"}
    assert not {"new", "changed"} & {line.split()[0] for line in output.splitlines() if line.strip()}


def test_process_older_than_its_unit_is_replaced(installed: Container) -> None:
    installed.run("touch", "/etc/systemd/system/companion.service")
    processes = [installed.show("InvocationID")]
    for _ in range(2):
        output = installed.companion("install", environment=OLD)
        assert not {"new", "changed"} & {line.split()[0] for line in output.splitlines() if line.strip()}
        processes.append(installed.show("InvocationID"))
    first, second, third = processes
    assert first != second
    assert second == third


def test_dry_run_changes_nothing(empty: Container) -> None:
    before = tree(empty)
    output = empty.companion("install", "--dry-run", environment=OLD)
    assert tree(empty) == before
    for text in ("WatchdogSec=5", "ID_MM_DEVICE_IGNORE", "u companion", "d /etc/companion", "daemon-reload"):
        assert text in output


def test_frozen_service_is_replaced(flight: Container) -> None:
    process = flight.show("MainPID")
    stopped_ns = time.monotonic_ns()
    flight.run("kill", "-STOP", process)
    left_s = until_row(flight, stopped_ns, lambda row: row["mode"] != "OFFBOARD", FAILSAFE_S + 3.0)
    wait_for(lambda: flight.show("MainPID") != process, "its end", 10.0)
    killed_s = (time.monotonic_ns() - stopped_ns) / 1e9
    wait_for(lambda: flight.show("ActiveState") == "active", "the next process", 30.0)
    again_s = (time.monotonic_ns() - stopped_ns) / 1e9
    print(f"frozen: failsafe {left_s:.2f} s, watchdog {killed_s:.2f} s, running again {again_s:.2f} s")
    assert left_s <= FAILSAFE_S
    assert killed_s <= WATCHDOG_S
    assert flight.show("NRestarts") == "1"


def test_stop_in_flight_is_hold(flight: Container) -> None:
    began_ns = time.monotonic_ns()
    flight.run("systemctl", "stop", "--no-block", "companion")
    hold_s = until_row(flight, began_ns, lambda row: row["mode"] == "HOLD", HOLD_S + 3.0)
    wait_for(lambda: flight.show("ActiveState") == "inactive", "its end", 30.0)
    print(f"stopped: HOLD {hold_s:.2f} s, ended {(time.monotonic_ns() - began_ns) / 1e9:.2f} s")
    assert hold_s <= HOLD_S
    assert flight.show("Result") == "success"
    assert mode(flight) == "HOLD"


def test_hangup_in_flight_is_hold_and_another_start(flight: Container) -> None:
    process = flight.show("MainPID")
    began_ns = time.monotonic_ns()
    flight.run("systemctl", "kill", f"--signal={signal.SIGHUP.name}", "--kill-who=main", "companion")
    hold_s = until_row(flight, began_ns, lambda row: row["mode"] == "HOLD", HOLD_S)
    wait_for(
        lambda: flight.show("MainPID") not in ("0", process) and flight.show("ActiveState") == "active",
        "the next process",
        AGAIN_S + 10.0,
    )
    again_s = (time.monotonic_ns() - began_ns) / 1e9
    print(f"SIGHUP: HOLD {hold_s:.2f} s, running again {again_s:.2f} s")
    assert again_s <= AGAIN_S


def test_update_waits_for_the_ground_and_is_taken_back(flight: Container) -> None:
    code, output = flight.result(f"{NEW}/bin/companion", "install")
    assert code == 1
    assert "--force" in output
    assert mode(flight) == "OFFBOARD"
    assert flight.run("readlink", "/opt/companion/current").strip() == OLD
    flight.companion("send", "land")
    wait_for(lambda: not rows(flight)[-1]["armed"], "the ground", 60.0)
    for environment in (NEW, OLD):
        before = flight.show("MainPID")
        flight.companion("install", environment=environment)
        assert flight.run("readlink", "/opt/companion/current").strip() == environment
        process = flight.show("MainPID")
        assert process != before
        command = flight.run("cat", f"/proc/{process}/cmdline").split("\0")
        assert Path(command[0]).is_relative_to(environment)


def test_exposure_of_the_loaded_unit(installed: Container) -> None:
    line = installed.run("systemd-analyze", "security", "--no-pager", "companion").splitlines()[-1]
    print(line)
    assert float(line.partition("companion.service:")[2].split()[0]) <= EXPOSURE


def test_start_is_few_lines_of_the_log(installed: Container) -> None:
    start_simulator(installed)
    installed.run("systemctl", "restart", "companion")
    wait_for(lambda: ready(installed), "a service that is ready", 60.0)
    own = f"_SYSTEMD_INVOCATION_ID={installed.show('InvocationID')}"
    lines = installed.run("journalctl", "--no-pager", "--output=cat", own).splitlines()
    print("\n".join(lines))
    assert 0 < len(lines) <= LINES_OF_A_START


def test_service_starts_at_boot_without_a_clock(empty: Container) -> None:
    empty.write(SETTINGS_FILE, SETTINGS)
    output = empty.companion("install", environment=OLD)
    assert output.splitlines()[-1].split()[0] == "ready"
    empty.power_off()
    boot_s = empty.boot()
    wait_for(lambda: empty.show("ActiveState") == "active", "the service", BOOT_S)
    print(f"booted in {boot_s:.1f} s")
    # It still waits, and with it all that is ordered after the time.
    assert empty.show("ActiveState", "systemd-time-wait-sync") == "activating"
    assert empty.show("ActiveState", "time-sync.target") == "inactive"


def test_wrong_settings_are_named_from_the_log(empty: Container) -> None:
    empty.write(SETTINGS_FILE, SETTINGS.replace("uri =", "url ="))
    code, output = empty.result(f"{OLD}/bin/companion", "install")
    assert code == 1
    assert "exit code 2" in output
    assert "source.url" in output


def tree(container: Container) -> dict[str, str]:
    """What is installed: each path below /etc, /opt, /usr and /var, with its kind; of text files the content.

    Without logs, caches of other programs and compiled Python.
    """
    found = {}
    unlike = ("__pycache__", "/var/log/", "/var/tmp/", "/var/cache/ldconfig", "/var/lib/systemd/")
    for top in ("etc", "opt", "usr", "var"):
        for path in sorted((container.root / top).rglob("*")):
            name = str(path.relative_to(container.root))
            if name in BESIDE or any(part in f"/{name}" for part in unlike):
                continue
            status = path.lstat()
            text = f"{status.st_mode:o} {status.st_uid}"
            if path.is_symlink():
                text += f" {path.readlink()}"
            elif path.is_file() and top == "etc":
                text += " " + path.read_text(errors="replace")
            found[name] = text
    return found


def test_uninstall_leaves_nothing(empty: Container) -> None:
    enabled = ("systemctl", "list-unit-files", "--state=enabled", "--no-legend")
    before, units, users = tree(empty), empty.run(*enabled), empty.run("getent", "passwd")
    empty.write(SETTINGS_FILE, SETTINGS)
    empty.companion("install", environment=OLD)
    assert empty.run(*enabled) != units
    empty.companion("uninstall", environment=OLD)
    left = {name for name in tree(empty).keys() - before.keys() if not name.startswith(KEPT)}
    assert not left
    assert (empty.root / SETTINGS_FILE.lstrip("/")).read_text() == SETTINGS
    assert empty.run(*enabled) == units
    assert empty.show("LoadState") == "not-found"
    empty.companion("uninstall", "--purge", environment=OLD)
    assert empty.run("getent", "passwd") == users
    assert tree(empty) == before


def test_user_installs_without_privileges(empty: Container) -> None:
    empty.run("useradd", "--create-home", "--groups", "dialout,video", "pilot")
    empty.run("loginctl", "enable-linger", "pilot")
    uid = empty.run("id", "-u", "pilot").strip()
    empty.write("/home/pilot/.config/companion/companion.toml", SETTINGS)
    empty.run("chown", "-R", "pilot:", "/home/pilot/.config")
    wait_for(lambda: empty.run("ls", f"/run/user/{uid}/bus", check=False), "its manager", 30.0)
    as_pilot = ("runuser", "-u", "pilot", "--", "env", f"XDG_RUNTIME_DIR=/run/user/{uid}", "HOME=/home/pilot")
    output = empty.run(*as_pilot, f"{OLD}/bin/companion", "install", "--user")
    assert output.splitlines()[-1].split()[0] == "ready"
    assert "enable-linger" not in output
    shown = empty.run(*as_pilot, "systemctl", "--user", "is-active", "companion")
    assert shown.strip() == "active"
    empty.run(*as_pilot, f"{OLD}/bin/companion", "uninstall", "--user")
    assert not list((empty.root / "home/pilot/.config/systemd").rglob("*.service"))
