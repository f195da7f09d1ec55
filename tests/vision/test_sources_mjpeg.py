"""Splitting Motion JPEG into images, for pieces of any size."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vision.sources.mjpeg import MjpegParser, MjpegSplitter


def jpeg(seed: int, *, quality: int = 60, progressive: bool = False, restart: int = 0) -> bytes:
    random = np.random.default_rng(seed)
    image = random.integers(0, 256, (random.integers(8, 60), random.integers(8, 60), 3), dtype=np.uint8)
    flags = [
        cv2.IMWRITE_JPEG_QUALITY,
        quality,
        cv2.IMWRITE_JPEG_PROGRESSIVE,
        int(progressive),
        cv2.IMWRITE_JPEG_RST_INTERVAL,
        restart,
    ]
    ok, data = cv2.imencode(".jpg", image, flags)
    assert ok
    return data.tobytes()


def with_segment(image: bytes, marker: int, payload: bytes) -> bytes:
    return image[:2] + bytes([0xFF, marker]) + (len(payload) + 2).to_bytes(2, "big") + payload + image[2:]


def in_pieces(data: bytes, cuts: list[int]) -> list[bytes]:
    edges = [0, *sorted(cut % (len(data) + 1) for cut in cuts), len(data)]
    return [data[start:end] for start, end in itertools.pairwise(edges)]


kinds = st.builds(
    jpeg,
    st.integers(0, 1000),
    quality=st.integers(5, 100),
    progressive=st.booleans(),
    restart=st.sampled_from([0, 1, 3]),
)
# Text between images, like multipart headers, without a start marker.
between = st.binary(max_size=40).filter(lambda data: b"\xff" not in data)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(between, kinds), max_size=4), st.lists(st.integers(0, 1 << 20), max_size=12))
def test_images_are_identical_for_any_stream_split(parts: list[tuple[bytes, bytes]], cuts: list[int]) -> None:
    stream = b"".join(gap + image for gap, image in parts)
    splitter = MjpegSplitter()
    found = [image for piece in in_pieces(stream, cuts) for image in splitter.push(piece)]
    assert found == [image for _, image in parts]
    assert splitter.damaged == 0
    assert splitter.pending == 0


@settings(max_examples=30, deadline=None)
@given(kinds, kinds, st.integers(0xE0, 0xEF), st.lists(st.integers(0, 1 << 20), max_size=8))
def test_a_thumbnail_inside_a_segment_is_not_taken_for_an_image(
    image: bytes, thumbnail: bytes, marker: int, cuts: list[int]
) -> None:
    outer = with_segment(image, marker, b"Exif\0\0" + thumbnail)
    splitter = MjpegSplitter()
    found = [whole for piece in in_pieces(outer * 2, cuts) for whole in splitter.push(piece)]
    assert found == [outer, outer]


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=400), st.lists(st.integers(0, 1 << 20), max_size=8))
def test_image_after_any_bytes_is_found(noise: bytes, cuts: list[int]) -> None:
    image = jpeg(1)
    # Twice, since the noise may end with the start of a segment that includes the first.
    stream = noise + (b"\0" * 65536 + image) * 2
    splitter = MjpegSplitter()
    found = [whole for piece in in_pieces(stream, cuts) for whole in splitter.push(piece)]
    assert found[-1:] == [image]


def test_interrupted_image_is_counted_and_next_is_complete() -> None:
    image = jpeg(2)
    splitter = MjpegSplitter()
    found = splitter.push(image[: len(image) // 2] + image)
    assert found == [image]
    assert splitter.damaged == 1


def test_an_image_without_end_does_not_fill_the_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("vision.sources.mjpeg._LARGEST_IMAGE", 10_000)
    splitter = MjpegSplitter()
    begun = jpeg(3)[:-2]
    splitter.push(begun)
    for _ in range(20):
        splitter.push(b"\x11" * 1000)
    assert splitter.pending == 0
    assert splitter.damaged == 1
    assert splitter.push(jpeg(4)) == [jpeg(4)]


def test_fill_bytes_before_a_marker_are_allowed() -> None:
    image = jpeg(5)
    filled = image[:2] + b"\xff\xff\xff" + image[2:]
    assert MjpegSplitter().push(filled) == [filled]


def test_undecodable_image_is_counted(
    caplog: pytest.LogCaptureFixture,
) -> None:
    empty = b"\xff\xd8\xff\xd9"
    parser = MjpegParser()
    images = parser.push(jpeg(6) + empty + jpeg(7))
    decoded = [cv2.imdecode(np.frombuffer(jpeg(seed), np.uint8), cv2.IMREAD_COLOR) for seed in (6, 7)]
    assert [image.shape for image in images] == [image.shape for image in decoded if image is not None]
    assert parser.unreadable == 1
    assert "1 damaged" in caplog.text


def test_leftover_at_the_end_is_reported() -> None:
    parser = MjpegParser()
    parser.push(jpeg(8)[:-10])
    assert "incomplete" in parser.leftover()
