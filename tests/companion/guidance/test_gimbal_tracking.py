"""`approach` and `follow` keep the camera's gimbal on their object: flights in lockstep.

The vehicle stays 10 m up and comes to 2 m: the object ends 75° under the horizon, where a camera that was
pointed at it in the beginning has long lost it.
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
from companion.guidance.behaviour import Behaviour, BehaviourContext
from companion.guidance.behaviours.gimbal_pointing import PointGimbalBehaviour
from companion.guidance.command import BuildContext
from companion.guidance.gimbal.tracking import GimbalTracking
from companion.guidance.gimbal_status import GimbalStatus
from companion.guidance.grammar import parse
from companion.guidance.missions.mission_file import plan_from
from companion.guidance.missions.sequence import SequenceBehaviour
from companion.guidance.requirements import check_requirements
from companion.guidance.targets.target import Target
from companion.vehicle.gimbal import GimbalAim, GimbalState
from companion.vehicle.mav_result import result_name
from companion.vehicle.state import VehicleState
from mavlink_sim.wire.messages import dialect
from tests.companion.guidance.gimbal_flight import FOOTPRINT, ON_GIMBAL, PERSON_M, gimbal_flight, person
from vision.camera_model import CameraMount

MIDDLE_M = PERSON_M[2] / 2
# The picture is 64° high; how far from its middle the object may be while vehicle and gimbal move.
IN_THE_MIDDLE_RAD = math.radians(6.0)
SECOND_NS = 1_000_000_000
STATION = (245, 190)
NOBODY = (0, 0)
DO_GIMBAL_MANAGER_CONFIGURE = 1001

Each = Callable[[LockstepFlight, Moment], None]


def fly(
    behaviour: Behaviour,
    thing: SceneObject,
    each: Each = lambda flight, moment: None,
    *,
    begin_deg: float = -37.0,
    mount: CameraMount = ON_GIMBAL,
    limit_s: float = 150.0,
) -> tuple[LockstepFlight, FlightLog]:
    """With the gimbal pointed somewhere in the beginning, by default at somebody 12 m away."""
    flight = gimbal_flight(thing, mount=mount)
    pointed = flight.fly(PointGimbalBehaviour(GimbalAim(math.radians(begin_deg))), 20.0)
    assert pointed.outcome is not None
    assert pointed.outcome.success, pointed.outcome.reason
    flight.run(1.0)
    return flight, flight.fly(behaviour, limit_s, each=lambda moment: each(flight, moment))


def command(text: str) -> Behaviour:
    return parse(text).build(BuildContext(FOOTPRINT))


def reason(log: FlightLog, success: bool) -> str:
    assert log.outcome is not None
    assert log.outcome.success is success, log.outcome.reason
    return log.outcome.reason


def off_rad(moment: Moment, thing: SceneObject, camera_rad: float = 0.0) -> float:
    """Between where the camera looks and the object's true elevation."""
    pose, (north, east, down) = thing.pose(moment.seconds), moment.truth.position_ned_m
    range_m = math.hypot(pose.north_m - north, pose.east_m - east)
    gimbal = moment.context.state.gimbal
    assert gimbal is not None
    assert gimbal.pitch_rad is not None
    return abs(gimbal.pitch_rad + camera_rad - math.atan2(down + MIDDLE_M, range_m))


def take(flight: LockstepFlight) -> None:
    """A ground station takes control of the gimbal."""
    flight.vehicle.send(
        dialect.MAVLink_command_long_message(1, 1, DO_GIMBAL_MANAGER_CONFIGURE, 0, *STATION, -1, -1, 0, 0, 0),
        source=STATION,
    )


def primary(flight: LockstepFlight) -> tuple[int, int]:
    """Who has it."""
    manager = flight.vehicle.vehicle.gimbal_manager
    assert manager is not None
    who: tuple[int, int] = manager.primary
    return who


def pitch_deg(state: VehicleState) -> float:
    """Where the gimbal looks, above the horizon."""
    assert state.gimbal is not None
    assert state.gimbal.pitch_rad is not None
    return math.degrees(state.gimbal.pitch_rad)


def test_an_approach_keeps_what_a_camera_at_rest_loses() -> None:
    thing = person(0.0, 12.0)
    _, still = fly(command("approach person distance=2 retries=0"), thing)
    assert "lost the person" in reason(still, False)

    flight, log = fly(command("approach person distance=2 retries=0 gimbal=track"), thing)
    assert reason(log, True)
    assert not log.violations
    assert thing.range_m(flight.vehicle.truth.position_ned_m, 0.0) == pytest.approx(2.0, abs=0.6)
    assert max(off_rad(moment, thing) for moment in log.moments[20:]) < IN_THE_MIDDLE_RAD
    # Nobody holds it any more, and it stays as it was pointed.
    flight.run(1.0)
    assert primary(flight) == NOBODY
    assert pitch_deg(flight.state) < -70.0


