"""RealSense and OAK cameras, with stand-ins for their libraries: the same names, arguments and types."""

from __future__ import annotations

import sys
import time
from datetime import timedelta
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from vision.camera_model import CameraModel
from vision.sources import SourceError, SourceSettings, open_source
from vision.sources.depth_cameras import _warn_ignored_distortion

pytestmark = pytest.mark.realtime

WIDTH, HEIGHT = 32, 24


class RealsenseFrame:
    def __init__(self, data: Any, number: int, stamp_ms: float, domain: str) -> None:
        self._data, self._number, self._stamp_ms, self._domain = data, number, stamp_ms, domain

    def get_data(self) -> Any:
        return self._data

    def get_frame_number(self) -> int:
        return self._number

    def get_timestamp(self) -> float:
        return self._stamp_ms

    def get_frame_timestamp_domain(self) -> str:
        return self._domain


class FakeRealsense:
    """`pyrealsense2`: one camera with the serial number 0815, which misses a frame after each one."""

    stream = SimpleNamespace(color="color", depth="depth")
    format = SimpleNamespace(bgr8="bgr8", z16="z16")
    distortion = SimpleNamespace(brown_conrady="brown_conrady", inverse_brown_conrady="inverse_brown_conrady")
    timestamp_domain = SimpleNamespace(hardware_clock="hardware_clock", global_time="global_time")

    def __init__(self, coefficients: tuple[float, ...] = (), model: str = "brown_conrady") -> None:
        self.streams: list[tuple[Any, ...]] = []
        self.serial = ""
        self.stopped = 0
        self._number = 0
        coeffs = [*coefficients, 0.0, 0.0, 0.0, 0.0, 0.0][:5]
        self._lens = SimpleNamespace(
            width=WIDTH, height=HEIGHT, fx=30.0, fy=31.0, ppx=15.0, ppy=12.0, coeffs=coeffs, model=model
        )

    def config(self) -> Any:
        def enable_device(serial: str) -> None:
            self.serial = serial

        return SimpleNamespace(
            enable_device=enable_device, enable_stream=lambda *values: self.streams.append(values)
        )

    def pipeline(self) -> Any:
        return SimpleNamespace(start=self._start, stop=self._stop, try_wait_for_frames=self._wait)

    def _stop(self) -> None:
        self.stopped += 1

    def _start(self, _config: Any) -> Any:
        if self.serial not in ("", "0815"):
            raise RuntimeError("No device connected")
        sensor = SimpleNamespace(get_depth_scale=lambda: 0.0001)
        profile = SimpleNamespace(get_intrinsics=lambda: self._lens)
        return SimpleNamespace(
            get_device=lambda: SimpleNamespace(first_depth_sensor=lambda: sensor),
            get_stream=lambda _stream: SimpleNamespace(as_video_stream_profile=lambda: profile),
        )

    def _wait(self, timeout_ms: int) -> tuple[bool, Any]:
        assert isinstance(timeout_ms, int)
        time.sleep(0.005)
        self._number += 2
        return True, "frames"

    def align(self, stream: str) -> Any:
        assert stream == "color"
        return SimpleNamespace(process=self._aligned)

    def _aligned(self, frames: str) -> Any:
        assert frames == "frames"
        depth = np.full((HEIGHT, WIDTH), 25000, np.uint16)
        depth[0, 0] = 0
        made = [
            RealsenseFrame(data, self._number, time.time() * 1e3 - 30.0, "global_time")
            for data in (np.full((HEIGHT, WIDTH, 3), 50, np.uint8), depth)
        ]
        return SimpleNamespace(get_color_frame=lambda: made[0], get_depth_frame=lambda: made[1])


