"""Depth as a second source: files, pipes, pairing by stamp."""

from __future__ import annotations

import io
import logging
import os
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from vision.calibration_files.camera_info import write_camera_info
from vision.camera_model import CameraModel
from vision.depth_registration import DepthCalibration
from vision.frame import Frame
from vision.orientation import Orientation
from vision.shared_frame import SharedFrameReader
from vision.sources import (
    EndOfStream,
    Source,
    SourceError,
    SourceSettings,
    SourceStatistics,
    open_source,
)
from vision.sources.depth_images import decode_depth, to_metres
from vision.sources.paired import DepthImages, PairedCapture, paired_source
from vision.sources.shared import FrameSharing

MILLIMETRES = np.array([[1500, 0], [65535, 250]], np.uint16)
METRES = np.array([[1.5, np.nan], [np.inf, -1.0]], np.float32)


def saved(path: Path, image: NDArray[Any]) -> Path:
    path.parent.mkdir(exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, image)
    else:
        assert cv2.imwrite(str(path), image)
    return path


@pytest.mark.parametrize("name", ["a.png", "a.npy", "a.tiff", "a.pgm"])
def test_16_bit_integers_are_millimetres(tmp_path: Path, name: str) -> None:
    with open_source(str(saved(tmp_path / name, MILLIMETRES)), SourceSettings(as_depth=True)) as source:
        frame = source.read()
    assert frame is not None
    assert frame.depth_m is not None
    assert frame.depth_m.dtype == np.float32
    np.testing.assert_allclose(frame.depth_m, [[1.5, np.nan], [np.nan, 0.25]], rtol=1e-6)


@pytest.mark.parametrize("name", ["a.npy", "a.tiff"])
def test_floats_are_metres_and_holes_are_nan(tmp_path: Path, name: str) -> None:
    path = saved(tmp_path / name, METRES)
    for scale, expected in ((None, 1.5), (0.1, 0.15)):
        with open_source(str(path), SourceSettings(as_depth=True, depth_scale=scale)) as source:
            frame = source.read()
        assert frame is not None
        assert frame.depth_m is not None
        np.testing.assert_allclose(frame.depth_m, [[expected, np.nan], [np.nan, np.nan]], rtol=1e-6)


def saved_exr(path: Path, channels: dict[str, NDArray[Any]]) -> Path:
    OpenEXR = pytest.importorskip("OpenEXR")  # noqa: N806
    OpenEXR.File({"type": OpenEXR.scanlineimage}, channels).write(str(path))
    return path


@pytest.mark.parametrize("names", [["V"], ["B", "G", "R", "Z"], ["L.Combined.B", "L.Mist.V", "L.Depth.Z"]])
@pytest.mark.parametrize("dtype", [np.float32, np.float16])
def test_openexr_depth_is_its_channel_or_z(tmp_path: Path, names: list[str], dtype: type) -> None:
    channels: dict[str, NDArray[Any]] = {name: np.full((2, 2), 9.0, dtype) for name in names}
    channels[names[-1]] = METRES.astype(dtype)
    path = saved_exr(tmp_path / "a.exr", channels)
    with open_source(str(path), SourceSettings(as_depth=True)) as source:
        frame = source.read()
    assert frame is not None
    assert frame.depth_m is not None
    np.testing.assert_array_equal(frame.depth_m, [[1.5, np.nan], [np.nan, np.nan]])


