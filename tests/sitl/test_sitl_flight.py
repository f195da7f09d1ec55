"""Each command flown on the autopilot at COMPANION_SITL_URL, measured by the autopilot's own position."""

from __future__ import annotations

import math
import re
import time
from itertools import pairwise

import numpy as np
import numpy.typing as npt
import pytest

from tests.sitl.conftest import Services
from tests.sitl.sitl_harness import HOLD, NAMES, PX4, Flight, Pose, set_for_test
from vision.attitude import wrap_angle

pytestmark = [pytest.mark.sitl, pytest.mark.timeout(300), pytest.mark.realtime]
HEIGHT_M = 5.0
CORNERS_M = [(0.0, 0.0), (15.0, 0.0), (15.0, 15.0), (0.0, 15.0)]


def horizontal_m(pose: Pose, north_m: float, east_m: float) -> float:
    return math.hypot(pose.position_ned_m[0] - north_m, pose.position_ned_m[1] - east_m)


def distances_m(
    points: npt.NDArray[np.float64], start: npt.NDArray[np.float64], end: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """Of each point (n, 2) from the line between two."""
    leg = end - start
    along = np.clip((points - start) @ leg / (leg @ leg), 0.0, 1.0)
    aside: npt.NDArray[np.float64] = np.hypot(*(points - start - along[:, None] * leg).T)
    return aside


def test_the_autopilot_is_named_and_all_streams_come(flight: Flight) -> None:
    link = flight.link
    took_s = link.until(
        lambda: flight.status and not flight.status["vehicle"]["missing_streams"], 30.0, "all streams"
    )
    vehicle = flight.status["vehicle"]
    assert (vehicle["autopilot"], vehicle["driver"]) == (NAMES[link.autopilot or 0], flight.driver)
    assert vehicle["connected"]
    flight.note("all streams", after_s=took_s)


def test_take_off_and_land(flight: Flight) -> None:
    link = flight.link
    flight.take_off(1.5)  # the estimator may take its time before the first one
    flight.fly("land")
    begun_s = time.monotonic()
    reply = flight.fly(f"takeoff {HEIGHT_M:g}")
    took_s = time.monotonic() - begun_s
    height_m = link.height_m
    reported = re.search(r"([\d.]+) m above home", reply["reason"])
    assert reported is not None
    assert float(reported[1]) == pytest.approx(height_m, abs=0.3)
    assert height_m == pytest.approx(HEIGHT_M, abs=0.5)
    begun_s = time.monotonic()
    flight.fly("land")
    assert link.grounded
    flight.note("take-off to 5 m", time_s=took_s, height_m=height_m)
    flight.note("land from 5 m", time_s=time.monotonic() - begun_s)


def test_a_take_off_that_px4_ends_early_is_finished(
    flight: Flight, services: Services, parameters: dict[str, float]
) -> None:
    """PX4 holds up to NAV_MC_ALT_RAD below the height; that is no pilot's hold."""
    link = flight.link
    if link.autopilot != PX4:
        pytest.skip("NAV_MC_ALT_RAD is PX4's")
    parameters |= set_for_test(link, {"NAV_MC_ALT_RAD": 1.5})
    services.close()
    fresh = services.flight(flight.driver)  # it is read when the link opens
    since_s = time.monotonic()
    fresh.take_off(HEIGHT_M)
    held_s = next(at_s for at_s, mode in link.modes if at_s > since_s and mode == HOLD[PX4])
    ended_m = link.home_ned_m[2] - link.trajectory(held_s)[0].position_ned_m[2]
    assert ended_m < HEIGHT_M - 0.5  # PX4 itself stopped there
    assert link.height_m == pytest.approx(HEIGHT_M, abs=0.5)
    assert not [event for event in fresh.events if "pilot" in event]
    fresh.note("take-off with NAV_MC_ALT_RAD 1.5", px4_ended_at_m=ended_m, height_m=link.height_m)


def test_goto_arrives_and_stays(flight: Flight) -> None:
    link = flight.link
    flight.take_off(HEIGHT_M)
    start = link.poses[-1].position_ned_m
    begun_s = time.monotonic()
    flight.fly("goto forward=15 right=0")
    took_s = time.monotonic() - begun_s
    yaw_rad = link.trajectory(begun_s)[0].yaw_rad
    goal = (start[0] + 15.0 * math.cos(yaw_rad), start[1] + 15.0 * math.sin(yaw_rad))
    link.after(2.0)
    error_m = horizontal_m(link.poses[-1], *goal)
    assert error_m < 2.0
    flight.note("goto 15 m", time_s=took_s, error_after_2_s_m=error_m)


# 8 m at 4 m/s needs all the acceleration that the envelope allows: 3.7 m/s are flown.
@pytest.mark.parametrize(
    ("radius_m", "speed_mps", "laps"), [(10.0, 2.0, 1.2), (8.0, 4.0, 4.0), (5.0, 3.0, 3.0)]
)
def test_an_orbit_keeps_radius_speed_and_nose(
    flight: Flight, radius_m: float, speed_mps: float, laps: float
) -> None:
    link = flight.link
    flight.take_off(HEIGHT_M)
    start = link.poses[-1]
    centre = (
        start.position_ned_m[0] + radius_m * math.cos(start.yaw_rad),
        start.position_ned_m[1] + radius_m * math.sin(start.yaw_rad),
    )
    begun_s = time.monotonic()
    flight.fly(f"orbit radius={radius_m:g} speed={speed_mps:g} laps={laps:g}")
    poses = link.trajectory(begun_s + 5.0)
    radius_errors = [abs(horizontal_m(pose, *centre) - radius_m) for pose in poses]
    nose_errors = [
        abs(
            wrap_angle(
                math.atan2(centre[1] - p.position_ned_m[1], centre[0] - p.position_ned_m[0]) - p.yaw_rad
            )
        )
        for p in poses
    ]
    p50, p95 = np.percentile(radius_errors, [50, 95])
    speed = float(np.mean([pose.speed_mps for pose in poses]))
    nose_deg = math.degrees(float(np.percentile(nose_errors, 95)))
    assert p50 < 0.4
    assert p95 < 0.6
    assert speed == pytest.approx(speed_mps, rel=0.25)
    assert nose_deg < 20.0
    flight.note(
        f"orbit R {radius_m:g} m at {speed_mps:g} m/s",
        radius_error_p50_m=float(p50),
        radius_error_p95_m=float(p95),
        speed_mps=speed,
        nose_error_p95_deg=nose_deg,
    )


def test_a_path_is_followed(flight: Flight) -> None:
    link = flight.link
    flight.take_off(HEIGHT_M)
    flight.fly("goto 0 0")
    link.after(2.0)
    home = link.poses[-1].position_ned_m  # ArduPilot's local home is not true in every version
    begun_s = time.monotonic()
    flight.fly("follow-path 0,0 15,0 15,15 0,15")
    took_s = time.monotonic() - begun_s
    track = np.array([pose.position_ned_m[:2] for pose in link.trajectory(begun_s)]) - home[:2]
    errors = np.min([distances_m(track, *leg) for leg in pairwise(np.array(CORNERS_M))], axis=0)
    p50, worst = float(np.percentile(errors, 50)), float(errors.max())
    assert p50 < 1.0
    assert worst < 3.0
    flight.note("follow-path", time_s=took_s, cross_track_p50_m=p50, cross_track_max_m=worst)


def test_return_lands_at_home(flight: Flight) -> None:
    link = flight.link
    flight.take_off(HEIGHT_M)
    start = link.poses[-1].position_ned_m
    flight.fly("goto forward=12 right=0")
    begun_s = time.monotonic()
    flight.fly("rtl", timeout_s=200.0)
    assert link.grounded
    error_m = horizontal_m(link.poses[-1], start[0], start[1])
    assert error_m < 2.0
    flight.note("return from 12 m", time_s=time.monotonic() - begun_s, error_m=error_m)
