"""SET_ATTITUDE_TARGET: the fields used, and the control of attitudes and rates."""

import math
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavlink_sim.flight.attitude_control import AttitudeController, AttitudeSetpoint, RatesSetpoint
from mavlink_sim.flight.setpoints import attitude_setpoint
from mavlink_sim.physics.airframe import GRAVITY_MPS2, LINEAR_DRAG_PER_S, MAX_THRUST_MPS2
from mavlink_sim.px4.parameters import Parameters
from mavlink_sim.wire.messages import dialect
from tests.mavlink_sim.conftest import SimHarness, position_setpoint
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

HOVER = GRAVITY_MPS2 / MAX_THRUST_MPS2
RATES_IGNORED = 7


def attitude(
    roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0, thrust: float = HOVER, mask: int = RATES_IGNORED
) -> Any:
    q = quaternion_from_euler(math.radians(roll), math.radians(pitch), math.radians(yaw))
    return dialect.MAVLink_set_attitude_target_message(0, 1, 1, mask, list(q), 0, 0, 0, thrust)


def rates(p: float, q: float, r: float, thrust: float = HOVER, mask: int = 128) -> Any:
    return dialect.MAVLink_set_attitude_target_message(0, 1, 1, mask, [1, 0, 0, 0], p, q, r, thrust)


# ---- what counts


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 255))
def test_type_mask_decides_between_attitude_rates_and_nothing(mask: int) -> None:
    message = dialect.MAVLink_set_attitude_target_message(0, 1, 1, mask, [1, 0, 0, 0], 0.1, 0.2, 0.3, 0.6)
    setpoint = attitude_setpoint(message)
    if not mask & 128:
        assert isinstance(setpoint, AttitudeSetpoint)
        assert math.isnan(setpoint.yaw_rate_radps) == bool(mask & 4)
        assert setpoint.thrust == pytest.approx(0.0 if mask & (64 | 32) else 0.6)
    elif mask & 3:
        assert setpoint is None
    else:
        assert isinstance(setpoint, RatesSetpoint)
        assert setpoint.rates[:2] == pytest.approx((0.1, 0.2))
        assert math.isnan(setpoint.rates[2]) == bool(mask & 4)
        assert setpoint.thrust == pytest.approx(0.0 if mask & 64 else 0.6)


def test_thrust_vector_uses_its_vertical_part() -> None:
    message = attitude(mask=RATES_IGNORED | 32, thrust=0.9)
    message.thrust_body = [0.1, 0.2, -0.55]
    setpoint = attitude_setpoint(message)
    assert setpoint is not None
    assert setpoint.thrust == pytest.approx(0.55)


@pytest.mark.parametrize(("mask", "counts"), [(7, True), (128, True), (0, True), (129, False), (135, False)])
def test_any_controlling_setpoint_keeps_offboard_alive(harness: SimHarness, mask: int, counts: bool) -> None:
    harness.heartbeats.append(("gcs", (245, 190), 6))
    harness.fly(0.1)
    harness.send(attitude(mask=mask))
    harness.fly(0.05)
    assert harness.vehicle.autopilot.has_setpoints is counts
    assert harness.texts() == []  # an unused setpoint is dropped silently


@pytest.mark.parametrize(("system", "component", "counts"), [(1, 0, True), (0, 0, True), (2, 1, False)])
def test_setpoint_used_if_addressed_to_autopilot(
    harness: SimHarness, system: int, component: int, counts: bool
) -> None:
    harness.fly(0.1)
    message = attitude()
    message.target_system, message.target_component = system, component
    harness.send(message)
    assert harness.vehicle.autopilot.has_setpoints is counts


# ---- flying by attitude


def test_level_at_hover_thrust_it_stays_where_it_is(harness: SimHarness) -> None:
    harness.take_off(10.0)
    harness.offboard(attitude())
    before = harness.vehicle.airframe.position
    harness.fly(5.0, attitude())
    assert math.dist(harness.vehicle.airframe.position, before) < 0.3
    assert harness.mode == "OFFBOARD"


def test_attitude_is_taken_and_thrust_is_not_adjusted_to_tilt(harness: SimHarness) -> None:
    harness.take_off(20.0)
    tilted = attitude(roll=20.0, pitch=-10.0, yaw=60.0)
    harness.offboard(tilted)
    harness.fly(4.0, tilted)
    airframe = harness.vehicle.airframe
    seen = [math.degrees(angle) for angle in (airframe.roll_rad, airframe.pitch_rad, airframe.yaw_rad)]
    assert seen == pytest.approx([20.0, -10.0, 60.0], abs=1.0)
    down = body_down_axis(quaternion_from_euler(airframe.roll_rad, airframe.pitch_rad, airframe.yaw_rad))
    drag = LINEAR_DRAG_PER_S
    expected = [-GRAVITY_MPS2 * axis - drag * v for axis, v in zip(down, airframe.velocity, strict=True)]
    expected[2] += GRAVITY_MPS2
    assert airframe.acceleration == pytest.approx(expected, abs=0.02)
    assert airframe.velocity[2] > 0.2  # hover thrust, tilted, does not carry the weight


