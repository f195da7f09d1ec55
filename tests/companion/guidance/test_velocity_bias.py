"""`VelocityBias`: the difference between the rate of an estimated position and its velocity."""

from __future__ import annotations

import pytest

from companion.guidance.motion import MAX_BIAS_MPS, VelocityBias
from companion.vehicle.state import VehicleState

STEP_S = 0.05
VELOCITY_MPS = (3.0, -1.0, 0.0)


def state(north_m: float, east_m: float) -> VehicleState:
    return VehicleState(position_ned_m=(north_m, east_m, -5.0), velocity_ned_mps=VELOCITY_MPS)


def observed(rate_mps: tuple[float, float], seconds: float, jump_m: float = 0.0) -> list[tuple[float, float]]:
    """Biases of each step while the position moves at a rate; halfway it jumps north."""
    bias, steps = VelocityBias(), round(seconds / STEP_S)
    return [
        bias.update(
            state(rate_mps[0] * i * STEP_S + jump_m * (i > steps // 2), rate_mps[1] * i * STEP_S), STEP_S
        )
        for i in range(steps)
    ]


def test_rate_and_velocity_difference_is_found_within_8_s() -> None:
    assert observed((3.2, -1.1), 8.0)[-1] == pytest.approx((0.2, -0.1), abs=0.01)


def test_result_is_limited() -> None:
    north_mps, east_mps = observed((6.0, -1.0), 8.0)[-1]
    assert abs(north_mps) <= MAX_BIAS_MPS
    assert abs(east_mps) < 0.01


@pytest.mark.parametrize("jump_m", [0.6, 0.9, 20.0])
def test_jump_of_the_position_is_no_velocity(jump_m: float) -> None:
    assert max(abs(north_mps) for north_mps, _ in observed(VELOCITY_MPS[:2], 8.0, jump_m)) < 0.01


def test_unknown_state_starts_again() -> None:
    bias = VelocityBias()
    for index in range(100):
        bias.update(state(3.2 * index * STEP_S, 0.0), STEP_S)
    assert bias.update(VehicleState(), STEP_S) == (0.0, 0.0)
    assert bias.update(state(500.0, 0.0), STEP_S) == (0.0, 0.0)
