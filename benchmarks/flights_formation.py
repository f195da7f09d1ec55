"""Five simulated vehicles in formation through turns: wind, noise, poses that come late or not at all.

The shape goes by the seed. The leader flies a path with right-angled turns; four vehicles that hover about it
in any order take their slots and follow. All are of the built-in kind, each with its own origin, clock, gusts
and errors of estimate.
"""

from __future__ import annotations

import math
import random

import numpy as np

from benchmarks.flights import FlightResult
from benchmarks.formation import Fleet, LockstepAirframe
from companion.geometry.formation import SHAPES
from companion.guidance.behaviours.follow_path import FollowPathBehaviour
from companion.guidance.behaviours.formation import Formation, FormationBehaviour
from companion.guidance.limits.envelope import Limits

VEHICLES = 5
SPACING_M = 6.0
WIND_MPS = 3.0
LEADER_SPEED_MPS = 2.0
HEIGHT_M = 6.0
# About the leader's home: a turn to the right and one to the left.
PATH = ((25.0, 0.0), (25.0, 25.0), (50.0, 25.0))
ASSEMBLED_M = 1.5


def hovering(fleet: Fleet, count: int, seed: int, wind_mps: float = WIND_MPS) -> list[str]:
    """That many simulated vehicles, hovering 7 m apart on a grid in an order of the seed's."""
    chance = random.Random(seed)
    places = [(-7.0 * (index // 3), 7.0 * (index % 3)) for index in range(count)]
    chance.shuffle(places)
    direction = chance.uniform(0.0, math.tau)
    wind = (wind_mps * math.cos(direction), wind_mps * math.sin(direction))
    names = []
    for index, place in enumerate(places):
        clock_ns = chance.randrange(10**9, 10**14)
        name = f"vehicle{index + 1}"
        fleet.add(name, LockstepAirframe(index + 1, chance.randrange(10**6), place, HEIGHT_M, clock_ns, wind))
        names.append(name)
    return names


def run(seed: int) -> FlightResult:
    """One flight: `min_separation_m` over all of it, slot errors from the start of the path to its end."""
    limits = Limits()
    fleet = Fleet(seed, limits=limits)
    names = hovering(fleet, VEHICLES, seed)
    leader, followers = names[0], names[1:]
    shape = SHAPES[seed % len(SHAPES)]
    fleet.run(2.0)
    for name in followers:
        refused = fleet.command(name, FormationBehaviour(Formation(shape, leader, SPACING_M)))
        if refused is not None:
            return FlightResult(seed, False, {}, f"{name}: {refused}")
    began_s = fleet.now_s
    assembled = fleet.run_until(lambda: _worst(fleet) < ASSEMBLED_M and len(fleet.slot_errors()) == 4, 40.0)
    assembly_s = fleet.now_s - began_s
    fleet.run(3.0)
    errors: list[float] = []
    fleet.command(leader, FollowPathBehaviour(PATH, LEADER_SPEED_MPS))

    def flown() -> bool:
        errors.extend(fleet.slot_errors().values())
        return fleet.members[leader].outcome is not None

    arrived = fleet.run_until(flown, 120.0)
    fleet.run(4.0)
    values = {
        "min_separation_m": fleet.least_m,
        "slot_error_p50_m": float(np.percentile(errors, 50)) if errors else math.nan,
        "slot_error_p95_m": float(np.percentile(errors, 95)) if errors else math.nan,
        "slot_error_max_m": max(errors, default=math.nan),
        "end_error_m": _worst(fleet),
        "assembly_s": assembly_s,
        "flight_s": fleet.now_s - began_s,
        "message_bytes": float(np.mean(fleet.sent_bytes)),
    }
    problems = []
    if fleet.least_m < limits.min_separation_m:
        problems.append(f"two vehicles came within {fleet.least_m:.2f} m")
    if not assembled:
        problems.append(f"not in their slots after {assembly_s:.0f} s")
    if not arrived:
        problems.append("the leader did not arrive")
    for name in followers:
        if (outcome := fleet.members[name].outcome) is not None:
            problems.append(f"{name} ended: {outcome.reason}")
    if not values["end_error_m"] < ASSEMBLED_M:
        problems.append(f"{values['end_error_m']:.1f} m from a slot at the end")
    return FlightResult(seed, not problems, values, f"{shape}: {'; '.join(problems) or 'flown'}")


def _worst(fleet: Fleet) -> float:
    return max(fleet.slot_errors().values(), default=math.inf)
