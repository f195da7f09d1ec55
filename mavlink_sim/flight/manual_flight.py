"""PX4's manual modes for multirotors: Position, Altitude, Stabilized and Acro.

Position: sticks are accelerations against a drag that limits the speed to MPC_VEL_MANUAL, with the jerk
limited by MPC_JERK_MAX; with centred sticks the vehicle brakes and holds its position (MPC_POS_MODE 4). Or
sticks are velocities (MPC_POS_MODE 0). Altitude: sticks are tilt, the height is held. Stabilized and Manual:
sticks are tilt and thrust. Acro: sticks are body rates and thrust. Names in capitals are PX4's parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable

from mavlink_sim.flight.attitude_control import RatesSetpoint
from mavlink_sim.flight.position_control import NAN, Demand, TrajectorySetpoint
from mavlink_sim.flight.tasks import Task
from mavlink_sim.flight.transmitter import Sticks
from mavlink_sim.physics.airframe import GRAVITY_MPS2, MAX_THRUST_MPS2, Multirotor
from mavlink_sim.px4.modes import Mode
from mavlink_sim.px4.parameters import Parameters

EXPO = 0.6  # of PX4's sticks in Position and Altitude, and of yaw
TAKEOFF_THROTTLE = 0.3  # above this the vehicle leaves the ground in Position and Altitude
TINY = 1e-7
BRAKE_BLEND_S = 0.8
MAX_TILT_FOR_ACCELERATION_DEG = 89.0

Plane = tuple[float, float]  # north and east
StickSource = Callable[[], Sticks]
# (acceleration setpoint of the sticks, velocity), m/s² and m/s, NED -> the allowed acceleration
AccelerationGuard = Callable[[Plane, Plane], Plane]


def expo(value: float, share: float) -> float:
    """A mix of linear (0) and cubic (1)."""
    bounded, share = min(max(value, -1.0), 1.0), min(max(share, 0.0), 1.0)
    return (1.0 - share) * bounded + share * bounded**3


def with_dead_zone(value: float, dead_zone: float) -> float:
    """Zero around the centre, continuous and up to ±1 outside it."""
    bounded, zone = min(max(value, -1.0), 1.0), min(max(dead_zone, 0.0), 0.99)
    if abs(bounded) <= zone:
        return 0.0
    return (bounded - math.copysign(zone, bounded)) / (1.0 - zone)


def super_expo(value: float, share: float, steepness: float) -> float:
    """Expo combined with a 1/(1-x) shape, for Acro's sticks."""
    steepness = min(max(steepness, 0.0), 0.99)
    return expo(value, share) * (1.0 - steepness) / (1.0 - abs(min(max(value, -1.0), 1.0)) * steepness)


def within_circle(x: float, y: float) -> Plane:
    """Limit the length to 1: a stick in a corner is no faster than one at a side."""
    length = math.hypot(x, y)
    return (x / length, y / length) if length > 1.0 else (x, y)


def turned(x: float, y: float, yaw_rad: float) -> Plane:
    """From forward and right to north and east."""
    cosine, sine = math.cos(yaw_rad), math.sin(yaw_rad)
    return cosine * x - sine * y, sine * x + cosine * y


def interpolated(value: float, low: float, high: float, at_low: float, at_high: float) -> float:
    """Linear between two corners, constant outside them."""
    if high <= low:
        return at_high
    share = min(max((value - low) / (high - low), 0.0), 1.0)
    return at_low + share * (at_high - at_low)


class YawByStick:
    """Yaw by stick (MPC_MAN_Y_MAX, MPC_MAN_Y_TAU); heading hold with a centred stick."""

    def __init__(self, parameters: Parameters, fastest_degps: float = math.inf) -> None:
        self._value = parameters.number
        self._fastest_degps = fastest_degps
        self._rate_radps = 0.0
        self.locked_rad = NAN

    def update(self, stick: float, yaw_rad: float, dt_s: float) -> float:
        """The yaw rate in rad/s; `locked_rad` is the heading to hold, NaN while turning."""
        wanted = expo(with_dead_zone(stick, self._value("MAN_DEADZONE")), EXPO)
        wanted *= math.radians(min(self._value("MPC_MAN_Y_MAX"), self._fastest_degps))
        blend = dt_s / (dt_s + max(self._value("MPC_MAN_Y_TAU"), 0.0))
        self._rate_radps += blend * (wanted - self._rate_radps)
        if wanted == 0.0 and abs(self._rate_radps) < 1e-3:
            self._rate_radps = 0.0
        if self._rate_radps != 0.0:
            self.locked_rad = NAN
        elif self.locked_rad != self.locked_rad:
            self.locked_rad = yaw_rad
        return self._rate_radps


