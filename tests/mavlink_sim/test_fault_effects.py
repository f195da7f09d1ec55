"""What each fault does to the vehicle, in lockstep."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest

from mavlink_sim.physics.geography import local
from mavlink_sim.wire.messages import dialect
from tests.mavlink_sim.conftest import Cockpit

DO_SET_MODE, LAND, ARM, REQUEST_MESSAGE = 176, 21, 400, 512
GPS_ID, ESTIMATOR_ID = 24, 230


def newest(cockpit: Cockpit, kind: str, within_s: float = 2.5) -> Any:
    """The next message of a kind."""
    cockpit.forget()
    cockpit.until(lambda: bool(cockpit.received(kind)), within_s)
    return cockpit.received(kind)[-1]


def begin(cockpit: Cockpit, line: str) -> int:
    return cockpit.vehicle.faults.begin(line)


# ---- what is said


@pytest.mark.hears("everything")
def test_of_a_vehicle_with_heartbeats_only_answers_still_come(cockpit: Cockpit) -> None:
    cockpit.fly(6.0)  # what a start alone sends is over
    begin(cockpit, "heartbeat_only link=onboard")
    cockpit.forget()
    cockpit.send(dialect.MAVLink_timesync_message(0, 5))
    assert cockpit.command(REQUEST_MESSAGE, 148) == [0]
    cockpit.fly(3.0)
    kinds = {item.message.get_type() for _, item in cockpit.inbox["onboard"]}
    assert kinds == {"HEARTBEAT", "COMMAND_ACK", "TIMESYNC", "AUTOPILOT_VERSION"}
    assert cockpit.received("ATTITUDE", "gcs")
    cockpit.vehicle.faults.end()
    cockpit.fly(0.5)
    assert cockpit.received("ATTITUDE")


def test_acknowledgements_are_lost_all_or_the_nth(cockpit: Cockpit) -> None:
    cockpit.wait_ready()
    begin(cockpit, "lost_ack")
    assert cockpit.command(178) == []
    cockpit.vehicle.faults.end()
    begin(cockpit, "lost_ack 2")
    assert cockpit.command(DO_SET_MODE, 1, 4, 3) == [0]  # of two the second is gone
    cockpit.fly(0.02)
    assert not cockpit.vehicle.faults.active
    assert cockpit.command(178) == [0]
    begin(cockpit, "lost_ack command=400")
    assert cockpit.command(178) == [0]
    assert cockpit.command(ARM, 1) == []
    assert cockpit.armed


@pytest.mark.hears("everything")
def test_the_boot_clock_jumps_in_every_stamp_and_back(cockpit: Cockpit) -> None:
    cockpit.fly(2.0)
    begin(cockpit, "time_jump 100 for=3")
    cockpit.forget()
    cockpit.send(dialect.MAVLink_timesync_message(0, 5))
    cockpit.fly(1.1)
    now_ms = cockpit.now_s * 1000
    for kind in ("ATTITUDE", "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT", "SYSTEM_TIME"):
        assert cockpit.received(kind)[-1].time_boot_ms == pytest.approx(now_ms + 100_000, abs=1100), kind
    for kind in ("ODOMETRY", "HIGHRES_IMU", "ALTITUDE", "ESTIMATOR_STATUS"):
        assert cockpit.received(kind)[-1].time_usec == pytest.approx(now_ms * 1e3 + 1e8, abs=1.1e6), kind
    answers = [message for message in cockpit.received("TIMESYNC") if message.tc1]
    assert answers[0].tc1 == pytest.approx(102e9, abs=0.1e9)
    assert answers[0].ts1 == 5
    cockpit.fly(3.0)
    assert newest(cockpit, "ATTITUDE").time_boot_ms == pytest.approx(cockpit.now_s * 1000, abs=20)
    begin(cockpit, "time_jump -3")
    assert newest(cockpit, "ATTITUDE").time_boot_ms == pytest.approx((cockpit.now_s - 3) * 1000, abs=20)


@pytest.mark.hears("everything")
def test_a_second_autopilot_speaks_and_answers(cockpit: Cockpit) -> None:
    cockpit.wait_ready()
    begin(cockpit, "second_autopilot 9")
    cockpit.forget()
    cockpit.fly(2.5)
    systems = {
        item.message.get_srcSystem()
        for _, item in cockpit.inbox["onboard"]
        if item.forwarded and item.message.get_type() == "HEARTBEAT"
    }
    assert systems == {9}
    assert len([m for m in cockpit.received("LOCAL_POSITION_NED") if m.get_srcSystem() == 9]) > 50
    assert cockpit.command(ARM, 1, target=(9, 1)) == [0]
    assert not cockpit.armed
    cockpit.vehicle.faults.end()
    cockpit.forget()
    cockpit.fly(1.5)
    assert not [item for _, item in cockpit.inbox["onboard"] if item.forwarded]


@pytest.mark.hears("GLOBAL_POSITION_INT")
def test_a_second_autopilot_of_the_same_system_gives_every_answer_twice(cockpit: Cockpit) -> None:
    cockpit.wait_ready()
    begin(cockpit, "second_autopilot")
    cockpit.fly(0.5)
    assert cockpit.command(ARM, 1) == [0, 0]
    places = [
        local(message.lat / 1e7, message.lon / 1e7, 0.0)
        for message in cockpit.received("GLOBAL_POSITION_INT")
    ]
    assert {round(east) for _, east, _ in places} == {0, 25}


@pytest.mark.hears("everything")
def test_a_stalled_vehicle_stands_still_and_reads_all_afterwards(cockpit: Cockpit) -> None:
    cockpit.wait_ready()
    begin(cockpit, "stall for=2")
    boot_ms = cockpit.vehicle.boot_ms
    cockpit.forget()
    cockpit.send(dialect.MAVLink_command_long_message(1, 1, ARM, 0, 1, 0, 0, 0, 0, 0, 0))
    for _ in range(400):
        cockpit.vehicle.step(0.004)
    assert cockpit.vehicle.boot_ms == boot_ms
    assert not cockpit.vehicle.outgoing("onboard")
    assert not cockpit.armed
    for _ in range(200):
        cockpit.vehicle.step(0.004)
    assert cockpit.armed
    assert cockpit.vehicle.boot_ms == pytest.approx(boot_ms + 400, abs=10)


def test_a_slow_vehicle_goes_at_a_part_of_its_pace(cockpit: Cockpit) -> None:
    begin(cockpit, "stall 0.25")
    for _ in range(1000):
        cockpit.vehicle.step(0.004)
    assert cockpit.now_s == pytest.approx(1.0, abs=0.02)
    assert cockpit.vehicle.faults.now_s == pytest.approx(4.0)


# ---- position and estimate


@pytest.mark.hears("GPS_RAW_INT", "LOCAL_POSITION_NED", "ODOMETRY")
def test_offboard_by_position_ends_blind_when_gps_is_lost_and_resumes(
    cockpit: Cockpit, position_setpoint: Callable[..., Any]
) -> None:
    cockpit.heartbeats = [("gcs", (245, 190), 6)]
    cockpit.take_off(20.0)
    setpoint = position_setpoint(0, 0, -20)
    cockpit.offboard(setpoint)
    begin(cockpit, "gps_loss for=9 seed=1")
    cockpit.fly(1.2, setpoint)
    fix = cockpit.received("GPS_RAW_INT")[-1]
    assert (fix.fix_type, fix.satellites_visible) == (1, 0)
    assert not cockpit.received("SYS_STATUS")[-1].onboard_control_sensors_health & 0x20
    assert cockpit.mode == "OFFBOARD"  # dead reckoning
    took_s = cockpit.until(lambda: cockpit.mode != "OFFBOARD", 6.0, setpoint)
    assert took_s == pytest.approx(3.8, abs=0.1)
    assert cockpit.mode == "LAND"  # how PX4 shows Descend
    assert "GNSS data fusion stopped\t" in cockpit.texts()
    assert "Failsafe activated\t" in cockpit.texts()
    assert cockpit.heartbeat().system_status == 5
    cockpit.fly(1.5, setpoint)
    assert cockpit.vehicle.airframe.velocity[2] == pytest.approx(0.7, abs=0.2)  # MPC_LAND_SPEED
    assert cockpit.set_mode(4, 3) == [0, 1]
    assert cockpit.command(20) == [1]  # return to launch
    assert newest(cockpit, "ESTIMATOR_STATUS").flags & (2 | 8 | 16) == 0
    # PX4 goes on sending positions that stand still
    cockpit.forget()
    cockpit.until(lambda: not cockpit.vehicle.faults.active, 9.0, setpoint)
    places = {(message.x, message.y) for message in cockpit.received("LOCAL_POSITION_NED")}
    assert len(places) == 1
    cockpit.until(lambda: cockpit.mode == "OFFBOARD", 2.0, setpoint)
    assert newest(cockpit, "ODOMETRY").reset_counter > 0


def test_offboard_by_attitude_needs_no_position() -> None:
    from mavlink_sim.autopilot.position_failsafe import asks_for_position
    from mavlink_sim.flight.position_control import TrajectorySetpoint

    assert asks_for_position(TrajectorySetpoint(velocity=(1.0, 0.0, 0.0)))
    assert not asks_for_position(TrajectorySetpoint(acceleration=(0.0, 0.0, 0.0)))
    assert not asks_for_position(object())


def test_hold_without_gps_descends_and_a_pilot_gets_altitude_mode(cockpit: Cockpit) -> None:
    cockpit.take_off(10.0)
    begin(cockpit, "gps_loss")
    cockpit.until(lambda: cockpit.mode == "LAND", 6.0)
    cockpit.until(lambda: not cockpit.armed, 30.0)
    assert cockpit.height_m == pytest.approx(0.0, abs=0.1)

    assert not cockpit.vehicle.autopilot.can_arm  # in a mode that needs a position
    assert cockpit.command(ARM, 1) == [1]


def test_position_mode_falls_to_altitude_where_a_pilot_has_sticks(cockpit: Cockpit) -> None:
    cockpit.take_off(10.0)
    begin(cockpit, "pilot_takeover POSCTL")
    assert cockpit.mode == "POSCTL"
    begin(cockpit, "gps_loss")
    cockpit.until(lambda: cockpit.mode != "POSCTL", 6.0)
    assert cockpit.mode == "ALTCTL"


@pytest.mark.hears("GLOBAL_POSITION_INT", "GPS_RAW_INT")
def test_a_drifting_gps_takes_the_vehicle_along(cockpit: Cockpit) -> None:
    cockpit.take_off(10.0)
    begin(cockpit, "gps_drift 0.5 towards=0")
    cockpit.fly(10.0)
    assert cockpit.vehicle.estimate.position[0] == pytest.approx(0.0, abs=0.7)
    assert cockpit.vehicle.airframe.position[0] == pytest.approx(-5.0, abs=0.8)
    fix, told = newest(cockpit, "GPS_RAW_INT"), newest(cockpit, "GLOBAL_POSITION_INT")
    assert fix.lat == pytest.approx(told.lat, abs=60)
    assert fix.fix_type == 3


@pytest.mark.hears("LOCAL_POSITION_NED", "ODOMETRY")
def test_an_estimator_reset_moves_the_estimate_and_not_the_vehicle(
    cockpit: Cockpit, position_setpoint: Callable[..., Any]
) -> None:
    cockpit.take_off(10.0)
    setpoint = position_setpoint(0, 0, -10)
    cockpit.offboard(setpoint)
    cockpit.fly(3.0, setpoint)
    before = cockpit.vehicle.airframe.position
    begin(cockpit, "ekf_reset 3 0 0 yaw=20")
    assert cockpit.vehicle.airframe.position == before
    cockpit.fly(0.05, setpoint)
    assert cockpit.received("LOCAL_POSITION_NED")[-1].x == pytest.approx(before[0] + 3.0, abs=0.2)
    odometry = cockpit.received("ODOMETRY")[-1]
    assert odometry.reset_counter == 2
    assert 2 * math.atan2(odometry.q[3], odometry.q[0]) == pytest.approx(math.radians(20), abs=0.1)
    cockpit.fly(6.0, setpoint)  # an absolute setpoint is flown to in the new frame
    assert cockpit.vehicle.airframe.position[0] == pytest.approx(-3.0, abs=0.6)
    cockpit.vehicle.faults.end()
    cockpit.fly(0.05, setpoint)
    assert cockpit.received("ODOMETRY")[-1].reset_counter == 4


# ---- power, rotors, air


def test_a_battery_has_what_it_is_given_and_is_used_up(cockpit: Cockpit) -> None:
    cockpit.take_off(5.0)
    begin(cockpit, "battery 0.5")
    assert newest(cockpit, "SYS_STATUS").battery_remaining == 50
    cockpit.fly(6.0)
    assert newest(cockpit, "SYS_STATUS").battery_remaining == pytest.approx(41, abs=2)
    cockpit.vehicle.faults.end()
    assert newest(cockpit, "SYS_STATUS").battery_remaining > 60


def test_a_battery_that_fails_brings_the_vehicle_down(make_cockpit: type[Cockpit]) -> None:
    cockpit = make_cockpit(parameters={"COM_FAIL_ACT_T": 0})
    cockpit.take_off(5.0)
    begin(cockpit, "battery emergency")
    cockpit.fly(0.1)
    assert cockpit.mode == "LAND"
    assert "failsafe: battery emergency, LAND" in cockpit.events
    assert cockpit.heartbeat().system_status == 5


@pytest.mark.parametrize(
    ("warning", "percent", "charge_state", "text", "mode"),
    [
        ("low", 14, 2, "Low battery\t", "HOLD"),
        ("critical", 7, 3, "Critical battery\t", "RTL"),
        ("emergency", 4, 4, "Emergency battery level\t", "LAND"),
    ],
)
def test_a_battery_warning_holds_and_has_its_failsafe_by_default(
    cockpit: Cockpit, warning: str, percent: int, charge_state: int, text: str, mode: str
) -> None:
    cockpit.heartbeats.append(("gcs", (245, 190), 6))  # texts go to a ground station that speaks
    cockpit.take_off(30.0)
    begin(cockpit, f"battery {warning}")
    cockpit.fly(12.0)  # an unhurried client's time to see it
    assert text in cockpit.texts()
    assert newest(cockpit, "SYS_STATUS").battery_remaining == percent
    assert newest(cockpit, "BATTERY_STATUS").charge_state == charge_state
    warnings = [line for line in cockpit.events if line.startswith("battery")]
    assert warnings == [f"battery {warning}: {percent}%"]  # and no worse one after it
    assert cockpit.mode == mode


def test_after_a_battery_fault_the_breaker_counts_again(cockpit: Cockpit) -> None:
    cockpit.wait_ready()
    begin(cockpit, "battery critical")
    cockpit.fly(0.1)
    assert cockpit.command(400, 1) == [1]
    cockpit.vehicle.faults.end()
    cockpit.fly(0.1)
    assert cockpit.command(400, 1) == [0]
    cockpit.vehicle.autopilot.supervision.battery.charge = 0.04
    cockpit.fly(0.1)
    assert cockpit.vehicle.parameters.number("CBRK_SUPPLY_CHK") == 894281
    assert not cockpit.vehicle.autopilot.supervision.battery.is_checked


def test_of_two_failsafes_the_worse_one_is_flown(
    make_cockpit: type[Cockpit], velocity_setpoint: Callable[..., Any]
) -> None:
    cockpit = make_cockpit(parameters={"CBRK_SUPPLY_CHK": 0, "COM_FAIL_ACT_T": 0})
    cockpit.take_off(8.0)
    cockpit.offboard(velocity_setpoint(0, 0, 0))
    cockpit.until(lambda: cockpit.mode == "RTL", 2.0)  # the stream is lost
    begin(cockpit, "battery emergency for=0.5")
    cockpit.fly(0.1)
    assert cockpit.mode == "LAND"
    cockpit.fly(0.2, velocity_setpoint(0, 0, 0))  # the stream is back, which now changes nothing
    assert cockpit.mode == "LAND"


@pytest.mark.parametrize("motor", [1, 4])
def test_a_vehicle_that_loses_a_motor_comes_down(cockpit: Cockpit, motor: int) -> None:
    cockpit.take_off(15.0)
    begin(cockpit, f"motor_failure {motor}")
    cockpit.fly(1.0)
    tilt = math.hypot(cockpit.vehicle.airframe.roll_rad, cockpit.vehicle.airframe.pitch_rad)
    assert tilt > math.radians(10)
    cockpit.until(lambda: cockpit.height_m < 0.3, 30.0)


def test_wind_blows_from_where_it_comes_and_stops(cockpit: Cockpit) -> None:
    cockpit.take_off(10.0)
    calm = cockpit.vehicle.airframe.pitch_rad
    begin(cockpit, "wind 5 from=0 for=8")
    cockpit.fly(6.0)
    assert cockpit.vehicle.airframe.wind[0] == pytest.approx(-5.0)
    assert cockpit.vehicle.airframe.pitch_rad < calm - 0.2  # nose down, against it
    cockpit.fly(4.0)
    assert cockpit.vehicle.airframe.wind == (0.0, 0.0, 0.0)


def test_a_gust_rises_and_falls_once(cockpit: Cockpit) -> None:
    begin(cockpit, "gust 8 from=90 for=2")
    seen = []
    for _ in range(int(2.2 / 0.004)):
        cockpit.vehicle.step(0.004)
        seen.append(-cockpit.vehicle.airframe.wind[1])
    assert max(seen) == pytest.approx(8.0, abs=0.1)
    assert seen.index(max(seen)) * 0.004 == pytest.approx(1.0, abs=0.05)
    assert seen[-1] == 0.0
    assert not cockpit.vehicle.faults.active


# ---- command


def test_a_pilot_takes_the_vehicle_out_of_offboard(
    cockpit: Cockpit, velocity_setpoint: Callable[..., Any]
) -> None:
    cockpit.take_off(5.0)
    setpoint = velocity_setpoint(1, 0, 0)
    cockpit.offboard(setpoint)
    begin(cockpit, "pilot_takeover")
    cockpit.fly(2.0, setpoint)
    assert cockpit.mode == "POSCTL"


def test_a_pilot_who_goes_away_again_leaves_the_mode_behind(cockpit: Cockpit) -> None:
    cockpit.take_off(5.0)
    begin(cockpit, "pilot_takeover for=1")
    cockpit.fly(3.0)
    assert cockpit.mode == "POSCTL"


def test_where_a_remote_control_counts_its_pilot_going_away_is_a_failsafe(
    make_cockpit: type[Cockpit],
) -> None:
    cockpit = make_cockpit(parameters={"COM_RC_IN_MODE": 0})
    cockpit.take_off(5.0)
    begin(cockpit, "pilot_takeover for=2")
    cockpit.fly(1.9)
    assert cockpit.mode == "POSCTL"
    cockpit.fly(0.3)
    assert cockpit.mode == "HOLD"
    cockpit.until(lambda: cockpit.mode == "RTL", 6.0)
    assert "failsafe: manual control lost, RTL" in cockpit.events


def test_a_mode_is_refused_so_often_and_then_taken(cockpit: Cockpit) -> None:
    cockpit.take_off(5.0)
    begin(cockpit, "refuse_mode LAND count=2")
    assert cockpit.command(LAND) == [1]
    assert cockpit.set_mode(4, 6) == [0, 1]
    assert cockpit.set_mode(4, 3) == [0, 0]
    assert cockpit.mode == "HOLD"
    assert not cockpit.vehicle.faults.active
    assert cockpit.command(LAND) == [0]
    assert cockpit.mode == "LAND"


@pytest.mark.hears("everything")
def test_a_reboot_in_flight_is_silent_then_new_and_disarmed(cockpit: Cockpit) -> None:
    cockpit.take_off(30.0)
    assert cockpit.command(511, 30, 50_000) == [0]  # a setting, and settings are forgotten
    begin(cockpit, "reboot 2")
    cockpit.forget()
    cockpit.fly(1.9)
    assert not cockpit.inbox["onboard"]
    assert not cockpit.inbox["gcs"]
    assert not cockpit.armed
    assert cockpit.vehicle.airframe.velocity[2] > 5.0  # it falls
    cockpit.fly(2.0)
    assert cockpit.received("ATTITUDE")[0].time_boot_ms == pytest.approx(2000, abs=50)
    assert not cockpit.received("HEARTBEAT")[0].base_mode & 128
    assert cockpit.vehicle.links["onboard"].streams.interval_us("ATTITUDE") == 10_000
    cockpit.until(lambda: cockpit.height_m < 0.1, 10.0)


def test_a_reboot_on_the_ground_is_ready_again(cockpit: Cockpit) -> None:
    cockpit.fly(10.0)
    begin(cockpit, "reboot 2")
    cockpit.fly(2.1)
    assert not cockpit.vehicle.autopilot.can_arm
    cockpit.fly(3.0)
    assert cockpit.command(ARM, 1) == [0]


def test_what_needs_a_position_is_refused_without_one_and_land_is_not(cockpit: Cockpit) -> None:
    cockpit.heartbeats.append(("gcs", (245, 190), 6))
    cockpit.take_off(8.0)
    begin(cockpit, "gps_loss")
    cockpit.until(lambda: not cockpit.vehicle.autopilot.position_valid, 10.0)
    cockpit.fly(0.1)
    assert type(cockpit.vehicle.autopilot.task).__name__ == "Descend"
    cockpit.forget()
    nan = float("nan")
    for name, command in (
        ("Hold", (192, -1, 1, 0, nan, 47.3977, 8.5456, 495)),  # DO_REPOSITION
        ("Hold", (186, 500)),  # DO_CHANGE_ALTITUDE
        ("Takeoff", (22, nan, 0, 0, nan, nan, nan, 500)),
        ("Return", (20,)),
    ):
        assert cockpit.command(*command) == [1]
        assert cockpit.texts()[-1] == f"Switching to {name} is currently not available\t"
        cockpit.fly(1.0)
    assert cockpit.command(34, 5, 2, 0, 0, nan, nan, nan) == [1]  # DO_ORBIT
    assert cockpit.texts()[-1] == "Orbit command rejected"
    assert len(cockpit.texts()) == 5
    assert cockpit.command(LAND) == [0]
    assert cockpit.set_mode(4, 6) == [0, 0]  # AUTO_LAND
    assert type(cockpit.vehicle.autopilot.task).__name__ == "Descend"


def test_a_landing_goes_on_blindly_when_gps_is_lost(cockpit: Cockpit) -> None:
    cockpit.take_off(8.0)
    begin(cockpit, "gps_loss")
    cockpit.fly(2.0)
    assert cockpit.command(LAND) == [0]
    cockpit.until(lambda: not cockpit.vehicle.autopilot.position_valid, 5.0)
    cockpit.fly(0.1)
    assert type(cockpit.vehicle.autopilot.task).__name__ == "Descend"
    assert cockpit.mode == "LAND"
    cockpit.until(lambda: not cockpit.armed, 25.0)
