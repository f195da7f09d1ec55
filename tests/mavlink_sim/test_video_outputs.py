"""Frames at the outputs, read by this project's sources, FFmpeg and plain sockets."""

from __future__ import annotations

import http.client
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from mavlink_sim.camera.mjpeg_output import MAX_CLIENTS, MjpegOutput
from mavlink_sim.camera.newest_frame import NewestFrame
from mavlink_sim.camera.pipe_output import PipeOutput
from mavlink_sim.camera.video_outputs import FrameOutput, open_output
from mavlink_sim.testing import free_port
from vision.frame import Frame
from vision.sources import open_source
from vision.sources.source import SourceSettings

pytestmark = pytest.mark.realtime

DEADLINE_S = 30.0
SIZE = (160, 120)
SETTINGS = SourceSettings(width=SIZE[0], height=SIZE[1], open_timeout_s=20.0, read_timeout_s=20.0)


def image(number: int) -> Frame:
    """A blue image with a mark; the same each time, as streams are compared by colour."""
    image = np.full((SIZE[1], SIZE[0], 3), (200, 90, 20), np.uint8)
    image[40:80, 60:100] = (20, 220, 60)
    return Frame(
        image, 1_000_000_000 + number * 33_000_000, number, np.full(image.shape[:2], 3.0, np.float32)
    )


@pytest.fixture
def feeding() -> Iterator[Callable[[FrameOutput], None]]:
    """Writes images to an output, 60 a second, until the test ends."""
    stop = threading.Event()
    threads: list[threading.Thread] = []

    def feed(output: FrameOutput) -> None:
        def run() -> None:
            number = 0
            while not stop.wait(1 / 60):
                output.write(image(number))
                number += 1

        threads.append(threading.Thread(target=run, daemon=True))
        threads[-1].start()

    yield feed
    stop.set()
    for thread in threads:
        thread.join(10.0)


