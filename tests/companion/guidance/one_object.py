"""Detections of a car as a table of objects gets them, and what the table makes of one car."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from companion.guidance.objects.table import ObjectTable
from companion.guidance.objects.target import RangeSource, Target
from companion.guidance.objects.tracked_object import TrackedObject
from companion.vehicle.state import Vector3

T0, PERIOD_NS = 10**12, 100_000_000
VEHICLE = (0.0, 0.0, -5.0)


def seen_car(
    at: Sequence[float],
    frame: float = 0,
    *,
    vehicle: Vector3 = VEHICLE,
    along_error_m: float = 0.0,
    across_error_m: float = 0.0,
    source: RangeSource = RangeSource.GROUND_PLANE,
    **changes: Any,
) -> Target:
    """A car at (north, east), measured from the vehicle with these errors along and across the view."""
    ahead_m, right_m = at[0] - vehicle[0], at[1] - vehicle[1]
    range_m = math.hypot(ahead_m, right_m) + along_error_m
    bearing = math.atan2(right_m, ahead_m) + across_error_m / range_m
    known = source is not RangeSource.NONE
    target = Target(
        "car",
        0.8,
        T0 + round(frame * PERIOD_NS),
        bearing,
        -0.3,
        range_m if known else math.nan,
        source,
        (vehicle[0] + range_m * math.cos(bearing), vehicle[1] + range_m * math.sin(bearing), 0.0)
        if known
        else None,
        range_sigma_m=0.5 if known else math.nan,
    )
    return replace(target, **changes)


class OneObject:
    """A table whose first frame shows one object.

    Attributes:
        table: all objects.
    """

    def __init__(self, target: Target, vehicle: Vector3 = VEHICLE) -> None:
        self.table = ObjectTable()
        self.table.update([target], vehicle, target.captured_ns)
        self._newest_ns = target.captured_ns

    @property
    def now(self) -> TrackedObject:
        """That object."""
        return next(each for each in self.table.objects if each.object_id == 1)

    @property
    def track_id(self) -> int | None:
        return self.now.track_id

    @property
    def position_ned_m(self) -> Vector3:
        return self.now.position_at(self._newest_ns)

    def update(
        self, targets: Sequence[Target], vehicle: Vector3 = VEHICLE, captured_ns: int | None = None
    ) -> bool:
        """Add a frame. True: it shows the object."""
        before = self.now.last_ns
        self._newest_ns = targets[0].captured_ns if captured_ns is None else captured_ns
        self.table.update(targets, vehicle, self._newest_ns)
        return self.now.last_ns > before
