"""Plain images of an episode, drawn with lines and circles."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from mavlink_sim.environments.spaces import Array

SIZE_PX = 320
BACKGROUND, GROUND = (245, 245, 245), (215, 215, 205)
GREY, VEHICLE, TARGET, SEEN = (150, 150, 150), (30, 60, 200), (200, 40, 40), (230, 150, 30)
ABOVE = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])  # east to the right, north up
SIDE = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])  # east to the right, seen from the south

Place = Array | Sequence[float]
Colour = tuple[int, int, int]


class Canvas:
    """Square views of one scene, side by side. All positions are (3,) NED, metres.

    Args:
        width_m: of each view. centre: of all.
        views: projections to (right, down), (2, 3) each.
    """

    def __init__(self, width_m: float, centre: Place, views: Sequence[Array] = (ABOVE, SIDE)) -> None:
        self._views = [(view, np.full((SIZE_PX, SIZE_PX, 3), BACKGROUND, np.uint8)) for view in views]
        self._scale, self._centre = SIZE_PX / width_m, centre
        for view, image in self._views:
            if view is SIDE:
                image[max(self._pixel(view, (0.0, 0.0, 0.0))[1], 0) :] = GROUND

    @property
    def image(self) -> NDArray[np.uint8]:
        """(SIZE_PX, SIZE_PX times the views, 3) RGB."""
        return np.concatenate([image for _, image in self._views], axis=1)

    def _pixel(self, view: Array, place: Place) -> tuple[int, int]:
        at = SIZE_PX / 2 + view @ np.subtract(place, self._centre) * self._scale
        x, y = np.clip(at, -10 * SIZE_PX, 10 * SIZE_PX)
        return round(x), round(y)

    def line(self, start: Place, end: Place, colour: Colour, thickness: int = 2) -> None:
        """A line; thickness in pixels."""
        for view, image in self._views:
            ends = self._pixel(view, start), self._pixel(view, end)
            cv2.line(image, *ends, colour, thickness, cv2.LINE_AA)

    def circle(self, centre: Place, radius_m: float, colour: Colour, thickness: int = 2) -> None:
        """A circle of at least 3 pixels; a thickness of -1 fills it."""
        radius = max(round(radius_m * self._scale), 3)
        for view, image in self._views:
            cv2.circle(image, self._pixel(view, centre), radius, colour, thickness, cv2.LINE_AA)
