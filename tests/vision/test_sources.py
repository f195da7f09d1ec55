"""Files, folders and images: every frame in order, and errors on opening."""

from __future__ import annotations

import os
import struct
import subprocess
import time
import zlib
from pathlib import Path

import cv2
import imageio_ffmpeg  # type: ignore[import-untyped]
import numpy as np
import pytest

from vision.image_file import natural_key
from vision.sources import EndOfStream, SourceError, SourceSettings, open_source
from vision.sources.source import SourceStatistics

pytestmark = pytest.mark.realtime

DATA = Path(
    os.environ.get("COMPANION_TEST_DATA", Path(__file__).resolve().parents[2].parent / "shared" / "data")
)


def write_image(path: Path, value: int, width: int = 32, height: int = 24) -> None:
    assert cv2.imwrite(str(path), np.full((height, width, 3), value, np.uint8))


@pytest.fixture(scope="module")
def video(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """20 frames at 50 Hz, each with its own grey; MJPEG in AVI, whose frames are independent."""
    path = tmp_path_factory.mktemp("video") / "video.avi"
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter.fourcc(*"MJPG"), 50.0, (64, 48))
    for index in range(20):
        writer.write(np.full((48, 64, 3), index * 10, np.uint8))
    writer.release()
    return path


def test_a_video_gives_every_frame_in_order_with_rising_stamps(video: Path) -> None:
    with open_source(str(video)) as source:
        assert not source.live
        assert source.total_frames == 20
        frames = list(source)
        assert source.statistics == SourceStatistics(delivered=20)
        with pytest.raises(EndOfStream):
            source.read()
    assert [round(float(frame.image.mean()) / 10) for frame in frames] == list(range(20))
    assert [frame.sequence for frame in frames] == list(range(20))
    stamps = [frame.captured_ns for frame in frames]
    assert stamps == sorted(stamps)
    assert stamps[-1] <= time.monotonic_ns()


def test_a_file_address_is_a_file(video: Path) -> None:
    with open_source(f"file://{video}") as source:
        assert len(list(source)) == 20


def test_looped_video_continues_after_its_end(video: Path) -> None:
    with open_source(str(video), SourceSettings(loop=True)) as source:
        frames = [source.read() for _ in range(45)]
    assert [frame.sequence for frame in frames if frame] == list(range(45))
    assert frames[44] is not None
    assert round(float(frames[44].image.mean()) / 10) == 4


@pytest.mark.parametrize("count", [1, 2])
def test_looped_single_image_keeps_the_interval(count: int, tmp_path: Path) -> None:
    paths = [tmp_path / f"{number}.png" for number in range(count)]
    for path in paths:
        cv2.imwrite(str(path), np.zeros((8, 8, 3), np.uint8))
    with open_source(str(tmp_path), SourceSettings(loop=True, rate_hz=10.0)) as source:
        frames = [source.read() for _ in range(5)]
    assert [frame.media_s for frame in frames if frame] == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4])


def test_a_video_in_real_time_keeps_its_own_pace_and_ends(video: Path) -> None:
    began_s = time.monotonic()
    with open_source(str(video), SourceSettings(realtime=True)) as source:
        assert source.live
        frames = list(source)
        statistics = source.statistics
    # Twenty frames at 50 Hz: the last is due 0.38 s after the first, on any machine.
    assert time.monotonic() - began_s >= 0.37
    assert frames[-1].sequence == 19
    assert statistics.delivered + statistics.dropped == 20
    assert (
        frames[-1].captured_ns - frames[0].captured_ns >= (frames[-1].sequence - frames[0].sequence - 1) * 2e7
    )


def test_slow_realtime_reader_gets_the_newest_frame(video: Path) -> None:
    with open_source(str(video), SourceSettings(realtime=True, loop=True)) as source:
        first = source.read()
        assert first is not None
        deadline_s = time.monotonic() + 20
        while source.statistics.dropped < 8 and time.monotonic() < deadline_s:
            time.sleep(0.01)
        second = source.read()
        assert second is not None
        statistics = source.statistics
        assert second.sequence - first.sequence >= 8
        assert statistics.delivered + statistics.dropped >= second.sequence + 1


def test_after_close_there_are_no_frames(video: Path) -> None:
    for settings in (SourceSettings(), SourceSettings(realtime=True)):
        source = open_source(str(video), settings)
        source.close()
        source.close()
        with pytest.raises(EndOfStream):
            source.read()


