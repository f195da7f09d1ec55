"""A source plug-in: `--source square://640x480?rate=10` is a red square moving in a circle."""

import math
import re

import numpy as np

from vision.sources import Capture, LatestSource, RawFrame, Source, SourceError, SourceSettings
from vision.sources.registry import source

SIDE_PX, ROUND_S = 40, 8.0


class SquareCapture(Capture):
    def __init__(self, width: int, height: int, rate_hz: float) -> None:
        self._size, self._rate_hz, self._count = (width, height), rate_hz, 0

    def read(self, timeout_s: float) -> RawFrame:
        width, height = self._size
        time_s = self._count / self._rate_hz
        angle = 2 * math.pi * time_s / ROUND_S
        left = round((width - SIDE_PX) * (0.5 + 0.4 * math.cos(angle)))
        top = round((height - SIDE_PX) * (0.5 + 0.4 * math.sin(angle)))
        image = np.full((height, width, 3), 128, np.uint8)
        image[top : top + SIDE_PX, left : left + SIDE_PX] = (20, 20, 230)
        self._count += 1
        return RawFrame(image, media_s=time_s)

    def close(self) -> None:
        """Nothing to close."""


@source("square", "a red square moving in a circle")
def open_square(uri: str, settings: SourceSettings) -> Source:
    match = re.fullmatch(r"square://(\d{2,4})x(\d{2,4})(?:\?rate=([1-9]\d{0,2}))?", uri)
    if match is None or min(int(match[1]), int(match[2])) <= SIDE_PX:
        raise SourceError(f"{uri}: expected square://WIDTHxHEIGHT?rate=HZ, e.g. square://640x480?rate=10")
    width, height, rate_hz = int(match[1]), int(match[2]), float(match[3] or settings.rate_hz or 10)
    return LatestSource(uri, lambda: SquareCapture(width, height, rate_hz), settings, paced=True)
