"""The motion of a multirotor: a rigid body under four rotors, drag, wind, gravity and the ground.

World frame NED with its origin on the ground where the vehicle started, body frame FRD. Mass, inertia, drag
and rotors are those of PX4's own SIH quadrotor (its SIH_* parameters). The attitude is an integrated
quaternion, so there is no singular tilt. PX4's inner loops, `rotor_control`, run at every step, as on the
real vehicle.
"""

from __future__ import annotations

import math
import random
from collections.abc import Callable

from mavlink_sim.physics.contact import (
    BOUNCE_MPS,
    CRASH_MPS,
    INERTIA_XY_KGM2,
    INERTIA_Z_KGM2,
    NEW_CONTACT_S,
    RESTITUTION,
    Collision,
)
from mavlink_sim.physics.gaussian import BITS, NORMAL
from mavlink_sim.physics.rotations import (
    Matrix,
    Quaternion,
    Vector,
    integrated,
    rotation_matrix,
    turned_back,
)
from mavlink_sim.physics.rotor_control import MAX_YAW_RATE_RADPS, Rotors, attitude_loop, mix, rate_loop

GRAVITY_MPS2 = 9.80665
ROTOR_THRUST_MPS2 = 5.0  # SIH_T_MAX 5 N on SIH_MASS 1 kg
MAX_THRUST_MPS2 = 4.0 * ROTOR_THRUST_MPS2
LINEAR_DRAG_PER_S = 1.0  # SIH_KDV / SIH_MASS
ROTOR_TIME_CONSTANT_S = 0.05  # SIH_T_TAU
ARM_M = 0.2  # SIH_L_ROLL, SIH_L_PITCH
ROTOR_TORQUE_NM = 0.1  # SIH_Q_MAX
ANGULAR_DRAG_NMS = 0.025  # SIH_KDW
_COUPLING_KGM2 = INERTIA_XY_KGM2 - INERTIA_Z_KGM2
_TORQUE_PER_THRUST_M = ROTOR_TORQUE_NM / ROTOR_THRUST_MPS2

GUST_TIME_CONSTANT_S = 1.5
GUST_STEP_S = 0.032  # a fiftieth of the time constant: finer steps have no visible effect

# The ground.
GEAR_TIME_CONSTANT_S = 0.1
FRICTION = 0.8
# Tilted further than this at contact, it does not come to rest on its legs.
MAX_STANDING_TILT_COSINE = 0.5

_LEVEL: Matrix = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
_DOWN: Vector = (0.0, 0.0, 1.0)
_STILL: Vector = (0.0, 0.0, 0.0)
_BROKEN: Rotors = (0.0, 0.0, 0.0, 0.0)


