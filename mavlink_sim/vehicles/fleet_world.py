"""The vehicles of a fleet as they see and meet one another: each is a thing in the world of the others.

The world begins where the first of them started; each one's own local frame begins at its own start.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from mavlink_sim.physics.airframe import Vector
from mavlink_sim.physics.midair import Body, Midair
from mavlink_sim.physics.neighbours import Neighbours
from mavlink_sim.vehicles.vehicle import STEP_S, Vehicle
from mavlink_sim.world.aircraft import Aircraft, aircraft_objects

if TYPE_CHECKING:
    from mavlink_sim.world.world import WorldObject


def position_in_world(vehicle: Vehicle) -> Vector:
    """The true position NED in metres, from where the world begins."""
    north, east, down = vehicle.airframe.position
    start_north, start_east = vehicle.start_ned_m
    return (start_north + north, start_east + east, down)


def as_aircraft(vehicle: Vehicle) -> Aircraft:
    """Where a vehicle is in the world at this moment."""
    airframe = vehicle.airframe
    return Aircraft(
        vehicle.system_id,
        position_in_world(vehicle),
        airframe.roll_rad,
        airframe.pitch_rad,
        airframe.yaw_rad,
    )


class FleetWorld:
    """The vehicles that fly in one world.

    Whoever steps them in lockstep calls `meet` after each step of 4 ms of all, and none can fly through
    another. A vehicle's `copy` is in no fleet_world.

    Args:
        size: how many there will be.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self._vehicles: list[Vehicle] = []
        self._midair = Midair()
        self._seen: tuple[int, int, tuple[WorldObject, ...]] | None = None

    def join(self, vehicle: Vehicle, offset: int = 0) -> None:
        """From now on the others see and measure it, and run into it.

        Args:
            offset: from a system id to its identifier among the world's things (`identifier_offset`), by
                which the others' collisions with it are told; the same for all.

        Raises:
            ValueError: it is in one place with another, has joined before, or is one too many.
        """
        number = vehicle.system_id
        if len(self._vehicles) == self.size:
            raise ValueError(f"vehicle {number}: this fleet_world is of {self.size}, and all have joined")
        faults = vehicle.faults
        body = Body(
            vehicle.airframe,
            vehicle.start_ned_m,
            offset + number,
            f"vehicle {number}",
            lambda: faults.now_s,
        )
        self._midair.join(body)
        vehicle.neighbours = Neighbours(self._midair.bodies, body)
        self._vehicles.append(vehicle)
        self._seen = None

    def meet(self) -> None:
        """Let those that touch run into each other; to be called when all have been stepped by 4 ms."""
        self._midair.resolve(STEP_S)

    def others(self, vehicle: Vehicle) -> list[Aircraft]:
        """All but this one, as they are at this moment, in the order in which they joined."""
        return [as_aircraft(other) for other in self._vehicles if other is not vehicle]

    def objects(self, vehicle: Vehicle, offset: int, stamp_ns: int) -> list[WorldObject]:
        """All but this one as objects of a world (`aircraft_objects`).

        Args:
            stamp_ns: of this moment: whoever asks for the same is told the same, which is made only once.
        """
        if len(self._vehicles) < 2:
            return []
        if self._seen is None or self._seen[:2] != (stamp_ns, offset):
            everybody = aircraft_objects([as_aircraft(one) for one in self._vehicles], offset)
            self._seen = (stamp_ns, offset, everybody)
        others = zip(self._vehicles, self._seen[2], strict=True)
        return [item for other, item in others if other is not vehicle]
