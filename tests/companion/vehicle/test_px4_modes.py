from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.vehicle.px4_modes import mode_of_custom_mode, request_of_mode
from companion.vehicle.state import FlightMode

# As a real PX4 reports them.
SHOWN = {
    0x00010000: FlightMode.MANUAL,
    0x00020000: FlightMode.ALTITUDE,
    0x00030000: FlightMode.POSITION,
    0x02030000: FlightMode.POSITION,
    0x02040000: FlightMode.TAKEOFF,
    0x03040000: FlightMode.HOLD,
    0x04040000: FlightMode.MISSION,
    0x05040000: FlightMode.RETURN,
    0x06040000: FlightMode.LAND,
    0x08040000: FlightMode.FOLLOW,
    0x09040000: FlightMode.PRECISION_LAND,
    0x00050000: FlightMode.ACRO,
    0x00060000: FlightMode.OFFBOARD,
    0x00070000: FlightMode.STABILIZED,
}


@pytest.mark.parametrize(("custom_mode", "mode"), SHOWN.items())
def test_px4_custom_modes_are_named(custom_mode: int, mode: FlightMode) -> None:
    assert mode_of_custom_mode(custom_mode) is mode


@pytest.mark.parametrize("mode", sorted(set(FlightMode) - {FlightMode.UNKNOWN}))
def test_requested_mode_round_trips(mode: FlightMode) -> None:
    main, sub = request_of_mode(mode)
    assert mode_of_custom_mode(main << 16 | sub << 24) is mode


def test_position_request_has_sub_mode_zero() -> None:
    assert request_of_mode(FlightMode.POSITION) == (3, 0)


@given(st.integers(0, 2**32 - 1))
def test_any_custom_mode_is_decoded(custom_mode: int) -> None:
    mode = mode_of_custom_mode(custom_mode)
    assert mode is FlightMode.UNKNOWN or custom_mode & 0xFFFF0000 in SHOWN or mode is FlightMode.READY
