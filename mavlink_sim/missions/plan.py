"""A stored plan, and the progress of the mission."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import IntEnum

from mavlink_sim.missions import items as mission_items
from mavlink_sim.missions.items import MissionItem

MAX_JUMPS = 10  # PX4's MAX_JUMP_ITERATION: number of consecutive DO_JUMP that are followed


class MissionState(IntEnum):
    """MISSION_STATE."""

    NO_MISSION = 1
    NOT_STARTED = 2
    ACTIVE = 3
    PAUSED = 4
    COMPLETE = 5


@dataclass(frozen=True, slots=True)
class Plan:
    """The items of a mission, a fence or the rally points, with PX4's identifier (0 for none)."""

    items: tuple[MissionItem, ...] = ()
    identifier: int = 0


@dataclass(slots=True)
class Mission:
    """The mission on board and its progress.

    Attributes:
        current: index of the current item. reached: the last one reached, -1 for none.
        valid: it passed the feasibility checks. finished: it was completed.
        jumps: how often each DO_JUMP was followed.
    """

    items: tuple[MissionItem, ...] = ()
    current: int = 0
    reached: int = -1
    valid: bool = False
    finished: bool = False
    jumps: dict[int, int] = field(default_factory=dict)

    @property
    def item(self) -> MissionItem:
        """The current item."""
        return self.items[self.current]

    def go_to(self, index: int) -> bool:
        """Make an item the current one, following DO_JUMP. False, and no change, past the end."""
        found = self._resolve(index, count=True)
        if found is None:
            return False
        self.current = found
        return True

    def advance(self) -> bool:
        """Continue with the next item; False at the end."""
        return self.go_to(self.current + 1)

    def positions(self, start: int) -> Iterator[tuple[int, MissionItem]]:
        """The items with a position from `start` on, in the order of flight, with the current DO_JUMPs."""
        index = self._resolve(start, count=False)
        for _ in self.items:
            if index is None:
                return
            if self.items[index].has_position:
                yield index, self.items[index]
            index = self._resolve(index + 1, count=False)

    def next_position(self, start: int) -> MissionItem | None:
        """The first item with a position from `start` on."""
        return next((item for _, item in self.positions(start)), None)

    def land_start(self) -> int | None:
        """Index where the landing begins: DO_LAND_START, else the landing itself; None without a landing."""
        landing = self.landing()
        if landing is None:
            return None
        for index, item in enumerate(self.items[:landing]):
            if item.command == mission_items.DO_LAND_START:
                return index
        return landing

    def landing(self) -> int | None:
        """Index of the first landing."""
        for index, item in enumerate(self.items):
            if item.command == mission_items.LAND:
                return index
        return None

    def _resolve(self, index: int, *, count: bool) -> int | None:
        for _ in range(MAX_JUMPS):
            if not 0 <= index < len(self.items):
                return None
            item = self.items[index]
            if item.command != mission_items.DO_JUMP:
                return index
            target, repeats = (_whole(value) for value in item.parameters[:2])
            if not 0 <= target < len(self.items):
                return None
            if self.jumps.get(index, 0) < repeats:
                if count:
                    self.jumps[index] = self.jumps.get(index, 0) + 1
                index = target
            else:
                index += 1
        return index if 0 <= index < len(self.items) else None


def _whole(value: float) -> int:
    return int(value) if abs(value) < 2**31 else -1
