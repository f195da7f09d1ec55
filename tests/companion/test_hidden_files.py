"""The files that macOS adds to a folder (`._NAME`, AppleDouble) are none of a program's files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from companion.logs.flight_log import summaries
from vision.model_files import kept_models
from vision.runtimes.source import read_source

APPLE_DOUBLE = b"\0\x05\x16\x07\0\2\0\0Mac OS X        " + bytes(60)


def recordings(folder: Path) -> object:
    (folder / "flight.mcap").write_bytes(b"")
    return list(map(str, summaries(folder)))


def models(folder: Path) -> object:
    (folder / "mine.onnx").write_bytes(b"x")
    return [path.name for path in kept_models(folder)]


def openvino(folder: Path) -> object:
    (folder / "mine.xml").write_bytes(b"<net/>")
    with pytest.raises(Exception, match=r"mine\.xml") as raised:  # one file, and no network
        read_source(folder)
    return str(raised.value)


@pytest.mark.parametrize("listed", [recordings, models, openvino])
def test_hidden_files_change_nothing(listed: Callable[[Path], object], tmp_path: Path) -> None:
    before = listed(tmp_path)
    assert before
    for path in list(tmp_path.iterdir()):
        path.with_name(f"._{path.name}").write_bytes(APPLE_DOUBLE)
    assert listed(tmp_path) == before
