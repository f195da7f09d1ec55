"""`approach` and `follow` with gimbal tracking, in lockstep.

The vehicle stays at 10 m and approaches to 2 m: the object ends 75° below the horizon, outside the view of a
camera at its initial pitch.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.bench.lockstep_flight import FlightLog, LockstepFlight, Moment
from companion.bench.synthetic_detector import SceneObject, ScenePose
from companion.guidance.behaviour import Behaviour, BehaviourContext, GimbalStatus
from companion.guidance.behaviours.gimbal_pointing import PointGimbalBehaviour
from companion.guidance.command import BuildContext
from companion.guidance.gimbal.pitch import GimbalTracking
from companion.guidance.grammar import parse
from companion.guidance.missions.mission_file import plan_from
from companion.guidance.missions.sequence import SequenceBehaviour
from companion.guidance.objects.target import Target
from companion.guidance.requirements import check_requirements
from companion.vehicle.gimbal import GimbalAim, GimbalState
from companion.vehicle.mav_result import result_name
from companion.vehicle.state import VehicleState
from mavlink_sim.wire.messages import dialect
from tests.companion.guidance.gimbal_flight import FOOTPRINT, ON_GIMBAL, PERSON_M, gimbal_flight, person
from tests.companion.guidance.guidance_harness import assert_failed, assert_succeeded, known
from vision.camera_model import CameraMount

MIDDLE_M = PERSON_M[2] / 2
# The image is 64° high; tolerated offset from its centre while vehicle and gimbal move.
IN_THE_MIDDLE_RAD = math.radians(6.0)
SECOND_NS = 1_000_000_000
STATION = (245, 190)
NOBODY = (0, 0)
DO_GIMBAL_MANAGER_CONFIGURE = 1001

Each = Callable[[LockstepFlight, Moment], None]


def fly(
    behaviour: Behaviour,
    scene_object: SceneObject,
    each: Each = lambda flight, moment: None,
    *,
    begin_deg: float = -37.0,
    mount: CameraMount = ON_GIMBAL,
    limit_s: float = 150.0,
) -> tuple[LockstepFlight, FlightLog]:
    """Fly with an initial gimbal pitch, by default towards a person 12 m away."""
    flight = gimbal_flight(scene_object, mount=mount)
    pointed = flight.fly(PointGimbalBehaviour(GimbalAim(math.radians(begin_deg))), 20.0)
    assert_succeeded(pointed.outcome)
    flight.run(1.0)
    return flight, flight.fly(behaviour, limit_s, each=lambda moment: each(flight, moment))


def command(text: str) -> Behaviour:
    return parse(text).build(BuildContext(FOOTPRINT))


def reason(log: FlightLog, success: bool) -> str:
    assert log.outcome is not None
    assert log.outcome.success is success, log.outcome.reason
    return log.outcome.reason


def off_rad(moment: Moment, scene_object: SceneObject, camera_rad: float = 0.0) -> float:
    """Angle between the camera's axis and the object's true elevation."""
    pose, (north, east, down) = scene_object.pose(moment.seconds), moment.truth.position_ned_m
    range_m = math.hypot(pose.north_m - north, pose.east_m - east)
    gimbal = known(moment.context.state.gimbal)
    assert gimbal.pitch_rad is not None
    return abs(gimbal.pitch_rad + camera_rad - math.atan2(down + MIDDLE_M, range_m))


def take_control(flight: LockstepFlight) -> None:
    """A ground station takes control of the gimbal."""
    flight.vehicle.send(
        dialect.MAVLink_command_long_message(1, 1, DO_GIMBAL_MANAGER_CONFIGURE, 0, *STATION, -1, -1, 0, 0, 0),
        source=STATION,
    )


def primary(flight: LockstepFlight) -> tuple[int, int]:
    """The component in primary control."""
    manager = known(flight.vehicle.vehicle.gimbal_manager)
    who: tuple[int, int] = manager.primary
    return who


def pitch_deg(state: VehicleState) -> float:
    """The gimbal's pitch above the horizon."""
    assert state.gimbal is not None
    assert state.gimbal.pitch_rad is not None
    return math.degrees(state.gimbal.pitch_rad)


def test_approach_with_tracking_keeps_the_object_in_view() -> None:
    scene_object = person(0.0, 12.0)
    flight, log = fly(command("approach person distance=2 retries=0 gimbal=track"), scene_object)
    assert reason(log, True)
    assert not log.violations
    assert scene_object.range_m(flight.vehicle.truth.position_ned_m, 0.0) == pytest.approx(2.0, abs=0.6)
    assert max(off_rad(moment, scene_object) for moment in log.moments[20:]) < IN_THE_MIDDLE_RAD
    # Control is released, and the gimbal keeps its direction.
    flight.run(1.0)
    assert primary(flight) == NOBODY
    assert pitch_deg(flight.state) < -70.0


@pytest.mark.slow
def test_approach_without_tracking_loses_the_object() -> None:
    _, log = fly(command("approach person distance=2 retries=0"), person(0.0, 12.0))
    assert_failed(log.outcome, "lost the ", "person ")


