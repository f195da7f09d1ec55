"""What the environments observe and what acts on them: fixed lists of named entries with units and ranges.

A policy that is stored with these names can be flown by anything that provides the same entries. BODY LEVEL
frame: its origin is the vehicle, forward is its heading; it turns with the heading but does not tilt.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Entry:
    """One number of an observation or of an action; the range is inclusive."""

    name: str
    unit: str
    low: float
    high: float


def _vector(name: str, unit: str, limits: tuple[float, float, float]) -> tuple[Entry, ...]:
    """Forward, right and up, each from minus to plus its limit."""
    suffix = unit.replace("/", "_")
    return tuple(
        Entry(f"{name}{axis}_{suffix}", unit, -limit, limit)
        for axis, limit in zip(("forward", "right", "up"), limits, strict=True)
    )


VELOCITY = _vector("velocity_", "m/s", (5.0, 5.0, 3.0))
MAX_AGE_S = 5.0

# Velocities over ground in the BODY LEVEL frame; turn: clockwise seen from above.
VELOCITY_ACTION = (*_vector("", "m/s", (2.0, 2.0, 1.0)), Entry("turn_rad_s", "rad/s", -1.0, 1.0))

# target_*: the last known position, from where the vehicle is now. target_age_s: since that was captured.
TARGET = _vector("target_", "m", (40.0, 40.0, 20.0))
LANDING_OBSERVATION = (*TARGET, *VELOCITY, Entry("target_age_s", "s", 0.0, MAX_AGE_S))
APPROACH_OBSERVATION = (*LANDING_OBSERVATION, Entry("distance_wanted_m", "m", 3.0, 10.0))
# Along the circle, clockwise seen from above.
ORBIT_OBSERVATION = (*APPROACH_OBSERVATION, Entry("speed_wanted_m_s", "m/s", -1.5, 1.5))

# Distance to the nearest obstacle in each sector of 30 degrees, clockwise from the heading.
MAX_RANGE_M = 12.0
SECTORS_DEG = tuple(range(0, 360, 30))
OBSTACLES_OBSERVATION = (
    *TARGET,
    *VELOCITY,
    *(Entry(f"range_at_{angle}_deg_m", "m", 0.0, MAX_RANGE_M) for angle in SECTORS_DEG),
    Entry("range_age_s", "s", 0.0, MAX_AGE_S),
)

# down_*: the direction of gravity in body FRD. Commands: shares of a rotor's thrust.
ROTORS = ("front_right", "rear_left", "front_left", "rear_right")
ROTORS_OBSERVATION = (
    *_vector("target_", "m", (10.0, 10.0, 10.0)),
    *_vector("velocity_", "m/s", (10.0, 10.0, 10.0)),
    *(Entry(f"down_{axis}", "1", -1.0, 1.0) for axis in ("x", "y", "z")),
    *(Entry(f"{axis}_rate_rad_s", "rad/s", -10.0, 10.0) for axis in ("roll", "pitch", "yaw")),
    *(Entry(f"thrust_{rotor}_m_s2", "m/s2", 0.0, 10.0) for rotor in ROTORS),
    Entry("state_age_s", "s", 0.0, MAX_AGE_S),
)
ROTORS_ACTION = tuple(Entry(f"rotor_{rotor}", "1", 0.0, 1.0) for rotor in ROTORS)

CART_POLE_OBSERVATION = (
    Entry("cart_position_m", "m", -4.8, 4.8),
    Entry("cart_velocity_m_s", "m/s", -10.0, 10.0),
    Entry("pole_angle_rad", "rad", -0.42, 0.42),
    Entry("pole_rate_rad_s", "rad/s", -10.0, 10.0),
)
CART_POLE_ACTION = (Entry("force_n", "N", -10.0, 10.0),)


def low(entries: Sequence[Entry]) -> Array:
    """(len(entries),) lower ends of the ranges."""
    return np.array([entry.low for entry in entries])


def high(entries: Sequence[Entry]) -> Array:
    """(len(entries),) upper ends of the ranges."""
    return np.array([entry.high for entry in entries])
