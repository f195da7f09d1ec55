"""YUV4MPEG2: the header, the planes, and pieces of any size."""

from __future__ import annotations

import itertools

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from vision.sources.raw import StreamError
from vision.sources.y4m import Y4mParser, parse_y4m_header

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
    space: str,
    width: int,
    height: int,
    full: bool,
    colours: list[tuple[int, int, int]],
    cuts: list[int],
) -> None:
    header = f"YUV4MPEG2 W{width} H{height} F30000:1001 Ip A1:1 C{space}"
    stream = (header + (" XCOLORRANGE=FULL" if full else " XCOLORRANGE=LIMITED") + "\n").encode()
    for index, colour in enumerate(colours):
        stream += b"FRAME Ip\n" if index % 2 else b"FRAME\n"
        stream += planes(colour, width, height, space, full)
    parser = Y4mParser()
    edges = [0, *sorted(cut % (len(stream) + 1) for cut in cuts), len(stream)]
    found: list[NDArray[np.uint8]] = []
    for start, end in itertools.pairwise(edges):
        found += parser.push(stream[start:end])
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


@pytest.mark.parametrize(
    ("line", "words"),
    [
        pytest.param(b"YUV4MPEG2 W640 C420", "height", id="no height"),
        pytest.param(b"YUV4MPEG2 W0 H480", "width", id="no width"),
        pytest.param(b"YUV4MPEG2 W-4 H480", "width", id="negative"),
        pytest.param(b"YUV4MPEG2 W99999 H480", "width", id="huge"),
        pytest.param(b"YUV4MPEG2 W4 H4 C420p10", "ffmpeg -pix_fmt yuv420p", id="ten bits"),
        pytest.param(b"RIFFxxxx", "YUV4MPEG2 header", id="another format"),
    ],
)
def test_bad_header_is_rejected_with_a_reason(line: bytes, words: str) -> None:
    with pytest.raises(StreamError, match=words):
        parse_y4m_header(line)


def test_default_colour_space_is_420_and_rate_is_none() -> None:
    header = parse_y4m_header(b"YUV4MPEG2 W6 H5")
    assert header.subsampling == (2, 2)
    assert header.rate_hz is None
    assert header.frame_bytes == 6 * 5 + 2 * 3 * 3


def test_a_broken_frame_line_ends_the_stream_with_what_was_there() -> None:
    parser = Y4mParser()
    with pytest.raises(StreamError, match="FRAME"):
        parser.push(b"YUV4MPEG2 W2 H2 Cmono\nFRAME\n\0\0\0\0FRAMEX\n")


def test_a_line_without_end_is_rejected() -> None:
    with pytest.raises(StreamError, match="another format"):
        Y4mParser().push(b"YUV4MPEG2 " + b"W" * 5000)


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