def test_a_turn_takes_the_short_way_and_keeps_the_vehicle_level(harness: SimHarness) -> None:
    harness.take_off(10.0)
    harness.offboard(attitude(yaw=170.0))
    harness.fly(5.0, attitude(yaw=170.0))
    turns = []
    for _ in range(100):
        harness.fly(0.02, attitude(yaw=-170.0))
        turns.append(harness.vehicle.airframe.rates[2])
        assert abs(harness.vehicle.airframe.roll_rad) < 0.02
    assert min(turns) > -0.02
    assert math.degrees(harness.vehicle.airframe.yaw_rad) == pytest.approx(-170.0, abs=3.0)


def test_more_thrust_climbs_less_sinks_and_ignored_throttle_none(harness: SimHarness) -> None:
    harness.take_off(30.0)
    harness.offboard(attitude())
    harness.fly(1.0, attitude())
    harness.fly(1.0, attitude(thrust=HOVER + 0.05))
    gained = 0.05 * MAX_THRUST_MPS2 / LINEAR_DRAG_PER_S * (1 - math.exp(-LINEAR_DRAG_PER_S * 1.0))
    assert harness.vehicle.airframe.velocity[2] == pytest.approx(-gained, abs=0.08)
    harness.fly(0.6, attitude(mask=RATES_IGNORED | 64))
    assert harness.vehicle.airframe.thrust_mps2 < 0.01


def test_a_tumbling_vehicle_comes_upright(harness: SimHarness) -> None:
    harness.take_off(60.0)
    flip = rates(8.0, 0.0, 0.0)
    harness.offboard(flip)
    harness.until(lambda: abs(harness.vehicle.airframe.roll_rad) > 3.0, 2.0, flip)
    harness.fly(2.0, attitude(thrust=0.6))
    assert abs(harness.vehicle.airframe.roll_rad) < 0.02
    assert abs(harness.vehicle.airframe.pitch_rad) < 0.02


def test_invalid_quaternion_keeps_body_rates(harness: SimHarness) -> None:
    harness.take_off(10.0)
    harness.offboard(rates(0.0, 0.0, 0.5))
    harness.fly(3.0, rates(0.0, 0.0, 0.5))
    for values in ([0.0] * 4, [math.nan] * 4):
        nothing = attitude()
        nothing.q = values
        harness.fly(1.0, nothing)
        assert harness.vehicle.airframe.rates[2] == pytest.approx(0.5, abs=0.05)
    assert harness.mode == "OFFBOARD"


# ---- flying by rates


def test_body_rates_followed_and_ignored_yaw_rate_kept(harness: SimHarness) -> None:
    harness.take_off(10.0)
    spin = rates(0.0, 0.0, 0.8)
    harness.offboard(spin)
    harness.fly(3.0, spin)
    assert harness.vehicle.airframe.rates == pytest.approx((0.0, 0.0, 0.8), abs=0.02)
    harness.fly(1.0, rates(0.0, 0.0, 0.0, mask=128 | 4))
    assert harness.vehicle.airframe.rates[2] == pytest.approx(0.8, abs=0.1)
    harness.fly(2.0, rates(0.0, 0.0, 0.0))
    assert harness.vehicle.airframe.rates[2] == pytest.approx(0.0, abs=0.02)


def test_a_whole_flip_is_possible_by_rates(harness: SimHarness) -> None:
    harness.take_off(60.0)
    harness.offboard(attitude())
    flip = rates(0.0, 6.0, 0.0, thrust=0.3)
    harness.until(lambda: harness.vehicle.airframe.roll_rad > 3.0, 2.0, flip)  # past the vertical
    harness.until(lambda: abs(harness.vehicle.airframe.roll_rad) < 0.1, 2.0, flip)
    harness.fly(2.0, attitude(thrust=0.7))
    assert abs(harness.vehicle.airframe.pitch_rad) < 0.02
    assert harness.armed


@pytest.mark.parametrize("first", [attitude(roll=5.0), rates(0.1, 0.0, 0.0)], ids=["attitude", "rates"])
def test_a_position_may_follow_an_attitude_and_is_flown(harness: SimHarness, first: Any) -> None:
    harness.take_off(8.0)
    harness.offboard(first)
    harness.fly(1.0, first)
    there = position_setpoint(0, 0, -8)
    harness.fly(15.0, there)
    assert math.dist(harness.vehicle.airframe.position, (0, 0, -8)) < 0.3


