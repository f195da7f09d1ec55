"""Video for players: an RTSP 1.0 server (RFC 2326) that sends the JPEG images of the bus as RTP.

A player has one session per connection, over UDP to its own address or inside the connection. A session has
room for one image: what a slow player has not taken is replaced by the next. The same port answers HTTP
requests for a few small documents.
"""

from __future__ import annotations

import asyncio
import hmac
import os
import re
import secrets
import socket
import struct
import time
from asyncio import StreamReader, StreamWriter
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from typing import Any, NamedTuple
from urllib.parse import parse_qs, quote, unquote, urlsplit

from companion.ground_station import GroundStationError
from companion.ground_station.rtp_jpeg import PAYLOAD_TYPE, RtpJpegError, RtpSender, rtp_payloads
from companion.host.passing import AddressTakenError
from companion.host.tasks import spawn
from companion.settings.key_files import is_loopback

LONGEST_URI_BYTES = 159
"""Of VIDEO_STREAM_INFORMATION, with a zero at its end."""
MAX_CONNECTIONS, MAX_VIEWERS = 16, 8
"""In all, and sessions per stream."""
SESSION_TIMEOUT_S, UNREAD_S = 60, 10
"""A player that requests nothing, and one that does not read, is disconnected after this."""
_LARGEST_HEAD_BYTES = _LARGEST_BODY_BYTES = 8 * 1024
_REQUEST_PAUSE_S = 0.005  # a flood of requests leaves the loop to the others
_REPORT_PERIOD_S = 5.0
_SEND_BUFFER_BYTES = 128 * 1024  # what waits in the kernel is old when it arrives
_BURST_PACKETS, _BURST_PAUSE_S = 16, 0.001  # a receiver's buffer may hold less than an image
_PLAYERS_PORTS, _CHANNELS = range(1024, 65536), range(256)
_PROTOCOLS = ("RTP/AVP", "RTP/AVP/UDP", "RTP/AVP/TCP")
_INTERLEAVED = struct.Struct(">cBH")
_METHODS = "OPTIONS, DESCRIBE, SETUP, PLAY, PAUSE, TEARDOWN, GET_PARAMETER, SET_PARAMETER"
_MALFORMED = "400 Bad Request"


def announced_host(listen_host: str, video_host: str | None, station_host: str) -> str:
    """Return the host of announced addresses, IPv6 in brackets.

    Args:
        listen_host: that the server listens on. video_host: the one that the operator set, if any.
        station_host: address of the station or of the router before it; empty: unknown.
    """
    host = video_host or listen_host
    if host in ("0.0.0.0", "::"):
        # Of a station behind a router here only the way to all networks is known. TEST-NET; nothing is sent.
        known = station_host and not is_loopback(station_host)
        host = _address_towards(station_host if known else "192.0.2.1") or "127.0.0.1"
    return f"[{host}]" if ":" in host and not host.startswith("[") else host


def announced_uri(host: str, port: int, path: str) -> str:
    """Return a stream's URI. `host`: of `announced_host`. Raises GroundStationError: too long for MAVLink."""
    uri = f"rtsp://{host}:{port}{path}"
    if len(uri.encode()) > LONGEST_URI_BYTES:
        raise GroundStationError(
            f"the video's address has {len(uri.encode())} bytes, and VIDEO_STREAM_INFORMATION carries "
            f"{LONGEST_URI_BYTES}: a shorter ground_station.video_host, camera name or token is needed"
        )
    return uri


def _reason(error: OSError) -> str:
    """Return the system's text; asyncio replaces it with a longer one."""
    return os.strerror(error.errno) if error.errno is not None and error.errno > 0 else str(error)


def _address_towards(host: str) -> str:
    """Return the address of this computer that packets to a host come from; empty if there is no way."""
    with suppress(OSError):
        family, kind, *_, address = socket.getaddrinfo(host, 9, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, kind) as probe:
            probe.connect(address)
            return str(probe.getsockname()[0]).partition("%")[0]
    return ""


