"""Collision prevention as a function of the sticks and the map of obstacles."""

from __future__ import annotations

import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavlink_sim.flight.collision_prevention import (
    FRAME_BODY_FRD,
    FRAME_LOCAL_NED,
    SECTORS,
    UNKNOWN_CM,
    ObstacleMap,
    limited_acceleration,
)
from mavlink_sim.flight.transmitter import Sticks
from mavlink_sim.px4.parameters import Parameters
from mavlink_sim.wire.messages import dialect
from tests.mavlink_sim.conftest import CALIBRATION, SimHarness, velocity_setpoint
from tests.mavlink_sim.plan_client import listen

FAR_CM = 2100  # nothing within the 20 m of the sensor
STILL = (0.0, 0.0)
FRAME_REFUSED = "Obstacle message received in unsupported frame 7\t"  # STATUSTEXT of PX4


def parameters(**values: float) -> Parameters:
    return Parameters({"CP_DIST": 2.0, "CP_GUIDE_ANG": 0.0, **values})


def obstacle_map(
    obstacles: dict[int, int] | None = None,
    *,
    others: int = FAR_CM,
    frame: int = FRAME_BODY_FRD,
    yaw: float = 0.0,
) -> ObstacleMap:
    """A fresh map: centimetres by 5° sector, the rest free."""
    distances = [others] * SECTORS
    for sector, distance in (obstacles or {}).items():
        distances[sector % SECTORS] = distance
    found = ObstacleMap()
    found.add(distances, 5.0, 0.0, 20, 2000, frame, yaw, 100.0)
    return found


def limit(
    acceleration: tuple[float, float],
    found: ObstacleMap,
    *,
    velocity: tuple[float, float] = STILL,
    yaw: float = 0.0,
    now: float = 100.0,
    **values: float,
) -> Any:
    return limited_acceleration(acceleration, velocity, yaw, found, parameters(**values), now)


def test_disabled_it_limits_nothing() -> None:
    assert limit((3.0, 1.0), ObstacleMap(), CP_DIST=-1.0).acceleration == (3.0, 1.0)


def test_without_data_stops_and_holds_after_5_s() -> None:
    found = ObstacleMap()
    first = limit((3.0, 0.0), found, now=100.0)
    assert (first.acceleration, first.hold) == (STILL, False)
    assert not limit((3.0, 0.0), found, now=104.9).hold
    assert limit((3.0, 0.0), found, now=105.1).hold


def test_stale_data_are_ignored() -> None:
    found = obstacle_map()
    assert limit((3.0, 0.0), found, now=100.4).acceleration != STILL
    assert limit((3.0, 0.0), found, now=100.6).acceleration == STILL


def test_sticks_not_limited_without_obstacles() -> None:
    north, east = limit((2.0, 1.0), obstacle_map()).acceleration
    assert (north, east) == pytest.approx((2.0, 1.0))


def test_limit_decreases_to_zero_at_cp_dist() -> None:
    left = []
    for distance_cm in (1500, 1000, 600, 300, 200):
        wall = obstacle_map(dict.fromkeys(range(-6, 7), distance_cm))
        left.append(limit((3.0, 0.0), wall).acceleration[0])
    assert left == sorted(left, reverse=True)
    assert left[0] == pytest.approx(3.0)
    assert left[-1] == pytest.approx(0.0)


def test_sticks_not_limited_away_from_wall() -> None:
    wall = obstacle_map({0: 210})
    assert limit((-3.0, 0.0), wall).acceleration == pytest.approx((-3.0, 0.0))


def test_below_cp_dist_the_stick_pushes_away() -> None:
    assert limit((3.0, 0.0), obstacle_map({0: 100})).acceleration[0] < -1.0


def test_a_vehicle_too_fast_to_stop_is_braked() -> None:
    wall = obstacle_map({0: 500})
    slow = limit((1.0, 0.0), wall, velocity=(0.5, 0.0)).acceleration[0]
    fast = limit((1.0, 0.0), wall, velocity=(6.0, 0.0)).acceleration[0]
    assert fast < -3.0 < slow


def test_older_data_brake_earlier() -> None:
    wall = obstacle_map({0: 700})
    now = limit((1.0, 0.0), wall, velocity=(4.0, 0.0)).acceleration[0]
    later = limit((1.0, 0.0), wall, velocity=(4.0, 0.0), now=100.4).acceleration[0]
    assert later < now


