"""The parameter set and MAVLink's parameter protocol."""

import pickle
import struct
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavlink_sim.px4.parameters import (
    INT32,
    REAL32,
    Parameter,
    Parameters,
    decode_wire_value,
)
from mavlink_sim.vehicles.ardupilot.parameters import CopterParameters
from mavlink_sim.wire.messages import dialect
from tests.mavlink_sim.conftest import SimHarness


def bytewise(value: int) -> float:
    return float(struct.unpack("<f", struct.pack("<i", value))[0])


def read(harness: SimHarness, name: str = "", index: int = -1) -> list[Any]:
    harness.forget()
    harness.send(dialect.MAVLink_param_request_read_message(1, 1, name.encode(), index))
    harness.fly(0.05)
    return [*harness.received("PARAM_VALUE"), *harness.received("PARAM_ERROR")]


def write(harness: SimHarness, name: str, value: float, kind: int) -> list[Any]:
    harness.forget()
    harness.send(dialect.MAVLink_param_set_message(1, 1, name.encode(), value, kind))
    harness.fly(0.05)
    return [*harness.received("PARAM_VALUE"), *harness.received("PARAM_ERROR")]


def test_integers_travel_bytewise(harness: SimHarness) -> None:
    harness.fly(0.1)
    assert read(harness, "NAV_RCL_ACT")[0].param_value == bytewise(2)
    sent = write(harness, "NAV_RCL_ACT", bytewise(3), INT32)
    assert [message.param_value for message in sent] == [bytewise(3), bytewise(3)]
    assert harness.vehicle.parameters.number("NAV_RCL_ACT") == 3


def test_non_finite_value_refused_with_old_value(harness: SimHarness) -> None:
    harness.fly(0.1)
    answer = write(harness, "COM_OF_LOSS_T", float("nan"), REAL32)
    assert [message.param_value for message in answer] == [1.0]


def test_the_hash_changes_with_a_value_and_comes_back_with_it(harness: SimHarness) -> None:
    harness.fly(0.1)
    before = read(harness, "_HASH_CHECK")[0].param_value
    write(harness, "MIS_TAKEOFF_ALT", 4.0, REAL32)
    assert read(harness, "_HASH_CHECK")[0].param_value != before
    write(harness, "MIS_TAKEOFF_ALT", 2.5, REAL32)
    assert read(harness, "_HASH_CHECK")[0].param_value == before


@given(st.integers(-(2**31), 2**31 - 1))
def test_integers_exact_in_float_round_trip(value: int) -> None:
    wire = Parameter("X", INT32, value).wire_value
    pattern = struct.unpack("<I", struct.pack("<i", value))[0]
    if pattern & 0x7F800000 == 0x7F800000 and pattern & 0x7FFFFF and not pattern & 0x400000:
        return  # a signalling NaN: the processor itself alters it on its way through a float
    assert decode_wire_value(INT32, wire) == value


@pytest.mark.parametrize(("kind", "name"), [(Parameters, "MPC_XY_P"), (CopterParameters, "WPNAV_SPEED")])
def test_copy_has_values_and_shares_the_defaults(kind: type[Parameters], name: str) -> None:
    first = kind(gimbal=True)
    first.use("MIS_DIST_1WP")
    default = first.number(name)
    first.set(name, 2.0)
    stored = pickle.dumps(first)
    assert len(stored) < 10_000
    second = pickle.loads(stored)
    assert list(second) == list(first)
    assert [second.index(item.name) for item in second] == list(range(len(first)))
    assert (second.revision, second.hash()) == (first.revision, first.hash())
    assert second.customised() == first.customised()
    first.set(name, 3.0)
    assert second.number(name) == 2.0
    second.reset()
    assert second.number(name) == default
