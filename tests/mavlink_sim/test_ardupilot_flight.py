"""Copter: arming, GUIDED and its targets, landing, failsafes."""

from __future__ import annotations

import math
from typing import Any

import pytest

from mavlink_sim import LockstepVehicle
from mavlink_sim.lockstep import CommandRefusedError
from mavlink_sim.wire.messages import dialect
from vision.attitude import quaternion_inverse, quaternion_product

ARM, TAKEOFF, SET_MODE, PAUSE_CONTINUE = 400, 22, 176, 193
POSITION, VELOCITY, ACCELERATION = 0b110111111000, 0b110111000111, 0b110000111111

# STATUSTEXTs of Copter, with their severities.
NOT_ARMABLE = "Arm: {} mode not armable"
NEED_POSITION = (2, "Arm: Need Position Estimate")
AUTO_FAILED = (4, "Mode change to AUTO failed: init failed")
NO_MODE_99 = (4, "No such mode 99")
EKF_LANDS = (2, "EKF Failsafe: changed to LAND Mode")
FENCE_BREACHED = (5, "Circle fence breached")
TARGET_FRAME_REFUSED = "Plnd: Frame not supported "


@pytest.fixture(scope="module")
def ready() -> LockstepVehicle:
    vehicle = LockstepVehicle(autopilot="ardupilot", seed=4, noise=0.0, ready_after_s=0.0)
    vehicle.send(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
    vehicle.step(0.1)
    return vehicle


@pytest.fixture
def copter(ready: LockstepVehicle) -> LockstepVehicle:
    """Ready to be armed, in STABILIZE, with a companion's heartbeat."""
    return ready.copy()


@pytest.fixture(scope="module")
def flown(ready: LockstepVehicle) -> LockstepVehicle:
    vehicle = ready.copy()
    vehicle.take_off(6.0)
    vehicle.step(3.0)
    return vehicle


@pytest.fixture
def flying(flown: LockstepVehicle) -> LockstepVehicle:
    """In the air, in GUIDED."""
    return flown.copy()


def texts(vehicle: LockstepVehicle) -> list[tuple[int, str]]:
    return [(m.severity, m.text) for m in vehicle.receive() if m.get_type() == "STATUSTEXT"]


def target(mask: int, values: tuple[float, ...], frame: int = 1, yaw: float = 0.0, rate: float = 0.0) -> Any:
    """SET_POSITION_TARGET_LOCAL_NED with the values in the fields that the mask enables."""
    groups: list[tuple[float, ...]] = [(0.0,) * 3] * 3
    groups[(POSITION, VELOCITY, ACCELERATION).index(mask | 0b110000000000)] = values
    flat = [value for group in groups for value in group]
    return dialect.MAVLink_set_position_target_local_ned_message(0, 1, 1, frame, mask, *flat, yaw, rate)


def guided(vehicle: LockstepVehicle, mask: int, *values: float, **options: Any) -> None:
    vehicle.send(target(mask, values, **options))


def away(vehicle: LockstepVehicle, position: tuple[float, float, float]) -> float:
    return math.dist(vehicle.truth.position_ned_m, position)


def test_it_boots_in_stabilize_and_can_be_armed_there(copter: LockstepVehicle) -> None:
    assert copter.truth.mode == "STABILIZE"
    assert copter.command(ARM, 1) == "ACCEPTED"
    assert copter.command(ARM, 1) == "ACCEPTED"
    assert texts(copter) == [(6, "Arming motors")]


@pytest.mark.parametrize("mode", [6, 9, 17, 3])
def test_unarmable_modes_accepted_while_disarmed_refuse_arming(copter: LockstepVehicle, mode: int) -> None:
    assert copter.command(SET_MODE, 1, mode) == "ACCEPTED"
    assert copter.command(ARM, 1) == "FAILED"
    name = {6: "RTL", 9: "LAND", 17: "BRAKE", 3: "AUTO"}[mode]
    assert texts(copter) == [(2, NOT_ARMABLE.format(name))]
    assert copter.command(ARM, 1, 2989) == "ACCEPTED"  # the magic number arms anyhow


def test_arming_guided_needs_position_stabilize_does_not() -> None:
    vehicle = LockstepVehicle(autopilot="ardupilot", parameters={"ARMING_CHECK": 0})
    vehicle.send(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
    vehicle.set_mode("GUIDED")
    assert vehicle.command(ARM, 1) == "FAILED"
    assert texts(vehicle) == [NEED_POSITION]
    vehicle.set_mode("STABILIZE")
    assert vehicle.command(ARM, 1) == "ACCEPTED"


def test_takeoff_needs_guided_and_arming_height_above_home(copter: LockstepVehicle) -> None:
    copter.arm()
    assert copter.command(TAKEOFF, 0, 0, 0, 0, 0, 0, 5) == "FAILED"
    copter.command(ARM, 0)
    copter.set_mode("GUIDED")
    assert copter.command(TAKEOFF, 0, 0, 0, 0, 0, 0, 5) == "FAILED"
    copter.arm()
    assert copter.command(TAKEOFF, 0, 0, 0, 0, 0, 0, 5) == "ACCEPTED"
    states: list[int] = []
    for _ in range(150):
        copter.step(0.1)
        states.append(int(copter.vehicle.autopilot.landed_state))
    assert [state for at, state in enumerate(states) if at == 0 or state != states[at - 1]] == [1, 3, 2]
    assert copter.truth.height_m == pytest.approx(5.0, abs=0.5)
    assert copter.command(TAKEOFF, 0, 0, 0, 0, 0, 0, 9) == "FAILED"  # it flies already
    assert copter.truth.mode == "GUIDED"


def test_setpoints_do_not_take_off_and_disarm_delay_disarms(copter: LockstepVehicle) -> None:
    copter.set_mode("GUIDED")
    copter.arm()
    armed_s = copter.now_s
    sent = copter.repeat(target(VELOCITY, (0.0, 0.0, -1.0)), 10.0)
    copter.run_until(lambda truth: not truth.armed, 20.0)
    sent.stop()
    assert copter.now_s - armed_s == pytest.approx(10.0, abs=0.2)
    assert copter.truth.on_ground


@pytest.mark.parametrize(
    ("frame", "asked", "turns"), [(1, (8.0, 3.0, -6.0), 0), (7, (8.0, 3.0, 0.0), 0), (8, (3.0, -8.0, 0.0), 1),
                                  (9, (3.0, -8.0, 0.0), 1)],
)  # fmt: skip
def test_position_relative_to_origin_vehicle_or_heading(
    flying: LockstepVehicle, frame: int, asked: tuple[float, float, float], turns: int
) -> None:
    if turns:  # the nose to the east
        guided(flying, VELOCITY & ~1024, 0.0, 0.0, 0.0, yaw=math.pi / 2)
        flying.step(3.0)
        assert flying.truth.yaw_rad == pytest.approx(math.pi / 2, abs=0.1)
    north, east, down = flying.truth.position_ned_m
    position = asked if frame == 1 else (north + 8.0, east + 3.0, down)
    guided(flying, POSITION, *asked, frame=frame)
    flying.step(15.0)
    assert away(flying, position) < 1.0


def test_stale_velocity_stops_after_guid_timeout_mode_stays(flying: LockstepVehicle) -> None:
    guided(flying, VELOCITY & ~2048, 2.0, 0.0, 0.0)
    flying.step(2.8)
    assert flying.truth.velocity_ned_mps[0] == pytest.approx(2.0, abs=0.7)
    flying.step(2.7)
    stopped = flying.truth.position_ned_m
    flying.step(10.0)
    assert away(flying, stopped) < 1.5  # in gusts
    assert flying.truth.mode == "GUIDED"
    assert flying.truth.armed


def test_position_target_never_expires(flying: LockstepVehicle) -> None:
    guided(flying, POSITION, 30.0, 0.0, -6.0)
    flying.step(25.0)
    assert away(flying, (30.0, 0.0, -6.0)) < 1.0


def test_heading_follows_flight_and_holds_with_rate_0(flying: LockstepVehicle) -> None:
    sent = flying.repeat(target(VELOCITY & ~2048, (0.0, 3.0, 0.0)), 10.0)
    flying.step(5.0)
    assert abs(flying.truth.yaw_rad) < 0.2
    sent.message = target(VELOCITY, (0.0, 3.0, 0.0))
    flying.step(5.0)
    assert flying.truth.yaw_rad == pytest.approx(math.pi / 2, abs=0.25)


@pytest.mark.parametrize(
    "message",
    [
        target(VELOCITY, (2.0, 0.0, 0.0), frame=12),
        target(VELOCITY, (math.nan, 0.0, 0.0)),
        target(VELOCITY, (2000.0, 0.0, 0.0)),
        dialect.MAVLink_set_position_target_local_ned_message(0, 1, 1, 1, 0b110111111111, *([1.0] * 11)),
    ],
    ids=["frame", "no number", "too fast", "nothing given"],
)
def test_invalid_target_stops_vehicle(flying: LockstepVehicle, message: Any) -> None:
    sent = flying.repeat(target(VELOCITY, (3.0, 0.0, 0.0)), 10.0)
    flying.step(3.0)
    sent.stop()
    flying.send(message)
    flying.step(2.5)
    assert math.hypot(*flying.truth.velocity_ned_mps) < 0.8


def test_acceleration_target_acts_until_timeout(flying: LockstepVehicle) -> None:
    guided(flying, ACCELERATION, 1.0, 0.0, 0.0)
    flying.step(2.5)
    assert flying.truth.velocity_ned_mps[0] == pytest.approx(2.0, abs=0.8)
    flying.step(4.0)
    assert math.hypot(*flying.truth.velocity_ned_mps) < 0.8


def test_global_relative_position_is_reached(flying: LockstepVehicle) -> None:
    scale = math.radians(1.0) * 6371000.0
    latitude = round((47.397743225 + 10.0 / scale) * 1e7)
    flying.send(
        dialect.MAVLink_set_position_target_global_int_message(
            0, 1, 1, 6, POSITION, latitude, round(8.545594215e7), 9.0, *([0.0] * 8)
        )
    )
    flying.step(15.0)
    assert away(flying, (10.0, 0.0, -9.0)) < 1.0


def test_setpoints_ignored_outside_guided(flying: LockstepVehicle) -> None:
    flying.set_mode("BRAKE")
    flying.step(2.0)
    before = flying.truth.position_ned_m
    sent = flying.repeat(target(VELOCITY, (3.0, 0.0, 0.0)), 10.0)
    flying.step(4.0)
    sent.stop()
    assert away(flying, before) < 1.2
    assert texts(flying)[-1] == (6, "Arming motors")


def test_condition_yaw_turns_and_change_speed_slows_down(flying: LockstepVehicle) -> None:
    assert flying.command(115, 90.0, 30.0, 1.0, 0.0) == "ACCEPTED"
    flying.step(4.0)
    assert flying.truth.yaw_rad == pytest.approx(math.pi / 2, abs=0.1)
    assert flying.command(115, 30.0, 0.0, -1.0, 1.0) == "ACCEPTED"
    flying.step(3.0)
    assert flying.truth.yaw_rad == pytest.approx(math.pi / 3, abs=0.1)
    assert flying.command(115, 400.0) == "FAILED"
    assert flying.command(178, 1.0, 1.0) == "ACCEPTED"
    guided(flying, POSITION, 20.0, 0.0, -6.0)
    flying.step(5.0)
    assert math.hypot(*flying.truth.velocity_ned_mps) == pytest.approx(1.0, abs=0.6)
    assert flying.command(178, 1.0, 0.0) == "DENIED"


def test_land_disarms_after_landing_and_mode_stays_land(flying: LockstepVehicle) -> None:
    flying.land()
    assert flying.truth.on_ground
    assert flying.truth.mode == "LAND"
    assert flying.events[-2:] == ["landed", "disarmed (after landing)"]
    assert not flying.truth.crashed


def test_rtl_climbs_returns_waits_and_lands_at_home() -> None:
    vehicle = LockstepVehicle(
        autopilot="ardupilot", seed=2, ready_after_s=0.0, parameters={"RTL_ALT": 1200, "RTL_LOIT_TIME": 2000}
    )
    vehicle.take_off(6.0)
    guided(vehicle, POSITION, 15.0, -5.0, -6.0)
    vehicle.step(12.0)
    vehicle.set_mode("RTL")
    highest = 0.0
    for _ in range(600):
        vehicle.step(0.1)
        highest = max(highest, vehicle.truth.height_m)
        if not vehicle.truth.armed:
            break
    assert highest == pytest.approx(12.0, abs=1.0)
    assert away(vehicle, (0.0, 0.0, 0.0)) < 1.0
    assert vehicle.truth.mode == "RTL"


def test_disarm_delay_restarts_with_arming(flying: LockstepVehicle) -> None:
    flying.set_mode("LAND")
    flying.run_until(lambda truth: not truth.armed, 60.0)
    flying.step(15.0)
    flying.set_mode("GUIDED")
    flying.arm()
    flying.step(9.5)
    assert flying.truth.armed
    flying.step(1.0)  # DISARM_DELAY is 10 s
    assert flying.events[-1] == "disarmed (no takeoff)"


def test_disarming_in_the_air_needs_the_magic_number(flying: LockstepVehicle) -> None:
    assert flying.command(ARM, 0) == "FAILED"
    assert flying.command(ARM, 0, 21196) == "ACCEPTED"


def test_auto_without_mission_and_unknown_modes_refused(flying: LockstepVehicle) -> None:
    texts(flying)
    assert flying.command(SET_MODE, 1, 3) == "FAILED"
    assert flying.command(SET_MODE, 1, 99) == "FAILED"
    assert flying.command(SET_MODE, 0, 5) == "DENIED"
    assert texts(flying) == [AUTO_FAILED, NO_MODE_99]
    with pytest.raises(CommandRefusedError):
        flying.set_mode("FLIP")
    with pytest.raises(ValueError, match="GUIDED"):
        flying.set_mode("OFFBOARD")


def test_lost_ground_station_returns_with_fs_gcs_enable(flying: LockstepVehicle) -> None:
    flying.vehicle.parameters.set("FS_GCS_ENABLE", 1)
    beat = flying.repeat(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3), 1.0, source=(255, 190))
    flying.step(8.0)
    assert flying.truth.mode == "GUIDED"
    beat.stop()
    flying.step(6.5)
    assert flying.truth.mode == "RTL"
    assert (4, "GCS Failsafe") in texts(flying)
    flying.set_mode("BRAKE")  # a requested mode overrides the failsafe
    flying.step(2.0)
    assert flying.truth.mode == "BRAKE"


def test_a_lost_position_leads_to_land(flying: LockstepVehicle) -> None:
    flying.vehicle.faults.begin("gps_loss for=30")
    flying.run_until(lambda truth: truth.mode == "LAND", 30.0)
    assert EKF_LANDS in texts(flying)
    assert flying.command(SET_MODE, 1, 4) in ("FAILED", "TEMPORARILY_REJECTED")


def test_fence_breach_changes_mode(flying: LockstepVehicle) -> None:
    for name, value in (("FENCE_ENABLE", 1), ("FENCE_RADIUS", 12), ("RTL_ALT", 600)):
        flying.vehicle.parameters.set(name, value)
    guided(flying, POSITION, 40.0, 0.0, -6.0)
    flying.run_until(lambda truth: truth.mode == "RTL", 20.0)
    assert flying.truth.position_ned_m[0] == pytest.approx(12.0, abs=0.5)
    assert FENCE_BREACHED in texts(flying)


def test_velocity_targets_stop_before_the_fence(flying: LockstepVehicle) -> None:
    """Measured on Copter 4.7: it holds at 28 m of 30, in GUIDED."""
    for name, value in (("FENCE_ENABLE", 1), ("FENCE_RADIUS", 30)):
        flying.vehicle.parameters.set(name, value)
    flying.repeat(target(VELOCITY, (3.0, 0.0, 0.0)), 10.0)
    flying.step(25.0)
    assert flying.truth.position_ned_m[0] == pytest.approx(28.0, abs=0.5)
    assert flying.truth.mode == "GUIDED"


def test_pause_stops_vehicle_despite_new_targets(flying: LockstepVehicle) -> None:
    flying.repeat(target(VELOCITY, (3.0, 0.0, 0.0)), 10.0)
    flying.step(4.0)
    assert flying.command(PAUSE_CONTINUE, 2) == "DENIED"
    assert flying.command(PAUSE_CONTINUE, 0) == "ACCEPTED"
    flying.step(6.0)
    assert abs(flying.truth.velocity_ned_mps[0]) < 0.4
    assert flying.truth.mode == "GUIDED"
    assert flying.command(PAUSE_CONTINUE, 1) == "ACCEPTED"
    flying.step(4.0)
    assert flying.truth.velocity_ned_mps[0] > 2.0
    flying.set_mode("LOITER")
    assert flying.command(PAUSE_CONTINUE, 0) == "FAILED"


def landing_target(north: float, east: float, vehicle: LockstepVehicle, *, frame: int, valid: int) -> Any:
    """LANDING_TARGET of a camera fixed to the body, looking down at a plate on the ground."""
    truth = vehicle.truth
    x, y, z = (
        position - here for position, here in zip((north, east, 0.3), truth.position_ned_m, strict=True)
    )
    body = quaternion_product(
        quaternion_product(quaternion_inverse(truth.quaternion), (0.0, x, y, z)), truth.quaternion
    )[1:]
    angle_x, angle_y = math.atan2(body[1], body[2]), math.atan2(-body[0], body[2])
    return dialect.MAVLink_landing_target_message(
        0, 0, frame, angle_x, angle_y, math.hypot(*body), 0.0, 0.0, *body, [1, 0, 0, 0], 2, valid
    )


@pytest.mark.parametrize(
    ("frame", "valid", "enabled", "hits"),
    [(12, 0, 1, True), (12, 1, 1, True), (1, 1, 1, False), (12, 0, 0, False)],
    ids=["angles", "body position", "PX4's frame", "disabled"],
)
def test_land_uses_landing_target_in_supported_frames(
    flying: LockstepVehicle, frame: int, valid: int, enabled: int, hits: bool
) -> None:
    flying.vehicle.parameters.set("PLND_ENABLED", enabled)
    flying.vehicle.parameters.set("PLND_TYPE", 1)
    north, east = 1.6, -1.2
    flying.set_mode("LAND")
    while flying.truth.armed:
        flying.send(landing_target(north, east, flying, frame=frame, valid=valid))
        flying.step(0.1)
        assert flying.now_s < 120.0
    missed = math.dist(flying.truth.position_ned_m[:2], (north, east))
    assert (missed < 0.8) is hits, missed  # in gusts that move a held position by 0.3 m
    sent_texts = [text for _, text in texts(flying)]
    assert sent_texts.count(TARGET_FRAME_REFUSED) == (frame == 1)


def test_pilot_takes_over_in_loiter_and_reboot_resets(flying: LockstepVehicle) -> None:
    flying.vehicle.faults.begin("pilot_takeover mode=POSCTL")
    flying.step(0.5)
    assert flying.truth.mode == "LOITER"
    flying.vehicle.faults.begin("reboot seconds=1")
    flying.step(8.0)
    assert not flying.truth.armed
    assert flying.truth.mode == "STABILIZE"


# ---- measured on a real Copter, without wind


@pytest.fixture
def calm() -> LockstepVehicle:
    return LockstepVehicle(autopilot="ardupilot", gusts_mps=0.0, noise=False, ready_after_s=0.0)


@pytest.mark.parametrize(("armed_for_s", "duration_s"), [(4.0, 5.8), (0.0, 8.15)])
def test_takeoff_to_5_m_takes_the_measured_time(
    calm: LockstepVehicle, armed_for_s: float, duration_s: float
) -> None:
    calm.set_mode("GUIDED")
    calm.arm()
    calm.step(armed_for_s)
    asked_s = calm.now_s
    assert calm.command(TAKEOFF, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 5.0) == "ACCEPTED"
    calm.run_until(lambda truth: calm.vehicle.autopilot.landed_state == 2, 15.0)
    assert calm.now_s - asked_s == pytest.approx(duration_s, abs=0.4)
    calm.step(4.0)
    assert calm.truth.height_m == pytest.approx(5.0, abs=0.1)


def test_velocity_step_overshoots_little(calm: LockstepVehicle) -> None:
    calm.take_off(6.0)
    calm.step(3.0)
    sent = calm.repeat(target(VELOCITY, (0.0, 3.0, 0.0)), 20.0)
    speeds = []
    for _ in range(400):
        calm.step(0.02)
        speeds.append(calm.truth.velocity_ned_mps[1])
    assert speeds[50] == pytest.approx(1.77, abs=0.15)
    assert max(speeds) == pytest.approx(3.05, abs=0.05)
    assert min(speeds[200:]) > 2.95
    sent.message = target(VELOCITY, (0.0, 0.0, 0.0))
    east = calm.truth.position_ned_m[1]
    assert calm.run_until(lambda truth: truth.velocity_ned_mps[1] < 0.3, 5.0) < 2.2
    assert calm.truth.position_ned_m[1] - east < 3.4


def test_velocity_circle_is_no_wider_than_measured(calm: LockstepVehicle) -> None:
    """A real Copter, whose setpoints lag by another 0.1 s, is 1.25 m outside such a circle."""
    radius_m, speed_mps = 5.0, 3.0
    calm.take_off(6.0)
    calm.step(3.0)
    sent = calm.repeat(target(VELOCITY, (0.0, 0.0, 0.0)), 20.0)
    north, east, _ = calm.truth.position_ned_m
    off_m = []
    for step in range(500):
        x, y, _ = calm.truth.position_ned_m
        x, y = x - north - radius_m, y - east
        away_m = math.hypot(x, y)
        back_mps = 0.8 * (radius_m - away_m)
        sent.message = target(
            VELOCITY, ((-y * speed_mps + x * back_mps) / away_m, (x * speed_mps + y * back_mps) / away_m, 0.0)
        )
        calm.step(0.05)
        if step > 120:
            off_m.append(abs(away_m - radius_m))
    assert max(off_m) == pytest.approx(0.9, abs=0.15)


def test_the_same_seed_is_the_same_flight() -> None:
    positions = []
    for _ in range(2):
        vehicle = LockstepVehicle(autopilot="ardupilot", seed=9, wind_mps=3.0, ready_after_s=0.0)
        vehicle.take_off(3.0)
        guided(vehicle, VELOCITY, 1.0, 1.0, 0.0)
        vehicle.step(5.0)
        positions.append(vehicle.truth.position_ned_m)
    assert positions[0] == positions[1]
