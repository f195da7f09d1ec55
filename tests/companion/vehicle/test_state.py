from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.vehicle.state import HEARTBEAT_MAX_AGE_S, TELEMETRY_MAX_AGE_S, VehicleState, with_fields

S = 1_000_000_000


@given(yaw=st.floats(-3.14, 3.14), pitch=st.floats(-1.2, 1.2), roll=st.floats(-3.0, 3.0))
def test_yaw_is_the_heading_at_any_tilt(yaw: float, pitch: float, roll: float) -> None:
    cy, sy = math.cos(yaw / 2), math.sin(yaw / 2)
    cp, sp = math.cos(pitch / 2), math.sin(pitch / 2)
    cr, sr = math.cos(roll / 2), math.sin(roll / 2)
    attitude = (
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )
    assert VehicleState(attitude=attitude).yaw_rad == pytest.approx(yaw, abs=1e-9)


def test_initial_state_is_unknown() -> None:
    state = VehicleState()
    assert state.yaw_rad is None
    assert state.altitude_m is None
    assert not state.connected(0)
    assert not state.position_fresh(0)


def test_altitude_is_above_home_or_the_origin() -> None:
    assert VehicleState(position_ned_m=(0.0, 0.0, -5.0)).altitude_m == 5.0
    assert (
        VehicleState(position_ned_m=(0.0, 0.0, -5.0), home_position_ned_m=(1.0, 1.0, -2.0)).altitude_m == 3.0
    )


def test_connected_until_three_heartbeats_are_missing() -> None:
    state = VehicleState(heartbeat_ns=10 * S)
    last_ns = 10 * S + round(HEARTBEAT_MAX_AGE_S * S)
    assert state.connected(last_ns)
    assert not state.connected(last_ns + 1)


@pytest.mark.parametrize("late", ["position_ns", "attitude_ns"])
def test_fresh_needs_position_and_attitude(late: str) -> None:
    stamps: dict[str, Any] = {"position_ns": 10 * S, "attitude_ns": 10 * S}
    known: dict[str, Any] = {"position_ned_m": (0.0, 0.0, 0.0), "attitude": (1.0, 0.0, 0.0, 0.0)}
    now_ns = 10 * S + round(TELEMETRY_MAX_AGE_S * S)
    assert VehicleState(**stamps, **known).position_fresh(now_ns)
    assert not VehicleState(**stamps | {late: 10 * S - 1}, **known).position_fresh(now_ns)
    for missing in known:
        assert not VehicleState(**stamps, **known | {missing: None}).position_fresh(now_ns)


CHANGES = {
    "battery_fraction": st.floats(0, 1),
    "armed": st.booleans(),
    "position_ned_m": st.tuples(*[st.floats(-9, 9)] * 3),
}


@given(st.fixed_dictionaries({}, optional=CHANGES))
def test_state_with_fields_equals_a_replaced_one(changes: dict[str, Any]) -> None:
    before = VehicleState(armed=True, battery_fraction=0.5)
    assert with_fields(before, **changes) == replace(before, **changes)
    assert before == VehicleState(armed=True, battery_fraction=0.5)