def test_openexr_without_a_depth_channel_is_refused(tmp_path: Path) -> None:
    for names in (("B", "G", "R"), ("A.Z", "B.Z")):
        whole = saved_exr(tmp_path / "a.exr", dict.fromkeys(names, METRES)).read_bytes()
        with pytest.raises(SourceError, match=f"the only 'Z', got {', '.join(names)}"):
            decode_depth(Path("of-bytes.exr"), whole)
    for data in (whole[: len(whole) // 2], whole[:-4], b"\x76\x2f\x31\x01", b"image", b""):
        assert decode_depth(Path("of-bytes.exr"), data) is None


def test_openexr_without_its_extra_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    with pytest.raises(SourceError, match=r"a\.exr: .*\[cameras\].*TIFF"):
        decode_depth(tmp_path / "a.exr", b"")


@pytest.mark.parametrize("dtype", [">u2", "<u2", ">f4"])
def test_depth_of_any_byte_order_is_read(dtype: str) -> None:
    stored = io.BytesIO()
    np.save(stored, np.full((4, 4), 3000, dtype))
    depth = decode_depth(Path("a.npy"), stored.getvalue())
    assert depth is not None
    np.testing.assert_allclose(to_metres(depth, 0.001), np.full((4, 4), 3.0, np.float32))


def test_integers_in_metres_are_refused_with_the_key() -> None:
    metres = np.full((4, 4), 3, np.uint16)
    with pytest.raises(SourceError, match=r"0\.003 m.*source\.depth_scale"):
        to_metres(metres, None)
    np.testing.assert_array_equal(to_metres(metres, 1.0), metres.astype(np.float32))
    near = np.zeros((4, 4), np.uint16)
    near[0] = 3  # most of it unknown: something is at the lens
    assert np.isnan(to_metres(near, None)[1:]).all()


def test_floats_in_millimetres_are_refused_with_the_key() -> None:
    metres = np.full((4, 4), 3.0, np.float32)
    with pytest.raises(SourceError, match=r" 3000 m.*depth_scale"):
        to_metres(metres * 1000, None)
    np.testing.assert_allclose(to_metres(metres * 1000, 0.001), metres)
    assert np.isnan(to_metres(np.zeros((2, 2), np.float32), None)).all()


@pytest.mark.parametrize(
    ("image", "words"),
    [
        (np.zeros((4, 4), np.uint8), r"16-bit .*\(4, 4\) uint8"),
        (np.zeros((4, 4, 3), np.uint16), r"one channel.*\(4, 4, 3\)"),
    ],
)
def test_image_that_is_not_depth_is_refused(tmp_path: Path, image: NDArray[Any], words: str) -> None:
    with pytest.raises(SourceError, match=words):
        open_source(str(saved(tmp_path / "a.png", image)), SourceSettings(as_depth=True))


def folders(
    tmp_path: Path, count: int, depth_count: int, size: tuple[int, int] = (12, 16)
) -> tuple[str, SourceSettings]:
    """A folder of colour images, and settings with one of depth: image N is N + 1 metres away."""
    for index in range(count):
        saved(tmp_path / "colour" / f"{index}.png", np.full((12, 16, 3), index, np.uint8))
    for index in range(depth_count):
        saved(tmp_path / "depth" / f"{index}.png", np.full(size, (index + 1) * 1000, np.uint16))
    return str(tmp_path / "colour"), SourceSettings(depth=str(tmp_path / "depth"))


def test_folders_are_paired_image_by_image(tmp_path: Path) -> None:
    uri, settings = folders(tmp_path, 4, 3)
    with open_source(uri, settings) as source:
        assert not source.live
        assert source.total_frames == 4
        assert source.uri.split(" with depth ")[0] == uri
        assert source.uri.endswith(f" {settings.depth}")
        frames = list(source)
    assert [int(frame.image[0, 0, 0]) for frame in frames] == [0, 1, 2, 3]
    depths = [None if frame.depth_m is None else round(float(frame.depth_m[0, 0]), 4) for frame in frames]
    assert depths == [1.0, 2.0, 3.0, None]


@pytest.mark.parametrize("rate_hz", [None, 100.0])
def test_folders_are_paired_by_file_name(tmp_path: Path, rate_hz: float | None) -> None:
    for index in range(10):
        saved(tmp_path / "col" / f"{index:06d}.png", np.full((12, 16, 3), index, np.uint8))
        if index not in (0, 3):
            saved(tmp_path / "dep" / f"{index:06d}.npy", np.full((12, 16), 1.0 + index, np.float32))
    settings = SourceSettings(depth=f"file://{tmp_path}/dep", rate_hz=rate_hz)
    with open_source(str(tmp_path / "col"), settings) as source:
        frames = {int(frame.image[0, 0, 0]): frame.depth_m for frame in source}
    # The first has no partner before the first pair, and is skipped.
    assert list(frames) == list(range(1, 10))
    depths = {index: None if depth is None else float(depth[0, 0]) for index, depth in frames.items()}
    assert depths == {index: None if index == 3 else 1.0 + index for index in range(1, 10)}


def test_folders_with_other_names_are_paired_by_position(tmp_path: Path) -> None:
    uri, settings = folders(tmp_path, 3, 3)
    for path in (tmp_path / "depth").iterdir():
        path.rename(path.with_name(f"depth_{path.name}"))
    with open_source(uri, settings) as source:
        depths = [float(frame.depth_m[0, 0]) for frame in source if frame.depth_m is not None]
    assert depths == pytest.approx([1.0, 2.0, 3.0])
    (tmp_path / "depth" / "depth_1.png").unlink()
    with pytest.raises(SourceError, match=r"^3 .* 2 depth .* 0 "):
        open_source(uri, settings)
    saved(tmp_path / "depth" / "depth_0.npy", METRES)
    with pytest.raises(SourceError, match=r"depth: two "):
        open_source(uri, settings)


def test_loop_is_refused_with_depth(tmp_path: Path) -> None:
    uri, settings = folders(tmp_path, 2, 2)
    with pytest.raises(SourceError, match=r"source\.loop"):
        open_source(uri, SourceSettings(depth=settings.depth, loop=True))


@pytest.mark.realtime
def test_folders_in_real_time_stay_paired_and_rotated(tmp_path: Path) -> None:
    uri, settings = folders(tmp_path, 6, 6)
    shared: list[bool] = []
    live = SourceSettings(
        depth=settings.depth, realtime=True, rate_hz=50.0, rotate_deg=90, name="front",
        on_frame=lambda frame: shared.append(frame.depth_m is not None),
    )  # fmt: skip
    frames = []
    with open_source(uri, live) as source:
        assert source.live
        assert source.uri.startswith(f"front ({uri})")
        frames = list(source)
    assert frames
    for frame in frames:
        assert frame.depth_m is not None
        assert frame.depth_m.shape == (16, 12)
        assert frame.depth_m[0, 0] == pytest.approx(int(frame.image[0, 0, 0]) + 1)
    assert shared == [True] * 6


@pytest.mark.parametrize("realtime", [True, False])
def test_depth_of_another_size_is_refused(tmp_path: Path, realtime: bool) -> None:
    uri, settings = folders(tmp_path, 2, 2, size=(6, 8))
    with pytest.raises(SourceError, match=r"8x6, .*16x12"):
        open_source(uri, SourceSettings(depth=settings.depth, realtime=realtime))


def test_depth_of_a_camera_beside_the_colour_one_is_registered(tmp_path: Path) -> None:
    uri, settings = folders(tmp_path, 3, 3, size=(6, 8))
    colour, depth = (CameraModel.from_horizontal_fov(*size, 1.0) for size in ((32, 24), (8, 6)))
    rig = DepthCalibration(depth, colour, np.eye(3), np.array([0.0, 0.0, 0.25]))
    file = tmp_path / "depth.yaml"
    write_camera_info(file, depth, "depth", orientation=Orientation(), registration=rig)
    registered = replace(settings, depth_calibration_file=str(file))
    with open_source(uri, registered) as source:
        frames = list(source)
    for index, frame in enumerate(frames):
        assert frame.depth_m is not None
        assert frame.depth_m.shape == (12, 16)
        known = frame.depth_m[np.isfinite(frame.depth_m)]
        np.testing.assert_allclose(known, index + 1.25, rtol=1e-6)
        assert len(known) > 100
    assert len(frames) == 3
    with pytest.raises(SourceError, match=r"yaml .*rotate_deg 0.* 90"):
        open_source(uri, replace(registered, rotate_deg=90))
    write_camera_info(file, depth.scaled(8, 4), "depth", registration=rig)
    with pytest.raises(SourceError, match=r"depth_calibration_file: .* 8x4.* 8x6"):
        open_source(uri, registered)


def test_depth_that_cannot_be_paired_is_refused(tmp_path: Path) -> None:
    uri, settings = folders(tmp_path, 1, 1)
    fifo = tmp_path / "depth.fifo"
    os.mkfifo(fifo)
    held = os.open(fifo, os.O_RDWR)
    os.write(held, bytes(16 * 12 * 2))
    try:
        with pytest.raises(SourceError, match=r"fifo .*live .*recording"):
            open_source(uri, SourceSettings(depth=str(fifo), width=16, height=12))
        with pytest.raises(SourceError, match=r"gray16 .*width .*height"):
            open_source(uri, SourceSettings(depth=str(fifo)))
    finally:
        os.close(held)
    with pytest.raises(SourceError, match=r"source\.uri .* source\.depth"):
        open_source("-", SourceSettings(depth="-"))
    with pytest.raises(SourceError, match="delivers colour"):
        open_source(uri, SourceSettings(depth="rtsp://camera/1"))
    with pytest.raises(SourceError, match=r"gray16 .* source\.depth"):
        open_source(str(fifo), SourceSettings(pixel_format="gray16", width=16, height=12))
    assert settings.depth is not None


@pytest.mark.realtime
def test_pipes_of_colour_and_gray16_are_paired(tmp_path: Path) -> None:
    """The writer writes image N and depth of N metres together, at 50 Hz."""
    paths = [tmp_path / "colour.fifo", tmp_path / "depth.fifo"]
    for path in paths:
        os.mkfifo(path)
    stop = threading.Event()

    def write() -> None:
        with open(paths[0], "wb", buffering=0) as colour, open(paths[1], "wb", buffering=0) as depth:
            for index in range(1, 250):
                if stop.wait(0.02):
                    return
                depth.write(np.full((12, 16), index * 1000, "<u2").tobytes())
                colour.write(np.full((12, 16, 3), index, np.uint8).tobytes())

    writer = threading.Thread(target=write)
    writer.start()
    settings = SourceSettings(depth=str(paths[1]), pixel_format="bgr24", width=16, height=12)
    try:
        with open_source(str(paths[0]), settings) as source:
            assert source.live
            frames: list[Frame] = []
            while len(frames) < 10:
                frame = source.read(20.0)
                assert frame is not None
                frames.append(frame)
            stop.set()
    finally:
        stop.set()
        writer.join(20.0)
    # A loaded machine may read one of the two later, and then the neighbour is nearer.
    errors = [
        abs(float(frame.depth_m[0, 0]) - int(frame.image[0, 0, 0]))
        for frame in frames
        if frame.depth_m is not None and float(frame.depth_m[0, 0]) < 65
    ]
    assert len(errors) >= 5
    assert sorted(errors)[len(errors) // 2] <= 1.0


class ScriptedSource(Source):
    """Delivers the frames given, then ends or stays silent."""

    def __init__(self, frames: list[Frame], *, live: bool, ends: bool = True, uri: str = "scripted") -> None:
        self.uri, self.live = uri, live
        self._frames, self._ends = frames, ends
        self.closed = False

    def read(self, timeout_s: float = 1.0) -> Frame | None:
        if self._frames:
            return self._frames.pop(0)
        if self._ends:
            raise EndOfStream
        return None

    @property
    def statistics(self) -> SourceStatistics:
        return SourceStatistics()

    def close(self) -> None:
        self.closed = True


def frame_at(stamp_s: float, sequence: int = 0, depth_m: float | None = None) -> Frame:
    depth = None if depth_m is None else np.full((4, 4), depth_m, np.float32)
    return Frame(np.zeros((4, 4, 3), np.uint8), round(stamp_s * 1e9), sequence, depth, media_s=stamp_s)


def paired(colour: list[Frame], depth: list[Frame]) -> Iterator[float | None]:
    """The depth of each frame that a live pair delivers; the depth images have all arrived."""
    images = DepthImages()
    for frame in depth:
        images.add(frame)
    capture = PairedCapture(
        ScriptedSource(colour, live=True),
        ScriptedSource([], live=True, ends=False),
        images,
        SourceSettings(open_timeout_s=0.2),
    )
    while True:
        try:
            raw = capture.read(0.1)
        except EndOfStream:
            return
        assert raw is not None
        yield None if raw.depth_m is None else float(raw.depth_m[0, 0])


def test_live_images_are_paired_by_the_nearest_stamp() -> None:
    depth = [frame_at(1.000, depth_m=1.0), frame_at(1.033, depth_m=2.0), frame_at(1.066, depth_m=3.0)]
    colour = [frame_at(0.5), frame_at(1.004, 1), frame_at(1.030, 2), frame_at(1.055, 3), frame_at(1.090, 4)]
    # The first has no partner before the first pair, and is skipped; the last one's is 24 ms away.
    assert list(paired(colour, depth)) == [1.0, 2.0, 3.0, None]


def test_stamps_of_another_clock_are_refused() -> None:
    with pytest.raises(SourceError, match=r"nearest .* 5 s "):
        list(paired([frame_at(10.0 + index / 30, index) for index in range(3)], [frame_at(5.0, depth_m=1.0)]))
    with pytest.raises(SourceError, match="none came"):
        list(paired([frame_at(10.0)], []))


def test_depth_that_arrives_late_is_waited_for() -> None:
    images = DepthImages()
    late = threading.Timer(0.01, images.add, [frame_at(1.0, depth_m=7.0)])
    late.start()
    found = images.nearest(1.0)
    late.join()
    assert found is not None
    assert found[1][0, 0] == 7.0
    started_s = time.monotonic()
    assert images.nearest(2.0) == found
    assert 0.03 < time.monotonic() - started_s < 1.0


def test_lost_depth_is_not_waited_for_until_it_is_back() -> None:
    images = DepthImages()
    images.add(frame_at(1.0, depth_m=1.0))
    colour = ScriptedSource([frame_at(1.0 + index / 10, index) for index in range(30)], live=True)
    depth = ScriptedSource([], live=True, ends=False)
    capture = PairedCapture(colour, depth, images, SourceSettings())
    for _ in range(4):
        assert capture.read(0.1) is not None
    started_s = time.monotonic()
    for _ in range(20):
        raw = capture.read(0.1)
        assert raw is not None
        assert raw.depth_m is None
    assert time.monotonic() - started_s < 0.4  # 40 ms for each would be 0.8 s
    images.add(frame_at(3.3, depth_m=1.0))
    back = threading.Timer(0.01, images.add, [frame_at(3.4, depth_m=2.0)])
    back.start()
    raw = capture.read(0.1)
    back.join()
    assert raw is not None
    assert raw.depth_m is not None
    assert raw.depth_m[0, 0] == 2.0


def test_recordings_of_different_rates_are_paired_by_time() -> None:
    colour = ScriptedSource([frame_at(index / 30, index) for index in range(7)], live=False)
    depth = ScriptedSource(
        [frame_at(index / 15, index, depth_m=1.0 + index) for index in range(3)], live=False
    )
    with paired_source(colour, depth, DepthImages(), SourceSettings()) as source:
        depths = [None if frame.depth_m is None else float(frame.depth_m[0, 0]) for frame in source]
    assert depths == [1.0, None, 2.0, None, 3.0, None, None]
    assert colour.closed
    assert depth.closed


def test_error_of_the_depth_source_ends_the_pair(caplog: pytest.LogCaptureFixture) -> None:
    class Failing(ScriptedSource):
        def read(self, timeout_s: float = 1.0) -> Frame | None:
            raise SourceError("the median of depth is 3000 m")

    caplog.set_level(logging.WARNING)
    colour = ScriptedSource([frame_at(index / 30, index) for index in range(7)], live=True)
    depth = Failing([], live=True, uri="depth.tiff")
    with pytest.raises(SourceError, match=r"depth\.tiff: .* 3000 m"):
        paired_source(colour, depth, DepthImages(), SourceSettings())
    assert colour.closed
    assert depth.closed


def test_frame_without_depth_is_shared_with_unknown_depth() -> None:
    name = f"depth-test-{os.getpid()}"
    with FrameSharing(name) as sharing:
        sharing.write(frame_at(1.0, 0, depth_m=2.0))
        reader = SharedFrameReader(name)
        sharing.write(frame_at(2.0, 1))
        frame = reader.latest(None)
        reader.close()
    assert frame is not None
    assert frame.captured_ns == 2_000_000_000
    assert frame.depth_m is not None
    assert np.isnan(frame.depth_m).all()
