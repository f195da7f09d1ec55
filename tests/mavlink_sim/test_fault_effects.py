"""The effect of each fault on the vehicle, in lockstep."""

from __future__ import annotations

import math
from typing import Any

import pytest

from mavlink_sim.camera.freeze import CameraFreeze
from mavlink_sim.wire.messages import dialect
from tests.mavlink_sim.conftest import SIH_FRAME, SimHarness, position_setpoint, velocity_setpoint

DO_SET_MODE, LAND, ARM, REQUEST_MESSAGE = 176, 21, 400, 512

# STATUSTEXTs of PX4.
GNSS_STOPPED = "GNSS data fusion stopped\t"
MODE_REFUSED = "Switching to {} is currently not available\t"
ORBIT_REFUSED = "Orbit command rejected"

# Event lines of the simulator.
BATTERY_LANDS = "failsafe: battery emergency, LAND"
STICKS_LOST_RTL = "failsafe: manual control lost, RTL"


def newest(harness: SimHarness, kind: str, within_s: float = 2.5) -> Any:
    """The next message of a kind."""
    harness.forget()
    harness.until(lambda: bool(harness.received(kind)), within_s)
    return harness.received(kind)[-1]


def begin(harness: SimHarness, line: str) -> int:
    return harness.vehicle.faults.begin(line)


# ---- messages


@pytest.mark.streams("everything")
def test_heartbeat_only_still_answers(harness: SimHarness) -> None:
    harness.fly(6.0)  # what a start alone sends is over
    begin(harness, "heartbeat_only link=onboard")
    harness.forget()
    harness.send(dialect.MAVLink_timesync_message(0, 5))
    assert harness.command(REQUEST_MESSAGE, 148) == [0]
    harness.fly(3.0)
    kinds = {item.message.get_type() for _, item in harness.inbox["onboard"]}
    assert kinds == {"HEARTBEAT", "COMMAND_ACK", "TIMESYNC", "AUTOPILOT_VERSION"}
    assert harness.received("ATTITUDE", "gcs")
    harness.vehicle.faults.end()
    harness.fly(0.5)
    assert harness.received("ATTITUDE")


def test_acknowledgements_are_lost_all_or_the_nth(harness: SimHarness) -> None:
    harness.wait_ready()
    begin(harness, "lost_ack")
    assert harness.command(178) == []
    harness.vehicle.faults.end()
    begin(harness, "lost_ack 2")
    assert harness.command(DO_SET_MODE, 1, 4, 3) == [0]  # of two the second is gone
    harness.fly(0.02)
    assert not harness.vehicle.faults.active
    assert harness.command(178) == [0]
    begin(harness, "lost_ack command=400")
    assert harness.command(178) == [0]
    assert harness.command(ARM, 1) == []
    assert harness.armed


@pytest.mark.streams("everything")
def test_the_boot_clock_jumps_in_every_stamp_and_back(harness: SimHarness) -> None:
    harness.fly(2.0)
    begin(harness, "time_jump 100 for=3")
    harness.forget()
    harness.send(dialect.MAVLink_timesync_message(0, 5))
    harness.fly(1.1)
    now_ms = harness.now_s * 1000
    for kind in ("ATTITUDE", "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT", "SYSTEM_TIME"):
        assert harness.received(kind)[-1].time_boot_ms == pytest.approx(now_ms + 100_000, abs=1100), kind
    for kind in ("ODOMETRY", "HIGHRES_IMU", "ALTITUDE", "ESTIMATOR_STATUS"):
        assert harness.received(kind)[-1].time_usec == pytest.approx(now_ms * 1e3 + 1e8, abs=1.1e6), kind
    answers = [message for message in harness.received("TIMESYNC") if message.tc1]
    assert answers[0].tc1 == pytest.approx(102e9, abs=0.1e9)
    assert answers[0].ts1 == 5
    harness.fly(3.0)
    assert newest(harness, "ATTITUDE").time_boot_ms == pytest.approx(harness.now_s * 1000, abs=20)
    begin(harness, "time_jump -3")
    assert newest(harness, "ATTITUDE").time_boot_ms == pytest.approx((harness.now_s - 3) * 1000, abs=20)


