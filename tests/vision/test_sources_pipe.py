"""Pipes with real bytes: FIFOs and standard input, raw, YUV4MPEG2 and MJPEG."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from tests.vision.network_streams import is_grey, read_until_logged, wait_for_frame
from vision.sources import EndOfStream, SourceError, SourceSettings, open_source

pytestmark = pytest.mark.realtime

RAW = SourceSettings(width=8, height=6, pixel_format="bgr24", retry_min_s=0.05, retry_max_s=0.1)
EVERY = SourceSettings(width=8, height=6, pixel_format="bgr24", every_frame=True)


def raw_frame(value: int) -> bytes:
    return bytes([value]) * (8 * 6 * 3)


def fifo(tmp_path: Path) -> Path:
    path = tmp_path / "camera.fifo"
    os.mkfifo(path)
    return path


def write_in_thread(path: Path, write: Callable[[int], object]) -> threading.Thread:
    def run() -> None:
        descriptor = os.open(path, os.O_WRONLY)
        try:
            write(descriptor)
        finally:
            os.close(descriptor)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread


def test_fifo_every_frame_in_order_until_the_writer_closes(tmp_path: Path) -> None:
    path = fifo(tmp_path)
    writer = write_in_thread(path, lambda out: [os.write(out, raw_frame(i)) for i in range(40)] and None)
    with open_source(str(path), EVERY) as source:
        assert not source.live
        frames = list(source)
    writer.join()
    assert [int(frame.image[0, 0, 0]) for frame in frames] == list(range(40))
    assert [frame.sequence for frame in frames] == list(range(40))
    stamps = [frame.captured_ns for frame in frames]
    assert stamps == sorted(stamps)
    assert stamps[-1] <= time.monotonic_ns()
    assert source.statistics.delivered == 40


def test_fifo_newest_frame_wins_and_drops_are_counted(tmp_path: Path) -> None:
    path = fifo(tmp_path)
    written = threading.Event()
    closing = threading.Event()

    def write(out: int) -> None:
        for value in range(50):
            os.write(out, raw_frame(value))
        written.set()
        closing.wait(30)

    writer = write_in_thread(path, write)
    with open_source(str(path), RAW) as source:
        assert source.live
        assert written.wait(20)
        assert wait_for_frame(source, is_grey(49)).sequence == 49
        assert source.statistics.delivered + source.statistics.dropped == 50
        assert source.read(0.01) is None
        closing.set()
    writer.join()


def test_fifo_recovers_with_a_new_writer(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO")
    path = fifo(tmp_path)
    first = write_in_thread(path, lambda out: os.write(out, raw_frame(1) + raw_frame(2)[:50]) and None)
    with open_source(str(path), RAW) as source:
        first.join()
        assert int(wait_for_frame(source).image[0, 0, 0]) == 1
        assert read_until_logged(source, caplog, "lost") == []
        second = write_in_thread(path, lambda out: os.write(out, raw_frame(3)) and None)
        frame = wait_for_frame(source)
        second.join()
        assert int(frame.image[0, 0, 0]) == 3
        assert source.statistics.reopened == 1
    lines = [record.getMessage() for record in caplog.records]
    assert sum("50 of 144 bytes" in line for line in lines) == 1
    assert sum("recovered after" in line for line in lines) == 1


def test_fifo_without_writer_times_out(tmp_path: Path) -> None:
    path = fifo(tmp_path)
    with pytest.raises(SourceError, match=r"camera\.fifo: .* 0\.3 s"):
        open_source(str(path), SourceSettings(open_timeout_s=0.3))


def test_a_slow_writer_of_a_fifo_is_not_cut_off(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = fifo(tmp_path)
    go_on = threading.Event()

    def write(out: int) -> None:
        os.write(out, raw_frame(1))
        go_on.wait(30)
        os.write(out, raw_frame(2))  # would fail with EPIPE if the reader had closed

    writer = write_in_thread(path, write)
    quick = SourceSettings(width=8, height=6, pixel_format="bgr24", read_timeout_s=0.2)
    with open_source(str(path), quick) as source:
        wait_for_frame(source)
        assert read_until_logged(source, caplog, "waiting") == []
        go_on.set()
        assert int(wait_for_frame(source).image[0, 0, 0]) == 2
        assert source.statistics.reopened == 0
    writer.join()


def test_read_returns_none_while_the_writer_is_late(tmp_path: Path) -> None:
    path = fifo(tmp_path)
    go_on = threading.Event()

    def write(out: int) -> None:
        os.write(out, raw_frame(1))
        go_on.wait(30)
        os.write(out, raw_frame(2))

    writer = write_in_thread(path, write)
    with open_source(str(path), EVERY) as source:
        assert source.read() is not None
        assert source.read(0.05) is None
        go_on.set()
        assert wait_for_frame(source).sequence == 1
        with pytest.raises(EndOfStream):
            source.read(10.0)
    writer.join()


@pytest.mark.parametrize("given_format", [None, "y4m"])
def test_yuv4mpeg2_is_recognised_by_its_first_bytes(tmp_path: Path, given_format: str | None) -> None:
    path = fifo(tmp_path)
    stream = b"YUV4MPEG2 W8 H6 F30:1 Cmono\n" + b"".join(
        b"FRAME\n" + bytes([i * 9]) * 48 for i in range(1, 6)
    )
    writer = write_in_thread(path, lambda out: [os.write(out, bytes([b])) for b in stream] and None)
    with open_source(str(path), SourceSettings(every_frame=True, pixel_format=given_format)) as source:
        assert len(list(source)) == 5
    writer.join()


def test_mjpeg_is_recognised_by_its_first_bytes(tmp_path: Path) -> None:
    path = fifo(tmp_path)
    image = cv2.imencode(".jpg", np.full((40, 60, 3), (0, 0, 200), np.uint8))[1].tobytes()
    writer = write_in_thread(path, lambda out: os.write(out, image * 4) and None)
    with open_source(str(path), SourceSettings(every_frame=True)) as source:
        frames = list(source)
    writer.join()
    assert [frame.image.shape for frame in frames] == [(40, 60, 3)] * 4


def test_unknown_bytes_require_format_and_size(tmp_path: Path) -> None:
    path = fifo(tmp_path)
    writer = write_in_thread(path, lambda out: os.write(out, b"\1\2\3\4" * 100) and None)
    with pytest.raises(SourceError, match=r"01 02 03.*pixel_format bgr24"):
        open_source(str(path), SourceSettings(every_frame=True))
    writer.join()


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        (SourceSettings(pixel_format="bgr24"), "width and height"),
        (SourceSettings(pixel_format="MJPG"), "a pipe carries bgr24"),
    ],
)
def test_invalid_pipe_settings_are_rejected(tmp_path: Path, settings: SourceSettings, words: str) -> None:
    with pytest.raises(SourceError, match=words):
        open_source(str(fifo(tmp_path)), settings)


READER = """
import json, sys
from vision.sources import SourceError, SourceSettings, open_source
try:
    with open_source("-", SourceSettings(**json.loads(sys.argv[1]))) as source:
        frames = [[frame.sequence, int(frame.image[0, 0, 0])] for frame in source]
        statistics = source.statistics
        print(json.dumps({"live": source.live, "frames": frames,
                          "counted": statistics.delivered + statistics.dropped}))
