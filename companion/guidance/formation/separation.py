"""Separation: keep a minimum distance between vehicles.

The speed towards a neighbour is limited so that both can stop in the distance left, including the neighbour's
own stopping distance, by the car-following law of Gipps (1981, "A behavioural car-following model for
computer simulation"): v <= sqrt((b·t)² + 2·b·distance + v_ahead²) - b·t, with both braking at b and t our
reaction time, which grows with the age of the pose. Each neighbour defines a half-space of velocities; the
commanded velocity is projected into all of them one after the other (van den Berg et al. 2011, "Reciprocal
n-body collision avoidance", with the plane normal to the line of centres). Zero velocity is in every
half-space: a limit only reduces speed and never makes a vehicle move away.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from companion.guidance.formation.neighbours import Neighbour
from companion.vehicle.state import Vector3

# Added to the minimum distance: two position estimates, each some 0.4 m wrong, and gusts.
MARGIN_M = 1.0
# Delay of a multirotor's velocity response.
REACTION_S = 0.4
# Maximum closing speed per metre left. Both vehicles may close, so it is half of what one could have alone:
# critically damped for velocities with a time constant of 0.3 s.
GAIN_PER_S = 0.4
# Part of the maximum acceleration that is planned for stopping; the rest covers the vehicle's delay.
BRAKING = 0.5
# Detours are searched this far ahead, in steps of this angle to either side.
LOOK_M = 12.0
TURN_RAD = math.radians(15.0)
_TURNS = 10
_FAVOUR = 2
# Speed away from a vehicle that is too near, per metre missing, and its limit.
PUSH_PER_S = 0.8
PUSH_MPS = 1.0
# Correcting for one constraint may violate another: maximum number of projections.
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
        left_m: distance left. ahead_mps: of the neighbour, away from us; negative: towards us.
        age_s: of its pose. braking_mps2: of both.
    """
    reaction_s = REACTION_S + age_s
    if ahead_mps < 0.0:
        left_m -= -ahead_mps * reaction_s + ahead_mps**2 / (2.0 * braking_mps2)
        ahead_mps = 0.0
    late = braking_mps2 * reaction_s
    square = late**2 + 2.0 * braking_mps2 * left_m + ahead_mps**2
    stopping = math.sqrt(max(0.0, square)) - late
    return max(0.0, min(stopping, ahead_mps + GAIN_PER_S * max(0.0, left_m)))


def constraints_at(
    position: Vector3, neighbours: Sequence[Neighbour], separation_m: float, braking_mps2: float
) -> list[SpeedConstraint]:
    """The constraints at a position (local NED): one for every real neighbour."""
    constraints = []
    for neighbour in neighbours:
        if neighbour.virtual:
            continue
        offset = [n - p for n, p in zip(neighbour.position_ned_m, position, strict=True)]
        distance_m = math.hypot(*offset)
        # At the same position every direction leads apart.
        north, east, down = (part / distance_m for part in offset) if distance_m > 1e-6 else (0.0, 0.0, 0.0)
        ahead = sum(v * d for v, d in zip(neighbour.velocity_ned_mps, (north, east, down), strict=True))
        left_m = distance_m - separation_m - MARGIN_M
        # A silent neighbour is taken to be at rest, so its age does not add to the reaction time.
        age_s = 0.0 if neighbour.silent else neighbour.age_s
        constraints.append(
            SpeedConstraint(
                north, east, down, allowed_speed(left_m, ahead, age_s, braking_mps2), neighbour.name
            )
        )
    return constraints


def apply_separation(
    velocity: Vector3, constraints: Sequence[SpeedConstraint]
) -> tuple[Vector3, tuple[str, ...]]:
    """Limit a velocity (NED); returns it, never faster than the input, and the names that limited it."""
    top = math.hypot(*velocity)
    acting = [constraint for constraint in constraints if constraint.allowed_mps < top]
    names: dict[str, None] = {}
    for _ in range(_ROUNDS):
        before = velocity
        for constraint in acting:
            excess = _towards(velocity, constraint) - constraint.allowed_mps
            if excess > 1e-9:
                names[constraint.name] = None
                velocity = (
                    velocity[0] - excess * constraint.north,
                    velocity[1] - excess * constraint.east,
                    velocity[2] - excess * constraint.down,
                )
        if velocity == before:
            return velocity, tuple(names)
    # Zero velocity satisfies every constraint: scale down what still violates one.
    fraction = 1.0
    for constraint in acting:
        towards = _towards(velocity, constraint)
        if towards > constraint.allowed_mps + 1e-6:
            fraction = min(fraction, constraint.allowed_mps / towards)
    return (velocity[0] * fraction, velocity[1] * fraction, velocity[2] * fraction), tuple(names)


def level_constraints(
    constraints: Sequence[SpeedConstraint], down_mps: float
) -> list[tuple[float, float, float]]:
    """The constraints on horizontal velocity (north, east, speed), given the vertical one."""
    level = []
    for constraint in constraints:
        fraction = math.hypot(constraint.north, constraint.east)
        if fraction > 1e-3:
            allowed = max(0.0, (constraint.allowed_mps - down_mps * constraint.down) / fraction)
            level.append((constraint.north / fraction, constraint.east / fraction, allowed))
    return level


def avoid(
    wanted: tuple[float, float],
    distance_m: float,
    position: Vector3,
    standing: Sequence[Neighbour],
    clearance_m: float,
    side: float = 1.0,
) -> tuple[tuple[float, float], float]:
    """A horizontal velocity (north, east) that leads around standing vehicles.

    The straight path if it is free, else the free direction with the least turn. Between equal sides the last
    one is kept; initially the right, so that vehicles that meet head on both pass on the right.

    Args:
        wanted: relative to the standing vehicles. distance_m: to the goal. standing: local NED.
        clearance_m: to keep to each of them.
        side: the previously returned side: 1 right, -1 left.

    Returns:
        The velocity, as fast as the wanted one if any direction is free (else zero), and the side.
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
    reach_m = min(distance_m, LOOK_M)
    # Changing sides must save at least _FAVOUR steps.
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
        turned = (wanted[0] * cosine - wanted[1] * sine, wanted[0] * sine + wanted[1] * cosine)
        if all(_clear((turned[0] / speed, turned[1] / speed), reach_m, there, clearance_m) for there in near):
            return turned, side if turn == 0.0 else math.copysign(1.0, turn)
    return (0.0, 0.0), side


def _clear(
    ahead: tuple[float, float], reach_m: float, there: tuple[float, float], clearance_m: float
) -> bool:
    """Whether a straight path keeps clear of a point; from inside the clearance: whether it leads away."""
    along = there[0] * ahead[0] + there[1] * ahead[1]
    if along <= 0.0:
        return True
    if math.hypot(*there) < clearance_m:
        return False
    nearest = min(along, reach_m)
    return math.hypot(there[0] - nearest * ahead[0], there[1] - nearest * ahead[1]) >= clearance_m


def repulsion(position: Vector3, neighbours: Sequence[Neighbour], distance_m: float) -> tuple[float, float]:
    """A horizontal velocity (north, east) away from every neighbour nearer than a distance.

    The limit only reduces speed; a behaviour that flies among others uses this to restore the distance.
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


def _towards(velocity: Vector3, constraint: SpeedConstraint) -> float:
    return velocity[0] * constraint.north + velocity[1] * constraint.east + velocity[2] * constraint.down
