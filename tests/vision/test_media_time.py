"""Media time from stamps that jump, repeat, go back or start late: every frame, at its pace."""

from __future__ import annotations

import functools
import http.server
import itertools
import logging
import math
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.vision.stamped_video import write_stamped_video
from vision.sources import open_source
from vision.sources.capture import LONGEST_STEP_S, Capture, MediaTime, RawFrame
from vision.sources.latest import LatestSource
from vision.sources.source import EndOfStream, SourceSettings

INTERVAL_S = 0.04
FRAMES = 20
LATER_MS = 37_440_000  # 10.4 h: a 33-bit clock of MPEG-TS that wrapped, or a clock that was set
REGULAR = [40 * index for index in range(FRAMES)]

STAMPS_MS = {
    "regular": REGULAR,
    "one frame later": [stamp + LATER_MS * (index == 10) for index, stamp in enumerate(REGULAR)],
    "second half later": [stamp + LATER_MS * (index >= 10) for index, stamp in enumerate(REGULAR)],
    "second half earlier": [stamp + 60_000 * (index < 10) for index, stamp in enumerate(REGULAR)],
    "late start": [stamp + 5_000_000 for stamp in REGULAR],
    "repeated": [stamp // 200 * 200 for stamp in REGULAR],
    "all the same": [0] * FRAMES,
    "two exchanged": [*REGULAR[:8], REGULAR[9], REGULAR[8], *REGULAR[10:]],
}


@pytest.fixture(params=list(STAMPS_MS.values()), ids=list(STAMPS_MS))
def stamped(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return write_stamped_video(tmp_path / "stamped.mkv", request.param)


def check_times(media_s: list[float | None]) -> None:
    assert media_s == pytest.approx([index * INTERVAL_S for index in range(FRAMES)], abs=1.5 * INTERVAL_S)
    assert all(0.0 < after - before for before, after in itertools.pairwise(filter(None, media_s)))


def test_every_frame_of_a_file_advances_by_an_interval(
    stamped: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with open_source(str(stamped)) as source:
        check_times([frame.media_s for frame in source])
    assert not caplog.records


@pytest.mark.realtime
def test_a_file_in_real_time_has_all_frames_at_its_pace(
    stamped: Path, caplog: pytest.LogCaptureFixture
) -> None:
    seen: list[float | None] = []
    settings = SourceSettings(realtime=True, on_frame=lambda frame: seen.append(frame.media_s))
    began_s = time.monotonic()
    with open_source(str(stamped), settings) as source:
        list(source)
    check_times(seen)
    assert FRAMES * INTERVAL_S - 0.1 < time.monotonic() - began_s < 5.0
    assert not caplog.records


@contextmanager
def served(folder: Path) -> Iterator[str]:
    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            """Nothing."""

    with http.server.ThreadingHTTPServer(
        ("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder))
    ) as server:
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()
        thread.join()


@pytest.mark.realtime
def test_a_network_stream_has_all_frames_at_its_pace(stamped: Path) -> None:
    seen: list[float | None] = []
    arrived = threading.Event()

    def on_frame(frame: object) -> None:
        seen.append(getattr(frame, "media_s", None))
        if len(seen) == FRAMES:
            arrived.set()

    settings = SourceSettings(on_frame=on_frame, retry_min_s=5.0)
    with served(stamped.parent) as address, open_source(f"{address}/{stamped.name}", settings):
        assert arrived.wait(5.0)
        check_times(seen[:FRAMES])


def test_a_truncated_late_recording_names_its_own_number(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    stamps_ms = [stamp + 5_000_000 for stamp in REGULAR]
    path = write_stamped_video(tmp_path / "short.mkv", stamps_ms[:10], duration_ms=5_000_000 + 40 * FRAMES)
    with open_source(str(path)) as source:
        assert source.total_frames is None
        assert len(list(source)) == 10
    assert f"should have {FRAMES};" in caplog.text


class Stamped(Capture):
    """A capture of any kind, for example a plug-in's, with these stamps."""

    interval_s = INTERVAL_S

    def __init__(self, stamps_s: list[float]) -> None:
        self._stamps_s = iter(stamps_s)

    def read(self, timeout_s: float) -> RawFrame | None:
        try:
            return RawFrame(np.zeros((2, 2, 3), np.uint8), media_s=next(self._stamps_s))
        except StopIteration:
            raise EndOfStream from None

    def close(self) -> None:
        """Nothing stays open."""


@pytest.mark.realtime
def test_a_reopened_stream_continues_its_media_time() -> None:
    seen: list[float | None] = []
    arrived = threading.Event()

    def on_frame(frame: object) -> None:
        seen.append(getattr(frame, "media_s", None))
        if len(seen) == 6:
            arrived.set()

    settings = SourceSettings(on_frame=on_frame, retry_min_s=0.01)
    with LatestSource("stream", lambda: Stamped([9e9, 9e9 + 0.04, 9e9 + 0.08]), settings, paced=True):
        assert arrived.wait(5.0)
    assert seen[:6] == pytest.approx([index * INTERVAL_S for index in range(6)], abs=1e-5)


@pytest.mark.realtime
def test_a_long_wait_for_the_next_frame_is_logged(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    caplog.set_level(logging.INFO)
    slow = Stamped([0.0, 29.0])
    slow.interval_s = 10.0
    with LatestSource("slow", lambda: slow, SourceSettings(), reopen=False, paced=True) as source:
        assert source.read() is not None
        waiting: Callable[[], bool] = lambda: "due in 29 s" in caplog.text  # noqa: E731
        deadline_s = time.monotonic() + 5.0
        while not waiting() and time.monotonic() < deadline_s:
            source.read(0.05)
        assert waiting()


@given(st.lists(st.floats(), min_size=1, max_size=60), st.floats(0.001, 10.0))
def test_media_time_increases_in_bounded_steps(stamps_s: list[float], interval_s: float) -> None:
    clock = MediaTime()
    times_s = [clock.advance(stamp_s, interval_s) for stamp_s in stamps_s]
    longest_s = max(LONGEST_STEP_S, 3 * interval_s)
    assert 0.0 <= times_s[0] <= longest_s
    for before_s, after_s in itertools.pairwise(times_s):
        assert 0.0 < after_s - before_s <= longest_s * 1.001


@given(
    st.lists(st.floats(0.001, LONGEST_STEP_S - 0.001), min_size=1, max_size=40),
    st.floats(-1e6, 1e6),
    st.integers(0, 40),
    st.floats(-1e9, 1e9).filter(lambda jump_s: abs(jump_s) > 2 * LONGEST_STEP_S + 1.0),
)
def test_only_a_discontinuity_changes_the_steps(
    steps_s: list[float], start_s: float, at: int, jump_s: float
) -> None:
    clock = MediaTime()
    stamps_s = list(itertools.accumulate(steps_s, initial=start_s))
    jumped_s = [stamp_s + jump_s * (index > at) for index, stamp_s in enumerate(stamps_s)]
    times_s = [clock.advance(stamp_s, INTERVAL_S) for stamp_s in jumped_s]
    expected_s = [INTERVAL_S if index == at else step_s for index, step_s in enumerate(steps_s)]
    taken_s = [after_s - before_s for before_s, after_s in itertools.pairwise(times_s)]
    assert taken_s == pytest.approx(expected_s, abs=1e-5)
    assert all(math.isfinite(time_s) for time_s in times_s)


def test_a_video_that_states_an_implausible_rate_is_complete(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_stamped_video(tmp_path / "fast.mkv", [40 * index for index in range(12)], interval_ms=1)
    with open_source(str(path)) as source:
        assert len(list(source)) == 12
    assert "truncated" not in caplog.text
