"""Vehicles as objects of a world, visible for the others."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

if TYPE_CHECKING:
    from mavlink_sim.world.world import Vector, World, WorldObject

AIRCRAFT_CLASS = "drone"


class Aircraft(NamedTuple):
    """The pose of a vehicle at one time.

    Attributes:
        system_id: its MAVLink system id, 1 to 255.
        position_ned_m: from the world's origin, of the centre between its feet.
        roll_rad, pitch_rad, yaw_rad: its attitude.
    """

    system_id: int
    position_ned_m: Vector
    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    yaw_rad: float = 0.0


def identifier_offset(world: World) -> int:
    """The offset from a vehicle's system id to its identifier, which no object of the world has."""
    return max((item.identifier for item in world.objects), default=-1)


def aircraft_objects(aircraft: Iterable[Aircraft], offset: int) -> tuple[WorldObject, ...]:
    """Vehicles as objects of a world, in their order.

    The identifier is the system id plus `offset` (`identifier_offset`): the same for all cameras, at any
    time. The colours are drawn from the system id.
    """
    # imported here: a fleet without a camera needs no rendering, not even OpenCV
    from mavlink_sim.world.world import WorldObject

    return tuple(
        WorldObject(
            offset + one.system_id,
            AIRCRAFT_CLASS,
            one.position_ned_m,
            one.yaw_rad,
            appearance=one.system_id,
            roll_rad=one.roll_rad,
            pitch_rad=one.pitch_rad,
            system_id=one.system_id,
        )
        for one in aircraft
    )
