"""SET_POSITION_TARGET_GLOBAL_INT, accelerations and mixed setpoints."""

import math
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavlink_sim.flight.setpoints import (
    SetpointRejectedError,
    flyable,
    global_trajectory_setpoint,
    trajectory_setpoint,
)
from mavlink_sim.physics.airframe import LINEAR_DRAG_PER_S
from mavlink_sim.physics.geography import HOME_ALTITUDE_M
from mavlink_sim.wire.messages import dialect
from tests.mavlink_sim.conftest import SIH_FRAME, SimHarness

pytestmark = pytest.mark.streams("POSITION_TARGET_LOCAL_NED")

NAMES = ("vx", "vy", "vz", "afx", "afy", "afz", "yaw", "yaw_rate")
POSITION_ALONE = 0xDF8
ACCELERATION_ALONE = 0xC3F

# STATUSTEXTs of PX4.
FRAME_REFUSED = "SET_POSITION_TARGET_GLOBAL_INT invalid coordinate frame {}\t"
FORCE_REFUSED = "SET_POSITION_TARGET_GLOBAL_INT force not supported\t"


def globally(
    position: tuple[float, float, float] = (0.0, 0.0, 0.0),
    altitude_m: float = 0.0,
    frame: int = 5,
    mask: int = POSITION_ALONE,
    **fields: float,
) -> Any:
    """A setpoint at a local position, as latitude and longitude; the altitude as sent."""
    latitude, longitude, _ = SIH_FRAME.geographic(position)
    values = dict.fromkeys(NAMES, 0.0) | fields
    return dialect.MAVLink_set_position_target_global_int_message(
        0, 1, 1, frame, mask, round(latitude * 1e7), round(longitude * 1e7), altitude_m, **values
    )


def locally(mask: int, frame: int = 1, **fields: float) -> Any:
    values = dict.fromkeys(("x", "y", "z", *NAMES), 0.0) | fields
    return dialect.MAVLink_set_position_target_local_ned_message(0, 1, 1, frame, mask, **values)


# ---- what counts


@pytest.mark.parametrize(
    ("frame", "altitude_m", "down_m"),
    [(5, HOME_ALTITUDE_M + 7.0, -7.0), (6, 7.0, -7.0), (11, 7.0, -7.0)],
    ids=["above sea", "above home", "above ground"],
)
def test_altitude_reference_follows_frame(frame: int, altitude_m: float, down_m: float) -> None:
    setpoint = global_trajectory_setpoint(
        globally((3.0, -4.0, 0.0), altitude_m, frame), SIH_FRAME, HOME_ALTITUDE_M
    )
    assert setpoint is not None
    assert setpoint.position == pytest.approx((3.0, -4.0, down_m), abs=0.02)
    assert all(math.isnan(value) for value in (*setpoint.velocity, *setpoint.acceleration))


def test_relative_altitude_error_with_raised_home_as_in_px4() -> None:
    setpoint = global_trajectory_setpoint(
        globally(altitude_m=10.0, frame=6), SIH_FRAME, HOME_ALTITUDE_M + 2.0
    )
    assert setpoint is not None
    assert setpoint.position[2] == pytest.approx(-8.0)  # 8 m over the origin is 6 m over home


@pytest.mark.parametrize("frame", [0, 1, 3, 8, 10])
def test_position_in_unsupported_frame_refused(harness: SimHarness, frame: int) -> None:
    harness.heartbeats.append(("gcs", (245, 190), 6))
    harness.wait_ready()
    harness.fly(0.1)
    harness.forget()
    harness.send(globally(altitude_m=500.0, frame=frame))
    harness.fly(0.05)
    assert harness.texts() == [FRAME_REFUSED.format(frame)]
    assert not harness.vehicle.autopilot.has_setpoints


@pytest.mark.parametrize("bit", [1, 2, 4])
def test_ignored_axis_disables_position_in_any_frame(bit: int) -> None:
    message = globally((3.0, 4.0, 0.0), 500.0, frame=3, mask=0x1C0 | bit, vx=1.0, vy=2.0, vz=3.0)
    setpoint = global_trajectory_setpoint(message, SIH_FRAME, HOME_ALTITUDE_M)
    assert setpoint is not None
    assert all(math.isnan(value) for value in setpoint.position)
    assert setpoint.velocity == (1.0, 2.0, 3.0)


