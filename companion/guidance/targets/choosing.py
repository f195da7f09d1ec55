"""Target selection over several frames, because a detector misses single frames."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence

from companion.guidance.targets.target import Target
from vision.attitude import wrap_angle

# Candidates are collected for this long from the first confirmed object on.
CHOOSING_S = 0.4
# Objects within this angle of the nose count as ahead; of these the nearest one is selected.
BEFORE_RAD = math.radians(10.0)


class TargetSelector:
    """Collects confirmed objects for `CHOOSING_S` and selects the nearest one ahead.

    If none is ahead, the one with the smallest angle from the nose. An object that is ambiguous in at least
    as many frames as it is confirmed in is not selected.
    """

    def __init__(self) -> None:
        self._seen: dict[int, Target] = {}
        self._trusted: Counter[int] = Counter()
        self._doubted: Counter[int] = Counter()
        self._since_ns: int | None = None
        self._newest_ns = -1

    def update(self, fitting: Sequence[Target], yaw_rad: float, now_ns: int) -> Target | None:
        """The selected object's newest detection; None: not selected yet.

        Args:
            fitting: the newest frame's targets of the class, `trusted` or not. Without track ids one frame
                decides.
            yaw_rad: of the vehicle.
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
            self._forget(chosen.track_id)  # lost again: select the next nearest
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
