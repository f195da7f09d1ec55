"""Gimbal requirements of a seek with a sweep, and failures during it."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from companion.guidance.behaviour import Behaviour, BehaviourContext, GimbalStatus, Outcome
from companion.guidance.behaviours.approach import Approach, ApproachBehaviour
from companion.guidance.behaviours.gimbal_pointing import PointGimbalBehaviour
from companion.guidance.behaviours.hold import HoldBehaviour
from companion.guidance.behaviours.seek import Seek, SeekBehaviour
from companion.guidance.core import GuidanceOptions
from companion.guidance.gimbal.controller import GimbalMounting
from companion.guidance.gimbal.pitch import GimbalSweep
from companion.guidance.objects.tracked_object import Subject
from companion.guidance.requirements import check_requirements
from companion.vehicle.gimbal import CONTROL_MAX_AGE_S, NOBODY, GimbalAim, GimbalState
from tests.companion.guidance.guidance_harness import (
    GuidanceHarness,
    ScriptedGimbal,
    assert_failed,
    assert_succeeded,
    engaged,
    flying,
    known,
)
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle
from vision.attitude import quaternion_from_euler

CARRIED = GimbalStatus(carries_camera=True)
FIELD_RAD = math.radians(80.0)


def sweep(end_deg: float = -60.0, rate_dps: float = 20.0) -> GimbalSweep:
    return GimbalSweep(math.radians(end_deg), math.radians(rate_dps), FIELD_RAD)


def seek() -> SeekBehaviour:
    return SeekBehaviour(Seek("car"), sweep=sweep())


def gimbal(now_ns: int, pitch_deg: float = 0.0, **changes: Any) -> GimbalState:
    attitude = quaternion_from_euler(0.0, math.radians(pitch_deg), 0.0)
    low, high = math.radians(-90.0), math.radians(30.0)
    known = GimbalState(1, now_ns, now_ns, now_ns, attitude, primary_control=NOBODY)
    return replace(replace(known, lowest_pitch_rad=low, highest_pitch_rad=high), **changes)


def context(gimbal_state: GimbalState | None, status: GimbalStatus = CARRIED) -> BehaviourContext:
    vehicle = KinematicVehicle()
    state = replace(vehicle.state, gimbal=gimbal_state)
    return BehaviourContext(vehicle.now_ns, state, (), 0.05, not status.direction_fault, gimbal=status)


NOW_NS = KinematicVehicle().now_ns


LATE_NS = NOW_NS - round((CONTROL_MAX_AGE_S + 0.1) * 1e9)
MISSING = {
    "none": (None, CARRIED, "not responding"),
    "silent": (gimbal(NOW_NS - 2_000_000_000), CARRIED, "2.0 s old"),
    "too short": (gimbal(NOW_NS, lowest_pitch_rad=math.radians(-30.0)), CARRIED, "-30° to 30°"),
    "another's": (gimbal(NOW_NS), replace(CARRIED, controlled_by="245/190"), "245/190 has it"),
    "owner unknown": (gimbal(NOW_NS, primary_control=None), CARRIED, "primary control"),
    "owner outdated": (gimbal(NOW_NS, status_ns=LATE_NS), CARRIED, "primary control"),
    "no camera": (gimbal(NOW_NS), GimbalStatus(), "camera.on_gimbal"),
}


@pytest.mark.parametrize(("gimbal_state", "status", "words"), MISSING.values(), ids=MISSING)
def test_missing_gimbal_requirements_are_named(
    gimbal_state: GimbalState | None, status: GimbalStatus, words: str
) -> None:
    why = known(check_requirements(seek(), context(gimbal_state, status), None))
    assert words in why


def test_nothing_is_missing_and_no_sweep_needs_no_gimbal() -> None:
    assert check_requirements(seek(), context(gimbal(NOW_NS)), None) is None
    assert check_requirements(SeekBehaviour(Seek("car")), context(None, GimbalStatus()), None) is None
    pointing, without_camera = PointGimbalBehaviour(GimbalAim(-0.5)), context(gimbal(NOW_NS), GimbalStatus())
    assert check_requirements(pointing, without_camera, None) is None


@pytest.mark.parametrize(
    "behaviour", [SeekBehaviour(Seek("car")), ApproachBehaviour(Approach(Subject("car"), retries=0.0))]
)
def test_unknown_camera_direction_is_refused(behaviour: Behaviour) -> None:
    status = GimbalStatus(carries_camera=True, direction_fault="no gimbal")
    why = known(check_requirements(behaviour, context(None, status), None))
    assert "direction (no gimbal)" in why


class KeepsAim(HoldBehaviour):
    """Holds with a gimbal aim, whatever happens to the gimbal."""

    gimbal_aim = GimbalAim(-0.7)


def harness_with_gimbal(**changes: Any) -> GuidanceHarness:
    """In flight, with the camera on a gimbal. `changes`: of the scripted gimbal."""
    mounting = GimbalMounting(carries_camera=True, carries_steering=True)
    harness = GuidanceHarness(flying(), options=GuidanceOptions(gimbal=mounting))
    harness.autopilot.gimbal = ScriptedGimbal(**changes)
    harness.run(0.1)
    return harness


def test_lost_gimbal_control_ends_seek_with_the_owner() -> None:
    harness = harness_with_gimbal()
    command = engaged(harness, seek())
    known(harness.autopilot.gimbal).primary = (245, 190)
    assert_failed(harness.outcome(command, 1.0), "lost the gimbal", "245/190")


def test_gimbal_that_is_not_free_is_not_pointed() -> None:
    used, of_another = harness_with_gimbal(), harness_with_gimbal(primary=(245, 190))
    engaged(used, seek())
    assert_failed(used.command(aim=GimbalAim(0.0)).result(), "in use by seek")
    assert_failed(of_another.command(aim=GimbalAim(0.0)).result(), "gimbal needs ", "245/190 has")


@pytest.mark.parametrize("behaviour", [seek(), PointGimbalBehaviour(GimbalAim(-0.5))])
def test_previous_gimbal_problem_does_not_end_the_next(behaviour: Behaviour) -> None:
    """A behaviour begins in the step in which the previous one is replaced."""
    harness = harness_with_gimbal(refuses="denied")
    engaged(harness, KeepsAim())
    known(harness.autopilot.gimbal).refuses = None
    assert harness.guidance.gimbal.problem(harness.vehicle.now_ns, harness.autopilot.state) == "denied"
    command = harness.command(behaviour)
    harness.run(3.0)
    assert not command.done() or command.result().success


def test_stuck_gimbal_ends_seek() -> None:
    harness = harness_with_gimbal(follows=False)
    outcome = harness.outcome(engaged(harness, seek()))
    assert_failed(outcome, "does not follow")
    assert outcome.reason.endswith("measured 0°")


def test_silent_gimbal_ends_seek_with_the_reason() -> None:
    harness = harness_with_gimbal()
    command = engaged(harness, seek())
    known(harness.autopilot.gimbal).reports_attitude = False
    outcome = harness.outcome(command)
    assert_failed(outcome, "camera direction unknown", "attitude 5.")
    assert outcome.reason.endswith("s old) for 5 s")


@pytest.mark.parametrize(
    "left",
    [
        None,
        GimbalState(1, NOW_NS, NOW_NS, NOW_NS),
        GimbalState(1, NOW_NS, NOW_NS, NOW_NS, attitude_problem="frame unknown"),
    ],
)
@pytest.mark.parametrize("ended", [False, True])
def test_cleared_gimbal_attitude_ends_the_sweep(left: GimbalState | None, ended: bool) -> None:
    behaviour = SeekBehaviour(Seek("car", laps=0.25), sweep=sweep())
    harness = harness_with_gimbal()
    command = engaged(harness, behaviour)
    harness.until(lambda: bool(behaviour._failure) is ended, 20.0)  # after a failure the gimbal returns
    vars(known(harness.autopilot.gimbal))["state"] = lambda now_ns: left
    reason = "gimbal manager not responding"
    if left is not None:
        reason = f"seek lost the gimbal: {left.why_not_looking(NOW_NS) or '?'}"
    assert not command.done()
    harness.run()
    assert command.result() == Outcome(False, reason)


def test_missing_gimbal_at_the_start_is_named() -> None:
    behaviour = seek()
    now = context(None)
    behaviour.on_activate(now)
    assert_failed(behaviour.update(0.05, now), "not responding")


def test_mission_step_ends_when_the_gimbal_points_there() -> None:
    pointed = PointGimbalBehaviour(GimbalAim(-0.5))
    harness = harness_with_gimbal()
    assert_succeeded(harness.outcome(harness.command(pointed)), "29° down")
    stuck = harness_with_gimbal(follows=False)
    assert_failed(stuck.outcome(stuck.command(pointed)), "29° down")


@pytest.mark.parametrize(("end_deg", "rate_dps"), [(-60.0, 20.0), (-90.0, 40.0), (30.0, 5.0)])
def test_sweep_covers_every_direction_during_the_turn(end_deg: float, rate_dps: float) -> None:
    """Every direction between the ends is in the middle row at least once before it leaves the image."""
    moving = sweep(end_deg, rate_dps)
    moving.begin(0.0)
    pitch_rad, seconds, ends = 0.0, 0.0, [0.0]
    goal = moving.end_rad
    while len(ends) < 6:
        moving.step(0.05, pitch_rad)
        seconds += 0.05
        pitch_rad = known(moving.aim).pitch_rad
        if abs(pitch_rad - goal) < 1e-6:
            ends.append(seconds)
            goal = 0.0 if goal else moving.end_rad
    there_and_back_s = max(b - a for a, b in zip(ends, ends[2:], strict=False))
    assert there_and_back_s * moving.turn_rate_radps < FIELD_RAD
    assert there_and_back_s * moving.turn_rate_radps > 0.7 * FIELD_RAD
