"""Reassembly of STATUSTEXT (https://mavlink.io/en/messages/common.html#STATUSTEXT)."""

from __future__ import annotations

import struct

from companion.vehicle.framing import Frame
from companion.vehicle.report import WARNING, Report

STATUSTEXT_ID = 253
_STATUSTEXT = struct.Struct("<B50sHB")  # severity, text, id, chunk_seq
_CHUNK = 50
_LONGEST_TEXT = 500


class StatusTexts:
    """Reassembles texts from STATUSTEXT: long ones are sent in chunks of 50 bytes with one id."""

    def __init__(self) -> None:
        self._id = 0
        self._chunks: list[bytes] = []

    def add(self, frame: Frame, now_ns: int) -> Report | None:
        """Return the text that a frame completes. A text with a lost chunk is dropped at the next text."""
        severity, chunk, identifier, sequence = _STATUSTEXT.unpack(frame.padded(_STATUSTEXT.size))
        ends = b"\0" in chunk
        if identifier == 0:
            return _text_report(severity, chunk, now_ns)
        if sequence == 0 or identifier != self._id:
            self._id, self._chunks = identifier, []
        if sequence != len(self._chunks):
            return None
        self._chunks.append(chunk)
        if not ends and len(self._chunks) * _CHUNK < _LONGEST_TEXT:
            return None
        whole, self._chunks, self._id = b"".join(self._chunks), [], 0
        return _text_report(severity, whole, now_ns)


def _text_report(severity: int, text: bytes, now_ns: int) -> Report | None:
    words = text.split(b"\0")[0].decode("utf-8", "replace").strip()
    if words.endswith("fence breached"):
        severity = min(severity, WARNING)  # ArduPilot 4.7 sends the reason of its mode change as NOTICE
    return Report(now_ns, severity, words) if words else None
