"""ATTITUDE_TARGET, the rates of the attitude controller, and the algebra of quaternions."""

import math
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavlink_sim.flight.attitude_control import AttitudeController
from mavlink_sim.flight.transmitter import Sticks
from mavlink_sim.px4.modes import Mode
from mavlink_sim.px4.parameters import Parameters
from mavlink_sim.wire.messages import dialect
from tests.mavlink_sim.conftest import CALIBRATION, SimHarness, position_setpoint
from vision.attitude import (
    body_down_axis,
    euler_from_quaternion,
    quaternion_from_euler,
    quaternion_inverse,
    quaternion_product,
    unit_or_none,
    unit_quaternion,
)
from vision.rotation import matrix_from_quaternion

# ---- what is sent


def test_acro_sends_its_rates_and_no_position_target() -> None:
    """As PX4: attitude and thrust stay the last demanded ones."""
    streams = ("ATTITUDE_TARGET", "POSITION_TARGET_LOCAL_NED")
    harness = SimHarness(streams, parameters={**CALIBRATION, "COM_RC_IN_MODE": 0})
    harness.vehicle.transmitter.on = True
    harness.take_off(10.0)
    harness.fly(0.2)
    before = harness.received("ATTITUDE_TARGET")[-1]
    harness.vehicle.transmitter.sticks = Sticks(yaw=0.2)
    assert harness.vehicle.autopilot.set_mode(Mode.ACRO) == 0
    harness.fly(0.1)
    harness.forget()
    harness.fly(0.5)
    assert harness.received("POSITION_TARGET_LOCAL_NED") == []
    sent = harness.received("ATTITUDE_TARGET")[-1]
    assert sent.body_yaw_rate > 0.1
    assert (sent.body_roll_rate, sent.body_pitch_rate) == (0.0, 0.0)
    assert sent.q == pytest.approx(before.q, abs=0.1)
    assert sent.thrust == pytest.approx(before.thrust, abs=0.05)


def test_attitude_setpoint_is_no_offboard_stream(harness: SimHarness) -> None:
    harness.take_off(5.0)
    hover = dialect.MAVLink_set_attitude_target_message(0, 1, 1, 7, [1, 0, 0, 0], 0, 0, 0, 0.49)
    harness.fly(1.0, hover)
    assert not harness.vehicle.autopilot.has_setpoints


@pytest.mark.streams("ATTITUDE_TARGET", "POSITION_TARGET_LOCAL_NED", "POSITION_TARGET_GLOBAL_INT")
def test_attitude_target_has_correcting_rates_in_position_mode(harness: SimHarness) -> None:
    harness.take_off(5.0)
    facing_north = position_setpoint(0, 0, -5, 0.0)
    harness.offboard(facing_north)
    harness.fly(1.0, facing_north)
    harness.forget()
    harness.fly(0.11, position_setpoint(0, 0, -5, 1.4))
    echo = harness.received("ATTITUDE_TARGET")[0]
    assert echo.q[3] == pytest.approx(math.sin(0.7), abs=0.01)
    assert echo.body_yaw_rate > 1.0  # a PX4 reported 2.5 rad/s at the beginning of such a turn


# ---- the algebra


def turned(attitude_rad: Any, rates_radps: Any, dt_s: float) -> tuple[float, float, float]:
    """(roll, pitch, yaw) after turning at these body rates for a short time."""
    p, q, r = (0.5 * rate * dt_s for rate in rates_radps)
    step = unit_or_none((1.0, p, q, r))
    assert step is not None
    return euler_from_quaternion(quaternion_product(quaternion_from_euler(*attitude_rad), step))


angles = st.floats(-3.1, 3.1)
attitudes = st.tuples(angles, st.floats(-1.5, 1.5), angles)


@settings(max_examples=30, deadline=None)
@given(attitudes, attitudes)
def test_the_controller_turns_any_attitude_into_any_other(
    start: tuple[float, float, float], goal: tuple[float, float, float]
) -> None:
    controller = AttitudeController(Parameters())
    airframe: Any = SimpleNamespace(roll_rad=start[0], pitch_rad=start[1], yaw_rad=start[2])
    wanted = quaternion_from_euler(*goal)
    for _ in range(600):
        demanded = controller.rates(wanted, 0.0, airframe)
        assert all(abs(rate) <= math.radians(220.0) + 1e-9 for rate in demanded)
        now = (airframe.roll_rad, airframe.pitch_rad, airframe.yaw_rad)
        airframe.roll_rad, airframe.pitch_rad, airframe.yaw_rad = turned(now, demanded, 0.01)
    reached = quaternion_from_euler(airframe.roll_rad, airframe.pitch_rad, airframe.yaw_rad)
    assert abs(quaternion_product(quaternion_inverse(reached), wanted)[0]) > 0.9999


@settings(max_examples=60, deadline=None)
@given(attitudes)
def test_the_quaternion_algebra_agrees_with_the_matrices(attitude_rad: tuple[float, float, float]) -> None:
    q = quaternion_from_euler(*attitude_rad)
    assert body_down_axis(q) == pytest.approx(tuple(matrix_from_quaternion(q)[:, 2]), abs=1e-9)
    assert quaternion_product(quaternion_inverse(q), q) == pytest.approx((1.0, 0.0, 0.0, 0.0), abs=1e-9)
    w, x, y, z = q
    assert unit_or_none((3.0 * w, 3.0 * x, 3.0 * y, 3.0 * z)) == pytest.approx(q)


@pytest.mark.parametrize("values", [(0.0,) * 4, (math.nan, 0.0, 0.0, 1.0), (math.inf, 0.0, 0.0, 0.0)])
def test_zero_quaternion_has_no_unit_quaternion(values: tuple[float, float, float, float]) -> None:
    assert unit_or_none(values) is None
    with pytest.raises(ValueError, match="not a rotation"):
        unit_quaternion(values)