def test_force_setpoint_refused(harness: SimHarness) -> None:
    harness.heartbeats.append(("gcs", (245, 190), 6))
    harness.wait_ready()
    harness.fly(0.1)
    harness.forget()
    harness.send(globally(altitude_m=500.0, mask=512))
    harness.send(globally(altitude_m=500.0, mask=0xDFF))
    harness.fly(0.05)
    assert harness.texts() == [FORCE_REFUSED]
    assert not harness.vehicle.autopilot.has_setpoints


def test_global_position_dropped_without_own_position(harness: SimHarness) -> None:
    harness.fly(0.1)
    assert not harness.vehicle.autopilot.sensors_ready
    harness.send(globally(altitude_m=500.0))
    assert not harness.vehicle.autopilot.has_setpoints
    harness.send(globally(mask=0xDC7, vx=1.0))  # a velocity needs no position
    assert harness.vehicle.autopilot.has_setpoints


@pytest.mark.parametrize(("mask", "refused"), [(512 | 0x1C0, False), (512, True), (512 | 0x180, True)])
def test_the_force_bit_matters_only_with_an_acceleration(mask: int, refused: bool) -> None:
    if refused:
        with pytest.raises(SetpointRejectedError, match="force"):
            trajectory_setpoint(locally(mask), 0.0)
    else:
        assert trajectory_setpoint(locally(mask), 0.0).velocity == (0.0, 0.0, 0.0)


@settings(max_examples=60, deadline=None)
@given(
    st.sampled_from([0, 3, 5, 6, 10, 11, 99]),
    st.integers(0, 65535),
    st.lists(st.floats(width=32), min_size=9, max_size=9),
)
def test_any_global_setpoint_dropped_or_finite_where_it_controls(
    frame: int, mask: int, values: list[float]
) -> None:
    fields = dict(zip(NAMES, values, strict=False))
    message = globally((1.0, 2.0, 0.0), values[8], frame, mask, **fields)
    try:
        setpoint = global_trajectory_setpoint(message, SIH_FRAME, HOME_ALTITUDE_M)
    except SetpointRejectedError:
        assert mask & 512 or (not mask & 7 and frame not in (5, 6, 11))
        return
    if setpoint is None:
        return
    every = (*setpoint.position, *setpoint.velocity, *setpoint.acceleration)
    assert any(map(math.isfinite, every))
    assert not any(math.isinf(value) for value in (*every, setpoint.yaw_rad, setpoint.yaw_rate_radps))
    if mask & 7:
        assert all(math.isnan(value) for value in setpoint.position)
    flight = flyable(setpoint)
    groups = (flight.position, flight.velocity, flight.acceleration)
    for axis in range(3):
        assert any(math.isfinite(group[axis]) for group in groups)


# ---- flying


@pytest.mark.parametrize(("frame", "altitude_m"), [(5, HOME_ALTITUDE_M + 6.0), (6, 6.0), (11, 6.0)])
def test_a_global_position_is_flown_to_in_each_frame(
    harness: SimHarness, frame: int, altitude_m: float
) -> None:
    harness.take_off(5.0)
    there = globally((4.0, -3.0, 0.0), altitude_m, frame, mask=0x9F8, yaw=0.5)
    harness.offboard(there)
    harness.fly(15.0, there)
    assert math.dist(harness.vehicle.airframe.position, (4.0, -3.0, -6.0)) < 0.3
    assert harness.vehicle.airframe.yaw_rad == pytest.approx(0.5, abs=0.02)
    echo = harness.received("POSITION_TARGET_LOCAL_NED")[-1]
    assert (echo.type_mask, echo.coordinate_frame) == (0, 1)
    assert (echo.x, echo.y, echo.z) == pytest.approx((4.0, -3.0, -6.0), abs=0.02)
    assert harness.heartbeat().base_mode == 145


