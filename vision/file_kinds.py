"""What kind of file was given by mistake, by its first bytes: one sentence with what to do about it.

Each reader puts it in place of its own error, which would say only what its parser met first.
"""

from __future__ import annotations

import errno
import os
import re
import stat
from io import BufferedReader
from pathlib import Path
from typing import BinaryIO

_HEAD_BYTES = 65_536
_INDEX_BYTES = 64 << 20
_MP4, _MATROSKA = "is a video (MP4)", "is a video (Matroska, WebM)"
_HEIC = "is a HEIC image, as iPhones take: convert it to JPEG"
_MAGIC: tuple[tuple[bytes, int, str], ...] = (
    (b"\xff\xd8\xff", 0, "is a JPEG image"),
    (b"\x89PNG\r\n\x1a\n", 0, "is a PNG image"),
    (b"GIF8", 0, "is a GIF image"),
    (b"II*\0", 0, "is a TIFF image"),
    (b"MM\0*", 0, "is a TIFF image"),
    (b"WEBP", 8, "is a WebP image"),
    (b"\0\0\0\x0cjP  \r\n", 0, "is a JPEG 2000 image"),
    *((b"ftyp" + brand, 4, _HEIC) for brand in (b"heic", b"heix", b"heim", b"heis", b"mif1", b"msf1")),
    *((b"ftyp" + brand, 4, "is an AVIF image") for brand in (b"avif", b"avis")),
    (b"AVI ", 8, "is a video (AVI)"),
    (b"WAVE", 8, "is a sound recording (WAV)"),
    (b"ftypM4A ", 4, "is a sound recording (MP4)"),
    (b"fLaC", 0, "is a sound recording (FLAC)"),
    (b"ID3", 0, "is a sound recording (MP3)"),
    (b"ftyp", 4, _MP4),
    (b"\x1aE\xdf\xa3", 0, _MATROSKA),
    (b"\x89MCAP0\r\n", 0, "is a recording (MCAP): `companion log show` shows it"),
    (b"ULog\x01\x12\x35", 0, "is a log of PX4 (ULog): PlotJuggler shows it, and PX4's Flight Review"),
    (b"\xa3\x95\x80", 0, "is a log of ArduPilot (dataflash): read it with a ground station"),
    (b"#ROSBAG", 0, "is a bag of ROS 1: convert it with `mcap convert`"),
    (b"SQLite format 3\0", 0, "is a SQLite database, such as a bag of ROS 2: convert it to MCAP"),
    (b"\x89HDF\r\n\x1a\n", 0, "is an HDF5 file, such as Keras writes: export the model to ONNX"),
    (b"TFL3", 4, "is a TensorFlow Lite model: export the model to ONNX"),
    (b"\x93NUMPY", 0, "is an array of NumPy"),
    (b"\x7fELF", 0, "is a program"),
    (b"%PDF-", 0, "is a PDF document"),
    (b"\x1f\x8b", 0, "is a gzip archive: unpack it and give the file that is in it"),
    (b"BZh", 0, "is a bzip2 archive: unpack it and give the file that is in it"),
    (b"\xfd7zXZ\0", 0, "is an xz archive: unpack it and give the file that is in it"),
    (b"7z\xbc\xaf\x27\x1c", 0, "is a 7z archive: unpack it and give the file that is in it"),
    (b"Rar!\x1a\x07", 0, "is a RAR archive: unpack it and give the file that is in it"),
    (b"ustar", 257, "is a tar archive: unpack it and give the file that is in it"),
    (b"\xff\xfe", 0, "is UTF-16 text: save it as UTF-8"),
    (b"\xfe\xff", 0, "is UTF-16 text: save it as UTF-8"),
)
_TEXTS: tuple[tuple[re.Pattern[bytes], str], ...] = tuple(
    (re.compile(pattern), sentence)
    for pattern, sentence in (
        (
            rb"version https://git-lfs\.github\.com/spec/",
            "is a pointer of Git LFS, not the file itself: run `git lfs pull` in its repository",
        ),
        (
            rb"(?i:<!doctype html|<html)",
            "is an HTML page, as a server sends for a login or an error: download the file itself",
        ),
        (
            rb'\{(?s:.*)"fileType"\s*:\s*"Plan"',
            "is a plan of QGroundControl: upload it there and fly it in the autopilot's mission mode; a "
            "mission here is TOML",
        ),
        (
            rb"QGC WPL \d",
            "is a list of waypoints: upload it with a ground station and fly it in the autopilot's mission "
            "mode; a mission here is TOML",
        ),
        (
            rb"# (?:Onboard parameters|Vehicle-Id|MAV ID)",
            "is a parameter file of a ground station: load it there",
        ),
        (rb"(?s:<\?xml.{0,500}?)?<(?:[\w.]+:)?kml\b", "is a KML file of places"),
        (rb"(?s:<\?xml.{0,500}?)?<gpx\b", "is a GPX file of a GPS receiver"),
        (
            rb"(?s:<\?xml.{0,500}?)?<annotation\b",
            "is an annotation in Pascal VOC's format (XML): convert the data set to YOLO's or COCO's format",
        ),
        (rb"-----BEGIN ", "is a certificate or key (PEM)"),
    )
)


