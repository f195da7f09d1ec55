"""The timestamp of signatures over a restart: boards without a clock, steps of the clock, damaged files."""

from __future__ import annotations

import errno
import logging
import os
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from companion.host.state_folder import state_folder
from companion.vehicle.framing import Frame, Framer, pack_frame
from companion.vehicle.kept_timestamp import FILE_NAME, LATEST, ONE_MINUTE, KeptTimestamp, timestamp_now
from companion.vehicle.signing import FrameSigner

KEY = bytes(range(32))
YEAR_1970_S = 20.0
SetClock = Callable[[float], None]


@pytest.fixture
def set_clock(monkeypatch: pytest.MonkeyPatch) -> SetClock:
    return lambda now_s: monkeypatch.setattr(time, "time", lambda: now_s)


def signed(signer: FrameSigner, component: int = 191) -> Frame:
    frame = pack_frame(0, bytes(9), system_id=1, component_id=component, sequence=0)
    (found,) = Framer().feed(signer.signed(frame), datagram=True)
    return found


def timestamp_of(frame: Frame) -> int:
    return int.from_bytes(frame.raw[-12:-6], "little")


def kept_in(folder: Path) -> int:
    return int((folder / FILE_NAME).read_text())


def test_signing_goes_on_after_a_restart_without_a_clock(
    tmp_path: Path, set_clock: SetClock, caplog: pytest.LogCaptureFixture
) -> None:
    kept = KeptTimestamp(tmp_path)
    autopilot, before = FrameSigner(KEY), FrameSigner(KEY, kept)
    for _ in range(1000):
        assert autopilot.accepts(signed(before))
    kept.flush()
    set_clock(YEAR_1970_S)
    assert not autopilot.accepts(signed(FrameSigner(KEY)))
    caplog.clear()
    assert autopilot.accepts(signed(FrameSigner(KEY, KeptTimestamp(tmp_path))))
    assert not caplog.records


def test_an_autopilot_of_that_time_is_not_late_after_a_start(tmp_path: Path, set_clock: SetClock) -> None:
    autopilot, kept = FrameSigner(KEY), KeptTimestamp(tmp_path)
    autopilot.accepts(signed(FrameSigner(KEY, kept)))
    kept.flush()
    set_clock(YEAR_1970_S)
    assert FrameSigner(KEY, KeptTimestamp(tmp_path)).accepts(signed(autopilot, 1))


def test_the_newest_received_timestamp_is_kept_too(tmp_path: Path, set_clock: SetClock) -> None:
    autopilot = FrameSigner(KEY)
    theirs = signed(autopilot, 1)
    set_clock(YEAR_1970_S)
    kept = KeptTimestamp(tmp_path)
    assert FrameSigner(KEY, kept).accepts(theirs)
    kept.flush()
    assert KeptTimestamp(tmp_path).start > timestamp_of(theirs)


def test_the_file_is_ahead_of_all_used_and_written_once_a_minute(tmp_path: Path, set_clock: SetClock) -> None:
    kept, start_s = KeptTimestamp(tmp_path), time.time()
    signer = FrameSigner(KEY, kept)
    written = set()
    for second in range(600):
        set_clock(start_s + second)
        used = timestamp_of(signed(signer))
        kept.flush()
        assert used < kept_in(tmp_path) <= used + ONE_MINUTE
        written.add(kept_in(tmp_path))
    assert 10 <= len(written) <= 11


@pytest.mark.parametrize("step_s", [3600.0, -3600.0])
def test_a_step_of_the_clock_never_turns_timestamps_back(
    tmp_path: Path, set_clock: SetClock, step_s: float
) -> None:
    kept, autopilot, start_s = KeptTimestamp(tmp_path), FrameSigner(KEY), time.time()
    signer = FrameSigner(KEY, kept)
    for now_s in (start_s, start_s + step_s, start_s + 1.0):
        set_clock(now_s)
        assert autopilot.accepts(signed(signer))
        kept.flush()
    assert autopilot.accepts(signed(FrameSigner(KEY, KeptTimestamp(tmp_path))))