class HeightByStick:
    """Climb rate by throttle with limited acceleration and jerk; centred, the height is held."""

    def __init__(self, airframe: Multirotor, parameters: Parameters, fastest_mps: float = math.inf) -> None:
        self._airframe = airframe
        self._value = parameters.number
        self._fastest_mps = fastest_mps
        self._velocity = airframe.velocity[2]
        self._acceleration = 0.0
        self._locked_m = NAN

    def update(self, throttle: float, dt_s: float) -> tuple[float, float, float]:
        """(position, velocity, acceleration) along z: NED metres, NaN where not controlled."""
        value, airframe = self._value, self._airframe
        stick = expo(with_dead_zone(throttle, value("MAN_DEADZONE")), EXPO)
        height = -airframe.position[2]
        if airframe.on_ground:
            return self._grounded(throttle, stick)
        low, high = value("MPC_LAND_ALT2"), value("MPC_LAND_ALT1")
        if stick < 0.0:
            fastest = min(value("MPC_Z_VEL_MAX_DN"), self._fastest_mps)
            wanted = -stick * fastest
            wanted = min(wanted, interpolated(height, low, high, value("MPC_LAND_SPEED"), fastest))
        else:
            fastest = min(value("MPC_Z_VEL_MAX_UP"), self._fastest_mps)
            wanted = max(-stick * fastest, -interpolated(height, low, high, value("MPC_TKO_SPEED"), fastest))
        self._smooth(wanted, dt_s)
        if stick != 0.0 or abs(self._velocity) > 0.01:
            self._locked_m = NAN
        elif self._locked_m != self._locked_m and self._is_slow():
            self._locked_m = airframe.position[2]
        return self._locked_m, self._velocity, self._acceleration

    def _is_slow(self) -> bool:
        limit = self._value("MPC_HOLD_MAX_Z")
        return limit <= 0.0 or abs(self._airframe.velocity[2]) < limit

    def _grounded(self, throttle: float, stick: float) -> tuple[float, float, float]:
        self._locked_m, self._acceleration = NAN, 0.0
        if throttle > TAKEOFF_THROTTLE:
            self._velocity = -stick * min(self._value("MPC_Z_VEL_MAX_UP"), self._value("MPC_TKO_SPEED"))
        else:
            self._velocity = max(0.0, -stick * self._value("MPC_LAND_SPEED"))
        return NAN, self._velocity, NAN

    def _smooth(self, wanted: float, dt_s: float) -> None:
        """Approach a velocity with limited jerk, so that the acceleration is zero when it is reached."""
        jerk = max(self._value("MPC_JERK_MAX"), 0.1)
        change = wanted - self._velocity
        # upwards is negative z: more climb, or less descent, is an acceleration upwards
        limit = max(self._value("MPC_ACC_UP_MAX" if change < 0.0 else "MPC_ACC_DOWN_MAX"), 0.1)
        target = math.copysign(min(limit, math.sqrt(2.0 * jerk * abs(change))), change)
        step = jerk * dt_s
        self._acceleration += min(max(target - self._acceleration, -step), step)
        moved = self._acceleration * dt_s
        if abs(moved) >= abs(change) and moved * change >= 0.0:
            self._velocity, self._acceleration = wanted, 0.0
        else:
            self._velocity += moved


