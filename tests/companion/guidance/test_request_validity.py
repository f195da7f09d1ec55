"""What a command directly causes is not requested long after its reception, whatever it waited for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest

from companion.guidance.behaviour import Behaviour
from companion.guidance.core import GuidanceOptions
from companion.guidance.gimbal.controller import GimbalMounting
from companion.guidance.interface import (
    COMMAND_VALID_S,
    REQUEST_VALID_S,
    Arm,
    CommandInput,
    GuidanceInput,
    Request,
    SetMode,
    TakeOff,
)
from companion.guidance.limits.battery import BatteryMinimum
from companion.vehicle.state import FlightMode
from tests.companion.guidance.guidance_harness import (
    GuidanceHarness,
    ScriptedGimbal,
    built,
    flying,
    hovering,
    mission,
    parked,
    standing,
    with_state,
)

WAITED_S = 3.0


no_home = with_state(home_position_ned_m=None, home_altitude_amsl_m=None)
checks_run = with_state(ready_to_arm=False)


def no_frame(inputs: GuidanceInput) -> GuidanceInput:
    return replace(inputs, seen_ns=None)


def give(harness: GuidanceHarness, command: Behaviour | str, before_s: float = 0.0) -> int:
    """A command that was received so long ago; returns when."""
    behaviour, received_ns = built(command), harness.now_ns - round(before_s * 1e9)
    harness.step(CommandInput(1, behaviour.name, behaviour, received_ns=received_ns))
    return received_ns


def starts(harness: GuidanceHarness) -> list[tuple[int, Request]]:
    """End of the validity and request of everything that may start motion."""
    return [
        (request.valid_until_ns, request)
        for output in harness.outputs
        for request in output.requests
        if isinstance(request.action, Arm | TakeOff) or request.action == SetMode(FlightMode.OFFBOARD)
    ]


@pytest.mark.parametrize(
    ("text", "on_ground", "missing", "seconds"),
    [
        ("takeoff 4", True, no_home, WAITED_S),
        ("takeoff 1", True, no_home, WAITED_S),
        ("takeoff 4", True, checks_run, 2.0),
        ("approach car", False, no_frame, WAITED_S),
        ("seek car", False, no_frame, WAITED_S),
    ],
)
@pytest.mark.parametrize("before_s", [0.0, 2.0])
def test_waits_count_from_the_command_on(
    text: str,
    on_ground: bool,
    missing: Callable[[GuidanceInput], GuidanceInput],
    seconds: float,
    before_s: float,
) -> None:
    harness = GuidanceHarness(parked() if on_ground else flying(), lag_s=0.4, inputs=missing)
    harness.run(before_s + 0.5)
    received_ns = give(harness, text, before_s)
    harness.run(seconds)
    assert starts(harness) == []
    harness._inputs = lambda inputs: inputs
    harness.until(lambda: starts(harness), 5.0)
    (until_ns, _), *_ = starts(harness)
    decided_s = (harness.now_ns - received_ns) / 1e9
    expected_s = min(COMMAND_VALID_S, decided_s + REQUEST_VALID_S)
    assert (until_ns - received_ns) / 1e9 == pytest.approx(expected_s)


def test_last_request_of_a_takeoff_is_as_old_as_its_command() -> None:
    harness = standing(lag_s=2.5, inputs=no_home)  # a mode shows late
    received_ns = give(harness, "takeoff 4")
    harness.run(WAITED_S)
    harness._inputs = checks_run
    harness.until(lambda: any(isinstance(request.action, TakeOff) for _, request in starts(harness)), 20.0)
    until_ns, _ = starts(harness)[-1]
    assert harness.now_ns - received_ns > (COMMAND_VALID_S - REQUEST_VALID_S) * 1e9
    assert until_ns == received_ns + COMMAND_VALID_S * 1e9


def test_gimbal_is_waited_for_within_the_validity() -> None:
    mounting = GimbalMounting(carries_camera=True, carries_steering=True)
    harness = hovering(options=GuidanceOptions(gimbal=mounting), inputs=with_state(gimbal=None))
    harness.autopilot.gimbal = ScriptedGimbal()
    received_ns = give(harness, "seek car sweep=-60", 5.0)
    harness.run(WAITED_S)
    assert starts(harness) == []
    harness._inputs = lambda inputs: inputs
    harness.until(lambda: starts(harness), 5.0)
    (until_ns, _), *_ = starts(harness)
    assert until_ns == received_ns + COMMAND_VALID_S * 1e9


def test_later_steps_count_from_their_own_decision() -> None:
    harness = standing(lag_s=0.4)
    received_ns = give(harness, mission(harness, "takeoff 3", "hold 10", "land", "takeoff 3"))
    decided: list[tuple[int, Request]] = []

    def second_takeoff() -> bool:
        if len(decided) < (found := len(starts(harness))):
            decided.extend((harness.now_ns, request) for _, request in starts(harness)[len(decided) : found])
        return sum(isinstance(request.action, TakeOff) for _, request in decided) == 2

    harness.until(second_takeoff)
    first = [request for now_ns, request in decided if now_ns - received_ns < 3e9]
    later = [(now_ns, request) for now_ns, request in decided if now_ns - received_ns > COMMAND_VALID_S * 1e9]
    assert len(first) >= 2
    assert len(later) >= 2
    assert all(request.valid_until_ns <= received_ns + COMMAND_VALID_S * 1e9 for request in first)
    assert all(request.valid_until_ns == now_ns + REQUEST_VALID_S * 1e9 for now_ns, request in later)


@pytest.mark.parametrize("streaming", [True, False])
def test_low_battery_action_is_not_as_old_as_the_command(streaming: bool) -> None:
    options = GuidanceOptions(battery=BatteryMinimum(0.2, "land"))
    harness = hovering(lag_s=0.4, options=options)
    harness.streaming = streaming  # without it OFFBOARD is not requested yet
    received_ns = give(harness, "hold", COMMAND_VALID_S - 1.0)
    harness.autopilot.battery_fraction = 0.1
    harness.until(lambda: "land" in harness.autopilot.requests, 10.0)
    requests = [request for output in harness.outputs for request in output.requests]
    land = next(request for request in requests if request.action == SetMode(FlightMode.LAND))
    assert land.valid_until_ns > received_ns + COMMAND_VALID_S * 1e9