def test_a_start_goes_on_from_a_state_of_the_future(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    ahead = timestamp_now() + 3650 * 1440 * ONE_MINUTE
    (tmp_path / FILE_NAME).write_text(f"{ahead}\n")
    kept = KeptTimestamp(tmp_path)
    assert kept.start == ahead
    assert timestamp_of(signed(FrameSigner(KEY, kept))) == ahead + 1
    assert [record.levelno for record in caplog.records] == [logging.WARNING]


@pytest.mark.parametrize(
    "content",
    [b"", b"soon", b"-5", b"1" * 4000, b"\xff\xfe\x00", str(LATEST + 1).encode()],
    ids=["empty", "text", "negative", "long", "bytes", "last"],
)
def test_a_damaged_state_is_said_once_and_replaced(
    tmp_path: Path, content: bytes, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / FILE_NAME).write_bytes(content)
    kept = KeptTimestamp(tmp_path)
    assert kept.start == 0
    assert kept.problem
    used = timestamp_of(signed(FrameSigner(KEY, kept)))
    kept.flush()
    assert kept_in(tmp_path) > used
    assert len(caplog.records) == 1


def test_a_problem_ends_and_another_one_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / FILE_NAME).touch()
    kept = KeptTimestamp(tmp_path)
    damaged = kept.problem

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", full)
        kept.passed(timestamp_now())
        kept.flush()
        assert kept.problem not in ("", damaged)
        assert len(caplog.records) == 2
    kept.passed(timestamp_now() + 2 * ONE_MINUTE)
    kept.flush()
    assert kept.problem == ""


def test_a_folder_that_cannot_be_written_is_said_once(
    tmp_path: Path, set_clock: SetClock, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "file").touch()
    kept, start_s = KeptTimestamp(tmp_path / "file" / "state"), time.time()
    signer, autopilot = FrameSigner(KEY, kept), FrameSigner(KEY)
    for minute in range(5):
        set_clock(start_s + 60.0 * minute)
        assert autopilot.accepts(signed(signer))
        kept.flush()
    assert len({record.getMessage() for record in caplog.records}) == len(caplog.records) == 2  # read, write


def test_a_problem_ends_where_another_program_has_written(tmp_path: Path) -> None:
    (tmp_path / FILE_NAME).touch()
    now = timestamp_now()
    kept, other = KeptTimestamp(tmp_path), KeptTimestamp(tmp_path)
    assert kept.problem
    other.passed(now + ONE_MINUTE)
    other.flush()
    kept.passed(now)
    kept.flush()
    assert kept.problem == ""


def test_reading_and_writing_are_two_problems(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refused(*_: object, **__: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "open", refused)
    monkeypatch.setattr(os, "replace", refused)
    kept = KeptTimestamp(tmp_path)
    before = kept.problem
    for minute in (0, 2):
        kept.passed(timestamp_now() + minute * ONE_MINUTE)
        kept.flush()
    assert kept.problem not in ("", before)
    assert len(caplog.records) == 2


def test_a_clock_after_2100_leaves_timestamps_to_go_on(tmp_path: Path, set_clock: SetClock) -> None:
    set_clock(9e9)
    signer, autopilot = FrameSigner(KEY, KeptTimestamp(tmp_path)), FrameSigner(KEY)
    assert all(autopilot.accepts(signed(signer)) for _ in range(100))


def test_two_programs_keep_the_newer_timestamp(tmp_path: Path) -> None:
    now = timestamp_now()
    one, other = KeptTimestamp(tmp_path), KeptTimestamp(tmp_path)
    one.passed(now + ONE_MINUTE)
    one.flush()
    other.passed(now)
    other.flush()
    assert kept_in(tmp_path) == now + 2 * ONE_MINUTE
    assert [each.name for each in tmp_path.iterdir()] == [FILE_NAME]


def test_state_folder_is_the_units_else_the_users(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/companion:/var/lib/companion/models")
    assert state_folder() == Path("/var/lib/companion")
    monkeypatch.delenv("STATE_DIRECTORY")
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    assert state_folder() == tmp_path / "companion"
    monkeypatch.setenv("XDG_STATE_HOME", "relative")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert state_folder() == tmp_path / ".local" / "state" / "companion"