class VideoServer:
    """Serves streams to players until closed.

    Args:
        listen: HOST:PORT. streams: their names: letters, digits, `_`, `-`.
        token: players need it in the address (`?token=`), for documents too; None: none is needed.
        documents: path: content type and bytes, for HTTP.
        on_wanted: called in the loop with a stream's name when somebody plays it, and when nobody does.
        say: called with a line for the operator.

    Attributes:
        host, port: that it listens on; the port once started. viewers: the sessions of each stream.

    Raises:
        GroundStationError: other computers can reach it, and there is no token.
    """

    def __init__(
        self,
        listen: str,
        streams: Iterable[str],
        *,
        token: str | None = None,
        documents: Mapping[str, tuple[str, bytes]] | None = None,
        on_wanted: Callable[[str, bool], None] = lambda _stream, _wanted: None,
        say: Callable[[str], None] = lambda _text: None,
    ) -> None:
        self.host, _, port = listen.rpartition(":")
        self.port = int(port)
        if token is None and not is_loopback(self.host):
            raise GroundStationError(
                f"ground_station.video_listen {listen} is open to other computers: "
                "ground_station.video_token_file must be set"
            )
        self.viewers: dict[str, set[_Viewer]] = {stream: set() for stream in streams}
        self.documents = {} if documents is None else documents
        self._token, self._on_wanted, self._say = token, on_wanted, say
        self._wanted: set[str] = set()
        self._refused: dict[str, str] = {}
        self._connections: dict[Any, StreamWriter] = {}
        self._server: asyncio.Server | None = None

    @property
    def paths(self) -> dict[str, str]:
        """Stream: path and query of its address."""
        return {stream: self.with_token(f"/{stream}") for stream in self.viewers}

    def with_token(self, path: str) -> str:
        """Return a path with the token as its query."""
        return path if self._token is None else f"{path}?token={quote(self._token, safe='')}"

    def token_is(self, text: str) -> bool:
        """Whether a text is the token, or none is needed."""
        given = text.encode("utf-8", "surrogatepass")
        return self._token is None or hmac.compare_digest(given, self._token.encode())

    async def start(self) -> None:
        """Listen. Raises AddressTakenError."""
        try:
            self._server = await asyncio.start_server(
                self._serve, self.host, self.port, limit=_LARGEST_HEAD_BYTES
            )
        except OSError as error:
            raise AddressTakenError(
                f"cannot listen on {self.host}:{self.port}: {_reason(error)}; "
                "ground_station.video_listen sets another address"
            ) from error
        self.port = self._server.sockets[0].getsockname()[1]

    async def close(self) -> None:
        """End all connections."""
        if self._server is not None:
            self._server.close()
        for writer in self._connections.values():
            writer.transport.abort()
        await asyncio.gather(*self._connections, return_exceptions=True)

    def push(self, stream: str, jpeg: bytes, stamp_ns: int) -> None:
        """Send an image to the stream's players. It replaces one that a player has not taken yet.

        Args:
            stamp_ns: when it was captured, CLOCK_MONOTONIC.
        """
        playing = [viewer for viewer in self.viewers[stream] if viewer.playing]
        if not playing:
            return
        try:
            payloads = rtp_payloads(jpeg)
        except RtpJpegError as error:
            if self._refused.get(stream) != (text := f"video {stream}: JPEG: {error}"):
                self._say(text)
            self._refused[stream] = text
            return
        for viewer in playing:
            viewer.offer(payloads, stamp_ns)

    def update_wanted(self, stream: str) -> None:
        """Report whether somebody plays a stream, if that has changed."""
        wanted = any(viewer.playing for viewer in self.viewers[stream])
        if wanted != (stream in self._wanted):
            (self._wanted.add if wanted else self._wanted.discard)(stream)
            self._on_wanted(stream, wanted)

    async def _serve(self, reader: StreamReader, writer: StreamWriter) -> None:
        task = asyncio.current_task()
        try:
            if len(self._connections) >= MAX_CONNECTIONS:
                writer.write(_reply("RTSP/1.0", "503 Service Unavailable", {}))
                return
            self._connections[task] = writer
            await _Connection(self, reader, writer).run()
        finally:
            self._connections.pop(task, None)
            writer.close()


