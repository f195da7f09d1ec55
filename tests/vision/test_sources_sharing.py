"""One camera, several readers: frames are also published in shared memory."""

from __future__ import annotations

import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from vision.shared_frame import SharedFrameReader, SharedFrameWriter
from vision.sources import Source, SourceError, SourceSettings, open_source
from vision.sources.sharing import FrameSharing

pytestmark = pytest.mark.realtime


@pytest.fixture
def name() -> Iterator[str]:
    name = f"companion-test-{secrets.token_hex(4)}"
    yield name
    assert not Path("/dev/shm", name).exists(), "the shared memory was left behind"


def write_images(folder: Path, *sizes: tuple[int, int]) -> Path:
    rng = np.random.default_rng(1)
    for index, (width, height) in enumerate(sizes):
        image = rng.integers(0, 255, (height, width, 3), dtype=np.uint8)
        assert cv2.imwrite(str(folder / f"{index}.png"), image)
    return folder


@contextmanager
def shared(folder: Path, name: str, **settings: Any) -> Iterator[Source]:
    with (
        FrameSharing(name) as sharing,
        open_source(str(folder), SourceSettings(on_frame=sharing.write, **settings)) as source,
    ):
        yield source


def test_frames_are_shared_with_their_stamps(name: str, tmp_path: Path) -> None:
    folder = write_images(tmp_path, (32, 24), (32, 24))
    with shared(folder, name) as source:
        for _ in range(2):
            frame = source.read()
            assert frame is not None
            with SharedFrameReader(name) as reader:
                other = reader.latest()
            assert other is not None
            assert (other.sequence, other.captured_ns) == (frame.sequence, frame.captured_ns)
            assert np.array_equal(other.image, frame.image)


def test_frame_after_close_is_not_shared(name: str, tmp_path: Path) -> None:
    folder = write_images(tmp_path, (32, 24), (32, 24))
    with FrameSharing(name) as sharing, open_source(str(folder)) as source:
        frame = source.read()
        assert frame is not None
        sharing.write(frame)
    sharing.write(frame)
    with pytest.raises(FileNotFoundError):
        SharedFrameReader(name)


def test_sharing_continues_after_a_size_change(name: str, tmp_path: Path) -> None:
    folder = write_images(tmp_path, (32, 24), (48, 16))
    with shared(folder, name) as source:
        source.read()
        with SharedFrameReader(name) as reader:
            assert (reader.width, reader.height) == (32, 24)
            source.read()
            other = reader.latest()
            assert other is not None
            assert (other.width, other.height) == (48, 16)


def test_name_in_use_is_a_one_line_error(name: str, tmp_path: Path) -> None:
    folder = write_images(tmp_path, (32, 24))
    with (
        SharedFrameWriter(name, 8, 8, False),
        shared(folder, name) as source,
        pytest.raises(SourceError, match=f"shm://{name}: .*another process"),
    ):
        source.read()


def test_sharing_includes_frames_a_slow_reader_misses(name: str, tmp_path: Path) -> None:
    folder = write_images(tmp_path, (32, 24), (32, 24))
    with shared(folder, name, realtime=True, loop=True, rate_hz=200.0), SharedFrameReader(name) as reader:
        # The source itself is not read.
        seen: set[int] = set()
        deadline_s = time.monotonic() + 30.0
        while len(seen) < 5:
            assert time.monotonic() < deadline_s, f"only the frames {seen} were shared"
            frame = reader.latest()
            if frame is not None:
                seen.add(frame.sequence)
            time.sleep(0.001)


def test_source_fails_to_open_if_sharing_fails(name: str, tmp_path: Path) -> None:
    folder = write_images(tmp_path, (32, 24))
    with (
        SharedFrameWriter(name, 8, 8, False),
        pytest.raises(SourceError, match=f"shm://{name}: .*another process"),
        shared(folder, name, realtime=True),
    ):
        pass
