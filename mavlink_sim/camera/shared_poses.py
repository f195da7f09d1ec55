"""Where the other aircraft are, for the camera's process, in memory that both processes have.

They do not go through the pipe that the camera's own pose goes through: for a large fleet they are more than
a pipe takes at once, so that a write could end in the midst of them, and a queue of them would fill it. They
lie in a ring of slots, and the message in the pipe names their number.
"""

from __future__ import annotations

import ctypes
import struct
from collections.abc import Sequence
from multiprocessing.context import BaseContext

from mavlink_sim.world.aircraft import Aircraft

SLOTS = 8
_HEADER = struct.Struct("=qi")
"""The number, and how many aircraft follow."""
_AIRCRAFT = struct.Struct("=B6d")
"""System id; position NED in metres; roll, pitch, yaw in radians."""


class SharedPoses:
    """One side writes, never waiting; the other reads what it has a number of.

    Args:
        context: that of the process which it is handed to when that is started.
        most: how many aircraft there can be.
    """

    def __init__(self, context: BaseContext, most: int) -> None:
        self._most = most
        self._slot_bytes = _HEADER.size + most * _AIRCRAFT.size
        self._memory = context.RawArray(ctypes.c_ubyte, SLOTS * self._slot_bytes)
        self._kept = 0

    def write(self, aircraft: Sequence[Aircraft]) -> int:
        """Write them where the next ones will be written too, unless `keep` is called. Returns their number.

        Raises:
            ValueError: they are more than there can be.
        """
        if len(aircraft) > self._most:
            raise ValueError(f"{len(aircraft)} other aircraft: this camera was made for {self._most} at most")
        number = self._kept
        memory = memoryview(self._memory)
        at = number % SLOTS * self._slot_bytes
        _HEADER.pack_into(memory, at, number, len(aircraft))  # first: whoever reads now sees that it changed
        at += _HEADER.size
        for system_id, position, roll_rad, pitch_rad, yaw_rad in aircraft:
            _AIRCRAFT.pack_into(memory, at, system_id, *position, roll_rad, pitch_rad, yaw_rad)
            at += _AIRCRAFT.size
        return number

    def keep(self) -> None:
        """The number of those written last has been sent: leave them until `SLOTS` - 1 more were kept."""
        self._kept += 1

    def read(self, number: int) -> tuple[Aircraft, ...] | None:
        """Those of a number; None if others have been written over them, which are newer."""
        memory = memoryview(self._memory)
        at = number % SLOTS * self._slot_bytes
        found, count = _HEADER.unpack_from(memory, at)
        if found != number:
            return None
        copied = bytes(memory[at + _HEADER.size : at + _HEADER.size + count * _AIRCRAFT.size])
        if _HEADER.unpack_from(memory, at)[0] != number:  # a sequence lock: copy first, then look again
            return None
        return tuple(
            Aircraft(system_id, (north, east, down), roll_rad, pitch_rad, yaw_rad)
            for system_id, north, east, down, roll_rad, pitch_rad, yaw_rad in _AIRCRAFT.iter_unpack(copied)
        )