def test_realsense_delivers_registered_depth_in_metres(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = FakeRealsense((0.1, -0.2, 0.001, 0.002, 0.05))
    monkeypatch.setitem(sys.modules, "pyrealsense2", camera)
    settings = SourceSettings(width=WIDTH, height=HEIGHT, rate_hz=30.0)
    with open_source("realsense://0815", settings) as source:
        first = source.read(20.0)
        second = source.read(20.0)
        dropped = source.statistics.dropped
    assert first is not None
    assert second is not None
    assert first.depth_m is not None
    assert np.isnan(first.depth_m[0, 0])
    assert first.depth_m[1, 1] == pytest.approx(2.5)  # 25000 units of 0.1 mm
    assert int(first.image[0, 0, 0]) == 50
    assert 0.03 <= (first.ready_ns - first.captured_ns) / 1e9 < 0.5
    assert second.sequence - first.sequence >= 2
    assert dropped >= 1
    assert source.calibration is not None
    lens = (0.1, -0.2, 0.001, 0.002, 0.05)
    assert source.calibration.model == CameraModel(WIDTH, HEIGHT, 30.0, 31.0, 15.0, 12.0, lens)
    assert source.calibration.mount is None
    assert camera.serial == "0815"
    assert camera.streams == [("color", WIDTH, HEIGHT, "bgr8", 30), ("depth", "z16", 30)]
    assert camera.stopped == 1


def test_unsupported_distortion_of_a_realsense_is_not_used(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", FakeRealsense((0.1,), "kannala_brandt4"))
    with open_source("realsense://") as source:
        assert source.calibration is None
    assert "distortion kannala_brandt4, " in caplog.text
    assert "not supported" in caplog.text


def test_inverse_distortion_of_a_realsense_is_ignored_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    _warn_ignored_distortion.cache_clear()
    monkeypatch.setitem(sys.modules, "pyrealsense2", FakeRealsense((-0.05, 0.06), "inverse_brown_conrady"))
    for _ in range(2):
        with open_source("realsense://") as source:
            assert source.calibration is not None
            assert source.calibration.model == CameraModel(WIDTH, HEIGHT, 30.0, 31.0, 15.0, 12.0)
    assert caplog.text.count("-0.05, 0.06") == 1


def test_missing_depth_camera_is_a_one_line_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pyrealsense2", FakeRealsense())
    with pytest.raises(SourceError, match=r"realsense://4711: .*No device "):
        open_source("realsense://4711", SourceSettings(open_timeout_s=0.3))


@pytest.mark.parametrize(("uri", "module"), [("realsense://", "pyrealsense2"), ("oak://", "depthai")])
def test_missing_library_names_the_extra(uri: str, module: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(SourceError, match=rf"^{uri}: .*'mavlink-companion\[cameras\]'"):
        open_source(uri)


class OakNode:
    """A node of a pipeline, an output, or an input: it notes what is linked to it."""

    def __init__(self, name: str, links: list[tuple[str, str]]) -> None:
        self.name, self.links = name, links

    def build(self, *places: Any) -> OakNode:
        self.name += "".join(f" {place.name if isinstance(place, OakNode) else place}" for place in places)
        return self

    def requestOutput(self, size: tuple[int, int], *_: Any, fps: float, **_named: Any) -> OakNode:  # noqa: N802
        return OakNode(f"{self.name} {size[0]}x{size[1]}@{fps:g}", self.links)

    def link(self, target: OakNode) -> None:
        self.links.append((self.name, target.name))

    def setSyncThreshold(self, limit: timedelta) -> None:  # noqa: N802
        assert 0.0 < limit.total_seconds() < 0.1

    @property
    def inputs(self) -> dict[str, OakNode]:
        return {name: OakNode(f"sync {name}", self.links) for name in ("colour", "depth")}

    def __getattr__(self, name: str) -> OakNode:
        return OakNode(f"{self.name}.{name}", self.links)


class FakeOak:
    """`depthai` 3: one camera; image N is followed by N + 1, and the queue is empty every other time."""

    CameraBoardSocket = SimpleNamespace(CAM_A="A", CAM_B="B", CAM_C="C")
    ImgFrame = SimpleNamespace(Type=SimpleNamespace(BGR888i="BGR888i"))
    Platform = SimpleNamespace(RVC2="RVC2", RVC4="RVC4")
    node = SimpleNamespace(Camera="camera", StereoDepth="stereo", Sync="sync", ImageAlign="align")

    def __init__(self, platform: str = "RVC2") -> None:
        self.platform = platform
        self.links: list[tuple[str, str]] = []
        self.calls: list[str] = []
        self._number = 0

    def DeviceInfo(self, identifier: str) -> str:  # noqa: N802
        return identifier

    def Device(self, identifier: str = "") -> Any:  # noqa: N802
        if identifier == "gone":
            raise RuntimeError("Cannot find any device with given deviceInfo")
        return SimpleNamespace(
            getPlatform=lambda: self.platform, close=lambda: self.calls.append("device closed")
        )

    def Pipeline(self, _device: Any) -> Any:  # noqa: N802
        queue = SimpleNamespace(get=self._get)

        def create(name: str) -> Any:
            node = OakNode(name, self.links)
            if name == "sync":
                node.__dict__["out"] = SimpleNamespace(createOutputQueue=lambda **_limits: queue)
            return node

        return SimpleNamespace(
            create=create,
            start=lambda: self.calls.append("started"),
            stop=lambda: self.calls.append("stopped"),
        )

    def _get(self, timeout: timedelta) -> Any:
        self._number += 1
        if self._number % 2 == 0:
            time.sleep(0.01)
            return None
        depth = np.full((HEIGHT, WIDTH), 3400, np.uint16)
        depth[0, 0] = 0
        stamp = timedelta(seconds=time.monotonic() - 0.05)
        matrix = [[40.0, 0.0, 16.5], [0.0, 41.0, 11.5], [0.0, 0.0, 1.0]]
        number = self._number
        colour = SimpleNamespace(
            getCvFrame=lambda: np.full((HEIGHT, WIDTH, 3), 60, np.uint8),
            getTransformation=lambda: SimpleNamespace(getIntrinsicMatrix=lambda: matrix),
            getWidth=lambda: WIDTH,
            getHeight=lambda: HEIGHT,
            getSequenceNum=lambda: number,
            getTimestamp=lambda: stamp,
        )
        return {"colour": colour, "depth": SimpleNamespace(getFrame=lambda: depth)}


@pytest.mark.parametrize("platform", ["RVC2", "RVC4"])
def test_oak_delivers_registered_depth_in_metres(platform: str, monkeypatch: pytest.MonkeyPatch) -> None:
    camera = FakeOak(platform)
    monkeypatch.setitem(sys.modules, "depthai", camera)
    settings = SourceSettings(width=WIDTH, height=HEIGHT, rate_hz=20.0)
    with open_source("oak://14442C10D13EABCE00", settings) as source:
        frame = source.read(20.0)
        while (later := source.read(20.0)) is None:
            pass
    assert frame is not None
    assert frame.depth_m is not None
    assert np.isnan(frame.depth_m[0, 0])
    assert frame.depth_m[1, 1] == pytest.approx(3.4)
    assert later.sequence > frame.sequence
    assert 0.04 < (frame.ready_ns - frame.captured_ns) / 1e9 < 0.5
    assert source.calibration is not None
    assert source.calibration.model == CameraModel(WIDTH, HEIGHT, 40.0, 41.0, 16.5, 11.5)
    assert camera.calls == ["started", "stopped", "device closed"]
    colour, stereo = "camera A 32x24@20", "stereo camera B 640x400@20 camera C 640x400@20"
    aligned = f"{stereo}.depth" if platform == "RVC2" else "align.outputAligned"
    assert (colour, "sync colour") in camera.links
    assert (aligned, "sync depth") in camera.links
    assert (colour, f"{stereo}.inputAlignTo" if platform == "RVC2" else "align.inputAlignTo") in camera.links


def test_missing_oak_is_a_one_line_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "depthai", FakeOak())
    with pytest.raises(SourceError, match=r"gone: .*any device "):
        open_source("oak://gone", SourceSettings(open_timeout_s=0.3))
