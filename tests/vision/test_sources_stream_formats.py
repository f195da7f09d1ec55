"""Images in byte streams, in pieces of any size: raw pixels, YUV4MPEG2 and Motion JPEG."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vision.sources.stream_formats import (
    MjpegParser,
    MjpegSplitter,
    RawParser,
    StreamError,
    Y4mParser,
    parse_y4m_header,
)


def in_pieces(data: bytes, cuts: list[int]) -> list[bytes]:
    edges = [0, *sorted(cut % (len(data) + 1) for cut in cuts), len(data)]
    return [data[start:end] for start, end in itertools.pairwise(edges)]


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(["bgr24", "rgb24", "gray8"]),
    st.integers(1, 9),
    st.integers(1, 9),
    st.integers(0, 4),
    st.integers(0, 1 << 20),
    st.lists(st.integers(0, 1 << 20), max_size=8),
)
def test_raw_frames_are_complete_for_any_stream_split(
    pixel_format: str, width: int, height: int, count: int, extra: int, cuts: list[int]
) -> None:
    channels = 1 if pixel_format == "gray8" else 3
    size = width * height * channels
    pixels = np.random.default_rng(size).integers(0, 256, (count, height, width, channels), dtype=np.uint8)
    stream = pixels.tobytes() + b"\1" * (extra % size)
    parser = RawParser(width, height, pixel_format)
    found = [image for piece in in_pieces(stream, cuts) for image in parser.push(piece)]
    wanted = pixels[..., ::-1] if pixel_format == "rgb24" else np.broadcast_to(pixels, (*pixels.shape[:3], 3))
    assert len(found) == count
    for image, expected in zip(found, wanted, strict=True):
        np.testing.assert_array_equal(image, expected)
    assert bool(parser.leftover()) == (extra % size > 0)


SUBSAMPLING = {
    "420": (2, 2),
    "420jpeg": (2, 2),
    "420mpeg2": (2, 2),
    "420paldv": (2, 2),
    "411": (4, 1),
    "422": (2, 1),
    "440": (1, 2),
    "444": (1, 1),
    "444alpha": (1, 1),
    "mono": None,
}


def planes(colour: tuple[int, int, int], width: int, height: int, space: str, full: bool) -> bytes:
    """One frame of one BGR colour, by the formulas of BT.601."""
    blue, green, red = (value / 255.0 for value in colour)
    luma = 0.299 * red + 0.587 * green + 0.114 * blue
    cb, cr = (blue - luma) / 1.772, (red - luma) / 1.402
    if full:
        values = (255 * luma, 128 + 255 * cb, 128 + 255 * cr)
    else:
        values = (16 + 219 * luma, 128 + 224 * cb, 128 + 224 * cr)
    y, u, v = (min(max(round(value), 0), 255) for value in values)
    sampling = SUBSAMPLING[space]
    chroma = 0 if sampling is None else -(-width // sampling[0]) * -(-height // sampling[1])
    alpha = b"\x80" * (width * height) if space == "444alpha" else b""
    return bytes([y]) * (width * height) + bytes([u]) * chroma + bytes([v]) * chroma + alpha


def test_raw_yuv420_is_decoded_by_bt601() -> None:
    colour = (200, 90, 30)
    parser = RawParser(6, 4, "yuv420")
    data = planes(colour, 6, 4, "420", full=False)
    (image,) = parser.push(data + data[:10])
    assert image.shape == (4, 6, 3)
    assert np.abs(image.astype(int) - colour).max() <= 3
    assert "10 of 36 bytes" in parser.leftover()


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from(sorted(SUBSAMPLING)),
    st.integers(1, 21),
    st.integers(1, 21),
    st.booleans(),
    st.lists(st.tuples(*[st.integers(0, 255)] * 3), min_size=1, max_size=4),
    st.lists(st.integers(0, 1 << 20), max_size=10),
)
def test_colours_are_right_for_every_format_size_and_split(
    space: str, width: int, height: int, full: bool, colours: list[tuple[int, int, int]], cuts: list[int]
) -> None:
    header = f"YUV4MPEG2 W{width} H{height} F30000:1001 Ip A1:1 C{space}"
    stream = (header + (" XCOLORRANGE=FULL" if full else " XCOLORRANGE=LIMITED") + "\n").encode()
    for index, colour in enumerate(colours):
        stream += b"FRAME Ip\n" if index % 2 else b"FRAME\n"
        stream += planes(colour, width, height, space, full)
    parser = Y4mParser()
    found = [image for piece in in_pieces(stream, cuts) for image in parser.push(piece)]
    assert parser.leftover() == ""
    assert parser.rate_hz == pytest.approx(29.97, abs=0.01)
    assert len(found) == len(colours)
    for decoded, colour in zip(found, colours, strict=True):
        assert decoded.shape == (height, width, 3)
        if space == "mono":
            grey = 0.114 * colour[0] + 0.587 * colour[1] + 0.299 * colour[2]
            np.testing.assert_allclose(decoded, grey, atol=2.0)
        else:
            # Eight bits of limited-range YUV round a colour by up to three steps.
            np.testing.assert_allclose(decoded, np.broadcast_to(colour, decoded.shape), atol=4.0)


def test_plane_layout_matches_opencv() -> None:
    image = cv2.GaussianBlur(
        np.random.default_rng(1).integers(0, 256, (48, 64, 3), dtype=np.uint8), (15, 15), 0
    )
    data = cv2.cvtColor(image, cv2.COLOR_BGR2YUV_I420).tobytes()
    (decoded,) = Y4mParser().push(b"YUV4MPEG2 W64 H48 C420jpeg\nFRAME\n" + data)
    assert float(np.abs(decoded.astype(int) - image).mean()) < 4.0


def test_default_colour_space_is_420_and_rate_is_none() -> None:
    header = parse_y4m_header(b"YUV4MPEG2 W6 H5")
    assert header.subsampling == (2, 2)
    assert header.rate_hz is None
    assert header.frame_bytes == 6 * 5 + 2 * 3 * 3


def test_a_broken_frame_line_ends_the_stream_with_what_was_there() -> None:
    parser = Y4mParser()
    with pytest.raises(StreamError, match="FRAME"):
        parser.push(b"YUV4MPEG2 W2 H2 Cmono\nFRAME\n\0\0\0\0FRAMEX\n")


def test_a_new_writer_on_the_same_pipe_may_change_the_size() -> None:
    parser = Y4mParser()
    images = parser.push(
        b"YUV4MPEG2 W2 H2 Cmono\nFRAME\n\0\0\0\0YUV4MPEG2 W4 H2 Cmono\nFRAME\n\0\0\0\0\0\0\0\0"
    )
    assert [decoded.shape for decoded in images] == [(2, 2, 3), (2, 4, 3)]


def test_incomplete_last_frame_is_reported_with_its_bytes() -> None:
    parser = Y4mParser()
    parser.push(b"YUV4MPEG2 W4 H4 Cmono\nFRAME\n\0\0\0")
    assert parser.leftover().endswith("3 of 16 bytes")


@settings(max_examples=100, deadline=None)
@given(st.binary(max_size=300))
def test_any_bytes_give_images_or_a_stream_error(data: bytes) -> None:
    parser = Y4mParser()
    try:
        parser.push(b"YUV4MPEG2 W2 H2 Cmono\n" + data)
    except StreamError:
        return
    parser.leftover()


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
    monkeypatch.setattr("vision.sources.stream_formats._LARGEST_IMAGE", 10_000)
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


def test_undecodable_image_is_counted(caplog: pytest.LogCaptureFixture) -> None:
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