except SourceError as error:
    print(json.dumps({"error": str(error)}))
"""


def read_standard_input(settings: dict[str, object], **how: object) -> tuple[dict[str, object], str]:
    done = subprocess.run(
        [sys.executable, "-c", READER, json.dumps(settings)],
        capture_output=True,
        timeout=100,
        check=True,
        **how,  # type: ignore[call-overload]
    )
    return json.loads(done.stdout), done.stderr.decode()


RAW_WORDS = {"width": 8, "height": 6, "pixel_format": "bgr24"}


def test_stdin_every_frame_reports_a_partial_last_frame() -> None:
    stream = b"".join(raw_frame(i) for i in range(30)) + b"\0" * 10
    result, message = read_standard_input({**RAW_WORDS, "every_frame": True}, input=stream)
    assert result == {"live": False, "frames": [[i, i] for i in range(30)], "counted": 30}
    assert "10 of 144 bytes" in message


def test_piped_standard_input_is_live_until_the_writer_ends() -> None:
    stream = b"".join(raw_frame(i) for i in range(30))
    result, _ = read_standard_input(RAW_WORDS, input=stream)
    frames = result["frames"]
    assert isinstance(frames, list)
    assert result["live"] is True
    assert frames[-1] == [29, 29]
    assert result["counted"] == 30


def test_a_file_redirected_into_standard_input_is_read_whole(tmp_path: Path) -> None:
    path = tmp_path / "video.y4m"
    path.write_bytes(b"YUV4MPEG2 W8 H6 Cmono\n" + (b"FRAME\n" + bytes(48)) * 20)
    with path.open("rb") as file:
        result, _ = read_standard_input({}, stdin=file)
    assert result["live"] is False
    assert result["counted"] == 20


def test_empty_standard_input_is_a_one_line_error() -> None:
    result, message = read_standard_input({}, stdin=subprocess.DEVNULL)
    assert result.keys() == {"error"}
    assert re.match(r"standard input: .* first frame: .*no data", str(result["error"]))
    assert message == ""
