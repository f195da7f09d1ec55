"""The units of systemd: how they restart, what they share, and how much of the system they can reach."""

from __future__ import annotations

import difflib
import re
import subprocess
from pathlib import Path

import pytest

from companion.cli.flags import EXIT_BAD_INPUT
from companion.settings.layers import SYSTEM_FILE
from companion.setup.files import CURRENT
from vision.model_files import SYSTEM_FOLDER

ROOT = Path(__file__).parent.parent
UNIT = ROOT / "systemd" / "companion.service"
TEMPLATE = ROOT / "systemd" / "companion@.service"
# What an instance has of its own: the unit's text and the template's.
OWN = {
    "Description": ("zenoh", "zenoh (%i)"),
    "ExecStart": ("companion run", "companion run --config /etc/companion/%i.toml"),
    "StateDirectory": ("companion companion/models", "companion/%i companion/models"),
    "Environment": ("/var/cache/companion", "/var/cache/companion COMPANION_VEHICLE_NAME=%i"),
    "WorkingDirectory": ("/var/lib/companion", "/var/lib/companion/%i"),
}
# `systemd-analyze security --offline=true` of systemd 252 and 257, tenths.
LARGEST_EXPOSURE = 17


def body(unit: Path) -> list[str]:
    """The lines after the comment on installation."""
    return unit.read_text().partition("[Unit]\n")[2].splitlines()


def settings(unit: Path) -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for line in body(unit):
        if match := re.fullmatch(r"(\w+)=(.*)", line):
            found.setdefault(match[1], []).append(match[2])
    return found


def test_units_differ_in_what_an_instance_owns() -> None:
    expected = []
    for line in body(UNIT):
        key = line.partition("=")[0]
        if key in OWN:
            one, instance = OWN[key]
            assert line.endswith(one)
            line = line.removesuffix(one) + instance
        expected.append(line)
    assert not list(difflib.unified_diff(expected, body(TEMPLATE), lineterm=""))
    assert OWN.keys() <= settings(UNIT).keys()


@pytest.mark.parametrize("unit", [UNIT, TEMPLATE], ids=lambda path: path.name)
def test_only_wrong_settings_end_the_service(unit: Path) -> None:
    found = settings(unit)
    assert found["Restart"] == ["always"]
    assert found["RestartPreventExitStatus"] == [str(EXIT_BAD_INPUT)]
    assert found["StartLimitIntervalSec"] == ["0"]
    # Of another process systemd does not ask for the exit code: it would start again without limit.
    assert "ExecStartPre" not in found
    assert "time-sync.target" not in " ".join(found["After"])


def test_unit_has_the_folders_of_the_program() -> None:
    found = settings(UNIT)
    folders = {Path("/var/lib") / name for name in found["StateDirectory"][0].split()}
    assert SYSTEM_FOLDER in folders
    # Without --config: a computer without settings starts with the defaults, the unit's user has none.
    assert found["ExecStart"] == [f"{CURRENT}/bin/companion run"]
    assert settings(TEMPLATE)["ExecStart"] == [
        f"{CURRENT}/bin/companion run --config {SYSTEM_FILE.with_name('%i.toml')}"
    ]
    assert "COMPANION_MODELS_FOLDER" not in UNIT.read_text()


def test_what_the_service_writes_is_its_own() -> None:
    # It writes no model: those are put into the folder, which all read, by `models pull` of root.
    assert settings(UNIT)["UMask"] == ["0077"]


@pytest.mark.needs("systemd-analyze")
@pytest.mark.parametrize("unit", [UNIT, TEMPLATE], ids=lambda path: path.name)
def test_exposure_stays_small(unit: Path) -> None:
    command = ["systemd-analyze", "security", "--offline=true", f"--threshold={LARGEST_EXPOSURE}"]
    done = subprocess.run([*command, unit], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
