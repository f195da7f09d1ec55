"""The hold after a `goto`: how far the vehicle gets from the goal in the 10 s after it arrived.

The goal is up to 21 m away, 3 to 8 m high; the wind is up to 3 m/s, with gusts of 0.6 m/s. A flight succeeds
when the vehicle stays within 0.3 m of the goal, by its own estimate.
"""

from __future__ import annotations

import math
import random

from benchmarks.flights import FlightResult
from companion.bench.lockstep_flight import LockstepFlight
from companion.guidance.behaviours.goto import Goto, GotoBehaviour

GUSTS_MPS, LIMIT_S, HOLD_S = 0.6, 120.0, 10.0
WITHIN_M = 0.3


def run(seed: int) -> FlightResult:
    """One flight and its hold."""
    chance = random.Random(seed)
    goal = (chance.uniform(-15.0, 15.0), chance.uniform(-15.0, 15.0))
    goto = GotoBehaviour(Goto(*goal, altitude_m=chance.uniform(3.0, 8.0), speed_mps=4.0))
    flight = LockstepFlight.airborne(seed=seed, wind_mps=chance.uniform(0.0, 3.0), gusts_mps=GUSTS_MPS)
    log = flight.fly(goto, LIMIT_S)
    if log.outcome is None or not log.outcome.success or log.outcome.goal_ned_m is None:
        reason = f"not there after {LIMIT_S:g} s" if log.outcome is None else log.outcome.reason
        return FlightResult(seed, False, {}, reason)
    took_s, place = flight.seconds, log.outcome.goal_ned_m
    estimated_m, true_m = [], []
    while flight.seconds < took_s + HOLD_S:
        flight.tick()
        assert flight.state.position_ned_m is not None
        estimated_m.append(math.dist(flight.state.position_ned_m, place))
        true_m.append(math.dist(flight.vehicle.truth.position_ned_m, place))
    values = {"hold_error_max_m": max(estimated_m), "true_hold_error_max_m": max(true_m), "time_s": took_s}
    good = max(estimated_m) <= WITHIN_M and not log.violations
    return FlightResult(seed, good, values, log.outcome.reason)
