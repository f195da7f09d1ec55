"""Choice of views: which ones are new, which are fitted, and what is missing for a good calibration."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.calibration.boards import Board, BoardView

# The cells of the image that the board must reach: its outer fifths on each side.
EDGES = (0.2, 0.8)
# A complete set has so many views; a board that spans this share of the image's diagonal, and one that spans
# less by this factor; and boards with one edge longer than the opposite one by this factor, which is a tilt
# of some 20 degrees where the board spans a third of the image.
ENOUGH_VIEWS = 15
CLOSE, FARTHER = 0.4, 0.75
TILTED = 1.08
# Views that differ by less are the same: share of the image's diagonal, and logarithm of the edges' ratio.
SAME = 0.04
# So many views are fitted at most, since more hardly improve the lens.
MOST_VIEWS = 40
CELLS = tuple(
    f"{row} {column}" for row in ("upper", "middle", "lower") for column in ("left", "centre", "right")
)
_TILTS = ("left", "right", "upper", "lower")


class ViewCollector:
    """Collects views of a board that differ from each other.

    Args:
        whole_image: whether the board must reach all parts of the image, as for the fit of a lens.

    Attributes:
        views: the collected ones.
    """

    def __init__(self, board: Board, *, whole_image: bool = True) -> None:
        self.views: list[BoardView] = []
        self._board = board
        self._whole_image = whole_image
        self._features: list[NDArray[np.float64]] = []

    def add(self, view: BoardView) -> bool:
        """Keep a view if it is new; returns whether it was.

        Raises:
            ValueError: its image has another size than the views before.
        """
        if self.views and view.size != self.views[0].size:
            first = self.views[0]
            raise ValueError(
                f"all images must have one size: {first.name} has {first.size[0]}x{first.size[1]}, "
                f"{view.name} {view.size[0]}x{view.size[1]}"
            )
        features = _features(self._board, view)
        if any(float(np.linalg.norm(features - other)) < SAME for other in self._features):
            return False
        self.views.append(view)
        self._features.append(features)
        return True

    def missing(self) -> list[str]:
        """What is missing for a good calibration, in words; empty: nothing."""
        if not self.views:
            return ["a view of the board"]
        wanted = []
        corners = np.concatenate([view.corners_px for view in self.views])
        cells = np.digitize(corners / self.views[0].size, EDGES)
        seen = set((cells[:, 1] * 3 + cells[:, 0]).tolist())
        empty = [name for index, name in enumerate(CELLS) if index not in seen]
        if empty and self._whole_image:
            wanted.append(f"the board in the image's {', '.join(empty)}")
        features = np.array(self._features)
        spans, tilts = features[:, 2], features[:, 3:5]
        if spans.max() < CLOSE:
            wanted.append("the board closer")
        elif spans.min() > FARTHER * spans.max():
            wanted.append("the board farther away")
        reached = (-tilts.min(axis=0), tilts.max(axis=0))
        edges = (reached[1][0], reached[0][0], reached[1][1], reached[0][1])
        if level := [edge for edge, most in zip(_TILTS, edges, strict=True) if most < math.log(TILTED)]:
            wanted.append(f"the board tilted, its {' or '.join(level)} edge nearer")
        if len(self.views) < ENOUGH_VIEWS:
            wanted.append(f"{ENOUGH_VIEWS - len(self.views)} more views")
        return wanted

    def chosen(self) -> list[BoardView]:
        """At most MOST_VIEWS views that differ most, in their order: farthest-point sampling."""
        if len(self.views) <= MOST_VIEWS:
            return list(self.views)
        features = np.array(self._features)
        # The largest board first: it has the most of the lens.
        kept = [int(features[:, 2].argmax())]
        nearest = np.linalg.norm(features - features[kept[0]], axis=1)
        while len(kept) < MOST_VIEWS:
            kept.append(int(nearest.argmax()))
            nearest = np.minimum(nearest, np.linalg.norm(features - features[kept[-1]], axis=1))
        return [self.views[index] for index in sorted(kept)]


def _features(board: Board, view: BoardView) -> NDArray[np.float64]:
    """(6,) centre x and y, and span, in shares of the image's diagonal; tilts; direction of the upper edge.

    A tilt is the logarithm of the ratio of opposite edges: of left to right, of upper to lower in the image.
    """
    homography = cv2.findHomography(view.points_m, view.corners_px)[0]
    points = board.points_m
    low, high = points.min(axis=0), points.max(axis=0)
    outline = np.array([[low, (high[0], low[1]), high, (low[0], high[1])]])
    corners = cv2.perspectiveTransform(outline, homography)[0]
    middle = corners.mean(axis=0)
    # As seen in the image, however the board is turned: from the corner at the upper left.
    corners = np.roll(corners, -int((corners - middle).sum(axis=1).argmin()), axis=0)
    edges = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    upper, right, lower, left = np.maximum(edges, 1e-6)
    diagonal = math.hypot(*view.size)
    extent = np.linalg.norm(view.corners_px.max(axis=0) - view.corners_px.min(axis=0))
    direction = corners[1] - corners[0]
    turn = math.atan2(direction[1], direction[0])
    return np.array(
        [*(middle / diagonal), extent / diagonal, math.log(left / right), math.log(upper / lower), turn / 4]
    )