class Multirotor:
    """One airframe with its attitude and rate loops. Deterministic: same seed, same demands, same flight.

    Rotors are numbered as PX4's quad X: 0 front right, 1 rear left (both turn counter-clockwise seen from
    above), 2 front left, 3 rear right (clockwise).

    Attributes:
        position: NED metres; velocity: NED m/s; acceleration: NED m/s², kinematic.
        quaternion: `ned_from_body`, (w, x, y, z), of length 1.
        rates: body angular rates about FRD, rad/s.
        rotor_thrusts: of each rotor per vehicle mass, m/s².
        rotor_commands: the command of each rotor, 0..1 of its thrust.
        rotor_effectiveness: 0..1 for each rotor; 0 is a failed one. See `fail_motor`.
        on_ground: touching the ground.
        crashed: it hit the ground too hard or upside down: the rotors are broken.
        on_touch: called with the downward speed, m/s, at every contact with the ground, before the motion and
            the rotors of that step are set.
        collisions: count, with objects. last_collision: the newest; None before the first.
        on_collision: called with each.
        floor_down_m: NED z of the surface it stands or last stood on; 0 is the ground.
        wind: NED m/s steady wind; gusts of `gusts_mps` (standard deviation per axis) are added.
    """

    __slots__ = (
        "_angular_acceleration",
        "_contacts",
        "_down_demand",
        "_gust",
        "_gust_left_s",
        "_matrix",
        "_random",
        "_rate_demand",
        "_thrust_demand_mps2",
        "_yaw_rate_demand_radps",
        "acceleration",
        "collisions",
        "crashed",
        "floor_down_m",
        "gusts_mps",
        "last_collision",
        "on_collision",
        "on_ground",
        "on_touch",
        "position",
        "quaternion",
        "rates",
        "rotor_commands",
        "rotor_effectiveness",
        "rotor_thrusts",
        "velocity",
        "wind",
    )

    def __init__(self, seed: int = 0, wind: Vector = _STILL, gusts_mps: float = 0.0) -> None:
        self.position: Vector = _STILL
        self.velocity: Vector = _STILL
        self.acceleration: Vector = _STILL
        self.quaternion: Quaternion = (1.0, 0.0, 0.0, 0.0)
        self.rates: Vector = _STILL
        self.rotor_thrusts: Rotors = (0.0, 0.0, 0.0, 0.0)
        self.rotor_commands: Rotors = (0.0, 0.0, 0.0, 0.0)
        self.rotor_effectiveness: Rotors = (1.0, 1.0, 1.0, 1.0)
        self.on_ground = True
        self.crashed = False
        self.floor_down_m = 0.0
        self.on_touch: Callable[[float], None] | None = None
        self.collisions = 0
        self.last_collision: Collision | None = None
        self.on_collision: Callable[[Collision], None] | None = None
        self._contacts: dict[int, float] = {}
        self.wind = wind
        self.gusts_mps = gusts_mps
        self._matrix = _LEVEL
        self._angular_acceleration: Vector = _STILL  # about FRD, rad/s²
        self._thrust_demand_mps2 = 0.0
        self._down_demand: Vector = _DOWN  # see `attitude_loop`
        self._yaw_rate_demand_radps = 0.0
        self._rate_demand: Vector | None = None  # instead of these two
        self._gust: Vector = _STILL
        self._gust_left_s = 0.0
        self._random = random.Random(seed)

    def reseed(self, seed: int) -> None:
        """Draw the random numbers from now on with another seed."""
        self._random.seed(seed)

    # ---- other representations of the attitude ----------------------------------------------------------

    @property
    def matrix(self) -> Matrix:
        """The rotation `ned_from_body`, row by row."""
        return self._matrix

    @property
    def roll_rad(self) -> float:
        return math.atan2(self._matrix[7], self._matrix[8])

    @property
    def pitch_rad(self) -> float:
        return math.asin(min(max(-self._matrix[6], -1.0), 1.0))

    @property
    def yaw_rad(self) -> float:
        return math.atan2(self._matrix[3], self._matrix[0])

    @yaw_rad.setter
    def yaw_rad(self, yaw_rad: float) -> None:
        self.set_attitude(self.roll_rad, self.pitch_rad, yaw_rad)

    def set_attitude(self, roll_rad: float, pitch_rad: float, yaw_rad: float) -> None:
        """Set the attitude (aerospace sequence)."""
        cr, sr = math.cos(roll_rad / 2), math.sin(roll_rad / 2)
        cp, sp = math.cos(pitch_rad / 2), math.sin(pitch_rad / 2)
        cy, sy = math.cos(yaw_rad / 2), math.sin(yaw_rad / 2)
        self.quaternion = (
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        )
        self._matrix = rotation_matrix(self.quaternion)

    @property
    def thrust_mps2(self) -> float:
        """Collective thrust per mass, along body up."""
        return _lift(self.rotor_thrusts)

    @thrust_mps2.setter
    def thrust_mps2(self, thrust_mps2: float) -> None:
        share = thrust_mps2 / 4.0
        self.rotor_thrusts = (share, share, share, share)

    @property
    def specific_force(self) -> Vector:
        """The reading of an ideal accelerometer, body FRD m/s²."""
        north, east, down = self.acceleration
        return turned_back(self._matrix, (north, east, down - GRAVITY_MPS2))

    # ---- demands ----------------------------------------------------------------------------------------

    def command(self, thrust_mps2: float, roll_rad: float, pitch_rad: float, yaw_rate_radps: float) -> None:
        """Set the demand: collective thrust, tilt relative to the heading, yaw rate about the vertical."""
        cosine = math.cos(roll_rad)
        self._thrust_demand_mps2 = thrust_mps2
        self._down_demand = (
            math.sin(pitch_rad) * cosine,
            -math.sin(roll_rad),
            math.cos(pitch_rad) * cosine,
        )
        self._yaw_rate_demand_radps = min(max(yaw_rate_radps, -MAX_YAW_RATE_RADPS), MAX_YAW_RATE_RADPS)
        self._rate_demand = None

    def command_rates(self, thrust_mps2: float, rates_radps: Vector) -> None:
        """Set the demand: collective thrust and body rates."""
        self._thrust_demand_mps2 = thrust_mps2
        self._rate_demand = rates_radps

    def fail_motor(self, index: int, effectiveness: float = 0.0) -> None:
        """Reduce a rotor (0 to 3) to this share of its command; 1 restores it.

        Raises:
            ValueError: there is no such rotor, or the share is not within 0 to 1.
        """
        if not 0 <= index < 4:
            raise ValueError(f"motor {index}: this vehicle has motors 0 to 3")
        if not 0.0 <= effectiveness <= 1.0:
            raise ValueError(f"motor effectiveness {effectiveness}: expected 0 (failed) to 1 (intact)")
        a, b, c, d = (
            effectiveness if rotor == index else known for rotor, known in enumerate(self.rotor_effectiveness)
        )
        self.rotor_effectiveness = (a, b, c, d)

    def step(
        self, dt_s: float, thrust_mps2: float, roll_rad: float, pitch_rad: float, yaw_rate_radps: float
    ) -> None:
        """`command`, then `advance`."""
        self.command(thrust_mps2, roll_rad, pitch_rad, yaw_rate_radps)
        self.advance(dt_s)

    def step_rates(self, dt_s: float, thrust_mps2: float, rates: Vector) -> None:
        """`command_rates`, then `advance`."""
        self.command_rates(thrust_mps2, rates)
        self.advance(dt_s)

    # ---- time -------------------------------------------------------------------------------------------

    def advance(self, dt_s: float, steps: int = 1) -> None:
        """Advance by steps of `dt_s` (at most ~10 ms) towards what was commanded."""
        for _ in range(steps):
            if not self.on_ground or self._lifts_off(dt_s):
                self._fly(dt_s)

    def _lifts_off(self, dt_s: float) -> bool:
        """On the ground: run the rotors; stand, unless they lift the vehicle."""
        thrust_mps2 = 0.0 if self.crashed else min(max(self._thrust_demand_mps2, 0.0), MAX_THRUST_MPS2)
        each_mps2 = thrust_mps2 / 4.0
        command = each_mps2 / ROTOR_THRUST_MPS2
        self.rotor_commands = (command, command, command, command)
        self.rotor_thrusts = self._thrusts_after((each_mps2, each_mps2, each_mps2, each_mps2), dt_s)
        lift_mps2 = _lift(self.rotor_thrusts)
        if lift_mps2 * self._matrix[8] <= GRAVITY_MPS2:
            self._stand(dt_s, lift_mps2)
            return False
        self.on_ground = False
        return True

    def _fly(self, dt_s: float) -> None:
        """One step in the air: control, rotors, turn and motion."""
        rates_demand = self._rate_demand or attitude_loop(
            self._matrix, self._down_demand, self._yaw_rate_demand_radps
        )
        torques = rate_loop(rates_demand, self.rates, self._angular_acceleration)
        commands = mix(self._thrust_demand_mps2 / MAX_THRUST_MPS2, torques)
        front_right, rear_left, front_left, rear_right = commands
        thrusts = self._thrusts_after(
            (
                ROTOR_THRUST_MPS2 * front_right,
                ROTOR_THRUST_MPS2 * rear_left,
                ROTOR_THRUST_MPS2 * front_left,
                ROTOR_THRUST_MPS2 * rear_right,
            ),
            dt_s,
        )
        angular_acceleration = _angular_acceleration(thrusts, self.rates)
        p, q, r = self.rates
        roll_radps2, pitch_radps2, yaw_radps2 = angular_acceleration
        rates = (p + roll_radps2 * dt_s, q + pitch_radps2 * dt_s, r + yaw_radps2 * dt_s)

        air = self._air_velocity(dt_s) if self.gusts_mps > 0.0 else self.wind
        acceleration = _acceleration(thrusts, self._matrix, air, self.velocity)
        north_mps2, east_mps2, down_mps2 = acceleration
        north_mps, east_mps, down_mps = self.velocity
        north_mps += north_mps2 * dt_s
        east_mps += east_mps2 * dt_s
        down_mps += down_mps2 * dt_s
        north_m, east_m, down_m = self.position
        north_m += north_mps * dt_s
        east_m += east_mps * dt_s
        down_m += down_mps * dt_s
        if down_m >= 0.0 and down_mps >= 0.0:
            down_m = 0.0
            down_mps = self._touch(down_mps, self._matrix[8])

        self.rotor_commands, self.rotor_thrusts = commands, thrusts
        self._angular_acceleration, self.rates = angular_acceleration, rates
        self.quaternion = integrated(self.quaternion, rates, dt_s)
        self._matrix = rotation_matrix(self.quaternion)
        self.acceleration, self.velocity = acceleration, (north_mps, east_mps, down_mps)
        self.position = (north_m, east_m, down_m)

    def _thrusts_after(self, demanded: Rotors, dt_s: float) -> Rotors:
        """The rotors' thrusts, m/s², a step after these were demanded of them: a first-order lag."""
        front_right, rear_left, front_left, rear_right = self.rotor_thrusts
        whole = _BROKEN if self.crashed else self.rotor_effectiveness
        share = dt_s / ROTOR_TIME_CONSTANT_S
        if share > 1.0:
            share = 1.0
        return (
            front_right + (demanded[0] * whole[0] - front_right) * share,
            rear_left + (demanded[1] * whole[1] - rear_left) * share,
            front_left + (demanded[2] * whole[2] - front_left) * share,
            rear_right + (demanded[3] * whole[3] - rear_right) * share,
        )

    def blow(self, gust: Vector) -> None:
        """Set the gust, NED m/s, instead of an own one; to be repeated every 32 ms."""
        self._gust = gust
        self._gust_left_s = 1.0

    def _air_velocity(self, dt_s: float) -> Vector:
        """Wind and gust of this step; the gust changes when it is due."""
        self._gust_left_s -= dt_s
        if self._gust_left_s <= 0.0:
            self._change_gust()
        north, east, down = self.wind
        gust_north, gust_east, gust_down = self._gust
        return (north + gust_north, east + gust_east, down + gust_down)

    def _change_gust(self) -> None:
        """The next gust (a first-order Gauss-Markov process)."""
        self._gust_left_s += GUST_STEP_S
        keep = 1.0 - GUST_STEP_S / GUST_TIME_CONSTANT_S
        spread = self.gusts_mps * math.sqrt(1.0 - keep * keep)
        bits = self._random.getrandbits
        north, east, down = self._gust
        self._gust = (
            keep * north + spread * NORMAL[bits(BITS)],
            keep * east + spread * NORMAL[bits(BITS)],
            keep * down + spread * NORMAL[bits(BITS)],
        )

    # ---- the ground -------------------------------------------------------------------------------------

    def _touch(self, down_mps: float, tilt_cosine: float) -> float:
        """Contact at this downward speed; returns the downward speed after it (negative: it bounces)."""
        self.floor_down_m = 0.0
        if down_mps > CRASH_MPS or tilt_cosine < MAX_STANDING_TILT_COSINE:
            self.crashed = True
        if self.on_touch is not None:
            self.on_touch(down_mps)
        if down_mps > BOUNCE_MPS:
            return -RESTITUTION * down_mps
        self.on_ground = True
        return 0.0

    def _stand(self, dt_s: float, lift: float) -> None:
        """On the ground: friction stops it, the landing gear levels it and keeps its heading."""
        self.rates = self._angular_acceleration = _STILL
        vx, vy, _ = self.velocity
        if vx != 0.0 or vy != 0.0:
            speed = math.hypot(vx, vy)
            slower = max(speed - FRICTION * (GRAVITY_MPS2 - lift) * dt_s, 0.0) / speed
            moved = (vx * slower, vy * slower, 0.0)
            self.acceleration = ((moved[0] - vx) / dt_s, (moved[1] - vy) / dt_s, 0.0)
            self.velocity = moved
            x, y, _ = self.position
            self.position = (x + moved[0] * dt_s, y + moved[1] * dt_s, self.floor_down_m)
        else:
            self.velocity = self.acceleration = _STILL
        if self._matrix[8] < 1.0 and not self.crashed:
            keep = 1.0 - min(1.0, dt_s / GEAR_TIME_CONSTANT_S)
            self.set_attitude(self.roll_rad * keep, self.pitch_rad * keep, self.yaw_rad)

    # ---- collisions -------------------------------------------------------------------------------------

    def count(self, collision: Collision) -> None:
        """Record a collision; continued contact is no new one, unless it breaks the rotors now."""
        before_s = self._contacts.get(collision.identifier, -math.inf)
        self._contacts[collision.identifier] = collision.time_s
        if collision.crashed or collision.time_s - before_s > NEW_CONTACT_S:
            self.collisions += 1
            self.last_collision = collision
            if self.on_collision is not None:
                self.on_collision(collision)


