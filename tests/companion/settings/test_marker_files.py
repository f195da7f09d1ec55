"""Files of marker boards and maps."""

from __future__ import annotations

import errno
import math
import os
from pathlib import Path

import numpy as np
import pytest

from companion.settings import Settings
from companion.settings.marker_files import BoardError, read_boards, read_map
from companion.settings.reading import ConfigurationError, load_settings
from vision.markers import square

BOARDS = """
[[boards]]
name = "dock"
[[boards.markers]]
id = 3
size_m = 0.2
position_m = [-0.3, 0, 0]
[[boards.markers]]
id = 4
size_m = 0.1
position_m = [0.3, 0.1, 0]
rotation_deg = [0, 0, 90]
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "file.toml"


def test_boards_are_read(file: Path) -> None:
    file.write_text(BOARDS)
    (board,) = read_boards(file)
    assert (board.name, dict(board.sizes_m)) == ("dock", {3: 0.2, 4: 0.1})
    assert np.allclose(board.corners_m[3], square(0.2) + np.array([-0.3, 0.0, 0.0]))
    # A quarter turn counter-clockwise: the upper left corner is to the lower left.
    assert np.allclose(board.corners_m[4][0], [0.25, 0.05, 0.0])


def test_map_has_lying_and_standing_markers(file: Path) -> None:
    file.write_text(
        "[origin]\nlatitude_deg = 47.4\nlongitude_deg = 8.5\naltitude_m = 488\n"
        "[[markers]]\nid = 1\nsize_m = 0.5\nposition_m = [6, 2, 0]\nyaw_deg = 90\n"
        "[[markers]]\nid = 2\nsize_m = 0.4\nposition_m = [9, 0, -1]\nyaw_deg = 180\nstanding = true\n"
    )
    board = read_map(file)
    assert board.origin == (47.4, 8.5, 488)
    # The upper edge of a lying one points east; its left is to the north.
    assert np.allclose(board.corners_m[1][0], [6.25, 2.25, 0.0])
    assert np.allclose(board.corners_m[1][1], [5.75, 2.25, 0.0])
    # A standing one faces south: seen from there its left is to the west.
    assert np.allclose(board.corners_m[2][0], [9.0, -0.2, -1.2])


@pytest.mark.parametrize(
    ("text", "names"),
    [
        ("[[boards]", ["not TOML"]),
        ("", ["boards", "required"]),
        (BOARDS.replace("size_m = 0.1", "size_m = 0"), ["boards[0].markers[1].size_m", "0.01", "got 0"]),
        (BOARDS.replace("id = 4", "id = 3"), ["marker 3", "twice"]),
        (BOARDS.replace("[-0.3, 0, 0]", "[1, 2]"), ["boards[0].markers[0].position_m", "3 items"]),
        (BOARDS.replace("rotation_deg", "turn"), ["boards[0].markers[1].turn"]),
        (BOARDS + BOARDS, ["boards[1].name", "'dock'"]),
        (BOARDS.replace("dock", "map"), ["boards[0].name", "'map'"]),
    ],
)
def test_bad_file_is_one_line_that_names_the_key(file: Path, text: str, names: list[str]) -> None:
    file.write_text(text)
    with pytest.raises(BoardError) as caught:
        read_boards(file)
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(str(file))
    assert all(name in message for name in names), message


def test_settings_read_the_boards_and_their_sizes(file: Path) -> None:
    file.write_text(BOARDS)
    settings = load_settings(
        None, {"markers.dictionary": "4X4_50", "markers.boards_file": str(file), "markers.others": "7:0.3"}
    )
    kind = settings.markers.kind()
    assert kind is not None
    assert (kind.size_of(3), kind.size_of(7), kind.size_of(9)) == (0.2, 0.3, 0.5)
    with pytest.raises(ConfigurationError, match=r"marker 3 .*0\.3 m .* 0\.2 m .*'dock'"):
        load_settings(None, {"markers.boards_file": str(file), "markers.others": "3:0.3"})
    with pytest.raises(ConfigurationError, match=rf"none\.toml: {os.strerror(errno.ENOENT)}"):
        load_settings(None, {"markers.boards_file": str(file.with_name("none.toml"))})
    assert Settings().markers.boards() == ()
    assert math.isclose(kind.size_of(4), 0.1)
