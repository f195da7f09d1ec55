"""Calibration boards: chessboards and ChArUco boards, their detection, and their print.

The board's frame has its origin at the middle of the inner corners, x to the print's right, y to its lower
edge, z into the board, so that a board seen face on and upright has the identity as its rotation.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.marker_dictionaries import dictionary_named, lengths_of, opencv_dictionary
from vision.markers import markers_in

KINDS = ("chessboard", "charuco")
# Fewest corners of a partly visible ChArUco board, of the share of all.
LEAST_CORNERS, LEAST_SHARE = 8, 0.25
# Share of a square, around a corner, that its refinement uses.
REFINED_SHARE = 0.4


@dataclass(frozen=True, eq=False)
class BoardView:
    """A board in one image.

    Attributes:
        points_m: (N, 2) float64, the detected inner corners in the board's plane, metres.
        corners_px: (N, 2) float64, the same in the image, pixels.
        size: width and height of the image, pixels.
        name: of the image.
        legacy: whether it is a ChArUco board as OpenCV drew them before 4.6, and as calib.io does.
    """

    points_m: NDArray[np.float64]
    corners_px: NDArray[np.float64]
    size: tuple[int, int]
    name: str = ""
    legacy: bool = False


@dataclass(frozen=True)
class Board:
    """A printed board.

    Attributes:
        kind: "chessboard" or "charuco".
        columns, rows: inner corners of a chessboard, squares of a ChArUco board, as OpenCV counts them.
        square_m: side of a square, metres.
        marker_m, dictionary: of a ChArUco board: side of a marker's black square, and the name of the
            dictionary ("4X4_50"). A family (calib.io's "DICT_4X4") is its shortest with enough markers.

    Raises:
        ValueError: the kind, a size or the dictionary is invalid, or the dictionary has too few markers.
    """

    kind: str
    columns: int
    rows: int
    square_m: float
    marker_m: float | None = None
    dictionary: str | None = None

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise ValueError(f"the board must be one of {', '.join(KINDS)}, got {self.kind!r}")
        if not (3 <= self.columns <= 100 and 3 <= self.rows <= 100):
            raise ValueError(f"a board needs 3x3 to 100x100, got {self.columns}x{self.rows}")
        if not (math.isfinite(self.square_m) and self.square_m > 0.0):
            raise ValueError(f"the side of a square must be above 0 m, got {self.square_m:g}")
        if self.kind == "chessboard":
            if self.marker_m is not None or self.dictionary is not None:
                raise ValueError("a chessboard has no markers: leave out the marker and the dictionary")
            return
        if self.marker_m is None or self.dictionary is None:
            raise ValueError("a charuco board needs the side of its markers and their dictionary")
        if not 0.0 < self.marker_m < self.square_m:
            raise ValueError(
                f"the markers' side must be above 0 and below the squares' {self.square_m:g} m, "
                f"got {self.marker_m:g}"
            )
        wanted = self.columns * self.rows // 2
        enough = (name for name in lengths_of(self.dictionary) if markers_in(name) >= wanted)
        object.__setattr__(self, "dictionary", next(enough, None) or dictionary_named(self.dictionary))
        if wanted > (count := markers_in(self.dictionary)):
            raise ValueError(
                f"a charuco board of {self.columns}x{self.rows} squares has {wanted} markers, dictionary "
                f"{self.dictionary} has {count}"
            )

    @classmethod
    def parse(
        cls,
        kind: str,
        size: str,
        square_m: float,
        marker_m: float | None = None,
        dictionary: str | None = None,
    ) -> Board:
        """The board of texts: `chessboard`, `10x7`. Raises ValueError."""
        if (found := re.fullmatch(r"(\d{1,3})x(\d{1,3})", size)) is None:
            raise ValueError(f"the board's size must be COLUMNSxROWS such as 10x7, got {size!r}")
        return cls(kind, int(found[1]), int(found[2]), square_m, marker_m, dictionary)

    @property
    def squares(self) -> tuple[int, int]:
        """Columns and rows of squares."""
        more = 1 if self.kind == "chessboard" else 0
        return self.columns + more, self.rows + more

    @property
    def size_m(self) -> tuple[float, float]:
        """Width and height of all squares, without a margin, metres."""
        across, down = self.squares
        return across * self.square_m, down * self.square_m

    @cached_property
    def points_m(self) -> NDArray[np.float64]:
        """(N, 2) all inner corners in the board's plane, row by row, metres."""
        across, down = (count - 1 for count in self.squares)
        x, y = np.meshgrid(np.arange(across) - (across - 1) / 2, np.arange(down) - (down - 1) / 2)
        return np.column_stack([x.ravel(), y.ravel()]) * self.square_m

    def detect(self, image: NDArray[Any], name: str = "") -> BoardView | None:
        """The board in an image, its corners with sub-pixel accuracy; None if it is not found.

        A chessboard must be seen completely, a ChArUco board only in part. With an even number of rows there
        are two ChArUco boards: OpenCV's, and the one of before 4.6, with a marker in the upper-left square.
        Either is found; their corners are at the same places.

        Args:
            image: (H, W, 3) uint8 BGR or (H, W) uint8 grey.
        """
        grey = image if image.ndim == 2 else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
        if self.kind == "chessboard":
            found, legacy = self._chessboard(grey), False
        else:
            found, legacy = self._charuco(grey)
        if found is None:
            return None
        indices, corners = found
        corners = self._refined(grey, np.asarray(corners, np.float32).reshape(-1, 2))
        return BoardView(self.points_m[indices], corners, (grey.shape[1], grey.shape[0]), name, legacy)

    def _refined(self, grey: NDArray[Any], corners: NDArray[np.float32]) -> NDArray[np.float64]:
        """Corners by the gradients around each one (Förstner and Gülch 1987), as far as no marker is near.

        On rendered views of chessboards this halves the detector's error, to 0.05 px, and removes its bias.
        """
        apart = np.linalg.norm(corners[:, None] - corners, axis=2) + np.diag(np.full(len(corners), np.inf))
        clear = REFINED_SHARE
        if self.marker_m is not None:
            clear = min(clear, (1.0 - self.marker_m / self.square_m) / 2)
        half = max(2, round(float(apart.min()) * clear))
        criteria = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 50, 1e-3)
        refined = cv2.cornerSubPix(grey, corners[:, None].copy(), (half, half), (-1, -1), criteria)
        return np.asarray(refined, np.float64).reshape(-1, 2)

    def _chessboard(self, grey: NDArray[Any]) -> tuple[Any, Any] | None:
        shape = (self.columns, self.rows)
        # Duda and Frese 2018, "Accurate detection and localization of checkerboard corners".
        found, corners = cv2.findChessboardCornersSB(grey, shape, flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
        return (slice(None), corners) if found else None

    def _charuco(self, grey: NDArray[Any]) -> tuple[tuple[Any, Any] | None, bool]:
        """Indices and pixels of the corners, and whether the board is of before OpenCV 4.6.

        OpenCV gives no corners where the markers are not those of the pattern.
        """
        corners, identifiers, markers, marker_ids = self._detector.detectBoard(grey)
        legacy = identifiers is None and marker_ids is not None and self.rows % 2 == 0
        if legacy:
            corners, identifiers, _, _ = self._legacy_detector.detectBoard(
                grey, markerCorners=markers, markerIds=marker_ids
            )
        if identifiers is None:
            return None, False
        indices = np.ravel(identifiers)
        least = max(LEAST_CORNERS, math.ceil(LEAST_SHARE * len(self.points_m)))
        across = self.columns - 1
        if len(indices) < least or min(len(set(indices % across)), len(set(indices // across))) < 2:
            return None, False
        return (indices, corners), legacy

    @cached_property
    def _opencv(self) -> cv2.aruco.CharucoBoard:
        assert self.marker_m is not None
        assert self.dictionary is not None
        dictionary = opencv_dictionary(self.dictionary)
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square_m, self.marker_m, dictionary)

    @cached_property
    def _detector(self) -> cv2.aruco.CharucoDetector:
        return cv2.aruco.CharucoDetector(self._opencv)

    @cached_property
    def _legacy_detector(self) -> cv2.aruco.CharucoDetector:
        board = cv2.aruco.CharucoBoard(
            self._opencv.getChessboardSize(),
            self._opencv.getSquareLength(),
            self._opencv.getMarkerLength(),
            self._opencv.getDictionary(),
        )
        board.setLegacyPattern(True)
        return cv2.aruco.CharucoDetector(board)

    def image(self, square_px: int) -> NDArray[np.uint8]:
        """The print: (H, W) uint8, 0 or 255, with a white margin of one square around it."""
        across, down = self.squares
        if self.kind == "charuco":
            image = self._opencv.generateImage((across * square_px, down * square_px))
            inner = np.where(np.asarray(image) > 127, 255, 0).astype(np.uint8)
        else:
            odd = (np.arange(down)[:, None] + np.arange(across)) % 2
            inner = np.kron(odd * 255, np.ones((square_px, square_px))).astype(np.uint8)
        return np.pad(inner, square_px, constant_values=255)
