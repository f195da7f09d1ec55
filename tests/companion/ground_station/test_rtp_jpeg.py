"""JPEG images as RTP packets, taken apart by a receiver of its own."""

from __future__ import annotations

import struct
from contextlib import suppress
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.ground_station.rtp_jpeg import PACKET_BYTES, RtpJpegError, RtpSender, rtp_payloads
from tests.companion.ground_station.rtp_jpeg_receiver import received

S420, S422, S444 = (
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR_422,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
)


def image(width: int, height: int) -> npt.NDArray[np.uint8]:
    """Colours that change slowly, with noise."""
    y, x = np.mgrid[0:height, 0:width]
    noise = np.random.default_rng(width * height).integers(0, 16, (height, width, 3))
    return (np.stack([x % 200, y % 200, (x + y) % 200], -1) + noise).astype(np.uint8)


def encoded(pixels: npt.NDArray[np.uint8], *options: int) -> bytes:
    return cv2.imencode(".jpg", pixels, options)[1].tobytes()


def decoded(jpeg: bytes) -> npt.NDArray[Any]:
    pixels = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)
    assert pixels is not None
    return pixels


def packets(jpeg: bytes, stamp_ns: int = 0, sender: RtpSender | None = None) -> list[bytes]:
    return [b"".join(packet) for packet in (sender or RtpSender()).packets(rtp_payloads(jpeg), stamp_ns)]


sides = st.one_of(st.integers(16, 300), st.integers(16, 2040))


@given(sides, sides, st.sampled_from([S420, S422]), st.integers(10, 100), st.sampled_from([0, 1, 7]))
def test_receiver_gets_the_pixels_of_the_image(
    width: int, height: int, sampling: int, quality: int, interval: int
) -> None:
    jpeg = encoded(
        image(width, height),
        *(cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling),
        *(cv2.IMWRITE_JPEG_QUALITY, quality),
        *(cv2.IMWRITE_JPEG_RST_INTERVAL, interval),
    )
    sent = packets(jpeg)
    assert max(map(len, sent)) <= PACKET_BYTES
    assert [packet[1] >> 7 for packet in sent] == [0] * (len(sent) - 1) + [1]
    (one,) = received(sent)
    there, here = decoded(one.jpeg), decoded(jpeg)
    assert there.shape == (-(-height // 8) * 8, -(-width // 8) * 8, 3)
    # The colour of the last pixels is interpolated with what the format adds to whole blocks.
    rows, columns = height - 2 * (height % 16 > 0), width - 2 * (width % 16 > 0)
    np.testing.assert_array_equal(there[:rows, :columns], here[:rows, :columns])


def test_numbers_go_on_from_image_to_image() -> None:
    sender, jpeg = RtpSender(), encoded(image(320, 240))
    sent = [packet for number in range(3) for packet in packets(jpeg, number * 100_000_000, sender)]
    images = received(sent)  # no number is missing
    assert {one.ssrc for one in images} == {sender.ssrc}
    steps = [(later.time - one.time) % (1 << 32) for one, later in pairwise(images)]
    assert steps == [9000, 9000]


def test_report_maps_the_time_of_images_to_utc() -> None:
    sender = RtpSender()
    (one,) = received(packets(encoded(image(64, 48)), 5_000_000_000, sender))
    report = sender.report(7_000_000_000, 1_700_000_000_250_000_000)
    kind, words, ssrc, seconds, fraction, time, count, size = struct.unpack_from(">xBHIIIIII", report)
    assert (kind, words, ssrc, fraction) == (200, 6, sender.ssrc, 1 << 30)
    assert seconds - 1_700_000_000 == (70 * 365 + 17) * 86400  # 1900 to 1970
    assert (time - one.time) % (1 << 32) == 2 * 90_000
    assert (count, size) == (
        len(packets(encoded(image(64, 48)))),
        sum(map(len, rtp_payloads(encoded(image(64, 48))))),
    )
    kind, words, ssrc, item, length = struct.unpack_from(">xBHIBB", report, 28)
    assert (kind, ssrc, item, length) == (202, sender.ssrc, 1, 8)
    assert len(report) == 28 + 4 * (words + 1)
    assert report[-2:] == b"\0\0"


def test_image_without_huffman_tables_has_the_usual_ones() -> None:
    jpeg = encoded(image(64, 48))
    bare, at = jpeg[:2], 2
    while jpeg[at + 1] != 0xDA:
        size = 2 + int.from_bytes(jpeg[at + 2 : at + 4], "big")
        bare += b"" if jpeg[at + 1] == 0xC4 else jpeg[at : at + size]
        at += size
    (one,) = received(packets(bare + jpeg[at:]))
    np.testing.assert_array_equal(decoded(one.jpeg), decoded(jpeg))


PLAIN = encoded(image(64, 48))


@pytest.mark.parametrize(
    ("jpeg", "named"),
    [
        (encoded(image(64, 48)[:, :, :1]), "1 components"),
        (encoded(image(64, 48), cv2.IMWRITE_JPEG_SAMPLING_FACTOR, S444), "sampling 1x1 1x1 1x1"),
        (encoded(image(64, 48), cv2.IMWRITE_JPEG_OPTIMIZE, 1), "Huffman"),
        (encoded(image(64, 48), cv2.IMWRITE_JPEG_PROGRESSIVE, 1), "SOF2"),
        (encoded(image(2041, 16)), "2041x16"),
        (encoded(image(16, 2041)), "16x2041"),
        (PLAIN[:-2], "cut off"),
        (PLAIN[:200], "header"),
        (PLAIN[:2], "header"),
        (b"", "not a JPEG"),
        (b"\x89PNG\r\n", "not a JPEG"),
    ],
)
def test_image_that_the_format_cannot_carry_is_named(jpeg: bytes, named: str) -> None:
    with pytest.raises(RtpJpegError, match=named):
        rtp_payloads(jpeg)


@given(
    st.lists(st.tuples(st.integers(0, 700), st.integers(0, 255)), min_size=1, max_size=4), st.integers(0, 700)
)
def test_damaged_image_is_sent_or_refused(changes: list[tuple[int, int]], size: int) -> None:
    damaged = bytearray(PLAIN)
    for at, value in changes:
        damaged[at % len(damaged)] = value
    for jpeg in (bytes(damaged), bytes(damaged[:size])):
        with suppress(RtpJpegError):
            rtp_payloads(jpeg)