class Altitude(Task):
    """ALTCTL: sticks are tilt up to MPC_MAN_TILT_MAX; the height is held, not the position."""

    def __init__(self, airframe: Multirotor, parameters: Parameters, sticks: StickSource) -> None:
        self._airframe = airframe
        self._parameters = parameters
        self._sticks = sticks
        self._height = HeightByStick(airframe, parameters)
        self._yaw = YawByStick(parameters)
        self._tilt: Plane = (0.0, 0.0)

    def update(self, dt_s: float) -> TrajectorySetpoint:
        sticks, yaw_rad = self._sticks(), self._airframe.yaw_rad
        rate = self._yaw.update(sticks.yaw, yaw_rad, dt_s)
        z, vz, az = self._height.update(sticks.throttle, dt_s)
        blend = dt_s / (dt_s + max(self._parameters.number("MC_MAN_TILT_TAU"), 0.0))
        forward, right = within_circle(sticks.pitch, sticks.roll)
        self._tilt = (
            self._tilt[0] + blend * (forward - self._tilt[0]),
            self._tilt[1] + blend * (right - self._tilt[1]),
        )
        tilt_deg = self._parameters.number("MPC_MAN_TILT_MAX")
        tangent = math.tan(math.radians(min(max(tilt_deg, 0.0), MAX_TILT_FOR_ACCELERATION_DEG)))
        strongest = min(max(tangent, 0.02), 3.0) * GRAVITY_MPS2
        heading = self._yaw.locked_rad if self._yaw.locked_rad == self._yaw.locked_rad else yaw_rad
        north, east = turned(*self._tilt, heading)
        return TrajectorySetpoint(
            (NAN, NAN, z),
            (NAN, NAN, vz),
            (north * strongest, east * strongest, az),
            self._yaw.locked_rad,
            rate,
        )