@pytest.mark.streams("everything")
def test_second_autopilot_streams_and_answers(harness: SimHarness) -> None:
    harness.wait_ready()
    begin(harness, "second_autopilot 9")
    harness.forget()
    harness.fly(2.5)
    systems = {
        item.message.get_srcSystem()
        for _, item in harness.inbox["onboard"]
        if item.forwarded and item.message.get_type() == "HEARTBEAT"
    }
    assert systems == {9}
    assert len([m for m in harness.received("LOCAL_POSITION_NED") if m.get_srcSystem() == 9]) > 50
    assert harness.command(ARM, 1, target=(9, 1)) == [0]
    assert not harness.armed
    harness.vehicle.faults.end()
    harness.forget()
    harness.fly(1.5)
    assert not [item for _, item in harness.inbox["onboard"] if item.forwarded]


@pytest.mark.streams("GLOBAL_POSITION_INT")
def test_second_autopilot_of_same_system_doubles_answers(harness: SimHarness) -> None:
    harness.wait_ready()
    begin(harness, "second_autopilot")
    harness.fly(0.5)
    assert harness.command(ARM, 1) == [0, 0]
    positions = [
        SIH_FRAME.local(message.lat / 1e7, message.lon / 1e7, 0.0)
        for message in harness.received("GLOBAL_POSITION_INT")
    ]
    assert {round(east) for _, east, _ in positions} == {0, 25}


@pytest.mark.streams("everything")
def test_stalled_vehicle_reads_messages_afterwards(harness: SimHarness) -> None:
    harness.wait_ready()
    begin(harness, "stall for=2")
    boot_ms = harness.vehicle.boot_ms
    harness.forget()
    harness.send(dialect.MAVLink_command_long_message(1, 1, ARM, 0, 1, 0, 0, 0, 0, 0, 0))
    for _ in range(400):
        harness.vehicle.step(0.004)
    assert harness.vehicle.boot_ms == boot_ms
    assert not harness.vehicle.outgoing("onboard")
    assert not harness.armed
    for _ in range(200):
        harness.vehicle.step(0.004)
    assert harness.armed
    assert harness.vehicle.boot_ms == pytest.approx(boot_ms + 400, abs=10)


def test_slow_vehicle_runs_at_given_pace(harness: SimHarness) -> None:
    begin(harness, "stall 0.25")
    for _ in range(1000):
        harness.vehicle.step(0.004)
    assert harness.now_s == pytest.approx(1.0, abs=0.02)
    assert harness.vehicle.faults.now_s == pytest.approx(4.0)


# ---- position and estimate


@pytest.mark.streams("GPS_RAW_INT", "LOCAL_POSITION_NED", "ODOMETRY")
def test_offboard_position_descends_without_gps_and_resumes(harness: SimHarness) -> None:
    harness.heartbeats = [("gcs", (245, 190), 6)]
    harness.vehicle.parameters.set("COM_OBL_RC_ACT", 3)
    harness.take_off(20.0)
    setpoint = position_setpoint(0, 0, -20)
    harness.offboard(setpoint)
    begin(harness, "gps_loss for=9 seed=1")
    harness.fly(1.2, setpoint)
    fix = harness.received("GPS_RAW_INT")[-1]
    assert (fix.fix_type, fix.satellites_visible) == (1, 0)
    assert not harness.received("SYS_STATUS")[-1].onboard_control_sensors_health & 0x20
    assert harness.mode == "OFFBOARD"  # dead reckoning
    took_s = harness.until(lambda: harness.mode != "OFFBOARD", 6.0, setpoint)
    assert took_s == pytest.approx(3.8, abs=0.1)
    assert harness.mode == "LAND"  # how PX4 shows Descend
    assert GNSS_STOPPED in harness.texts()
    assert "Failsafe activated\t" in harness.texts()
    assert harness.heartbeat().system_status == 5
    harness.fly(1.5, setpoint)
    assert harness.vehicle.airframe.velocity[2] == pytest.approx(0.7, abs=0.2)  # MPC_LAND_SPEED
    assert harness.set_mode(4, 3) == [0, 1]
    assert harness.command(20) == [1]  # return to launch
    assert newest(harness, "ESTIMATOR_STATUS").flags & (2 | 8 | 16) == 0
    # PX4 goes on sending positions that stand still
    harness.forget()
    harness.until(lambda: not harness.vehicle.faults.active, 9.0, setpoint)
    positions = {(message.x, message.y) for message in harness.received("LOCAL_POSITION_NED")}
    assert len(positions) == 1
    harness.until(lambda: harness.mode == "OFFBOARD", 2.0, setpoint)
    assert newest(harness, "ODOMETRY").reset_counter > 0


