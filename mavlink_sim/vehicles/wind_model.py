"""The gusts of a world, the same for all vehicles in it."""

from __future__ import annotations

import math
import random

from mavlink_sim.physics.airframe import GUST_STEP_S, GUST_TIME_CONSTANT_S
from mavlink_sim.physics.gaussian import BITS, NORMAL
from mavlink_sim.physics.rotations import Vector

GUST_STEP_US = round(GUST_STEP_S * 1e6)
_KEEP = 1.0 - GUST_STEP_S / GUST_TIME_CONSTANT_S


class WindModel:
    """The gusts of one seed.

    Args:
        seed: the same for all vehicles of a fleet.
        gusts_mps: standard deviation per axis.
    """

    def __init__(self, seed: int, gusts_mps: float) -> None:
        self._bits = random.Random(f"air {seed}").getrandbits
        self._spread = gusts_mps * math.sqrt(1.0 - _KEEP * _KEEP)
        self._gust: Vector = (0.0, 0.0, 0.0)
        self._next_us = 0

    def gust_at(self, time_us: int) -> Vector:
        """NED m/s at a simulated time; times may only grow."""
        bits, spread = self._bits, self._spread
        while self._next_us <= time_us:
            self._next_us += GUST_STEP_US
            north, east, down = self._gust
            self._gust = (
                _KEEP * north + spread * NORMAL[bits(BITS)],
                _KEEP * east + spread * NORMAL[bits(BITS)],
                _KEEP * down + spread * NORMAL[bits(BITS)],
            )
        return self._gust
