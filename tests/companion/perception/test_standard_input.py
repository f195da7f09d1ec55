"""Standard input forwarded in whole frames: real pipes, and readers that stop within a frame."""

from __future__ import annotations

import errno
import os
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.perception.standard_input import StandardInput
from companion.settings import SourceSection

pytestmark = pytest.mark.realtime

RAW = SourceSection(uri="-", width=32, height=16, pixel_format="gray8")
FRAME_BYTES = 32 * 16


def frame(number: int) -> bytes:
    return bytes([number % 256]) * FRAME_BYTES


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    reader, writer = os.pipe()
    yield reader, writer
    os.close(reader)


def read_exactly(descriptor: int, count: int) -> bytes:
    data = b""
    while len(data) < count:
        chunk = os.read(descriptor, count - len(data))
        assert chunk, f"it ended after {len(data)} of {count} bytes"
        data += chunk
    return data


def read_all(descriptor: int) -> bytes:
    data = b""
    while chunk := os.read(descriptor, 65536):
        data += chunk
    return data


def write_in_background(writer: int, data: bytes) -> threading.Thread:
    def write() -> None:
        with open(writer, "wb") as file:
            file.write(data)

    thread = threading.Thread(target=write, daemon=True)
    thread.start()
    return thread


def test_bytes_arrive_unchanged(pipe: tuple[int, int]) -> None:
    reader, writer = pipe
    data = b"".join(frame(number) for number in range(200))
    worker = StandardInput(RAW, reader).for_worker()
    write_in_background(writer, data)
    assert read_all(worker) == data
    os.close(worker)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 40 * FRAME_BYTES), st.booleans())
def test_next_reader_starts_with_a_whole_frame(read_bytes: int, is_socket: bool) -> None:
    # More frames than the pipe of the lost reader can hold.
    count = 300
    if is_socket:
        ours, theirs = (end.detach() for end in socket.socketpair())
    else:
        ours, theirs = os.pipe()
    # Numbered over the whole frame, so that a shift of one byte is detected.
    data = b"".join(number.to_bytes(2, "big") * (FRAME_BYTES // 2) for number in range(count))
    standard_input = StandardInput(RAW, ours)
    first = standard_input.for_worker()
    writing = write_in_background(theirs, data)
    assert read_exactly(first, read_bytes) == data[:read_bytes]
    os.close(first)
    second = standard_input.for_worker()
    rest = read_all(second)
    os.close(second)
    writing.join()
    os.close(ours)
    assert len(rest) % FRAME_BYTES == 0
    assert len(rest) > 0
    assert data.endswith(rest)


def test_next_reader_of_yuv4mpeg2_gets_the_header(pipe: tuple[int, int]) -> None:
    reader, writer = pipe
    source = SourceSection(uri="-")
    header = b"YUV4MPEG2 W32 H16 F30:1 C420jpeg\n"
    frames = [b"FRAME\n" + bytes([number % 256]) * (FRAME_BYTES * 3 // 2) for number in range(400)]
    standard_input = StandardInput(source, reader)
    first = standard_input.for_worker()
    write_in_background(writer, header + b"".join(frames))
    assert read_exactly(first, len(header) + 1000) == (header + b"".join(frames[:2]))[: len(header) + 1000]
    os.close(first)
    second = standard_input.for_worker()
    rest = read_all(second)
    os.close(second)
    assert rest.startswith(header)
    assert b"".join(frames).endswith(rest.removeprefix(header))
    assert (len(rest) - len(header)) % len(frames[0]) == 0


@pytest.mark.parametrize(
    ("source", "data"),
    [
        (SourceSection(uri="-", pixel_format="mjpeg"), b"\xff\xd8\xff" + bytes(5000) + b"\xff\xd9"),
        (SourceSection(uri="-"), b"\xff\xd8\xff" + bytes(5000) + b"\xff\xd9"),
        (SourceSection(uri="-"), b"YUV4MPEG2 W32 H16 Cnonsense\nFRAME\n" + bytes(768)),
        (SourceSection(uri="-"), b"neither of them"),
        (SourceSection(uri="-", pixel_format="bgr24"), b"raw pixels of no known size"),
    ],
)
def test_unknown_framing_is_forwarded_unchanged(
    pipe: tuple[int, int], source: SourceSection, data: bytes
) -> None:
    reader, writer = pipe
    worker = StandardInput(source, reader).for_worker()
    write_in_background(writer, data)
    assert read_all(worker) == data
    os.close(worker)


def test_after_the_end_the_next_reader_gets_nothing(pipe: tuple[int, int]) -> None:
    reader, writer = pipe
    standard_input = StandardInput(RAW, reader)
    first = standard_input.for_worker()
    write_in_background(writer, frame(1) + frame(2)[:100])
    assert read_all(first) == frame(1) + frame(2)[:100]
    os.close(first)
    second = standard_input.for_worker()
    assert read_all(second) == b""
    os.close(second)


def test_non_blocking_input_is_waited_for(pipe: tuple[int, int]) -> None:
    reader, writer = pipe
    os.set_blocking(reader, False)
    worker = StandardInput(RAW, reader).for_worker()
    write_in_background(writer, frame(7))
    assert read_all(worker) == frame(7)
    os.close(worker)


def test_every_reader_of_a_file_starts_at_its_position(tmp_path: Path) -> None:
    path = tmp_path / "frames.gray"
    path.write_bytes(b"skip" + frame(1) + frame(2))
    with path.open("rb", buffering=0) as file:
        file.read(4)
        standard_input = StandardInput(RAW, file.fileno())
        for _ in range(2):
            worker = standard_input.for_worker()
            assert read_exactly(worker, FRAME_BYTES) == frame(1)
            os.close(worker)


def test_closed_standard_input_is_an_error() -> None:
    reader, writer = os.pipe()
    os.close(reader)
    os.close(writer)
    with pytest.raises(OSError, match=rf"\[Errno {errno.EBADF}\]"):
        StandardInput(RAW, reader)
