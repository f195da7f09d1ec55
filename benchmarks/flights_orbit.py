"""Orbits of 8 m at 4 m/s, two laps: the errors of radius and heading, by the vehicle's own estimate.

The wind is up to 3 m/s, with gusts of 0.6 m/s. The first 8 s do not count. A flight succeeds when in 95 of
100 steps the radius is within 0.3 m and the nose within 3° of the centre.
"""

from __future__ import annotations

import math
import random

import numpy as np

from benchmarks.flights import FlightResult
from companion.bench.lockstep_flight import LockstepFlight
from companion.guidance.behaviours.orbit import Orbit, OrbitBehaviour
from companion.guidance.motion import ground_speed, position_and_yaw
from vision.attitude import wrap_angle

RADIUS_M, SPEED_MPS, LAPS = 8.0, 4.0, 2.0
GUSTS_MPS, SETTLED_S, LIMIT_S = 0.6, 8.0, 150.0
WITHIN_M, WITHIN_DEG = 0.3, 3.0


def run(seed: int) -> FlightResult:
    """One flight in gusts."""
    return fly(seed, GUSTS_MPS)


def fly(seed: int, gusts_mps: float) -> FlightResult:
    """One flight."""
    wind_mps = random.Random(seed).uniform(0.0, 3.0)
    flight = LockstepFlight.airborne(seed=seed, wind_mps=wind_mps, gusts_mps=gusts_mps)
    direction = ("counterclockwise", "clockwise")[seed % 2]
    orbit = OrbitBehaviour(Orbit(None, RADIUS_M, SPEED_MPS, LAPS, direction))
    log = flight.fly(orbit, LIMIT_S)
    if log.outcome is None or not log.outcome.success:
        reason = f"not flown in {LIMIT_S:g} s" if log.outcome is None else log.outcome.reason
        return FlightResult(seed, False, {}, reason)
    begin, yaw_rad = position_and_yaw(log.moments[0].context.state)
    centre = (begin[0] + RADIUS_M * math.cos(yaw_rad), begin[1] + RADIUS_M * math.sin(yaw_rad))
    radius_m, nose_deg, speed_mps = [], [], []
    for state in (moment.context.state for moment in log.moments if moment.seconds > SETTLED_S):
        position, yaw_rad = position_and_yaw(state)
        radius_m.append(abs(math.dist(position[:2], centre) - RADIUS_M))
        to_centre = math.atan2(centre[1] - position[1], centre[0] - position[0])
        nose_deg.append(abs(math.degrees(wrap_angle(to_centre - yaw_rad))))
        speed_mps.append(ground_speed(state))
    values = {
        "radius_error_p95_m": float(np.percentile(radius_m, 95)),
        "radius_error_max_m": max(radius_m),
        "heading_error_p95_deg": float(np.percentile(nose_deg, 95)),
        "speed_p50_mps": float(np.median(speed_mps)),
    }
    good = values["radius_error_p95_m"] <= WITHIN_M and values["heading_error_p95_deg"] <= WITHIN_DEG
    return FlightResult(seed, good and not log.violations, values, log.outcome.reason)
