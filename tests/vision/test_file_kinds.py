"""The kind of a file by its first bytes."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import pytest

from vision.file_kinds import explained, why_no_frames, wrong_file

_FTYP = b"\0\0\0\x10ftypisom\0\0\2\0"
# First bytes → a word of the sentence.
KINDS = {
    b"": "empty",
    b"version https://git-lfs.github.com/spec/v1\noid sha256:00\n": "git lfs pull",
    b"\n<!doctype html><html>": "HTML",
    b"<html><body>502": "HTML",
    b'{\n  "fileType": "Plan", "mission": {}}': "QGroundControl",
    b'{"mission": {}, "fileType":"Plan"}': "QGroundControl",
    b"QGC WPL 110\n": "waypoints",
    b"# Onboard parameters for Vehicle 1\n": "parameter",
    '[[step]]\ndo = "land"\n'.encode("utf-16"): "UTF-8",
    b"\xff\xd8\xff\xe0": "JPEG",
    b"\x89PNG\r\n\x1a\n": "PNG",
    _FTYP: "MP4",
    b"\0\0\0\x18ftypheic": "HEIC",
    b"\0\0\0\x18ftypavif": "AVIF",
    b"\0\0\0\x18ftypM4A ": "sound",
    b"RIFF\0\0\0\0WAVEfmt ": "WAV",
    b"\x1aE\xdf\xa3": "Matroska",
    b"\x89MCAP0\r\n": "MCAP",
    b"ULog\x01\x12\x35": "ULog",
    b"\x1f\x8b\x08": "gzip",
    b"\x89HDF\r\n\x1a\n": "HDF5",
    b"\x1c\0\0\0TFL3": "TensorFlow",
    b'<?xml version="1.0"?><annotation>': "VOC",
    b'<?xml version="1.0"?>\n<kml xmlns="">': "KML",
    b"-----BEGIN PRIVATE KEY-----": "PEM",
    b"\x93NUMPY\x01": "NumPy",
}
UNKNOWN = (
    b"[source]\n",
    b'{"images": []}',
    b'<?xml version="1.0"?><net name="x">',
    b"\x08\x07\x12",
    b"0 0.5 0.5\n",
)


@pytest.mark.parametrize(("head", "word"), KINDS.items(), ids=list(KINDS.values()))
def test_kind_is_recognised(head: bytes, word: str, tmp_path: Path) -> None:
    path = tmp_path / "given.toml"
    path.write_bytes(head)
    sentence = wrong_file(path)
    assert sentence is not None
    assert sentence.startswith(f"{path}: ")
    assert word in sentence
    assert explained(path, "other") == sentence


@pytest.mark.parametrize("head", UNKNOWN)
def test_unknown_kind_keeps_the_readers_error(head: bytes, tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(head)
    assert explained(tmp_path / "a", "the reader's") == "the reader's"


@pytest.mark.parametrize(
    ("member", "word"), [("readme.txt", "unpack"), ("yolo/data.pkl", "torch"), ("a.npy", "NumPy")]
)
def test_zip_is_named_by_its_members(member: str, word: str, tmp_path: Path) -> None:
    with zipfile.ZipFile(content := io.BytesIO(), "w") as archive:
        archive.writestr(member, "")
    (tmp_path / "a.pt").write_bytes(content.getvalue())
    assert word in (wrong_file(tmp_path / "a.pt") or "")
    assert (wrong_file(tmp_path / "a.pt", "is a checkpoint of torch") is None) == (word == "torch")


_MDAT, _VIDEO, _SOUND = b"\0\0\0\x10mdat" + bytes(8), b"\0\0\0\x0cmoovvide", b"\0\0\0\x0cmoovsoun"
_MATROSKA = b"\x1aE\xdf\xa3"
# The file → a word of the reason.
NO_FRAMES = {
    "MP4 without index": (_FTYP + _MDAT, "moov"),
    "MP4 cut in its first box": (_FTYP[:12], "moov"),
    "MP4 of sound": (_FTYP + _SOUND + _MDAT, "sound"),
    "MP4 of nothing": (_FTYP + _MDAT + b"\0\0\0\x08moov", "without frames"),
    "MP4": (_FTYP + _MDAT + _VIDEO, ""),
    "MP4, index first": (_FTYP + _VIDEO + _MDAT, ""),
    "Matroska of sound": (_MATROSKA + b"\x86\x85A_AAC", "sound"),
    "Matroska of nothing": (_MATROSKA + bytes(40), "without frames"),
    "Matroska": (_MATROSKA + b"\x86\x85V_VP9\x86\x85A_AAC", ""),
    "another kind": (b"x" * 40, ""),
}


@pytest.mark.parametrize("name", NO_FRAMES)
def test_reason_why_a_video_has_no_frames(name: str, tmp_path: Path) -> None:
    content, word = NO_FRAMES[name]
    (path := tmp_path / "a.mp4").write_bytes(content)
    assert word in why_no_frames(path)
    assert bool(word) == bool(why_no_frames(path))
