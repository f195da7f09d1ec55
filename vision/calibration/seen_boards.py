"""The board that images show, where it is not the one that was looked for.

A ChArUco board states its layout by the ids of its markers: two rows below a marker is the one whose id is
larger by the number of columns. Only neighbours are compared, in the frame of one of them, so that a lens
needs no model.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.calibration.boards import Board
from vision.marker_dictionaries import DICTIONARIES, opencv_dictionary

FAMILIES = (
    *(f"{bits}_250" for bits in ("4X4", "5X5", "6X6", "7X7")),
    *(name for name in reversed(DICTIONARIES) if not name[0].isdigit()),
)
"""Dictionaries of boards, the fastest first; a longer one begins with the markers of the shorter ones."""
_MAX_COLUMNS = 60
# Fewest markers, and pairs of neighbours, that show a layout; share of the pairs that must agree with it, and
# by how much more than with the next one.
_LEAST_MARKERS, _LEAST_PAIRS, _AGREEING, _CLEAR = 6, 12, 0.85, 0.04
# A neighbour is where it is expected within this share of a square.
_TOLERANCE = 0.35
# Measured with a ruler, a marker's side differs from the stated one by less than this share.
_SIDE_TOLERANCE = 0.15


@dataclass(frozen=True, slots=True)
class SeenBoard:
    """A ChArUco board in an image.

    Attributes:
        dictionary: of its markers; where the board's own does not fit, the longest of the family.
        columns, rows: of squares; rows are at least so many.
        marker_first: whether the upper-left square has a marker.
        marker_share: side of a marker over that of a square.
    """

    dictionary: str
    columns: int
    rows: int
    marker_first: bool
    marker_share: float


def seen_board(image: NDArray[Any], dictionaries: Iterable[str]) -> SeenBoard | None:
    """The ChArUco board in an image, of the first dictionary whose markers form one.

    Args:
        image: (H, W, 3) uint8 BGR or (H, W) uint8 grey.
    """
    grey = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
    found = (_layout(grey, name) for name in dictionaries)
    return next((layout for layout in found if layout is not None), None)


def contradiction(board: Board, seen: Sequence[SeenBoard]) -> str | None:
    """How the boards in most images contradict the one that was given; None: they agree, or none was seen."""
    if not seen:
        return None
    kinds = Counter((each.dictionary, each.columns, each.marker_first) for each in seen)
    most, _ = kinds.most_common(1)[0]
    same = [each for each in seen if (each.dictionary, each.columns, each.marker_first) == most]
    share = float(np.median([each.marker_share for each in same]))
    found = replace(same[0], rows=max(each.rows for each in same), marker_share=share)
    if _agrees(board, found):
        return None
    family = found.dictionary.removesuffix("_250")
    first = "a marker" if found.marker_first else "no marker"
    return (
        f"the images show a charuco of {found.columns} columns and at least {found.rows} rows of squares, "
        f"{first} in the upper left one, {family}, markers of {share:.2f} of a square's side; looked for "
        f"{described(board)}"
    )


def described(board: Board) -> str:
    """A board in words."""
    if board.kind == "chessboard":
        return f"a chessboard of {board.columns}x{board.rows} inner corners"
    assert board.marker_m is not None
    return (
        f"a charuco of {board.columns}x{board.rows} squares (COLUMNSxROWS), {board.dictionary}, markers of "
        f"{board.marker_m / board.square_m:.2f} of a square's side"
    )


def _agrees(board: Board, seen: SeenBoard) -> bool:
    if board.kind != "charuco" or seen.dictionary != board.dictionary:
        return False
    assert board.marker_m is not None
    share = board.marker_m / board.square_m
    return (
        seen.columns == board.columns
        and seen.rows <= board.rows
        and (not seen.marker_first or board.rows % 2 == 0)
        and abs(seen.marker_share - share) <= _SIDE_TOLERANCE * share
    )


@cache
def _detector(dictionary: str) -> cv2.aruco.ArucoDetector:
    return cv2.aruco.ArucoDetector(opencv_dictionary(dictionary))


def _layout(grey: NDArray[Any], dictionary: str) -> SeenBoard | None:
    """The layout that the markers of a dictionary in an image agree with; None: they are no such board."""
    corners, identifiers, _ = _detector(dictionary).detectMarkers(grey)
    if identifiers is None or len(identifiers) < _LEAST_MARKERS:
        return None
    ids = np.ravel(identifiers)
    markers = np.asarray(corners, np.float64).reshape(-1, 4, 2)
    # In each marker's own frame: right and down, in its sides.
    right = (markers[:, 1] - markers[:, 0] + markers[:, 2] - markers[:, 3]) / 2
    down = (markers[:, 3] - markers[:, 0] + markers[:, 2] - markers[:, 1]) / 2
    centres = markers.mean(axis=1)
    inverse = np.linalg.pinv(np.stack([right, down], axis=-1))
    offsets = np.einsum("iab,ijb->ija", inverse, centres[None, :] - centres[:, None])
    # The mean of both frames: a slope seen from either end cancels.
    offsets = (offsets - offsets.transpose(1, 0, 2)) / 2
    far = np.abs(offsets).max(axis=2) + np.diag(np.full(len(ids), np.inf))
    # The nearest marker is diagonally beside each, one square away in both directions.
    square = float(np.median(np.abs(offsets[np.arange(len(ids)), far.argmin(axis=1)])))
    if not square > 1.0:
        return None
    one, other = np.nonzero(far < 2.5 * square)
    if len(one) < _LEAST_PAIRS:
        return None
    near = offsets[one, other] / square
    scores: list[tuple[float, int, bool]] = []
    for columns in range(3, _MAX_COLUMNS + 1):
        for first in (False, True):
            column, row = _squares(ids, columns, first)
            expected = np.column_stack([column[other] - column[one], row[other] - row[one]])
            agreeing = float((np.abs(near - expected).max(axis=1) < _TOLERANCE).mean())
            scores.append((agreeing, columns, first))
    (second, *_), (agreeing, columns, first) = sorted(scores)[-2:]
    if agreeing < _AGREEING or agreeing - second < _CLEAR:
        return None
    rows = int(_squares(ids, columns, first)[1].max()) + 1
    return SeenBoard(dictionary, columns, rows, first, 1.0 / square)


def _squares(
    ids: NDArray[Any], columns: int, marker_first: bool
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Column and row of the squares of markers, which are counted row by row."""
    even_row = (columns + marker_first) // 2
    pair, place = ids // columns, ids % columns
    odd = place >= even_row
    place = np.where(odd, place - even_row, place)
    return 2 * place + (odd == marker_first), 2 * pair + odd
