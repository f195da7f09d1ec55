"""A live source: the newest frame wins, a lost capture is reopened, events are logged once."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable

import numpy as np
import pytest

from tests.vision.network_streams import is_grey, wait_for_frame
from vision.sources.capture import Capture, CaptureError, RawFrame
from vision.sources.latest import LatestSource
from vision.sources.source import EndOfStream, SourceError, SourceSettings

pytestmark = pytest.mark.realtime

QUICK = SourceSettings(open_timeout_s=20.0, read_timeout_s=0.2, retry_min_s=0.01, retry_max_s=0.04)
NOBODY = "nobody there"


class ScriptedFeed(Capture):
    """Delivers its script: a number (that grey), an exception, None (no data)."""

    def __init__(self, script: list[int | Exception | None], gate: threading.Event | None = None) -> None:
        self.script = script
        self.gate = gate
        self.closed = 0

    def read(self, timeout_s: float) -> RawFrame | None:
        if not self.script:
            time.sleep(min(timeout_s, 0.02))
            return None
        step = self.script.pop(0)
        if isinstance(step, Exception):
            if self.gate is not None:
                self.gate.wait(30)
            raise step
        if step is None:
            time.sleep(min(timeout_s, 0.02))
            return None
        return RawFrame(np.full((2, 2, 3), step, np.uint8))

    def close(self) -> None:
        self.closed += 1


def opener(*feeds: Capture | Exception) -> Callable[[], Capture]:
    remaining = list(feeds)

    def open_capture() -> Capture:
        capture = remaining.pop(0) if remaining else CaptureError(NOBODY)
        if isinstance(capture, Exception):
            raise capture
        return capture

    return open_capture


def test_lost_capture_is_reopened_and_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("WARNING")
    gate = threading.Event()
    first = ScriptedFeed([1, CaptureError("unplugged")], gate)
    second = ScriptedFeed([2])
    with LatestSource(
        "camera", opener(first, CaptureError("no"), CaptureError("no"), second), QUICK
    ) as source:
        wait_for_frame(source, is_grey(1))
        gate.set()
        frame = wait_for_frame(source, is_grey(2))
        assert frame.sequence == 1
        assert source.statistics.reopened == 1
    lines = [record.getMessage() for record in caplog.records]
    assert lines[0].startswith("camera: lost: ")
    assert "unplugged" in lines[0]
    assert lines[1].startswith("camera: recovered ")
    assert len(lines) == 2
    assert first.closed == second.closed == 1


def test_silence_is_a_loss(caplog: pytest.LogCaptureFixture) -> None:
    with LatestSource("camera", opener(ScriptedFeed([1]), ScriptedFeed([2])), QUICK) as source:
        wait_for_frame(source, is_grey(1))
        wait_for_frame(source, is_grey(2))
    assert re.search(r"camera: lost: .*data for \d", caplog.text)


def test_retry_pause_doubles_up_to_its_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    pauses: list[float] = []
    enough = threading.Event()

    class Watched(threading.Event):
        def wait(self, timeout: float | None = None) -> bool:
            if timeout is not None and not self.is_set():
                pauses.append(timeout)
                if len(pauses) >= 6:
                    enough.set()
            return super().wait(0.001)

    gate = threading.Event()
    settings = SourceSettings(retry_min_s=1.0, retry_max_s=5.0)
    source = LatestSource("camera", opener(ScriptedFeed([1, CaptureError("gone")], gate)), settings)
    source._stop = Watched()
    gate.set()
    assert enough.wait(20)
    source.close()
    assert pauses[:5] == [1.0, 2.0, 4.0, 5.0, 5.0]


def test_source_that_never_opens_names_cause_and_action() -> None:
    settings, advice = SourceSettings(open_timeout_s=0.2, retry_min_s=0.02), "is it on?"
    with pytest.raises(SourceError) as caught:
        LatestSource("camera", opener(), settings, advice=advice)
    assert str(caught.value).startswith("camera: no ")
    assert str(caught.value).endswith(f"0.2 s: {NOBODY}; {advice}")


def test_permanent_error_is_raised_at_once() -> None:
    denied = SourceError("no permission")
    with pytest.raises(SourceError, match=f"camera: {denied}"):
        LatestSource("camera", opener(denied), SourceSettings(open_timeout_s=600.0))


def test_unexpected_error_is_raised_in_the_reader() -> None:
    gate = threading.Event()
    source = LatestSource("camera", opener(ScriptedFeed([1, ZeroDivisionError("a bug")], gate)), QUICK)
    with source:
        wait_for_frame(source, is_grey(1))
        gate.set()
        with pytest.raises(ZeroDivisionError, match="a bug"):
            wait_for_frame(source, is_grey(2))


def test_without_reopening_the_end_comes_after_the_last_frame() -> None:
    capture = ScriptedFeed([1, 2, EndOfStream()])
    with LatestSource("pipe", opener(capture), QUICK, reopen=False) as source:
        assert wait_for_frame(source, is_grey(2)).sequence == 1
        with pytest.raises(EndOfStream):
            source.read(20.0)
        with pytest.raises(EndOfStream):
            source.read(20.0)


def test_without_reopening_a_loss_is_an_error() -> None:
    gate = threading.Event()
    capture = ScriptedFeed([1, CaptureError("a broken frame")], gate)
    with LatestSource("pipe", opener(capture), QUICK, reopen=False) as source:
        wait_for_frame(source, is_grey(1))
        gate.set()
        with pytest.raises(SourceError, match="pipe: a broken frame"):
            source.read(20.0)


def test_each_frame_is_returned_once_then_none() -> None:
    settings = SourceSettings(read_timeout_s=60.0)
    with LatestSource("camera", opener(ScriptedFeed([7])), settings) as source:
        assert source.read(20.0) is not None
        assert source.read(0.01) is None


def test_close_wakes_a_reader_that_waits() -> None:
    source = LatestSource("camera", opener(ScriptedFeed([7])), SourceSettings(read_timeout_s=60.0))
    source.read(20.0)
    ended = threading.Event()

    def wait() -> None:
        with pytest.raises(EndOfStream):
            source.read(60.0)
        ended.set()

    reader = threading.Thread(target=wait, daemon=True)
    reader.start()
    source.close()
    assert ended.wait(20)


def test_overwritten_frames_count_as_dropped() -> None:
    class Skipping(ScriptedFeed):
        def read(self, timeout_s: float) -> RawFrame | None:
            raw = super().read(timeout_s)
            return None if raw is None else RawFrame(raw.image, skipped=4)

    with LatestSource("shared", opener(Skipping([1])), QUICK) as source:
        assert wait_for_frame(source, is_grey(1)).sequence == 4
        assert source.statistics.dropped == 4
