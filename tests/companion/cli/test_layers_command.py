"""The files of settings, as commands read them: which, in what order, and `describe settings --origin`."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

from companion.settings import Settings
from companion.settings.layers import SYSTEM_VARIABLE
from companion.settings.reading import load_settings
from tests.companion.command_line import companion_here


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path, Path]:
    """The files of system and user, and the working folder."""
    system, user = tmp_path / "etc.toml", tmp_path / "home" / "companion" / "companion.toml"
    monkeypatch.setenv(SYSTEM_VARIABLE, str(system))
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "home"))
    user.parent.mkdir(parents=True)
    system.write_text("[guidance]\nmax_altitude_m = 60.0\n[vehicle]\nname = 'kestrel'\n")
    user.write_text("# mine\n[guidance]\nmax_altitude_m = 40.0\n")
    work = tmp_path / "work"
    work.mkdir()
    return system, user, work


def origins(work: Path, *words: str) -> dict[str, Any]:
    done = companion_here("describe", "settings", "--origin", "--json", *words, cwd=work)
    assert (done.returncode, done.stderr) == (0, "")
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def test_origin_names_files_lines_and_what_was_overridden(files: tuple[Path, Path, Path]) -> None:
    system, user, work = files
    (work / "own.toml").write_text("[guidance]\nmax_altitude_m = 20.0\n")
    found = origins(work, "--config", "own.toml", "--guidance-max-altitude-m", "25")
    assert found["files"] == [str(system), str(user), "own.toml"]
    name, altitude = found["settings"]
    assert (name["key"], name["value"], name["default"]) == ("vehicle.name", "kestrel", "vehicle1")
    assert (name["name"], name["line"], name["overrides"]) == (str(system), 4, [])
    assert (altitude["value"], altitude["kind"]) == (25.0, "flag")
    assert [(each["value"], each["name"], each["line"]) for each in altitude["overrides"]] == [
        (20.0, "own.toml", 2),
        (40.0, str(user), 3),
        (60.0, str(system), 2),
    ]


def test_origin_is_a_file_with_what_differs(files: tuple[Path, Path, Path], tmp_path: Path) -> None:
    system, user, work = files
    done = companion_here("describe", "settings", "--origin", "--detector-threads", "3", cwd=work)
    assert done.returncode == 0
    assert all(str(path) in done.stdout for path in (system, user))
    printed = tmp_path / "printed.toml"
    printed.write_text(done.stdout)
    values = {
        "guidance": {"max_altitude_m": 40.0},
        "vehicle": {"name": "kestrel"},
        "detector": {"threads": 3},
    }
    assert load_settings(printed, environment={}) == Settings.model_validate(values)


def test_origin_hides_secrets(files: tuple[Path, Path, Path]) -> None:
    _, _, work = files
    for words in ((), ("--json",)):
        uri = "rtsp://me:sesame@10.0.0.9/front"
        done = companion_here("describe", "settings", "--origin", *words, "--source", uri, cwd=work)
        assert "10.0.0.9" in done.stdout
        assert "sesame" not in done.stdout + done.stderr.replace("--source", "")


def test_origin_of_defaults_is_empty(tmp_path: Path) -> None:
    assert origins(tmp_path) == {"files": [], "settings": []}


@pytest.mark.parametrize(
    "words", [("commands", "--origin"), ("settings", "--check", "--origin"), ("settings", "--json")]
)
def test_options_that_do_not_fit_are_refused(words: tuple[str, ...], tmp_path: Path) -> None:
    done = companion_here("describe", *words, cwd=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1


def test_check_is_of_the_merged_layers(files: tuple[Path, Path, Path]) -> None:
    system, _user, work = files
    check = ("describe", "settings", "--check", "--source", "none")
    assert companion_here(*check, cwd=work).returncode == 0
    with system.open("a") as file:
        file.write("url = 'pigeon://'\n")
    done = companion_here(*check, cwd=work)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "vehicle.url" in line
    assert f"{system}, line 5" in line
    (work / "own.toml").write_text("[vehicle]\nurl = 'none'\n")
    assert companion_here(*check, "--config", "own.toml", cwd=work).returncode == 0


def test_missing_device_is_said_with_its_line(files: tuple[Path, Path, Path]) -> None:
    _, user, work = files
    with user.open("a") as file:
        file.write("[vehicle]\nurl = 'serial:///dev/ttyNone:57600'\nsigning_key_file = 'none.key'\n")
    check = ("describe", "settings", "--check", "--source", "none")
    done = companion_here(*check, cwd=work)
    assert done.returncode == 2
    assert [f"{user}, line 6" in line for line in done.stderr.splitlines()] == [True]
    done = companion_here(*check, "--vehicle-signing-key-file", "none", cwd=work)
    assert done.returncode == 0
    assert [f"{user}, line 5" in line for line in done.stderr.splitlines()] == [True]


def test_former_default_file_is_named_in_one_line(files: tuple[Path, Path, Path]) -> None:
    _, user, work = files
    (work / "companion.toml").write_text("[vehicle]\nname = 'stray'\n")
    done = companion_here("describe", "settings", cwd=work)
    assert "stray" not in done.stdout
    (line,) = done.stderr.splitlines()
    assert str(work / "companion.toml") in line
    assert "--config companion.toml" in line
    assert str(user) in line
    done = companion_here("describe", "settings", "--config", "companion.toml", cwd=work)
    assert "stray" in done.stdout
    assert done.stderr == ""


def test_play_reads_only_the_file_that_it_is_given(files: tuple[Path, Path, Path]) -> None:
    _, user, work = files
    user.write_text("[detector]\niou = 3\n")
    words = ("play", "--source", "a.mp4")  # refused after the settings are read
    assert "iou" not in companion_here(*words, cwd=work).stderr
    assert "iou" in companion_here(*words, "--config", user, cwd=work).stderr


def test_no_file_at_all_is_read_with_the_null_device(files: tuple[Path, Path, Path]) -> None:
    assert origins(files[2], "--config", os.devnull) == {"files": [], "settings": []}


def test_doctor_names_the_files(files: tuple[Path, Path, Path]) -> None:
    system, user, work = files
    (work / "companion.toml").touch()
    quiet = ("--source", "none", "--vehicle-url", "none", "--dashboard-listen", "")
    done = companion_here("doctor", "--json", *quiet, cwd=work)
    assert done.stderr == ""
    own = [check for check in json.loads(done.stdout) if check["name"] == "settings files"]
    assert [check["verdict"] for check in own] == ["warning", "ok"]
    assert str(work / "companion.toml") in own[0]["found"]
    assert "--config" in own[0]["advice"]
    assert own[1]["found"].index(str(system)) < own[1]["found"].index(str(user))