def test_truncated_video_gives_its_frames_and_a_warning(
    video: Path, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    data = video.read_bytes()
    short = tmp_path / "short.avi"
    frames_at = data.index(b"movi")
    short.write_bytes(data[: (frames_at + len(data)) // 2])
    with open_source(str(short)) as source:
        frames = list(source)
    assert 0 < len(frames) < 20
    assert f"avi: ended after {len(frames)} " in caplog.text
    assert "should have 20;" in caplog.text


def test_a_folder_gives_its_images_in_natural_order_of_any_size(tmp_path: Path) -> None:
    for index in (10, 2, 1):
        write_image(tmp_path / f"image{index}.png", index * 20, width=16 + index)
    (tmp_path / "image1.txt").write_text("a label, no image")
    (tmp_path / "folder.png").mkdir()
    with open_source(str(tmp_path)) as source:
        assert source.total_frames == 3
        frames = list(source)
    assert [int(frame.image[0, 0, 0]) for frame in frames] == [20, 40, 200]
    assert [frame.width for frame in frames] == [17, 18, 26]


def test_video_of_16_bit_grey_is_stretched(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path, counts = tmp_path / "thermal.mkv", np.tile(np.arange(7000, 7064, dtype="<u2"), (48, 1))
    raw = ("-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "gray16le", "-s", "64x48", "-i", "-")
    command = [imageio_ffmpeg.get_ffmpeg_exe(), *raw, "-c:v", "ffv1", str(path)]
    subprocess.run(command, input=counts.tobytes() * 3, check=True)
    with open_source(str(path)) as source:
        frames = list(source)
    assert len(frames) == 3
    for frame in frames:
        assert frame.image.shape == (48, 64, 3)
        assert (frame.image[0, 0, 0], frame.image[0, 63, 2]) == (0, 255)
    assert caplog.text.count("values 7000 to 7063") == 1


def test_video_of_big_endian_grey_says_that_it_may_be_dark(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path, images = tmp_path / "thermal.mov", ("-f", "lavfi", "-i", "testsrc=size=64x48:duration=0.1")
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", *images, "-pix_fmt", "gray16be"]
    subprocess.run([*command, "-c:v", "png", str(path)], check=True)
    with open_source(str(path)) as source:
        assert next(iter(source)).image.shape == (48, 64, 3)
    assert caplog.text.count("gray16le") == 1


def test_image_that_cannot_be_shown_names_why(tmp_path: Path) -> None:
    floats = tmp_path / "float.tiff"
    assert cv2.imwrite(str(floats), np.ones((8, 8), np.float32))
    header = struct.pack(">IIBBBBB", 34000, 32000, 8, 0, 0, 0, 0)
    chunks = ((b"IHDR", header), (b"IDAT", zlib.compress(b"")), (b"IEND", b""))
    huge = tmp_path / "huge.png"
    huge.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + b"".join(
            struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))
            for name, data in chunks
        )
    )
    for path, why in ((floats, "32-bit floats"), (huge, "34000x32000 pixels")):
        with pytest.raises(SourceError, match=rf"{path.name}: {why}"), open_source(str(path)) as source:
            source.read()


def test_unreadable_image_is_logged_counted_and_skipped(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write_image(tmp_path / "a.png", 10)
    (tmp_path / "b.png").write_bytes((tmp_path / "a.png").read_bytes()[:40])
    (tmp_path / "c.jpg").write_bytes(b"")
    write_image(tmp_path / "d.png", 30)
    with open_source(str(tmp_path)) as source:
        frames = list(source)
        assert source.statistics == SourceStatistics(delivered=2, unreadable=2)
    assert [frame.sequence for frame in frames] == [0, 3]
    assert "b.png: skipped" in caplog.text
    assert "c.jpg: skipped" in caplog.text


def test_names_sort_in_natural_order() -> None:
    names = ["b2.png", "B10.png", "b1.png", "10.png", "9.png", "a.png", "01.png"]
    ordered = sorted((Path(name) for name in names), key=natural_key)
    assert [path.name for path in ordered] == [
        "01.png",
        "9.png",
        "10.png",
        "a.png",
        "b1.png",
        "b2.png",
        "B10.png",
    ]


def test_single_image_is_one_colour_frame(tmp_path: Path) -> None:
    for name, shape in (("grey.png", (8, 9)), ("alpha.png", (8, 9, 4)), ("deep.png", (8, 9))):
        kind = np.uint16 if name == "deep.png" else np.uint8
        cv2.imwrite(str(tmp_path / name), np.full(shape, 200 if kind is np.uint8 else 51200, kind))
        with open_source(str(tmp_path / name)) as source:
            (frame,) = list(source)
        assert frame.image.shape == (8, 9, 3)
        assert frame.image.flags.c_contiguous
        assert int(frame.image[0, 0, 0]) == 200


def test_a_raw_file_is_read_with_the_format_and_size_given(tmp_path: Path) -> None:
    path = tmp_path / "video.rgb"
    path.write_bytes(bytes([1, 2, 3]) * 12 * 2)
    with open_source(str(path), SourceSettings(width=4, height=3, pixel_format="rgb24")) as source:
        frames = list(source)
    assert len(frames) == 2
    assert frames[0].image[0, 0].tolist() == [3, 2, 1]


@pytest.mark.parametrize(
    ("files", "address", "words"),
    [
        pytest.param({"bikes.mp4": ""}, "{}/bike.mp4", r"bike\.mp4: .*bikes\.mp4", id="missing, with a hint"),
        pytest.param({}, "{}/no/where.mp4", "does not exist", id="no folder"),
        pytest.param({"empty.mp4": ""}, "{}/empty.mp4", "empty$", id="empty"),
        pytest.param({"a.mp4": "no video " * 100}, "{}/a.mp4", r"a\.mp4: no video", id="not a video"),
        pytest.param({}, "{}", "no images", id="folder without images"),
        pytest.param({"a.png": "not an image"}, "{}", r"a\.png: not an", id="only broken image"),
        pytest.param({}, "gopher://x/y", "unknown scheme gopher://", id="unknown scheme"),
        pytest.param({}, "udp://127.0.0.1", "1 to 65535", id="no port"),
        pytest.param({}, "udp://127.0.0.1:1?format=vp9", "mpegts, rtp-h264", id="RTP format"),
        pytest.param({}, "shm://a/b", "plain file name", id="shared memory"),
        pytest.param({}, "ros://a-b", "name of a topic", id="ROS topic"),
    ],
)
def test_open_failure_is_a_one_line_error(
    tmp_path: Path, files: dict[str, str], address: str, words: str, capfd: pytest.CaptureFixture[str]
) -> None:
    for name, content in files.items():
        (tmp_path / name).write_text(content)
    with pytest.raises(SourceError, match=words) as caught:
        open_source(address.format(tmp_path))
    assert "\n" not in str(caught.value)
    assert capfd.readouterr().err == ""  # no output of OpenCV or FFmpeg


def test_video_with_a_name_that_is_not_utf8_is_refused(video: Path, tmp_path: Path) -> None:
    copied = tmp_path / os.fsdecode(b"caf\xe9.avi")
    copied.write_bytes(video.read_bytes())
    with pytest.raises(SourceError, match="not UTF-8"):
        open_source(str(copied))


@pytest.mark.parametrize(
    "uri", ["photo.png", "-", "rtsp://u:secret@cam/1", "udp://:5600", "shm://front", "ros://image_raw"]
)
@pytest.mark.parametrize("key", ["exposure_us", "gain"])
def test_exposure_of_images_already_taken_is_refused(uri: str, key: str) -> None:
    with pytest.raises(SourceError, match=rf"source\.{key} .*\(/dev/video0") as error:
        open_source(uri, SourceSettings(**{key: 100.0}))  # type: ignore[arg-type]
    assert "secret" not in str(error.value)


def test_rotated_file_is_delivered_rotated_under_its_name(tmp_path: Path) -> None:
    path = tmp_path / "photo.png"
    image = np.zeros((2, 3, 3), np.uint8)
    image[0, 0] = 200
    cv2.imwrite(str(path), image)
    shared: list[tuple[int, int]] = []
    wanted = SourceSettings(
        rotate_deg=90, name="front", on_frame=lambda frame: shared.append((frame.width, frame.height))
    )
    with open_source(str(path), wanted) as source:
        assert source.uri == f"front ({path})"
        frame = source.read()
    assert frame is not None
    assert frame.image[:, :, 0].tolist() == [[0, 200], [0, 0], [0, 0]]
    assert shared == [(2, 3)]


def test_a_real_street_is_read_whole() -> None:
    path = DATA / "video" / "bikes.mp4"
    if not path.exists():
        pytest.skip(f"{path} is not there: test data that is not part of the product")
    with open_source(str(path)) as source:
        frames = sum(1 for _ in source)
        assert frames == source.total_frames == 250
