"""RTP and MPEG-TS over real loopback sockets."""

from __future__ import annotations

import contextlib
import socket
import threading
import time

import numpy as np
import pytest

from mavlink_sim.testing import free_port
from tests.vision.network_streams import QUICK, is_blue, sending, wait_for_frame
from vision.sources import SourceError, SourceSettings, open_source
from vision.sources.network import UdpStream

pytestmark = pytest.mark.realtime


def test_rtp_jpeg_recovers_from_a_sender_restart(caplog: pytest.LogCaptureFixture) -> None:
    port = free_port()
    settings = SourceSettings(open_timeout_s=20.0, read_timeout_s=0.5, retry_min_s=0.05)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        out.connect(("127.0.0.1", port))

        def send(packet: bytes) -> None:
            with contextlib.suppress(ConnectionRefusedError):  # there is no listener yet
                out.send(packet)

        with sending(send):
            source = open_source(f"udp://127.0.0.1:{port}?format=rtp-jpeg", settings)
            frame = wait_for_frame(source, is_blue(200))
            assert (frame.width, frame.height) == (128, 96)
        with source:
            deadline_s = time.monotonic() + 20
            while "lost" not in caplog.text and time.monotonic() < deadline_s:
                source.read(0.05)
            with sending(send, blue=60):
                wait_for_frame(source, is_blue(60))
                assert source.statistics.reopened >= 1


def test_silent_udp_port_names_the_expected_stream(capfd: pytest.CaptureFixture[str]) -> None:
    port = free_port()
    settings = SourceSettings(open_timeout_s=0.5)
    with pytest.raises(SourceError, match=f"no MPEG-TS .*{port}"):
        open_source(f"udp://127.0.0.1:{port}", settings)
    with pytest.raises(SourceError, match=f"no RTP H264 .*{port}"):
        open_source(f"udp://127.0.0.1:{port}?format=rtp-h264", settings)
    assert capfd.readouterr().err == ""


def test_udp_port_in_use_is_reported() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("0.0.0.0", 0))
        port = other.getsockname()[1]
        with pytest.raises(SourceError, match=f"UDP port {port} is in use"):
            open_source(f"udp://127.0.0.1:{port}", SourceSettings(open_timeout_s=0.5))


@pytest.mark.parametrize(
    ("uri", "lines"),
    [
        (
            "udp://:5600?format=rtp-h264",
            ["c=IN IP4 0.0.0.0", "m=video 5600 RTP/AVP 96", "a=rtpmap:96 H264/90000"],
        ),
        (
            "udp://127.0.0.1:7000?format=rtp-h265&payload=98",
            ["m=video 7000 RTP/AVP 98", "a=rtpmap:98 H265/90000"],
        ),
        ("udp://239.1.2.3:7000?format=rtp-jpeg", ["c=IN IP4 239.1.2.3/16", "m=video 7000 RTP/AVP 26"]),
        ("udp://[::1]:7000?format=rtp-jpeg", ["o=- 0 0 IN IP6 ::1", "c=IN IP6 ::1"]),
    ],
)
def test_session_description_matches_the_address(uri: str, lines: list[str]) -> None:
    text = UdpStream(uri, SourceSettings()).session_description().split("\r\n")
    assert set(lines) <= set(text)


def test_a_payload_type_out_of_range_is_rejected() -> None:
    with pytest.raises(SourceError, match=r"payload .*'200'"):
        UdpStream("udp://:5600?format=rtp-h264&payload=200", SourceSettings())


@pytest.mark.parametrize(
    ("container", "codec", "address"),
    [
        pytest.param("mpegts", "mpeg2video", "udp://127.0.0.1:{port}", id="MPEG-TS"),
        pytest.param("rtp", "libx264", "udp://127.0.0.1:{port}?format=rtp-h264", id="RTP H.264"),
    ],
)
def test_an_encoded_stream_over_udp_is_received(container: str, codec: str, address: str) -> None:
    av = pytest.importorskip("av", reason="PyAV encodes the stream; it is not installed")
    if codec not in av.codecs_available:
        pytest.skip(f"this PyAV has no {codec}")
    port = free_port()
    stop = threading.Event()

    def send() -> None:
        scheme = "udp" if container == "mpegts" else "rtp"
        with av.open(f"{scheme}://127.0.0.1:{port}?pkt_size=1316", "w", format=container) as out:
            stream = out.add_stream(codec, rate=30)
            stream.width, stream.height, stream.pix_fmt, stream.gop_size = 128, 96, "yuv420p", 5
            if codec == "libx264":
                stream.options = {"preset": "ultrafast", "tune": "zerolatency"}
            image = np.full((96, 128, 3), (200, 90, 20), np.uint8)
            index = 0
            while not stop.wait(1 / 30):
                video_frame = av.VideoFrame.from_ndarray(image, format="bgr24").reformat(format="yuv420p")
                video_frame.pts = index
                index += 1
                out.mux(stream.encode(video_frame))

    sender = threading.Thread(target=send, daemon=True)
    sender.start()
    try:
        with open_source(address.format(port=port), QUICK) as source:
            frame = wait_for_frame(source, is_blue(200))
            assert (frame.width, frame.height) == (128, 96)
    finally:
        stop.set()
        sender.join()
