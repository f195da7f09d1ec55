"""Guidance core: engaging, replacing and ending behaviours."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest

from companion.guidance.behaviour import Behaviour, BehaviourContext, BehaviourOutput, Outcome
from companion.guidance.behaviours.hold import HoldBehaviour
from companion.guidance.gimbal.controller import ENDING
from companion.guidance.interface import EventKind
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode
from tests.companion.guidance.guidance_harness import (
    STEP_S,
    GuidanceHarness,
    ScriptedGimbal,
    assert_failed,
    assert_succeeded,
    engaged,
    flying,
    hovering,
    kinds,
    known,
    parked,
)


@pytest.mark.parametrize("lag_s", [0.0, 0.05, 1.0])
def test_setpoints_are_sent_before_offboard_is_requested(lag_s: float) -> None:
    harness = hovering(lag_s=lag_s)
    harness.command("hold")
    assert harness.guidance.status.endswith("engaging offboard")
    harness.until(lambda: "offboard" in harness.autopilot.requests, 5.0)
    assert len(harness.autopilot.setpoints) >= 2
    harness.until(lambda: harness.guidance.phase == "offboard", 5.0)
    harness.run(3.0)
    assert kinds(harness) == [EventKind.STARTED, EventKind.ENGAGED]
    assert math.dist(harness.vehicle.position, (0, 0, -5)) < 0.05
    assert "arm" not in harness.autopilot.requests


def test_hold_follows_a_behaviour_until_the_next_command() -> None:
    harness = GuidanceHarness(flying())
    future = engaged(harness, "hold 1")
    assert (harness.outcome(future)).success
    sent = len(harness.autopilot.setpoints)
    harness.run(2.0)
    assert len(harness.autopilot.setpoints) >= sent + round(2.0 / STEP_S) - 1
    assert known(harness.guidance.behaviour).name == "hold"
    assert not harness.guidance.busy
    assert "no command" in harness.guidance.status


def test_new_command_replaces_behaviour_within_offboard() -> None:
    harness = GuidanceHarness(flying())
    future = engaged(harness)
    second = harness.command("orbit")
    assert_failed(future.result(), "replaced by ", " orbit")
    harness.run(3.0)
    assert harness.autopilot.requests.count("offboard") == 1
    assert not second.done()
    assert math.hypot(*harness.vehicle.velocity) > 1.0


@pytest.mark.parametrize("lag_s", [0.0, 1.0])
@pytest.mark.parametrize("mode", [FlightMode.HOLD, FlightMode.OFFBOARD])
def test_takeoff_arms_climbs_and_ends_in_autopilot_hold(mode: FlightMode, lag_s: float) -> None:
    harness = GuidanceHarness(parked(mode), lag_s)
    harness.run(1.2)
    assert harness.autopilot.requests == []
    assert_succeeded(harness.outcome(harness.command("takeoff 5")))
    assert harness.autopilot.requests[-2:] == ["arm", "takeoff 5"]
    harness.run(2.0)
    assert harness.autopilot.setpoints == []
    assert not harness.guidance.in_command


def test_takeoff_that_px4_ends_short_is_completed() -> None:
    harness = GuidanceHarness(parked())
    harness.autopilot.takeoff_short_m = 0.6
    harness.run(0.2)
    assert_succeeded(harness.outcome(harness.command("takeoff 2.5")))
    assert "offboard" in harness.autopilot.requests
    harness.run(5.0)
    assert harness.vehicle.position[2] == pytest.approx(-2.5, abs=0.45)
    assert harness.guidance.phase == "offboard"


@pytest.mark.parametrize("lag_s", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("command", ["land", "rtl", "stop"])
def test_command_that_ends_the_flight_hands_over_silently(command: str, lag_s: float) -> None:
    harness = GuidanceHarness(flying(), lag_s)
    replaced = engaged(harness)
    assert_succeeded(harness.outcome(harness.command(command)), *(["disarmed"] if command != "stop" else []))
    assert_failed(replaced.result(), "replaced by ", f" {command}")
    assert harness.autopilot.state.armed is (command == "stop")
    assert harness.silent(2.0)
    assert not harness.guidance.in_command
    assert harness.guidance.status == "not in command"
    assert EventKind.LOST not in kinds(harness)


def test_brake_is_sent_while_leaving_offboard() -> None:
    harness = GuidanceHarness(flying(), lag_s=0.8)
    engaged(harness, "orbit speed=3")
    harness.command("land")
    harness.run(0.4)
    assert harness.autopilot.setpoints[-1].velocity_ned_mps == (0.0, 0.0, 0.0)
    assert not harness.autopilot.setpoints[-1].expired(harness.vehicle.now_ns)


def test_landing_replaced_before_it_shows_is_reverted() -> None:
    harness = GuidanceHarness(flying(), lag_s=1.0)
    engaged(harness)
    harness.command("land")
    harness.run(0.3)
    future = harness.command("hold")
    harness.until(lambda: harness.guidance.phase == "offboard", 5.0)
    harness.run(3.0)
    assert not future.done()
    assert harness.autopilot.state.mode is FlightMode.OFFBOARD
    assert EventKind.LOST not in kinds(harness)


class Curious(Behaviour):
    name = "curious"
    requirements = frozenset()

    def __init__(self) -> None:
        self.seen: list[tuple[float, Setpoint | None]] = []
        self.deactivated = 0

    def update(self, dt_s: float, context: BehaviourContext) -> Setpoint:
        self.seen.append((dt_s, context.sent))
        return Setpoint.velocity((9.0, 0.0, 0.0), context.now_ns)

    def on_deactivate(self) -> None:
        self.deactivated += 1


def faulty(hook: str, broken: Callable[[Curious], bool] = lambda behaviour: True) -> Curious:
    """A behaviour whose hook raises while it is broken."""
    plain: Any = getattr(Curious, hook)
    is_property = isinstance(plain, property)

    def failing(self: Curious, *given: Any) -> Any:
        if broken(self):
            raise ZeroDivisionError("a bug")
        return plain.fget(self) if is_property else plain(self, *given)

    kind: type[Curious] = type("Faulty", (Curious,), {hook: property(failing) if is_property else failing})
    return kind()


HOOKS = ("on_activate", "update", "take_notes", "active", "landing", "gimbal_aim", "landing_target")


@pytest.mark.parametrize(("hook", "steps"), [*((hook, 0) for hook in HOOKS), ("update", 20)])
def test_exception_in_any_hook_ends_it_and_holds(
    hook: str, steps: int, caplog: pytest.LogCaptureFixture
) -> None:
    harness = GuidanceHarness(flying())
    engaged(harness)
    behaviour = faulty(hook, lambda behaviour: len(behaviour.seen) >= steps)
    outcome = harness.outcome(harness.command(behaviour), 5.0)
    assert_failed(outcome, "curious", "ZeroDivisionError: a bug")
    assert "Traceback" in caplog.text
    assert behaviour.deactivated == 1
    harness.run(2.0)
    assert harness.guidance.phase == "offboard"
    assert isinstance(harness.guidance.behaviour, HoldBehaviour)
    assert harness.outputs[-1].setpoint is not None
    assert math.hypot(*harness.vehicle.velocity) < 0.1


def test_a_gimbal_controller_that_fails_is_logged_once(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    harness = GuidanceHarness(flying())
    harness.autopilot.gimbal = ScriptedGimbal()
    engaged(harness)
    for times in (1, 2):
        with monkeypatch.context() as patch:
            patch.setattr(harness.guidance.gimbal, "update", lambda *_: 1 / 0)
            harness.run(1.0)
        assert len(caplog.records) == times
        harness.run(0.1)


@pytest.mark.parametrize("idle", [True, False])
def test_update_that_returns_nothing_ends_it(idle: bool) -> None:
    harness = GuidanceHarness(flying())
    if not idle:
        engaged(harness)
    kind = type("Forgetful", (Curious,), {"update": lambda *_: None})
    assert_failed(harness.outcome(harness.command(kind()), 5.0), "TypeError")
    harness.run(1.0)
    assert harness.guidance.phase == ("idle" if idle else "offboard")


def test_pilot_wins_while_a_hook_raises() -> None:
    harness = GuidanceHarness(flying())
    pending = engaged(
        harness, faulty("active", lambda _: harness.autopilot.state.mode is FlightMode.POSITION)
    )
    harness.autopilot.change_mode(FlightMode.POSITION)
    assert_failed(harness.outcome(pending, 2.0))
    assert harness.silent(1.0)
    assert harness.guidance.phase == "idle"


def test_exception_with_the_answer_does_not_lose_it() -> None:
    """OFFBOARD is answered in the same step in which a hook raises: the hold that follows is flown."""
    harness = hovering()
    behaviour = faulty("active", lambda _: harness.guidance.phase == "offboard")
    assert_failed(harness.outcome(harness.command(behaviour), 5.0))
    harness.run(1.0)
    assert harness.guidance.phase == "offboard"
    assert harness.outcome(harness.command("hold 0.5"), 5.0).success


def test_exception_in_the_status_shows_the_name_instead() -> None:
    harness = GuidanceHarness(flying())
    engaged(harness, faulty("status"))
    assert harness.guidance.status == "curious"


@dataclass(frozen=True)
class Steady(Behaviour):
    name = "steady"

    def update(self, dt_s: float, context: BehaviourContext) -> Setpoint:
        return Setpoint.velocity((1.0, 0.0, 0.0), context.now_ns)


def test_behaviour_may_be_a_frozen_dataclass() -> None:
    harness = GuidanceHarness(flying())
    harness.command(Steady())
    harness.run(1.0)
    assert harness.guidance.behaviour == Steady()


def test_sent_setpoint_is_passed_to_the_behaviour() -> None:
    harness = GuidanceHarness(flying())
    behaviour = Curious()
    engaged(harness, behaviour)
    harness.run(5.0)
    assert known(harness.guidance.setpoints.asked).velocity_ned_mps == pytest.approx(
        (9.0, 0.0, 0.0), abs=1e-3
    )
    assert known(harness.guidance.setpoints.sent).velocity_ned_mps == pytest.approx((5.0, 0.0, 0.0))
    assert harness.guidance.setpoints.limited_by
    dt_s, sent = behaviour.seen[-1]
    assert dt_s == pytest.approx(STEP_S)
    assert known(sent).velocity_ned_mps == pytest.approx((5.0, 0.0, 0.0))


def test_closing_ends_behaviour_and_stream() -> None:
    harness = GuidanceHarness(flying())
    future = engaged(harness)
    harness.close()
    assert future.result() == Outcome(False, ENDING)
    assert "service" in ENDING
    assert harness.silent(0.5)
    assert harness.step(ending=True).released


class Stops(HoldBehaviour):
    """Ends at once with a goal to hold."""

    name = "stops"

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        return Outcome(True, "there", (1.0, 0.5, -5.0)) if dt_s else super().update(dt_s, context)


def test_following_hold_keeps_the_goal_of_the_behaviour() -> None:
    harness = hovering()
    harness.vehicle.position[0] = 0.6
    assert harness.outcome(harness.command(Stops()), 5.0).success
    harness.run(6.0)
    assert math.dist(harness.vehicle.position, (1.0, 0.5, -5.0)) < 0.1
    # An operator's hold keeps it too; a pilot's mode change discards it.
    harness.command("hold")
    harness.run(3.0)
    assert math.dist(harness.vehicle.position, (1.0, 0.5, -5.0)) < 0.1
    harness.autopilot.change_mode(FlightMode.POSITION)
    harness.run(0.5)
    harness.vehicle.position[1] = 0.0
    harness.command("hold")
    harness.run(5.0)
    assert abs(harness.vehicle.position[1]) < 0.1