class _Viewer:
    """A session: the way to its player, and the newest image that it has not been sent.

    Args:
        numbers: ports of the player or, with `interleaved`, channels of its connection: of RTP and RTCP.

    Attributes:
        identifier, transport: of the session, as in the reply to SETUP. playing: between PLAY and PAUSE.

    Raises:
        OSError: there are no two ports.
    """

    def __init__(
        self, stream: str, writer: StreamWriter, numbers: tuple[int, int], *, interleaved: bool
    ) -> None:
        self.stream, self.identifier, self.playing = stream, secrets.token_hex(8), False
        self._writer, self._numbers, self._rtp = writer, numbers, RtpSender()
        self._arrived, self._newest = asyncio.Event(), (list[bytes](), 0)
        self._sockets = () if interleaved else _port_pair(writer, numbers)
        ports = [one.getsockname()[1] for one in self._sockets]
        way = (
            "/TCP;unicast;interleaved={}-{}"
            if interleaved
            else ";unicast;client_port={}-{};server_port={}-{}"
        )
        self.transport = f"RTP/AVP{way.format(*numbers, *ports)};ssrc={self._rtp.ssrc:08X}"
        self._sending = spawn(self._send_all(), f"video {stream}")

    def offer(self, payloads: list[bytes], stamp_ns: int) -> None:
        """Replace the image that waits."""
        self._newest = payloads, stamp_ns
        self._arrived.set()

    def close(self) -> None:
        """Send nothing more."""
        self._sending.cancel()
        for one in self._sockets:
            one.close()

    async def _send_all(self) -> None:
        report_s = 0.0
        try:
            while await self._arrived.wait():
                self._arrived.clear()
                packets = self._rtp.packets(*self._newest)
                if (now_s := time.monotonic()) >= report_s:
                    report_s = now_s + _REPORT_PERIOD_S
                    self._send_report(self._rtp.report(time.monotonic_ns(), time.time_ns()))
                async with asyncio.timeout(UNREAD_S):
                    await (self._send_udp(packets) if self._sockets else self._send_tcp(packets))
        except (TimeoutError, OSError):
            self._writer.transport.abort()

    async def _send_tcp(self, packets: Iterable[tuple[bytes, bytes]]) -> None:
        """Send an image inside the connection (RFC 2326, 10.12); returns when the kernel has all of it."""
        channel = self._numbers[0]
        self._writer.write(b"".join(part for one in packets for part in (_framed(channel, *one), *one)))
        await self._writer.drain()

    async def _send_udp(self, packets: Iterable[tuple[bytes, bytes]]) -> None:
        for number, packet in enumerate(packets, 1):
            with suppress(ConnectionError):  # nobody has that port now
                try:
                    self._sockets[0].sendmsg(packet)
                except BlockingIOError:  # the network is slower: this packet is lost
                    await asyncio.sleep(_BURST_PAUSE_S)
            if number % _BURST_PACKETS == 0:
                await asyncio.sleep(_BURST_PAUSE_S)

    def _send_report(self, report: bytes) -> None:
        if not self._sockets:
            self._writer.write(_framed(self._numbers[1], report) + report)
            return
        with suppress(OSError):
            self._sockets[1].send(report)


def _framed(channel: int, *parts: bytes) -> bytes:
    return _INTERLEAVED.pack(b"$", channel, sum(map(len, parts)))


def _port_pair(writer: StreamWriter, ports: tuple[int, int]) -> tuple[socket.socket, ...]:
    """Open two sockets with an even port and the next one (RFC 3550, 11), to ports of a connection's peer.

    To its own address alone, whatever address its request names. Raises OSError.
    """
    local, peer = (writer.get_extra_info(name) for name in ("sockname", "peername"))
    for _ in range(50):
        pair = [socket.socket(writer.get_extra_info("socket").family, socket.SOCK_DGRAM) for _ in range(2)]
        with suppress(OSError):
            pair[0].bind((local[0], 0, *local[2:]))
            first = pair[0].getsockname()[1]
            pair[1].bind((local[0], first + 1, *local[2:]))
            for one, port in zip(pair, ports, strict=True):
                one.setblocking(False)
                one.connect((peer[0], port, *peer[2:]))
            if first % 2 == 0:
                return tuple(pair)
        for one in pair:
            one.close()
    raise OSError("no two ports")


