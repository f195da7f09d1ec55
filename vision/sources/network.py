"""Streams from the network that FFmpeg reads: RTSP, MPEG-TS and RTP over UDP, and some that come by HTTP."""

from __future__ import annotations

import errno
import ipaddress
import os
import socket
import tempfile
from collections.abc import Mapping
from urllib.parse import SplitResult, parse_qsl, urlencode, urlsplit, urlunsplit

import cv2

from vision.sources.capture import Capture, CaptureError, RawFrame
from vision.sources.opencv import open_ffmpeg, read_capture
from vision.sources.source import SourceError, SourceSettings

# Show frames when they come: no reordering buffer before the decoder, and none of its frame threads.
_LOW_LATENCY = {"fflags": "nobuffer", "flags": "low_delay"}

# RFC 3551 (JPEG is the static type 26), RFC 6184 (H.264), RFC 7798 (H.265).
_RTP_FORMATS = {"rtp-h264": "H264/90000", "rtp-h265": "H265/90000", "rtp-jpeg": "JPEG/90000"}
_JPEG_PAYLOAD, _FIRST_DYNAMIC_PAYLOAD = 26, 96
_LONGEST_STEP_S = 1.0  # a larger step in a stream's own time is a break in it, not a pause


def without_password(uri: str) -> str:
    """The address as it may be shown: a user's password replaced by stars."""
    parts = urlsplit(uri)
    if parts.password is None:
        return uri
    host = parts.netloc.rpartition("@")[2]
    return urlunsplit(parts._replace(netloc=f"{parts.username}:***@{host}"))


class StreamCapture(Capture):
    """A stream opened by FFmpeg.

    Args:
        location: an address, or a file that describes one.
        settings: the time-outs.
        options: FFmpeg's.
        reason: says why nothing came, once opening has failed.

    Raises:
        CaptureError: it did not open in `open_timeout_s`.
    """

    def __init__(
        self, location: str, settings: SourceSettings, options: Mapping[str, str], reason: str = ""
    ) -> None:
        self._capture = open_ffmpeg(
            location,
            open_timeout_s=settings.open_timeout_s,
            read_timeout_s=settings.read_timeout_s,
            options=options,
        )
        self._media_s = 0.0
        self._stamp_s: float | None = None
        # RTP's description alone lets FFmpeg open it; without a size nothing has come.
        if not (self._capture.isOpened() and self._capture.get(cv2.CAP_PROP_FRAME_WIDTH) > 0):
            self._capture.release()
            raise CaptureError(reason or "no video stream came")

    def read(self, timeout_s: float) -> RawFrame | None:
        image, captured_ns, decode_ms = read_capture(self._capture)
        if image is None:
            # OpenCV does not tell an end from a silence of `read_timeout_s`.
            raise CaptureError("the stream stopped")
        stamp_s = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0
        step_s = 0.0 if self._stamp_s is None else stamp_s - self._stamp_s
        self._stamp_s = stamp_s
        if 0.0 <= step_s <= _LONGEST_STEP_S:
            self._media_s += step_s
        return RawFrame(image, captured_ns, media_s=self._media_s, decode_ms=decode_ms)

    def close(self) -> None:
        self._capture.release()


def open_rtsp(uri: str, settings: SourceSettings) -> StreamCapture:
    """RTSP (RFC 2326), its media inside the TCP connection; OPENCV_FFMPEG_CAPTURE_OPTIONS can say otherwise.

    Raises:
        CaptureError: nobody answers, or not with video.
    """
    options = {"rtsp_transport": "tcp", **_LOW_LATENCY}
    try:
        return StreamCapture(uri, settings, options)
    except CaptureError as lost:
        raise CaptureError(_why_no_rtsp(uri, min(settings.open_timeout_s, 2.0))) from lost


def _why_no_rtsp(uri: str, timeout_s: float) -> str:
    """Ask the server ourselves, since OpenCV tells nobody why FFmpeg failed."""
    parts = urlsplit(uri)
    host, port = parts.hostname or "", parts.port or (322 if parts.scheme == "rtsps" else 554)
    if parts.scheme == "rtsps":
        request = b""
    else:
        bare = urlunsplit(parts._replace(netloc=parts.netloc.rpartition("@")[2]))
        request = f"DESCRIBE {bare} RTSP/1.0\r\nCSeq: 1\r\nAccept: application/sdp\r\n\r\n".encode()
    try:
        with socket.create_connection((host, port), timeout_s) as connection:
            if not request:
                return f"{host}:{port} answers, but not with video"
            connection.sendall(request)
            answer = connection.recv(4096).split(b"\r\n")[0].decode("ascii", "replace")
    except OSError as error:
        return f"{host}:{port} {network_error(error)}"
    if " 401 " in answer:
        return (
            f"{host}:{port} asks for a user and password ({answer}); put the right ones into the address: "
            f"rtsp://USER:PASSWORD@{host}…"
        )
    if answer.startswith("RTSP/") and " 200 " not in f"{answer} ":
        return f"{host}:{port} answers {answer!r}; is the path right?"
    return f"{host}:{port} answers, but no video that FFmpeg can read came"


