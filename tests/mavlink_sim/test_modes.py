"""The encodings of flight modes, as measured."""

import pytest

from mavlink_sim.px4.modes import Mode, base_mode, mode_of


@pytest.mark.parametrize(
    ("mode", "custom"),
    [
        (Mode.MANUAL, 0x00010000),
        (Mode.ALTCTL, 0x00020000),
        (Mode.POSCTL, 0x00030000),
        (Mode.POSITION_SLOW, 0x02030000),
        (Mode.TAKEOFF, 0x02040000),
        (Mode.HOLD, 0x03040000),
        (Mode.MISSION, 0x04040000),
        (Mode.RTL, 0x05040000),
        (Mode.LAND, 0x06040000),
        (Mode.FOLLOW, 0x08040000),
        (Mode.PRECLAND, 0x09040000),
        (Mode.ACRO, 0x00050000),
        (Mode.OFFBOARD, 0x00060000),
        (Mode.STABILIZED, 0x00070000),
    ],
)
def test_a_mode_has_px4s_custom_mode_and_is_found_by_it(mode: Mode, custom: int) -> None:
    assert mode.custom_mode == custom
    assert mode_of(custom >> 16 & 0xFF, custom >> 24) is mode


@pytest.mark.parametrize(("main", "sub"), [(8, 0), (4, 1), (4, 99), (0, 0), (10, 0), (99, 0)])
def test_modes_that_px4_refuses_are_no_modes(main: int, sub: int) -> None:
    assert mode_of(main, sub) is None


def test_an_orbit_request_shows_as_position_mode() -> None:
    assert mode_of(3, 1) is Mode.POSCTL


@pytest.mark.parametrize(
    ("mode", "armed", "has_setpoints", "expected"),
    [
        (Mode.HOLD, False, False, 29),
        (Mode.HOLD, True, False, 157),
        (Mode.RTL, True, False, 157),
        (Mode.OFFBOARD, False, True, 17),
        (Mode.OFFBOARD, True, True, 145),
        (Mode.OFFBOARD, False, False, 1),
        (Mode.POSCTL, False, False, 81),
        (Mode.MANUAL, False, True, 81),
        (Mode.ACRO, False, False, 65),
        (Mode.FOLLOW, False, False, 17),
    ],
)
def test_the_base_mode_is_as_measured(mode: Mode, armed: bool, has_setpoints: bool, expected: int) -> None:
    assert base_mode(mode, armed, has_setpoints) == expected