def is_hidden(path: Path) -> bool:
    """Whether the name begins with a dot, as those that macOS adds (`._NAME`)."""
    return path.name.startswith(".")


def wrong_file(path: Path, *fitting: str) -> str | None:
    """What a file is, if it is of a kind that is recognised, after its name: `given.pt: is an HTML page …`.

    Args:
        fitting: beginnings of the sentences about what the caller can read, such as "is a JPEG".

    Returns:
        None for a kind that is not recognised or is fitting, and for a file that cannot be read.
    """
    try:
        if not path.is_file():
            return None
        with path.open("rb") as file:
            sentence = kind_of_bytes(file.read(_HEAD_BYTES))
    except (OSError, ValueError):
        return None
    return None if sentence is None or sentence.startswith(fitting or ("\0",)) else f"{path}: {sentence}"


def explained(path: Path, problem: str, *fitting: str) -> str:
    """The line for an error of a reader: what the file is if that is recognised, else its own problem.

    Args:
        problem: the whole line, with the path. fitting: as of `wrong_file`.
    """
    return wrong_file(path, *fitting) or problem


def kind_of_bytes(head: bytes) -> str | None:
    """The sentence about a file that begins with these bytes, without its name; None: not recognised."""
    if not head:
        return "is empty: copy or download it again"
    if head.startswith((b"PK\x03\x04", b"PK\x05\x06")):
        return _zip_kind(head)
    for magic, offset, sentence in _MAGIC:
        if head[offset : offset + len(magic)] == magic:
            return sentence
    text = head.removeprefix(b"\xef\xbb\xbf").lstrip()
    return next((sentence for pattern, sentence in _TEXTS if pattern.match(text)), None)


def kind_of_text(text: str) -> str | None:
    """The same of a text that was read already."""
    return kind_of_bytes(text[:_HEAD_BYTES].encode())


def why_no_frames(path: Path) -> str:
    """Why a video file has none, as a sentence without its name; empty: its container does not say.

    By an MP4 file's index (`moov`, ISO 14496-12), which is written when a recording ends, and the names of
    the tracks' codecs near the beginning of a Matroska file.
    """
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
        kind = kind_of_bytes(head)
        if kind == _MP4:
            index = _mp4_index(file, path.stat().st_size)
            if index is None:
                return (
                    "is an MP4 video without its index (moov): its recording or copy was not ended; copy it "
                    "again, or repair it with untrunc"
                )
            images, sound = b"vide" in index, b"soun" in index
        elif kind == _MATROSKA:
            images, sound = (re.search(rb"\x86[\x82-\xbf]" + of, head) is not None for of in (b"V_", b"A_"))
        else:
            return ""
    if images:
        return ""
    return (
        "has sound but no images" if sound else "is a video without frames: its recording was ended too early"
    )


def _mp4_index(file: BinaryIO, size: int) -> bytes | None:
    """The content of the index; None if there is none."""
    at = 0
    while at + 8 <= size:
        file.seek(at)
        header = file.read(16)
        length, kind = int.from_bytes(header[:4], "big"), header[4:8]
        if kind == b"moov":
            file.seek(at)
            return file.read(min(length or size, _INDEX_BYTES))
        if length == 1:
            length = int.from_bytes(header[8:16], "big")
        if length < 8:  # 0: to the end of the file
            return None
        at += length
    return None


def _zip_kind(head: bytes) -> str:
    """By the names near its beginning: reading the directory of a hostile one takes memory."""
    if b"/data.pkl" in head or b"/constants.pkl" in head:
        return "is a checkpoint of torch"
    name = head[30 : 30 + int.from_bytes(head[26:28], "little")]
    if name.endswith(b".npy"):
        return "is an archive of NumPy arrays"
    return "is a zip archive: unpack it and give the file that is in it"


def open_file(path: Path) -> BufferedReader:
    """Open a file for reading. Raises OSError, also for a pipe, where opening would wait for its writer."""
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    if stat.S_ISFIFO(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise OSError(errno.ESPIPE, "is a pipe, give a file", str(path))
    return open(descriptor, "rb")
