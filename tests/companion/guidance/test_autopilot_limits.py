"""The autopilot's own limits of speed reduce the envelope: a slow vehicle has no other commander."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from companion.bench.lockstep_flight import LockstepFlight, plain_settings
from companion.guidance.interface import EventKind
from companion.guidance.limits.envelope import Limits, within_autopilot
from companion.vehicle.autopilot_parameters import AutopilotParameters, FirmwareVersion
from tests.companion.guidance.guidance_harness import assert_succeeded


def reading(**values: float) -> AutopilotParameters:
    return AutopilotParameters("PX4", FirmwareVersion(1, 16), 1, tuple(values.items()))


@pytest.mark.parametrize(
    ("name", "field"),
    [
        ("MPC_XY_VEL_MAX", "max_horizontal_speed_mps"),
        ("MPC_Z_VEL_MAX_UP", "max_climb_mps"),
        ("MPC_Z_VEL_MAX_DN", "max_descend_mps"),
    ],
)
def test_autopilots_lower_limit_applies(name: str, field: str) -> None:
    limits, words = within_autopilot(Limits(), reading(**{name: 0.7}))
    changes: dict[str, Any] = {field: 0.7}
    assert limits == replace(Limits(), **changes)
    assert name in words
    assert field in words


@pytest.mark.parametrize("value", [30.0, 0.0, -1.0, math.nan, math.inf])
def test_higher_and_impossible_limits_change_nothing(value: float) -> None:
    assert within_autopilot(Limits(), reading(MPC_XY_VEL_MAX=value)) == (Limits(), "")


@pytest.mark.parametrize("fastest_mps", [1.0, 1.5])
def test_vehicle_slower_than_commanded_is_no_other_commander(fastest_mps: float) -> None:
    settings = plain_settings()
    flight = LockstepFlight.airborne(seed=5, settings=settings, parameters={"MPC_XY_VEL_MAX": fastest_mps})
    log = flight.fly("goto north=30 east=0 speed=4", 90.0)
    assert_succeeded(log.outcome)
    assert flight.guidance.setpoints.limits.max_horizontal_speed_mps == fastest_mps
    for moment in log.moments:
        north, east, _ = moment.sent.velocity_ned_mps or (0.0, 0.0, 0.0)
        assert math.hypot(north, east) <= fastest_mps + 1e-9
    said = [event.message for event in flight.events if event.kind is EventKind.NOTED]
    assert len([text for text in said if "MPC_XY_VEL_MAX" in text]) == 1
