"""Reads one file of an autopilot by MAVLink FTP (https://mavlink.io/en/services/ftp.html)."""

from __future__ import annotations

import asyncio
import contextlib
import struct
from collections.abc import Callable

from companion.vehicle.framing import Frame

FTP_ID = 110  # FILE_TRANSFER_PROTOCOL
_TERMINATE, _RESET, _OPEN, _READ, _ACK = 1, 2, 4, 5, 128
_END_OF_FILE = 6
_ERRORS = {1: "failed", 2: "failed: errno", 4: "wrong session", 5: "no free session", 10: "no such file"}
# target network, system, component; sequence, session, opcode, size, request opcode, burst, padding, offset
_HEADER = struct.Struct("<3BHBBBBBBI")
_DATA = 239
_ATTEMPTS, _ATTEMPT_S = 6, 0.5
LARGEST_FILE = 4 * 1024 * 1024


class FileReadError(OSError):
    """The file cannot be read. The message says which and why."""


class FileReader:
    """Reads one file at a time.

    Args:
        send: sends one payload of FILE_TRANSFER_PROTOCOL.
        target: returns system and component id of the autopilot.
    """

    def __init__(self, send: Callable[[int, bytes], None], target: Callable[[], tuple[int, int]]) -> None:
        self._send, self._target = send, target
        self._sequence = 0
        self._answer: asyncio.Future[bytes] | None = None

    def on_frame(self, frame: Frame) -> None:
        """Process a reply of the autopilot."""
        payload = frame.padded(_HEADER.size + _DATA)
        sequence = _HEADER.unpack_from(payload)[3]
        if self._answer is not None and not self._answer.done() and sequence == self._sequence + 1 & 0xFFFF:
            self._answer.set_result(payload)

    async def read(self, path: str) -> bytes:
        """Return the content of a file. Raises FileReadError."""
        await self._request(path, _RESET)  # closes sessions that were left open
        session, opened = await self._request(path, _OPEN, path.encode())
        size = int.from_bytes(opened[:4], "little")
        if size > LARGEST_FILE:
            raise FileReadError(f"{path}: {size} bytes exceed the limit of {LARGEST_FILE}")
        content = b""
        try:
            while len(content) < size:
                _, part = await self._request(path, _READ, session=session, offset=len(content), size=_DATA)
                if not part:
                    raise FileReadError(f"{path}: truncated after {len(content)} of {size} bytes")
                content += part
        finally:
            with contextlib.suppress(FileReadError):
                await self._request(path, _TERMINATE, session=session)
        return content

    async def _request(
        self, path: str, opcode: int, data: bytes = b"", *, session: int = 0, offset: int = 0, size: int = 0
    ) -> tuple[int, bytes]:
        """Send one request, repeated until answered; returns the session and the reply's data."""
        self._sequence = self._sequence + 2 & 0xFFFF
        system, component = self._target()
        header = _HEADER.pack(
            0, system, component, self._sequence, session, opcode, size or len(data), 0, 0, 0, offset
        )
        for _ in range(_ATTEMPTS):
            self._answer = asyncio.get_running_loop().create_future()
            self._send(FTP_ID, (header + data).ljust(_HEADER.size + _DATA, b"\0"))
            await asyncio.wait([self._answer], timeout=_ATTEMPT_S)
            if self._answer.done():
                break
        else:
            raise FileReadError(f"{path}: no MAVLink FTP answer from the autopilot")
        payload = self._answer.result()
        _, _, _, _, answered, code, length, _, _, _, _ = _HEADER.unpack_from(payload)
        part = payload[_HEADER.size : _HEADER.size + min(length, _DATA)]
        if code == _ACK:
            return answered, part
        error = part[0] if part else 0
        if opcode in (_RESET, _TERMINATE) or (opcode == _READ and error == _END_OF_FILE):
            return answered, b""
        raise FileReadError(f"{path}: {_ERRORS.get(error, f'MAVLink FTP error {error}')}")