def test_walking_person_is_followed_from_nearly_above() -> None:
    scene_object = SceneObject("person", PERSON_M, lambda seconds: ScenePose(8.0, seconds))
    _, log = fly(command("follow person distance=2 duration=20 gimbal=track"), scene_object)
    assert reason(log, True)
    assert max(off_rad(moment, scene_object) for moment in log.moments[20:]) < IN_THE_MIDDLE_RAD


def test_tracking_includes_the_camera_mount_pitch() -> None:
    down_rad = math.radians(-15.0)
    scene_object = person(0.0, 12.0)
    _, log = fly(
        command("approach person distance=3 retries=0 gimbal=track"),
        scene_object,
        begin_deg=-22.0,
        mount=replace(ON_GIMBAL, pitch_rad=down_rad),
    )
    assert reason(log, True)
    assert max(off_rad(moment, scene_object, down_rad) for moment in log.moments[20:]) < IN_THE_MIDDLE_RAD


@pytest.mark.parametrize("word", ["approach", pytest.param("follow", marks=pytest.mark.slow)])
def test_cut_off_object_gets_a_range_by_pointing_at_it(word: str) -> None:
    """The image ends 46° down, above its wheels: no range until the gimbal points at it."""
    scene_object = SceneObject("car", (4.0, 1.8, 1.5), person(0.0, 9.0).pose)
    # an approach ends by itself long before; a follow holds there
    flight, log = fly(
        command(f"{word} car distance=4 gimbal=track"), scene_object, begin_deg=-14.0, limit_s=15.0
    )
    first = next(seen for moment in log.moments for seen in moment.context.targets)
    assert first.position_ned_m is None
    assert pitch_deg(flight.state) < -40.0
    assert scene_object.range_m(flight.vehicle.truth.position_ned_m, 0.0) == pytest.approx(4.0, abs=1.0)


@pytest.mark.parametrize("word", ["approach", pytest.param("follow", marks=pytest.mark.slow)])
def test_losing_gimbal_control_ends_the_behaviour(word: str) -> None:
    taken: list[float] = []

    def at_three(flight: LockstepFlight, moment: Moment) -> None:
        if moment.seconds >= 3.0 and not taken:
            taken.append(moment.seconds)
            take_control(flight)

    flight, log = fly(command(f"{word} person distance=2 gimbal=track"), person(0.0, 12.0), at_three)
    # Depends on what comes first: the manager's status, or its answer to the next aim.
    assert any(part in reason(log, False) for part in ("245/190 has taken", result_name(2)))
    flight.run(3.0)
    assert primary(flight) == STATION


GONE_AFTER_S = 4.0


def leaving_person() -> SceneObject:
    """A person that disappears."""
    near, gone = ScenePose(12.0, 0.0), ScenePose(-200.0, 0.0)
    return SceneObject("person", PERSON_M, lambda seconds: near if seconds < GONE_AFTER_S else gone)


def test_lost_object_is_searched_with_the_gimbal() -> None:
    seen: list[tuple[str, float, tuple[int, int]]] = []
    behaviour = command("approach person retries=1 gimbal=track")

    def note(flight: LockstepFlight, moment: Moment) -> None:
        seen.append((behaviour.status, pitch_deg(moment.context.state), primary(flight)))

    flight, log = fly(behaviour, leaving_person(), note)
    assert "again once" in reason(log, False)
    assert {who for _, _, who in seen[10:]} == {(1, 191)}
    lost_deg = next(pitch for status, pitch, _ in seen if "where it was" in status)
    around = [pitch for status, pitch, _ in seen if "all around" in status]
    assert max(around) > -6.0, "up to level"
    assert min(around) == pytest.approx(lost_deg, abs=6.0)
    flight.run(1.0)
    assert primary(flight) == NOBODY


@pytest.mark.parametrize("phase", ["where it was", pytest.param("all around", marks=pytest.mark.slow)])
def test_losing_gimbal_control_ends_the_search(phase: str) -> None:
    behaviour = command("approach person retries=2 gimbal=track")
    taken_s: list[float] = []

    def in_phase(flight: LockstepFlight, moment: Moment) -> None:
        if not taken_s and phase in behaviour.status:
            take_control(flight)
            taken_s.append(moment.seconds)

    flight, log = fly(behaviour, leaving_person(), in_phase)
    assert_failed(log.outcome, "lost the ", "the gimbal: ")
    assert flight.seconds - taken_s[0] < 4.0
    assert primary(flight) == STATION


def test_stuck_gimbal_ends_follow() -> None:
    def stick(flight: LockstepFlight, moment: Moment) -> None:
        flight.vehicle.vehicle.parameters.set("MNT_MIN_PITCH", -37.0)  # an end stop that is not reported

    behaviour = command("follow person distance=2 duration=60 occlusion=60 gimbal=track")
    _, log = fly(behaviour, person(0.0, 12.0), stick)
    assert_failed(log.outcome, "the gimbal: ", "not follow: ")