def test_a_longer_delay_brakes_earlier() -> None:
    wall = obstacle_map({0: 700})
    swift = limit((1.0, 0.0), wall, velocity=(4.0, 0.0), CP_DELAY=0.0).acceleration[0]
    slow = limit((1.0, 0.0), wall, velocity=(4.0, 0.0), CP_DELAY=1.0).acceleration[0]
    assert slow < swift


def test_unknown_sectors_need_cp_go_no_data() -> None:
    blind = obstacle_map({0: UNKNOWN_CM, 1: UNKNOWN_CM, 71: UNKNOWN_CM})
    assert limit((3.0, 0.0), blind).acceleration == STILL
    assert limit((3.0, 0.0), blind, CP_GO_NO_DATA=1).acceleration[0] > 2.0


def test_sector_with_lost_data_is_never_allowed() -> None:
    found = obstacle_map()
    distances = [FAR_CM] * SECTORS
    distances[0] = UNKNOWN_CM
    found.add(distances, 5.0, 0.0, 20, 2000, FRAME_BODY_FRD, 0.0, 100.6)
    assert limit((3.0, 0.0), found, now=100.7, CP_GO_NO_DATA=1).acceleration == STILL


def test_the_setpoint_is_guided_into_a_gap_beside_it() -> None:
    wall = dict.fromkeys(range(-12, 13), 400) | {4: 1900, 5: 1900, 3: 1900}
    _, east = limit((3.0, 0.0), obstacle_map(wall), CP_GUIDE_ANG=30.0).acceleration
    assert east > 0.1
    assert abs(limit((3.0, 0.0), obstacle_map(wall)).acceleration[1]) < 1e-9


def test_north_aligned_data_turn_with_the_vehicle() -> None:
    east_wall = obstacle_map({18: 200}, frame=FRAME_LOCAL_NED, yaw=math.pi / 2)
    assert east_wall.distances_cm[0] == 200  # it looks east
    assert limit((0.0, 3.0), east_wall, yaw=math.pi / 2).acceleration[1] == pytest.approx(0.0, abs=1e-6)


def test_wide_sectors_fill_all_the_narrow_ones_they_cover() -> None:
    found = ObstacleMap()
    found.add([300, *([FAR_CM] * 11)], 30.0, 0.0, 20, 2000, FRAME_BODY_FRD, 0.0, 100.0)
    near = {sector for sector in range(SECTORS) if found.distances_cm[sector] == 300}
    assert near == {70, 71, 0, 1, 2}  # of a sector that two measurements share PX4 keeps the later


def test_nearer_range_kept_over_out_of_range() -> None:
    found = obstacle_map({0: 300})
    found.add([4000] * SECTORS, 5.0, 0.0, 20, 3000, FRAME_BODY_FRD, 0.0, 100.1)
    assert found.distances_cm[0] == 300
    found.add([4000] * SECTORS, 5.0, 0.0, 20, 2000, FRAME_BODY_FRD, 0.0, 100.2)
    assert found.distances_cm[0] == 4000


@settings(max_examples=60, deadline=None)
@given(
    st.lists(st.integers(0, 65535), min_size=SECTORS, max_size=SECTORS),
    st.floats(-math.pi, math.pi),
    st.tuples(st.floats(-5, 5), st.floats(-5, 5)),
    st.tuples(st.floats(-12, 12), st.floats(-12, 12)),
    st.floats(0, 60),
)
def test_result_is_finite_for_any_map(
    distances: list[int],
    yaw: float,
    acceleration: tuple[float, float],
    velocity: tuple[float, float],
    guide: float,
) -> None:
    found = ObstacleMap()
    found.add(distances, 5.0, 0.0, 20, 2000, FRAME_BODY_FRD, yaw, 100.0)
    got = limit(acceleration, found, velocity=velocity, yaw=yaw, CP_GUIDE_ANG=guide)
    assert all(map(math.isfinite, got.acceleration))


def test_vehicle_limits_sticks_and_holds_without_sensor() -> None:
    harness = SimHarness(ready_after_s=0.0, parameters={"CP_DIST": 3.0, "CP_GUIDE_ANG": 0.0})
    harness.take_off()
    harness.vehicle.autopilot.pilot_takes_over()
    allowed = harness.vehicle.autopilot.navigator.guard_sticks
    assert allowed((3.0, 0.0), STILL) == STILL
    free = dialect.MAVLink_obstacle_distance_message(0, 0, [FAR_CM] * SECTORS, 5, 20, 2000, 0.0, 0.0, 12)
    harness.send(free)
    assert allowed((3.0, 0.0), STILL)[0] > 2.9
    harness.fly(4.0)
    assert allowed((3.0, 0.0), STILL) == STILL
    assert harness.mode == "POSCTL"
    harness.fly(1.5)
    allowed((3.0, 0.0), STILL)
    assert harness.mode == "HOLD"