@pytest.mark.parametrize(
    ("release", "sticks", "mode", "sinks"),
    [
        ("1.14", False, "ALTCTL", True),
        ("1.16", False, "ALTCTL", True),  # flown: 8.4 m to 0.9 m in 11 s
        ("1.17", False, "ALTCTL", True),
        ("1.18", False, "LAND", True),
        ("1.16", True, "ALTCTL", False),
        ("1.18", True, "ALTCTL", False),
    ],
)
def test_gps_loss_in_offboard_without_sticks_sinks(
    release: str, sticks: bool, mode: str, sinks: bool
) -> None:
    harness = SimHarness(px4=release)
    harness.take_off(8.0)
    harness.vehicle.autopilot.pilot_has_sticks = sticks
    setpoint = velocity_setpoint(0, 0, 0)
    harness.offboard(setpoint)
    begin(harness, "gps_loss seed=1")
    harness.until(lambda: harness.mode != "OFFBOARD", 6.0, setpoint)
    assert harness.mode == mode
    harness.fly(8.0, setpoint)
    assert (harness.height_m < 4.0) is sinks


def test_offboard_by_acceleration_needs_no_position() -> None:
    from mavlink_sim.autopilot.position_failsafe import asks_for_position
    from mavlink_sim.flight.position_control import TrajectorySetpoint

    assert asks_for_position(TrajectorySetpoint(velocity=(1.0, 0.0, 0.0)))
    assert not asks_for_position(TrajectorySetpoint(acceleration=(0.0, 0.0, 0.0)))


def test_hold_without_gps_descends_and_pilot_gets_altitude_mode(harness: SimHarness) -> None:
    harness.take_off(10.0)
    begin(harness, "gps_loss")
    harness.until(lambda: harness.mode == "LAND", 6.0)
    harness.until(lambda: not harness.armed, 30.0)
    assert harness.height_m == pytest.approx(0.0, abs=0.1)

    assert not harness.vehicle.autopilot.can_arm  # in a mode that needs a position
    assert harness.command(ARM, 1) == [1]


def test_position_mode_falls_to_altitude_where_pilot_has_sticks(harness: SimHarness) -> None:
    harness.take_off(10.0)
    begin(harness, "pilot_takeover POSCTL")
    assert harness.mode == "POSCTL"
    begin(harness, "gps_loss")
    harness.until(lambda: harness.mode != "POSCTL", 6.0)
    assert harness.mode == "ALTCTL"


@pytest.mark.streams("GLOBAL_POSITION_INT", "GPS_RAW_INT")
def test_gps_drift_moves_vehicle(harness: SimHarness) -> None:
    harness.take_off(10.0)
    begin(harness, "gps_drift 0.5 towards=0")
    harness.fly(10.0)
    assert harness.vehicle.estimate.position[0] == pytest.approx(0.0, abs=0.7)
    assert harness.vehicle.airframe.position[0] == pytest.approx(-5.0, abs=0.8)
    fix, reported = newest(harness, "GPS_RAW_INT"), newest(harness, "GLOBAL_POSITION_INT")
    assert fix.lat == pytest.approx(reported.lat, abs=60)
    assert fix.fix_type == 3


