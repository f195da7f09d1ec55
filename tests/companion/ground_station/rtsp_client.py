"""A plain client of RTSP, which sends what a test wants, and images that show their number."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
import numpy.typing as npt

from companion.ground_station.rtsp import VideoServer
from tests.companion.ground_station.rtp_jpeg_receiver import Receiver

TCP = "RTP/AVP/TCP;unicast;interleaved=0-1"
_BITS = 8


@cache
def numbered_jpeg(number: int, width: int = 160, height: int = 128) -> bytes:
    """A JPEG image whose columns are light where a bit of its number (0 to 255) is set."""
    bits = [number >> bit & 1 for bit in range(_BITS)]
    row = np.repeat(np.array([40 + 180 * bit for bit in bits], np.uint8), width // _BITS)
    grey = np.broadcast_to(row, (height, len(row)))
    return cv2.imencode(".jpg", np.dstack([grey] * 3))[1].tobytes()


def number_of(pixels: npt.NDArray[np.uint8]) -> int:
    """The number that a decoded image shows."""
    middle = pixels[pixels.shape[0] // 2, :, 1]
    step = len(middle) // _BITS
    return sum(1 << bit for bit in range(_BITS) if middle[bit * step + step // 2] > 128)


async def push_images(
    server: VideoServer, stream: str, rate_hz: float, sent: list[int] | None = None
) -> None:
    """Push numbered images until cancelled. `sent`: their numbers, while somebody plays the stream."""
    loop = asyncio.get_running_loop()
    begun_s = loop.time()
    for count in range(1_000_000):
        await asyncio.sleep(begun_s + count / rate_hz - loop.time())
        if sent is not None and any(viewer.playing for viewer in server.viewers[stream]):
            sent.append(count % 256)
        server.push(stream, numbered_jpeg(count % 256), int(loop.time() * 1e9))


class Reply(NamedTuple):
    """A reply. `headers`: names in lower case."""

    status: int
    headers: dict[str, str]
    body: bytes


class RtspClient:
    """One connection.

    Attributes:
        receiver: of the packets of channel 0. reports: those of channel 1.
    """

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer
        self.receiver, self.reports = Receiver(), list[bytes]()
        self._cseq, self._session = 0, ""

    @classmethod
    async def connect(cls, server: VideoServer) -> RtspClient:
        return cls(*await asyncio.open_connection("127.0.0.1", server.port))

    async def request(self, method: str, uri: str, **headers: str) -> Reply:
        """Send a request with CSeq and the session; returns its reply."""
        self._cseq += 1
        fields = {"CSeq": str(self._cseq), **({"Session": self._session} if self._session else {}), **headers}
        lines = [f"{method} {uri} RTSP/1.0", *(f"{name}: {value}" for name, value in fields.items())]
        reply = await self.raw("".join(f"{line}\r\n" for line in [*lines, ""]).encode())
        if reply.status == 200 and "session" in reply.headers:
            self._session = reply.headers["session"].partition(";")[0]
        return reply

    async def raw(self, request: bytes) -> Reply:
        """Send bytes; returns the next reply. Packets before it are taken."""
        self.writer.write(request)
        while (first := await self.reader.readexactly(1)) == b"$":
            await self._take_packet()
        head = first + await self.reader.readuntil(b"\r\n\r\n")
        line, *fields = head.decode().strip().split("\r\n")
        headers = {name.lower(): value for name, value in (field.split(": ", 1) for field in fields)}
        body = await self.reader.readexactly(int(headers.get("content-length", "0")))
        return Reply(int(line.split(" ")[1]), headers, body)

    async def play(self, uri: str, transport: str = TCP) -> Reply:
        """SETUP and PLAY; returns the reply to SETUP."""
        reply = await self.request("SETUP", uri, Transport=transport)
        assert reply.status == 200
        assert (await self.request("PLAY", uri)).status == 200
        return reply

    async def receive(self, count: int) -> None:
        """Take packets until there are so many images."""
        while len(self.receiver.images) < count:
            assert await self.reader.readexactly(1) == b"$"
            await self._take_packet()

    async def ended(self) -> bool:
        """Take packets until the server ends the connection."""
        with suppress(asyncio.IncompleteReadError, ConnectionError):
            while await self.reader.readexactly(1):
                await self._take_packet()
        return True

    async def _take_packet(self) -> None:
        channel, *size = await self.reader.readexactly(3)
        packet = await self.reader.readexactly(int.from_bytes(bytes(size), "big"))
        if channel == 0:
            self.receiver.take(packet)
        else:
            self.reports.append(packet)
