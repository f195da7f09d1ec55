"""The vehicles of a fleet in one world: each is an object for the others.

The world's origin is the start of the first vehicle; each local frame has its origin at its vehicle's start.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mavlink_sim.physics.midair import Body, Midair, Neighbours
from mavlink_sim.physics.rotations import Vector
from mavlink_sim.vehicles.vehicle import STEP_S, Vehicle
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
    """The vehicles of one world.

    In lockstep, call `meet` after each step of 4 ms of all vehicles, so that they collide. A vehicle's `copy`
    is in no fleet world.

    Args:
        size: the number of vehicles.

    >>> from mavlink_sim import FleetWorld, LockstepVehicle
    >>> pair = [LockstepVehicle(system_id=1), LockstepVehicle(system_id=2, start_ned_m=(6.0, 0.0))]
    >>> world = FleetWorld(2)
    >>> for member in pair:
    ...     world.join(member.vehicle)
    >>> for member in pair:
    ...     member.step(0.004)
    >>> world.meet()
    >>> [member.truth.collisions for member in pair]
    [0, 0]
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self._vehicles: list[Vehicle] = []
        self._midair = Midair()
        self._seen: tuple[int, int, tuple[WorldObject, ...]] | None = None

    def join(self, vehicle: Vehicle, offset: int = 0) -> None:
        """Add a vehicle, visible, measurable and an obstacle for the others.

        Args:
            offset: from a system id to its identifier among the world's objects (`identifier_offset`), which
                the others' collisions with it have; the same for all.

        Raises:
            ValueError: it overlaps another, has joined before, or the world is full.
        """
        number = vehicle.system_id
        if len(self._vehicles) == self.size:
            raise ValueError(
                f"vehicle {number}: this fleet has {self.size} vehicles, and all of them have joined"
            )
        faults = vehicle.faults
        body = Body(
            vehicle.airframe, vehicle.start_ned_m, offset + number, f"vehicle {number}", lambda: faults.now_s
        )
        self._midair.join(body)
        vehicle.neighbours = Neighbours(self._midair.bodies, body)
        self._vehicles.append(vehicle)
        self._seen = None

    def meet(self) -> None:
        """Resolve collisions; to be called when all have been stepped by 4 ms."""
        self._midair.resolve(STEP_S)

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