class Position(Task):
    """POSCTL and POSITION_SLOW: sticks move the vehicle over ground; centred, it brakes and holds."""

    def __init__(
        self,
        airframe: Multirotor,
        parameters: Parameters,
        sticks: StickSource,
        *,
        slow: bool = False,
        guard: AccelerationGuard | None = None,
    ) -> None:
        self._airframe = airframe
        self._parameters = parameters
        self._sticks = sticks
        self._slow = slow
        self._guard = guard
        value = parameters.number
        climb_mps, turn_degps = math.inf, math.inf
        if slow:
            climb_mps, turn_degps = value("MC_SLOW_DEF_VVEL"), value("MC_SLOW_DEF_YAWR")
        self._height = HeightByStick(airframe, parameters, climb_mps)
        self._yaw = YawByStick(parameters, turn_degps)
        self._velocity: Plane = airframe.velocity[:2]
        self._acceleration: Plane = (0.0, 0.0)
        self._locked: Plane | None = None
        self._brake = 1.0

    def update(self, dt_s: float) -> TrajectorySetpoint:
        sticks, value = self._sticks(), self._parameters.number
        rate = self._yaw.update(sticks.yaw, self._airframe.yaw_rad, dt_s)
        z, vz, az = self._height.update(sticks.throttle, dt_s)
        if self._airframe.on_ground:
            self._velocity = self._acceleration = (0.0, 0.0)
            self._locked = None
            return TrajectorySetpoint(
                (NAN, NAN, z), (0.0, 0.0, vz), (NAN, NAN, az), self._yaw.locked_rad, rate
            )
        zone = value("MAN_DEADZONE")
        forward = expo(with_dead_zone(sticks.pitch, zone), EXPO)
        right = expo(with_dead_zone(sticks.roll, zone), EXPO)
        forward, right = self._scaled(*within_circle(forward, right))
        yaw_rad = self._airframe.yaw_rad
        heading = self._yaw.locked_rad if self._yaw.locked_rad == self._yaw.locked_rad else yaw_rad
        wanted = turned(forward, right, heading)
        if int(value("MPC_POS_MODE")) == 0:
            self._by_velocity(wanted, dt_s)
        else:
            self._by_acceleration(wanted, dt_s)
        self._lock_position()
        x, y = (NAN, NAN) if self._locked is None else self._locked
        return TrajectorySetpoint(
            (x, y, z), (*self._velocity, vz), (*self._acceleration, az), self._yaw.locked_rad, rate
        )

    def _speed_mps(self) -> float:
        fastest = self._parameters.positive("MPC_VEL_MANUAL")
        return min(fastest, self._parameters.positive("MC_SLOW_DEF_HVEL")) if self._slow else fastest

    def _scaled(self, forward: float, right: float) -> Plane:
        """MPC_VEL_MAN_SIDE and MPC_VEL_MAN_BACK: slower sideways and backwards."""
        value, fastest = self._parameters.number, self._parameters.positive("MPC_VEL_MANUAL")
        side, back = value("MPC_VEL_MAN_SIDE"), value("MPC_VEL_MAN_BACK")
        if side >= 0.0:
            right *= side / fastest
        if back >= 0.0 and forward < 0.0:
            forward *= back / fastest
        return forward, right

    def _by_velocity(self, wanted: Plane, dt_s: float) -> None:
        """MPC_POS_MODE 0: sticks are velocities, reached within MPC_ACC_HOR_MAX."""
        speed = self._speed_mps()
        target = (wanted[0] * speed, wanted[1] * speed)
        change = (target[0] - self._velocity[0], target[1] - self._velocity[1])
        length = math.hypot(*change)
        step = self._parameters.positive("MPC_ACC_HOR_MAX") * dt_s
        share = 1.0 if length <= step else step / length
        self._velocity = (self._velocity[0] + change[0] * share, self._velocity[1] + change[1] * share)
        self._acceleration = (0.0, 0.0)

    def _by_acceleration(self, wanted: Plane, dt_s: float) -> None:
        """Sticks are accelerations, limited by a drag: a constant stick gives its share of the top speed."""
        value = self._parameters.positive
        speed = self._speed_mps()
        # the drag takes half of the acceleration on average, so the sticks demand twice as much
        strongest = 2.0 * value("MPC_ACC_HOR") * speed / value("MPC_VEL_MANUAL")
        asked = (wanted[0] * strongest, wanted[1] * strongest)
        if self._guard is not None:  # collision prevention
            asked = self._guard(asked, self._velocity)
        released = math.hypot(*wanted) < TINY
        drag = self._drag(strongest / speed, released, dt_s)
        turning_back = any(
            math.copysign(1.0, old) != math.copysign(1.0, new)
            for old, new in zip(self._acceleration, asked, strict=True)
        )
        if (released or turning_back) and math.hypot(*self._velocity) < math.hypot(*drag) * dt_s:
            drag, self._velocity = (0.0, 0.0), (0.0, 0.0)
        target = (asked[0] - drag[0], asked[1] - drag[1])
        change = (target[0] - self._acceleration[0], target[1] - self._acceleration[1])
        length, step = math.hypot(*change), value("MPC_JERK_MAX") * dt_s
        share = 1.0 if length <= step else step / length
        ax, ay = self._acceleration[0] + change[0] * share, self._acceleration[1] + change[1] * share
        limit = GRAVITY_MPS2 * math.tan(math.radians(min(value("MPC_TILTMAX_AIR"), 80.0)))
        length = math.hypot(ax, ay)
        if length > limit:
            ax, ay = ax / length * limit, ay / length * limit
        vx, vy = self._velocity
        if released and math.hypot(vx, vy) < 0.05 and math.hypot(ax, ay) < 0.2:
            self._velocity = self._acceleration = (0.0, 0.0)  # too slow for another oscillation
        else:
            self._velocity, self._acceleration = (vx + ax * dt_s, vy + ay * dt_s), (ax, ay)

    def _drag(self, coefficient: float, released: bool, dt_s: float) -> Plane:
        """With centred sticks the drag grows, below 1 m/s with the root of the speed, so that it stops."""
        boost = max(2.0, math.sqrt(self._parameters.positive("MPC_VEL_MANUAL"))) if released else 1.0
        self._brake += dt_s / (dt_s + BRAKE_BLEND_S) * (boost - self._brake)
        vx, vy = self._velocity
        speed = math.hypot(vx, vy)
        if speed == 0.0:
            return 0.0, 0.0
        share = min(max(self._brake - 1.0, 0.0), 1.0)
        rooted = math.sqrt(speed) if speed < 1.0 else speed
        factor = coefficient * self._brake * (share * rooted / speed + 1.0 - share)
        return vx * factor, vy * factor

    def _lock_position(self) -> None:
        x, y, _ = self._airframe.position
        moving = math.hypot(*self._velocity) > TINY
        if not moving and self._locked is None:
            self._locked = (x, y)
        elif moving and self._locked is not None:
            self._locked = None
            self._velocity = self._airframe.velocity[:2]


