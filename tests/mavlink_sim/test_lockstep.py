"""The vehicle in lockstep: step, messages, truth, copies."""

import hashlib
import itertools
import math
import subprocess
import sys
from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest

from mavlink_sim import CommandRefusedError, LockstepVehicle, NotReachedError
from mavlink_sim.wire.messages import dialect, parser
from mavlink_sim.wire.signing import Signing
from mavlink_sim.wire.streams import GCS_RATES_HZ, ONBOARD_RATES_HZ


def flight(seed: int, links: dict[str, dict[str, float]] | None = None) -> tuple[str, Any]:
    """A take-off, a few seconds of OFFBOARD, a landing: the digest of every byte sent, and where it ended."""
    vehicle = LockstepVehicle(
        {"onboard": ONBOARD_RATES_HZ, "gcs": GCS_RATES_HZ} if links is None else links, seed=seed
    )
    vehicle.take_off(2.5)
    vehicle.set_position(3.0, 2.0, -3.0, yaw_rad=0.5)
    vehicle.step(3.0)
    vehicle.land()
    vehicle.stop_setpoints()
    digest = hashlib.sha256()
    for link in vehicle.newest:
        digest.update(vehicle.receive_bytes(link))
    return digest.hexdigest(), vehicle.truth


@pytest.fixture(scope="module")
def fly() -> tuple[str, Any]:
    return flight(5)


def test_same_seed_gives_byte_equal_flight(fly: tuple[str, Any]) -> None:
    assert flight(5) == fly


def test_another_seed_is_another_flight(fly: tuple[str, Any]) -> None:
    other = flight(6, {"onboard": ONBOARD_RATES_HZ})
    assert fly[0] != other[0]
    assert fly[1] != other[1]


def test_the_number_of_links_does_not_change_the_flight(fly: tuple[str, Any]) -> None:
    assert fly[1] == flight(5, {"onboard": {}})[1]


@pytest.mark.parametrize("rates_hz", [{}, ONBOARD_RATES_HZ], ids=["quiet", "streams"])
def test_the_length_of_the_steps_does_not_change_the_flight(rates_hz: dict[str, float]) -> None:
    long, short = (LockstepVehicle({"onboard": rates_hz}, seed=4, wind_mps=3.0) for _ in range(2))
    for vehicle in (long, short):
        vehicle.take_off(3.0)
        vehicle.set_velocity(1.0, -2.0, 0.1, 0.3)
    for _ in range(20):
        long.step(0.2)
        for _ in range(50):
            short.step(0.004)
        assert long.truth == short.truth
        assert long.receive_bytes() == short.receive_bytes()


def test_another_process_flies_the_same_flight() -> None:
    program = (
        "import hashlib\nfrom mavlink_sim import LockstepVehicle\n"
        "vehicle = LockstepVehicle(seed=3)\nvehicle.take_off()\n"
        "print(hashlib.sha256(vehicle.receive_bytes()).hexdigest())"
    )
    vehicle = LockstepVehicle(seed=3)
    vehicle.take_off()
    own = hashlib.sha256(vehicle.receive_bytes()).hexdigest()
    reported = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert reported.stdout.strip() == own


def test_three_lines_fly() -> None:
    vehicle = LockstepVehicle(seed=1)
    vehicle.take_off(5.0)
    assert 3.5 < vehicle.truth.height_m < 6.0
    assert vehicle.events == ["armed", "mode TAKEOFF", "takeoff", "mode HOLD"]


def test_time_advances_only_by_step() -> None:
    vehicle = LockstepVehicle()
    assert vehicle.now_s == 0.0
    vehicle.step(0.01)
    vehicle.step(0.01)
    assert vehicle.now_s == pytest.approx(0.02)
    with pytest.raises(ValueError, match="-1"):
        vehicle.step(-1.0)
    with pytest.raises(ValueError, match="nan"):
        vehicle.step(math.nan)


def test_messages_come_out_once_and_in_order() -> None:
    vehicle = LockstepVehicle()
    vehicle.step(1.0)
    messages = vehicle.receive()
    stamps = [message.time_boot_ms for message in messages if message.get_type() == "ATTITUDE"]
    assert stamps == sorted(stamps)
    assert 95 <= len(stamps) <= 99
    assert vehicle.receive() == []
    assert vehicle.newest["onboard"]["HEARTBEAT"].autopilot == 12


def test_bytes_are_received_like_messages() -> None:
    vehicle = LockstepVehicle({"onboard": {}})
    codec = dialect.MAVLink(None, 1, 191)
    packet = dialect.MAVLink_timesync_message(0, 77).pack(codec)
    assert vehicle.send_bytes(b"noise" + packet[:9]) == 0
    assert vehicle.send_bytes(packet[9:]) == 1
    assert vehicle.newest["onboard"]["TIMESYNC"].ts1 == 77


