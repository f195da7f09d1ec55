"""The lines of consoles, kept in a file that all consoles of a user share."""

from __future__ import annotations

import os
import stat
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


def test_place_is_that_of_xdg(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    assert history_file() == tmp_path / "state/companion/console_history"
    monkeypatch.setenv("XDG_STATE_HOME", "state")
    assert history_file() == tmp_path / ".local/state/companion/console_history"
    monkeypatch.delenv("XDG_STATE_HOME")
    assert history_file() == tmp_path / ".local/state/companion/console_history"
