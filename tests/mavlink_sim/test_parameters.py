"""The parameter set and MAVLink's parameter protocol."""

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
    UnknownParameterError,
    decode_wire_value,
)
from mavlink_sim.wire.messages import dialect
from tests.mavlink_sim.conftest import SimHarness


def bytewise(value: int) -> float:
    return float(struct.unpack("<f", struct.pack("<i", value))[0])


def name_of(message: Any) -> str:
    text = message.param_id
    return (text.decode() if isinstance(text, bytes) else text).rstrip("\0")


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


def test_the_list_is_alphabetical_and_begins_with_the_hash(harness: SimHarness) -> None:
    harness.fly(0.1)
    harness.forget()
    harness.send(dialect.MAVLink_param_request_list_message(1, 1))
    started = harness.now_s
    total = len(harness.vehicle.parameters)
    harness.until(lambda: len(harness.received("PARAM_VALUE")) == total + 1, 2.0)
    assert harness.now_s - started == pytest.approx(0.01 + total / 1000, abs=0.02)
    first, *rest = harness.received("PARAM_VALUE")
    assert (name_of(first), first.param_type, first.param_index) == ("_HASH_CHECK", 5, 65535)
    assert [message.param_index for message in rest] == list(range(total))
    names = [name_of(message) for message in rest]
    assert names == sorted(names)
    assert {message.param_count for message in [first, *rest]} == {total}
    assert {message.param_type for message in rest} == {INT32, REAL32}


def test_a_parameter_is_read_by_name_and_by_index(harness: SimHarness) -> None:
    harness.fly(0.1)
    by_name = read(harness, "COM_OF_LOSS_T")
    assert len(by_name) == 1
    assert (by_name[0].param_value, by_name[0].param_type) == (1.0, REAL32)
    by_index = read(harness, index=by_name[0].param_index)
    assert name_of(by_index[0]) == "COM_OF_LOSS_T"


def test_integers_travel_bytewise(harness: SimHarness) -> None:
    harness.fly(0.1)
    assert read(harness, "NAV_RCL_ACT")[0].param_value == bytewise(2)
    sent = write(harness, "NAV_RCL_ACT", bytewise(3), INT32)
    assert [message.param_value for message in sent] == [bytewise(3), bytewise(3)]
    assert harness.vehicle.parameters.number("NAV_RCL_ACT") == 3


def test_a_set_is_echoed_twice(harness: SimHarness) -> None:
    harness.fly(0.1)
    harness.forget()
    harness.send(dialect.MAVLink_param_set_message(1, 1, b"MIS_TAKEOFF_ALT", 4.0, REAL32))
    harness.fly(0.008)
    assert len(harness.received("PARAM_VALUE")) == 1
    harness.fly(0.02)
    assert [message.param_value for message in harness.received("PARAM_VALUE")] == [4.0, 4.0]


def test_px4_checks_no_range(harness: SimHarness) -> None:
    harness.fly(0.1)
    write(harness, "COM_OF_LOSS_T", 1000.0, REAL32)
    assert harness.vehicle.parameters.number("COM_OF_LOSS_T") == 1000.0


def test_an_unknown_parameter_is_answered_by_an_error(harness: SimHarness) -> None:
    harness.fly(0.1)
    for answer in (
        read(harness, "NO_SUCH"),
        read(harness, index=30000),
        write(harness, "NO_SUCH", 1.0, REAL32),
    ):
        assert [(message.get_type(), message.error) for message in answer] == [("PARAM_ERROR", 1)]


def test_the_wrong_type_is_answered_by_an_error(harness: SimHarness) -> None:
    harness.fly(0.1)
    answer = write(harness, "COM_OF_LOSS_T", 2.0, INT32)
    assert [(message.get_type(), message.error) for message in answer] == [("PARAM_ERROR", 7)]
    assert harness.vehicle.parameters.number("COM_OF_LOSS_T") == 1.0


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


def test_a_client_with_the_right_hash_stops_the_list(harness: SimHarness) -> None:
    harness.fly(0.1)
    harness.send(dialect.MAVLink_param_request_list_message(1, 1))
    harness.fly(0.05)
    write(harness, "_HASH_CHECK", 0.0, 5)
    harness.forget()
    harness.fly(1.0)
    assert harness.received("PARAM_VALUE") == []


@given(st.integers(-(2**31), 2**31 - 1))
def test_integers_exact_in_float_round_trip(value: int) -> None:
    wire = Parameter("X", INT32, value).wire_value
    pattern = struct.unpack("<I", struct.pack("<i", value))[0]
    if pattern & 0x7F800000 == 0x7F800000 and pattern & 0x7FFFFF and not pattern & 0x400000:
        return  # a signalling NaN: the processor itself alters it on its way through a float
    assert decode_wire_value(INT32, wire) == value


def test_unknown_name_raises() -> None:
    with pytest.raises(UnknownParameterError, match="no parameter 'COM_OF_LOST'"):
        Parameters({"COM_OF_LOST": 1.0})


@pytest.mark.parametrize(
    ("name", "value"), [("NAV_RCL_ACT", 1.5), ("NAV_RCL_ACT", 2**40), ("COM_OF_LOSS_T", 1e300)]
)
def test_a_value_that_the_type_cannot_hold_is_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=r"INT32|32-bit float"):
        Parameters({name: value})
