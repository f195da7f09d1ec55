"""Two cameras of one service for one station, behind the router, with MAVSDK as the station."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from mavsdk.asyncio.plugins.camera import CameraAsync
from pymavlink.dialects.v20 import common as mavlink

from mavlink_sim.testing import free_port
from tests.companion.ground_station.operator_station import operator_station
from tests.companion.ground_station.test_ground_station_process import flight
from tests.companion.ground_station.video_players import ffmpeg
from tests.mavlink_sim.mavsdk_client import wait_for

pytestmark = [pytest.mark.realtime, pytest.mark.slow]

FIRST, SECOND = 100, 101
SIZES = {FIRST: (160, 120), SECOND: (320, 240)}
BOX = (0.25, 0.25, 0.5, 0.5)
"""Left, top, right and bottom of a rectangle on the second camera's pattern, shares of the image."""


@pytest.fixture
def rear(tmp_path: Path, exported_model: Path) -> Path:
    """Settings of a second camera with a still pattern. An untrained network detects nothing in it."""
    folder = tmp_path / "patterned"
    folder.mkdir()
    blocks = np.random.default_rng(2).integers(0, 255, (12, 16), np.uint8)
    cv2.imwrite(str(folder / "0.png"), cv2.resize(blocks, SIZES[SECOND], interpolation=cv2.INTER_CUBIC))
    settings = tmp_path / "two.toml"
    settings.write_text(
        f'[cameras.rear.source]\nuri = "{folder}"\nloop = true\nrate_hz = 10\n'
        f'[cameras.rear.detector]\nenabled = true\nmodel = "{exported_model}"\nimage_size = 160\n'
        "confidence = 0.9\n"
    )
    return settings


async def both(camera: CameraAsync) -> dict[int, Any]:
    """Component id: what MAVSDK knows of a camera, once it knows the sizes of two."""
    listed = await wait_for(
        camera.subscribe_camera_list(),
        lambda each: len(each.cameras) == 2 and all(one.horizontal_resolution_px for one in each.cameras),
    )
    return {one.component_id: one for one in listed.cameras}


async def test_station_uses_two_cameras(filming: list[str], rear: Path, tmp_path: Path) -> None:
    recordings, port, watching = tmp_path / "recordings", free_port(), free_port()
    flags = [*filming, "--config", str(rear), "--recording-directory", str(recordings)]
    flags += ["--ground-station-video-listen", f"127.0.0.1:{port}"]
    with operator_station(f"udpin:127.0.0.1:{watching}", SECOND) as (station, _):
        async with flight(flags, tmp_path, watching) as (_, client):
            camera = client.plugin(CameraAsync)
            cameras = await both(camera)
            names = {number: one.model_name for number, one in cameras.items()}
            assert names == {FIRST: "camera", SECOND: "rear"}
            for number, one in cameras.items():
                assert (one.horizontal_resolution_px, one.vertical_resolution_px) == SIZES[number]

            for number in (FIRST, SECOND):
                waiting = asyncio.create_task(wait_for(camera.subscribe_capture_info()))
                await asyncio.sleep(0)  # the subscription begins
                await camera.take_photo(number)
                capture = await waiting
                assert (capture.component_id, capture.is_success, capture.index) == (number, True, 0)
                photo = cv2.imread(str(recordings / capture.file_url))
                assert photo is not None
                assert photo.shape[1::-1] == SIZES[number]

            for number, name in names.items():
                stream = await camera.get_video_stream_info(number)
                # MAVSDK keeps one stream of a camera: JPEG or, where GStreamer is, H.264.
                ports = (port, port + 1)
                assert stream.settings.uri in [f"rtsp://127.0.0.1:{one}/{name}" for one in ports]
                async with ffmpeg(stream.settings.uri, "tcp") as player:
                    assert player.process.stdout is not None
                    width, height = SIZES[number]
                    await player.process.stdout.readexactly(width * height * 3)

            await camera.track_rectangle(SECOND, *BOX)
            await asyncio.to_thread(
                station.until,
                lambda: [
                    each
                    for _, each in station.of("CAMERA_TRACKING_IMAGE_STATUS")
                    if each.tracking_status == mavlink.CAMERA_TRACKING_STATUS_FLAGS_ACTIVE
                ],
                20.0,
                "tracking",
            )
            status = station.of("CAMERA_TRACKING_IMAGE_STATUS")[-1][1]
            box = (status.rec_top_x, status.rec_top_y, status.rec_bottom_x, status.rec_bottom_y)
            assert box == pytest.approx(BOX, abs=0.02)
            await camera.track_stop(SECOND)