def until(condition: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not condition():
        assert time.monotonic() < deadline, f"not within {DEADLINE_S} s: {what}"
        time.sleep(0.01)


def first_frame(uri: str, settings: SourceSettings = SETTINGS) -> Frame:
    with open_source(uri, settings) as source:
        deadline = time.monotonic() + DEADLINE_S
        while time.monotonic() < deadline:
            frame = source.read(0.5)
            if frame is not None:
                return frame
    raise AssertionError(f"no frame from {uri}")


def matches_image(frame: Frame, tolerance: int) -> bool:
    wanted = image(0).image
    away = np.abs(frame.image[[10, 60], [10, 80]].astype(int) - wanted[[10, 60], [10, 80]])
    return frame.image.shape == wanted.shape and bool(away.max() <= tolerance)


def test_fifo_carries_complete_images(tmp_path: Path, feeding: Callable[[FrameOutput], None]) -> None:
    path = tmp_path / "camera"
    with closing(open_output(f"pipe:{path}", *SIZE, 30.0)) as output:
        feeding(output)
        for _ in range(2):  # a second reader after the first
            frame = first_frame(str(path), replace(SETTINGS, pixel_format="bgr24"))
            assert np.array_equal(frame.image, image(0).image)
    assert not path.exists()


def test_hanging_reader_delays_no_other(tmp_path: Path) -> None:
    path = tmp_path / "camera"
    os.mkfifo(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    output = PipeOutput(str(path))
    try:
        for number in range(400):
            output.write(image(number))
        until(lambda: output._thread.dropped > 300, "frames dropped for a reader that takes none")
    finally:
        output.close()
        os.close(reader)
    assert path.exists()


def test_non_fifo_path_refused_and_unchanged(tmp_path: Path) -> None:
    path = tmp_path / "notes"
    path.write_text("mine")
    with pytest.raises(ValueError, match="must be a FIFO"):
        open_output(f"pipe:{path}", *SIZE, 30.0)
    assert path.read_text() == "mine"


STDOUT_WRITER = """
import sys, numpy as np
from mavlink_sim.camera.video_outputs import open_output
from vision.frame import Frame
output = open_output("pipe:-", 64, 48, 30.0)
for number in range(100000):
    output.write(Frame(np.full((48, 64, 3), 7, np.uint8), number, number))
    if output._closed.wait(0.005):
        break
output.close()
print("ended", file=sys.stderr)
"""


def test_standard_output_carries_images_until_closed() -> None:
    with subprocess.Popen(
        [sys.executable, "-c", STDOUT_WRITER], stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as child:
        assert child.stdout is not None
        assert child.stderr is not None
        assert child.stdout.read(64 * 48 * 3) == b"\x07" * (64 * 48 * 3)
        child.stdout.close()
        assert b"ended" in child.stderr.read()
        assert child.wait(DEADLINE_S) == 0


def test_motion_jpeg_read_by_own_source_and_opencv(feeding: Callable[[FrameOutput], None]) -> None:
    with closing(MjpegOutput("127.0.0.1", 0)) as output:
        feeding(output)
        address = f"http://127.0.0.1:{output.port}/"
        assert matches_image(first_frame(address), 12)
        capture = cv2.VideoCapture(address, cv2.CAP_FFMPEG)
        try:
            done, image = capture.read()
        finally:
            capture.release()
        assert done
        assert matches_image(Frame(np.asarray(image, np.uint8), 0, 0), 12)


def test_snapshot_is_one_image_other_paths_404(feeding: Callable[[FrameOutput], None]) -> None:
    with closing(MjpegOutput("127.0.0.1", 0)) as output:
        feeding(output)
        connection = http.client.HTTPConnection("127.0.0.1", output.port, timeout=DEADLINE_S)
        with closing(connection):
            connection.request("GET", "/snapshot.jpg")
            answer = connection.getresponse()
            assert answer.status == 200
            assert int(answer.headers["X-Captured-Ns"]) >= 1_000_000_000
            image = cv2.imdecode(np.frombuffer(answer.read(), np.uint8), cv2.IMREAD_COLOR)
            assert matches_image(Frame(np.asarray(image, np.uint8), 0, 0), 12)
        with closing(http.client.HTTPConnection("127.0.0.1", output.port, timeout=DEADLINE_S)) as connection:
            connection.request("GET", "/passwords")
            assert connection.getresponse().status == 404


def test_stalled_client_does_not_stop_others(feeding: Callable[[FrameOutput], None]) -> None:
    with closing(MjpegOutput("127.0.0.1", 0)) as output:
        feeding(output)
        stuck = []
        for _ in range(3):
            client = socket.create_connection(("127.0.0.1", output.port), timeout=DEADLINE_S)
            client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            client.sendall(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")
            stuck.append(client)
        until(lambda: output.clients == 3, "three clients served")
        before = output.number
        until(lambda: output.number > before + 20, "images made while three clients hang")
        assert matches_image(first_frame(f"http://127.0.0.1:{output.port}/"), 12)
        for client in stuck:
            client.close()
        until(lambda: output.clients == 0, "the clients counted out again")


def test_too_many_clients_refused(feeding: Callable[[FrameOutput], None]) -> None:
    with closing(MjpegOutput("127.0.0.1", 0)) as output:
        feeding(output)
        clients = [socket.create_connection(("127.0.0.1", output.port)) for _ in range(MAX_CLIENTS)]
        for client in clients:
            client.sendall(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")
        until(lambda: output.clients == MAX_CLIENTS, "all places taken")
        with closing(http.client.HTTPConnection("127.0.0.1", output.port, timeout=DEADLINE_S)) as connection:
            connection.request("GET", "/")
            assert connection.getresponse().status == 503
        for client in clients:
            client.close()


def test_no_encoding_without_clients() -> None:
    with closing(MjpegOutput("127.0.0.1", 0)) as output:
        for number in range(10):
            output.write(image(number))
        assert output.number == 0


def test_a_taken_port_is_an_error_at_once() -> None:
    with closing(MjpegOutput("127.0.0.1", 0)) as output, pytest.raises(OSError, match="in use"):
        open_output(f"http://127.0.0.1:{output.port}", *SIZE, 30.0)


def test_h264_in_rtp_decoded_by_own_source(feeding: Callable[[FrameOutput], None]) -> None:
    pytest.importorskip("av", reason="PyAV encodes the stream; it is not installed")
    port = free_port()
    with closing(open_output(f"rtp://127.0.0.1:{port}", *SIZE, 10.0)) as output:
        feeding(output)
        with open_source(f"udp://127.0.0.1:{port}?format=rtp-h264", SETTINGS) as source:

            def good() -> bool:
                frame = source.read(0.5)
                return frame is not None and matches_image(frame, 25)

            until(good, "an image that looks right")


def test_rtp_packets_are_h264_of_payload_type_96_on_90_khz_clock() -> None:
    pytest.importorskip("av", reason="PyAV encodes the stream; it is not installed")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver:
        receiver.bind(("127.0.0.1", 0))
        receiver.settimeout(DEADLINE_S)
        port = receiver.getsockname()[1]
        with closing(open_output(f"rtp://127.0.0.1:{port}", *SIZE, 30.0)) as output:
            stamps, kinds = [], set()
            for number in range(3):
                output.write(image(number))
                while True:
                    packet = receiver.recv(65536)
                    assert packet[0] >> 6 == 2  # RTP's version, RFC 3550
                    assert packet[1] & 0x7F == 96
                    assert len(packet) <= 1400
                    kind = packet[12] & 0x1F
                    kinds.add(packet[13] & 0x1F if kind == 28 else kind)  # FU-A, RFC 6184
                    if packet[1] & 0x80:  # the last of an image
                        stamps.append(int.from_bytes(packet[4:8], "big"))
                        break
    # The first image brings its parameter sets (in an aggregate, or alone) and is a key frame.
    assert kinds & {7, 24}
    assert [(b - a) % 2**32 for a, b in pairwise(stamps)] == [2970, 2970]


def test_h264_of_odd_sides_is_refused() -> None:
    pytest.importorskip("av", reason="PyAV encodes the stream; it is not installed")
    with pytest.raises(ValueError, match="161x120"):
        open_output("rtp://127.0.0.1:5600", 161, 120, 30.0)


def test_newest_frame_wins_with_slow_consumer() -> None:
    taken: list[int] = []
    go = threading.Event()

    def take(frame: Frame) -> None:
        taken.append(frame.sequence)
        go.wait(DEADLINE_S)

    thread = NewestFrame("slow", take)
    thread.put(image(0))
    until(lambda: taken == [0], "the first frame taken")
    for number in range(1, 50):
        thread.put(image(number))
    go.set()
    until(lambda: len(taken) == 2, "the next frame taken")
    thread.close()
    assert taken == [0, 49]
    assert thread.dropped == 48
