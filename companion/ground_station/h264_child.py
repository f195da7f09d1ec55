"""H.264 over RTSP, made of JPEG images by GStreamer. The system's Python runs this file (3.9 or later).

It imports nothing but the standard library and gi. Standard input: a line of JSON, then `HEADER` and a JPEG
for each image; its end ends the program. It prints `ready PORT ENCODER`, `wanted STREAM 0` or `1`, and lines
for people.
"""

from __future__ import annotations

import json
import os
import socket
import struct
import sys
import threading
from typing import Any, BinaryIO

HEADER = struct.Struct("<BI")
"""Number of the stream, bytes of the image."""
EXIT_REFUSED, EXIT_PASSING = 2, 75
MAX_CONNECTIONS, MAX_VIEWERS = 16, 8
UNREAD_S, SILENT_S = 10, 60
"""A player that takes nothing, and a connection without life, ends after this; as in `rtsp`."""
PACKAGES = "python3-gi gir1.2-gst-rtsp-server-1.0 gstreamer1.0-plugins-base -good -bad"
_SEND_BUFFER_BYTES = 128 * 1024
_BITRATE, _KEY_FRAME_EVERY = 2_000_000, 15
_TRIAL_S = 5
# JPEG has the full range of values, which players do not expect of H.264. From I420 to I420 it would stay.
LIMITED_RANGE = (
    "videoconvert ! video/x-raw,format=BGRx ! videoconvert ! video/x-raw,format=I420,colorimetry=bt601"
)
# The boards' own encoders first: NVIDIA Jetson, then V4L2 (Raspberry Pi 4). Never x264, which is GPL.
ENCODERS = {
    "nvv4l2h264enc": "nvvidconv ! video/x-raw(memory:NVMM),format=I420 ! nvv4l2h264enc insert-sps-pps=true "
    f"bitrate={_BITRATE} iframeinterval={_KEY_FRAME_EVERY} idrinterval={_KEY_FRAME_EVERY}",
    "v4l2h264enc": 'v4l2h264enc extra-controls="controls,repeat_sequence_header=1,'
    f'video_bitrate={_BITRATE},h264_i_frame_period={_KEY_FRAME_EVERY}" ! video/x-h264,level=(string)4',
    "openh264enc": "openh264enc complexity=low rate-control=bitrate "
    f"bitrate={_BITRATE} gop-size={_KEY_FRAME_EVERY}",
}


def main(frames: BinaryIO) -> int:
    """Serve until the input ends; returns the exit code."""
    options = json.loads(frames.readline())
    try:
        import gi

        for name in ("Gst", "GstRtsp", "GstRtspServer"):
            gi.require_version(name, "1.0")
        from gi.repository import GLib, Gst, GstRtsp, GstRtspServer
    except (ImportError, ValueError) as error:
        say(f"no H.264: {error} (Debian: {PACKAGES})")
        return EXIT_REFUSED
    Gst.init(None)
    encoder = next((name for name in ENCODERS if _works(Gst, ENCODERS[name])), None)
    if encoder is None:
        say(f"no H.264: no encoder works of {', '.join(ENCODERS)} (Debian: {PACKAGES})")
        return EXIT_REFUSED
    server = GstRtspServer.RTSPServer()
    server.set_address(options["host"])
    server.set_service(str(options["port"]))
    sources: dict[int, Any] = {}
    for number, (stream, path) in enumerate(options["paths"].items()):
        factory = GstRtspServer.RTSPMediaFactory()
        factory.set_launch(
            "( appsrc name=source is-live=true do-timestamp=true format=time caps=image/jpeg ! jpegdec ! "
            f"{LIMITED_RANGE} ! {ENCODERS[encoder]} ! h264parse ! "
            "rtph264pay name=pay0 pt=96 config-interval=-1 )"
        )
        factory.set_shared(True)  # one encoder for all its viewers
        factory.set_protocols(GstRtsp.RTSPLowerTrans.UDP | GstRtsp.RTSPLowerTrans.TCP)
        factory.connect("media-configure", _on_media, sources, number, stream)
        server.get_mount_points().add_factory(path, factory)
    sessions = server.get_session_pool()
    sessions.set_max_sessions(MAX_VIEWERS * len(options["paths"]))
    GLib.timeout_add_seconds(5, lambda: sessions.cleanup() >= 0)
    clients: set[Any] = set()
    server.connect("client-connected", _on_client, clients)
    if not server.attach(None):
        say(
            f"no H.264: cannot listen on {options['host']}:{options['port']}, the port after that of "
            "ground_station.video_listen: another program has it"
        )
        return EXIT_PASSING
    say(f"ready {server.get_bound_port()} {encoder}")
    threading.Thread(target=_read, args=(frames, sources, Gst), daemon=True).start()
    GLib.MainLoop().run()
    return 0


def say(text: str) -> None:
    print(text, flush=True)


def _works(gst: Any, encoder: str) -> bool:
    """Whether an encoder is installed and encodes: a board's may be there without its device."""
    try:
        trial = gst.parse_launch(
            "videotestsrc num-buffers=3 ! video/x-raw,width=320,height=240,framerate=15/1 ! "
            f"{LIMITED_RANGE} ! {encoder} ! fakesink"
        )
    except Exception:  # GLib.Error: no such element
        return False
    trial.set_state(gst.State.PLAYING)
    ends = gst.MessageType.EOS | gst.MessageType.ERROR
    message = trial.get_bus().timed_pop_filtered(_TRIAL_S * gst.SECOND, ends)
    trial.set_state(gst.State.NULL)
    return message is not None and message.type == gst.MessageType.EOS


def _on_media(_factory: Any, media: Any, sources: dict[int, Any], number: int, stream: str) -> None:
    def end(_media: Any) -> None:
        sources.pop(number, None)
        say(f"wanted {stream} 0")

    media.connect("unprepared", end)
    sources[number] = media.get_element().get_by_name("source")
    say(f"wanted {stream} 1")


def _on_client(_server: Any, client: Any, clients: set[Any]) -> None:
    if len(clients) >= MAX_CONNECTIONS:
        client.close()
        return
    clients.add(client)
    client.connect("closed", clients.discard)
    # GStreamer leaves such connections open, until there are too many: the kernel ends them.
    connection = client.get_connection().get_read_socket()
    connection.set_keepalive(True)
    for level, name, value in (
        (socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES),
        (socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 1000 * UNREAD_S),
        (socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, SILENT_S),
        (socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, UNREAD_S),
    ):
        connection.set_option(level, name, value)


def _read(frames: BinaryIO, sources: dict[int, Any], gst: Any) -> None:
    """Give each image to the encoder of its stream; it is dropped while that has not taken the one before."""
    try:
        while len(header := frames.read(HEADER.size)) == HEADER.size:
            number, size = HEADER.unpack(header)
            jpeg = frames.read(size)
            source = sources.get(number)
            if source is not None and source.get_property("current-level-bytes") == 0:
                source.emit("push-buffer", gst.Buffer.new_wrapped(jpeg))
    finally:
        os._exit(0)  # GStreamer's threads need no end


if __name__ == "__main__":
    try:
        code = main(sys.stdin.buffer)
    except Exception as error:  # the parent reads lines, and no traceback
        say(f"{type(error).__name__}: {error}")
        code = 1
    sys.exit(code)