class _Refused(Exception):  # noqa: N818
    """A request that is refused. `status`: code and reason. `closes`: the connection ends."""

    def __init__(self, status: str, *, closes: bool = False) -> None:
        super().__init__(status)
        self.status, self.closes = status, closes


class _Request(NamedTuple):
    """A request without its body. `headers`: names in lower case."""

    method: str
    uri: str
    protocol: str
    headers: Mapping[str, str]


class _Connection:
    """A connection of a player, or of a program that reads a document."""

    def __init__(self, server: VideoServer, reader: StreamReader, writer: StreamWriter) -> None:
        self._server, self._reader, self._writer = server, reader, writer
        self._viewer: _Viewer | None = None
        writer.transport.set_write_buffer_limits(high=0)  # drained: the kernel has all
        writer.get_extra_info("socket").setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER_BYTES)

    async def run(self) -> None:
        """Answer requests until the connection ends."""
        try:
            with suppress(TimeoutError, OSError, asyncio.IncompleteReadError):
                goes_on = True
                while goes_on:
                    goes_on = await self._answer_next()
                    await asyncio.sleep(_REQUEST_PAUSE_S)
        finally:
            self._end_viewer()

    async def _answer_next(self) -> bool:
        """Answer the next request; False: the connection is to end."""
        goes_on, protocol, status, headers, body = True, "RTSP/1.0", "200 OK", dict[str, str](), b""
        try:
            async with asyncio.timeout(SESSION_TIMEOUT_S):
                request = await self._next_request()
            if request is None:
                return True
            if request.method == "GET" and request.protocol.startswith("HTTP/1."):
                goes_on, protocol = False, "HTTP/1.1"
                headers["Content-Type"], body = self._document(request)
            elif request.protocol != "RTSP/1.0" or not request.headers.get("cseq", "").isdecimal():
                newer = request.protocol.startswith("RTSP/2")
                raise _Refused("505 RTSP Version Not Supported" if newer else _MALFORMED, closes=True)
            else:
                headers["CSeq"] = request.headers["cseq"]
                more, body = self._answer(request)
                headers |= more
        except _Refused as refused:
            status, goes_on = refused.status, goes_on and not refused.closes
        self._writer.write(_reply(protocol, status, headers, body))
        async with asyncio.timeout(UNREAD_S):
            await self._writer.drain()
        return goes_on

    async def _next_request(self) -> _Request | None:
        """Read a request; None: an empty line, or a packet about what the player receives."""
        first = await self._reader.readexactly(1)
        if first == b"$":
            size = int.from_bytes((await self._reader.readexactly(3))[1:], "big")
            await self._reader.readexactly(size)
            return None
        if first in b"\r\n":
            return None
        try:
            head = first + await self._reader.readuntil(b"\r\n\r\n")
            line, *rest = head.decode("ascii").rstrip("\r\n").split("\r\n")
            method, uri, protocol = line.split(" ")
            pairs = (one.split(":", 1) for one in rest)
            headers = {name.strip().lower(): value.strip() for name, value in pairs}
            size = int(headers.get("content-length", "0"))
            urlsplit(uri)
        except (asyncio.LimitOverrunError, ValueError):
            raise _Refused(_MALFORMED, closes=True) from None
        if not 0 <= size <= _LARGEST_BODY_BYTES:
            raise _Refused("413 Request Entity Too Large", closes=True)
        await self._reader.readexactly(size)
        return _Request(method, uri, protocol, headers)

    def _path(self, request: _Request) -> str:
        """Return a request's path. Raises _Refused: it has no token or a wrong one."""
        parts = urlsplit(request.uri)
        token = parse_qs(parts.query).get("token", [""])[0]
        if not self._server.token_is(token):
            raise _Refused("403 Forbidden" if token else "401 Unauthorized")
        return unquote(parts.path)

    def _document(self, request: _Request) -> tuple[str, bytes]:
        document = self._server.documents.get(self._path(request))
        if document is None:
            raise _Refused("404 Not Found")
        return document

    def _answer(self, request: _Request) -> tuple[dict[str, str], bytes]:
        """Return headers and body of the reply. Raises _Refused."""
        if request.method == "OPTIONS":
            return {"Public": _METHODS}, b""
        if request.method not in _METHODS.split(", "):
            raise _Refused("501 Not Implemented")
        stream = self._path(request).strip("/")
        if stream not in self._server.viewers:
            raise _Refused("404 Not Found")
        given = request.headers.get("session", "").partition(";")[0].strip()
        if given and (self._viewer is None or given != self._viewer.identifier):
            raise _Refused("454 Session Not Found")
        if request.method == "DESCRIBE":
            return {"Content-Type": "application/sdp"}, self._description(request.uri, stream)
        if request.method == "SETUP":
            self._set_up(stream, request.headers.get("transport", ""))
        if (viewer := self._viewer) is None:
            if request.method in ("GET_PARAMETER", "SET_PARAMETER"):
                return {}, b""
            raise _Refused("455 Method Not Valid in This State")
        headers = {"Session": f"{viewer.identifier};timeout={SESSION_TIMEOUT_S}"}
        if request.method == "SETUP":
            headers["Transport"] = viewer.transport
        elif request.method == "TEARDOWN":
            self._end_viewer()
        elif request.method in ("PLAY", "PAUSE"):
            viewer.playing = request.method == "PLAY"
            self._server.update_wanted(viewer.stream)
        return headers, b""

    def _description(self, uri: str, stream: str) -> bytes:
        """Return the stream's description (SDP, RFC 4566)."""
        host = str(self._writer.get_extra_info("sockname")[0])
        family, anything = ("IP6", "::") if ":" in host else ("IP4", "0.0.0.0")
        lines = (
            "v=0",
            f"o=- {time.time_ns()} 1 IN {family} {host}",
            f"s={stream}",
            f"c=IN {family} {anything}",
        )
        # `control` is the whole address: players put a relative one behind the query, or in its place.
        media = (
            f"m=video 0 RTP/AVP {PAYLOAD_TYPE}",
            f"a=rtpmap:{PAYLOAD_TYPE} JPEG/90000",
            f"a=control:{uri}",
        )
        return "".join(f"{line}\r\n" for line in (*lines, "t=0 0", "a=range:npt=now-", *media)).encode()

    def _set_up(self, stream: str, transports: str) -> None:
        if self._viewer is not None and self._viewer.playing:
            raise _Refused("455 Method Not Valid in This State")
        self._end_viewer()
        if len(self._server.viewers[stream]) >= MAX_VIEWERS:
            raise _Refused("453 Not Enough Bandwidth")
        for offer in transports.split(","):
            protocol, *options = (part.strip() for part in offer.split(";"))
            values = dict(option.partition("=")[::2] for option in options)
            interleaved = protocol == "RTP/AVP/TCP"
            numbers = _pair(
                values.get("interleaved", "0-1") if interleaved else values.get("client_port", "")
            )
            if numbers is None or "multicast" in values or protocol not in _PROTOCOLS:
                continue
            if all(number in (_CHANNELS if interleaved else _PLAYERS_PORTS) for number in numbers):
                with suppress(OSError):  # no ports here: it may take the next one
                    self._viewer = _Viewer(stream, self._writer, numbers, interleaved=interleaved)
                    self._server.viewers[stream].add(self._viewer)
                    return
        raise _Refused("461 Unsupported Transport")

    def _end_viewer(self) -> None:
        if self._viewer is not None:
            viewer, self._viewer = self._viewer, None
            viewer.close()
            self._server.viewers[viewer.stream].discard(viewer)
            self._server.update_wanted(viewer.stream)


def _pair(text: str) -> tuple[int, int] | None:
    """Parse `a-b`, or `a` for a and the next one."""
    found = re.fullmatch(r"([0-9]{1,5})(?:-([0-9]{1,5}))?", text)
    return (int(found[1]), int(found[2] or int(found[1]) + 1)) if found else None


def _reply(protocol: str, status: str, headers: Mapping[str, str], body: bytes = b"") -> bytes:
    lines = [f"{protocol} {status}", *(f"{name}: {value}" for name, value in headers.items())]
    lines.append(f"Content-Length: {len(body)}")
    return "".join(f"{line}\r\n" for line in (*lines, "")).encode() + body