@pytest.mark.streams("LOCAL_POSITION_NED", "ODOMETRY")
def test_estimator_reset_moves_estimate_and_not_vehicle(harness: SimHarness) -> None:
    harness.take_off(10.0)
    setpoint = position_setpoint(0, 0, -10)
    harness.offboard(setpoint)
    harness.fly(3.0, setpoint)
    before = harness.vehicle.airframe.position
    begin(harness, "ekf_reset 3 0 0 yaw=20")
    assert harness.vehicle.airframe.position == before
    harness.fly(0.05, setpoint)
    assert harness.received("LOCAL_POSITION_NED")[-1].x == pytest.approx(before[0] + 3.0, abs=0.2)
    odometry = harness.received("ODOMETRY")[-1]
    assert odometry.reset_counter == 2
    assert 2 * math.atan2(odometry.q[3], odometry.q[0]) == pytest.approx(math.radians(20), abs=0.1)
    harness.fly(6.0, setpoint)  # an absolute setpoint is flown to in the new frame
    assert harness.vehicle.airframe.position[0] == pytest.approx(-3.0, abs=0.6)
    harness.vehicle.faults.end()
    harness.fly(0.05, setpoint)
    assert harness.received("ODOMETRY")[-1].reset_counter == 4


# ---- power, rotors, air


def test_battery_fault_sets_and_drains_charge(harness: SimHarness) -> None:
    harness.take_off(5.0)
    begin(harness, "battery 0.5")
    assert newest(harness, "SYS_STATUS").battery_remaining == 50
    harness.fly(6.0)
    assert newest(harness, "SYS_STATUS").battery_remaining == pytest.approx(41, abs=2)
    harness.vehicle.faults.end()
    assert newest(harness, "SYS_STATUS").battery_remaining > 60


def test_failed_battery_lands_vehicle() -> None:
    harness = SimHarness(parameters={"COM_FAIL_ACT_T": 0})
    harness.take_off(5.0)
    begin(harness, "battery emergency")
    harness.fly(0.1)
    assert harness.mode == "LAND"
    assert BATTERY_LANDS in harness.events
    assert harness.heartbeat().system_status == 5


@pytest.mark.parametrize(
    ("warning", "percent", "charge_state", "text", "mode"),
    [
        ("low", 14, 2, "Low battery\t", "HOLD"),
        ("critical", 7, 3, "Critical battery\t", "RTL"),
        ("emergency", 4, 4, "Emergency battery level\t", "LAND"),
    ],
)
def test_a_battery_warning_holds_and_has_its_failsafe_by_default(
    harness: SimHarness, warning: str, percent: int, charge_state: int, text: str, mode: str
) -> None:
    harness.heartbeats.append(("gcs", (245, 190), 6))  # texts go to a ground station that speaks
    harness.take_off(30.0)
    begin(harness, f"battery {warning}")
    harness.fly(12.0)  # time for a client to receive it
    assert text in harness.texts()
    assert newest(harness, "SYS_STATUS").battery_remaining == percent
    assert newest(harness, "BATTERY_STATUS").charge_state == charge_state
    warnings = [line for line in harness.events if line.startswith("battery")]
    assert warnings == [f"battery {warning}: {percent}%"]  # and no worse one after it
    assert harness.mode == mode


def test_supply_check_applies_again_after_battery_fault(harness: SimHarness) -> None:
    harness.wait_ready()
    begin(harness, "battery critical")
    harness.fly(0.1)
    assert harness.command(400, 1) == [1]
    harness.vehicle.faults.end()
    harness.fly(0.1)
    assert harness.command(400, 1) == [0]
    harness.vehicle.autopilot.supervision.battery.charge = 0.04
    harness.fly(0.1)
    assert harness.vehicle.parameters.number("CBRK_SUPPLY_CHK") == 894281
    assert not harness.vehicle.autopilot.supervision.battery.is_checked


