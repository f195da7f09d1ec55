"""A simulated MAVLink vehicle: PX4-like, in Python, with a camera. Imports nothing of `companion`.

`LockstepVehicle` runs in the caller's process and is stepped by the caller; `running_simulator` starts one in
its own process; `mavlink-sim` on the command line runs one on UDP.

>>> from mavlink_sim import LockstepVehicle
>>> vehicle = LockstepVehicle(seed=1)
>>> vehicle.take_off(5.0)
>>> vehicle.set_position(10.0, 0.0, -5.0)
>>> vehicle.step(20.0)
>>> abs(vehicle.truth.position_ned_m[0] - 10.0) < 1.0
True
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mavlink_sim.lockstep import CommandRefusedError, LockstepVehicle, NotReachedError, Truth
    from mavlink_sim.testing import RunningSimulator, running_simulator
    from mavlink_sim.vehicles.fleet_world import FleetWorld
    from mavlink_sim.vehicles.vehicle import Vehicle

__all__ = [
    "CommandRefusedError",
    "FleetWorld",
    "LockstepVehicle",
    "NotReachedError",
    "RunningSimulator",
    "Truth",
    "Vehicle",
    "__version__",
    "running_simulator",
]

_HOMES = {
    "CommandRefusedError": "lockstep",
    "FleetWorld": "vehicles.fleet_world",
    "LockstepVehicle": "lockstep",
    "NotReachedError": "lockstep",
    "RunningSimulator": "testing",
    "Truth": "lockstep",
    "Vehicle": "vehicles.vehicle",
    "running_simulator": "testing",
}


def __getattr__(name: str) -> Any:
    """Import on demand: rendering alone must not load MAVLink's dialect."""
    if name == "__version__":
        from importlib.metadata import version

        return version("mavlink-companion")
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
