"""Loss of GPS and resets of the position estimate, on the autopilot at COMPANION_SITL_URL."""

from __future__ import annotations

import math
import time
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pytest

from mavlink_sim.wire.messages import dialect
from tests.sitl.sitl_harness import (
    ARDUPILOT,
    ORBIT_M,
    PX4,
    READY_S,
    AutopilotLink,
    Flight,
    bring_down,
    command_or_skip,
    orbiting,
    set_for_test,
)
from vision.attitude import wrap_angle

Vector = npt.NDArray[np.float64]
pytestmark = [pytest.mark.sitl, pytest.mark.timeout(500), pytest.mark.realtime]
NO_GPS = {PX4: {"SIM_GPS_USED": 0.0}, ARDUPILOT: {"SIM_GPS1_ENABLE": 0.0}}
NO_POSITION = "position estimate not valid"
NOT_VALID = "estimator reports it as not valid"
# PX4's estimator dead-reckons for EKF2_NOAID_TOUT (5 s), Copter's for some 8 s.
LOSS_S, RETURN_S = 30.0, 60.0
# A reset of the estimate, and of what was sent when it came.
RESET_M, IN_TRANSIT_S = 22.0, 0.3
METRES_PER_DEGREE = 111_319.0
ZERO, GOTO_M, TURN_DEG = np.zeros(3), 30.0, 25.0
# Commands of PX4 and of ArduPilot that "common" has not, and the auxiliary function of the latter.
EXTERNAL_ATTITUDE, DO_AUX_FUNCTION, EKF_YAW_RESET = 620, 218, 104


def test_loss_of_gps_in_flight_ends_the_command(flight: Flight, parameters: dict[str, float]) -> None:
    link = flight.link
    orbiting(flight, 30.0)
    lost, already = flight.said("command lost"), len(flight.events)
    flight.service.last_lines()
    before = len(flight.service.lines)
    parameters |= set_for_test(link, NO_GPS[link.autopilot or 0])
    ended_s = link.until(lost, LOSS_S, "reported as lost")
    silent_from_s = time.monotonic() + IN_TRANSIT_S
    flight.service.wait_for_line(NO_POSITION, LOSS_S, after=before)
    reply = flight.command("goto forward=5 right=0")
    assert not reply["success"]
    assert NOT_VALID in reply["reason"]
    assert not [at for at in link.setpoints_s if at > silent_from_s]
    for name, value in parameters.items():
        link.set_parameter(name, value)
    restored_s = time.monotonic()
    # In the air, before the autopilot has landed by itself: a command is taken again, and flown.
    while not (reply := flight.command("hold"))["success"]:
        assert link.armed, reply
        assert time.monotonic() - restored_s < RETURN_S, reply
        link.after(0.5)
    taken_s = time.monotonic() - restored_s
    flight.fly("goto forward=5 right=0")
    mode = next(text for text in flight.events[already:] if "command lost" in text)
    flight.note("loss of GPS in an orbit", command_lost_after_s=ended_s, command_taken_after_s=taken_s)
    assert "autopilot failsafe" in mode
    bring_down(link)
    link.until(lambda: link.ready, READY_S, "ready to be armed")


def test_without_gps_a_take_off_is_refused(flight: Flight, parameters: dict[str, float]) -> None:
    link = flight.link
    flight.service.last_lines()
    before = len(flight.service.lines)
    parameters |= set_for_test(link, NO_GPS[link.autopilot or 0])

    def lost() -> bool:
        """PX4 at rest calls its position valid, and is not ready to be armed; Copter the other way round."""
        flight.service.last_lines()
        return not link.ready or any(NO_POSITION in line for line in flight.service.lines[before:])

    refused_s = link.until(lost, LOSS_S, "without a position")
    reply = flight.command("takeoff 3")
    assert not reply["success"]
    assert "position" in reply["reason"] or "GPS" in reply["reason"]
    assert not link.armed
    for name, value in parameters.items():
        link.set_parameter(name, value)
    restored_s = time.monotonic()
    link.until(lambda: link.ready, READY_S, "ready to be armed")
    flight.take_off(3.0)
    flown_s = time.monotonic() - restored_s
    flight.fly("land")
    flight.note("loss of GPS on the ground", lost_after_s=refused_s, flown_after_s=flown_s)


def reset_estimate(link: AutopilotLink, parameters: dict[str, float]) -> None:
    """Have the estimate jump north by about RESET_M, which no motion of the vehicle explains."""
    if link.autopilot == PX4:
        degrees = link.global_deg
        accuracy_m = 0.5  # below 1 m PX4 resets to it instead of weighing it
        north_deg = degrees[0] + RESET_M / METRES_PER_DEGREE
        position = (north_deg, degrees[1], math.nan)
        command_or_skip(
            link, dialect.MAV_CMD_EXTERNAL_POSITION_ESTIMATE, 0.0, 0.0, accuracy_m, 0.0, *position
        )
    else:
        parameters |= set_for_test(link, {"SIM_GPS1_GLTCH_X": RESET_M / METRES_PER_DEGREE})


