"""The poses of other aircraft for a camera in its own process: a ring of slots in shared memory.

The message in the camera's pipe has the slot's number: the poses of a large fleet are more than a pipe writes
atomically, and a queue of them would fill it.
"""

from __future__ import annotations

import ctypes
import struct
from collections.abc import Sequence
from multiprocessing.context import BaseContext

from mavlink_sim.world.aircraft import Aircraft

SLOTS = 8
_HEADER = struct.Struct("=qi")
"""The number, and the count of aircraft."""
_AIRCRAFT = struct.Struct("=B6d")
"""System id; position NED in metres; roll, pitch, yaw in radians."""


class SharedPoses:
    """One side writes, without waiting; the other reads by number.

    Args:
        context: that of the process that gets it at its start.
        most: greatest number of aircraft.
    """

    def __init__(self, context: BaseContext, most: int) -> None:
        self._most = most
        self._slot_bytes = _HEADER.size + most * _AIRCRAFT.size
        self._memory = context.RawArray(ctypes.c_ubyte, SLOTS * self._slot_bytes)
        self._kept = 0

    def write(self, aircraft: Sequence[Aircraft]) -> int:
        """Write them into the current slot, which is reused unless `keep` is called. Returns their number.

        Raises:
            ValueError: there are more than `most`.
        """
        if len(aircraft) > self._most:
            raise ValueError(f"{len(aircraft)} other aircraft: this camera was made for {self._most} at most")
        number = self._kept
        memory = memoryview(self._memory)
        at = number % SLOTS * self._slot_bytes
        _HEADER.pack_into(memory, at, number, len(aircraft))  # first: a concurrent reader detects the change
        at += _HEADER.size
        for system_id, position, roll_rad, pitch_rad, yaw_rad in aircraft:
            _AIRCRAFT.pack_into(memory, at, system_id, *position, roll_rad, pitch_rad, yaw_rad)
            at += _AIRCRAFT.size
        return number

    def keep(self) -> None:
        """Keep the last ones until `SLOTS` - 1 more are kept, because their number has been sent."""
        self._kept += 1

    def read(self, number: int) -> tuple[Aircraft, ...] | None:
        """The poses of a number; None if they have been overwritten."""
        memory = memoryview(self._memory)
        at = number % SLOTS * self._slot_bytes
        found, count = _HEADER.unpack_from(memory, at)
        if found != number:
            return None
        copied = bytes(memory[at + _HEADER.size : at + _HEADER.size + count * _AIRCRAFT.size])
        if _HEADER.unpack_from(memory, at)[0] != number:  # a sequence lock: copy first, then check again
            return None
        return tuple(
            Aircraft(system_id, (north, east, down), roll_rad, pitch_rad, yaw_rad)
            for system_id, north, east, down, roll_rad, pitch_rad, yaw_rad in _AIRCRAFT.iter_unpack(copied)
        )
