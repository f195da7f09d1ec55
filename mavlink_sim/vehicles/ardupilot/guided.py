"""GUIDED: take-off and the newest target; a target without position stops the vehicle after GUID_TIMEOUT.

A position is flown to and held without a timeout. A velocity or an acceleration that is older than
GUID_TIMEOUT seconds becomes zero, and the vehicle stops; it stays in GUIDED. Paused (DO_PAUSE_CONTINUE) it
stops too, whatever new targets arrive.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from mavlink_sim.flight import tasks as flight
from mavlink_sim.flight.position_control import NAN, NOTHING, TrajectorySetpoint
from mavlink_sim.physics.airframe import LINEAR_DRAG_PER_S, Multirotor
from mavlink_sim.physics.rotations import Vector
from mavlink_sim.px4.parameters import Parameters
from mavlink_sim.vehicles.ardupilot.targets import STOP, GuidedTarget

# A target that runs ahead of the vehicle waits for it (ArduPilot's leash).
LEASH_M = 2.0
# Lag of the planned velocity behind its target, for the time the vehicle takes to tilt: tuned to a real
# Copter, whose step to 3 m/s passes 1.8 m/s after 1 s, peaks at 3.03 to 3.05 m/s, and stops within 3.2 m.
VELOCITY_LAG_S = 0.4
# The setpoint of a take-off leads the vehicle by its travel in this time, at least by the minimum.
CLIMB_LEAD_S = 0.35
LEAST_GAIN_MPS2 = 0.1
TAKEOFF_DONE_M = 0.06  # a take-off is complete within this distance of its height
FACING_SPEED_MPS = 1.0  # above this speed the direction of flight is defined
ZERO: Vector = (0.0, 0.0, 0.0)


class Heading:
    """The heading: a fixed one, a yaw rate, or along the direction of flight (WP_YAW_BEHAVIOR)."""

    def __init__(self, parameters: Parameters, yaw_rad: float) -> None:
        self._parameters = parameters
        self.yaw_rad = yaw_rad
        self._goal_rad = NAN
        self._rate_radps = NAN
        self._slew_radps = NAN

    def take(self, yaw_rad: float, rate_radps: float, slew_radps: float = NAN) -> None:
        self._goal_rad, self._rate_radps, self._slew_radps = yaw_rad, rate_radps, slew_radps

    def hold(self) -> None:
        """End a yaw rate."""
        if math.isnan(self._goal_rad) and not math.isnan(self._rate_radps):
            self._rate_radps = 0.0

    def advance(self, dt_s: float, velocity: Vector) -> float:
        goal = self._goal_rad
        if math.isnan(goal) and not math.isnan(self._rate_radps):
            self.yaw_rad = math.remainder(self.yaw_rad + self._rate_radps * dt_s, math.tau)
            return self.yaw_rad
        if math.isnan(goal):
            faces_flight = self._parameters.number("WP_YAW_BEHAVIOR") in (1, 2)
            if not faces_flight or math.hypot(velocity[0], velocity[1]) < FACING_SPEED_MPS:
                return self.yaw_rad
            goal = math.atan2(velocity[1], velocity[0])
        slew = math.radians(self._parameters.positive("ATC_SLEW_YAW") / 100.0)
        slew = min(slew, self._slew_radps) if self._slew_radps > 0.0 else slew
        error = math.remainder(goal - self.yaw_rad, math.tau)
        step = min(max(error, -slew * dt_s), slew * dt_s)
        self.yaw_rad = math.remainder(self.yaw_rad + step, math.tau)
        return self.yaw_rad


class Takeoff(flight.Takeoff):
    """Climb vertically, accelerating and braking by WPNAV_ACCEL_Z, up to WPNAV_SPEED_UP."""

    def _climb(self, dt_s: float, left_m: float) -> float:
        value = self._parameters.number
        gain = max(value("WPNAV_ACCEL_Z") / 100.0, LEAST_GAIN_MPS2)
        now = max(-self._airframe.velocity[2], 0.0)
        speed = min(
            now + gain * CLIMB_LEAD_S, math.sqrt(2.0 * gain * left_m), value("WPNAV_SPEED_UP") / 100.0
        )
        return max(speed, flight.SLOWEST_CLIMB_MPS)


class Guided(flight.Task):
    """The task of GUIDED. It begins with a stop.

    Args:
        avoid: limits a commanded velocity by ArduPilot's avoidance.

    Attributes:
        paused: stopped; continues with the newest target afterwards.
    """

    def __init__(
        self,
        airframe: Multirotor,
        parameters: Parameters,
        avoid: Callable[[Vector], Vector] = lambda velocity: velocity,
    ) -> None:
        self._airframe = airframe
        self._parameters = parameters
        self._avoid = avoid
        self.paused = False
        self._trajectory = flight.Trajectory(airframe, parameters)
        self._followed = self._trajectory.velocity
        self._takeoff: Takeoff | None = None
        self._reached = False  # the height of the take-off
        self._target = STOP
        self._age_s = 0.0
        self.heading = Heading(parameters, airframe.yaw_rad)

    # ---- targets ----------------------------------------------------------------------------------------

    def take_off(self, down_m: float) -> None:
        """Climb vertically to this NED z."""
        self._begin()
        self._reached = False
        self._takeoff = Takeoff(self._airframe, self._parameters, down_m)
        self.goal = self._takeoff.goal
        self.heading.take(NAN, 0.0)

    def fly(self, target: GuidedTarget) -> None:
        """Set a new target; it replaces the current one."""
        same_kind = self._kind(target) == self._kind(self._target)
        if self._takeoff is not None or not same_kind:
            self._begin()
        self._target, self._age_s = target, 0.0
        self.goal = target.position
        self.heading.take(target.yaw_rad, target.yaw_rate_radps)

    def cruise_at(self, speed_mps: float) -> None:
        self._trajectory.cruise_mps = speed_mps

    @property
    def target(self) -> GuidedTarget:
        """The target for POSITION_TARGET_LOCAL_NED."""
        if self._takeoff is not None:
            return GuidedTarget(position=self._takeoff.goal)
        return self._target

    @property
    def starting(self) -> bool:
        """A take-off is demanded; nothing else leaves the ground."""
        return self._takeoff is not None

    @property
    def is_taking_off(self) -> bool:
        """During the climb of a take-off."""
        if self._takeoff is None or self._takeoff.goal is None:
            return False
        self._reached |= self._airframe.position[2] - self._takeoff.goal[2] < TAKEOFF_DONE_M
        return not self._reached

    @staticmethod
    def _kind(target: GuidedTarget) -> tuple[bool, bool, bool]:
        return (
            target.position is not None,
            target.velocity is not None,
            target.acceleration is not None and target.velocity is None,
        )

    def _begin(self) -> None:
        cruise = self._trajectory.cruise_mps
        self._trajectory = flight.Trajectory(self._airframe, self._parameters)
        self._trajectory.cruise_mps = cruise
        self._followed = self._trajectory.velocity
        self._takeoff = None
        self._target = STOP
        self.heading.yaw_rad = self._airframe.yaw_rad

    # ---- one step ---------------------------------------------------------------------------------------

    def update(self, dt_s: float) -> TrajectorySetpoint:
        self._age_s += dt_s
        stale = self._age_s > self._parameters.number("GUID_TIMEOUT")
        if self._takeoff is not None and not self.paused:
            setpoint = self._takeoff.update(dt_s)
        elif self.paused:
            setpoint = self._by_velocity(dt_s, stale=True)
        elif self._target.position is None:
            setpoint = self._by_velocity(dt_s, stale)
        elif self._target.velocity is None:
            setpoint = self._trajectory.towards(self._target.position, dt_s)
        else:
            setpoint = self._by_moving_position(dt_s, stale)
        if stale and self._target.velocity is not None:
            self.heading.hold()
        setpoint.yaw_rad = self.heading.advance(dt_s, self._trajectory.velocity)
        return setpoint

    def _by_moving_position(self, dt_s: float, stale: bool) -> TrajectorySetpoint:
        target = self._target
        assert target.position is not None
        assert target.velocity is not None
        velocity = ZERO if stale else target.velocity
        x, y, z = (point + speed * dt_s for point, speed in zip(target.position, velocity, strict=True))
        self._target = GuidedTarget((x, y, z), velocity, None, target.yaw_rad, target.yaw_rate_radps)
        self._trajectory.velocity = velocity
        return TrajectorySetpoint((x, y, z), velocity, NOTHING)

    def _by_velocity(self, dt_s: float, stale: bool) -> TrajectorySetpoint:
        """A position setpoint that moves with the demanded velocity, within accelerations and leash."""
        value, target, trajectory = self._parameters.number, self._target, self._trajectory
        if stale or (target.velocity is None and target.acceleration is None):
            wanted = ZERO
        elif target.velocity is not None:
            wanted = self._avoid(target.velocity)
        else:
            assert target.acceleration is not None
            ax, ay, az = target.acceleration
            vx, vy, vz = trajectory.velocity
            wanted = (vx + ax * dt_s, vy + ay * dt_s, vz + az * dt_s)
        before = trajectory.velocity
        trajectory.velocity = velocity = _towards(
            before,
            _within(wanted, value("MPC_XY_CRUISE"), value("MPC_Z_V_AUTO_UP"), value("MPC_Z_V_AUTO_DN")),
            self._parameters.positive("MPC_ACC_HOR") * dt_s,
            self._parameters.positive("MPC_ACC_DOWN_MAX") * dt_s,
        )
        share = min(dt_s / VELOCITY_LAG_S, 1.0)
        vx, vy, vz = (now + (then - now) * share for now, then in zip(self._followed, velocity, strict=True))
        self._followed = (vx, vy, vz)
        x, y, z = (
            min(max(point + speed * dt_s, here - LEASH_M), here + LEASH_M)
            for point, speed, here in zip(
                trajectory.position, self._followed, self._airframe.position, strict=True
            )
        )
        trajectory.position = (x, y, z)
        return TrajectorySetpoint((x, y, z), self._followed, _feed_forward(before, velocity, dt_s))


def _feed_forward(before: Vector, velocity: Vector, dt_s: float) -> Vector:
    """The acceleration of a change of the target velocity, horizontally less the drag."""
    ax, ay, az = ((now - then) / dt_s for then, now in zip(before, velocity, strict=True))
    return (ax + LINEAR_DRAG_PER_S * velocity[0], ay + LINEAR_DRAG_PER_S * velocity[1], az)


def _within(velocity: Vector, horizontal: float, up: float, down: float) -> Vector:
    x, y, z = velocity
    speed = math.hypot(x, y)
    share = horizontal / speed if speed > horizontal else 1.0
    return (x * share, y * share, min(max(z, -up), down))


def _towards(velocity: Vector, wanted: Vector, horizontal: float, vertical: float) -> Vector:
    """The velocity after one step of bounded change."""
    x, y, z = (goal - now for goal, now in zip(wanted, velocity, strict=True))
    change = math.hypot(x, y)
    share = horizontal / change if change > horizontal else 1.0
    return (velocity[0] + x * share, velocity[1] + y * share, velocity[2] + min(max(z, -vertical), vertical))
