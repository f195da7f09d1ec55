"""Which object a behaviour begins with: a detector misses single frames, so one frame must not decide."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

from companion.guidance.targets.target import Target
from vision.attitude import wrap_angle

# From the first true object on it is looked for so long whether another is meant.
CHOOSING_S = 0.4
# Before the nose are all within this, and of them the one that is nearest to the vehicle is meant.
BEFORE_RAD = math.radians(10.0)


class TargetSelector:
    """Collects the true objects of the first moments and takes the nearest of those before the nose.

    With none before it, the one nearest to the nose. What is true in some frames and doubted in as many is
    not chosen.
    """

    def __init__(self) -> None:
        self._seen: dict[int, Target] = {}
        self._trusted: Counter[int] = Counter()
        self._doubted: Counter[int] = Counter()
        self._since_ns: int | None = None
        self._newest_ns = -1

    def take(self, fitting: Sequence[Target], yaw_rad: float, now_ns: int) -> Target | None:
        """The choice, once it is made: its newest detection. None: not yet.

        Args:
            fitting: of the newest frame, those of the class, `trusted` or not. Without identities one frame
                decides.
            yaw_rad: of the nose.
        """
        trusted = [target for target in fitting if target.trusted]
        if any(target.track_id is None for target in trusted):
            return _nearest(trusted, yaw_rad)
        for target in fitting:
            identity = target.track_id
            if identity is None or target.captured_ns <= self._newest_ns:
                continue
            if target.trusted:
                self._trusted[identity] += 1
                self._seen[identity] = target
                if self._since_ns is None:
                    self._since_ns = now_ns
            elif identity in self._seen:
                self._doubted[identity] += 1
        self._newest_ns = max([self._newest_ns, *(target.captured_ns for target in fitting)])
        if self._since_ns is None or now_ns - self._since_ns < CHOOSING_S * 1e9:
            return None
        sure = [t for identity, t in self._seen.items() if self._trusted[identity] > self._doubted[identity]]
        if not sure:
            return None
        chosen = _nearest(sure, yaw_rad)
        if now_ns - chosen.captured_ns > 2 * CHOOSING_S * 1e9:
            assert chosen.track_id is not None
            self._forget(chosen.track_id)  # gone again: the next nearest
            self._since_ns = now_ns if self._seen else None
            return None
        return chosen

    def _forget(self, identity: int) -> None:
        for memory in (self._seen, self._trusted, self._doubted):
            memory.pop(identity, None)


def _nearest(targets: Sequence[Target], yaw_rad: float) -> Target:
    def rank(target: Target) -> tuple[float, float, float]:
        off_rad = abs(wrap_angle(target.bearing_rad - yaw_rad))
        range_m = target.ground_range_m if math.isfinite(target.ground_range_m) else math.inf
        return (max(off_rad, BEFORE_RAD), range_m, off_rad)

    return min(targets, key=rank)
