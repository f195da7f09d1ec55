"""The vehicles of a fleet in one world: each sees the others.

The world's origin is the start of the first vehicle; each local frame has its origin at its vehicle's start.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mavlink_sim.physics.rotations import Vector
from mavlink_sim.vehicles.vehicle import Vehicle
from mavlink_sim.world.aircraft import Aircraft, aircraft_objects

if TYPE_CHECKING:
    from mavlink_sim.world.world import WorldObject


def position_in_world(vehicle: Vehicle) -> Vector:
    """The true position, NED metres in the world frame."""
    north, east, down = vehicle.airframe.position
    start_north, start_east = vehicle.start_ned_m
    return (start_north + north, start_east + east, down)


def as_aircraft(vehicle: Vehicle) -> Aircraft:
    """A vehicle's current pose in the world."""
    airframe = vehicle.airframe
    return Aircraft(
        vehicle.system_id, position_in_world(vehicle), airframe.roll_rad, airframe.pitch_rad, airframe.yaw_rad
    )


class FleetWorld:
    """The vehicles of one world, in the order in which they joined.

    Args:
        size: the most vehicles that join.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self._vehicles: list[Vehicle] = []
        self._seen: tuple[int, int, tuple[WorldObject, ...]] | None = None

    def join(self, vehicle: Vehicle) -> None:
        """Add a vehicle, visible for the others."""
        self._vehicles.append(vehicle)
        self._seen = None

    def others(self, vehicle: Vehicle) -> list[Aircraft]:
        """The current poses of all but this one, in the order in which they joined."""
        return [as_aircraft(other) for other in self._vehicles if other is not vehicle]

    def objects(self, vehicle: Vehicle, offset: int, stamp_ns: int) -> list[WorldObject]:
        """All but this one as objects of a world (`aircraft_objects`).

        Args:
            stamp_ns: of now: calls with the same stamp get the same objects, which are built once.
        """
        if len(self._vehicles) < 2:
            return []
        if self._seen is None or self._seen[:2] != (stamp_ns, offset):
            everybody = aircraft_objects([as_aircraft(one) for one in self._vehicles], offset)
            self._seen = (stamp_ns, offset, everybody)
        others = zip(self._vehicles, self._seen[2], strict=True)
        return [item for other, item in others if other is not vehicle]
