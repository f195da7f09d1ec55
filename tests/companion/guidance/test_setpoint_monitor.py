"""Setpoint monitor on synthetic motion sequences."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

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


@pytest.mark.parametrize(("speed_mps", "lasting_s"), [(1.0, 2.5), (2.0, 1.0), (5.0, 1.0)])
def test_vehicle_stopped_in_flight_is_detected(speed_mps: float, lasting_s: float) -> None:
    sequence = Sequence()
    assert sequence.fly(north(speed_mps), north(speed_mps), 5.0) is None
    braking = lambda seconds: (max(0.0, speed_mps - 3.0 * seconds), 0.0, 0.0)  # noqa: E731
    seen_s = known(sequence.fly(north(speed_mps), braking, 5.0))
    assert lasting_s <= seen_s <= lasting_s + speed_mps / 3.0 + 0.2


@pytest.mark.parametrize(("speed_mps", "at_most_s"), [(1.0, 9.0), (3.0, 4.5)])
def test_vehicle_that_never_starts_is_detected(speed_mps: float, at_most_s: float) -> None:
    seen_s = known(Sequence().fly(north(speed_mps), still, 10.0))
    assert seen_s < at_most_s


def test_vehicle_that_leaves_a_hold_is_detected() -> None:
    sequence = Sequence()
    assert sequence.fly(still, still, 5.0) is None
    seen_s = known(sequence.fly(still, rising(2.0, 0.6), 5.0))
    assert seen_s < 2.0


def test_vehicle_in_another_direction_is_detected() -> None:
    sequence = Sequence()
    assert sequence.fly(north(2.0), north(2.0), 3.0) is None
    seen_s = known(sequence.fly(north(2.0), lambda seconds: (0.0, 2.0, 0.0), 5.0))
    assert seen_s < 1.5


@pytest.mark.parametrize(("speed_mps", "noticed"), [(0.6, True), (0.3, False)])
def test_slow_setpoint_needs_the_long_rule(speed_mps: float, noticed: bool) -> None:
    sequence = Sequence()
    assert sequence.fly(north(speed_mps), north(speed_mps), 5.0) is None
    assert (sequence.fly(north(speed_mps), still, 8.0) is not None) is noticed


@pytest.mark.parametrize("within_s", [0.3, 1.0, 1.7])
def test_setpoint_steps_and_reversals_count_as_following(within_s: float) -> None:
    """From 3 m/s to -3 m/s, with a delay of 0.2 s."""
    sequence = Sequence()
    assert sequence.fly(north(3.0), rising(3.0, within_s, 0.2), 8.0) is None
    turning = lambda seconds: (3.0 - 2.0 * rising(3.0, within_s, 0.2)(seconds)[0], 0.0, 0.0)  # noqa: E731
    assert sequence.fly(north(-3.0), turning, 8.0) is None
    assert sequence.largest_mps < 0.7


def test_slow_rise_of_px4_to_3_mps_counts_as_following() -> None:
    """Measured in its SIH simulation: 2.65 m/s after 6 s."""
    sequence = Sequence()
    assert sequence.fly(north(3.0), rising(2.65, 1.2), 20.0) is None
    assert sequence.largest_mps < 0.5


def test_half_the_speed_counts_as_following() -> None:
    assert Sequence().fly(north(5.0), north(2.5), 20.0) is None


def test_oscillation_counts_as_following() -> None:
    """A badly tuned hold: ±1.6 m/s, against setpoints that are a quarter of a period late."""
    rate_radps = 1.9

    def active(seconds: float) -> Vector3:
        return (1.6 * math.cos(rate_radps * seconds), 1.6 * math.sin(rate_radps * seconds), 0.0)

    def sent(seconds: float) -> Vector3:
        return (-math.sin(rate_radps * seconds), math.cos(rate_radps * seconds), 0.0)

    sequence = Sequence()
    assert sequence.fly(sent, active, 20.0) is None
    assert sequence.largest_mps > 0.8


def test_estimate_reset_restarts_the_comparison() -> None:
    sequence = Sequence()
    assert sequence.fly(north(3.0), north(3.0), 3.0) is None
    assert sequence.fly(north(3.0), still, 0.9) is None
    sequence.state = replace(sequence.state, reset_count=1)
    assert sequence.fly(north(3.0), still, 1.5) is None


def test_telemetry_gap_restarts_the_comparison() -> None:
    sequence = Sequence()
    assert sequence.fly(north(3.0), north(3.0), 3.0) is None
    assert sequence.fly(north(3.0), still, 0.9) is None
    sequence.seconds += 1.0
    assert sequence.fly(north(3.0), still, 1.5) is None


@pytest.mark.parametrize("landed", [LandedState.ON_GROUND, LandedState.TAKING_OFF, LandedState.LANDING])
def test_no_comparison_on_the_ground(landed: LandedState) -> None:
    sequence = Sequence()
    sequence.state = replace(sequence.state, landed=landed)
    assert sequence.fly(north(3.0), still, 10.0) is None


def test_no_comparison_with_an_invalid_estimate() -> None:
    sequence = Sequence()
    sequence.state = replace(sequence.state, position_valid=False)
    assert sequence.fly(north(3.0), still, 10.0) is None


def test_ground_contact_at_a_landing_is_allowed() -> None:
    """The autopilot reports the landing seconds later."""
    down: Velocity = lambda seconds: (0.2, 0.1, 0.7)  # noqa: E731
    sequence = Sequence()
    assert sequence.fly(down, lambda seconds: (0.1, 0.1, 0.7), 3.0, landing=True) is None
    assert sequence.fly(down, still, 10.0, landing=True) is None


def test_landing_that_drifts_away_is_detected() -> None:
    down = lambda seconds: (0.0, 0.0, 0.7)  # noqa: E731
    assert Sequence().fly(down, rising(3.0, 0.5), 5.0, landing=True) is not None


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
