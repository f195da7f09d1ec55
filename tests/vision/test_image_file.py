"""Image files of every kind as 8-bit BGR, the same for every reader, and why one cannot be read."""

from __future__ import annotations

import logging
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from vision.evaluation.datasets import DatasetError, image_files
from vision.evaluation.datasets import read_image as read_labelled
from vision.exports.quantize import FEWEST_IMAGES, calibration_images
from vision.image_file import ImageError, decode, decode_image, read_image, stated_size
from vision.sources import SourceError, open_source

GREY = np.tile(np.linspace(0, 255, 64).round().astype(np.uint8), (48, 1))
COLOUR = np.dstack([GREY, GREY[:, ::-1], np.full_like(GREY, 128)])
COUNTS = (GREY.astype(np.uint16) * 8) + 7000  # a thermal camera of 14 bits
LARGE = cv2.resize(COLOUR, (640, 480)).astype(np.uint8)


def encoded(image: NDArray[np.integer | np.floating], suffix: str, *options: int) -> bytes:
    done, data = cv2.imencode(suffix, image, options)
    assert done
    return data.tobytes()


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png(width: int, height: int, *before: bytes, bits: int = 8, colour: int = 0, data: bytes = b"") -> bytes:
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0))
    end = chunk(b"IEND", b"")
    return b"".join((b"\x89PNG\r\n\x1a\n", header, *before, chunk(b"IDAT", zlib.compress(data)), end))


def turned(jpeg: bytes, orientation: int) -> bytes:
    """With an EXIF orientation."""
    exif = b"Exif\0\0II*\0" + struct.pack("<IHHHIII", 8, 1, 0x112, 3, 1, orientation, 0)
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + jpeg[2:]


def multi_page(small_copies: int, pages: int) -> bytes:
    """A little-endian TIFF of 1x1 pixels: the full pages first, then smaller copies of them."""
    data = b"II*\0" + struct.pack("<I", 8)
    for index in range(pages + small_copies):
        fields = [(254, 4, int(index >= pages)), (256, 3, 1), (257, 3, 1), (258, 3, 8), (259, 3, 1)]
        fields += [(262, 3, 1), (273, 4, 4), (277, 3, 1), (278, 3, 1), (279, 4, 1)]
        last = index == pages + small_copies - 1
        after = 0 if last else len(data) + 2 + 12 * len(fields) + 4
        data += struct.pack("<H", len(fields))
        data += b"".join(struct.pack("<HHII", tag, kind, 1, value) for tag, kind, value in fields)
        data += struct.pack("<I", after)
    return data


def animated(suffix: str, *options: int) -> bytes:
    animation = cv2.Animation()
    animation.frames, animation.durations = [COLOUR, 255 - COLOUR], [100, 100]
    done, data = cv2.imencodeanimation(suffix, animation, options)
    assert done
    return bytes(data)


CUT_JPEG = encoded(LARGE, ".jpg")
ALPHA = np.dstack([COLOUR, np.where(GREY < 128, 0, 255).astype(np.uint8)])
_PALETTE = chunk(b"PLTE", bytes([10, 20, 30, 40, 50, 60]))

