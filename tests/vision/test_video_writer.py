"""Video files: real time is kept, errors are reported, and a browser plays them."""

from __future__ import annotations

import json
import queue
import re
import resource
import subprocess
import sys
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, ClassVar

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.programs import CHROMIUM
from vision import video_writer
from vision.video_writer import VideoWriter, VideoWriterError

SECOND = 1_000_000_000


def make_image(value: int, width: int = 64, height: int = 48) -> np.ndarray:
    return np.full((height, width, 3), value, np.uint8)


def frames_of(path: Path, rate_hz: float) -> list[float]:
    """The mean grey of each slot of the video."""
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    greys: list[float] = []
    while True:
        ok, image = capture.read()
        if not ok:
            return greys
        slot = round(capture.get(cv2.CAP_PROP_POS_MSEC) * rate_hz / 1000.0)
        greys += [greys[-1]] * (slot - len(greys)) if greys else []
        assert len(greys) == slot
        greys.append(float(image.mean()))


@pytest.fixture(params=["PyAV", "OpenCV"], autouse=True)
def encoder(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Every test with both encoders."""
    if request.param == "PyAV":
        pytest.importorskip("av", reason="PyAV is an optional extra")
    else:
        monkeypatch.setitem(sys.modules, "av", None)
    video_writer._pyav.cache_clear()
    yield str(request.param)
    video_writer._pyav.cache_clear()


def test_video_at_its_rate_has_every_image_once(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "new" / "video.webm"
    with VideoWriter(path, 64, 48, 20.0) as writer:
        for index in range(20):
            assert writer.write(make_image(index * 12), 5 * SECOND + index * SECOND // 20) == 1
        assert writer.duration_s == 1.0
    assert (writer.frames, writer.repeated, writer.dropped) == (20, 0, 0)
    greys = frames_of(path, 20.0)
    np.testing.assert_allclose(greys, [index * 12 for index in range(20)], atol=4)
    assert capfd.readouterr().err == ""  # the harmless line about tags is suppressed


def test_a_pause_is_filled_with_the_image_before_it(tmp_path: Path) -> None:
    path = tmp_path / "video.webm"
    with VideoWriter(path, 64, 48, 10.0) as writer:
        assert writer.write(make_image(40), 0) == 1
        assert writer.write(make_image(200), SECOND) == 10
    assert (writer.frames, writer.repeated) == (11, 9)
    greys = frames_of(path, 10.0)
    np.testing.assert_allclose(greys, [40] * 10 + [200], atol=4)


def test_empty_slots_are_not_encoded_by_pyav(tmp_path: Path, encoder: str) -> None:
    path = tmp_path / "video.webm"
    with VideoWriter(path, 64, 48, 10.0) as writer:
        writer.write(make_image(40), 0)
        writer.write(make_image(200), 60 * SECOND)
    assert (writer.frames, writer.repeated, writer.duration_s) == (601, 599, 60.1)
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    images = 0
    while capture.grab():
        images += 1
    assert images == {"PyAV": 2, "OpenCV": 601}[encoder]


def test_images_that_come_too_fast_are_dropped_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "video.webm"
    with VideoWriter(path, 64, 48, 10.0) as writer:
        for index in range(100):
            writer.write(make_image(100), index * SECOND // 100)
    assert writer.frames + writer.dropped == 100
    assert writer.frames in (10, 11)
    assert len(frames_of(path, 10.0)) == writer.frames


@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(st.floats(1.0, 60.0), st.lists(st.integers(-SECOND // 2, SECOND // 2), min_size=1, max_size=40))
def test_playing_time_is_real_time_whatever_the_stamps(
    tmp_path: Path, rate_hz: float, steps: list[int]
) -> None:
    stamps = np.cumsum(steps)
    with VideoWriter(tmp_path / "video.webm", 16, 16, rate_hz) as writer:
        for stamp in stamps:
            writer.write(make_image(10, 16, 16), int(stamp))
        newest_s = max(float(stamps.max() - stamps[0]) / SECOND, 0.0)
        assert abs(writer.duration_s - newest_s) <= 1.51 / rate_hz
    assert writer.frames - writer.repeated + writer.dropped == len(stamps)


def test_image_may_be_modified_after_write(tmp_path: Path) -> None:
    path = tmp_path / "video.webm"
    image = make_image(40)
    with VideoWriter(path, 64, 48, 10.0) as writer:
        writer.write(image, 0)
        image[:] = 250
        writer.write(make_image(40), SECOND // 2)
    np.testing.assert_allclose(frames_of(path, 10.0), [40] * 6, atol=4)


def test_full_disk_is_reported(tmp_path: Path, encoder: str) -> None:
    if not Path("/dev/full").exists():
        pytest.skip("this system has no /dev/full to stand for a full disk")
    path = tmp_path / "video.webm"
    path.symlink_to("/dev/full")
    writer = VideoWriter(path, 64, 48, 10.0)
    for index in range(20):
        writer.write(make_image(index * 12), index * SECOND // 10)
    reported = {"PyAV": "cannot be written: No space left on device", "OpenCV": "0 of 20 frames"}
    with pytest.raises(VideoWriterError, match=re.escape(reported[encoder])):
        writer.close()


def test_disk_filling_during_recording_is_reported(tmp_path: Path) -> None:
    path = tmp_path / "video.webm"
    noise = np.random.default_rng(0).integers(0, 255, (30, 240, 320, 3), dtype=np.uint8)

    def video() -> None:
        with VideoWriter(path, 320, 240, 30.0) as writer:
            for index, image in enumerate(noise):
                writer.write(image, index * SECOND // 30)

    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200_000, limits[1]))
    try:
        with pytest.raises(VideoWriterError, match=re.escape(str(path))):
            video()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert path.stat().st_size <= 200_000


def test_file_name_may_contain_a_colon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with VideoWriter("flight-12:30.webm", 64, 48, 10.0) as writer:
        writer.write(make_image(40), 0)
    assert len(frames_of(Path("file:flight-12:30.webm"), 10.0)) == 1


def test_broken_pyav_is_logged_and_opencv_is_used(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    problem = "libav: wrong version"
    (tmp_path / "av.py").write_text(f"raise ImportError({problem!r})")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "av", raising=False)
    path = tmp_path / "video.webm"
    for _ in range(2):
        with VideoWriter(path, 64, 48, 10.0) as writer:
            writer.write(make_image(40), 0)
    assert len(frames_of(path, 10.0)) == 1
    (reported,) = [record.getMessage() for record in caplog.records]
    assert reported.startswith("PyAV")
    assert problem in reported


def test_an_image_of_another_size_is_rejected(tmp_path: Path) -> None:
    with VideoWriter(tmp_path / "video.webm", 64, 48, 10.0) as writer:
        with pytest.raises(ValueError, match=re.escape("got (48, 60, 3)")):
            writer.write(make_image(1, 60), 0)
        writer.write(make_image(1), 0)
    with pytest.raises(ValueError, match="after close"):
        writer.write(make_image(1), SECOND)


def test_an_odd_size_can_be_written(tmp_path: Path) -> None:
    path = tmp_path / "video.webm"
    with VideoWriter(path, 63, 47, 10.0) as writer:
        for index in range(5):
            writer.write(make_image(90, 63, 47), index * SECOND // 10)
    assert len(frames_of(path, 10.0)) == 5


PAGE = """<!doctype html><video id="video" muted src="video.webm"></video><script>
const video = document.getElementById("video");
function report(what) {
  fetch("/reported", {method: "POST", body: JSON.stringify({what, width: video.videoWidth,
    height: video.videoHeight, duration: video.duration, time: video.currentTime,
    error: video.error && video.error.message})});
}
video.onerror = () => report("error");
video.onended = () => report("ended");
video.play().catch(error => report(String(error)));
</script>"""


class Cinema(SimpleHTTPRequestHandler):
    """Serves the page and the video, and receives the page's report."""

    reported: ClassVar[queue.SimpleQueue[dict[str, Any]]] = queue.SimpleQueue()

    def do_POST(self) -> None:
        self.reported.put(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
        self.send_response(204)
        self.end_headers()

    def log_message(self, format: str, *arguments: Any) -> None:
        pass


@pytest.mark.needs("chromium")
@pytest.mark.realtime
def test_browser_plays_the_video_to_its_end(tmp_path: Path) -> None:
    assert CHROMIUM is not None
    with VideoWriter(tmp_path / "video.webm", 320, 240, 20.0) as writer:
        for index in range(30):
            image = make_image(60, 320, 240)
            cv2.circle(image, (20 + index * 9, 120), 15, (40, 60, 230), cv2.FILLED)
            writer.write(image, index * SECOND // 20)
    (tmp_path / "page.html").write_text(PAGE)
    switches = (
        "--headless --no-sandbox --disable-gpu --no-first-run --disable-background-networking "
        "--disable-component-update --disable-sync --disable-extensions --disable-dev-shm-usage "
        "--autoplay-policy=no-user-gesture-required --remote-debugging-port=0"
    )
    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Cinema, directory=str(tmp_path))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        page = f"http://127.0.0.1:{server.server_port}/page.html"
        with subprocess.Popen(
            [CHROMIUM, *switches.split(), f"--user-data-dir={tmp_path / 'profile'}", page],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        ) as process:
            try:
                reported = Cinema.reported.get(timeout=50)
            finally:
                process.terminate()
        server.shutdown()
    assert (reported["what"], reported["error"]) == ("ended", None)
    assert (reported["width"], reported["height"]) == (320, 240)
    assert reported["duration"] == pytest.approx(1.5, abs=0.1)
    assert reported["time"] == pytest.approx(1.5, abs=0.1)
