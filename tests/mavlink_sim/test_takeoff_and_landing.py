"""TAKEOFF, LAND, RTL, HOLD and DO_REPOSITION, with the landed states they pass through."""

import math
from typing import Any

import pytest

from mavlink_sim.physics.geography import SIH_FRAME
from tests.mavlink_sim.conftest import SimHarness

NAN = math.nan


def landed_states(harness: SimHarness) -> list[int]:
    """The EXTENDED_SYS_STATE.landed_state received, without repetitions."""
    found: list[int] = []
    for message in harness.received("EXTENDED_SYS_STATE"):
        if found[-1:] != [message.landed_state]:
            found.append(message.landed_state)
    return found


def test_take_off_climbs_to_two_and_a_half_metres_and_holds(harness: SimHarness) -> None:
    harness.wait_ready()
    assert harness.command(400, 1) == [0]
    harness.forget()
    armed_s = harness.now_s
    assert harness.command(22, NAN, 0, 0, NAN, NAN, NAN, NAN) == [0]
    assert harness.mode == "TAKEOFF"
    harness.until(lambda: not harness.vehicle.autopilot.landed)
    assert 1.5 < harness.now_s - armed_s < 2.5
    harness.until(lambda: harness.mode == "HOLD")
    assert 6.5 <= harness.now_s - armed_s <= 9.0
    assert 1.8 <= harness.height_m <= 2.2
    harness.fly(6.0)
    assert harness.height_m == pytest.approx(2.5, abs=0.15)
    assert landed_states(harness) == [1, 3, 2]


@pytest.mark.parametrize("seed", range(4))
def test_takeoff_with_gusts_ends_as_measured(make_harness: type[SimHarness], seed: int) -> None:
    harness = make_harness(noise=True, gusts_mps=None, seed=seed)
    harness.wait_ready()
    assert harness.command(400, 1) == [0]
    armed_s = harness.now_s
    harness.command(22, NAN, 0, 0, NAN, NAN, NAN, NAN)
    harness.until(lambda: harness.mode == "HOLD")
    assert 6.5 <= harness.now_s - armed_s <= 9.0
    assert 1.8 <= harness.height_m <= 2.2


@pytest.mark.parametrize(("height_m", "least_s", "most_s"), [(4.0, 7.2, 8.0), (5.0, 7.8, 8.7)])
def test_a_higher_take_off_holds_as_soon_as_measured(
    harness: SimHarness, height_m: float, least_s: float, most_s: float
) -> None:
    harness.wait_ready()
    harness.command(400, 1)
    harness.command(22, NAN, 0, 0, NAN, NAN, NAN, 489.4 + height_m)
    assert harness.mode == "TAKEOFF"
    assert least_s <= harness.until(lambda: harness.mode == "HOLD") + 0.04 <= most_s


def test_in_air_only_when_hold_begins(harness: SimHarness) -> None:
    harness.wait_ready()
    harness.command(400, 1)
    harness.command(22, NAN, 0, 0, NAN, NAN, NAN, NAN)
    states: list[tuple[str, int]] = []

    def watch() -> bool:
        state = (harness.mode, int(harness.vehicle.autopilot.landed_state))
        if states[-1:] != [state]:
            states.append(state)
        return bool(state[0] == "HOLD")

    harness.until(watch)
    assert states == [("TAKEOFF", 1), ("TAKEOFF", 3), ("HOLD", 2)]


def test_take_off_to_a_given_altitude_above_sea(harness: SimHarness) -> None:
    harness.take_off(6.0)
    harness.fly(6.0)
    assert harness.height_m == pytest.approx(6.0, abs=0.3)


def test_take_off_is_accepted_before_arming_and_waits_for_it(harness: SimHarness) -> None:
    harness.fly(0.5)  # not even ready
    assert harness.command(22, NAN, 0, 0, NAN, NAN, NAN, NAN) == [0]
    assert not harness.armed
    harness.wait_ready()
    assert harness.command(400, 1) == [0]
    harness.until(lambda: harness.mode == "HOLD")
    assert harness.height_m > 1.5


