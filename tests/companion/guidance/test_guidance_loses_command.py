"""Loss of command: pilot, autopilot, lost link, paused loop."""

from collections.abc import Callable

import pytest

from companion.guidance.interface import EventKind
from companion.vehicle.state import FlightMode
from tests.companion.guidance.guidance_harness import (
    GuidanceHarness,
    assert_failed,
    assert_succeeded,
    engaged,
    flying,
    hovering,
    kinds,
    known,
    standing,
)

Change = Callable[[GuidanceHarness], None]


@pytest.mark.parametrize("lag_s", [0.0, 1.0])
@pytest.mark.parametrize("mode", ["position", "altitude", "hold", "land", "return", "mission"])
def test_foreign_mode_ends_command_permanently(mode: str, lag_s: float) -> None:
    harness = GuidanceHarness(flying(), lag_s)
    pending = engaged(harness, "orbit")
    harness.autopilot.change_mode(FlightMode(mode))
    harness.until(lambda: harness.autopilot.state.mode == mode, 2.0)
    assert_failed(pending.result(), "the pilot took over", f"{mode} mode")
    assert kinds(harness)[-1] is EventKind.LOST
    assert harness.silent(2.0)
    harness.autopilot.change_mode(FlightMode.OFFBOARD)  # PX4 does this when setpoints come back
    assert harness.silent(3.0)
    assert not harness.guidance.in_command
    assert harness.guidance.setpoints.sent is None
    # Only an operator's command resumes.
    harness.autopilot.change_mode(FlightMode.POSITION)
    harness.run(1.2)
    harness.command("hold")
    harness.until(lambda: harness.guidance.phase == "offboard", 5.0)
    assert not harness.silent(0.1)


def failsafe(harness: GuidanceHarness) -> None:
    harness.autopilot.failsafe = True
    harness.autopilot.change_mode(FlightMode.RETURN)


def interrupted_stream(harness: GuidanceHarness) -> None:
    harness.streaming = False
    harness.run(1.5)
    harness.streaming = True


def nothing(harness: GuidanceHarness) -> None:
    """It lasts."""


# What ends the command, words of the reason, and the end of that, which does not resume it.
LOSSES: dict[str, tuple[Change, tuple[str, ...], Change]] = {
    "failsafe": (failsafe, ("autopilot failsafe", "return mode"), nothing),
    # The loop pauses; the vehicle flies on, and its failsafe is not known here yet.
    "paused loop": (lambda harness: harness.autopilot.step(2.0), ("paused for 2.0",), nothing),
    "interrupted stream": (interrupted_stream, ("stream interrupted",), nothing),
    "lost link": (
        lambda harness: setattr(harness.autopilot, "linked", False),
        (),
        lambda harness: setattr(harness.autopilot, "linked", True),
    ),
    "lost position": (
        lambda harness: setattr(harness.autopilot, "position_alive", False),
        ("position",),
        lambda harness: setattr(harness.autopilot, "position_alive", True),
    ),
}


@pytest.mark.parametrize("what", LOSSES)
def test_lost_command_resumes_by_an_operator_alone(what: str) -> None:
    begin, words, end = LOSSES[what]
    harness = GuidanceHarness(flying())
    pending = engaged(harness, "orbit")
    begin(harness)
    if what == "lost position":
        harness.run(1.0)
        assert harness.autopilot.setpoints[-1].velocity_ned_mps == (0.0, 0.0, 0.0)
    assert_failed(harness.outcome(pending, 10.0), *words)
    assert harness.silent(1.0)
    end(harness)
    assert harness.silent(3.0)
    harness.command("hold")
    harness.until(lambda: harness.guidance.phase == "offboard", 5.0)


@pytest.mark.parametrize(
    ("command", "begun", "mode"),
    [
        ("hold", lambda harness: "offboard" in harness.autopilot.requests, "position"),
        ("takeoff 10", lambda harness: harness.vehicle.position[2] < -3.0, "hold"),
    ],
    ids=["while OFFBOARD is requested", "in a take-off"],
)
def test_pilot_wins_before_a_setpoint_is_flown(
    command: str, begun: Callable[[GuidanceHarness], bool], mode: str
) -> None:
    harness = standing() if command.startswith("takeoff") else hovering(lag_s=1.0)
    pending = harness.command(command)
    harness.until(lambda: begun(harness))
    harness.autopilot.change_mode(FlightMode(mode))
    assert_failed(harness.outcome(pending, 5.0), "the pilot", f"{mode} mode")
    assert harness.silent(3.0)
    assert (harness.autopilot.setpoints == []) is command.startswith("takeoff")


def test_idle_hold_yields_to_the_pilot() -> None:
    harness = GuidanceHarness(flying())
    assert_succeeded(harness.outcome(engaged(harness, "hold 1")))
    harness.run(1.0)
    assert known(harness.streamer.last_sent).yaw_rad is not None  # a hold's; a brake has a yaw rate
    harness.autopilot.change_mode(FlightMode.POSITION)
    harness.run(0.04)
    assert harness.silent(1.0)
    assert harness.events[-1].kind is EventKind.LOST


def test_stopped_streamer_ends_command() -> None:
    harness = hovering()
    harness.streaming = False
    assert_failed(harness.outcome(harness.command("hold"), 10.0), "offboard ", "no setpoint sent")