def test_somebody_who_walks_is_followed_from_nearly_above() -> None:
    thing = SceneObject("person", PERSON_M, lambda seconds: ScenePose(8.0, seconds))
    _, still = fly(command("follow person distance=2 duration=20"), thing)
    assert "lost the person" in reason(still, False)

    _, log = fly(command("follow person distance=2 duration=20 gimbal=track"), thing)
    assert reason(log, True)
    assert max(off_rad(moment, thing) for moment in log.moments[20:]) < IN_THE_MIDDLE_RAD


def test_a_camera_that_is_mounted_askew_is_brought_to_the_object() -> None:
    down_rad = math.radians(-15.0)
    thing = person(0.0, 12.0)
    _, log = fly(
        command("approach person distance=3 retries=0 gimbal=track"),
        thing,
        begin_deg=-22.0,
        mount=replace(ON_GIMBAL, pitch_rad=down_rad),
    )
    assert reason(log, True)
    assert max(off_rad(moment, thing, down_rad) for moment in log.moments[20:]) < IN_THE_MIDDLE_RAD


@pytest.mark.parametrize("word", ["approach", "follow"])
def test_who_is_cut_off_by_the_pictures_edge_is_looked_at_and_gets_a_range(word: str) -> None:
    """The picture ends 46° down, above its wheels: it has no range until the gimbal looks at it."""
    thing = SceneObject("car", (4.0, 1.8, 1.5), person(0.0, 9.0).pose)
    # an approach ends by itself, long before; who follows has been there for half a minute
    flight, log = fly(command(f"{word} car distance=4 gimbal=track"), thing, begin_deg=-14.0, limit_s=50.0)
    first = next(seen for moment in log.moments for seen in moment.context.targets)
    assert first.position_ned_m is None
    assert pitch_deg(flight.state) < -40.0
    assert thing.range_m(flight.vehicle.truth.position_ned_m, 0.0) == pytest.approx(4.0, abs=1.0)


@pytest.mark.parametrize("word", ["approach", "follow"])
def test_who_takes_the_gimbal_meanwhile_wins(word: str) -> None:
    taken: list[float] = []

    def at_three(flight: LockstepFlight, moment: Moment) -> None:
        if moment.seconds >= 3.0 and not taken:
            taken.append(moment.seconds)
            take(flight)

    flight, log = fly(command(f"{word} person distance=2 gimbal=track"), person(0.0, 12.0), at_three)
    # What comes first: the manager's word of who has it, or its answer to the next aim.
    assert reason(log, False) in (
        f"{word} lost the gimbal: 245/190 has taken control of it",
        f"{word} lost the gimbal: the vehicle refused to point the gimbal ({result_name(2)})",
    )
    flight.run(3.0)
    assert primary(flight) == STATION


GONE_AFTER_S = 4.0


def who_leaves() -> SceneObject:
    """Somebody who is gone at once."""
    near, gone = ScenePose(12.0, 0.0), ScenePose(-200.0, 0.0)
    return SceneObject("person", PERSON_M, lambda seconds: near if seconds < GONE_AFTER_S else gone)


def test_what_is_lost_is_looked_for_with_the_gimbal_too_and_only_then_it_is_given_back() -> None:
    seen: list[tuple[str, float, tuple[int, int]]] = []
    behaviour = command("approach person retries=1 gimbal=track")

    def note(flight: LockstepFlight, moment: Moment) -> None:
        seen.append((behaviour.status, pitch_deg(moment.context.state), primary(flight)))

    flight, log = fly(behaviour, who_leaves(), note)
    assert "looked for it again once" in reason(log, False)
    assert {who for _, _, who in seen[10:]} == {(1, 191)}
    lost_deg = next(pitch for status, pitch, _ in seen if "where it was" in status)
    around = [pitch for status, pitch, _ in seen if "all around" in status]
    assert max(around) > -6.0, "up to level"
    assert min(around) == pytest.approx(lost_deg, abs=6.0)
    flight.run(1.0)
    assert primary(flight) == NOBODY


@pytest.mark.parametrize("phase", ["where it was", "all around"])
def test_taken_while_it_is_looked_for_it_ends_too(phase: str) -> None:
    behaviour = command("approach person retries=2 gimbal=track")
    taken_s: list[float] = []

    def in_phase(flight: LockstepFlight, moment: Moment) -> None:
        if not taken_s and phase in behaviour.status:
            take(flight)
            taken_s.append(moment.seconds)

    flight, log = fly(behaviour, who_leaves(), in_phase)
    assert "approach lost the gimbal: " in reason(log, False)
    assert flight.seconds - taken_s[0] < 4.0
    assert primary(flight) == STATION


def test_a_gimbal_that_does_not_follow_ends_it() -> None:
    def stick(flight: LockstepFlight, moment: Moment) -> None:
        flight.vehicle.vehicle.parameters.set("MNT_MIN_PITCH", -37.0)  # a stop that it has not told of

    behaviour = command("follow person distance=2 duration=60 occlusion=60 gimbal=track")
    _, log = fly(behaviour, person(0.0, 12.0), stick)
    assert "follow lost the gimbal: it does not follow: asked for -" in reason(log, False)