def test_takeoff_mode_takes_off_once_armed(harness: SimHarness) -> None:
    harness.wait_ready()
    assert harness.set_mode(4, 2) == [0, 0]
    assert harness.command(400, 1) == [0]
    harness.until(lambda: harness.mode == "HOLD")
    assert harness.height_m > 1.5


def test_take_off_while_flying_is_accepted_and_does_not_descend(harness: SimHarness) -> None:
    harness.take_off(6.0)
    harness.fly(5.0)
    assert harness.command(22, NAN, 0, 0, NAN, NAN, NAN, NAN) == [0]
    harness.fly(3.0)
    assert harness.height_m > 5.5
    assert harness.mode == "HOLD"


def test_landing_touches_down_softly_and_disarms_2_s_later(harness: SimHarness) -> None:
    harness.take_off(4.0)
    harness.fly(4.0)
    harness.forget()
    assert harness.command(21, 0, 0, 0, NAN, NAN, NAN, NAN) == [0]
    assert harness.heartbeat().custom_mode == 0x06040000
    took = harness.until(lambda: harness.vehicle.airframe.on_ground, 20.0)
    harness.until(lambda: harness.vehicle.autopilot.landed, 5.0)
    assert 6.0 <= took <= 12.0
    assert 1.9 < harness.until(lambda: not harness.armed, 5.0) < 2.1
    harness.fly(0.5)
    assert landed_states(harness) == [4, 1]


def test_mode_before_landing_restored(harness: SimHarness) -> None:
    harness.take_off()
    harness.command(21)
    harness.until(lambda: not harness.armed, 30.0)
    assert harness.mode == "HOLD"
    assert harness.heartbeat().system_status == 3


def test_leaving_land_in_the_air_is_in_air_again(harness: SimHarness) -> None:
    harness.take_off(5.0)
    harness.forget()
    harness.command(21)
    harness.fly(1.0)
    harness.set_mode(4, 3)
    harness.fly(1.0)
    assert landed_states(harness)[-2:] == [4, 2]


def test_return_close_to_home_stays_low_lands_and_disarms(harness: SimHarness) -> None:
    harness.heartbeats.append(("gcs", (245, 190), 6))
    harness.take_off(4.0)
    harness.fly(4.0)
    harness.forget()
    highest = harness.height_m
    assert harness.command(20) == [0]
    assert harness.mode == "RTL"
    harness.until(lambda: not harness.armed, 60.0)
    assert highest < 4.5
    assert landed_states(harness)[-2:] == [4, 1]
    texts = harness.texts()
    assert texts[:2] == ["Returning to launch\t", "RTL: start return at 493 m (4 m above destination)\t"]
    assert texts[-3:] == ["RTL: land at destination\t", "Landing detected\t", "Disarmed by landing\t"]


def test_return_from_afar_climbs_first_and_lands_at_home(
    make_harness: type[SimHarness],
) -> None:
    harness = make_harness(parameters={"RTL_RETURN_ALT": 12.0})
    harness.take_off(4.0)
    assert harness.command_int(192, (-1, 1, 0, NAN), 473980000, 85455942, 494.4) == [0]
    harness.fly(14.0)
    assert math.dist(harness.vehicle.airframe.position, (28.5, 0.0, -5.0)) < 1.5
    harness.command(20)
    harness.until(lambda: harness.vehicle.airframe.position[0] < 15.0, 40.0)
    assert abs(math.degrees(harness.vehicle.airframe.yaw_rad)) > 150.0  # it flies nose first
    highest = 0.0

    def done() -> bool:
        nonlocal highest
        highest = max(highest, harness.height_m)
        return not harness.armed

    harness.until(done, 90.0)
    assert 11.5 < highest < 13.0
    assert math.hypot(*harness.vehicle.airframe.position[:2]) < 1.0
    # and lands with the heading at arming, as measured on a real PX4
    assert harness.vehicle.airframe.yaw_rad == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize(
    ("parameters", "heading_deg", "landed_deg"),
    [({}, 70.0, 70.0), ({"WV_EN": 1}, 70.0, 120.0), ({}, math.nan, 120.0)],
)
def test_close_to_home_a_return_turns_to_the_heading_of_home(
    make_harness: type[SimHarness], parameters: dict[str, float], heading_deg: float, landed_deg: float
) -> None:
    harness = make_harness(parameters=parameters)
    harness.take_off(5.0)
    latitude, longitude, altitude = SIH_FRAME.geographic((0.0, 0.0, 0.0))
    assert harness.command(179, 0, 0, 0, heading_deg, latitude, longitude, altitude) == [0]
    at, above = (round(latitude * 1e7) + 540, round(longitude * 1e7)), altitude + 5.0  # 6 m north
    assert harness.command_int(192, (-1, 1, 0, math.radians(120.0)), *at, above) == [0]
    harness.fly(8.0)
    assert math.degrees(harness.vehicle.airframe.yaw_rad) == pytest.approx(120.0, abs=2.0)
    harness.command(20)
    harness.until(lambda: not harness.armed, 60.0)
    assert math.degrees(harness.vehicle.airframe.yaw_rad) == pytest.approx(landed_deg, abs=3.0)