def test_worse_of_two_failsafes_is_active() -> None:
    harness = SimHarness(parameters={"CBRK_SUPPLY_CHK": 0, "COM_FAIL_ACT_T": 0})
    harness.take_off(8.0)
    harness.offboard(velocity_setpoint(0, 0, 0))
    harness.until(lambda: harness.mode == "RTL", 2.0)  # the stream is lost
    begin(harness, "battery emergency for=0.5")
    harness.fly(0.1)
    assert harness.mode == "LAND"
    harness.fly(0.2, velocity_setpoint(0, 0, 0))  # the stream is back, which now changes nothing
    assert harness.mode == "LAND"


@pytest.mark.parametrize("motor", [1, 4])
def test_a_vehicle_that_loses_a_motor_comes_down(harness: SimHarness, motor: int) -> None:
    harness.take_off(15.0)
    begin(harness, f"motor_failure {motor}")
    harness.fly(1.0)
    tilt = math.hypot(harness.vehicle.airframe.roll_rad, harness.vehicle.airframe.pitch_rad)
    assert tilt > math.radians(10)
    harness.until(lambda: harness.height_m < 0.3, 30.0)


def test_wind_blows_from_where_it_comes_and_stops(harness: SimHarness) -> None:
    harness.take_off(10.0)
    calm = harness.vehicle.airframe.pitch_rad
    begin(harness, "wind 5 from=0 for=8")
    harness.fly(6.0)
    assert harness.vehicle.airframe.wind[0] == pytest.approx(-5.0)
    assert harness.vehicle.airframe.pitch_rad < calm - 0.2  # nose down, against it
    harness.fly(4.0)
    assert harness.vehicle.airframe.wind == (0.0, 0.0, 0.0)


def test_a_gust_rises_and_falls_once(harness: SimHarness) -> None:
    begin(harness, "gust 8 from=90 for=2")
    seen = []
    for _ in range(int(2.2 / 0.004)):
        harness.vehicle.step(0.004)
        seen.append(-harness.vehicle.airframe.wind[1])
    assert max(seen) == pytest.approx(8.0, abs=0.1)
    assert seen.index(max(seen)) * 0.004 == pytest.approx(1.0, abs=0.05)
    assert seen[-1] == 0.0
    assert not harness.vehicle.faults.active


# ---- command


def test_a_pilot_takes_the_vehicle_out_of_offboard(harness: SimHarness) -> None:
    harness.take_off(5.0)
    setpoint = velocity_setpoint(1, 0, 0)
    harness.offboard(setpoint)
    begin(harness, "pilot_takeover")
    harness.fly(2.0, setpoint)
    assert harness.mode == "POSCTL"


def test_pilot_fault_end_keeps_mode(harness: SimHarness) -> None:
    harness.take_off(5.0)
    begin(harness, "pilot_takeover for=1")
    harness.fly(3.0)
    assert harness.mode == "POSCTL"


def test_pilot_fault_end_is_rc_loss_if_rc_enabled() -> None:
    harness = SimHarness(parameters={"COM_RC_IN_MODE": 0})
    harness.take_off(5.0)
    begin(harness, "pilot_takeover for=2")
    harness.fly(1.9)
    assert harness.mode == "POSCTL"
    harness.fly(0.3)
    assert harness.mode == "HOLD"
    harness.until(lambda: harness.mode == "RTL", 6.0)
    assert STICKS_LOST_RTL in harness.events


def test_mode_refused_given_count_then_accepted(harness: SimHarness) -> None:
    harness.take_off(5.0)
    begin(harness, "refuse_mode LAND count=2")
    assert harness.command(LAND) == [1]
    assert harness.set_mode(4, 6) == [0, 1]
    assert harness.set_mode(4, 3) == [0, 0]
    assert harness.mode == "HOLD"
    assert not harness.vehicle.faults.active
    assert harness.command(LAND) == [0]
    assert harness.mode == "LAND"


