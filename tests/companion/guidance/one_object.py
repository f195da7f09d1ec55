"""The first object of a table, for tests that follow one."""

from __future__ import annotations

from collections.abc import Sequence

from companion.guidance.objects.table import ObjectTable
from companion.guidance.objects.target import Target
from companion.guidance.objects.tracked_object import TrackedObject
from companion.vehicle.state import Vector3


class OneObject:
    """A table whose first frame shows one object.

    Attributes:
        table: all objects.
    """

    def __init__(self, target: Target, vehicle: Vector3) -> None:
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

    def update(self, targets: Sequence[Target], vehicle: Vector3, captured_ns: int | None = None) -> bool:
        """Add a frame. True: it shows the object."""
        before = self.now.last_ns
        self._newest_ns = targets[0].captured_ns if captured_ns is None else captured_ns
        self.table.update(targets, vehicle, self._newest_ns)
        return self.now.last_ns > before