def network_error(error: OSError) -> str:
    if isinstance(error, socket.gaierror):
        return "is not a name that the network knows"
    if isinstance(error, TimeoutError):
        return "does not answer"
    return f"cannot be reached: {(error.strerror or str(error)).lower()}"


class UdpStream:
    """A UDP port that MPEG-TS or RTP is sent to: `udp://HOST:PORT[?format=…]`.

    `format` is `mpegts` (the default), `rtp-h264`, `rtp-h265` or `rtp-jpeg`; `payload` the RTP payload type
    where it is not the usual one. An empty host means every interface; a multicast group is joined. Other
    parameters go to FFmpeg.

    Raises:
        SourceError: the address makes no sense.
    """

    def __init__(self, uri: str, settings: SourceSettings) -> None:
        self._settings = settings
        parts = urlsplit(uri)
        query = dict(parse_qsl(parts.query, keep_blank_values=True))
        self._format = query.pop("format", "mpegts")
        if self._format != "mpegts" and self._format not in _RTP_FORMATS:
            raise SourceError(
                f"{uri}: format must be mpegts, {', '.join(_RTP_FORMATS)}, got {self._format!r}"
            )
        self._host, self._port = _udp_address(uri, parts)
        payload = query.pop("payload", "")
        usual = _JPEG_PAYLOAD if self._format == "rtp-jpeg" else _FIRST_DYNAMIC_PAYLOAD
        if payload and not (payload.isdecimal() and int(payload) <= 127):
            raise SourceError(f"{uri}: payload must be an RTP payload type from 0 to 127, got {payload!r}")
        self._payload = int(payload) if payload else usual
        self._query = query

    def open_capture(self) -> StreamCapture:
        """Open the port and wait for video on it."""
        if self._format == "mpegts":
            host = f"[{self._host}]" if ":" in self._host else self._host
            query = {"overrun_nonfatal": "1", "fifo_size": "50000", **self._query}
            location = f"udp://{host}:{self._port}?{urlencode(query)}"
            return self._open(location, _LOW_LATENCY)
        with tempfile.NamedTemporaryFile("w", suffix=".sdp", prefix="companion-") as description:
            description.write(self.session_description())
            description.flush()
            options = {"protocol_whitelist": "file,udp,rtp", **_LOW_LATENCY}
            return self._open(description.name, options)

    def _open(self, location: str, options: Mapping[str, str]) -> StreamCapture:
        try:
            return StreamCapture(location, self._settings, options)
        except CaptureError as lost:
            raise CaptureError(self._why_nothing()) from lost

    def session_description(self) -> str:
        """What the sender sends, in SDP (RFC 4566): FFmpeg cannot tell from RTP packets alone."""
        family = "IP6" if ":" in self._host else "IP4"
        group = "/16" if family == "IP4" and ipaddress.ip_address(self._host).is_multicast else ""
        lines = [
            "v=0",
            f"o=- 0 0 IN {family} {self._host}",
            "s=video",
            f"c=IN {family} {self._host}{group}",
            "t=0 0",
            f"m=video {self._port} RTP/AVP {self._payload}",
            f"a=rtpmap:{self._payload} {_RTP_FORMATS[self._format]}",
        ]
        return "\r\n".join(lines) + "\r\n"

    def _why_nothing(self) -> str:
        family = socket.AF_INET6 if ":" in self._host else socket.AF_INET
        try:
            with socket.socket(family, socket.SOCK_DGRAM) as probe:
                probe.bind(("", self._port))
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                return f"UDP port {self._port} is taken by another program"
            return f"UDP port {self._port} cannot be opened: {os.strerror(error.errno or 0).lower()}"
        what = "MPEG-TS" if self._format == "mpegts" else f"RTP {_RTP_FORMATS[self._format].split('/')[0]}"
        return f"no {what} came on UDP port {self._port}"


def _udp_address(uri: str, parts: SplitResult) -> tuple[str, int]:
    try:
        port = parts.port
    except ValueError:
        port = None
    if port is None or port == 0:
        raise SourceError(f"{uri}: expected udp://HOST:PORT with a port from 1 to 65535")
    host = parts.hostname or "0.0.0.0"
    try:
        return str(ipaddress.ip_address(host)), port
    except ValueError:
        pass
    try:
        return str(socket.getaddrinfo(host, port, socket.AF_INET, socket.SOCK_DGRAM)[0][4][0]), port
    except OSError as error:
        raise SourceError(f"{uri}: {host!r} is not an address or name of this network") from error
