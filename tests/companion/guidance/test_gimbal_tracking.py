"""`approach` and `follow` keep the camera's gimbal on their object: flights in lockstep.

The vehicle stays 10 m up and comes to 2 m: the object ends 75° under the horizon, where a camera that was
pointed at it in the beginning has long lost it.
"""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from gimbal_flight import FOOTPRINT, PERSON_M, gimbal_flight, person
from hypothesis import given
from hypothesis import strategies as st

from companion.bench.drawn_detector import Pose, Thing
from companion.bench.lockstep_flight import FlightLog, LockstepFlight, Moment
from companion.guidance.behaviour import Behaviour, Situation
from companion.guidance.gimbal_pointing import PointGimbalBehaviour
from companion.guidance.gimbal_sight import GimbalSight
from companion.guidance.gimbal_tracking import GimbalTracking
from companion.guidance.grammar import parse
from companion.guidance.refusal import refusal
from companion.guidance.registry import behaviour_for
from companion.vehicle.gimbal import GimbalAim, GimbalState
from companion.vehicle.state import VehicleState
from mavlink_sim.wire.messages import dialect

MIDDLE_M = PERSON_M[2] / 2
# The picture is 64° high; how far from its middle the object may be while vehicle and gimbal move.
IN_THE_MIDDLE_RAD = math.radians(6.0)
STATION = (245, 190)
DO_GIMBAL_MANAGER_CONFIGURE = 1001


def walker(speed_mps: float) -> Thing:
    """Somebody who crosses before the vehicle."""
    return Thing("person", PERSON_M, lambda seconds: Pose(8.0, speed_mps * seconds))


def fly(command: str, thing: Thing, each=None) -> tuple[LockstepFlight, FlightLog, Behaviour]:
    """With the gimbal pointed at the object in the beginning."""
    flight = gimbal_flight(thing)
    pointed = flight.fly(PointGimbalBehaviour(GimbalAim(math.radians(-37.0))), 20.0)
    assert pointed.outcome is not None
    assert pointed.outcome.success, pointed.outcome.reason
    flight.move_gimbal_on()
    behaviour = behaviour_for(parse(command), FOOTPRINT)
    log = flight.fly(behaviour, 90.0, each=None if each is None else lambda moment: each(flight, moment))
    return flight, log, behaviour


def off_rad(moment: Moment, thing: Thing) -> float:
    """Between the gimbal's pitch and the object's true elevation."""
    pose, (north, east, down) = thing.pose(moment.seconds), moment.truth.position_ned_m
    range_m = math.hypot(pose.north_m - north, pose.east_m - east)
    gimbal = moment.situation.state.gimbal
    assert gimbal is not None
    assert gimbal.pitch_rad is not None
    return abs(gimbal.pitch_rad - math.atan2(down + MIDDLE_M, range_m))


def test_an_approach_keeps_what_a_camera_at_rest_loses():
    thing = person(0.0, 12.0)
    _, still, _ = fly("approach person distance=2 retries=0", thing)
    assert still.outcome is not None
    assert not still.outcome.success
    assert "lost the person" in still.outcome.reason

    flight, log, _ = fly("approach person distance=2 retries=0 gimbal=track", thing)
    assert log.outcome is not None
    assert log.outcome.success, log.outcome.reason
    assert not log.violations
    assert thing.range_m(flight.vehicle.truth.position_ned_m, 0.0) == pytest.approx(2.0, abs=0.6)
    assert max(off_rad(moment, thing) for moment in log.moments[20:]) < IN_THE_MIDDLE_RAD
    # Nobody holds it any more, and it stays as it was pointed.
    flight.move_gimbal_on()
    assert flight.vehicle.vehicle.gimbal_manager.primary == (0, 0)
    assert math.degrees(flight.state.gimbal.pitch_rad) < -70.0


def test_somebody_who_walks_is_followed_from_nearly_above():
    thing = walker(1.0)
    _, still, _ = fly("follow person distance=2 duration=20", thing)
    assert still.outcome is not None
    assert not still.outcome.success

    _, log, _ = fly("follow person distance=2 duration=20 gimbal=track", thing)
    assert log.outcome is not None
    assert log.outcome.success, log.outcome.reason
    assert max(off_rad(moment, thing) for moment in log.moments[20:]) < IN_THE_MIDDLE_RAD


@pytest.mark.parametrize("command", ["approach person distance=2", "follow person distance=2"])
def test_who_takes_the_gimbal_meanwhile_wins(command):
    def take(flight: LockstepFlight, moment: Moment) -> None:
        if 3.0 <= moment.seconds < 3.04:
            flight.vehicle.send(
                dialect.MAVLink_command_long_message(
                    1, 1, DO_GIMBAL_MANAGER_CONFIGURE, 0, *STATION, -1, -1, 0, 0, 0
                ),
                source=STATION,
            )

    flight, log, behaviour = fly(f"{command} gimbal=track", person(0.0, 12.0), each=take)
    assert log.outcome is not None
    assert not log.outcome.success
    # What comes first: the manager's word of who has it, or its answer to the next aim.
    assert log.outcome.reason in (
        f"{behaviour.name} lost the gimbal: 245/190 has taken control of it",
        f"{behaviour.name} lost the gimbal: result 2",
    )
    flight.move_gimbal_on(3.0)
    assert flight.vehicle.vehicle.gimbal_manager.primary == STATION


