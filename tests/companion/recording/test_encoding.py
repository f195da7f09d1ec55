"""Values of guidance as JSON: exact for every float, and refused where the layout differs."""

from __future__ import annotations

import json
import math
import struct
from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.guidance.interface import Action, Arm, FindGimbal, GuidanceInput, PointGimbal, SetMode, TakeOff
from companion.recording.encoding import DecodeError, decode, dumps, encode, layout_of
from companion.vehicle.gimbal import GimbalAim
from companion.vehicle.state import FlightMode, VehicleState


@dataclass(frozen=True)
class Number:
    value: float


@dataclass(frozen=True)
class Asked:
    actions: tuple[Action, ...]


def bits(value: float) -> bytes:
    return struct.pack("<d", value)


def read_back(kind: type, value: object) -> object:
    return decode(kind, json.loads(dumps(encode(kind, value))))


@given(st.floats(allow_nan=False))
def test_float_is_read_back_bit_for_bit(value: float) -> None:
    found = read_back(Number, Number(value))
    assert isinstance(found, Number)
    assert bits(found.value) == bits(value)
    assert type(found.value) is float


def test_nan_infinity_and_whole_number_are_read_back() -> None:
    found = [read_back(Number, Number(value)) for value in (math.nan, math.inf, -math.inf, 3)]
    assert str(found) == str([Number(math.nan), Number(math.inf), Number(-math.inf), Number(3)])


@given(st.builds(VehicleState))
def test_vehicle_state_is_read_back(state: VehicleState) -> None:
    found = read_back(VehicleState, state)
    assert repr(found) == repr(state)
    assert dumps(encode(VehicleState, found)) == dumps(encode(VehicleState, state))


def test_default_input_is_read_back() -> None:
    inputs = GuidanceInput(VehicleState())
    assert repr(read_back(GuidanceInput, inputs)) == repr(inputs)


def test_union_keeps_the_class() -> None:
    asked = Asked((Arm(), FindGimbal(), SetMode(FlightMode.HOLD), TakeOff(2.5), PointGimbal(GimbalAim(-0.5))))
    assert read_back(Asked, asked) == asked


@pytest.mark.parametrize(
    "data",
    [None, [], {}, {"value": "1.0"}, {"value": None}, {"value": True}, {"value": 1.0, "more": 1}],
)
def test_other_data_is_refused(data: object) -> None:
    with pytest.raises(DecodeError):
        decode(Number, data)


def test_layout_depends_on_names_and_types() -> None:
    def made(name: str, kind: type) -> type:
        return dataclass(type("Made", (), {"__annotations__": {name: kind}, "__module__": __name__}))

    assert layout_of(made("a", int)) == layout_of(made("a", int))
    others = {layout_of(made("b", int)), layout_of(made("a", float)), layout_of(made("a", int), Number)}
    assert len(others | {layout_of(made("a", int))}) == 4


def test_type_without_encoding_is_refused() -> None:
    @dataclass(frozen=True)
    class Opaque:
        value: object

    with pytest.raises(TypeError):
        layout_of(Opaque)
