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
from mavlink_sim.wire.streams import EQUIPMENT_RATES_HZ

_TAKEOFF_M = 5.0
_SETTLED_S = 5.0


@cache
def hovering(noise: float = 1.0) -> LockstepVehicle:
    """A vehicle that hovers in OFFBOARD, without wind; to be copied."""
    vehicle = LockstepVehicle({"onboard": dict.fromkeys(EQUIPMENT_RATES_HZ, 0.0)}, noise=noise, gusts_mps=0.0)
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

    def __init__(self, count: int, *, noise: float = 1.0) -> None:
        self._noise = noise
        self.vehicles = [hovering(noise)] * count
        # views of one array, so that `_read` writes the values of all vehicles at once
        self._state = np.zeros((22, count))
        self.position, self.velocity = self._state[0:3], self._state[3:6]
        self.estimated_position, self.estimated_velocity = self._state[6:9], self._state[9:12]
        self.rotation = self._state[12:21].reshape(3, 3, count)
        self.yaw_rad = self._state[21]
        self.wind, self.gusts_m_s, self.mass = np.zeros((3, count)), np.zeros(count), np.ones(count)
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
        self._read(which)

    def fly(self, velocity: Array, turn_rad_s: Array, rng: np.random.Generator) -> None:
        """As `FastModel.fly`; `rng` is not used: each vehicle has its own."""
        for index, (north, east, down, turn) in enumerate(
            zip(*velocity.tolist(), turn_rad_s.tolist(), strict=True)
        ):
            vehicle = self.vehicles[index].vehicle
            setpoint = TrajectorySetpoint(NOTHING, (north, east, down), NOTHING, NAN, turn)
            vehicle.autopilot.offboard_setpoint(setpoint)
            vehicle.step(STEP_S)
        self._read(np.arange(len(self.vehicles)))

    def _read(self, which: NDArray[np.intp]) -> None:
        vehicles = [self.vehicles[index].vehicle for index in which]
        rows = [
            (
                *one.airframe.position,
                *one.airframe.velocity,
                *one.estimate.position,
                *one.estimate.velocity,
                *one.airframe.matrix,
                one.estimate.yaw_rad,
            )
            for one in vehicles
        ]
        self._state[:, which] = np.array(rows).T
        self.failed[which] = [
            one.airframe.crashed or one.autopilot.mode is not Mode.OFFBOARD for one in vehicles
        ]
