"""The motion of a multirotor: a rigid body under four rotors, drag, wind, gravity and the ground.

World frame NED with its origin on the ground where the vehicle started, body frame FRD. Mass, inertia, drag
and rotors are those of PX4's own SIH quadrotor (its SIH_* parameters). The attitude is an integrated
quaternion, so there is no singular tilt. PX4's attitude and rate controllers, with its default gains, and its
mixer with saturation run at every step, as on the real vehicle; the integral parts are replaced by their
steady value on this balanced airframe. The attitude loop compares thrust axes (the "reduced attitude" of
Brescianini, Hehn, D'Andrea, 2013), so it knows no gimbal lock. Plain floats in local names of one function:
numpy scalars, or an object for a vector, would make the step, and every test in lockstep, several times
slower; calls of a function for each loop and the mixer cost a tenth of a whole flight.
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

ATTITUDE_GAIN_PER_S = 4.0  # MC_ROLL_P, MC_PITCH_P
MAX_TILT_RATE_RADPS = math.radians(220.0)  # MC_ROLLRATE_MAX, MC_PITCHRATE_MAX
MAX_YAW_RATE_RADPS = math.radians(200.0)  # MC_YAWRATE_MAX
# Share of full thrust per rad/s: MC_ROLLRATE_P 0.15 through PX4's allocation of a roll to rotors (1/sqrt 2).
RATE_P = 0.15 * math.sqrt(0.5)
RATE_D = 0.003 * math.sqrt(0.5)
# MC_YAWRATE_P 0.2 alone turns SIH's weak rotor torque into 0.4 s of lag, which PX4's integral part shortens;
# this gain gives a lag of 0.15 s without one.
YAW_RATE_P = 0.5
# Share of full thrust per rad/s that angular drag (SIH_KDW) takes, of rotors on their arms and by torque.
RATE_DRAG = 0.025 / (4 * 5.0 * 0.2)
YAW_RATE_DRAG = 0.025 / (4 * 0.1)
# Yaw is served last, but PX4 keeps this share of the range for it by lowering the thrust.
YAW_MARGIN = 0.15


Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Matrix = tuple[float, float, float, float, float, float, float, float, float]
Rotors = tuple[float, float, float, float]

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
_STILL: Vector = (0.0, 0.0, 0.0)


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
        collisions: count, with objects and vehicles. last_collision: the newest; None before the first.
        on_collision: called with each.
        floor_down_m: NED z of the surface it stands or last stood on; 0 is the ground.
        wind: NED m/s steady wind; gusts of `gusts_mps` (standard deviation per axis) are added.
    """

    __slots__ = (
        "_contacts",
        "_demand",
        "_gust",
        "_gust_left_s",
        "_matrix",
        "_random",
        "_rate_demand",
        "_spin",
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
        self._spin: Vector = _STILL  # angular acceleration, rad/s²
        # collective m/s², demanded body thrust axis in the heading frame, yaw rate about the vertical
        self._demand = (0.0, 0.0, 0.0, 1.0, 0.0)
        self._rate_demand: Vector | None = None
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
        return sum(self.rotor_thrusts)

    @thrust_mps2.setter
    def thrust_mps2(self, thrust_mps2: float) -> None:
        share = thrust_mps2 / 4.0
        self.rotor_thrusts = (share, share, share, share)

    @property
    def specific_force(self) -> Vector:
        """The reading of an ideal accelerometer, body FRD m/s²."""
        ax, ay, az = self.acceleration
        az -= GRAVITY_MPS2
        a, b, c, d, e, f, g, h, i = self._matrix
        return (a * ax + d * ay + g * az, b * ax + e * ay + h * az, c * ax + f * ay + i * az)

    # ---- demands ----------------------------------------------------------------------------------------

    def command(self, thrust_mps2: float, roll_rad: float, pitch_rad: float, yaw_rate_radps: float) -> None:
        """Set the demand: collective thrust, tilt relative to the heading, yaw rate about the vertical."""
        cosine = math.cos(roll_rad)
        yaw_rate = min(max(yaw_rate_radps, -MAX_YAW_RATE_RADPS), MAX_YAW_RATE_RADPS)
        self._demand = (
            thrust_mps2,
            math.sin(pitch_rad) * cosine,
            -math.sin(roll_rad),
            math.cos(pitch_rad) * cosine,
            yaw_rate,
        )
        self._rate_demand = None

    def command_rates(self, thrust_mps2: float, rates_radps: Vector) -> None:
        """Set the demand: collective thrust and body rates; NaN: keep the rate demanded before."""
        self._demand = (thrust_mps2, 0.0, 0.0, 1.0, 0.0)
        before = self._rate_demand or self.rates
        p, q, r = (
            asked if math.isnan(rate) else rate for rate, asked in zip(rates_radps, before, strict=True)
        )
        self._rate_demand = (p, q, r)

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
        """Advance by steps of `dt_s` (at most ~10 ms) towards what was commanded.

        Clear of the ground the attributes change only after the last of several steps.
        """
        if steps > 1 and self.on_ground:
            for _ in range(steps):
                self.advance(dt_s)
            return
        thrust, tilt_x, tilt_y, tilt_z, yaw_rate = self._demand
        if self.on_ground:
            blend = min(1.0, dt_s / ROTOR_TIME_CONSTANT_S)
            share = 0.0 if self.crashed else min(max(thrust, 0.0), MAX_THRUST_MPS2) / 4.0
            command = share / ROTOR_THRUST_MPS2
            self.rotor_commands = (command, command, command, command)
            lift = 0.0
            thrusts = []
            for now, whole in zip(self.rotor_thrusts, self.rotor_effectiveness, strict=True):
                now += (share * whole - now) * blend
                thrusts.append(now)
                lift += now
            self.rotor_thrusts = (thrusts[0], thrusts[1], thrusts[2], thrusts[3])
            if lift * self._matrix[8] <= GRAVITY_MPS2:
                self._stand(dt_s, lift)
                return
            self.on_ground = False
        a, b, c, d, e, f, g, h, i = self._matrix
        p, q, r = self.rates
        spin_x, spin_y, spin_z = self._spin
        w, x, y, z = self.quaternion
        north, east, down = self.position
        vx, vy, vz = self.velocity
        t0, t1, t2, t3 = self.rotor_thrusts
        e0, e1, e2, e3 = (0.0, 0.0, 0.0, 0.0) if self.crashed else self.rotor_effectiveness
        blend = dt_s / ROTOR_TIME_CONSTANT_S
        if blend > 1.0:
            blend = 1.0
        half = 0.5 * dt_s
        limit, coupling = MAX_TILT_RATE_RADPS, _COUPLING_KGM2
        collective = thrust / MAX_THRUST_MPS2
        collective = 0.0 if collective < 0.0 else 1.0 if collective > 1.0 else collective
        rate_demand = self._rate_demand
        gusty = self.gusts_mps > 0.0
        air_x, air_y, air_z = self._air_velocity() if gusty else self.wind
        remaining = 0  # steps after a contact
        for left in range(steps - 1, -1, -1):
            # the attitude loop: body rates (FRD) that turn the thrust axis to the demanded direction
            if rate_demand is not None:
                wanted_p, wanted_q, wanted_r = rate_demand
            else:
                heading = math.sqrt(a * a + d * d)
                if heading > 1e-6:
                    cosine, sine = a / heading, d / heading
                else:  # the nose points straight up or down: the heading is that of the right axis
                    wing = math.sqrt(b * b + e * e)
                    cosine, sine = e / wing, -b / wing
                tilt_north = cosine * tilt_x - sine * tilt_y
                tilt_east = sine * tilt_x + cosine * tilt_y
                # the demanded axis in the body frame
                axis_x = a * tilt_north + d * tilt_east + g * tilt_z
                axis_y = b * tilt_north + e * tilt_east + h * tilt_z
                axis_z = c * tilt_north + f * tilt_east + i * tilt_z
                # 2 sin(angle / 2) about the axis e_z × wanted, as PX4 takes it from the error quaternion
                if axis_z > -0.98:
                    gain = ATTITUDE_GAIN_PER_S * math.sqrt(2.0 / (1.0 + axis_z))
                    wanted_p = -gain * axis_y
                    wanted_q = gain * axis_x
                else:  # upside down: every direction is as short; exactly upside down one must be selected
                    wanted_p = limit if axis_y <= 0.0 else -limit
                    wanted_q = 10.0 * ATTITUDE_GAIN_PER_S * axis_x
                wanted_p = limit if wanted_p > limit else -limit if wanted_p < -limit else wanted_p
                wanted_q = limit if wanted_q > limit else -limit if wanted_q < -limit else wanted_q
                wanted_p += yaw_rate * g
                wanted_q += yaw_rate * h
                wanted_r = yaw_rate * i

            # The rate loop and the mixer. At saturation, collective thrust is lowered first, then tilt is
            # scaled down, and yaw gets the rest (PX4's sequential desaturation without air mode).
            roll = RATE_P * (wanted_p - p) - RATE_D * spin_x + RATE_DRAG * wanted_p
            pitch = RATE_P * (wanted_q - q) - RATE_D * spin_y + RATE_DRAG * wanted_q
            yaw = YAW_RATE_P * (wanted_r - r) + YAW_RATE_DRAG * wanted_r
            base = collective
            spread = (roll if roll >= 0.0 else -roll) + (pitch if pitch >= 0.0 else -pitch)
            if spread > 0.5:
                scale = 0.5 / spread
                roll *= scale
                pitch *= scale
                spread = 0.5
            if base + spread > 1.0:
                base = 1.0 - spread
            if base < spread:
                scale = base / spread
                roll *= scale
                pitch *= scale
                spread = base
            reserve = (yaw if yaw >= 0.0 else -yaw) if -YAW_MARGIN < yaw < YAW_MARGIN else YAW_MARGIN
            if base + spread + reserve > 1.0:
                base = max(1.0 - spread - reserve, spread)
            margin = (1.0 - base if base > 0.5 else base) - spread
            if margin < 0.0:
                margin = 0.0
            yaw = margin if yaw > margin else -margin if yaw < -margin else yaw
            u0 = base - roll + pitch + yaw
            u1 = base + roll - pitch + yaw
            u2 = base + roll + pitch - yaw
            u3 = base - roll - pitch - yaw

            t0 += (ROTOR_THRUST_MPS2 * u0 * e0 - t0) * blend
            t1 += (ROTOR_THRUST_MPS2 * u1 * e1 - t1) * blend
            t2 += (ROTOR_THRUST_MPS2 * u2 * e2 - t2) * blend
            t3 += (ROTOR_THRUST_MPS2 * u3 * e3 - t3) * blend

            # torques of the rotors (1 kg, so m/s² are newtons), drag, and the gyroscopic coupling of the body
            spin_x = (ARM_M * (t1 + t2 - t0 - t3) - ANGULAR_DRAG_NMS * p + coupling * q * r) / INERTIA_XY_KGM2
            spin_y = (ARM_M * (t0 + t2 - t1 - t3) - ANGULAR_DRAG_NMS * q - coupling * p * r) / INERTIA_XY_KGM2
            spin_z = (_TORQUE_PER_THRUST_M * (t0 + t1 - t2 - t3) - ANGULAR_DRAG_NMS * r) / INERTIA_Z_KGM2
            p += spin_x * dt_s
            q += spin_y * dt_s
            r += spin_z * dt_s

            if gusty:
                self._gust_left_s -= dt_s
                if self._gust_left_s <= 0.0:
                    self._blow()
                    air_x, air_y, air_z = self._air_velocity()
            lift = t0 + t1 + t2 + t3
            ax = LINEAR_DRAG_PER_S * (air_x - vx) - lift * c
            ay = LINEAR_DRAG_PER_S * (air_y - vy) - lift * f
            az = LINEAR_DRAG_PER_S * (air_z - vz) - lift * i + GRAVITY_MPS2
            vx += ax * dt_s
            vy += ay * dt_s
            vz += az * dt_s
            north += vx * dt_s
            east += vy * dt_s
            down += vz * dt_s
            if down >= 0.0 and vz >= 0.0:
                down = 0.0
                vz = self._touch(vz, i)
                remaining = left

            half_p, half_q, half_r = p * half, q * half, r * half
            new_w = w - x * half_p - y * half_q - z * half_r
            new_x = x + w * half_p + y * half_r - z * half_q
            new_y = y + w * half_q + z * half_p - x * half_r
            new_z = z + w * half_r + x * half_q - y * half_p
            scale = 1.0 / math.sqrt(new_w * new_w + new_x * new_x + new_y * new_y + new_z * new_z)
            w = new_w * scale
            x = new_x * scale
            y = new_y * scale
            z = new_z * scale
            xx, yy, zz = x * x, y * y, z * z
            xy, xz, yz = x * y, x * z, y * z
            wx, wy, wz = w * x, w * y, w * z
            a, b, c = 1.0 - 2.0 * (yy + zz), 2.0 * (xy - wz), 2.0 * (xz + wy)
            d, e, f = 2.0 * (xy + wz), 1.0 - 2.0 * (xx + zz), 2.0 * (yz - wx)
            g, h, i = 2.0 * (xz - wy), 2.0 * (yz + wx), 1.0 - 2.0 * (xx + yy)
            if remaining:
                break
        self.rotor_commands, self.rotor_thrusts = (u0, u1, u2, u3), (t0, t1, t2, t3)
        self._spin, self.rates = (spin_x, spin_y, spin_z), (p, q, r)
        self.quaternion, self._matrix = (w, x, y, z), (a, b, c, d, e, f, g, h, i)
        self.position, self.velocity, self.acceleration = (north, east, down), (vx, vy, vz), (ax, ay, az)
        for _ in range(remaining):  # it stands now, bounces, or has no rotors
            self.advance(dt_s)

    def blow(self, gust: Vector) -> None:
        """Set the gust, NED m/s, instead of an own one; to be repeated every 32 ms."""
        self._gust = gust
        self._gust_left_s = 1.0

    def _air_velocity(self) -> Vector:
        """Wind and gust."""
        (wx, wy, wz), (gx, gy, gz) = self.wind, self._gust
        return (wx + gx, wy + gy, wz + gz)

    def _blow(self) -> None:
        """The next gust (a first-order Gauss-Markov process)."""
        self._gust_left_s += GUST_STEP_S
        keep = 1.0 - GUST_STEP_S / GUST_TIME_CONSTANT_S
        spread = self.gusts_mps * math.sqrt(1.0 - keep * keep)
        bits = self._random.getrandbits
        gx, gy, gz = self._gust
        self._gust = (
            keep * gx + spread * NORMAL[bits(BITS)],
            keep * gy + spread * NORMAL[bits(BITS)],
            keep * gz + spread * NORMAL[bits(BITS)],
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
        self.rates = self._spin = _STILL
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


def rotation_matrix(quaternion: Quaternion) -> Matrix:
    """The rotation, row by row, of a (w, x, y, z) quaternion of length 1."""
    w, x, y, z = quaternion
    return (
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    )
