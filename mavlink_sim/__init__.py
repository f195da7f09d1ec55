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

A flight with the parameters of QUICK_FLIGHT takes half as long:

>>> from mavlink_sim import QUICK_FLIGHT
>>> quick = LockstepVehicle(seed=1, parameters=QUICK_FLIGHT)
>>> quick.take_off(5.0)
>>> quick.truth.time_s < 12.0
True
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mavlink_sim.camera.scene import Scene
    from mavlink_sim.camera.scene_file import load_scene
    from mavlink_sim.camera.simulated_camera import SimulatedCamera, frame_truth
    from mavlink_sim.lockstep import CommandRefusedError, LockstepVehicle, NotReachedError, Truth
    from mavlink_sim.testing import QUICK_FLIGHT, RunningSimulator, running_simulator
    from mavlink_sim.vehicles.vehicle import Vehicle

__all__ = [
    "QUICK_FLIGHT",
    "CommandRefusedError",
    "LockstepVehicle",
    "NotReachedError",
    "RunningSimulator",
    "Scene",
    "SimulatedCamera",
    "Truth",
    "Vehicle",
    "__version__",
    "frame_truth",
    "load_scene",
    "running_simulator",
]

_HOMES = {
    "CommandRefusedError": "lockstep",
    "LockstepVehicle": "lockstep",
    "NotReachedError": "lockstep",
    "QUICK_FLIGHT": "testing",
    "RunningSimulator": "testing",
    "Scene": "camera.scene",
    "SimulatedCamera": "camera.simulated_camera",
    "Truth": "lockstep",
    "Vehicle": "vehicles.vehicle",
    "frame_truth": "camera.simulated_camera",
    "load_scene": "camera.scene_file",
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
