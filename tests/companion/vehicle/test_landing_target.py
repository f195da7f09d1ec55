"""LANDING_TARGET as bytes, in the forms of PX4 and ArduPilot."""

from __future__ import annotations

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common

from companion.vehicle.landing_target import LandingTarget, landing_target_fields

PX4, ARDUPILOT = 12, 3
TARGET = LandingTarget(5_000_123_000, 7, (3.0, -1.5, 0.2), (0.5, -0.25, 4.0), 0.6)
# MAVLink 2 sorts by size: time_usec, angle_x, angle_y, distance, size_x, size_y, target_num, frame, then the
# extension x, y, z, q[4], type, position_valid.
LAYOUT = struct.Struct("<Q5f2B3f4f2B")


def payload(target: LandingTarget, autopilot: int) -> tuple[float, ...]:
    codec = common.MAVLink(None, srcSystem=1, srcComponent=191)
    packed = bytes(
        common.MAVLink_landing_target_message(**landing_target_fields(target, autopilot)).pack(codec)
    )
    length = packed[1]
    assert packed[0] == 0xFD
    assert packed[7:10] == (149).to_bytes(3, "little")
    return LAYOUT.unpack(packed[10 : 10 + length].ljust(LAYOUT.size, b"\0"))


def test_px4_gets_a_position_in_local_ned() -> None:
    time_us, *_, distance, _, _, number, frame, x, y, z, q0, q1, q2, q3, kind, valid = payload(TARGET, PX4)
    assert time_us == 5_000_123
    assert (number, frame, kind, valid) == (7, common.MAV_FRAME_LOCAL_NED, 2, 1)
    assert (x, y, z) == pytest.approx((3.0, -1.5, 0.2))
    assert (q0, q1, q2, q3) == (1, 0, 0, 0)
    assert distance == pytest.approx(math.hypot(0.5, 0.25, 4.0))


def test_ardupilot_gets_a_body_vector_and_distance() -> None:
    _, angle_x, angle_y, distance, size_x, size_y, _, frame, x, y, z, *_, valid = payload(TARGET, ARDUPILOT)
    assert (frame, valid) == (common.MAV_FRAME_BODY_FRD, 1)
    assert (x, y, z) == pytest.approx((0.5, -0.25, 4.0))
    assert distance == pytest.approx(math.hypot(x, y, z))
    assert size_x == size_y == pytest.approx(2 * math.atan(0.3 / distance))
    # From the angles ArduPilot computes (-tan y, tan x, 1): the same direction.
    assert (-math.tan(angle_y) * z, math.tan(angle_x) * z) == pytest.approx((x, y))


coordinate = st.floats(-50.0, 50.0)


@given(
    position=st.tuples(coordinate, coordinate, coordinate),
    offset=st.tuples(coordinate, coordinate, coordinate),
    size=st.floats(0.01, 5),
)
def test_any_target_is_packed_with_its_position(
    position: tuple[float, float, float], offset: tuple[float, float, float], size: float
) -> None:
    target = LandingTarget(1_000_000, 300, position, offset, size)
    px4, ardupilot = payload(target, PX4), payload(target, ARDUPILOT)
    assert px4[8:11] == pytest.approx(position, rel=1e-5, abs=1e-5)
    assert ardupilot[8:11] == pytest.approx(offset, rel=1e-5, abs=1e-5)
    assert px4[6] == 255  # the field holds no more
    assert all(math.isfinite(value) for value in (*px4, *ardupilot))