@pytest.mark.streams("everything")
def test_reboot_in_flight_is_silent_then_disarmed(harness: SimHarness) -> None:
    harness.take_off(30.0)
    assert harness.command(511, 30, 50_000) == [0]  # a setting, and settings are forgotten
    begin(harness, "reboot 2")
    harness.forget()
    harness.fly(1.9)
    assert not harness.inbox["onboard"]
    assert not harness.inbox["gcs"]
    assert not harness.armed
    assert harness.vehicle.airframe.velocity[2] > 5.0  # it falls
    harness.fly(2.0)
    assert harness.received("ATTITUDE")[0].time_boot_ms == pytest.approx(2000, abs=50)
    assert not harness.received("HEARTBEAT")[0].base_mode & 128
    assert harness.vehicle.links["onboard"].streams.interval_us("ATTITUDE") == 10_000
    harness.until(lambda: harness.height_m < 0.1, 10.0)


def test_a_reboot_on_the_ground_is_ready_again(harness: SimHarness) -> None:
    harness.fly(10.0)
    begin(harness, "reboot 2")
    harness.fly(2.1)
    assert not harness.vehicle.autopilot.can_arm
    harness.fly(3.0)
    assert harness.command(ARM, 1) == [0]


def test_modes_needing_position_refused_except_land(harness: SimHarness) -> None:
    harness.heartbeats.append(("gcs", (245, 190), 6))
    harness.take_off(8.0)
    begin(harness, "gps_loss")
    harness.until(lambda: not harness.vehicle.autopilot.position_valid, 10.0)
    harness.fly(0.1)
    assert type(harness.vehicle.autopilot.task).__name__ == "Descend"
    harness.forget()
    nan = float("nan")
    for name, command in (
        ("Hold", (192, -1, 1, 0, nan, 47.3977, 8.5456, 495)),  # DO_REPOSITION
        ("Hold", (186, 500)),  # DO_CHANGE_ALTITUDE
        ("Takeoff", (22, nan, 0, 0, nan, nan, nan, 500)),
        ("Return", (20,)),
    ):
        assert harness.command(*command) == [1]
        assert harness.texts()[-1] == MODE_REFUSED.format(name)
        harness.fly(1.0)
    assert harness.command(34, 5, 2, 0, 0, nan, nan, nan) == [1]  # DO_ORBIT
    assert harness.texts()[-1] == ORBIT_REFUSED
    assert len(harness.texts()) == 5
    assert harness.command(LAND) == [0]
    assert harness.set_mode(4, 6) == [0, 0]  # AUTO_LAND
    assert type(harness.vehicle.autopilot.task).__name__ == "Descend"


def test_landing_continues_without_gps(harness: SimHarness) -> None:
    harness.take_off(8.0)
    begin(harness, "gps_loss")
    harness.fly(2.0)
    assert harness.command(LAND) == [0]
    harness.until(lambda: not harness.vehicle.autopilot.position_valid, 5.0)
    harness.fly(0.1)
    assert type(harness.vehicle.autopilot.task).__name__ == "Descend"
    assert harness.mode == "LAND"
    harness.until(lambda: not harness.armed, 25.0)


# ---- camera


def test_camera_freezes_add_up_and_end(harness: SimHarness) -> None:
    faults = harness.vehicle.faults
    depth, image = begin(harness, "camera_freeze depth"), begin(harness, "camera_freeze image clock=yes")
    assert faults.camera_freeze == CameraFreeze.IMAGE | CameraFreeze.DEPTH | CameraFreeze.CLOCK
    faults.end(image)
    assert CameraFreeze.IMAGE not in faults.camera_freeze
    faults.end(depth)
    assert not faults.camera_freeze