# Name → the file, the pixels that it is read as, and a word of the note.
READ: dict[str, tuple[bytes, NDArray[np.uint8], str]] = {
    "8 bits": (encoded(COLOUR, ".png"), COLOUR, ""),
    "grey": (encoded(GREY, ".png"), np.dstack([GREY] * 3), ""),
    "alpha": (encoded(ALPHA, ".png"), COLOUR, ""),
    "palette": (
        png(2, 1, _PALETTE, colour=3, data=b"\0\0\1"),
        np.array([[[30, 20, 10], [60, 50, 40]]], np.uint8),
        "",
    ),
    "1 bit": (png(2, 1, bits=1, data=b"\0\x40"), np.array([[[0] * 3, [255] * 3]], np.uint8), ""),
    "bmp": (encoded(COLOUR, ".bmp"), COLOUR, ""),
    "16 bits": (encoded(COLOUR.astype(np.uint16) * 257, ".png"), COLOUR, ""),
    "16 bits, one value": (encoded(np.full((8, 8), 0x1234, np.uint16), ".png"), np.full((8, 8, 3), 0x12), ""),
    "14 bits": (encoded(COUNTS, ".png"), np.dstack([GREY] * 3), "values 7000 to 9040: "),
    "14 bits, TIFF": (encoded(COUNTS, ".tiff"), np.dstack([GREY] * 3), "values 7000 to 9040: "),
    "14 bits, PGM": (encoded(COUNTS, ".pgm"), np.dstack([GREY] * 3), "values 7000 to 9040: "),
    "12 bits, colours": (encoded(COLOUR.astype(np.uint16) * 16, ".png"), COLOUR, "values 0 to 4080: "),
    "signed": (
        encoded(GREY.astype(np.int16) * 10 - 1000, ".tiff"),
        np.dstack([GREY] * 3),
        "values -1000 to 1550: ",
    ),
    "turned by EXIF": (turned(encoded(GREY, ".jpg"), 6), np.dstack([np.rot90(GREY, -1)] * 3), ""),
    "JPEG with more behind": (CUT_JPEG + b"more" * 99, LARGE, ""),
    "JPEG without its end": (CUT_JPEG[:-2], LARGE, ""),
    "JPEG without half of its end": (CUT_JPEG[:-1], LARGE, ""),
    "progressive without its end": (
        encoded(LARGE, ".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1)[:-2],
        LARGE,
        "without its end",
    ),
    "PNG without its end": (encoded(COLOUR, ".png")[:-12], COLOUR, ""),
    "PNG without half of its end": (encoded(COLOUR, ".png")[:-5], COLOUR, ""),
    "animated PNG": (animated(".png"), COLOUR, "2 images"),
    "animated WebP": (animated(".webp", cv2.IMWRITE_WEBP_QUALITY, 101), COLOUR, "animation"),
    "pages": (multi_page(0, 3), np.full((1, 1, 3), 8), "3 pages"),
    "smaller copies": (multi_page(2, 1), np.full((1, 1, 3), 8), ""),
}
# Name → the file, and a word of the reason.
UNREADABLE = {
    "empty": (b"", "empty"),
    "JPEG cut off": (CUT_JPEG[: len(CUT_JPEG) // 2], "rows are missing"),
    "JPEG cut off near its end": (CUT_JPEG[:-60], "rows are missing"),
    "PNG cut off": (encoded(LARGE, ".png")[:2000], "too early"),
    "PNG of no pixels": (png(0, 0), "0x0 pixels"),
    "WebP cut off": (encoded(LARGE, ".webp")[:500], "truncated"),
    "too large": (png(34000, 32000), "34000x32000 pixels"),
    "floats": (encoded(GREY.astype(np.float32), ".tiff"), "32-bit floats"),
    "64-bit floats": (encoded(GREY.astype(np.float64), ".tiff"), "64-bit floats"),
    "32-bit integers": (encoded(GREY.astype(np.int32), ".tiff"), "32-bit integers"),
    "HEIC": (b"\0\0\0\x18ftypheic\0\0\0\0mif1heic" + bytes(99), "HEIC"),
    "AVIF cut off": (b"\0\0\0\x18ftypavif\0\0\0\0mif1avif" + bytes(99), "AVIF"),
    "HTML": (b"<!doctype html><html></html>", "HTML"),
    "noise": (np.random.default_rng(1).bytes(999), "truncated or damaged"),
}


@pytest.mark.parametrize("name", READ)
def test_image_is_read_as_8_bit_bgr(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    data, expected, note = READ[name]
    image = decode(data)
    assert image.pixels.dtype == np.uint8
    assert image.pixels.flags.c_contiguous
    assert image.pixels.shape == expected.shape
    # JPEG is not exact.
    assert np.abs(image.pixels.astype(int) - expected).max() <= (8 if data[:2] == b"\xff\xd8" else 0)
    assert note in image.note
    assert bool(note) == bool(image.note)
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("name", UNREADABLE)
def test_unreadable_image_has_a_reason(name: str, capfd: pytest.CaptureFixture[str]) -> None:
    data, word = UNREADABLE[name]
    with pytest.raises(ImageError, match=word) as raised:
        decode(data)
    assert "\n" not in str(raised.value)
    assert decode_image(data) is None
    assert capfd.readouterr().err == ""


def with_tiles(width: int, height: int) -> bytes:
    """A TIFF of 1x1 pixels with such tiles."""
    fields = [(256, 3, 1), (257, 3, 1), (322, 4, width), (323, 4, height)]
    data = b"MM\0*" + struct.pack(">IH", 8, len(fields))
    for tag, kind, value in fields:
        data += struct.pack(">HHI", tag, kind, 1) + struct.pack(
            ">HH" if kind == 3 else ">I", value, *[0] * (kind == 3)
        )
    return data


FIRST = CUT_JPEG[:2]
SIZES: dict[str, tuple[bytes, tuple[int, int] | None]] = {
    "PNG": (png(16000, 15000), (16000, 15000)),
    "JPEG": (CUT_JPEG, (640, 480)),
    "progressive": (encoded(LARGE, ".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1), (640, 480)),
    "JPEG turned by EXIF": (turned(CUT_JPEG, 6), (640, 480)),
    "JPEG with fill bytes": (FIRST + b"\xff\xff" + CUT_JPEG[2:], (640, 480)),
    "JPEG with bytes between": (FIRST + b"\0\1\xff\0\xff\xd0" + CUT_JPEG[2:], (640, 480)),
    "JPEG with a frame in a comment": (
        FIRST + b"\xff\xfe\0\x0b\xff\xc0" + bytes(7) + CUT_JPEG[2:],
        (640, 480),
    ),
    "JPEG cut off": (CUT_JPEG[:100], None),
    "JPEG that begins with its end": (FIRST + b"\xff\xd9" + CUT_JPEG[2:], None),
    "TIFF": (encoded(COUNTS, ".tiff"), (64, 48)),
    "pages": (multi_page(0, 3), (1, 1)),
    "TIFF of large tiles": (with_tiles(30000, 20000), (30000, 20000)),
    "TIFF cut off": (b"II*\0", None),
    "bmp": (encoded(COLOUR, ".bmp"), None),
    "nothing": (b"", None),
}


@pytest.mark.parametrize("name", SIZES)
def test_size_is_known_before_decoding(name: str) -> None:
    data, expected = SIZES[name]
    assert stated_size(data) == expected


def test_dead_and_hot_pixels_do_not_set_the_range() -> None:
    counts = cv2.resize(COUNTS, (640, 512), interpolation=cv2.INTER_NEAREST)
    counts[::90, ::90], counts[45, ::90] = 65535, 0
    image = decode(encoded(counts, ".png"))
    assert "values 0 to 65535: 7000 to 9040 " in image.note
    assert image.pixels[3, 3].tolist() == [0, 0, 0]
    assert image.pixels[3, 636].tolist() == [255, 255, 255]
    assert image.pixels[0, 0].tolist() == [255, 255, 255]


def test_every_reader_gets_the_same_pixels(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    files = [tmp_path / f"{number}.PNG" for number in range(FEWEST_IMAGES)]
    for path in files:
        path.write_bytes(READ["14 bits"][0])
    with open_source(str(tmp_path)) as source:
        shown = [frame.image for frame in source]
    with open_source(str(files[0])) as source:
        shown += [frame.image for frame in source]
    shown += [read_labelled(files[0]), read_image(files[1])]
    assert len(shown) == len(files) + 3
    for image in shown:
        np.testing.assert_array_equal(image, READ["14 bits"][1])
    of_network = calibration_images(tmp_path, 64, 32)[0]
    assert (of_network.min(), of_network.max()) == (0, 255)
    said = [record for record in caplog.records if record.levelno == logging.WARNING]
    assert [record.getMessage().partition(":")[0] for record in said] == [str(files[0])]


@pytest.mark.parametrize("name", UNREADABLE)
def test_every_reader_says_the_same_reason(name: str, tmp_path: Path) -> None:
    data, word = UNREADABLE[name]
    path = tmp_path / "a.jpg"
    path.write_bytes(data)
    with pytest.raises(SourceError, match=rf"a\.jpg: .*{word}"), open_source(str(path)) as source:
        source.read()
    with pytest.raises(DatasetError, match=rf"a\.jpg: .*{word}"):
        read_labelled(path)


def test_hidden_files_are_no_images(tmp_path: Path) -> None:
    for name in ("a.png", "._a.png", ".b.png", "c.PNG", "Thumbs.db", ".DS_Store", "d.txt"):
        (tmp_path / name).write_bytes(READ["8 bits"][0])
    for name in (".ipynb_checkpoints", "more"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "e.jpg").write_bytes(READ["8 bits"][0])
    with open_source(str(tmp_path)) as source:
        assert [frame.file_name for frame in source] == ["a.png", "c.PNG"]
    found = [str(path.relative_to(tmp_path)) for path in image_files(tmp_path)]
    assert found == ["a.png", "c.PNG", "more/e.jpg"]
    with open_source(str(tmp_path / ".b.png")) as source:  # given by name
        assert [frame.file_name for frame in source] == [".b.png"]


def test_folder_names_a_heic_image_beside_others(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    (tmp_path / "a.png").write_bytes(READ["8 bits"][0])
    (tmp_path / "IMG_1.HEIC").write_bytes(UNREADABLE["HEIC"][0])
    with open_source(str(tmp_path)) as source:
        assert len(list(source)) == 1
    assert "skipped: is a HEIC" in caplog.text