def jumps(link: AutopilotLink, since_s: float) -> list[tuple[float, Vector]]:
    """When the position made a step that is no flight, and that step."""
    steps = [
        (other.time_s, np.subtract(other.position_ned_m, one.position_ned_m))
        for one, other in pairwise(link.trajectory(since_s))
    ]
    return [(at_s, step) for at_s, step in steps if np.linalg.norm(step) > RESET_M / 2]


def track(link: AutopilotLink, since_s: float) -> Vector:
    """The positions (n, 3) without the resets since then: where the vehicle flew."""
    resets = jumps(link, since_s)
    return np.array(
        [
            np.subtract(
                pose.position_ned_m, sum((step for at_s, step in resets if at_s <= pose.time_s), ZERO)
            )
            for pose in link.trajectory(since_s)
        ]
    )


def test_a_goal_moves_with_a_reset_of_the_estimate(flight: Flight, parameters: dict[str, float]) -> None:
    link = flight.link
    flight.take_off(5.0)
    flight.fly("hold")
    since_s = time.monotonic()
    link.after(2.0)
    moved = flight.said("goals moved with it")
    reset_estimate(link, parameters)
    link.until(lambda: jumps(link, since_s), LOSS_S, "reset")
    link.until(moved, 5.0, "reported as reset")
    link.after(3.0)
    at_s, step = jumps(link, since_s)[0]
    jump_m = float(np.linalg.norm(step))
    assert jump_m == pytest.approx(RESET_M, abs=3.0)
    flown = link.trajectory(at_s, at_s + 3.0)
    drift_m = max(math.dist(pose.position_ned_m, flown[0].position_ned_m) for pose in flown)
    assert drift_m < 1.5
    assert link.offboard
    flight.note("reset of the estimate in a hold", jump_m=jump_m, moved_in_3_s_m=drift_m)


def test_a_goto_arrives_at_its_moved_goal(flight: Flight, parameters: dict[str, float]) -> None:
    link = flight.link
    flight.take_off(5.0)
    flight.fly("hold")
    since_s = time.monotonic()
    link.after(2.0)
    start = link.poses[-1]
    moved = flight.said("goals moved with it")
    reset_estimate(link, parameters)  # Copter's follows after some seconds
    flight.fly(f"goto forward={GOTO_M:g} right=0 speed=2")
    link.after(2.0)
    assert moved()
    ahead = (math.cos(start.yaw_rad), math.sin(start.yaw_rad))
    goal = np.add(start.position_ned_m[:2], np.multiply(GOTO_M, ahead))
    error_m = math.dist(track(link, since_s)[-1][:2], goal)
    flight.note(
        "reset of the estimate in a goto", resets=len(jumps(link, since_s)), error_after_2_s_m=error_m
    )
    assert error_m < 2.0


def test_an_orbit_keeps_its_moved_centre(flight: Flight, parameters: dict[str, float]) -> None:
    link = flight.link
    centre = orbiting(flight)
    since_s = time.monotonic()
    link.after(1.0)
    moved = flight.said("goals moved with it")
    reset_estimate(link, parameters)
    link.until(lambda: jumps(link, since_s), LOSS_S, "reset")
    link.until(moved, 5.0, "reported as reset")
    link.after(10.0)
    radii = np.linalg.norm(track(link, since_s)[:, :2] - centre, axis=1)
    worst_m = float(np.abs(radii - ORBIT_M).max())
    flight.note("reset of the estimate in an orbit", radius_error_max_m=worst_m)
    assert worst_m < 2.0
    assert flight.status["pilot"]["behaviour"].startswith("orbiting")


def test_an_orbit_goes_on_after_a_reset_of_the_heading(flight: Flight) -> None:
    link = flight.link
    centre = orbiting(flight)
    since_s = time.monotonic()
    link.after(1.0)
    if link.autopilot == PX4:
        turned_deg = math.degrees(link.poses[-1].yaw_rad) + TURN_DEG
        nan = math.nan
        command_or_skip(link, EXTERNAL_ATTITUDE, nan, nan, turned_deg, nan, nan, nan, 1.0)
    else:
        command_or_skip(link, DO_AUX_FUNCTION, EKF_YAW_RESET, 2.0)
    link.after(15.0)
    yaws = [pose.yaw_rad for pose in link.trajectory(since_s)]
    turned_deg = max(abs(math.degrees(wrap_angle(other - one))) for one, other in pairwise(yaws))
    radii = np.linalg.norm(track(link, since_s)[:, :2] - centre, axis=1)
    worst_m = float(np.abs(radii - ORBIT_M).max())
    flight.note("reset of the heading in an orbit", step_deg=turned_deg, radius_error_max_m=worst_m)
    assert turned_deg > TURN_DEG / 2
    assert worst_m < 3.0
    assert flight.status["pilot"]["behaviour"].startswith("orbiting")
