"""What an airframe is to what it touches: a shape, and how it comes out of a contact.

It counts as an upright ellipsoid of its propellers' reach and a flat body's height; a contact takes its
speed, not its attitude.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

Vector = tuple[float, float, float]

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


def after_contact(
    velocity: Vector, normal: Vector, friction: float = SLIDING_FRICTION
) -> tuple[float, Vector]:
    """What a contact does to a velocity, both against what is touched.

    Args:
        velocity: m/s. normal: of the touched surface, of length 1, towards who touches it.
        friction: what slides along it is slowed by, in what it is pressed with.

    Returns:
        The speed at which they meet, m/s, and the velocity afterwards; they part already if it is negative,
        and the velocity is as it was.
    """
    vx, vy, vz = velocity
    nx, ny, nz = normal
    into = -(vx * nx + vy * ny + vz * nz)
    if into < 0.0:
        return into, velocity
    back = RESTITUTION * into if into > BOUNCE_MPS else 0.0
    tx, ty, tz = vx + into * nx, vy + into * ny, vz + into * nz
    sliding = math.sqrt(tx * tx + ty * ty + tz * tz)
    keep = 1.0 - min(friction * (into + back) / sliding, 1.0) if sliding > 0.0 else 0.0
    return into, (keep * tx + back * nx, keep * ty + back * ny, keep * tz + back * nz)
