"""Cameras are found by their images; what another program has open is left alone."""

from __future__ import annotations

import importlib
import importlib.util
import shutil
from dataclasses import replace
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import pytest

from companion.doctor.facts import CameraTrial, Facts, User
from companion.settings import Settings, SourceSection
from companion.setup import cameras as search
from companion.setup.cameras import Camera, Candidate, candidates_of, find_cameras
from companion.setup.tried import Tried
from tests.companion.doctor.computer import Computer
from vision.sources import csi, depth_cameras
from vision.sources.v4l2 import FrameSize, PixelFormat, VideoDevice

WEBCAM = VideoDevice(
    Path("/dev/video0"),
    Path("/dev/v4l/by-id/usb-webcam"),
    driver="uvcvideo",
    card="HD Webcam",
    kind="camera",
    formats=(PixelFormat("MJPG", "", (FrameSize(640, 480),)), PixelFormat("YUYV", "", ())),
)
METADATA = replace(WEBCAM, path=Path("/dev/video1"), stable_path=None, kind="metadata", formats=())
THERMAL = replace(WEBCAM, path=Path("/dev/video2"), stable_path=Path("/dev/v4l/by-id/usb-thermal"))
CSI_NODE = replace(WEBCAM, path=Path("/dev/video4"), stable_path=None, driver="rp1-cfe", card="rp1-cfe")
FRAMES = CameraTrial(36, 1.2, 640, 480)


@pytest.fixture
def computer(tmp_path: Path) -> Computer:
    return Computer(tmp_path)


def found(
    candidates: list[Candidate], computer: Computer, trials: dict[str, CameraTrial] | None = None
) -> tuple[list[Camera], dict[str, Tried], list[str]]:
    """Return the cameras, the results, and what was opened."""
    tried: dict[str, Tried] = {}
    opened: list[str] = []

    def trial(source: SourceSection) -> CameraTrial:
        opened.append(source.uri)
        return (trials or {}).get(source.uri, FRAMES)

    facts = Facts(Settings(), computer.machine())
    cameras = find_cameras(candidates, facts, lambda each: tried.update({each.where: each}), trial=trial)
    return cameras, tried, opened


def uris(*devices: VideoDevice, depth: tuple[str, ...] = ()) -> list[str]:
    return [each.uri for each in candidates_of(devices, depth)[0]]


@pytest.fixture(autouse=True)
def no_csi(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(shutil, "which", lambda _: None)


def test_only_camera_keeps_its_number() -> None:
    assert uris(WEBCAM, METADATA) == ["/dev/video0"]


def test_of_two_cameras_the_stable_names_are_taken() -> None:
    assert uris(WEBCAM, METADATA, THERMAL) == ["/dev/v4l/by-id/usb-webcam", "/dev/v4l/by-id/usb-thermal"]


def test_nodes_of_csi_and_depth_cameras_are_not_offered(monkeypatch: pytest.MonkeyPatch) -> None:
    assert uris(WEBCAM, CSI_NODE) != ["/dev/video0"]
    monkeypatch.setattr(search, "csi_cameras", lambda _: (csi.CsiCamera(0, "imx708"),))
    realsense = replace(WEBCAM, path=Path("/dev/video6"), card="Intel(R) RealSense(TM) 435")
    assert uris(CSI_NODE, realsense, depth=("realsense://123",)) == ["realsense://123", "csi://0"]


def test_node_that_cannot_be_asked_is_named() -> None:
    failed = VideoDevice(Path("/dev/video0"), error="no permission; the group video has it")
    candidates, others = candidates_of([failed], [])
    assert candidates == []
    assert others == [Tried("/dev/video0", failed.error)]


def test_rate_is_measured_and_formats_are_named(computer: Computer) -> None:
    candidates, _ = candidates_of([replace(WEBCAM, path=computer.root / "dev" / "video0")], [])
    (camera,), tried, _ = found(candidates, computer)
    assert camera.rate_hz == pytest.approx(30.0)
    text = tried[camera.uri].found
    assert all(word in text for word in ("HD Webcam", "640x480", "30.0", "MJPG", "YUYV"))


def test_camera_without_frames_is_not_taken(computer: Computer) -> None:
    silent = CameraTrial(problem="no frame within 3 s")
    candidates = [Candidate("csi://0", "imx708"), Candidate("csi://1", "imx219")]
    cameras, tried, opened = found(candidates, computer, {"csi://0": silent})
    assert [each.uri for each in cameras] == ["csi://1"]
    assert opened == ["csi://0", "csi://1"]
    assert silent.problem in tried["csi://0"].found


def hold(computer: Computer) -> None:
    computer.program(77, "cheese", opened=[computer.root / "dev" / "video0"])


def forbid(computer: Computer) -> None:
    computer.user = User("ann", 54321, frozenset())


@pytest.mark.parametrize("change", [hold, forbid])
def test_camera_of_another_program_is_not_opened(computer: Computer, change: Any) -> None:
    change(computer)
    device = computer.root / "dev" / "video0"
    cameras, tried, opened = found([Candidate("/dev/video0", "HD Webcam", device)], computer)
    assert (cameras, opened) == ([], [])
    assert tried["/dev/video0"].advice


def test_depth_cameras_are_listed_by_their_libraries(monkeypatch: pytest.MonkeyPatch) -> None:
    class Realsense:
        def get_info(self, key: str) -> str:
            return {"serial": "8312"}[key]

    modules: dict[str, Any] = {
        "pyrealsense2": SimpleNamespace(
            camera_info=SimpleNamespace(serial_number="serial"),
            context=lambda: SimpleNamespace(query_devices=lambda: [Realsense()]),
        ),
        "depthai": SimpleNamespace(
            Device=SimpleNamespace(
                getAllAvailableDevices=lambda: [SimpleNamespace(getDeviceId=lambda: "18443010")]
            )
        ),
    }
    monkeypatch.setattr(importlib.util, "find_spec", modules.get)
    monkeypatch.setattr(importlib, "import_module", modules.__getitem__)
    assert depth_cameras.depth_camera_addresses() == ["realsense://8312", "oak://18443010"]


def test_depth_library_that_does_not_load_is_logged(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(_: str) -> ModuleType:
        raise ImportError("libusb is missing")

    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name == "depthai" or None)
    monkeypatch.setattr(importlib, "import_module", refuse)
    assert depth_cameras.depth_camera_addresses() == []
    assert "libusb" in caplog.text
