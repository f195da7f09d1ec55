"""Plain pictures of an episode, drawn with lines and circles: from above and from the side."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

SIZE_PX = 320
BACKGROUND = (245, 245, 245)
GREY, VEHICLE, TARGET, SEEN = (150, 150, 150), (30, 60, 200), (200, 40, 40), (230, 150, 30)

Point = tuple[float, float]
Colour = tuple[int, int, int]


class View:
    """One square picture of a plane; x to the right and y up, in metres.

    Attributes:
        image: (SIZE_PX, SIZE_PX, 3) RGB.
    """

    def __init__(self, width_m: float, centre: Point) -> None:
        self.image: NDArray[np.uint8] = np.full((SIZE_PX, SIZE_PX, 3), BACKGROUND, np.uint8)
        self._scale = SIZE_PX / width_m
        self._centre = centre

    def _pixel(self, point: Point) -> tuple[int, int]:
        x = SIZE_PX / 2 + (point[0] - self._centre[0]) * self._scale
        y = SIZE_PX / 2 - (point[1] - self._centre[1]) * self._scale
        x, y = (min(max(value, -10.0 * SIZE_PX), 10.0 * SIZE_PX) for value in (x, y))
        return round(x), round(y)

    def line(self, start: Point, end: Point, colour: Colour, thickness: int = 2) -> None:
        """A line; thickness in pixels."""
        cv2.line(self.image, self._pixel(start), self._pixel(end), colour, thickness, cv2.LINE_AA)

    def circle(self, centre: Point, radius_m: float, colour: Colour, thickness: int = 2) -> None:
        """A circle of at least 3 pixels; a thickness of -1 fills it."""
        radius = max(round(radius_m * self._scale), 3)
        cv2.circle(self.image, self._pixel(centre), radius, colour, thickness, cv2.LINE_AA)
