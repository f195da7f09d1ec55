"""Motion JPEG over HTTP, as web cameras send it (`multipart/x-mixed-replace`).

Images are found by JPEG markers, not by the parts' headers: boundary and Content-Length of cameras are often
wrong. A stream of any other type is opened by FFmpeg.
"""

from __future__ import annotations

import contextlib
import http.client
import os
import socket
import time
import urllib.error
import urllib.request
from collections import deque
from urllib.parse import unquote, urlsplit, urlunsplit

import numpy as np
from numpy.typing import NDArray

from vision.sources.capture import Capture, CaptureError, RawFrame
from vision.sources.mjpeg import MjpegParser
from vision.sources.network import StreamCapture, network_error
from vision.sources.source import SourceError, SourceSettings

_JPEG_TYPES = ("multipart/x-mixed-replace", "image/jpeg", "image/jpg", "video/x-motion-jpeg", "video/x-jpeg")
_REFUSALS = {
    401: "requires a user and password",
    403: "denies access",
    404: "has no such resource",
    410: "no longer has this resource",
}


def open_http(uri: str, settings: SourceSettings) -> Capture:
    """Request the stream.

    Raises:
        SourceError: refused (401, 403, 404, 410).
        CaptureError: no response, or an error that may be temporary.
    """
    parts = urlsplit(uri)
    bare = urlunsplit(parts._replace(netloc=parts.netloc.rpartition("@")[2]))
    try:
        timeout_s = min(settings.open_timeout_s, settings.read_timeout_s)
        response = _opener(uri).open(bare, timeout=timeout_s)
    except urllib.error.HTTPError as error:
        with error:
            text = f"the server {_REFUSALS.get(error.code, 'refuses')} (HTTP {error.code} {error.reason})"
        if error.code == 401:
            text += f"; put them into the address: {parts.scheme}://USER:PASSWORD@{parts.hostname}…"
        if error.code in _REFUSALS:
            raise SourceError(text) from error
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
        self._response = response
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
            except (OSError, http.client.HTTPException) as error:
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
