"""The firmwares to emulate: PX4, or an ArduPilot Copter (`mavlink_sim.vehicles.ardupilot`)."""

from __future__ import annotations

from mavlink_sim.vehicles.vehicle import Vehicle

PX4, ARDUPILOT = "px4", "ardupilot"
AUTOPILOTS = (PX4, ARDUPILOT)


def vehicle_class(autopilot: str) -> type[Vehicle]:
    """The vehicle class of a firmware. Raises ValueError for an unknown one."""
    if autopilot == PX4:
        return Vehicle
    if autopilot == ARDUPILOT:
        # imported here: its message definitions load slowly
        from mavlink_sim.vehicles.ardupilot.copter import CopterVehicle

        return CopterVehicle
    raise ValueError(f"autopilot {autopilot!r}: expected one of {', '.join(AUTOPILOTS)}")
