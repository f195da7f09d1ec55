"""PX4's mode requirements and fallback without a valid horizontal position.

A mode that needs a position is refused, and left if it is active: Position falls back to Altitude (v1.18:
only with a pilot's sticks), every other mode to Descend, as Return and Land need a position too. Descend is
reported as LAND in HEARTBEAT, as by PX4: level, sinking with MPC_LAND_SPEED, drifting with the wind. OFFBOARD
is left only if its setpoints need a position or a velocity; then they count as lost. When the position is
back in the air, the intended mode is resumed; a vehicle that has descended to the ground stays there.
`failsafes` selects the mode; this module has the requirements and the descent.
"""

from __future__ import annotations

from mavlink_sim.flight.position_control import NAN, Demand, TrajectorySetpoint
from mavlink_sim.flight.tasks import Land, Task
from mavlink_sim.physics.airframe import Multirotor
from mavlink_sim.px4.modes import Mode
from mavlink_sim.px4.parameters import Parameters

# ALTCTL, STABILIZED, ACRO and MANUAL need none; OFFBOARD depends on its setpoints.
WITHOUT_POSITION = frozenset({Mode.ALTCTL, Mode.STABILIZED, Mode.ACRO, Mode.MANUAL, Mode.OFFBOARD})


class Descend(Task):
    """Descend without a position: level, with MPC_LAND_SPEED and constant heading."""

    landing = True

    def __init__(self, parameters: Parameters, yaw_rad: float) -> None:
        self._parameters = parameters
        self._yaw_rad = yaw_rad

    def update(self, dt_s: float) -> TrajectorySetpoint:
        speed = self._parameters.number("MPC_LAND_SPEED")
        return TrajectorySetpoint(
            velocity=(NAN, NAN, speed), acceleration=(0.0, 0.0, NAN), yaw_rad=self._yaw_rad
        )


class Sink(Task):
    """A climb-rate mode without sticks: PX4's flight tasks need them, so it descends.

    Flown on v1.16.2: 0.6 to 0.8 m/s to the ground.
    """

    def __init__(self, parameters: Parameters, yaw_rad: float) -> None:
        self._descent = Descend(parameters, yaw_rad)

    def update(self, dt_s: float) -> TrajectorySetpoint:
        return self._descent.update(dt_s)


class Drift(Task):
    """A mode of tilt and thrust without sticks: the last of them stays (flown on v1.16.2, Stabilized)."""

    def __init__(self, demand: Demand) -> None:
        self.demand = Demand(demand.thrust_mps2, demand.roll_rad, demand.pitch_rad, 0.0)

    def update(self, dt_s: float) -> TrajectorySetpoint:
        return TrajectorySetpoint()


def task_without_sticks(mode: Mode, airframe: Multirotor, parameters: Parameters, demand: Demand) -> Task:
    """The task of a mode of sticks while there are none. `demand`: the last one."""
    if mode in (Mode.POSCTL, Mode.POSITION_SLOW, Mode.ALTCTL):
        return Sink(parameters, airframe.yaw_rad)
    return Drift(demand)


def needs_position(mode: Mode) -> bool:
    """Whether PX4 refuses the mode without a valid horizontal position."""
    return mode not in WITHOUT_POSITION


def asks_for_position(setpoint: TrajectorySetpoint) -> bool:
    """Whether an offboard setpoint needs the position or velocity (an acceleration does not)."""
    return any(x == x or y == y or z == z for x, y, z in (setpoint.position, setpoint.velocity))


def landing_task(airframe: Multirotor, parameters: Parameters, *, position_valid: bool) -> Task:
    """The task of mode LAND: at one point, or a descent without a position."""
    if position_valid:
        return Land(airframe, parameters)
    return Descend(parameters, airframe.yaw_rad)
