"""The lines of consoles, kept in a file that all consoles of a user share."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from companion.operator.command_history import KEPT_LINES, CommandHistory, history_file


def test_file_is_private_and_shared(tmp_path: Path) -> None:
    path = tmp_path / "state/companion/console_history"
    first, second = CommandHistory(path), CommandHistory(path)
    assert first.lines() == []
    for history, line in ((first, "takeoff 3"), (second, "hold"), (first, "hold"), (first, "land")):
        history.add(line)
    assert first.lines() == second.lines() == ["takeoff 3", "hold", "land"]
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700
    path.chmod(0o644)
    first.add("rtl")
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_file_stays_short_and_keeps_the_newest(tmp_path: Path) -> None:
    path = tmp_path / "history"
    path.write_text("".join(f"goto {number} {'x' * 200}\n" for number in range(2000)))
    history = CommandHistory(path)
    history.add("hold")
    assert path.stat().st_size < 200_000
    assert history.lines()[-1] == "hold"
    assert 100 < len(history.lines()) <= KEPT_LINES
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert os.listdir(tmp_path) == ["history"]


def test_secrets_and_control_characters_are_not_kept(tmp_path: Path) -> None:
    path = tmp_path / "history"
    history = CommandHistory(path)
    history.add("ask look at rtsp://anna:geheim@camera/1")
    assert "geheim" not in path.read_text()
    path.write_bytes(b"hold\n\x1b]0;x\x07\n\xff\nland\nno end")
    assert history.lines()[0] == "hold"
    assert all(line.isprintable() for line in history.lines())


def test_without_a_file_the_lines_are_those_of_this_console(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    history = CommandHistory(tmp_path / "file/companion/history")
    with pytest.raises(OSError, match="file"):
        history.add("hold")
    assert history.lines() == ["hold"]
    CommandHistory(Path("/dev/null")).add("hold")  # its mode is left alone
    assert stat.S_IMODE(os.stat("/dev/null").st_mode) == 0o666


@pytest.mark.parametrize("foreign", ["home", "home/console_history"])
def test_root_writes_nothing_in_the_place_of_another_user(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, foreign: str
) -> None:
    (tmp_path / "home").mkdir()
    (tmp_path / "elsewhere").touch(0o644)
    path = tmp_path / "home/console_history"
    path.symlink_to(tmp_path / "elsewhere")
    lstat = Path.lstat

    def other(each: Path) -> os.stat_result:
        uid = 65534 if each == tmp_path / foreign else 0
        found = list(lstat(each))
        return os.stat_result([*found[:4], uid, *found[5:]])

    monkeypatch.setattr(Path, "lstat", other)
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    history = CommandHistory(path)
    with pytest.raises(PermissionError, match="another user"):
        history.add("hold")
    about = (tmp_path / "elsewhere").stat()
    assert (about.st_size, stat.S_IMODE(about.st_mode)) == (0, 0o644)


def test_history_is_kept_where_the_root_folder_is_nobodys(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lstat = Path.lstat

    def of_nobody(each: Path) -> os.stat_result:
        found = list(lstat(each))
        return os.stat_result([*found[:4], 65534, *found[5:]])

    monkeypatch.setattr(Path, "lstat", of_nobody)
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    CommandHistory(tmp_path / "history").add("hold")
    assert CommandHistory(tmp_path / "history").lines() == ["hold"]


def test_cut_line_is_no_command(tmp_path: Path) -> None:
    path = tmp_path / "history"
    path.write_text("".join(f"goto {number} {'ä' * 4000}\n" for number in range(60)))
    assert all(line.startswith("goto ") for line in CommandHistory(path).lines())


def test_file_is_utf_8_whatever_the_locale_is(tmp_path: Path) -> None:
    program = (
        "import sys; from pathlib import Path; from companion.operator import command_history as h; "
        "h._LONGEST_FILE = 60; c = h.CommandHistory(Path(sys.argv[1])); "
        "[c.add(f'ask \\u8eca {n:03}') for n in range(20)]"
    )
    environment = {**os.environ, "LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    path = tmp_path / "history"
    subprocess.run([sys.executable, "-c", program, path], env=environment, check=True, timeout=60)
    lines = path.read_bytes().decode().splitlines()
    assert lines == [f"ask 車 {number:03}" for number in range(20)][-len(lines) :]
    assert 1 < len(lines) < 10


def test_place_is_that_of_xdg(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    assert history_file() == tmp_path / "state/companion/console_history"
    monkeypatch.setenv("XDG_STATE_HOME", "state")
    assert history_file() == tmp_path / ".local/state/companion/console_history"
    monkeypatch.delenv("XDG_STATE_HOME")
    assert history_file() == tmp_path / ".local/state/companion/console_history"
