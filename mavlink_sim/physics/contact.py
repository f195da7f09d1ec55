"""What an airframe is to what it touches: a shape, and how it comes out of a contact.

It counts as an upright ellipsoid of its propellers' reach and a flat body's height, of 1 kg. What it slides
along turns it, as the impulses of a rigid body do (Mirtich, Canny 1995, "Impulse-based simulation of rigid
bodies"): first the one along the normal, then the one of friction, neither of which can give it energy.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

Vector = tuple[float, float, float]
Matrix = tuple[float, float, float, float, float, float, float, float, float]

INERTIA_XY_KGM2 = 0.025  # SIH_IXX, SIH_IYY
INERTIA_Z_KGM2 = 0.030  # SIH_IZZ
RADIUS_M = 0.3
HALF_HEIGHT_M = 0.12
RESTITUTION = 0.25
BOUNCE_MPS = 0.8
# A multirotor's legs take a landing at a walking pace; at 5 m/s something breaks.
HARD_LANDING_MPS = 2.0
CRASH_MPS = 5.0
# Propeller guards slide along a wall; legs hold on a roof as on the ground.
SLIDING_FRICTION = 0.3
# It stands on what slopes by up to 37 degrees.
STANDING_COSINE = 0.8
# Away from a thing for so long, it hits it anew.
NEW_CONTACT_S = 0.5


@dataclass(frozen=True, slots=True)
class Collision:
    """One meeting with an obstacle or another vehicle, when it began.

    Attributes:
        time_s: the scene's time.
        identifier, name: of the obstacle ("wall-2"), or the other's system id and "vehicle 2".
        speed_mps: at which they met, along the surface's normal.
        standing: on top of it: the airframe came to stand there, or bounced.
        crashed: this broke the rotors.
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
    """How a body moves; all in the body's frame (FRD), against what it touches.

    Attributes:
        velocity: m/s. rates: angular, rad/s.
    """

    velocity: Vector
    rates: Vector

    def at(self, arm: Vector) -> Vector:
        """The velocity of the body's point at `arm` from its middle, metres."""
        return _sum(self.velocity, _cross(self.rates, arm))

    def push(self, arm: Vector, direction: Vector, speed_mps: float, limit_ns: float = math.inf) -> float:
        """Change the speed of that point along a direction by an impulse, in Ns, which is returned."""
        x, y, z = lever = _cross(arm, direction)
        turn = (x / INERTIA_XY_KGM2, y / INERTIA_XY_KGM2, z / INERTIA_Z_KGM2)
        impulse = min(speed_mps / (1.0 + _dot(lever, turn)), limit_ns)
        self.velocity = _sum(self.velocity, direction, impulse)
        self.rates = _sum(self.rates, turn, impulse)
        return impulse


def after_contact(
    velocity: Vector, rates: Vector, ned_from_body: Matrix, normal: Vector
) -> tuple[float, Vector, Vector]:
    """What a contact does to an airframe.

    Args:
        velocity: NED, m/s, against what is touched. rates: body angular rates, rad/s.
        normal: NED, of the touched surface, of length 1, towards the airframe.

    Returns:
        The speed at which they meet, m/s, and velocity and rates afterwards; they part already if it is
        negative, and both are as they were.
    """
    out = _turned_back(ned_from_body, normal)
    arm = _turned_back(ned_from_body, _touching_point(normal))
    motion = Motion(_turned_back(ned_from_body, velocity), rates)
    into = -_dot(motion.at(arm), out)
    if into < 0.0:
        return into, velocity, rates
    pressed = motion.push(arm, out, into + back_speed(into))
    point = motion.at(arm)
    along = _sum(point, out, -_dot(point, out))
    sliding = math.sqrt(_dot(along, along))
    if sliding > 0.0:
        x, y, z = along
        against = (-x / sliding, -y / sliding, -z / sliding)
        motion.push(arm, against, sliding, SLIDING_FRICTION * pressed)
    return into, _turned(ned_from_body, motion.velocity), motion.rates


def back_speed(into_mps: float) -> float:
    """At which something comes back that met a thing at this speed."""
    return RESTITUTION * into_mps if into_mps > BOUNCE_MPS else 0.0


def _touching_point(normal: Vector) -> Vector:
    """From its middle to where an upright ellipsoid touches what has this normal, metres."""
    x, y, z = normal
    flat, high = RADIUS_M * RADIUS_M, HALF_HEIGHT_M * HALF_HEIGHT_M
    reach = math.sqrt(flat * (x * x + y * y) + high * z * z)
    return (-flat * x / reach, -flat * y / reach, -high * z / reach)


def _turned(matrix: Matrix, vector: Vector) -> Vector:
    """The vector, turned by a rotation that is given row by row."""
    x, y, z = vector
    a, b, c, d, e, f, g, h, i = matrix
    return (a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z)


def _turned_back(matrix: Matrix, vector: Vector) -> Vector:
    x, y, z = vector
    a, b, c, d, e, f, g, h, i = matrix
    return (a * x + d * y + g * z, b * x + e * y + h * z, c * x + f * y + i * z)


def _dot(one: Vector, other: Vector) -> float:
    return one[0] * other[0] + one[1] * other[1] + one[2] * other[2]


def _cross(one: Vector, other: Vector) -> Vector:
    ax, ay, az = one
    bx, by, bz = other
    return (ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx)


def _sum(one: Vector, other: Vector, times: float = 1.0) -> Vector:
    return (one[0] + times * other[0], one[1] + times * other[1], one[2] + times * other[2])
