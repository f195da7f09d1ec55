"""The cameras' video: two servers, what the cameras announce of them, and images while somebody watches."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from functools import partial

from pymavlink.dialects.v20 import common as mavlink

from companion.ground_station import GroundStationError
from companion.ground_station.camera import Camera, VideoStream
from companion.ground_station.component import Message
from companion.ground_station.feed import BusFeed
from companion.ground_station.gstreamer import H264Server
from companion.ground_station.rtsp import VideoServer, announced_host, announced_uri
from companion.host.passing import AddressTakenError
from companion.settings.key_files import KeyFileError, read_token
from companion.settings.operator import GroundStationSection
from companion.vehicle.link_url import LinkScheme, parse_link_url

LONGEST_DEFINITION_URI_BYTES = 139
"""Of CAMERA_INFORMATION, with a zero at its end."""
_RETRY_S = 5.0


async def serve_video(
    section: GroundStationSection,
    cameras: Sequence[Camera],
    feed: BusFeed,
    image_width: int,
    rate_hz: float,
    say: Callable[[str], None],
) -> None:
    """Serve the cameras' video until cancelled. While another program has its port, only video is missing.

    Args:
        section: with `url` and `video_listen`. image_width, rate_hz: at most.

    Raises:
        GroundStationError: the token is missing or not acceptable, or an address is too long to be announced.
    """
    assert section.video_listen is not None
    assert section.url is not None
    try:
        name = "ground_station.video_token_file"
        token = None if section.video_token_file is None else read_token(section.video_token_file, name)
    except KeyFileError as error:
        raise GroundStationError(str(error)) from None
    streams = {camera.name or "camera": camera for camera in cameras}
    if len(streams) < len(cameras):
        raise GroundStationError("a camera's name is `camera`, as the video of the first one: rename it")

    documents: dict[str, tuple[str, bytes]] = {}
    pushes: dict[str, Callable[[str, bytes, int], None]] = {}

    def want(kind: str, stream: str, wanted: bool) -> None:
        feed.want_images(streams[stream].name, kind, partial(pushes[kind], stream) if wanted else None)

    jpeg = VideoServer(
        section.video_listen,
        streams,
        token=token,
        documents=documents,
        on_wanted=partial(want, "RTP/JPEG"),
        say=say,
    )
    url = parse_link_url(section.url)
    known = url.scheme in (LinkScheme.UDP_OUT, LinkScheme.TCP)
    host = announced_host(jpeg.host, section.video_host, url.address[0] if known else "")
    for path in jpeg.paths.values():
        announced_uri(host, jpeg.port, path)
    await _start(jpeg, say)
    h264 = H264Server(
        jpeg.host,
        jpeg.port + 1,
        streams,
        token=token,
        on_wanted=partial(want, "H.264"),
        say=say,
    )
    pushes |= {"RTP/JPEG": jpeg.push, "H.264": h264.push}

    def define(stream: str, camera: Camera, _now_ns: int) -> list[Message]:
        if camera.definition is None:
            return []
        content, version = camera.definition
        path = f"/{stream}.xml"
        if documents.get(path, ("", b""))[1] == content:
            return []
        documents[path] = "application/xml", content
        uri = f"http://{host}:{jpeg.port}{jpeg.with_token(path)}"
        if len(uri.encode()) <= LONGEST_DEFINITION_URI_BYTES:
            camera.define(uri, version)
        elif camera.needs_definition:
            camera.define("", 0)
            say(
                f"parameters of camera {camera.label} are not announced: the address of their definition has "
                f"{len(uri.encode())} bytes, and CAMERA_INFORMATION carries {LONGEST_DEFINITION_URI_BYTES}: "
                "a shorter ground_station.video_host, camera name or token is needed"
            )
        return []

    def announce(stream: str, camera: Camera, _now_ns: int) -> list[Message]:
        width = min(camera.size[0], image_width)
        size = (width, round(camera.size[1] * width / camera.size[0])) if width else (0, 0)
        uri = announced_uri(host, jpeg.port, jpeg.paths[stream])
        found = [VideoStream(f"{stream} JPEG", uri, size, rate_hz=rate_hz)]
        if h264.is_ready:
            uri = announced_uri(host, h264.port, h264.paths[stream])
            found.append(
                VideoStream(f"{stream} H.264", uri, size, mavlink.VIDEO_STREAM_ENCODING_H264, rate_hz)
            )
        return camera.show_streams(found)

    try:
        for stream, camera in streams.items():
            camera.sources += [partial(announce, stream, camera), partial(define, stream, camera)]
        await h264.start()
        await asyncio.Event().wait()
    finally:
        await h264.close()
        await jpeg.close()


async def _start(server: VideoServer, say: Callable[[str], None]) -> None:
    """Listen, however late the port is free."""
    said = False
    while True:
        try:
            await server.start()
        except AddressTakenError as error:
            if not said:
                say(f"no video until its port is free: {error}")
            said = True
            await asyncio.sleep(_RETRY_S)
        else:
            if said:
                say(f"video is served now, at {server.host}:{server.port}")
            return