# ---- taking off, landing, losing it


def test_takeoff_by_thrust_and_disarm_after_landing(harness: SimHarness) -> None:
    harness.wait_ready()
    climb = attitude(thrust=HOVER + 0.03)
    harness.offboard(climb)
    assert harness.command(400, 1) == [0]
    harness.until(lambda: harness.height_m > 2.0, 15.0, climb)
    assert "takeoff" in harness.events
    sink = attitude(thrust=HOVER - 0.04)
    harness.until(lambda: harness.vehicle.airframe.on_ground, 15.0, sink)
    harness.until(lambda: not harness.armed, 6.0, attitude(thrust=0.0))
    assert "landed" in harness.events


def test_without_the_stream_the_failsafe_flies_home_by_position(harness: SimHarness) -> None:
    harness.take_off(8.0)
    stream = attitude(roll=3.0)
    harness.offboard(stream)
    harness.fly(1.0, stream)
    harness.send(stream)
    assert 1.0 <= harness.until(lambda: harness.mode == "RTL", 3.0) <= 1.15
    harness.until(lambda: not harness.armed, 60.0)


# ---- what is echoed


@pytest.mark.streams("ATTITUDE_TARGET", "POSITION_TARGET_LOCAL_NED", "POSITION_TARGET_GLOBAL_INT")
def test_attitude_target_sent_without_position_target(harness: SimHarness) -> None:
    harness.take_off(10.0)
    wanted = attitude(roll=6.0, yaw=30.0, thrust=0.52)
    harness.offboard(wanted)
    harness.fly(1.0, wanted)
    harness.forget()
    harness.fly(1.0, wanted)
    assert harness.received("POSITION_TARGET_LOCAL_NED") == []
    assert harness.received("POSITION_TARGET_GLOBAL_INT") == []
    echo = harness.received("ATTITUDE_TARGET")[-1]
    assert (echo.type_mask, echo.thrust) == (0, pytest.approx(0.52))
    assert echo.q == pytest.approx(wanted.q, abs=1e-6)

    turning = rates(0.0, 0.0, 0.4, thrust=0.5)
    harness.forget()
    harness.fly(0.5, turning)
    echo = harness.received("ATTITUDE_TARGET")[-1]
    assert (echo.body_roll_rate, echo.body_yaw_rate) == pytest.approx((0.0, 0.4))
    assert echo.q == pytest.approx(wanted.q, abs=1e-6)  # as PX4: the last attitude setpoint stays in it
    assert echo.thrust == pytest.approx(0.52)

    harness.forget()
    harness.fly(0.5, position_setpoint(0, 0, -10))
    assert harness.received("POSITION_TARGET_LOCAL_NED")[-1].type_mask == 0


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


@pytest.mark.parametrize(("setpoint", "base"), [(attitude(), 145), (rates(0, 0, 0), 129)])
def test_heartbeat_is_stabilized_except_with_body_rates(
    harness: SimHarness, setpoint: Any, base: int
) -> None:
    harness.take_off(10.0)
    harness.offboard(setpoint)
    harness.forget()
    harness.until(lambda: bool(harness.received("HEARTBEAT")), 1.5, setpoint)
    beat = harness.received("HEARTBEAT")[-1]
    assert (beat.custom_mode, beat.base_mode, beat.system_status) == (0x00060000, base, 4)


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
    setpoint = AttitudeSetpoint(wanted, math.nan, 0.5)
    for _ in range(600):
        demanded = controller.rates(setpoint, airframe)
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


@settings(max_examples=15, deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(0, 255), st.lists(st.floats(width=32), min_size=8, max_size=8)),
        min_size=1,
        max_size=5,
    )
)
def test_no_attitude_target_raises(requests: list[tuple[int, list[float]]]) -> None:
    harness = SimHarness(["everything"], ready_after_s=0.0)
    harness.offboard(attitude())
    harness.command(400, 1)
    for mask, values in requests:
        message = dialect.MAVLink_set_attitude_target_message(0, 1, 1, mask, values[:4], *values[4:])
        harness.fly(0.3, message)
    airframe = harness.vehicle.airframe
    attitude_rad = (airframe.roll_rad, airframe.pitch_rad, airframe.yaw_rad)
    assert all(map(math.isfinite, (*airframe.position, *airframe.velocity, *attitude_rad)))
    codec = dialect.MAVLink(None, 1, 1)
    for _, item in harness.inbox["onboard"]:
        assert item.pack(codec)
