"""Setpoint monitor on synthetic motion sequences."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import pytest

from companion.guidance.limits.setpoint_monitor import REASON, SetpointMonitor
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import LandedState, Vector3, VehicleState
from tests.companion.guidance.guidance_harness import known

PERIOD_S = 0.03  # LOCAL_POSITION_NED at 33 Hz
Velocity = Callable[[float], Vector3]


@dataclass
class Sequence:
    """Measurements of one flight, fed to the monitor."""

    monitor: SetpointMonitor = field(default_factory=SetpointMonitor)
    state: VehicleState = field(
        default_factory=lambda: VehicleState(landed=LandedState.IN_AIR, position_ned_m=(0.0, 0.0, -5.0))
    )
    seconds: float = 0.0
    largest_mps: float = 0.0

    def fly(
        self, sent: Velocity | Setpoint, active: Velocity, lasting_s: float, *, landing: bool = False
    ) -> float | None:
        """Seconds until the monitor reports that the vehicle does not follow; None: it does not report."""
        for index in range(round(lasting_s / PERIOD_S)):
            part_s = index * PERIOD_S
            self.seconds += PERIOD_S
            velocity, position = active(part_s), known(self.state.position_ned_m)
            north, east, down = (p + v * PERIOD_S for p, v in zip(position, velocity, strict=True))
            self.state = replace(
                self.state,
                position_ns=round(self.seconds * 1e9),
                velocity_ned_mps=velocity,
                position_ned_m=(north, east, down),
            )
            setpoint = sent if isinstance(sent, Setpoint) else Setpoint.velocity(sent(part_s), 0)
            why = self.monitor.update(setpoint, self.state, landing=landing)
            self.largest_mps = max(self.largest_mps, self.monitor.residual_mps)
            if why is not None:
                assert why.startswith(REASON)
                return part_s
        return None


def still(seconds: float) -> Vector3:
    return (0.0, 0.0, 0.0)


def north(speed_mps: float) -> Velocity:
    return lambda seconds: (speed_mps, 0.0, 0.0)


def rising(speed_mps: float, within_s: float, delay_s: float = 0.0) -> Velocity:
    """A first-order step response."""
    return lambda seconds: (speed_mps * (1 - math.exp(-max(0.0, seconds - delay_s) / within_s)), 0.0, 0.0)


def stopping(speed_mps: float) -> Velocity:
    return lambda seconds: (max(0.0, speed_mps - 3.0 * seconds), 0.0, 0.0)


def constant(*velocity: float) -> Velocity:
    return lambda seconds: (velocity[0], velocity[1], velocity[2])


# The first 5 s, then setpoint and velocity, and within which seconds the difference is noticed.
NOTICED: dict[str, tuple[Velocity | None, Velocity, Velocity, float, float]] = {
    "stopped at 1 m/s": (north(1.0), north(1.0), stopping(1.0), 2.5, 3.1),
    "stopped at 2 m/s": (north(2.0), north(2.0), stopping(2.0), 1.0, 1.9),
    "stopped at 5 m/s": (north(5.0), north(5.0), stopping(5.0), 1.0, 2.9),
    "stopped at 0.6 m/s": (north(0.6), north(0.6), still, 0.0, 8.0),
    "never starts at 1 m/s": (None, north(1.0), still, 0.0, 9.0),
    "never starts at 3 m/s": (None, north(3.0), still, 0.0, 4.5),
    "leaves a hold": (still, still, rising(2.0, 0.6), 0.0, 2.0),
    "another direction": (north(2.0), north(2.0), constant(0.0, 2.0, 0.0), 0.0, 1.5),
}


@pytest.mark.parametrize("what", NOTICED)
def test_vehicle_that_does_not_follow_is_noticed(what: str) -> None:
    before, sent, active, least_s, most_s = NOTICED[what]
    sequence = Sequence()
    assert before is None or sequence.fly(before, before, 5.0) is None
    assert least_s <= known(sequence.fly(sent, active, 10.0)) <= most_s


def late(seconds: float) -> Vector3:
    """A badly tuned hold: ±1.6 m/s, a quarter of a period after its setpoints."""
    return (1.6 * math.cos(1.9 * seconds), 1.6 * math.sin(1.9 * seconds), 0.0)


def early(seconds: float) -> Vector3:
    return (-math.sin(1.9 * seconds), math.cos(1.9 * seconds), 0.0)


# Setpoint and velocity, and the residual at most.
FOLLOWING: dict[str, tuple[Velocity, Velocity, float]] = {
    "0.3 m/s slower": (north(0.3), still, 0.4),
    "PX4's slow rise to 3 m/s in its SIH simulation": (north(3.0), rising(2.65, 1.2), 0.5),
    "half the speed": (north(5.0), north(2.5), 3.0),
    "oscillation": (early, late, 3.0),
}


@pytest.mark.parametrize("what", FOLLOWING)
def test_lag_and_slow_motion_count_as_following(what: str) -> None:
    sent, active, at_most_mps = FOLLOWING[what]
    sequence = Sequence()
    assert sequence.fly(sent, active, 20.0) is None
    assert sequence.largest_mps < at_most_mps
    assert what != "oscillation" or sequence.largest_mps > 0.8


@pytest.mark.parametrize("within_s", [0.3, 1.0, 1.7])
def test_setpoint_steps_and_reversals_count_as_following(within_s: float) -> None:
    """From 3 m/s to -3 m/s, with a delay of 0.2 s."""
    sequence, rise = Sequence(), rising(3.0, within_s, 0.2)
    assert sequence.fly(north(3.0), rise, 8.0) is None
    assert sequence.fly(north(-3.0), lambda seconds: (3.0 - 2.0 * rise(seconds)[0], 0.0, 0.0), 8.0) is None
    assert sequence.largest_mps < 0.7


@pytest.mark.parametrize("what", ["reset", "gap"])
def test_reset_or_telemetry_gap_restarts_the_comparison(what: str) -> None:
    sequence = Sequence()
    assert sequence.fly(north(3.0), north(3.0), 3.0) is None
    assert sequence.fly(north(3.0), still, 0.9) is None
    if what == "gap":
        sequence.seconds += 1.0
    else:
        sequence.state = replace(sequence.state, reset_count=1)
    assert sequence.fly(north(3.0), still, 1.5) is None


@pytest.mark.parametrize(
    "change",
    [
        {"landed": LandedState.ON_GROUND},
        {"landed": LandedState.TAKING_OFF},
        {"landed": LandedState.LANDING},
        {"position_valid": False},
    ],
    ids=str,
)
def test_no_comparison_on_the_ground_or_by_an_invalid_estimate(change: dict[str, Any]) -> None:
    sequence = Sequence()
    sequence.state = replace(sequence.state, **change)
    assert sequence.fly(north(3.0), still, 10.0) is None


def test_ground_contact_at_a_landing_is_allowed() -> None:
    """The autopilot reports the landing seconds later."""
    sequence, down = Sequence(), constant(0.2, 0.1, 0.7)
    assert sequence.fly(down, constant(0.1, 0.1, 0.7), 3.0, landing=True) is None
    assert sequence.fly(down, still, 10.0, landing=True) is None


def test_landing_that_drifts_away_is_detected() -> None:
    assert Sequence().fly(constant(0.0, 0.0, 0.7), rising(3.0, 0.5), 5.0, landing=True) is not None


def test_moving_position_setpoint_with_and_without_lag() -> None:
    """PX4 lags by 1 s times the speed; with feed-forward there is almost no lag."""
    for lag_m in (3.2, 0.3):
        sequence = Sequence()
        sequence.state = replace(sequence.state, position_ned_m=(-lag_m, 0.0, -5.0))
        for index in range(500):
            target = Setpoint.position((3.0 * (index + 1) * PERIOD_S, 0.0, -5.0), 0)
            assert sequence.fly(target, north(3.0), PERIOD_S) is None
        assert sequence.largest_mps < 1.0


def test_stop_away_from_a_position_setpoint_is_detected() -> None:
    assert Sequence().fly(Setpoint.position((4.0, 0.0, -5.0), 0), still, 5.0) is not None
