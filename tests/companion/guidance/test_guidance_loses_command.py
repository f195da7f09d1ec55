"""Loss of command: pilot, autopilot, lost link, paused loop."""

import pytest

from companion.guidance.behaviours.hold import HoldBehaviour
from companion.guidance.behaviours.orbit import Orbit, OrbitBehaviour
from companion.guidance.behaviours.takeoff import TakeoffBehaviour
from companion.guidance.interface import EventKind
from companion.vehicle.state import FlightMode
from tests.companion.guidance.guidance_harness import (
    GuidanceHarness,
    assert_failed,
    engaged,
    flying,
    kinds,
    parked,
)

OTHER_MODES = [
    FlightMode.POSITION,
    FlightMode.ALTITUDE,
    FlightMode.HOLD,
    FlightMode.LAND,
    FlightMode.RETURN,
    FlightMode.MISSION,
]


@pytest.mark.parametrize("lag_s", [0.0, 1.0])
@pytest.mark.parametrize("mode", OTHER_MODES)
def test_foreign_mode_ends_command_permanently(mode: FlightMode, lag_s: float) -> None:
    harness = GuidanceHarness(flying(), lag_s)
    future = engaged(harness, OrbitBehaviour(Orbit()))
    harness.autopilot.change_mode(mode)
    harness.until(lambda: harness.autopilot.state.mode is mode, 2.0)
    sent = len(harness.autopilot.setpoints)
    outcome = future.result()
    assert_failed(outcome, "pilot", f"{mode.value} mode")
    assert kinds(harness)[-1] is EventKind.LOST
    harness.run(2.0)
    harness.autopilot.change_mode(FlightMode.OFFBOARD)  # PX4 does this when setpoints come back
    harness.run(3.0)
    assert len(harness.autopilot.setpoints) == sent
    assert not harness.guidance.in_command
    assert harness.guidance.setpoints.sent is None
    # Only an operator's command resumes.
    harness.autopilot.change_mode(FlightMode.POSITION)
    harness.run(1.2)
    harness.command(HoldBehaviour())
    harness.until(lambda: harness.guidance.phase == "offboard", 5.0)
    assert len(harness.autopilot.setpoints) > sent


def test_pilot_wins_while_offboard_is_requested() -> None:
    harness = GuidanceHarness(flying(), lag_s=1.0)
    harness.run(1.2)
    future = harness.command(HoldBehaviour())
    harness.until(lambda: "offboard" in harness.autopilot.requests, 2.0)
    harness.autopilot.change_mode(FlightMode.POSITION)
    outcome = harness.outcome(future, 5.0)
    assert_failed(outcome, "pilot", "position mode")
    sent = len(harness.autopilot.setpoints)
    harness.run(3.0)
    assert len(harness.autopilot.setpoints) == sent


def test_idle_hold_yields_to_the_pilot() -> None:
    harness = GuidanceHarness(flying())
    future = engaged(harness, HoldBehaviour(duration_s=1.0))
    assert (harness.outcome(future)).success
    harness.run(1.0)
    assert harness.streamer.last_sent is not None
    assert harness.streamer.last_sent.yaw_rad is not None  # a hold's; a brake has a yaw rate
    harness.autopilot.change_mode(FlightMode.POSITION)
    harness.run(0.04)
    sent = len(harness.autopilot.setpoints)
    harness.run(1.0)
    assert len(harness.autopilot.setpoints) == sent
    assert harness.events[-1].kind is EventKind.LOST


def test_pilot_wins_during_takeoff() -> None:
    harness = GuidanceHarness(parked())
    harness.run(0.2)
    future = harness.command(TakeoffBehaviour(10.0))
    harness.until(lambda: harness.vehicle.position[2] < -3.0)
    harness.autopilot.change_mode(FlightMode.HOLD)
    outcome = harness.outcome(future, 2.0)
    assert_failed(outcome, "pilot", "hold mode")
    assert harness.autopilot.setpoints == []


def test_stopped_streamer_ends_command() -> None:
    harness = GuidanceHarness(flying())
    harness.streaming = False
    harness.run(0.1)
    outcome = harness.outcome(harness.command(HoldBehaviour()), 10.0)
    assert_failed(outcome, "offboard ", "no setpoint sent")


def test_autopilot_failsafe_ends_command() -> None:
    harness = GuidanceHarness(flying())
    future = engaged(harness)
    harness.autopilot.failsafe = True
    harness.autopilot.change_mode(FlightMode.RETURN)
    harness.run(0.04)
    assert_failed(future.result(), "autopilot failsafe", "return mode")
    # An operator can take it back out of the failsafe.
    harness.command(HoldBehaviour())
    harness.until(lambda: harness.guidance.phase == "offboard", 5.0)


def test_paused_loop_gives_up_command() -> None:
    harness = GuidanceHarness(flying())
    future = engaged(harness)
    sent = len(harness.autopilot.setpoints)
    # The loop pauses; the vehicle flies on, and its failsafe is not known here yet.
    harness.autopilot.step(2.0)
    harness.run(1.0)
    assert "paused for 2.0" in future.result().reason
    assert len(harness.autopilot.setpoints) == sent
    harness.command(HoldBehaviour())
    harness.until(lambda: harness.guidance.phase == "offboard", 5.0)


def test_lost_link_ends_command_without_resuming() -> None:
    harness = GuidanceHarness(flying())
    future = engaged(harness)
    harness.autopilot.linked = False
    harness.autopilot.position_alive = True
    assert_failed(harness.outcome(future, 10.0))
    sent = len(harness.autopilot.setpoints)
    harness.autopilot.linked = True
    harness.run(3.0)
    assert len(harness.autopilot.setpoints) == sent


def test_lost_position_brakes_then_gives_up_command() -> None:
    harness = GuidanceHarness(flying())
    future = engaged(harness, OrbitBehaviour(Orbit()))
    harness.autopilot.position_alive = False
    harness.run(1.0)
    assert harness.autopilot.setpoints[-1].velocity_ned_mps == (0.0, 0.0, 0.0)
    outcome = harness.outcome(future, 5.0)
    assert "position" in outcome.reason
    sent = len(harness.autopilot.setpoints)
    harness.run(1.0)
    assert len(harness.autopilot.setpoints) == sent


def test_interrupted_stream_ends_command() -> None:
    harness = GuidanceHarness(flying())
    future = engaged(harness)
    harness.streaming = False
    harness.run(1.5)
    harness.streaming = True
    harness.run(0.1)
    assert_failed(future.result(), "stream interrupted")
