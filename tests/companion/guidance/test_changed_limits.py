"""Limits that are changed in flight: the vehicle is slowed down to them, and a replay is equal."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from companion.guidance.core import GuidanceOptions
from companion.guidance.interface import ChangedLimits, GuidanceInput
from companion.guidance.limits.envelope import Limits
from companion.logs.replay import replay
from companion.recording.encoding import DecodeError, decode, encode
from companion.vehicle.autopilot_parameters import AutopilotParameters, FirmwareVersion
from companion.vehicle.state import Vector3, VehicleState
from tests.companion.guidance.gimbal_flight import gimbal_flight, person
from tests.companion.guidance.guidance_harness import STEP_S, GuidanceHarness, known
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle
from tests.companion.recording.lockstep_recording import recording

LIMITS = Limits(max_horizontal_speed_mps=8.0, max_climb_mps=3.0, max_descend_mps=2.0)
STEP_MPS = LIMITS.max_acceleration_mps2 * STEP_S


def changed(**values: float) -> ChangedLimits:
    names = asdict(LIMITS).keys() & ChangedLimits.__slots__
    return ChangedLimits(**{name: getattr(LIMITS, name) for name in names} | values)


class Flight(GuidanceHarness):
    """A vehicle in the air, whose limits can be changed."""

    def __init__(self, height_m: float = 10.0) -> None:
        vehicle = KinematicVehicle(position=[0.0, 0.0, -height_m])
        super().__init__(vehicle, options=GuidanceOptions(LIMITS), inputs=self._changed)
        self.limits: ChangedLimits | None = None
        self.parameters: AutopilotParameters | None = None

    def _changed(self, inputs: GuidanceInput) -> GuidanceInput:
        inputs = replace(inputs, limits=self.limits)
        return inputs if self.parameters is None else replace(inputs, parameters=self.parameters)

    @property
    def sent(self) -> list[Vector3]:
        """All sent velocities."""
        return [
            known(output.setpoint.velocity_ned_mps)
            for output in self.outputs
            if output.setpoint is not None and output.setpoint.velocity_ned_mps is not None
        ]

    def fly(self, command: str, until: Callable[[], bool]) -> None:
        self.command(command)
        self.until(until)

    def assert_no_jump(self) -> None:
        """The velocity was never reduced by more than the acceleration, each axis for itself."""
        for before, after in zip(self.sent, self.sent[1:], strict=False):
            over_ground = math.hypot(*after[:2]) - math.hypot(*before[:2])
            assert abs(over_ground) <= STEP_MPS + 1e-6, (before, after)
            assert abs(after[2] - before[2]) <= STEP_MPS + 1e-6, (before, after)


def test_lower_speed_is_reached_with_the_maximum_acceleration() -> None:
    flight = Flight()
    flight.fly("goto north=150 east=0 speed=8", lambda: flight.vehicle.velocity[0] > 7.5)
    flight.limits = changed(max_horizontal_speed_mps=2.0)
    flight.run(1.0)
    assert flight.sent[-1][0] == pytest.approx(5.0, abs=0.2)
    flight.run(1.5)
    assert flight.sent[-1][0] == pytest.approx(2.0)
    flight.run(5.0)
    assert max(north for north, _, _ in flight.sent[-100:]) <= 2.0 + 1e-9
    flight.assert_no_jump()


@pytest.mark.parametrize(
    ("command", "name", "value"),
    [
        ("goto north=1 east=0 altitude=45 speed=8", "max_climb_mps", 0.5),
        ("goto north=1 east=0 altitude=2 speed=8", "max_descend_mps", 0.4),
    ],
)
def test_lower_vertical_speed_is_reached_without_a_jump(command: str, name: str, value: float) -> None:
    flight = Flight(height_m=25.0)
    flight.fly(command, lambda: abs(flight.vehicle.velocity[2]) > 1.7)
    flight.limits = changed(**{name: value})
    flight.run(3.0)
    assert abs(flight.sent[-1][2]) == pytest.approx(value)
    flight.assert_no_jump()


def test_altitude_lowered_below_the_vehicle_stops_its_climb() -> None:
    flight = Flight()
    flight.fly("goto north=1 east=0 altitude=45 speed=8", lambda: flight.vehicle.velocity[2] < -2.5)
    height_m = -flight.vehicle.position[2]
    flight.limits = changed(max_altitude_m=height_m - 2.0)
    flight.run(10.0)
    assert flight.sent[-1][2] == 0.0
    # Its stopping distance at the maximum acceleration, and its lag.
    assert -flight.vehicle.position[2] < height_m + 3.0**2 / 6.0 + 1.5
    flight.assert_no_jump()
    refused = flight.command("goto north=5 east=0 altitude=45")
    flight.run()
    assert not refused.result().success


def test_lower_altitude_ahead_is_held() -> None:
    flight = Flight()
    flight.fly("goto north=1 east=0 altitude=45 speed=8", lambda: flight.vehicle.velocity[2] < -2.5)
    flight.limits = changed(max_altitude_m=20.0)
    flight.run(15.0)
    assert -flight.vehicle.position[2] == pytest.approx(20.0, abs=0.2)
    flight.assert_no_jump()


def test_minimum_altitude_raised_above_the_vehicle_stops_its_descent() -> None:
    flight = Flight(height_m=25.0)
    flight.fly("goto north=1 east=0 altitude=2 speed=8", lambda: flight.vehicle.velocity[2] > 1.7)
    height_m = -flight.vehicle.position[2]
    flight.limits = changed(min_altitude_m=height_m + 3.0)
    flight.run(10.0)
    assert flight.sent[-1][2] == 0.0
    assert -flight.vehicle.position[2] > height_m - 2.0
    flight.assert_no_jump()


def test_distance_lowered_below_the_vehicles_stops_it() -> None:
    flight = Flight()
    flight.fly("goto north=150 east=0 speed=8", lambda: flight.vehicle.position[0] > 50.0)
    flight.limits = changed(max_distance_m=30.0)
    flight.run(10.0)
    assert flight.sent[-1][0] == pytest.approx(0.0, abs=1e-6)
    assert flight.vehicle.position[0] < 50.0 + 8.0**2 / 6.0 + 5.0
    flight.assert_no_jump()


def test_autopilots_lower_limit_still_applies() -> None:
    flight = Flight()
    flight.parameters = AutopilotParameters("PX4", FirmwareVersion(1, 16), 1, (("MPC_XY_VEL_MAX", 3.0),))
    flight.run(1.0)
    for limit_mps, used_mps in ((6.0, 3.0), (2.0, 2.0), (8.0, 3.0)):
        flight.limits = changed(max_horizontal_speed_mps=limit_mps)
        flight.run()
        assert flight.guidance.setpoints.limits.max_horizontal_speed_mps == used_mps
    said = [event.message for event in flight.events if "MPC_XY_VEL_MAX" in event.message]
    assert [text.rpartition("= ")[2] for text in said] == ["8", "6", "8"]


def test_flight_with_changed_limits_replays_bit_for_bit(tmp_path: Path) -> None:
    flight = gimbal_flight(person(40.0, 12.0))
    with recording(flight, tmp_path) as path:
        assert flight.fly("goto forward=60 right=0 speed=5", 4.0).moments
        flight.inputs.limits = changed(max_horizontal_speed_mps=1.5, max_altitude_m=12.0)
        slow = flight.fly("goto forward=60 right=0 speed=5", 6.0).moments[-1]
        assert math.hypot(*known(slow.sent.velocity_ned_mps)[:2]) <= 1.5 + 1e-9
    found = replay([path], {})
    assert (found.first, found.inexact, found.differing_steps) == (None, [], 0)


def test_input_without_changed_limits_is_recorded_as_before() -> None:
    plain = GuidanceInput(VehicleState())
    data = json.loads(json.dumps(encode(GuidanceInput, plain)))
    assert "limits" not in data
    assert decode(GuidanceInput, data).limits is None
    limits = changed(max_altitude_m=20.0)
    again = decode(GuidanceInput, encode(GuidanceInput, replace(plain, limits=limits)))
    assert again.limits == limits
    with pytest.raises(DecodeError):
        decode(GuidanceInput, data | {"limit": None})