def test_gimbal_is_kept_between_mission_steps() -> None:
    table = "".join(
        f'[[step]]\ndo = "approach person distance={distance} gimbal=track"\n' for distance in (6, 3)
    )
    scene_object = person(0.0, 12.0)
    mission = SequenceBehaviour(plan_from(table, "nearer"), lambda behaviour: None)
    flight, log = fly(mission, scene_object)
    assert reason(log, True)
    assert [step.reason[:14] for step in mission.records] == ["reached person"] * 2
    assert off_rad(log.moments[-1], scene_object) < IN_THE_MIDDLE_RAD
    flight.run(1.0)
    assert primary(flight) == NOBODY


def flying(gimbal: GimbalState | None, status: GimbalStatus) -> BehaviourContext:
    """A context that meets all requirements of an approach, except possibly the gimbal."""
    contexts: list[BehaviourContext] = []
    flight = gimbal_flight(person(0.0, 12.0))
    flight.fly(command("hold"), 2.0, each=lambda moment: contexts.append(moment.context))
    now = contexts[-1]
    return replace(now, state=replace(now.state, gimbal=gimbal or now.state.gimbal), gimbal=status)


@pytest.mark.parametrize("word", ["approach", "follow"])
def test_tracking_is_refused_without_a_camera_on_a_gimbal(word: str) -> None:
    now = flying(None, GimbalStatus(carries_camera=False))
    assert check_requirements(command(f"{word} person"), now, ("person",)) is None
    refused = check_requirements(command(f"{word} person gimbal=track"), now, ("person",))
    assert "camera.on_gimbal" in (refused or "")
    no_gimbal = replace(now, state=replace(now.state, gimbal=None), gimbal=GimbalStatus(carries_camera=True))
    refused = check_requirements(command(f"{word} person gimbal=track"), no_gimbal, ("person",))
    assert "not responding" in (refused or "")


def target(elevation_rad: float, range_m: float) -> Target:
    return Target("person", 0.9, 1, 0.0, elevation_rad, range_m)


def context(
    gimbal: GimbalState, now_ns: int = 1, *, problem: str = "", camera_pitch_rad: float = 0.0
) -> BehaviourContext:
    status = GimbalStatus(True, problem=problem, camera_pitch_rad=camera_pitch_rad)
    return BehaviourContext(now_ns, replace(VehicleState(), gimbal=gimbal), gimbal=status)


FREE = GimbalState()


@given(
    elevation_deg=st.floats(-89.0, 40.0),
    then_m=st.floats(0.2, 80.0),
    later_m=st.floats(0.2, 80.0),
    climbed_m=st.floats(-20.0, 20.0),
)
def test_aim_is_at_the_detected_height(
    elevation_deg: float, then_m: float, later_m: float, climbed_m: float
) -> None:
    tracking = GimbalTracking()
    now = context(FREE)
    seen = target(math.radians(elevation_deg), then_m)
    assert tracking.keep_on(None, math.nan, (0.0, 0.0, -10.0), now) is None
    assert tracking.aim is None
    # Detected from farther away than now: only the height is used.
    tracking.keep_on(seen, later_m, (0.0, 0.0, -10.0), now)
    above_m = then_m * math.tan(math.radians(elevation_deg))
    assert tracking.aim is not None
    assert tracking.aim.pitch_rad == pytest.approx(math.atan2(above_m, later_m), abs=1e-6)
    # The same detection from another height: the object keeps its height.
    tracking.keep_on(seen, later_m, (0.0, 0.0, -10.0 - climbed_m), now)
    assert tracking.aim.pitch_rad == pytest.approx(math.atan2(above_m - climbed_m, later_m), abs=1e-6)


@given(
    elevation_deg=st.floats(-90.0, 90.0),
    range_m=st.floats(0.0, 200.0) | st.just(math.nan),
    low_deg=st.floats(-200.0, 200.0) | st.just(-math.inf),
    high_deg=st.floats(-200.0, 200.0) | st.just(math.inf),
)
def test_aim_stays_within_the_end_stops(
    elevation_deg: float, range_m: float, low_deg: float, high_deg: float
) -> None:
    low, high = math.radians(low_deg), math.radians(high_deg)
    now = context(GimbalState(lowest_pitch_rad=low, highest_pitch_rad=high), camera_pitch_rad=-0.3)
    tracking = GimbalTracking()
    seen = target(math.radians(elevation_deg), range_m)
    tracking.keep_on(seen, 5.0, (0.0, 0.0, -10.0), now)
    assert tracking.aim is not None
    pitch_rad = tracking.aim.pitch_rad
    assert abs(pitch_rad) <= math.pi / 2
    if -math.pi / 2 <= low <= high <= math.pi / 2:
        assert low <= pitch_rad <= high
    tracking.keep_on(seen, math.nan, (0.0, 0.0, -10.0), now)
    assert tracking.aim is not None


def test_previous_problem_is_ignored_in_the_first_update() -> None:
    tracking = GimbalTracking()
    first = context(FREE, 5 * SECOND_NS, problem="taken by 245/190")
    tracking.begin(first)
    assert tracking.keep_on(None, math.nan, (0.0, 0.0, -10.0), first) is None
    later = replace(first, now_ns=6 * SECOND_NS)
    assert tracking.keep_on(None, math.nan, (0.0, 0.0, -10.0), later) == "taken by 245/190"