def test_quiet_link_sends_only_answers() -> None:
    vehicle = LockstepVehicle({"onboard": {}})
    vehicle.step(6.0)
    reported = Counter(message.get_type() for message in vehicle.receive())
    assert set(reported) == {"GPS_GLOBAL_ORIGIN", "EVENT"}  # EVENT: the checks when they change
    assert reported["GPS_GLOBAL_ORIGIN"] == 1
    vehicle.step(10.0)
    assert vehicle.receive() == []
    assert vehicle.command(512, 30) == "ACCEPTED"
    assert {message.get_type() for message in vehicle.receive()} == {"ATTITUDE", "COMMAND_ACK"}


@pytest.mark.parametrize(
    ("act", "error", "words"),
    [
        (lambda v: v.run_until(lambda t: t.height_m > 1, 2.0), NotReachedError, ["2 s", "HOLD", "disarmed"]),
        (lambda v: (v.take_off(), v.set_mode("OFFBOARD")), CommandRefusedError, ["OFFBOARD", "TEMPORARILY"]),
        (lambda v: v.set_mode("HOVER"), ValueError, ["HOVER", "OFFBOARD"]),
    ],
    ids=["limit", "refused", "no such mode"],
)
def test_unreached_condition_raises(
    act: Callable[[LockstepVehicle], object], error: type[Exception], words: list[str]
) -> None:
    vehicle = LockstepVehicle({"onboard": {}})
    with pytest.raises(error) as raised:
        act(vehicle)
    for word in words:
        assert word in str(raised.value)


def test_the_time_of_day_is_stepped_too() -> None:
    vehicle = LockstepVehicle()
    vehicle.step(3.0)
    first = vehicle.newest["onboard"]["SYSTEM_TIME"]
    vehicle.step(10.0)
    second = vehicle.newest["onboard"]["SYSTEM_TIME"]
    passed_us = (second.time_boot_ms - first.time_boot_ms) * 1000
    assert second.time_unix_usec - first.time_unix_usec == pytest.approx(passed_us, abs=1000)


def test_motor_loss_crashes_reports_and_disarms() -> None:
    vehicle = LockstepVehicle({"onboard": {}}, seed=1)
    vehicle.take_off(10.0)
    vehicle.vehicle.airframe.fail_motor(2)
    vehicle.run_until(lambda truth: truth.crashed, 20.0)
    assert any(event.startswith("crashed at ") for event in vehicle.events)
    vehicle.run_until(lambda truth: truth.landed and not truth.armed, 20.0)
    with pytest.raises(NotReachedError):
        vehicle.run_until(lambda truth: truth.height_m > 0.5, 5.0)  # it stays where it fell


def test_a_fall_is_a_hard_landing_and_a_landing_is_none() -> None:
    vehicle = LockstepVehicle({"onboard": {}}, seed=1, noise=False, gusts_mps=0.0)
    vehicle.take_off(2.5)
    vehicle.land()
    assert not any("hard landing" in event for event in vehicle.events)
    vehicle.take_off(2.5)
    vehicle.run_until(lambda truth: truth.height_m < 1.5 or truth.mode == "HOLD", 20.0)
    vehicle.command(400, 0.0, 21196.0)  # motors off in the air
    vehicle.run_until(lambda truth: truth.on_ground, 10.0)
    assert any(event.split(" at ")[0] in ("hard landing", "crashed") for event in vehicle.events)


# ---- faults and signatures on its links


def test_a_delayed_link_is_late_both_ways() -> None:
    vehicle = LockstepVehicle({"onboard": {"HEARTBEAT": 1.0}}, seed=1)
    vehicle.step(5.0)
    vehicle.receive()
    vehicle.vehicle.faults.begin("link_delay 0.2")
    vehicle.send(dialect.MAVLink_timesync_message(0, 77))
    vehicle.step(0.38)
    assert [message for message in vehicle.receive() if message.get_type() == "TIMESYNC"] == []
    vehicle.step(0.04)
    answers = [message for message in vehicle.receive() if message.get_type() == "TIMESYNC"]
    assert [(answer.ts1, answer.get_srcSystem()) for answer in answers] == [(77, 1)]
    assert answers[0].tc1 == pytest.approx(5.2e9, abs=1e7)


def test_a_lost_link_loses_and_bytes_stay_numbered_in_order() -> None:
    vehicle = LockstepVehicle(seed=1)
    vehicle.step(1.0)
    vehicle.vehicle.faults.begin("packet_loss 0.5 way=out at=2 for=1")
    vehicle.step(4.0)
    numbers = [message.get_msgbuf()[4] for message in client_reads(vehicle.receive_bytes())]
    gaps = [(after - before) % 256 for before, after in itertools.pairwise(numbers)]
    assert max(gaps) > 1
    assert max(gaps) < 40
    assert gaps.count(1) > len(gaps) / 2


def test_corrupted_messages_are_bad_data() -> None:
    vehicle = LockstepVehicle(seed=1)
    vehicle.vehicle.faults.begin("corrupt 1.0 way=out")
    vehicle.step(3.0)
    assert all(message.get_type() != "BAD_DATA" for message in vehicle.receive())
    assert vehicle.vehicle.links["onboard"].sent > 500
    vehicle.step(1.0)
    assert vehicle.receive_bytes()


