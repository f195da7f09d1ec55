"""The recorder while nothing can be written: it leaves space, says so once, and goes on."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event

import pytest
import zenoh

from companion.bus.child_client import PAUSED
from companion.recording import RECORDED, RECORDING, RecordingError, recorder
from companion.recording import files as recording_files
from companion.recording.files import KEPT_FREE_BYTES, RecordingReader
from companion.recording.recorder import RecorderOptions, record
from companion.settings import ZenohSection
from tests.companion.recording.lockstep_recording import new_writer

FULL, FREE = KEPT_FREE_BYTES - 1, KEPT_FREE_BYTES


def options(folder: Path) -> RecorderOptions:
    return RecorderOptions(
        *(ZenohSection(), "vehicle1", str(folder)),
        images=False,
        depth=False,
        clouds=False,
        max_file_mb=100,
        max_total_mb=1000,
    )


@pytest.fixture(autouse=True)
def session(monkeypatch: pytest.MonkeyPatch) -> None:
    """A session alone, without delays."""

    @contextmanager
    def alone(*_: object, **__: object) -> Iterator[zenoh.Session]:
        config = zenoh.Config()
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("listen/endpoints", "[]")
        with zenoh.open(config) as opened:
            yield opened

    monkeypatch.setattr(recorder, "open_client", alone)
    monkeypatch.setattr(recorder, "RETRY_S", 0.01)
    monkeypatch.setattr(recorder, "FLUSH_S", 0.0)
    monkeypatch.setattr(recorder, "lower_priority", lambda nicer: None)


class Disk:
    """Becomes full when recording begins, and free at the second complaint."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.free, self.said, self.ending, self.asked = FULL, list[str](), Event(), 0
        monkeypatch.setattr(recording_files, "free_bytes", self.bytes_of)

    def bytes_of(self, directory: Path) -> int:
        self.asked += 1
        if self.asked % 4 == 0:
            self.free = FREE
        return self.free

    def say(self, text: str) -> None:
        self.said.append(text)
        if text.startswith(RECORDING):
            self.free = FULL
            if sum(line.startswith(RECORDING) for line in self.said) == 3:
                self.free = FREE
                self.ending.set()


def test_recorder_pauses_on_a_full_disk_and_goes_on(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    disk = Disk(monkeypatch)
    record(options(tmp_path), disk.ending, disk.say, patient=True)
    begins = [
        next(word for word in (RECORDING, RECORDED, PAUSED) if line.startswith(word)) for line in disk.said
    ]
    # However often it was tried, each pause is said once.
    assert begins == [PAUSED, RECORDING, PAUSED, RECORDING, PAUSED, RECORDING, RECORDED]
    files = sorted(tmp_path.glob("*.mcap"))
    assert len(files) == 3
    for file in files:
        reader = RecordingReader(file)
        list(reader.messages())
        assert (reader.ended, reader.problems) == (True, [])


def test_recorder_waits_for_its_folder(tmp_path: Path) -> None:
    """Such as the stick that is not there yet."""
    said: list[str] = []
    ending, where = Event(), tmp_path / "stick"
    where.write_text("no folder")

    def say(text: str) -> None:
        said.append(text)
        if text.startswith(PAUSED):
            where.unlink()
        else:
            ending.set()

    record(options(where), ending, say, patient=True)
    assert [line.split(":")[0] for line in said if line.startswith(PAUSED)] == ["paused"]
    assert said[-1].startswith(RECORDED)
    assert len(list(where.glob("*.mcap"))) == 1


def test_impatient_recorder_says_why_it_cannot_begin(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(RecordingError, match=re.escape(str(tmp_path / "file"))):
        record(options(tmp_path / "file"), Event(), lambda text: None)


def test_writer_leaves_the_last_space(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    writer = new_writer(tmp_path)
    monkeypatch.setattr(recording_files, "free_bytes", lambda directory: FULL)
    with pytest.raises(RecordingError, match="200 MB"):
        writer.flush()
    reader = RecordingReader(writer.path)
    list(reader.messages())
    assert reader.ended
    with pytest.raises(RecordingError, match="200 MB"):
        new_writer(tmp_path)