def test_the_steps_of_a_mission_hand_it_on() -> None:
    table = "".join(
        f'[[step]]\ndo = "approach person distance={distance} gimbal=track"\n' for distance in (6, 3)
    )
    thing = person(0.0, 12.0)
    mission = SequenceBehaviour(plan_from(table, "nearer"), lambda behaviour: None)
    flight, log = fly(mission, thing)
    assert reason(log, True)
    assert [step.reason[:14] for step in mission.records] == ["reached person"] * 2
    assert off_rad(log.moments[-1], thing) < IN_THE_MIDDLE_RAD
    flight.run(1.0)
    assert primary(flight) == NOBODY


def flying(gimbal: GimbalState | None, sight: GimbalStatus) -> BehaviourContext:
    """With everything that an approach wants but, perhaps, a gimbal."""
    contexts: list[BehaviourContext] = []
    flight = gimbal_flight(person(0.0, 12.0))
    flight.fly(command("hold"), 2.0, each=lambda moment: contexts.append(moment.context))
    now = contexts[-1]
    return replace(now, state=replace(now.state, gimbal=gimbal or now.state.gimbal), gimbal=sight)


@pytest.mark.parametrize("word", ["approach", "follow"])
def test_without_a_camera_on_a_gimbal_tracking_is_refused_and_the_rest_is_not(word: str) -> None:
    now = flying(None, GimbalStatus(carries_camera=False))
    assert check_requirements(command(f"{word} person"), now, ("person",)) is None
    refused = check_requirements(command(f"{word} person gimbal=track"), now, ("person",))
    assert refused == f"{word} needs the camera on the gimbal (camera.on_gimbal is not set)"
    nobody = replace(now, state=replace(now.state, gimbal=None), gimbal=GimbalStatus(carries_camera=True))
    refused = check_requirements(command(f"{word} person gimbal=track"), nobody, ("person",))
    assert refused == f"{word} needs a gimbal (none answers)"


def target(elevation_rad: float, range_m: float) -> Target:
    return Target("person", 0.9, 1, 0.0, elevation_rad, range_m)


def context(
    gimbal: GimbalState, now_ns: int = 1, *, problem: str = "", camera_pitch_rad: float = 0.0
) -> BehaviourContext:
    sight = GimbalStatus(True, problem=problem, camera_pitch_rad=camera_pitch_rad)
    return BehaviourContext(now_ns, replace(VehicleState(), gimbal=gimbal), gimbal=sight)


FREE = GimbalState()


@given(
    elevation_deg=st.floats(-89.0, 40.0),
    then_m=st.floats(0.2, 80.0),
    later_m=st.floats(0.2, 80.0),
    climbed_m=st.floats(-20.0, 20.0),
)
def test_it_looks_at_the_height_that_the_detection_told(
    elevation_deg: float, then_m: float, later_m: float, climbed_m: float
) -> None:
    tracking = GimbalTracking()
    now = context(FREE)
    seen = target(math.radians(elevation_deg), then_m)
    assert tracking.keep_on(None, math.nan, (0.0, 0.0, -10.0), now) is None
    assert tracking.aim is None
    # What was seen from farther away than the vehicle is by now: the height is what counts.
    tracking.keep_on(seen, later_m, (0.0, 0.0, -10.0), now)
    above_m = then_m * math.tan(math.radians(elevation_deg))
    assert tracking.aim is not None
    assert tracking.aim.pitch_rad == pytest.approx(math.atan2(above_m, later_m), abs=1e-6)
    # The same detection, from another height: the object has stayed at its own.
    tracking.keep_on(seen, later_m, (0.0, 0.0, -10.0 - climbed_m), now)
    assert tracking.aim.pitch_rad == pytest.approx(math.atan2(above_m - climbed_m, later_m), abs=1e-6)


@given(
    elevation_deg=st.floats(-90.0, 90.0),
    range_m=st.floats(0.0, 200.0) | st.just(math.nan),
    low_deg=st.floats(-200.0, 200.0) | st.just(-math.inf),
    high_deg=st.floats(-200.0, 200.0) | st.just(math.inf),
)
def test_it_asks_for_nothing_beyond_the_stops(
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
    tracking.turn_to(seen, now)
    assert tracking.aim is not None


def test_what_hindered_the_one_before_is_no_hindrance_in_the_first_turn() -> None:
    tracking = GimbalTracking()
    first = context(FREE, 5 * SECOND_NS, problem="245/190 has taken control of it")
    tracking.begin(first)
    assert tracking.keep_on(None, math.nan, (0.0, 0.0, -10.0), first) is None
    later = replace(first, now_ns=6 * SECOND_NS)
    assert tracking.keep_on(None, math.nan, (0.0, 0.0, -10.0), later) == "245/190 has taken control of it"