class Stabilized(Task):
    """STABILIZED, and MANUAL, which is the same on a multirotor: sticks are tilt, yaw rate and thrust.

    There is no position control: `demand` goes directly to the airframe.
    """

    def __init__(self, airframe: Multirotor, parameters: Parameters, sticks: StickSource) -> None:
        self._airframe = airframe
        self._parameters = parameters
        self._sticks = sticks
        self._yaw = YawByStick(parameters)
        self._tilt: Plane = (0.0, 0.0)
        self.demand: Demand = Demand(0.0, 0.0, 0.0, 0.0)

    def update(self, dt_s: float) -> TrajectorySetpoint:
        sticks, value, airframe = self._sticks(), self._parameters.number, self._airframe
        if sticks.throttle < -0.9 or airframe.on_ground:
            self._yaw.locked_rad = NAN  # the arming gesture has no yaw
        rate = self._yaw.update(0.0 if airframe.on_ground else sticks.yaw, airframe.yaw_rad, dt_s)
        if self._yaw.locked_rad == self._yaw.locked_rad:
            rate += value("MC_YAW_P") * math.remainder(self._yaw.locked_rad - airframe.yaw_rad, math.tau)
        steepest = math.radians(value("MPC_MAN_TILT_MAX"))
        blend = dt_s / (dt_s + max(value("MC_MAN_TILT_TAU"), 0.0))
        roll, pitch = within_circle(sticks.roll, -sticks.pitch)
        self._tilt = (
            self._tilt[0] + blend * (roll * steepest - self._tilt[0]),
            self._tilt[1] + blend * (pitch * steepest - self._tilt[1]),
        )
        thrust = throttle_curve(sticks.throttle, self._parameters) * MAX_THRUST_MPS2
        self.demand = Demand(thrust, *_tilt_to_euler(*self._tilt), rate)
        return TrajectorySetpoint()


class Acro(Task):
    """ACRO: sticks are body rates (MC_ACRO_*) and thrust; nothing levels the vehicle."""

    def __init__(self, parameters: Parameters, sticks: StickSource) -> None:
        self._parameters = parameters
        self._sticks = sticks

    def update(self, dt_s: float) -> RatesSetpoint:
        sticks, value = self._sticks(), self._parameters.number
        tilt_expo, tilt_super = value("MC_ACRO_EXPO"), value("MC_ACRO_SUPEXPO")
        roll = super_expo(sticks.roll, tilt_expo, tilt_super)
        pitch = super_expo(-sticks.pitch, tilt_expo, tilt_super)
        yaw = super_expo(sticks.yaw, value("MC_ACRO_EXPO_Y"), value("MC_ACRO_SUPEXPOY"))
        rates = (
            roll * math.radians(value("MC_ACRO_R_MAX")),
            pitch * math.radians(value("MC_ACRO_P_MAX")),
            yaw * math.radians(value("MC_ACRO_Y_MAX")),
        )
        return RatesSetpoint(rates, (sticks.throttle + 1.0) / 2.0)


def throttle_curve(stick: float, parameters: Parameters) -> float:
    """Thrust, 0..1, of a stick. MPC_THR_CURVE 1: linear; else hover in the middle, 2: by MPC_THR_HOVER."""
    value = parameters.number
    lowest, highest = value("MPC_MANTHR_MIN"), value("MPC_THR_MAX")
    curve = int(value("MPC_THR_CURVE"))
    if curve == 1:
        return interpolated(stick, -1.0, 1.0, lowest, highest)
    # by default PX4 uses its estimate of the hover thrust, which in flight is the true one
    hover = value("MPC_THR_HOVER") if curve == 2 else GRAVITY_MPS2 / MAX_THRUST_MPS2
    if stick < 0.0:
        return interpolated(stick, -1.0, 0.0, lowest, hover)
    return interpolated(stick, 0.0, 1.0, hover, highest)


def _tilt_to_euler(about_x: float, about_y: float) -> Plane:
    """(roll, pitch) of one rotation about a level axis (a rotation vector); its small yaw is dropped."""
    angle = math.hypot(about_x, about_y)
    if angle < 1e-9:
        return 0.0, 0.0
    half_sine, half_cosine = math.sin(angle / 2.0), math.cos(angle / 2.0)
    x, y = about_x / angle * half_sine, about_y / angle * half_sine
    roll = math.atan2(2.0 * half_cosine * x, 1.0 - 2.0 * (x * x + y * y))
    pitch = math.asin(min(max(2.0 * half_cosine * y, -1.0), 1.0))
    return roll, pitch


def task_of(
    mode: Mode,
    airframe: Multirotor,
    parameters: Parameters,
    sticks: StickSource,
    guard: AccelerationGuard | None = None,
) -> Task | None:
    """The task of a mode flown by sticks; None for any other mode. `guard`: see `AccelerationGuard`."""
    if mode in (Mode.POSCTL, Mode.POSITION_SLOW):
        return Position(airframe, parameters, sticks, slow=mode is Mode.POSITION_SLOW, guard=guard)
    if mode is Mode.ALTCTL:
        return Altitude(airframe, parameters, sticks)
    if mode in (Mode.STABILIZED, Mode.MANUAL):
        return Stabilized(airframe, parameters, sticks)
    return Acro(parameters, sticks) if mode is Mode.ACRO else None
