"""The contact model of an airframe: its shape, and the impulses of a contact.

The shape is an upright ellipsoid of the propellers' radius and a flat body's height, of 1 kg. A contact
applies the impulses of a rigid body (Mirtich, Canny 1995, "Impulse-based simulation of rigid bodies"): first
the one along the normal, then friction; neither adds energy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from mavlink_sim.physics.rotations import Matrix, Vector, turned, turned_back

INERTIA_XY_KGM2 = 0.025  # SIH_IXX, SIH_IYY
INERTIA_Z_KGM2 = 0.030  # SIH_IZZ
RADIUS_M = 0.3
HALF_HEIGHT_M = 0.12
RESTITUTION = 0.25
BOUNCE_MPS = 0.8
# A multirotor's legs withstand a landing at walking speed; at 5 m/s something breaks.
HARD_LANDING_MPS = 2.0
CRASH_MPS = 5.0
# Propeller guards slide along a wall; legs have the same friction on a roof as on the ground.
SLIDING_FRICTION = 0.3
# It can stand on slopes of up to 37 degrees.
STANDING_COSINE = 0.8
# After this time without contact, the next one is a new collision.
NEW_CONTACT_S = 0.5


@dataclass(frozen=True, slots=True)
class Collision:
    """One collision with an obstacle.

    Attributes:
        time_s: the scene's time at the first contact.
        identifier, name: of the obstacle ("wall-2").
        speed_mps: closing speed along the surface normal.
        standing: on top of it: the airframe came to rest there, or bounced.
        crashed: it broke the rotors.
    """

    time_s: float
    identifier: int
    name: str
    speed_mps: float
    standing: bool
    crashed: bool

    def __str__(self) -> str:
        if self.crashed:
            return f"crashed into {self.name} at {self.speed_mps:.1f} m/s"
        if self.standing and self.speed_mps <= HARD_LANDING_MPS:
            return f"touched down on {self.name}"
        return f"hit {self.name} at {self.speed_mps:.1f} m/s"


@dataclass(slots=True)
class Motion:
    """The motion of a body relative to what it touches, in the body frame (FRD).

    Attributes:
        velocity: m/s. rates: angular, rad/s.
    """

    velocity: Vector
    rates: Vector

    def at(self, arm: Vector) -> Vector:
        """The velocity of the body's point at `arm` (metres) from its centre."""
        return _sum(self.velocity, _cross(self.rates, arm))

    def push(self, arm: Vector, direction: Vector, speed_mps: float, limit_ns: float = math.inf) -> float:
        """Change the speed of that point along a direction by an impulse. Returns the impulse, Ns."""
        x, y, z = lever = _cross(arm, direction)
        turn = (x / INERTIA_XY_KGM2, y / INERTIA_XY_KGM2, z / INERTIA_Z_KGM2)
        impulse = min(speed_mps / (1.0 + _dot(lever, turn)), limit_ns)
        self.velocity = _sum(self.velocity, direction, impulse)
        self.rates = _sum(self.rates, turn, impulse)
        return impulse


def after_contact(
    velocity: Vector, rates: Vector, ned_from_body: Matrix, normal: Vector
) -> tuple[float, Vector, Vector]:
    """The effect of a contact on an airframe.

    Args:
        velocity: NED, m/s, relative to the touched body. rates: body angular rates, rad/s.
        normal: NED, of the touched surface, of length 1, towards the airframe.

    Returns:
        The closing speed, m/s, and velocity and rates afterwards; if the speed is negative they already
        separate, and both are unchanged.
    """
    out = turned_back(ned_from_body, normal)
    arm = turned_back(ned_from_body, _touching_point(normal))
    motion = Motion(turned_back(ned_from_body, velocity), rates)
    into = -_dot(motion.at(arm), out)
    if into < 0.0:
        return into, velocity, rates
    rebound = RESTITUTION * into if into > BOUNCE_MPS else 0.0
    pressed = motion.push(arm, out, into + rebound)
    point = motion.at(arm)
    along = _sum(point, out, -_dot(point, out))
    sliding = math.sqrt(_dot(along, along))
    if sliding > 0.0:
        x, y, z = along
        against = (-x / sliding, -y / sliding, -z / sliding)
        motion.push(arm, against, sliding, SLIDING_FRICTION * pressed)
    return into, turned(ned_from_body, motion.velocity), motion.rates


def _touching_point(normal: Vector) -> Vector:
    """From the centre of an upright ellipsoid to its contact point with a surface of this normal, metres."""
    x, y, z = normal
    flat, high = RADIUS_M * RADIUS_M, HALF_HEIGHT_M * HALF_HEIGHT_M
    reach = math.sqrt(flat * (x * x + y * y) + high * z * z)
    return (-flat * x / reach, -flat * y / reach, -high * z / reach)


def _dot(one: Vector, other: Vector) -> float:
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


def _cross(one: Vector, other: Vector) -> Vector:
    ax, ay, az = one
    bx, by, bz = other
    return (ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx)


def _sum(one: Vector, other: Vector, times: float = 1.0) -> Vector:
    return (one[0] + times * other[0], one[1] + times * other[1], one[2] + times * other[2])
