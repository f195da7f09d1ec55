"""Network streams: RTSP, MPEG-TS and RTP over UDP, read by FFmpeg; Motion JPEG over HTTP."""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import os
import re
import socket
import tempfile
import time
from collections import deque
from collections.abc import Mapping
from typing import TYPE_CHECKING
from urllib.parse import SplitResult, parse_qsl, unquote, urlencode, urlsplit, urlunsplit

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.redaction import HIDDEN, without_password
from vision.sources.capture import Capture, CaptureError, RawFrame
from vision.sources.opencv import interval_of, open_ffmpeg, read_capture
from vision.sources.source import SourceError, SourceSettings, SourceUnavailableError
from vision.sources.stream_formats import MjpegParser

# The HTTP library is imported by what uses it: every program with settings imports this module.
if TYPE_CHECKING:
    import http.client
    import urllib.request

# No reordering buffer before the decoder, and no frame threads in it.
_LOW_LATENCY = {"fflags": "nobuffer", "flags": "low_delay"}

# RFC 3551 (JPEG is the static type 26), RFC 6184 (H.264), RFC 7798 (H.265).
_RTP_FORMATS = {"rtp-h264": "H264/90000", "rtp-h265": "H265/90000", "rtp-jpeg": "JPEG/90000"}
_JPEG_PAYLOAD, _FIRST_DYNAMIC_PAYLOAD = 26, 96
_JPEG_TYPES = ("multipart/x-mixed-replace", "image/jpeg", "image/jpg", "video/x-motion-jpeg", "video/x-jpeg")
_HTTP_ERRORS = {
    401: "requires a user and password",
    403: "denies access",
    404: "has no such resource",
    410: "no longer has this resource",
}


_ENCODED = {"#": "%23", "/": "%2F", "?": "%3F"}


def check_user_info(uri: str) -> None:
    """Check that user, password and port of a network address are read as they are meant.

    Raises:
        SourceError: a `#`, `/` or `?` in the password ends it there, the password is stars, or the port is
            no number.
    """
    rest = uri.partition("://")[2]
    authority = re.split("[/?#]", rest, maxsplit=1)[0]
    port, after = authority.rpartition(":")[2], rest[len(authority) :]
    cut = "@" in after and "@" not in authority and ":" in authority
    if cut and (not port.isdecimal() or after.startswith("#")):
        found = [each for each in _ENCODED if each in rest.rpartition("@")[0]]
        remedy = ", ".join(f"{each} as {_ENCODED[each]}" for each in found)
        raise SourceError(
            f"{without_password(uri)}: the user or password has a character that ends it: "
            f"percent-encode {remedy}"
        )
    try:
        parts = urlsplit(uri)
        valid = parts.port != 0
        stars = parts.password == HIDDEN
    except ValueError:  # its text may have the password
        valid = stars = False
    if stars:
        raise SourceError(f"{uri}: the password was removed from this address: write it there")
    if not valid:
        raise SourceError(
            f"{without_password(uri)}: expected SCHEME://USER:PASSWORD@HOST:PORT with a port from 1 to 65535"
        )


class StreamCapture(Capture):
    """A stream opened by FFmpeg.

    Args:
        location: an address, or a file that describes one.
        settings: timeouts.
        options: of FFmpeg.
        reason: error text if opening fails.

    Raises:
        CaptureError: it did not open within `open_timeout_s`.
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
        # FFmpeg opens RTP by its description alone; without a size no data has arrived.
        if not (self._capture.isOpened() and self._capture.get(cv2.CAP_PROP_FRAME_WIDTH) > 0):
            self._capture.release()
            raise CaptureError(reason or "no video stream received")
        self.interval_s = interval_of(self._capture)

    def read(self, timeout_s: float) -> RawFrame | None:
        image, captured_ns, decode_ms = read_capture(self._capture, "the stream")
        if image is None:
            # OpenCV does not distinguish the end of a stream from a timeout of `read_timeout_s`.
            raise CaptureError("the stream stopped")
        stamp_s = self._capture.get(cv2.CAP_PROP_POS_MSEC) / 1000.0
        return RawFrame(image, captured_ns, media_s=stamp_s, decode_ms=decode_ms)

    def close(self) -> None:
        self._capture.release()


def open_rtsp(uri: str, settings: SourceSettings) -> StreamCapture:
    """RTSP (RFC 2326) over TCP; OPENCV_FFMPEG_CAPTURE_OPTIONS can override the transport.

    Raises:
        CaptureError: no response, or no video in it.
    """
    options = {"rtsp_transport": "tcp", **_LOW_LATENCY}
    try:
        return StreamCapture(uri, settings, options)
    except CaptureError as lost:
        raise CaptureError(_rtsp_problem(uri, min(settings.open_timeout_s, 2.0))) from lost


def _rtsp_problem(uri: str, timeout_s: float) -> str:
    """Query the server directly, since OpenCV does not report why FFmpeg failed."""
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
                return f"{host}:{port} responds, but without video"
            connection.sendall(request)
            answer = connection.recv(4096).split(b"\r\n")[0].decode("ascii", "replace")
    except OSError as error:
        return f"{host}:{port} {network_error(error)}"
    if " 401 " in answer:
        return (
            f"{host}:{port} requires a user and password ({answer}); put them into the address: "
            f"rtsp://USER:PASSWORD@{host}…"
        )
    if answer.startswith("RTSP/") and " 200 " not in f"{answer} ":
        return f"{host}:{port} responds {answer!r}; check the path"
    return f"{host}:{port} responds, but sent no video that FFmpeg can read"


def network_error(error: OSError) -> str:
    if isinstance(error, socket.gaierror):
        return "cannot be resolved"
    if isinstance(error, TimeoutError):
        return "does not respond"
    return f"cannot be reached: {(error.strerror or str(error)).lower()}"


class UdpStream:
    """A UDP port that receives MPEG-TS or RTP: `udp://HOST:PORT[?format=…]`.

    `format` is `mpegts` (the default), `rtp-h264`, `rtp-h265` or `rtp-jpeg`; `payload` the RTP payload type
    if not the usual one. An empty host means every interface; a multicast group is joined. Other parameters
    go to FFmpeg.

    Raises:
        SourceError: the address is invalid.
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
        """Open the port and wait for video."""
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
            raise CaptureError(self._problem()) from lost

    def session_description(self) -> str:
        """The stream's description in SDP (RFC 4566): FFmpeg cannot derive it from RTP packets."""
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

    def _problem(self) -> str:
        family = socket.AF_INET6 if ":" in self._host else socket.AF_INET
        try:
            with socket.socket(family, socket.SOCK_DGRAM) as probe:
                probe.bind(("", self._port))
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                return f"UDP port {self._port} is in use by another program"
            return f"UDP port {self._port} cannot be opened: {os.strerror(error.errno or 0).lower()}"
        what = "MPEG-TS" if self._format == "mpegts" else f"RTP {_RTP_FORMATS[self._format].split('/')[0]}"
        return f"no {what} received on UDP port {self._port}"


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
        raise SourceUnavailableError(f"{uri}: {host!r} is not an address and cannot be resolved") from error