def _lift(thrusts: Rotors) -> float:
    """The collective thrust, m/s², added in one order on all versions of Python (`sum` is not)."""
    front_right, rear_left, front_left, rear_right = thrusts
    return front_right + rear_left + front_left + rear_right


def _angular_acceleration(thrusts: Rotors, rates: Vector) -> Vector:
    """About FRD, rad/s²: torques of the rotors, drag, and the gyroscopic coupling of the body.

    The vehicle has 1 kg, so thrusts in m/s² are newtons.
    """
    front_right, rear_left, front_left, rear_right = thrusts
    p, q, r = rates
    roll_nm = ARM_M * (rear_left + front_left - front_right - rear_right)
    pitch_nm = ARM_M * (front_right + front_left - rear_left - rear_right)
    yaw_nm = _TORQUE_PER_THRUST_M * (front_right + rear_left - front_left - rear_right)
    return (
        (roll_nm - ANGULAR_DRAG_NMS * p + _COUPLING_KGM2 * q * r) / INERTIA_XY_KGM2,
        (pitch_nm - ANGULAR_DRAG_NMS * q - _COUPLING_KGM2 * p * r) / INERTIA_XY_KGM2,
        (yaw_nm - ANGULAR_DRAG_NMS * r) / INERTIA_Z_KGM2,
    )


def _acceleration(thrusts: Rotors, ned_from_body: Matrix, air: Vector, velocity: Vector) -> Vector:
    """NED, m/s²: drag, thrust and gravity. `air`: the velocity of the air, NED m/s, as `velocity`."""
    lift_mps2 = _lift(thrusts)
    _, _, down_n, _, _, down_e, _, _, down_d = ned_from_body  # the body's down axis
    air_north, air_east, air_down = air
    north, east, down = velocity
    return (
        LINEAR_DRAG_PER_S * (air_north - north) - lift_mps2 * down_n,
        LINEAR_DRAG_PER_S * (air_east - east) - lift_mps2 * down_e,
        LINEAR_DRAG_PER_S * (air_down - down) - lift_mps2 * down_d + GRAVITY_MPS2,
    )