def test_a_link_with_a_key_signs_and_refuses_what_is_unsigned() -> None:
    vehicle = LockstepVehicle(seed=1, parameters={"MAV_SIGN_CFG": 2})
    vehicle.vehicle.sign_everything(bytes(range(32)), timestamp=1_000_000)
    vehicle.step(2.0)
    frames = client_reads(vehicle.receive_bytes())
    assert len(frames) > 500
    assert all(message.get_msgbuf()[2] & 1 for message in frames)
    heartbeat = dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3)
    vehicle.send(heartbeat)
    assert vehicle.vehicle.links["onboard"].received == 0
    client = Signing(link_id=9)
    client.set_up(bytes(range(32)), 2_000_000)
    assert vehicle.send_bytes(client.signed(bytes(heartbeat.pack(parser(1, 191))))) == 1
    assert vehicle.vehicle.links["onboard"].received == 1


def client_reads(data: bytes) -> list[Any]:
    return [message for message in parser().parse_buffer(data) if message.get_type() != "BAD_DATA"]


# ---- copies


def all_messages(vehicle: LockstepVehicle) -> tuple[Any, ...]:
    return vehicle.truth, *(vehicle.receive_bytes(link) for link in vehicle.newest)


@pytest.mark.parametrize(
    ("autopilot", "options"),
    [
        ("px4", {"gimbal": True, "air_seed": 2}),
        ("px4", {"px4": "1.14", "scene": "village", "obstacle_sensor": True}),
        ("ardupilot", {}),
    ],
)
def test_copy_flies_byte_equal(autopilot: str, options: dict[str, Any]) -> None:
    first = LockstepVehicle(
        {"onboard": ONBOARD_RATES_HZ, "gcs": GCS_RATES_HZ},
        autopilot=autopilot,
        seed=4,
        wind_mps=3.0,
        **options,
    )
    first.take_off(2.5)
    first.repeat(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3), 1.0)
    first.vehicle.faults.begin("gps_loss for=0.5")
    first.vehicle.faults.begin("wind 4 at=60")
    first.step(0.7)
    # with pending state: a fix that returns, a command not yet executed, half a message
    half = dialect.MAVLink_command_long_message(1, 1, 512, 0, 242, 0, 0, 0, 0, 0, 0).pack(parser())
    first.send_bytes(half[:9])
    first.send(dialect.MAVLink_command_long_message(1, 1, 21, 0, 0, 0, 0, math.nan, 0, 0, 0))
    second = first.copy()
    for vehicle in (first, second):
        vehicle.send_bytes(half[9:])
        vehicle.step(3.0)
    assert all_messages(first) == all_messages(second)
    assert first.events == second.events
    assert any("mode LAND" in event for event in second.events)


def test_copy_is_independent() -> None:
    first, alike = LockstepVehicle(seed=4), LockstepVehicle(seed=4)
    for vehicle in (first, alike):
        vehicle.take_off(3.0)
    second = first.copy()
    second.vehicle.faults.begin("motor_failure 1")
    second.vehicle.parameters.set("MPC_XY_P", 0.1)
    second.step(2.0)
    assert second.truth.crashed
    for vehicle in (first, alike):
        vehicle.step(2.0)
    assert all_messages(first) == all_messages(alike)
    assert first.events == alike.events


def test_copy_with_active_fault_refused() -> None:
    vehicle = LockstepVehicle({"onboard": {}})
    vehicle.vehicle.faults.begin("gust 6")
    with pytest.raises(ValueError, match=r"copy: .* gust .*; end"):
        vehicle.copy()
    vehicle.vehicle.faults.end()
    vehicle.copy().step(1.0)


@pytest.mark.parametrize("autopilot", ["px4", "ardupilot"])
def test_setpoint_methods_send_the_stream(autopilot: str) -> None:
    vehicle = LockstepVehicle({"onboard": {}}, autopilot=autopilot, seed=3, noise=0.0, gusts_mps=0.0)
    vehicle.take_off(5.0)
    vehicle.set_velocity(2.0, 0.0, 0.0)
    vehicle.step(6.0)
    assert vehicle.truth.velocity_ned_mps == pytest.approx((2.0, 0.0, 0.0), abs=0.3)
    vehicle.set_position(5.0, -5.0, -6.0, yaw_rad=1.0)
    vehicle.step(20.0)
    assert vehicle.truth.position_ned_m == pytest.approx((5.0, -5.0, -6.0), abs=0.5)
    assert vehicle.truth.yaw_rad == pytest.approx(1.0, abs=0.1)
    with pytest.raises(ValueError, match="finite numbers"):
        vehicle.set_velocity(math.nan, 0.0, 0.0)


def test_a_px4_whose_setpoints_stop_leaves_offboard() -> None:
    vehicle = LockstepVehicle({"onboard": {}}, seed=3)
    vehicle.take_off(5.0)
    vehicle.set_velocity(1.0, 0.0, 0.0)
    vehicle.step(2.0)
    assert vehicle.truth.mode == "OFFBOARD"
    vehicle.stop_setpoints()
    vehicle.step(2.0)
    assert vehicle.truth.mode != "OFFBOARD"
