"""Which autopilot a vehicle is like: PX4, or an ArduPilot Copter (`mavlink_sim.vehicles.ardupilot`)."""

from __future__ import annotations

from mavlink_sim.vehicles.vehicle import Vehicle

PX4, ARDUPILOT = "px4", "ardupilot"
AUTOPILOTS = (PX4, ARDUPILOT)


def vehicle_class(autopilot: str) -> type[Vehicle]:
    """The class of vehicle with an autopilot's profile. Raises ValueError for one that is not known."""
    if autopilot == PX4:
        return Vehicle
    if autopilot == ARDUPILOT:
        # imported here: its message definitions take their time to load
        from mavlink_sim.vehicles.ardupilot.copter import CopterVehicle

        return CopterVehicle
    raise ValueError(f"autopilot {autopilot!r}: expected one of {', '.join(AUTOPILOTS)}")
