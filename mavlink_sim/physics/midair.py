"""Airframes that meet in the air: two upright ellipsoids, of equal mass, that cannot be in one place."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass

from mavlink_sim.physics.airframe import Multirotor, Vector
from mavlink_sim.physics.contact import (
    CRASH_MPS,
    HALF_HEIGHT_M,
    RADIUS_M,
    Collision,
    after_contact,
)

# Two equal ellipsoids touch where one of twice the size around the first passes through the second's middle.
REACH_M, REACH_UP_M = 2.0 * RADIUS_M, 2.0 * HALF_HEIGHT_M
# Those that are apart are not looked at again before they can have come together, and at least this often.
LONGEST_S = 0.1
# What both can gain in that time, beyond the speed that they have.
GAIN_MPS = 4.0


@dataclass(slots=True)
class Body:
    """An airframe in the world.

    Attributes:
        start_ned_m: north and east, in the world, of where the airframe's own frame begins.
        identifier, name: what the others' collisions with it are told by.
    """

    airframe: Multirotor
    start_ned_m: tuple[float, float]
    identifier: int
    name: str

    @property
    def place_ned_m(self) -> Vector:
        """In the world; of the legs' end, as all of them have their middle above it."""
        x, y, z = self.airframe.position
        return (x + self.start_ned_m[0], y + self.start_ned_m[1], z)


class Midair:
    """The airframes of one world. Step all of them, then call `look`; often enough, each 4 ms at best."""

    def __init__(self) -> None:
        self.bodies: list[Body] = []
        self._until_s = -math.inf

    def join(self, body: Body) -> None:
        """From now on it meets the others."""
        self.bodies.append(body)
        self._until_s = -math.inf

    def look(self, now_s: float) -> None:
        """Let those meet that touch. `now_s` is the scene's time, at which all of them are."""
        if now_s < self._until_s or len(self.bodies) < 2:
            return
        free_s = LONGEST_S
        fastest = max(_speed(body.airframe) for body in self.bodies)
        # nobody farther apart than this can meet before the next look
        horizon_m = REACH_M + (2.0 * fastest + GAIN_MPS) * LONGEST_S
        from_the_south = sorted(((body.place_ned_m, body) for body in self.bodies), key=lambda item: item[0])
        for index, (place, body) in enumerate(from_the_south):
            for other_place, other in itertools.islice(from_the_south, index + 1, None):
                if other_place[0] - place[0] > horizon_m:
                    break
                clear_m = math.dist(place, other_place) - REACH_M
                if clear_m <= 0.0 and not (body.airframe.on_ground and other.airframe.on_ground):
                    self._meet(body, other, now_s)
                    free_s = 0.0
                else:
                    closing = _speed(body.airframe) + _speed(other.airframe) + GAIN_MPS
                    free_s = min(free_s, max(clear_m, 0.0) / closing)
        self._until_s = now_s + free_s

    def _meet(self, first: Body, second: Body, now_s: float) -> None:
        """Part them if they touch, each by its share, and take what they ran into each other with."""
        ax, ay, az = first.place_ned_m
        bx, by, bz = second.place_ned_m
        dx, dy, dz = ax - bx, ay - by, az - bz
        apart = math.sqrt((dx * dx + dy * dy) / REACH_M**2 + dz * dz / REACH_UP_M**2)
        if apart >= 1.0:
            return
        if apart > 0.0:
            # out along the line between the middles, to where the hulls touch
            out = 1.0 / apart - 1.0
            push = (dx * out, dy * out, dz * out)
            nx, ny, nz = dx / REACH_M**2, dy / REACH_M**2, dz / REACH_UP_M**2
            length = math.sqrt(nx * nx + ny * ny + nz * nz)
            normal = (nx / length, ny / length, nz / length)
        else:  # in one place there is no side: one of them goes up
            push, normal = (0.0, 0.0, -REACH_UP_M), (0.0, 0.0, -1.0)
        # what stands on the ground does not give way
        share = (
            0.5 if first.airframe.on_ground == second.airframe.on_ground else float(second.airframe.on_ground)
        )
        before = _difference(first.airframe.velocity, second.airframe.velocity)
        into, after = after_contact(before, normal)
        change = _difference(after, before)
        _give(first.airframe, push, change, share)
        _give(second.airframe, push, change, share - 1.0)
        if into < 0.0:
            return
        for one, other in ((first, second), (second, first)):
            crashed = into > CRASH_MPS and not one.airframe.crashed
            one.airframe.crashed |= into > CRASH_MPS
            one.airframe.count(Collision(now_s, other.identifier, other.name, into, False, crashed))


def _speed(airframe: Multirotor) -> float:
    vx, vy, vz = airframe.velocity
    return math.sqrt(vx * vx + vy * vy + vz * vz)


def _difference(first: Vector, second: Vector) -> Vector:
    return (first[0] - second[0], first[1] - second[1], first[2] - second[2])


def _give(airframe: Multirotor, push: Vector, change: Vector, share: float) -> None:
    """Move an airframe by its share of a push, and its velocity by its share of a change."""
    if share == 0.0:
        return
    x, y, z = airframe.position
    airframe.position = (x + share * push[0], y + share * push[1], min(z + share * push[2], 0.0))
    vx, vy, vz = airframe.velocity
    airframe.velocity = (vx + share * change[0], vy + share * change[1], vz + share * change[2])
