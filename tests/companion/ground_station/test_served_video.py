"""The video of the cameras, and what is left without its port."""

from __future__ import annotations

import asyncio
import socket
from typing import Any, cast

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.ground_station import GroundStationError, video
from companion.ground_station.feed import BusFeed
from companion.settings.operator import GroundStationSection
from tests.companion.ground_station.station_harness import CameraHarness, types


def section(port: int, **changes: Any) -> GroundStationSection:
    listen = f"127.0.0.1:{port}"
    return GroundStationSection(url="udpout://127.0.0.1:14550", video_listen=listen, **changes)


async def test_camera_stays_without_video_until_its_port_is_free(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(video, "_RETRY_S", 0.05)
    monkeypatch.setattr("companion.ground_station.gstreamer.SYSTEM_PYTHON", "none")
    harness, lines = CameraHarness(None, streams=0), list[str]()
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        feed = cast("BusFeed", None)  # nobody watches
        task = asyncio.create_task(
            video.serve_video(section(port), [harness.camera], feed, 320, 10.0, lines.append)
        )
        async with asyncio.timeout(10.0):
            while not lines:
                await asyncio.sleep(0.01)
        assert str(port) in lines[0]
        assert not harness.camera.streams
    sent: list[Any] = []
    async with asyncio.timeout(10.0):
        while "CAMERA_INFORMATION" not in types(sent):
            sent += harness.due()
            harness.now_ns += 50_000_000
            await asyncio.sleep(0.01)
    assert f"rtsp://127.0.0.1:{port}/camera" == harness.camera.streams[0].uri
    assert "VIDEO_STREAM_INFORMATION" in types(sent)
    (information,) = [each for each in sent if each.get_type() == "CAMERA_INFORMATION"]
    assert information.flags & mavlink.CAMERA_CAP_FLAGS_HAS_VIDEO_STREAM
    assert len([line for line in lines if str(port) in line]) == 2  # missing, and served
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


async def test_address_that_is_too_long_is_refused_at_once() -> None:
    wanted = section(8554, video_host="a" * 150)
    with pytest.raises(GroundStationError, match="159"):
        await video.serve_video(wanted, [CameraHarness(None).camera], cast("BusFeed", None), 320, 10.0, print)