def test_message_fills_map_and_offboard_ignores_it() -> None:
    harness = SimHarness(ready_after_s=0.0, parameters={"CP_DIST": 3.0})
    listen(harness)
    near = [150] * SECTORS
    harness.send(dialect.MAVLink_obstacle_distance_message(0, 0, near, 5, 20, 2000, 0.0, 0.0, 12))
    assert harness.vehicle.autopilot.navigator.obstacles.distances_cm == near
    harness.send(dialect.MAVLink_obstacle_distance_message(0, 0, near, 5, 20, 2000, 0.0, 0.0, 7))
    harness.fly(0.1)
    assert harness.texts()[-1] == FRAME_REFUSED
    harness.take_off()
    north = velocity_setpoint(2, 0, 0)
    harness.offboard(north)
    harness.fly(2.0, north)
    assert harness.vehicle.airframe.velocity[0] > 1.5


class Wall:
    """A wall north of a hovering vehicle whose pilot flies by remote control, and a sensor that sees it.

    `at_m`: north of the vehicle's position when the wall was added.
    """

    def __init__(self, at_m: float, **values: float) -> None:
        self.harness = SimHarness(parameters={**CALIBRATION, "COM_RC_IN_MODE": 0, **values})
        self.vehicle = self.harness.vehicle
        self.vehicle.transmitter.on = True
        self.harness.take_off(5.0)
        self.harness.fly(1.0)
        self.start_m = self.north_m
        self.at_m = at_m

    @property
    def north_m(self) -> float:
        return float(self.vehicle.airframe.position[0])

    @property
    def distance_m(self) -> float:
        return self.start_m + self.at_m - self.north_m

    def fly(self, seconds: float, setpoint: Any = None, *, seen: bool = True, **sticks: float) -> None:
        """Advance time with these sticks; the sensor sends at 10 Hz, ahead and 20° to the sides."""
        self.vehicle.transmitter.sticks = Sticks(**sticks)
        for _ in range(round(seconds * 10)):
            distances = [FAR_CM] * SECTORS
            for sector in range(-4, 5):
                away = self.distance_m / math.cos(math.radians(5.0 * sector))
                distances[sector % SECTORS] = min(max(round(away * 100), 21), FAR_CM)
            if seen:
                self.harness.send(
                    dialect.MAVLink_obstacle_distance_message(
                        0, 0, distances, 5, 20, 2000, frame=FRAME_LOCAL_NED
                    )
                )
            self.harness.fly(0.1, setpoint)


def test_full_stick_towards_a_wall_stops_before_it() -> None:
    wall = Wall(3.0, CP_DIST=1.0, CP_GUIDE_ANG=0)
    assert wall.harness.set_mode(3, 0) == [0, 0]
    wall.fly(8.0, pitch=1.0)
    assert wall.harness.mode == "POSCTL"
    assert 0.7 < wall.distance_m < 2.5
    assert abs(wall.vehicle.airframe.velocity[0]) < 0.2
    wall.fly(2.0, pitch=-1.0)  # and away from it without a limit
    assert wall.distance_m > 3.5


def test_without_collision_prevention_wall_is_passed() -> None:
    wall = Wall(3.0, CP_DIST=-1.0)
    wall.harness.set_mode(3, 0)
    wall.fly(4.0, pitch=1.0)
    assert wall.distance_m < 0.0


def test_offboard_is_not_limited() -> None:
    wall = Wall(3.0, CP_DIST=1.0, CP_GUIDE_ANG=0)
    north = velocity_setpoint(2, 0, 0)
    wall.harness.offboard(north)
    wall.fly(4.0, north)
    assert wall.harness.mode == "OFFBOARD"
    assert wall.distance_m < 0.0


def test_silent_sensor_ends_position_mode() -> None:
    wall = Wall(10.0, CP_DIST=1.0, CP_GUIDE_ANG=0)
    wall.harness.set_mode(3, 0)
    wall.fly(1.0)
    wall.fly(4.5, seen=False)
    assert wall.harness.mode == "POSCTL"
    assert wall.distance_m > 9.0
    wall.fly(1.5, seen=False)
    assert wall.harness.mode == "HOLD"
