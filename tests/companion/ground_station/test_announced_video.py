"""Video as a station finds it: announced by the process beside a real service, and played by ffmpeg."""

from __future__ import annotations

from pathlib import Path

import pytest
from mavsdk.asyncio.plugins.camera import CameraAsync

from mavlink_sim.testing import free_port
from tests.companion.ground_station.test_ground_station_process import flight, found
from tests.companion.ground_station.video_players import ffmpeg
from tests.mavlink_sim.mavsdk_client import wait_for

pytestmark = [pytest.mark.realtime, pytest.mark.slow]
TOKEN = "0123456789abcdef"


async def test_announced_address_is_played(filming: list[str], tmp_path: Path) -> None:
    token = tmp_path / "token"
    token.touch(0o600)
    token.write_text(TOKEN)
    port = free_port()
    flags = [*filming, "--ground-station-video-listen", f"127.0.0.1:{port}"]
    flags += ["--ground-station-video-token-file", str(token)]
    async with flight(flags, tmp_path) as (_, client):
        camera = client.plugin(CameraAsync)
        await found(camera)
        update = await wait_for(camera.subscribe_video_stream_info())
        stream = update.video_stream_info.settings
        assert stream.uri == f"rtsp://127.0.0.1:{port}/camera?token={TOKEN}"
        assert (stream.horizontal_resolution_pix, stream.vertical_resolution_pix) == (160, 120)
        async with ffmpeg(stream.uri, "tcp") as player:
            assert player.process.stdout is not None
            for _ in range(5):
                await player.process.stdout.readexactly(160 * 120 * 3)
