"""TAKEOFF, LAND, RTL, HOLD and DO_REPOSITION, with the landed states they pass through."""

import math
from typing import Any

import pytest

from mavlink_sim.physics.geography import geographic
from tests.mavlink_sim.conftest import Cockpit

NAN = math.nan


def landed_states(cockpit: Cockpit) -> list[int]:
    """The EXTENDED_SYS_STATE.landed_state received, without repetitions."""
    found: list[int] = []
    for message in cockpit.received("EXTENDED_SYS_STATE"):
        if found[-1:] != [message.landed_state]:
            found.append(message.landed_state)
    return found


def test_take_off_climbs_to_two_and_a_half_metres_and_holds(cockpit: Cockpit) -> None:
    cockpit.wait_ready()
    assert cockpit.command(400, 1) == [0]
    cockpit.forget()
    armed_s = cockpit.now_s
    assert cockpit.command(22, NAN, 0, 0, NAN, NAN, NAN, NAN) == [0]
    assert cockpit.mode == "TAKEOFF"
    cockpit.until(lambda: not cockpit.vehicle.autopilot.landed)
    assert 1.5 < cockpit.now_s - armed_s < 2.5
    cockpit.until(lambda: cockpit.mode == "HOLD")
    assert 6.5 <= cockpit.now_s - armed_s <= 9.0
    assert 1.8 <= cockpit.height_m <= 2.2
    cockpit.fly(6.0)
    assert cockpit.height_m == pytest.approx(2.5, abs=0.15)
    assert landed_states(cockpit) == [1, 3, 2]


@pytest.mark.parametrize("seed", range(4))
def test_in_moving_air_too_hold_begins_after_6_5_to_9_s_at_1_8_to_2_2_m(
    make_cockpit: type[Cockpit], seed: int
) -> None:
    cockpit = make_cockpit(noise=True, gusts_mps=None, seed=seed)
    cockpit.wait_ready()
    assert cockpit.command(400, 1) == [0]
    armed_s = cockpit.now_s
    cockpit.command(22, NAN, 0, 0, NAN, NAN, NAN, NAN)
    cockpit.until(lambda: cockpit.mode == "HOLD")
    assert 6.5 <= cockpit.now_s - armed_s <= 9.0
    assert 1.8 <= cockpit.height_m <= 2.2


@pytest.mark.parametrize(("height_m", "least_s", "most_s"), [(4.0, 7.2, 8.0), (5.0, 7.8, 8.7)])
def test_a_higher_take_off_holds_as_soon_as_measured(
    cockpit: Cockpit, height_m: float, least_s: float, most_s: float
) -> None:
    cockpit.wait_ready()
    cockpit.command(400, 1)
    cockpit.command(22, NAN, 0, 0, NAN, NAN, NAN, 489.4 + height_m)
    assert cockpit.mode == "TAKEOFF"
    assert least_s <= cockpit.until(lambda: cockpit.mode == "HOLD") + 0.04 <= most_s


def test_it_is_in_air_as_hold_begins_and_not_before(cockpit: Cockpit) -> None:
    cockpit.wait_ready()
    cockpit.command(400, 1)
    cockpit.command(22, NAN, 0, 0, NAN, NAN, NAN, NAN)
    states: list[tuple[str, int]] = []

    def watch() -> bool:
        state = (cockpit.mode, int(cockpit.vehicle.autopilot.landed_state))
        if states[-1:] != [state]:
            states.append(state)
        return bool(state[0] == "HOLD")

    cockpit.until(watch)
    assert states == [("TAKEOFF", 1), ("TAKEOFF", 3), ("HOLD", 2)]


def test_take_off_to_a_given_altitude_above_sea(cockpit: Cockpit) -> None:
    cockpit.take_off(6.0)
    cockpit.fly(6.0)
    assert cockpit.height_m == pytest.approx(6.0, abs=0.3)


def test_take_off_is_accepted_before_arming_and_waits_for_it(cockpit: Cockpit) -> None:
    cockpit.fly(0.5)  # not even ready
    assert cockpit.command(22, NAN, 0, 0, NAN, NAN, NAN, NAN) == [0]
    assert not cockpit.armed
    cockpit.wait_ready()
    assert cockpit.command(400, 1) == [0]
    cockpit.until(lambda: cockpit.mode == "HOLD")
    assert cockpit.height_m > 1.5


