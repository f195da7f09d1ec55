"""Gimbal requirements of a seek with a sweep, and failures during it."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from companion.guidance.behaviour import Behaviour, BehaviourContext, GimbalStatus, Outcome
from companion.guidance.behaviours.approach import ApproachBehaviour
from companion.guidance.behaviours.gimbal_pointing import PointGimbalBehaviour
from companion.guidance.behaviours.seek import SeekBehaviour
from companion.guidance.gimbal.pitch import GimbalSweep
from companion.guidance.requirements import check_requirements
from companion.vehicle.gimbal import CONTROL_MAX_AGE_S, NOBODY, GimbalAim, GimbalState
from companion.vehicle.setpoint import Setpoint
from tests.companion.guidance.guidance_harness import assert_failed
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle
from vision.attitude import quaternion_from_euler

CARRIED = GimbalStatus(carries_camera=True)
FIELD_RAD = math.radians(80.0)


def sweep(end_deg: float = -60.0, rate_dps: float = 20.0) -> GimbalSweep:
    return GimbalSweep(math.radians(end_deg), math.radians(rate_dps), FIELD_RAD)


def seek() -> SeekBehaviour:
    return SeekBehaviour("car", sweep=sweep())


def gimbal(now_ns: int, pitch_deg: float = 0.0, **changes: Any) -> GimbalState:
    attitude = quaternion_from_euler(0.0, math.radians(pitch_deg), 0.0)
    low, high = math.radians(-90.0), math.radians(30.0)
    known = GimbalState(1, now_ns, now_ns, now_ns, attitude, primary_control=NOBODY)
    return replace(replace(known, lowest_pitch_rad=low, highest_pitch_rad=high), **changes)


def context(
    gimbal_state: GimbalState | None, status: GimbalStatus = CARRIED, now_ns: int = 0
) -> BehaviourContext:
    vehicle = KinematicVehicle()
    vehicle.now_ns = now_ns or vehicle.now_ns
    state = replace(vehicle.state, gimbal=gimbal_state)
    return BehaviourContext(vehicle.now_ns, state, (), 0.05, not status.direction_fault, gimbal=status)


NOW_NS = KinematicVehicle().now_ns


@pytest.mark.parametrize(
    ("gimbal_state", "status", "words"),
    [
        pytest.param(None, CARRIED, "not responding", id="none"),
        pytest.param(
            gimbal(NOW_NS - 2_000_000_000),
            CARRIED,
            "2.0 s old",
            id="silent",
        ),
        pytest.param(
            gimbal(NOW_NS, lowest_pitch_rad=math.radians(-30.0)),
            CARRIED,
            "-30° to 30°",
            id="too short",
        ),
        pytest.param(
            gimbal(NOW_NS),
            GimbalStatus(carries_camera=True, controlled_by="245/190"),
            "245/190 has it",
            id="another's",
        ),
        pytest.param(
            gimbal(NOW_NS, primary_control=None),
            CARRIED,
            "primary control",
            id="owner unknown",
        ),
        pytest.param(
            gimbal(NOW_NS, status_ns=NOW_NS - round((CONTROL_MAX_AGE_S + 0.1) * 1e9)),
            CARRIED,
            "primary control",
            id="owner outdated",
        ),
        pytest.param(
            gimbal(NOW_NS),
            GimbalStatus(),
            "camera.on_gimbal",
            id="no camera",
        ),
    ],
)
def test_missing_gimbal_requirements_are_named(
    gimbal_state: GimbalState | None, status: GimbalStatus, words: str
) -> None:
    why = check_requirements(seek(), context(gimbal_state, status), None)
    assert why is not None
    assert words in why


def test_nothing_is_missing_and_no_sweep_needs_no_gimbal() -> None:
    assert check_requirements(seek(), context(gimbal(NOW_NS)), None) is None
    assert check_requirements(SeekBehaviour("car"), context(None, GimbalStatus()), None) is None
    assert (
        check_requirements(
            PointGimbalBehaviour(GimbalAim(-0.5)), context(gimbal(NOW_NS), GimbalStatus()), None
        )
        is None
    )


@pytest.mark.parametrize("behaviour", [SeekBehaviour("car"), ApproachBehaviour("car")])
def test_unknown_camera_direction_is_refused(
    behaviour: SeekBehaviour | ApproachBehaviour,
) -> None:
    status = GimbalStatus(carries_camera=True, direction_fault="no gimbal")
    why = check_requirements(behaviour, context(None, status), None)
    assert why is not None
    assert "direction (no gimbal)" in why


def fly(
    behaviour: Behaviour, statuses: list[GimbalStatus], follows: bool = True, limit_s: float = 60.0
) -> Outcome | None:
    """20 updates a second; the gimbal follows its aim or not; the last status is kept."""
    now_ns, pitch_deg, yaw_rad = NOW_NS, 0.0, 0.0
    for turn in range(round(limit_s * 20)):
        status = statuses[min(turn, len(statuses) - 1)]
        now = context(gimbal(now_ns, pitch_deg), status, now_ns)
        now = replace(now, state=replace(now.state, attitude=quaternion_from_euler(0.0, 0.0, yaw_rad)))
        if turn == 0:
            behaviour.on_activate(now)
        step = behaviour.update(0.05, now)
        if isinstance(step, Outcome):
            return step
        assert isinstance(step, Setpoint)
        aim = behaviour.gimbal_aim
        if follows and aim is not None:
            pitch_deg = math.degrees(aim.pitch_rad)
        yaw_rad += 0.05 * (step.yaw_rate_radps or 0.0)
        now_ns += 50_000_000
    return None


def test_lost_gimbal_control_ends_seek_with_the_owner() -> None:
    taken = replace(CARRIED, problem="taken by 245/190")
    outcome = fly(seek(), [CARRIED] * 20 + [taken])
    assert_failed(outcome, "lost the gimbal", "245/190")


def test_previous_gimbal_problem_does_not_end_seek() -> None:
    """A step of a mission begins in the update in which the previous one ended."""
    before = replace(CARRIED, problem="taken by 245/190")
    for behaviour in (seek(), PointGimbalBehaviour(GimbalAim(-0.5))):
        outcome = fly(behaviour, [before, CARRIED], limit_s=3.0)
        assert outcome is None or outcome.success


def test_stuck_gimbal_ends_seek() -> None:
    outcome = fly(seek(), [CARRIED], follows=False)
    assert outcome is not None
    assert not outcome.success
    assert "does not follow" in outcome.reason
    assert outcome.reason.endswith("measured 0°")


def test_silent_gimbal_ends_seek_with_the_reason() -> None:
    silent = replace(CARRIED, direction_fault="0.6 s old")
    outcome = fly(seek(), [CARRIED] * 20 + [silent])
    assert outcome is not None
    assert outcome.reason.endswith("(0.6 s old) for 5 s")


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
    behaviour = SeekBehaviour("car", sweep=sweep())
    now = context(gimbal(NOW_NS))
    behaviour.on_activate(now)
    assert isinstance(behaviour.update(0.05, now), Setpoint)
    behaviour._failure = "no car found" if ended else ""  # the gimbal then returns
    later = replace(now, now_ns=NOW_NS + 50_000_000, state=replace(now.state, gimbal=left))
    reason = "gimbal manager not responding"
    if left is not None:
        reason = f"seek lost the gimbal: {left.why_not_looking(later.now_ns) or '?'}"
    assert behaviour.update(0.05, later) == Outcome(False, reason)


def test_missing_gimbal_at_the_start_is_named() -> None:
    behaviour = seek()
    now = context(None)
    behaviour.on_activate(now)
    assert_failed(behaviour.update(0.05, now), "not responding")


def test_mission_step_ends_when_the_gimbal_points_there() -> None:
    outcome = fly(PointGimbalBehaviour(GimbalAim(-0.5)), [CARRIED])
    assert outcome is not None
    assert outcome.success
    assert "29° down" in outcome.reason
    outcome = fly(PointGimbalBehaviour(GimbalAim(-0.5)), [CARRIED], follows=False)
    assert_failed(outcome, "29° down")


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
        assert moving.aim is not None
        pitch_rad = moving.aim.pitch_rad
        if abs(pitch_rad - goal) < 1e-6:
            ends.append(seconds)
            goal = 0.0 if goal else moving.end_rad
    there_and_back_s = max(b - a for a, b in zip(ends, ends[2:], strict=False))
    assert there_and_back_s * moving.turn_rate_radps < FIELD_RAD
    assert there_and_back_s * moving.turn_rate_radps > 0.7 * FIELD_RAD
