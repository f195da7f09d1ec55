"""Shared by tests of sources: waiting for frames and log lines; distinguishable images, JPEG and RTP."""

from __future__ import annotations

import contextlib
import struct
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import cv2
import numpy as np
import pytest

from vision.frame import Frame
from vision.sources import Source, SourceSettings

QUICK = SourceSettings(open_timeout_s=20.0, read_timeout_s=2.0, retry_min_s=0.05, retry_max_s=0.2)


def jpeg(blue: int) -> bytes:
    image = np.full((48, 64, 3), (blue, 90, 20), np.uint8)
    return cv2.imencode(".jpg", image)[1].tobytes()


def wait_for_frame(
    source: Source, wanted: Callable[[Frame], bool] = lambda frame: True, within_s: float = 30.0
) -> Frame:
    deadline_s = time.monotonic() + within_s
    while time.monotonic() < deadline_s:
        frame = source.read(0.5)
        if frame is not None and wanted(frame):
            return frame
    raise AssertionError(f"no such frame within {within_s} s")


def read_until_logged(source: Source, caplog: pytest.LogCaptureFixture, word: str) -> list[Frame]:
    """Read until the log contains the word; the frames meanwhile."""
    frames = []
    deadline_s = time.monotonic() + 20
    while word not in caplog.text and time.monotonic() < deadline_s:
        if (frame := source.read(0.05)) is not None:
            frames.append(frame)
    return frames


def is_grey(value: int) -> Callable[[Frame], bool]:
    return lambda frame: int(frame.image[0, 0, 0]) == value


def is_blue(value: int) -> Callable[[Frame], bool]:
    return lambda frame: abs(int(frame.image[24, 32, 0]) - value) < 12


def rtp_packets(image: np.ndarray[Any, Any], sequence: int, timestamp: int) -> list[bytes]:
    """One image as RTP packets of JPEG (RFC 2435), its quantisation tables in the first."""
    data = cv2.imencode(
        ".jpg", image, [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420]
    )[1]
    jpeg_bytes = data.tobytes()
    tables, position = b"", 2
    while jpeg_bytes[position + 1] != 0xDA:
        length = int.from_bytes(jpeg_bytes[position + 2 : position + 4], "big")
        if jpeg_bytes[position + 1] == 0xDB:
            tables += b"".join(
                jpeg_bytes[at + 1 : at + 65] for at in range(position + 4, position + 2 + length, 65)
            )
        position += 2 + length
    position += 2 + int.from_bytes(jpeg_bytes[position + 2 : position + 4], "big")
    scan = jpeg_bytes[position:-2]
    height, width = image.shape[:2]
    packets: list[bytes] = []
    offset = 0
    while offset < len(scan):
        chunk = scan[offset : offset + 1000]
        last = offset + len(chunk) == len(scan)
        header = struct.pack(
            ">BBHII", 0x80, 26 | (0x80 if last else 0), (sequence + len(packets)) & 0xFFFF, timestamp, 0x1234
        )
        header += struct.pack(">I", offset) + bytes([1, 255, width // 8, height // 8])
        if offset == 0:
            header += struct.pack(">BBH", 0, 0, len(tables)) + tables
        packets.append(header + chunk)
        offset += len(chunk)
    return packets


@contextmanager
def sending(send: Callable[[bytes], object], blue: int = 200) -> Iterator[None]:
    """Sends an image of this blue value thirty times a second."""
    stop = threading.Event()
    image = np.full((96, 128, 3), (blue, 90, 20), np.uint8)

    def run() -> None:
        sequence = timestamp = 0
        with contextlib.suppress(OSError):
            while not stop.wait(1 / 30):
                packets = rtp_packets(image, sequence, timestamp)
                for packet in packets:
                    send(packet)
                sequence += len(packets)
                timestamp += 3000

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