def test_until_it_is_seen_again_the_gimbal_looks_where_it_was():
    """Gone after 4 s: the approach waits, looks back and turns once, and lets go of the gimbal only then."""
    gone = Pose(-200.0, 0.0)
    at_hand = Pose(12.0, 0.0)
    thing = Thing("person", PERSON_M, lambda seconds: at_hand if seconds < 4.0 else gone)
    aims: list[GimbalAim | None] = []

    def note(flight: LockstepFlight, moment: Moment) -> None:
        aims.append(behaviours[0].gimbal_aim)
        pitches.append(moment.situation.state.gimbal.pitch_rad)

    behaviours: list[Behaviour] = [behaviour_for(parse("approach person retries=1 gimbal=track"), FOOTPRINT)]
    pitches: list[float] = []
    flight = gimbal_flight(thing)
    flight.fly(PointGimbalBehaviour(GimbalAim(math.radians(-37.0))), 20.0)
    flight.move_gimbal_on()
    log = flight.fly(behaviours[0], 120.0, each=lambda moment: note(flight, moment))
    assert log.outcome is not None
    assert not log.outcome.success
    assert "looked for it again once" in log.outcome.reason
    begun = next(index for index, aim in enumerate(aims) if aim is not None)
    assert None not in aims[begun:]
    assert len(aims) > 400, "it turned once"
    assert pitches[-1] == pytest.approx(aims[-1].pitch_rad, abs=math.radians(3.0))


def situation(gimbal: GimbalState | None, sight: GimbalSight) -> Situation:
    """Flying, with everything that an approach wants but, perhaps, a gimbal."""
    flight = gimbal_flight(person(0.0, 12.0))
    flight.move_gimbal_on(2.0)
    known = flight._situation(flight.now_ns)
    return replace(known, state=replace(known.state, gimbal=gimbal), gimbal=sight)


@pytest.mark.parametrize("command", ["approach person", "follow person"])
def test_without_a_gimbal_or_a_camera_on_it_tracking_is_refused_and_the_rest_is_not(command):
    names = ("person",)
    now = situation(None, GimbalSight(carries_camera=False))
    assert refusal(behaviour_for(parse(command), FOOTPRINT), now, names) is None
    refused = refusal(behaviour_for(parse(f"{command} gimbal=track"), FOOTPRINT), now, names)
    assert refused is not None
    assert "a gimbal (none answers)" in refused
    assert "the camera on the gimbal (camera.gimbal is not set)" in refused


class Seen:
    """A detection of an object."""

    def __init__(self, captured_ns: int, elevation_rad: float) -> None:
        self.captured_ns, self.elevation_rad = captured_ns, elevation_rad


@given(
    elevation_deg=st.floats(-89.0, 40.0),
    range_m=st.floats(0.2, 80.0),
    later_m=st.floats(0.2, 80.0),
    climbed_m=st.floats(-20.0, 20.0),
)
def test_it_looks_at_the_height_that_the_detection_told(elevation_deg, range_m, later_m, climbed_m):
    tracking = GimbalTracking()
    tracking.begin(0)
    now = Situation(1, VehicleState())
    seen = Seen(1, math.radians(elevation_deg))
    assert tracking.keep_on(None, math.nan, (0.0, 0.0, -10.0), now) is None
    assert tracking.aim is None
    tracking.keep_on(seen, range_m, (0.0, 0.0, -10.0), now)
    assert tracking.aim is not None
    assert tracking.aim.pitch_rad == pytest.approx(math.radians(elevation_deg), abs=1e-6)
    # The same detection, from elsewhere: the object has stayed at its height.
    tracking.keep_on(seen, later_m, (0.0, 0.0, -10.0 - climbed_m), now)
    above_m = range_m * math.tan(math.radians(elevation_deg)) - climbed_m
    assert tracking.aim.pitch_rad == pytest.approx(math.atan2(above_m, later_m), abs=1e-6)


@given(elevation_deg=st.floats(-90.0, 90.0), range_m=st.floats(0.0, 200.0))
def test_it_asks_for_nothing_beyond_the_stops(elevation_deg, range_m):
    low, high = math.radians(-60.0), math.radians(20.0)
    gimbal = GimbalState(lowest_pitch_rad=low, highest_pitch_rad=high)
    tracking = GimbalTracking()
    now = Situation(1, replace(VehicleState(), gimbal=gimbal))
    tracking.keep_on(Seen(1, math.radians(elevation_deg)), range_m, (0.0, 0.0, -10.0), now)
    assert tracking.aim is not None
    assert low <= tracking.aim.pitch_rad <= high