@pytest.mark.parametrize(
    "make",
    [lambda: locally(ACCELERATION_ALONE, afx=1.0), lambda: globally(mask=ACCELERATION_ALONE, afx=1.0)],
    ids=["local", "global"],
)
def test_acceleration_only_reaches_drag_limited_velocity(
    harness: SimHarness, make: Callable[[], Any]
) -> None:
    harness.take_off(10.0)
    push = make()
    harness.offboard(push)
    start_s = harness.now_s - 0.1
    lag_s = 0.3  # until the vehicle has tilted
    for _ in range(3):
        harness.fly(1.0, push)
        passed = harness.now_s - start_s - lag_s
        gained = (1.0 - math.exp(-LINEAR_DRAG_PER_S * passed)) / LINEAR_DRAG_PER_S
        assert harness.vehicle.airframe.velocity[0] == pytest.approx(gained, abs=0.07)
    assert abs(harness.vehicle.airframe.velocity[1]) < 0.02
    assert abs(harness.height_m - 10.0) < 0.5
    echo = harness.received("POSITION_TARGET_LOCAL_NED")[-1]
    assert echo.type_mask == 63  # no position, no velocity
    assert (echo.afx, echo.afy, echo.afz) == pytest.approx((1.0, 0.0, 0.0))


def test_a_body_acceleration_is_turned_by_the_whole_attitude() -> None:
    level = trajectory_setpoint(locally(ACCELERATION_ALONE, 8, afx=1.0), math.pi / 2)
    assert level.acceleration == pytest.approx((0.0, 1.0, 0.0))
    pitched = trajectory_setpoint(locally(ACCELERATION_ALONE, 8, afx=1.0), 0.0, 0.0, math.radians(30))
    assert pitched.acceleration == pytest.approx((math.cos(math.radians(30)), 0.0, -0.5))
    rolled = trajectory_setpoint(locally(ACCELERATION_ALONE, 8, afz=1.0), 0.0, math.radians(90), 0.0)
    assert rolled.acceleration == pytest.approx((0.0, -1.0, 0.0))


def test_an_acceleration_beside_a_velocity_is_a_feed_forward(harness: SimHarness) -> None:
    """With drag at 1/s, 2 m/s need 2 m/s² of thrust: with that feed-forward the error is small."""
    harness.take_off(10.0)
    errors = []
    for ahead in (0.0, 2.0):
        setpoint = locally(0xC07, vx=2.0, afx=ahead)
        harness.offboard(setpoint)
        harness.fly(1.5, setpoint)
        errors.append(abs(harness.vehicle.airframe.velocity[0] - 2.0))
        harness.fly(8.0, locally(0xDC7))
    assert errors[1] < 0.5 * errors[0]


def test_height_by_position_and_the_rest_by_velocity(harness: SimHarness) -> None:
    harness.take_off(5.0)
    mixed = locally(0xDE3, z=-8.0, vx=1.5, vy=-0.5)
    harness.offboard(mixed)
    harness.fly(12.0, mixed)
    airframe = harness.vehicle.airframe
    assert airframe.position[2] == pytest.approx(-8.0, abs=0.2)
    assert airframe.velocity[:2] == pytest.approx((1.5, -0.5), abs=0.1)
    assert harness.received("POSITION_TARGET_LOCAL_NED")[-1].type_mask == 3


def test_position_control_with_vertical_acceleration(harness: SimHarness) -> None:
    harness.take_off(10.0)
    mixed = locally(0xCFC, x=2.0, y=0.0, afz=-0.4)
    harness.offboard(mixed)
    harness.fly(8.0, mixed)
    airframe = harness.vehicle.airframe
    assert airframe.position[0] == pytest.approx(2.0, abs=0.35)
    assert airframe.velocity[2] == pytest.approx(-0.4 / LINEAR_DRAG_PER_S, abs=0.06)
    assert harness.received("POSITION_TARGET_LOCAL_NED")[-1].type_mask & 63 == 4 | 32


@pytest.mark.parametrize(
    "fields",
    [{"mask": 0xDDF, "vz": -1.0}, {"mask": 0xDFE, "x": 30.0}, {"mask": 0xDD7, "vx": 2.0, "vz": 0.0}],
    ids=["height alone", "north alone", "north and height"],
)
def test_incomplete_setpoint_stops_but_keeps_signal(harness: SimHarness, fields: dict[str, Any]) -> None:
    harness.take_off(6.0)
    before = harness.vehicle.airframe.position
    incomplete = locally(**fields)
    harness.offboard(incomplete)
    harness.fly(3.0, incomplete)
    assert harness.mode == "OFFBOARD"
    assert math.dist(harness.vehicle.airframe.position, before) < 0.3
    echo = harness.received("POSITION_TARGET_LOCAL_NED")[-1]
    assert (echo.type_mask, echo.vx, echo.vz) == (7, 0.0, 0.0)