def open_http(uri: str, settings: SourceSettings) -> Capture:
    """Request the stream.

    Raises:
        SourceUnavailableError: refused (401, 403, 404, 410).
        CaptureError: no response, or an error that may be temporary.
    """
    import http.client
    import urllib.error

    parts = urlsplit(uri)
    bare = urlunsplit(parts._replace(netloc=parts.netloc.rpartition("@")[2]))
    try:
        timeout_s = min(settings.open_timeout_s, settings.read_timeout_s)
        response = _opener(uri).open(bare, timeout=timeout_s)
    except urllib.error.HTTPError as error:
        with error:
            text = f"the server {_HTTP_ERRORS.get(error.code, 'refuses')} (HTTP {error.code} {error.reason})"
        if error.code == 401:
            text += f"; put them into the address: {parts.scheme}://USER:PASSWORD@{parts.hostname}…"
        if error.code in _HTTP_ERRORS:
            raise SourceUnavailableError(text) from error
        raise CaptureError(text) from error
    except urllib.error.URLError as error:
        cause = error.reason if isinstance(error.reason, OSError) else OSError(str(error.reason))
        raise CaptureError(f"{parts.hostname}:{parts.port or parts.scheme} {network_error(cause)}") from error
    except (OSError, http.client.HTTPException) as error:
        raise CaptureError(f"no HTTP response: {error!r}") from error
    if response.headers.get_content_type() in _JPEG_TYPES:
        return HttpMjpegCapture(response)
    kind = response.headers.get_content_type()
    response.close()
    return StreamCapture(uri, settings, {}, f"the server sends {kind}, which FFmpeg cannot read as video")


def _opener(uri: str) -> urllib.request.OpenerDirector:
    import urllib.request

    parts = urlsplit(uri)
    if parts.username is None:
        return urllib.request.build_opener()
    passwords = urllib.request.HTTPPasswordMgrWithDefaultRealm()
    root = f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}/"
    passwords.add_password(None, root, unquote(parts.username), unquote(parts.password or ""))
    return urllib.request.build_opener(
        urllib.request.HTTPDigestAuthHandler(passwords), urllib.request.HTTPBasicAuthHandler(passwords)
    )


class HttpMjpegCapture(Capture):
    """The images of an endless HTTP response."""

    def __init__(self, response: http.client.HTTPResponse) -> None:
        import http.client

        self._response = response
        self._errors = (OSError, http.client.HTTPException)
        self._parser = MjpegParser()
        self._ready: deque[tuple[NDArray[np.uint8], int, float]] = deque()
        # A second descriptor of the same connection, to end a read from another thread.
        self._socket = socket.socket(fileno=os.dup(response.fileno()))

    def read(self, timeout_s: float) -> RawFrame | None:
        while not self._ready:
            try:
                data = self._response.read1(1 << 16)
            except TimeoutError as error:
                raise CaptureError("no more data arrived") from error
            except self._errors as error:
                raise CaptureError(f"the connection failed: {error}") from error
            if not data:
                raise CaptureError("the server closed the connection")
            captured_ns = time.monotonic_ns()
            images = self._parser.push(data)
            decode_ms = (time.monotonic_ns() - captured_ns) / 1e6 / max(len(images), 1)
            self._ready.extend((image, captured_ns, decode_ms) for image in images)
            self.unreadable = self._parser.unreadable
        image, captured_ns, decode_ms = self._ready.popleft()
        return RawFrame(image, captured_ns, decode_ms=decode_ms)

    def interrupt(self) -> None:
        with contextlib.suppress(OSError):  # already closed
            self._socket.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self._socket.close()
        self._response.close()
