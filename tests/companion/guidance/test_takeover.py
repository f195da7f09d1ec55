"""A command that takes the vehicle from a pilot or from a mission says so, in its event and in its reply."""

from __future__ import annotations

import pytest

from companion.bench.lockstep_flight import LockstepFlight
from companion.guidance.interface import EventKind
from companion.vehicle.state import FlightMode
from mavlink_sim.flight.transmitter import Sticks
from mavlink_sim.px4.modes import Mode
from tests.companion.guidance.guidance_harness import assert_failed, assert_succeeded, known
from tests.mavlink_sim.conftest import CALIBRATION


def flown_by(mode: Mode) -> LockstepFlight:
    """A vehicle in the air in a mode that somebody else has chosen."""
    flight = LockstepFlight.airborne(seed=4)
    flight.vehicle.vehicle.autopilot.pilot_takes_over(mode)
    assert flight.run_until(lambda: flight.state.mode.value == MODES[mode], 3.0)
    return flight


MODES = {Mode.POSCTL: "position", Mode.ALTCTL: "altitude", Mode.RTL: "return", Mode.HOLD: "hold"}


def takeovers(flight: LockstepFlight) -> list[str]:
    return [event.message for event in flight.events if event.kind is EventKind.NOTED]


@pytest.mark.parametrize("mode", [Mode.POSCTL, Mode.ALTCTL, Mode.RTL])
def test_command_says_from_which_mode_it_took_over(mode: Mode) -> None:
    flight = flown_by(mode)
    outcome = assert_succeeded(flight.fly("goto north=3 east=0", 40.0).outcome)
    assert outcome.reason.endswith(f" from {MODES[mode]} mode")
    assert takeovers(flight) == [f"goto took over from {MODES[mode]} mode"]


def test_endless_command_and_autopilot_mode_say_it_too() -> None:
    flight = flown_by(Mode.POSCTL)
    identifier = flight.command("hold")
    assert flight.run_until(lambda: flight.outcome(identifier), 5.0)
    outcome = known(flight.outcome(identifier))
    assert outcome.reason.endswith(" from position mode")
    flight = flown_by(Mode.POSCTL)
    outcome = assert_succeeded(flight.fly("stop", 20.0).outcome)
    assert outcome.reason.endswith(" from position mode")


def test_only_the_first_command_after_the_pilot_says_it() -> None:
    flight = flown_by(Mode.POSCTL)
    assert flight.fly("goto north=3 east=0", 40.0).outcome is not None
    outcome = known(flight.fly("goto north=0 east=0", 40.0).outcome)
    assert "took over" not in outcome.reason
    assert len(takeovers(flight)) == 1


def test_nobody_is_displaced_in_hold_or_on_the_ground() -> None:
    flight = LockstepFlight.airborne(seed=4)
    outcome = known(flight.fly("goto north=3 east=0", 40.0).outcome)
    assert "took over" not in outcome.reason
    assert takeovers(flight) == []


def test_refused_command_has_taken_nothing_over() -> None:
    flight = flown_by(Mode.POSCTL)
    outcome = assert_failed(flight.fly("goto north=3000 east=0", 5.0).outcome)
    assert "took over" not in outcome.reason
    assert flight.state.mode is FlightMode.POSITION


@pytest.mark.parametrize(
    ("release", "values", "taken_over"),
    [
        ("1.14", {}, False),
        ("1.16", {}, False),
        ("1.17", {"COM_RC_OVERRIDE": 3}, True),
        ("1.18", {}, True),
        ("1.18", {"MAN_OVERRIDE_SPD": -1}, False),
    ],
)
def test_sticks_do_in_offboard_what_the_service_says(
    release: str, values: dict[str, float], taken_over: bool
) -> None:
    parameters = {**CALIBRATION, "COM_RC_IN_MODE": 0, **values}
    flight = LockstepFlight.airborne(seed=4, px4=release, parameters=parameters)
    transmitter = flight.vehicle.vehicle.transmitter
    transmitter.on = True
    identifier = flight.command("goto north=40 east=0")
    assert flight.run_until(lambda: flight.state.mode is FlightMode.OFFBOARD, 5.0)
    for number in range(10):  # all the way in 0.5 s
        transmitter.sticks = Sticks(roll=0.1 * number)
        flight.run(0.05)
    flight.run(0.5)
    assert ("takes over from" in (flight.inputs.parameters.sticks_text or "")) is taken_over
    outcome = flight.outcome(identifier)
    assert (flight.state.mode is FlightMode.POSITION) is taken_over
    if taken_over:
        assert known(outcome).reason.startswith("the pilot took")
    else:
        assert outcome is None
