"""What a seek with a sweep cannot do without is named; so is what goes wrong with it on the way."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest

from companion.guidance.behaviour import Behaviour, BehaviourContext, Outcome
from companion.guidance.behaviours.approach import ApproachBehaviour
from companion.guidance.behaviours.gimbal_pointing import PointGimbalBehaviour
from companion.guidance.behaviours.seek import SeekBehaviour
from companion.guidance.gimbal.sweep import GimbalSweep
from companion.guidance.gimbal_status import GimbalStatus
from companion.guidance.requirements import check_requirements
from companion.vehicle.gimbal import CONTROL_MAX_AGE_S, NOBODY, GimbalAim, GimbalState
from companion.vehicle.setpoint import Setpoint
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


def context(told: GimbalState | None, sight: GimbalStatus = CARRIED, now_ns: int = 0) -> BehaviourContext:
    vehicle = KinematicVehicle()
    vehicle.now_ns = now_ns or vehicle.now_ns
    state = replace(vehicle.state, gimbal=told)
    return BehaviourContext(vehicle.now_ns, state, (), 0.05, not sight.undirected, gimbal=sight)


NOW_NS = KinematicVehicle().now_ns


@pytest.mark.parametrize(
    ("told", "sight", "words"),
    [
        pytest.param(None, CARRIED, "seek needs a gimbal (none answers)", id="none"),
        pytest.param(
            gimbal(NOW_NS - 2_000_000_000),
            CARRIED,
            "a gimbal that tells where it looks (attitude 2.0 s old)",
            id="silent",
        ),
        pytest.param(
            gimbal(NOW_NS, lowest_pitch_rad=math.radians(-30.0)),
            CARRIED,
            "a gimbal that pitches to -60° (it goes from -30° to 30°)",
            id="too short",
        ),
        pytest.param(
            gimbal(NOW_NS),
            GimbalStatus(carries_camera=True, elsewhere="245/190"),
            "control of the gimbal (245/190 has it, and must give it back)",
            id="another's",
        ),
        pytest.param(
            gimbal(NOW_NS, primary_control=None),
            CARRIED,
            "to know who has control of it (its manager does not tell)",
            id="nobody tells whose",
        ),
        pytest.param(
            gimbal(NOW_NS, status_ns=NOW_NS - round((CONTROL_MAX_AGE_S + 0.1) * 1e9)),
            CARRIED,
            "to know who has control of it (its manager does not tell)",
            id="told whose long ago",
        ),
        pytest.param(
            gimbal(NOW_NS),
            GimbalStatus(),
            "the camera on the gimbal (camera.on_gimbal is not set)",
            id="no camera",
        ),
    ],
)
def test_a_seek_with_a_sweep_names_what_of_the_gimbal_is_missing(
    told: GimbalState | None, sight: GimbalStatus, words: str
) -> None:
    why = check_requirements(seek(), context(told, sight), None)
    assert why is not None
    assert words in why


def test_with_everything_there_nothing_is_missing_and_without_a_sweep_no_gimbal_is_needed() -> None:
    assert check_requirements(seek(), context(gimbal(NOW_NS)), None) is None
    assert check_requirements(SeekBehaviour("car"), context(None, GimbalStatus()), None) is None
    assert (
        check_requirements(
            PointGimbalBehaviour(GimbalAim(-0.5)), context(gimbal(NOW_NS), GimbalStatus()), None
        )
        is None
    )


@pytest.mark.parametrize("behaviour", [SeekBehaviour("car"), ApproachBehaviour("car")])
def test_what_looks_through_a_camera_of_which_nobody_knows_where_it_looks_is_refused(
    behaviour: SeekBehaviour | ApproachBehaviour,
) -> None:
    sight = GimbalStatus(carries_camera=True, undirected="the gimbal that carries it: no gimbal answers")
    why = check_requirements(behaviour, context(None, sight), None)
    assert why == (
        f"{behaviour.name} needs to know where its camera looks "
        "(the gimbal that carries it: no gimbal answers)"
    )


def fly(
    behaviour: Behaviour, sights: list[GimbalStatus], follows: bool = True, limit_s: float = 60.0
) -> Outcome | None:
    """20 turns a second; the gimbal looks where it is asked to, or does not; the last sight stays."""
    now_ns, pitch_deg, yaw_rad = NOW_NS, 0.0, 0.0
    for turn in range(round(limit_s * 20)):
        sight = sights[min(turn, len(sights) - 1)]
        told = context(gimbal(now_ns, pitch_deg), sight, now_ns)
        told = replace(told, state=replace(told.state, attitude=quaternion_from_euler(0.0, 0.0, yaw_rad)))
        if turn == 0:
            behaviour.on_activate(told)
        step = behaviour.update(0.05, told)
        if isinstance(step, Outcome):
            return step
        assert isinstance(step, Setpoint)
        aim = behaviour.gimbal_aim
        if follows and aim is not None:
            pitch_deg = math.degrees(aim.pitch_rad)
        yaw_rad += 0.05 * (step.yaw_rate_radps or 0.0)
        now_ns += 50_000_000
    return None


def test_a_gimbal_that_another_takes_ends_the_seek_and_says_who() -> None:
    taken = replace(CARRIED, problem="245/190 has taken control of it")
    outcome = fly(seek(), [CARRIED] * 20 + [taken])
    assert outcome == Outcome(False, "seek lost the gimbal: 245/190 has taken control of it")


def test_what_somebody_before_lost_is_no_loss_of_this_one() -> None:
    """A step of a mission begins in the turn in which the one before ended."""
    before = replace(CARRIED, problem="245/190 has taken control of it")
    for behaviour in (seek(), PointGimbalBehaviour(GimbalAim(-0.5))):
        outcome = fly(behaviour, [before, CARRIED], limit_s=3.0)
        assert outcome is None or outcome.success


def test_a_gimbal_that_does_not_follow_ends_the_seek() -> None:
    outcome = fly(seek(), [CARRIED], follows=False)
    assert outcome is not None
    assert not outcome.success
    assert outcome.reason.startswith("the gimbal does not follow: asked for -")
    assert outcome.reason.endswith("it is at 0°")


def test_a_gimbal_that_falls_silent_ends_the_seek_and_the_reason_is_told() -> None:
    silent = replace(CARRIED, undirected="the gimbal that carries it: its attitude is 0.6 s old")
    outcome = fly(seek(), [CARRIED] * 20 + [silent])
    assert outcome is not None
    assert outcome.reason == (
        "where the camera looks is not known (the gimbal that carries it: its attitude is 0.6 s old) for 5 s"
    )


@pytest.mark.parametrize(
    ("left", "words"),
    [
        (None, "none answers"),
        (GimbalState(1, NOW_NS, NOW_NS, NOW_NS), "attitude not received"),
        (GimbalState(1, NOW_NS, NOW_NS, NOW_NS, attitude_problem="it says two things"), "it says two things"),
    ],
)
@pytest.mark.parametrize("vain", [False, True])
def test_a_gimbal_whose_attitude_is_withdrawn_ends_the_sweep_and_the_reason_is_told(
    left: GimbalState | None, words: str, vain: bool
) -> None:
    behaviour = SeekBehaviour("car", sweep=sweep())
    told = context(gimbal(NOW_NS))
    behaviour.on_activate(told)
    assert isinstance(behaviour.update(0.05, told), Setpoint)
    behaviour._vain = "no car seen in 2 laps" if vain else ""  # the gimbal then goes back
    later = replace(told, now_ns=NOW_NS + 50_000_000, state=replace(told.state, gimbal=left))
    assert behaviour.update(0.05, later) == Outcome(False, f"seek lost the gimbal: {words}")


def test_a_gimbal_that_is_gone_when_the_seek_begins_is_named_too() -> None:
    behaviour = seek()
    told = context(None)
    behaviour.on_activate(told)
    assert behaviour.update(0.05, told) == Outcome(False, "seek lost the gimbal: none answers")


def test_the_mission_step_ends_when_the_gimbal_looks_there_or_will_not() -> None:
    assert fly(PointGimbalBehaviour(GimbalAim(-0.5)), [CARRIED]) == Outcome(True, "the gimbal looks 29° down")
    outcome = fly(PointGimbalBehaviour(GimbalAim(-0.5)), [CARRIED], follows=False)
    assert outcome == Outcome(False, "gimbal: it does not look 29° down after all")


@pytest.mark.parametrize(("end_deg", "rate_dps"), [(-60.0, 20.0), (-90.0, 40.0), (30.0, 5.0)])
def test_while_the_picture_turns_by_its_width_the_gimbal_goes_there_and_back(
    end_deg: float, rate_dps: float
) -> None:
    """Every direction between the ends has been in the middle row at least once before it leaves."""
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
