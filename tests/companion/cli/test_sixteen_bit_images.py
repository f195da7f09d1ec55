"""Every command that reads image files, given a thermal camera's counts of 14 bits."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from mavlink_sim.datasets.board_views import LENSES, write_board_views
from tests.companion.command_line import companion_here
from vision.calibration.boards import Board

LENS, BOARD = LENSES["webcam"].scaled(320, 240), Board("chessboard", 7, 5, 0.03)
COMMANDS = {
    "detect": "detect images --model {model} --image-size 64 --save saved",
    "status": "detect images --model none --period 0 --save saved",
    "evaluate": "learn evaluate images --model {model} --image-size 64",
    "train": "learn train --data images --validation images --from {model} --output out.safetensors "
    "--image-size 64 --batch-size 2 --workers 0 --steps 1",
    "compare": "models show {model} --compare {exported} --images images",
    "calibrate": "calibrate lens images --board chessboard 7x5 --square 0.03 -o lens.yaml",
}


@pytest.fixture(scope="module")
def counts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with `images` of a board, with labels."""
    folder = tmp_path_factory.mktemp("counts")
    write_board_views(folder / "images", BOARD, LENS, 6, 3)
    for path in (folder / "images").glob("*.png"):
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert grey is not None
        assert cv2.imwrite(str(path), grey.astype(np.uint16) * 8 + 7000)
        path.with_suffix(".txt").write_text("0 0.5 0.5 0.2 0.2\n")
    return folder


@pytest.mark.parametrize("name", COMMANDS)
def test_counts_of_14_bits_are_stretched_and_said_once(
    name: str, counts: Path, small_model: Path, exported_model: Path, tmp_path: Path
) -> None:
    (tmp_path / "images").mkdir()  # its own: the line is said once a folder
    for path in (counts / "images").iterdir():
        (tmp_path / "images" / path.name).symlink_to(path)
    words = COMMANDS[name].format(model=small_model, exported=exported_model).split()
    done = companion_here(*words, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    said = re.findall(r"16-bit image with values (\d+) to (\d+)", done.stderr)
    assert len(said) == 1
    assert 7000 <= int(said[0][0]) < int(said[0][1]) <= 7000 + 255 * 8
    for path in (tmp_path / "saved").glob("**/*.*"):
        saved = cv2.imread(str(path))
        assert saved is not None
        assert np.ptp(saved) > 200
