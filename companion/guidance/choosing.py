"""Which object a behaviour begins with: a detector misses single frames, so one frame must not decide."""

from __future__ import annotations

import math
from collections.abc import Sequence

from companion.guidance.target import Target
from vision.rotation import wrap_angle

# From the first true object on it is looked for so long whether another is nearer to the nose.
CHOOSING_S = 0.4
# Before the nose are all within this, and of them the one that is nearest to the vehicle is meant.
BEFORE_RAD = math.radians(10.0)


class Choice:
    """Collects the true objects of the first moments and takes the nearest of those before the nose.

    With none before it, the one nearest to the nose.
    """

    def __init__(self) -> None:
        self._seen: dict[int | None, Target] = {}
        self._since_ns: int | None = None

    def take(self, trusted: Sequence[Target], yaw_rad: float, now_ns: int) -> Target | None:
        """The choice, once it is made: its newest detection. None: not yet.

        Args:
            trusted: of the newest frame, those that may be chosen. Without identities one frame decides.
            yaw_rad: of the nose.
        """
        if trusted and any(target.track_id is None for target in trusted):
            return _nearest(trusted, yaw_rad)
        for target in trusted:
            self._seen[target.track_id] = target
            if self._since_ns is None:
                self._since_ns = now_ns
        if self._since_ns is None or now_ns - self._since_ns < CHOOSING_S * 1e9:
            return None
        chosen = _nearest(list(self._seen.values()), yaw_rad)
        if now_ns - chosen.captured_ns > 2 * CHOOSING_S * 1e9:
            self._seen.pop(chosen.track_id)  # gone again: the next nearest
            self._since_ns = now_ns if self._seen else None
            return None
        return chosen


def _nearest(targets: Sequence[Target], yaw_rad: float) -> Target:
    def rank(target: Target) -> tuple[float, float]:
        off_rad = abs(wrap_angle(target.bearing_rad - yaw_rad))
        range_m = target.range_m if math.isfinite(target.range_m) else math.inf
        return (max(off_rad, BEFORE_RAD), range_m)

    return min(targets, key=rank)