@pytest.mark.parametrize(("seed", "wind_mps"), [(0, 0.0), (1, 0.0), (2, 5.0)])
def test_return_in_moving_air_ends_at_home_too(
    make_harness: type[SimHarness], velocity_setpoint: Any, seed: int, wind_mps: float
) -> None:
    harness = make_harness(gusts_mps=None, seed=seed, wind_mps=wind_mps)
    harness.take_off(6.0)
    away = velocity_setpoint(3, 0, 0)
    harness.offboard(away)
    harness.fly(6.0, away)  # no more setpoints: the failsafe returns
    harness.until(lambda: not harness.armed, 90.0)
    # depends on the gusts of the last metres: with other seeds it is 0.4 to 3 m
    assert math.hypot(*harness.vehicle.airframe.position[:2]) < 3.5


def test_reposition_flies_there_and_turns_to_the_given_heading(harness: SimHarness) -> None:
    harness.take_off(5.0)
    assert harness.command_int(192, (-1, 1, 0, math.pi / 2), 473978330, 85455942, 497.4) == [0]
    harness.fly(25.0)
    north, east, down = harness.vehicle.airframe.position
    assert north == pytest.approx(10.0, abs=0.6)  # the integrator decays slowly
    assert east == pytest.approx(0.0, abs=0.3)
    assert down == pytest.approx(-8.0, abs=0.3)
    assert harness.vehicle.airframe.yaw_rad == pytest.approx(math.pi / 2, abs=0.05)
    assert harness.mode == "HOLD"


def test_reposition_without_the_change_of_mode_is_unsupported(harness: SimHarness) -> None:
    harness.take_off()
    assert harness.command_int(192, (-1, 0, 0, NAN), 473978330, 85455942, 497.4) == [3]


def test_hold_brakes_and_stays(harness: SimHarness, velocity_setpoint: Any) -> None:
    harness.take_off(5.0)
    fast = velocity_setpoint(4, 0, 0)
    harness.offboard(fast)
    harness.fly(5.0, fast)
    before = harness.vehicle.airframe.position[0]
    harness.set_mode(4, 3)
    harness.fly(12.0)
    assert math.hypot(*harness.vehicle.airframe.velocity) < 0.12
    assert 1.0 < harness.vehicle.airframe.position[0] - before < 8.0


def test_gimbal_commands_sent_at_every_landing(harness: SimHarness) -> None:
    harness.take_off(4.0)
    harness.forget()
    harness.command(21)
    harness.fly(3.0)
    sent = [
        (m.target_system, m.target_component, m.command, m.confirmation)
        for m in harness.received("COMMAND_LONG")
    ]
    assert sent == [
        (1, 0, 1001, 0),
        (1, 0, 1000, 0),
        (1, 0, 1001, 0),
        (1, 0, 1001, 1),
        (1, 0, 1001, 2),
        (1, 0, 1001, 3),
    ]
