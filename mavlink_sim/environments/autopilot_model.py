"""The whole simulated autopilot behind the interface of `FastModel`: one `LockstepVehicle` for each episode.

An episode begins as a copy of one vehicle that hovers in OFFBOARD. Setpoints go to the autopilot without the
wire; its streams are off.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from mavlink_sim.environments.spaces import Array
from mavlink_sim.environments.task import STEP_S
from mavlink_sim.flight.position_control import NAN, NOTHING, TrajectorySetpoint
from mavlink_sim.lockstep import LockstepVehicle
from mavlink_sim.px4.modes import Mode

_TAKEOFF_M = 5.0
_SETTLED_S = 5.0


@cache
def hovering(noise: bool = True) -> LockstepVehicle:
    """A vehicle that hovers in OFFBOARD, without wind; to be copied."""
    vehicle = LockstepVehicle({"onboard": {}}, noise=noise, gusts_mps=0.0)
    vehicle.take_off(_TAKEOFF_M)
    vehicle.set_velocity(0.0, 0.0, 0.0)
    vehicle.step(_SETTLED_S)
    vehicle.stop_setpoints()
    return vehicle


class AutopilotModel:
    """`count` vehicles; attributes and methods as `FastModel`'s, except `fly_rotors`.

    wind, gusts_m_s and mass take effect with `begin`. The vehicles' own estimates have errors; mass is
    simulated by the effectiveness of the rotors.
    """

    def __init__(self, count: int, *, noise: bool = True) -> None:
        self._noise = noise
        self.vehicles = [hovering(noise)] * count
        self.position, self.velocity, self.wind = (np.zeros((3, count)) for _ in range(3))
        self.estimated_position, self.estimated_velocity = np.zeros((3, count)), np.zeros((3, count))
        self.rotation = np.zeros((3, 3, count))
        self.yaw_rad, self.gusts_m_s, self.mass = np.zeros(count), np.zeros(count), np.ones(count)
        self.failed = np.zeros(count, bool)

    def begin(
        self, which: NDArray[np.intp], position: Array, yaw_rad: Array, rng: np.random.Generator
    ) -> None:
        """As `FastModel.begin`."""
        for column, index in enumerate(which):
            north, east, down = position[:, column]
            vehicle = self.vehicles[index] = hovering(self._noise).copy(seed=int(rng.integers(2**31)))
            airframe, autopilot = vehicle.vehicle.airframe, vehicle.vehicle.autopilot
            airframe.position = (float(north), float(east), float(down))
            airframe.yaw_rad = float(yaw_rad[column])
            airframe.wind = (
                float(self.wind[0, index]),
                float(self.wind[1, index]),
                float(self.wind[2, index]),
            )
            airframe.gusts_mps = float(self.gusts_m_s[index])
            share = 1.0 / float(self.mass[index])
            airframe.rotor_effectiveness = (share, share, share, share)
            vehicle.vehicle.estimate.refresh()
            autopilot.controller.reset(vehicle.vehicle.estimate.yaw_rad)
            self._read(int(index))

    def fly(self, velocity: Array, turn_rad_s: Array, rng: np.random.Generator) -> None:
        """As `FastModel.fly`; `rng` is not used: each vehicle has its own."""
        for index, (north, east, down, turn) in enumerate(
            zip(*velocity.tolist(), turn_rad_s.tolist(), strict=True)
        ):
            vehicle = self.vehicles[index].vehicle
            setpoint = TrajectorySetpoint(NOTHING, (north, east, down), NOTHING, NAN, turn)
            vehicle.autopilot.offboard_setpoint(setpoint)
            vehicle.step(STEP_S)
            self._read(index)

    def _read(self, index: int) -> None:
        vehicle = self.vehicles[index].vehicle
        airframe, estimate = vehicle.airframe, vehicle.estimate
        self.position[:, index] = airframe.position
        self.velocity[:, index] = airframe.velocity
        self.rotation[:, :, index] = np.reshape(airframe.matrix, (3, 3))
        self.estimated_position[:, index] = estimate.position
        self.estimated_velocity[:, index] = estimate.velocity
        self.yaw_rad[index] = estimate.yaw_rad
        self.failed[index] = airframe.crashed or vehicle.autopilot.mode is not Mode.OFFBOARD
