"""`VelocityBias`: the difference between the rate of an estimated position and its velocity."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from companion.geometry.fence import Fence
from companion.guidance.behaviour import BehaviourContext
from companion.guidance.interface import OutputCollector
from companion.guidance.limits.envelope import Limits
from companion.guidance.limits.obstacles import ObstacleRules
from companion.guidance.motion import MAX_BIAS_MPS, VelocityBias
from companion.guidance.setpoint_output import SetpointOutput
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import LandedState, Vector3, VehicleState
from tests.companion.guidance.test_obstacles import sectors

STEP_NS = 50_000_000
VELOCITY_MPS = (3.0, -1.0, 0.2)
BEGIN_NS = 10**12


def state(north_m: float, east_m: float, stamp_ns: int) -> VehicleState:
    return VehicleState(
        position_ned_m=(north_m, east_m, -5.0), velocity_ned_mps=VELOCITY_MPS, position_ns=stamp_ns
    )


def observed(
    rate_mps: tuple[float, float], seconds: float, jump_m: float = 0.0, repeats: int = 1
) -> list[tuple[float, float]]:
    """Biases of each step while the position moves at a rate; halfway it jumps north."""
    bias, steps = VelocityBias(), round(seconds * 1e9 / STEP_NS)
    found = []
    for i in range(steps):
        now_s = i * STEP_NS / 1e9
        jumped_m = jump_m * (i > steps // 2)
        received = state(rate_mps[0] * now_s + jumped_m, rate_mps[1] * now_s, BEGIN_NS + i * STEP_NS)
        for _ in range(repeats):
            bias.update(received)
        found.append(bias._bias_mps)
    return found


def after(seconds: float) -> VelocityBias:
    """One that has found 0.2 m/s north, 0.1 m/s west."""
    bias = VelocityBias()
    for i in range(round(seconds * 1e9 / STEP_NS)):
        now_s = i * STEP_NS / 1e9
        bias.update(state(3.2 * now_s, -1.1 * now_s, BEGIN_NS + i * STEP_NS))
    return bias


@pytest.mark.parametrize("repeats", [1, 3])
def test_rate_and_velocity_difference_is_found_within_4_s(repeats: int) -> None:
    assert observed((3.2, -1.1), 4.0, repeats=repeats)[-1] == pytest.approx((0.2, -0.1), abs=0.01)


@pytest.mark.parametrize("step_ns", [20_000_000, 100_000_000, 250_000_000])
def test_turning_at_a_constant_speed_is_no_difference(step_ns: int) -> None:
    bias = VelocityBias()
    for i in range(400):
        angle = 0.45 * i * step_ns / 1e9  # 3.6 m/s on a circle of 8 m
        position = (8.0 * math.cos(angle), 8.0 * math.sin(angle), -5.0)
        velocity = (-3.6 * math.sin(angle), 3.6 * math.cos(angle), 0.0)
        bias.update(
            VehicleState(
                position_ned_m=position, velocity_ned_mps=velocity, position_ns=BEGIN_NS + i * step_ns
            )
        )
        assert math.hypot(*bias._bias_mps) < 0.01


def test_result_is_limited() -> None:
    north_mps, east_mps = observed((6.0, -1.0), 8.0)[-1]
    assert abs(north_mps) <= MAX_BIAS_MPS
    assert abs(east_mps) < 0.01


@pytest.mark.parametrize("jump_m", [0.6, 0.9, 20.0])
def test_jump_of_the_position_is_no_velocity(jump_m: float) -> None:
    assert max(abs(north_mps) for north_mps, _ in observed(VELOCITY_MPS[:2], 8.0, jump_m)) < 0.01


@pytest.mark.parametrize("gap_ns", [400_000_000, -400_000_000, 10**11])
def test_gap_of_telemetry_starts_again(gap_ns: int) -> None:
    bias = after(4.0)
    bias.update(state(3.2 * 4.0, -1.1 * 4.0, BEGIN_NS + 4 * 10**9 - STEP_NS + gap_ns))
    assert bias._bias_mps == (0.0, 0.0)


def test_none_on_the_ground() -> None:
    bias = after(4.0)
    parked = replace(state(0.0, 0.0, BEGIN_NS + 4 * 10**9), landed=LandedState.ON_GROUND)
    bias.update(parked)
    assert bias._bias_mps == (0.0, 0.0)
    assert bias.fitting(parked) is parked


def test_unknown_state_starts_again() -> None:
    bias = after(4.0)
    bias.update(VehicleState())
    assert bias._bias_mps == (0.0, 0.0)
    bias.update(state(500.0, 0.0, BEGIN_NS))
    bias.update(state(500.0, 0.0, BEGIN_NS))
    assert bias._bias_mps == (0.0, 0.0)


def test_state_and_setpoint_are_corrected_oppositely() -> None:
    bias = after(4.0)
    fitting = bias.fitting(state(0.0, 0.0, BEGIN_NS))
    assert fitting.velocity_ned_mps == pytest.approx((3.2, -1.1, 0.2), abs=0.01)
    assert fitting.position_ned_m == (0.0, 0.0, -5.0)
    wanted = Setpoint.velocity((1.0, 0.0, -0.5), BEGIN_NS, yaw_rad=1.0)
    command = bias.command(wanted, 5.0)
    assert command.velocity_ned_mps == pytest.approx((0.8, 0.1, -0.5), abs=0.01)
    assert command.yaw_rad == 1.0
    place = Setpoint.position((1.0, 2.0, -5.0), BEGIN_NS)
    assert bias.command(place, 5.0) is place


def test_command_is_at_most_the_greatest_speed() -> None:
    fast = after(4.0).command(Setpoint.velocity((-3.0, 0.0, -0.5), BEGIN_NS), 3.0)
    assert fast.velocity_ned_mps is not None
    north_mps, east_mps, down_mps = fast.velocity_ned_mps
    assert math.hypot(north_mps, east_mps) == pytest.approx(3.0)
    assert down_mps == -0.5


@pytest.mark.parametrize(
    ("limits", "near"),
    [
        (Limits(max_distance_m=21.0), None),
        (Limits(fence=Fence(include=((-9.0, -9.0), (21.0, -9.0), (21.0, 9.0), (-9.0, 9.0)))), None),
        (Limits(), {0: 3.0}),
    ],
    ids=["distance from home", "fence", "obstacle"],
)
def test_limits_hold_for_how_the_position_changes(limits: Limits, near: dict[int, float] | None) -> None:
    """Of two vehicles that move alike, one with a wrong velocity estimate, both go on moving alike."""
    bias = after(4.0)
    wrong = state(20.0, 0.0, BEGIN_NS)

    def sent(seen: VehicleState, by: VelocityBias) -> Vector3:
        output = SetpointOutput(limits, ObstacleRules("auto", 1.0), 1.0, OutputCollector())
        at = BehaviourContext(
            now_ns=BEGIN_NS, state=seen, obstacles=None if near is None else sectors(BEGIN_NS, near)
        )
        asked = Setpoint.velocity((4.0, 0.0, 0.0), BEGIN_NS)
        output.limit(asked, at, 0.05, "goto", by, landing=False)
        assert output.sent is not None
        assert output.limited_by
        assert output.sent.velocity_ned_mps is not None
        return output.sent.velocity_ned_mps

    right = bias.fitting(replace(wrong, home_position_ned_m=(0.0, 0.0, 0.0)))
    assert sent(right, VelocityBias())[0] < 2.0
    corrected = [one + b for one, b in zip(sent(right, bias)[:2], bias._bias_mps, strict=True)]
    assert corrected == pytest.approx(sent(right, VelocityBias())[:2], abs=1e-6)