def test_the_mode_take_off_alone_takes_off_once_armed(cockpit: Cockpit) -> None:
    cockpit.wait_ready()
    assert cockpit.set_mode(4, 2) == [0, 0]
    assert cockpit.command(400, 1) == [0]
    cockpit.until(lambda: cockpit.mode == "HOLD")
    assert cockpit.height_m > 1.5


def test_take_off_while_flying_is_accepted_and_does_not_descend(cockpit: Cockpit) -> None:
    cockpit.take_off(6.0)
    cockpit.fly(5.0)
    assert cockpit.command(22, NAN, 0, 0, NAN, NAN, NAN, NAN) == [0]
    cockpit.fly(3.0)
    assert cockpit.height_m > 5.5
    assert cockpit.mode == "HOLD"


def test_landing_touches_down_softly_and_disarms_two_seconds_later(cockpit: Cockpit) -> None:
    cockpit.take_off(4.0)
    cockpit.fly(4.0)
    cockpit.forget()
    assert cockpit.command(21, 0, 0, 0, NAN, NAN, NAN, NAN) == [0]
    assert cockpit.heartbeat().custom_mode == 0x06040000
    took = cockpit.until(lambda: cockpit.vehicle.airframe.on_ground, 20.0)
    cockpit.until(lambda: cockpit.vehicle.autopilot.landed, 5.0)
    assert 6.0 <= took <= 12.0
    assert 1.9 < cockpit.until(lambda: not cockpit.armed, 5.0) < 2.1
    cockpit.fly(0.5)
    assert landed_states(cockpit) == [4, 1]


def test_after_a_landing_the_mode_chosen_before_it_comes_back(cockpit: Cockpit) -> None:
    cockpit.take_off()
    cockpit.command(21)
    cockpit.until(lambda: not cockpit.armed, 30.0)
    assert cockpit.mode == "HOLD"
    assert cockpit.heartbeat().system_status == 3


def test_leaving_land_in_the_air_is_in_air_again(cockpit: Cockpit) -> None:
    cockpit.take_off(5.0)
    cockpit.forget()
    cockpit.command(21)
    cockpit.fly(1.0)
    cockpit.set_mode(4, 3)
    cockpit.fly(1.0)
    assert landed_states(cockpit)[-2:] == [4, 2]


def test_return_close_to_home_stays_low_lands_and_disarms(cockpit: Cockpit) -> None:
    cockpit.heartbeats.append(("gcs", (245, 190), 6))
    cockpit.take_off(4.0)
    cockpit.fly(4.0)
    cockpit.forget()
    highest = cockpit.height_m
    assert cockpit.command(20) == [0]
    assert cockpit.mode == "RTL"
    cockpit.until(lambda: not cockpit.armed, 60.0)
    assert highest < 4.5
    assert landed_states(cockpit)[-2:] == [4, 1]
    said = cockpit.texts()
    assert said[:2] == ["Returning to launch\t", "RTL: start return at 493 m (4 m above destination)\t"]
    assert said[-3:] == ["RTL: land at destination\t", "Landing detected\t", "Disarmed by landing\t"]


def test_return_from_afar_climbs_to_the_return_altitude_and_lands_at_home(
    make_cockpit: type[Cockpit],
) -> None:
    cockpit = make_cockpit(parameters={"RTL_RETURN_ALT": 12.0})
    cockpit.take_off(4.0)
    assert cockpit.command_int(192, (-1, 1, 0, NAN), 473980000, 85455942, 494.4) == [0]
    cockpit.fly(14.0)
    assert math.dist(cockpit.vehicle.airframe.position, (28.5, 0.0, -5.0)) < 1.5
    cockpit.command(20)
    cockpit.until(lambda: cockpit.vehicle.airframe.position[0] < 15.0, 40.0)
    assert abs(math.degrees(cockpit.vehicle.airframe.yaw_rad)) > 150.0  # it flies nose first
    highest = 0.0

    def done() -> bool:
        nonlocal highest
        highest = max(highest, cockpit.height_m)
        return not cockpit.armed

    cockpit.until(done, 90.0)
    assert 11.5 < highest < 13.0
    assert math.hypot(*cockpit.vehicle.airframe.position[:2]) < 1.0
    # and lands as it stood when it was armed: so did a real PX4
    assert cockpit.vehicle.airframe.yaw_rad == pytest.approx(0.0, abs=0.05)


