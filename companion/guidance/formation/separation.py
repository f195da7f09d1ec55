"""Apart from each other: no vehicle is flown nearer to another than a least distance.

Towards a neighbour no more speed is left than can be taken off in the way that is there, and the neighbour's
own way of stopping counts: one that flies ahead goes on for a while even when it brakes, one that comes
nearer needs room itself. That is the car-following law of Gipps (1981, "A behavioural car-following model for
computer simulation"): v <= sqrt((b·t)² + 2·b·way + v_ahead²) - b·t, with both braking at b and t the time
until we answer, which grows with the age of what we know. Each neighbour so makes a half-space of velocities;
what was asked for is brought into all of them by the least change, one after the other (van den Berg et al.
2011, "Reciprocal n-body collision avoidance", with the line of centres for the plane). Standing still is in
every half-space: a limit only takes away, and never makes anybody flee.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from companion.guidance.formation.neighbours import Neighbour
from companion.vehicle.state import Vector3

# Kept on top of the least distance: two places are estimates, each some 0.4 m wrong, and gusts push.
MARGIN_M = 1.0
# How late a multirotor's velocity follows.
ANSWER_S = 0.4
# Closing speed for each metre left, at most. Both close, so it is half of what one could have alone:
# velocities that follow by 0.3 s are then damped critically.
GAIN_PER_S = 0.4
# Part of the greatest acceleration that is kept for stopping, against a vehicle that answers late.
BRAKING = 0.5
# Ways around somebody are looked for so far ahead, in steps of so much to either side.
LOOK_M = 12.0
TURN_RAD = math.radians(15.0)
_TURNS = 10
_FAVOUR = 2
# Speed away from somebody too near, for each metre that is missing, and at most.
PUSH_PER_S = 0.8
PUSH_MPS = 1.0
# What slows down for one may push towards another: so often it is taken back.
_ROUNDS = 20


class SpeedConstraint(NamedTuple):
    """One limit: a unit direction (NED) towards a neighbour, and the speed allowed in it."""

    north: float
    east: float
    down: float
    allowed_mps: float
    name: str


def allowed_speed(left_m: float, ahead_mps: float, age_s: float, braking_mps2: float) -> float:
    """The speed towards a neighbour from which both can stop in time; never less than 0.

    Args:
        left_m: way that is left. ahead_mps: of the neighbour, away from us; negative: towards us.
        age_s: of what is known of it. braking_mps2: of both.
    """
    answer_s = ANSWER_S + age_s
    if ahead_mps < 0.0:
        left_m -= -ahead_mps * answer_s + ahead_mps**2 / (2.0 * braking_mps2)
        ahead_mps = 0.0
    late = braking_mps2 * answer_s
    square = late**2 + 2.0 * braking_mps2 * left_m + ahead_mps**2
    stopping = math.sqrt(max(0.0, square)) - late
    return max(0.0, min(stopping, ahead_mps + GAIN_PER_S * max(0.0, left_m)))


def constraints_at(
    position: Vector3, neighbours: Sequence[Neighbour], separation_m: float, braking_mps2: float
) -> list[SpeedConstraint]:
    """The limits at a place (local NED): one for every neighbour that is really there."""
    rows = []
    for neighbour in neighbours:
        if neighbour.virtual:
            continue
        offset = [n - p for n, p in zip(neighbour.position_ned_m, position, strict=True)]
        distance_m = math.hypot(*offset)
        # In the same place every way leads apart.
        north, east, down = (part / distance_m for part in offset) if distance_m > 1e-6 else (0.0, 0.0, 0.0)
        ahead = sum(v * d for v, d in zip(neighbour.velocity_ned_mps, (north, east, down), strict=True))
        left_m = distance_m - separation_m - MARGIN_M
        # A silent one is at rest; how late we answer does not grow with its silence.
        age_s = 0.0 if neighbour.silent else neighbour.age_s
        rows.append(
            SpeedConstraint(
                north, east, down, allowed_speed(left_m, ahead, age_s, braking_mps2), neighbour.name
            )
        )
    return rows


def apply_separation(velocity: Vector3, rows: Sequence[SpeedConstraint]) -> tuple[Vector3, tuple[str, ...]]:
    """What is left of a velocity (NED), no faster than it came, and because of whom."""
    top = math.hypot(*velocity)
    acting = [row for row in rows if row.allowed_mps < top]
    names: dict[str, None] = {}
    for _ in range(_ROUNDS):
        before = velocity
        for row in acting:
            excess = _towards(velocity, row) - row.allowed_mps
            if excess > 1e-9:
                names[row.name] = None
                velocity = (
                    velocity[0] - excess * row.north,
                    velocity[1] - excess * row.east,
                    velocity[2] - excess * row.down,
                )
        if velocity == before:
            return velocity, tuple(names)
    # Standing still keeps every limit, so what still breaks one is shortened towards that.
    share = 1.0
    for row in acting:
        towards = _towards(velocity, row)
        if towards > row.allowed_mps + 1e-6:
            share = min(share, row.allowed_mps / towards)
    return (velocity[0] * share, velocity[1] * share, velocity[2] * share), tuple(names)


def level_constraints(rows: Sequence[SpeedConstraint], down_mps: float) -> list[tuple[float, float, float]]:
    """The same limits for a velocity over ground (north, east, speed), beside this one downwards."""
    level = []
    for row in rows:
        share = math.hypot(row.north, row.east)
        if share > 1e-3:
            allowed = max(0.0, (row.allowed_mps - down_mps * row.down) / share)
            level.append((row.north / share, row.east / share, allowed))
    return level


def avoid(
    wanted: tuple[float, float],
    way_m: float,
    position: Vector3,
    standing: Sequence[Neighbour],
    clearance_m: float,
    side: float = 1.0,
) -> tuple[tuple[float, float], float]:
    """A velocity over ground (north, east) that leads past whoever stands in the way.

    The straight way if it is free, else the free one that turns off it least. Both sides alike, the one it
    turned to last is kept; first that is the right, as vehicles that meet head on both pass there.

    Args:
        wanted: relative to those who stand. way_m: how far it is to go. standing: local NED.
        clearance_m: wanted to everybody on the way.
        side: what this told last: 1 right, -1 left.

    Returns:
        The velocity, as fast as the wanted one where any way is free, and the side it turns to.
    """
    speed = math.hypot(*wanted)
    if speed < 1e-6:
        return wanted, side
    near = [
        (offset[0], offset[1])
        for offset in (
            tuple(n - p for n, p in zip(other.position_ned_m, position, strict=True)) for other in standing
        )
        if abs(offset[2]) < clearance_m
    ]
    reach_m = min(way_m, LOOK_M)
    # The other side must be better by _FAVOUR steps to be changed to.
    turns = [
        0.0,
        *(
            turn
            for step in range(1, _TURNS + _FAVOUR + 1)
            for turn in (side * step, -side * (step - _FAVOUR))
            if 0.0 < abs(turn) <= _TURNS and (turn * side > 0.0 or step > _FAVOUR)
        ),
    ]
    for turn in turns:
        cosine, sine = math.cos(turn * TURN_RAD), math.sin(turn * TURN_RAD)
        way = (wanted[0] * cosine - wanted[1] * sine, wanted[0] * sine + wanted[1] * cosine)
        if all(_clear((way[0] / speed, way[1] / speed), reach_m, there, clearance_m) for there in near):
            return way, side if turn == 0.0 else math.copysign(1.0, turn)
    return (0.0, 0.0), side


def _clear(
    ahead: tuple[float, float], reach_m: float, there: tuple[float, float], clearance_m: float
) -> bool:
    """Whether a straight way keeps clear of a place; from too near already: whether it leads away."""
    along = there[0] * ahead[0] + there[1] * ahead[1]
    if along <= 0.0:
        return True
    if math.hypot(*there) < clearance_m:
        return False
    nearest = min(along, reach_m)
    return math.hypot(there[0] - nearest * ahead[0], there[1] - nearest * ahead[1]) >= clearance_m


def pushed_apart(
    position: Vector3, neighbours: Sequence[Neighbour], distance_m: float
) -> tuple[float, float]:
    """A velocity over ground (north, east) away from everybody nearer than a distance.

    A limit cannot undo what a gust has done; a behaviour that flies among others can.
    """
    north = east = 0.0
    for neighbour in neighbours:
        offset = [p - n for n, p in zip(neighbour.position_ned_m, position, strict=True)]
        away_m = math.hypot(*offset)
        level_m = math.hypot(offset[0], offset[1])
        if not neighbour.virtual and 1e-6 < level_m and away_m < distance_m:
            push = PUSH_PER_S * (distance_m - away_m) / level_m
            north, east = north + push * offset[0], east + push * offset[1]
    speed = math.hypot(north, east)
    scale = min(1.0, PUSH_MPS / speed) if speed > 1e-6 else 1.0
    return (north * scale, east * scale)


def _towards(velocity: Vector3, row: SpeedConstraint) -> float:
    return velocity[0] * row.north + velocity[1] * row.east + velocity[2] * row.down
