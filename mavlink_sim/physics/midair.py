"""The vehicles of a fleet for each other: collisions, and what a range sensor measures of them.

All are upright ellipsoids, of equal mass; NED metres in the world frame. Contacts are without friction; an
airframe that comes down on another which stands on the ground stands on it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from mavlink_sim.physics.airframe import Multirotor
from mavlink_sim.physics.contact import (
    BOUNCE_MPS,
    CRASH_MPS,
    HALF_HEIGHT_M,
    RADIUS_M,
    STANDING_COSINE,
    Collision,
    back_speed,
)
from mavlink_sim.physics.rotations import Vector

if TYPE_CHECKING:
    from mavlink_sim.world.obstacles import Segment


# A horizontal section has this many sides: an error of 3 mm, where the sensor's is 20.
_CORNERS = [(math.cos(number * math.tau / 24), math.sin(number * math.tau / 24)) for number in range(25)]


class Neighbours:
    """All bodies of a world except one.

    Args:
        bodies: all; may grow later.
        own: the one with the sensor.
    """

    def __init__(self, bodies: Sequence[Body], own: Body) -> None:
        self._bodies = bodies
        self._own = own

    def _others(self) -> Iterator[Vector]:
        """From the own centre to the centre of each other body."""
        x, y, z = self._own.position_ned_m
        for body in self._bodies:
            if body is not self._own:
                north, east, down = body.position_ned_m
                yield north - x, east - y, down - z

    def range_below_m(self) -> float:
        """From the own legs along the own down axis to the first body; inf: none."""
        _, _, x, _, _, y, _, _, z = self._own.airframe.matrix
        found = min((_along(middle, (x, y, z)) for middle in self._others()), default=math.inf)
        return max(found - HALF_HEIGHT_M, 0.0)

    def outlines(self, range_m: float) -> list[Segment]:
        """The horizontal sections of bodies within a range: sides, (north, east) from the own centre."""
        sides: list[Segment] = []
        for north, east, down in self._others():
            if abs(down) >= HALF_HEIGHT_M or math.hypot(north, east) - RADIUS_M > range_m:
                continue
            radius = RADIUS_M * math.sqrt(1.0 - (down / HALF_HEIGHT_M) ** 2)
            corners = [(north + radius * x, east + radius * y) for x, y in _CORNERS]
            sides += itertools.pairwise(corners)
        return sides


def _along(middle: Vector, direction: Vector) -> float:
    """The distance along a unit vector to the ellipsoid around a point; 0 inside it, inf without a hit."""
    x, y, z = middle[0] / RADIUS_M, middle[1] / RADIUS_M, middle[2] / HALF_HEIGHT_M
    dx, dy, dz = direction[0] / RADIUS_M, direction[1] / RADIUS_M, direction[2] / HALF_HEIGHT_M
    # |t d - m| = 1
    square = dx * dx + dy * dy + dz * dz
    half = x * dx + y * dy + z * dz
    outside = x * x + y * y + z * z - 1.0
    if outside <= 0.0:
        return 0.0
    root = half * half - square * outside
    return (half - math.sqrt(root)) / square if root >= 0.0 and half > 0.0 else math.inf


# Two equal ellipsoids touch where one of twice the size around the first passes through the second's centre.
REACH_M, REACH_UP_M = 2.0 * RADIUS_M, 2.0 * HALF_HEIGHT_M
# Legs extend a little beyond the surface they stand on.
_CARRIED = 1.05


@dataclass(slots=True, eq=False)
class Body:
    """An airframe in the world.

    Attributes:
        start_ned_m: north and east, in the world, of the origin of the airframe's frame.
        identifier, name: of it in the others' collisions.
        clock: the time of its own collisions, seconds.
        stands_on: the body below it that carries it.
    """

    airframe: Multirotor
    start_ned_m: tuple[float, float]
    identifier: int
    name: str
    clock: Callable[[], float]
    stands_on: Body | None = None

    @property
    def position_ned_m(self) -> Vector:
        """Of the end of the legs, in the world; the centre is above it by the same height for all."""
        x, y, z = self.airframe.position
        return (x + self.start_ned_m[0], y + self.start_ned_m[1], z)


def apart(first: Body, second: Body) -> float:
    """The distance of two bodies relative to that at contact: 1 at contact, less if they overlap."""
    dx, dy, dz = _difference(first.position_ned_m, second.position_ned_m)
    return math.sqrt((dx * dx + dy * dy) / REACH_M**2 + dz * dz / REACH_UP_M**2)


class Midair:
    """The airframes of one world. Advance all of them, then call `resolve`."""

    def __init__(self) -> None:
        self.bodies: list[Body] = []
        # no pair is checked before a body has moved by half of the least distance at the last check
        self._checked_at: list[Vector] = []
        self._free_m = 0.0

    def join(self, body: Body) -> None:
        """Add a body.

        Raises:
            ValueError: it overlaps another, or was added before.
        """
        for other in self.bodies:
            if other.airframe is body.airframe or other.identifier == body.identifier:
                raise ValueError(f"{body.name} has joined already: each needs its own system id")
            if apart(body, other) < 1.0:
                away_m = math.dist(body.position_ned_m[:2], other.position_ned_m[:2])
                raise ValueError(
                    f"{body.name} is {away_m:.2g} m beside {other.name}: they need {REACH_M:g} m from middle "
                    f"to middle, so one of them must start elsewhere"
                )
        self.bodies.append(body)
        self._checked_at.append(body.position_ned_m)
        self._free_m = 0.0

    def resolve(self, step_s: float) -> None:
        """Resolve all contacts.

        Args:
            step_s: since the last call. A body that moves by more than its own size in it may pass through
                another undetected.
        """
        for body in self.bodies:
            if body.stands_on is not None:
                _fall_unless_carried(body, body.stands_on)
        limit = (0.5 * self._free_m) ** 2
        for body, (lx, ly, lz) in zip(self.bodies, self._checked_at, strict=True):
            x, y, z = body.position_ned_m
            x, y, z = x - lx, y - ly, z - lz
            if x * x + y * y + z * z >= limit:
                break
        else:
            return
        self._free_m = math.inf
        for first, second in itertools.combinations(self.bodies, 2):
            clear_m = math.dist(first.position_ned_m, second.position_ned_m) - REACH_M
            if clear_m <= 0.0 and apart(first, second) < 1.0:
                self._meet(first, second, step_s)
            self._free_m = min(self._free_m, max(clear_m, 0.0))
        self._checked_at = [body.position_ned_m for body in self.bodies]

    def _meet(self, first: Body, second: Body, step_s: float) -> None:
        """Separate two bodies, each by its share, and exchange their momentum."""
        if first.stands_on is second or second.stands_on is first:
            return
        push, normal = _occlusion(first, second)
        share = _share(first.airframe, second.airframe)
        before = _difference(first.airframe.velocity, second.airframe.velocity)
        into = -(before[0] * normal[0] + before[1] * normal[1] + before[2] * normal[2])
        lost = max(into + back_speed(into), 0.0)
        change = (lost * normal[0], lost * normal[1], lost * normal[2])
        # without a bounce they are in resting contact: the acceleration into it is cancelled
        held_s = step_s if into <= BOUNCE_MPS else math.inf
        _give(first.airframe, push, change, share, held_s)
        _give(second.airframe, push, change, share - 1.0, held_s)
        if into <= 0.0:
            return
        for one, other, up in ((first, second, -normal[2]), (second, first, normal[2])):
            above = up > STANDING_COSINE
            crashed = into > CRASH_MPS and not one.airframe.crashed
            one.airframe.crashed |= into > CRASH_MPS
            one.airframe.count(Collision(one.clock(), other.identifier, other.name, into, above, crashed))
            if above and other.airframe.on_ground and into <= BOUNCE_MPS:
                one.airframe.on_ground = True
                one.airframe.floor_down_m = one.airframe.position[2]
                one.stands_on = other


def _fall_unless_carried(upper: Body, lower: Body) -> None:
    """End the support when it has taken off, or when the body below has moved away."""
    if upper.airframe.on_ground and lower.airframe.on_ground and apart(upper, lower) < _CARRIED:
        return
    upper.stands_on = None
    if upper.airframe.floor_down_m < 0.0:
        upper.airframe.on_ground = False


def _occlusion(first: Body, second: Body) -> tuple[Vector, Vector]:
    """How far the first alone has to move until they touch; and the second's normal there."""
    dx, dy, dz = _difference(first.position_ned_m, second.position_ned_m)
    distance = apart(first, second)
    if distance == 0.0:  # coincident centres have no direction: one of them goes up
        return (0.0, 0.0, -REACH_UP_M), (0.0, 0.0, -1.0)
    out = 1.0 / distance - 1.0
    nx, ny, nz = dx / REACH_M**2, dy / REACH_M**2, dz / REACH_UP_M**2
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    return (dx * out, dy * out, dz * out), (nx / length, ny / length, nz / length)


def _share(first: Multirotor, second: Multirotor) -> float:
    """The first one's share of the separation: a standing body does not move for a flying one."""
    if first.on_ground == second.on_ground:
        return 0.5
    return 0.0 if first.on_ground else 1.0


def _difference(first: Vector, second: Vector) -> Vector:
    return (first[0] - second[0], first[1] - second[1], first[2] - second[2])


def _give(airframe: Multirotor, push: Vector, change: Vector, share: float, held_s: float) -> None:
    """Apply an airframe's share of a displacement and of a velocity change."""
    x, y, z = airframe.position
    airframe.position = (x + share * push[0], y + share * push[1], min(z + share * push[2], 0.0))
    vx, vy, vz = airframe.velocity
    airframe.velocity = (vx + share * change[0], vy + share * change[1], vz + share * change[2])
    ax, ay, az = airframe.acceleration
    share /= held_s
    airframe.acceleration = (ax + share * change[0], ay + share * change[1], az + share * change[2])