@pytest.mark.parametrize(
    ("parameters", "heading_deg", "landed_deg"),
    [({}, 70.0, 70.0), ({"WV_EN": 1}, 70.0, 120.0), ({}, math.nan, 120.0)],
)
def test_close_to_home_a_return_turns_to_the_heading_of_home(
    make_cockpit: type[Cockpit], parameters: dict[str, float], heading_deg: float, landed_deg: float
) -> None:
    cockpit = make_cockpit(parameters=parameters)
    cockpit.take_off(5.0)
    latitude, longitude, altitude = geographic((0.0, 0.0, 0.0))
    assert cockpit.command(179, 0, 0, 0, heading_deg, latitude, longitude, altitude) == [0]
    at, above = (round(latitude * 1e7) + 540, round(longitude * 1e7)), altitude + 5.0  # 6 m north
    assert cockpit.command_int(192, (-1, 1, 0, math.radians(120.0)), *at, above) == [0]
    cockpit.fly(8.0)
    assert math.degrees(cockpit.vehicle.airframe.yaw_rad) == pytest.approx(120.0, abs=2.0)
    cockpit.command(20)
    cockpit.until(lambda: not cockpit.armed, 60.0)
    assert math.degrees(cockpit.vehicle.airframe.yaw_rad) == pytest.approx(landed_deg, abs=3.0)


@pytest.mark.parametrize(("seed", "wind_mps"), [(0, 0.0), (1, 0.0), (2, 5.0)])
def test_return_in_moving_air_ends_at_home_too(
    make_cockpit: type[Cockpit], velocity_setpoint: Any, seed: int, wind_mps: float
) -> None:
    cockpit = make_cockpit(gusts_mps=None, seed=seed, wind_mps=wind_mps)
    cockpit.take_off(6.0)
    away = velocity_setpoint(3, 0, 0)
    cockpit.offboard(away)
    cockpit.fly(6.0, away)  # and then nothing: the failsafe returns
    cockpit.until(lambda: not cockpit.armed, 90.0)
    # the gusts of the last metres decide: with other seeds it is 0.4 to 3 m
    assert math.hypot(*cockpit.vehicle.airframe.position[:2]) < 3.5


def test_reposition_flies_there_and_turns_to_the_given_heading(cockpit: Cockpit) -> None:
    cockpit.take_off(5.0)
    assert cockpit.command_int(192, (-1, 1, 0, math.pi / 2), 473978330, 85455942, 497.4) == [0]
    cockpit.fly(25.0)
    north, east, down = cockpit.vehicle.airframe.position
    assert north == pytest.approx(10.0, abs=0.6)  # the integrator lets go slowly
    assert east == pytest.approx(0.0, abs=0.3)
    assert down == pytest.approx(-8.0, abs=0.3)
    assert cockpit.vehicle.airframe.yaw_rad == pytest.approx(math.pi / 2, abs=0.05)
    assert cockpit.mode == "HOLD"


def test_reposition_without_the_change_of_mode_is_unsupported(cockpit: Cockpit) -> None:
    cockpit.take_off()
    assert cockpit.command_int(192, (-1, 0, 0, NAN), 473978330, 85455942, 497.4) == [3]


def test_hold_brakes_and_stays(cockpit: Cockpit, velocity_setpoint: Any) -> None:
    cockpit.take_off(5.0)
    fast = velocity_setpoint(4, 0, 0)
    cockpit.offboard(fast)
    cockpit.fly(5.0, fast)
    before = cockpit.vehicle.airframe.position[0]
    cockpit.set_mode(4, 3)
    cockpit.fly(12.0)
    assert math.hypot(*cockpit.vehicle.airframe.velocity) < 0.12
    assert 1.0 < cockpit.vehicle.airframe.position[0] - before < 8.0


def test_a_gimbal_is_looked_after_at_every_landing(cockpit: Cockpit) -> None:
    cockpit.take_off(4.0)
    cockpit.forget()
    cockpit.command(21)
    cockpit.fly(3.0)
    sent = [
        (m.target_system, m.target_component, m.command, m.confirmation)
        for m in cockpit.received("COMMAND_LONG")
    ]
    assert sent == [
        (1, 0, 1001, 0),
        (1, 0, 1000, 0),
        (1, 0, 1001, 0),
        (1, 0, 1001, 1),
        (1, 0, 1001, 2),
        (1, 0, 1001, 3),
    ]
