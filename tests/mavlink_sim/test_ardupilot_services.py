"""Copter's messages: heartbeats, streams, parameters, texts; and a whole flight by mavutil."""

from __future__ import annotations

import math
import time
from pathlib import Path
from typing import Any

import pytest
from pymavlink import mavutil

from mavlink_sim import LockstepVehicle
from mavlink_sim.testing import running_simulator
from mavlink_sim.wire.messages import dialect

pytestmark = pytest.mark.realtime

GCS = (255, 190)


@pytest.fixture
def copter() -> LockstepVehicle:
    vehicle = LockstepVehicle(autopilot="ardupilot", seed=1, ready_after_s=0.0)
    vehicle.step(0.1)
    vehicle.receive()
    return vehicle


def kinds(vehicle: LockstepVehicle, seconds: float) -> dict[str, int]:
    vehicle.receive()
    vehicle.step(seconds)
    counted: dict[str, int] = {}
    for message in vehicle.receive():
        counted[message.get_type()] = counted.get(message.get_type(), 0) + 1
    return counted


def read(vehicle: LockstepVehicle, name: str) -> Any:
    vehicle.receive()
    vehicle.send(dialect.MAVLink_param_request_read_message(1, 1, name.encode(), -1))
    vehicle.step(0.1)
    found = [m for m in vehicle.receive() if m.get_type() == "PARAM_VALUE"]
    return found[-1] if found else None


def test_heartbeat_is_ardupilot_and_sent_at_mode_change(copter: LockstepVehicle) -> None:
    copter.step(1.0)
    beat = copter.newest["onboard"]["HEARTBEAT"]
    assert (beat.autopilot, beat.type, beat.custom_mode, beat.base_mode, beat.system_status) == (
        3,
        2,
        0,
        81,
        3,
    )
    copter.receive()
    assert copter.command(176, 1, 4) == "ACCEPTED"
    copter.step(0.02)
    reported = copter.receive()
    assert [m.custom_mode for m in reported if m.get_type() == "HEARTBEAT"] == [4]
    acknowledged = [m for m in reported if m.get_type() == "COMMAND_ACK"]
    assert [(m.command, m.result) for m in acknowledged] == [(176, 0)]  # one, and the real one
    copter.command(400, 1)
    copter.step(1.1)
    assert copter.newest["onboard"]["HEARTBEAT"].base_mode == 217
    assert copter.newest["onboard"]["HEARTBEAT"].system_status == 3  # landed is STANDBY, armed or not


def test_set_mode_acknowledged_with_its_own_id(copter: LockstepVehicle) -> None:
    copter.send(dialect.MAVLink_set_mode_message(1, 1, 5))
    copter.step(0.02)
    (answer,) = [m for m in copter.receive() if m.get_type() == "COMMAND_ACK"]
    assert (answer.command, answer.result) == (11, 0)
    assert copter.truth.mode == "LOITER"


def test_streams_only_on_request_by_group_or_message(copter: LockstepVehicle) -> None:
    assert set(kinds(copter, 12.0)) == {"HEARTBEAT", "TIMESYNC"}
    copter.send(dialect.MAVLink_request_data_stream_message(1, 1, 6, 5, 1))
    counted = kinds(copter, 4.0)
    assert counted["GLOBAL_POSITION_INT"] == counted["LOCAL_POSITION_NED"] == 20
    assert "ATTITUDE" not in counted
    assert read(copter, "SR1_POSITION").param_value == 5.0
    assert copter.command(511, 32, 50_000) == "ACCEPTED"
    assert copter.command(511, 245, 200_000) == "ACCEPTED"
    counted = kinds(copter, 4.0)
    assert (counted["LOCAL_POSITION_NED"], counted["EXTENDED_SYS_STATE"]) == (80, 20)
    assert counted["GLOBAL_POSITION_INT"] == 20
    assert copter.command(511, 32, 0) == "ACCEPTED"  # back to the group's rate
    assert copter.command(511, 410, 100_000) == "FAILED"
    copter.send(dialect.MAVLink_request_data_stream_message(1, 1, 0, 2, 1))
    counted = kinds(copter, 4.0)
    assert counted["LOCAL_POSITION_NED"] == counted["ATTITUDE"] == counted["EKF_STATUS_REPORT"] == 8
    copter.send(dialect.MAVLink_request_data_stream_message(1, 1, 0, 2, 0))
    assert set(kinds(copter, 3.0)) <= {"HEARTBEAT", "TIMESYNC", "EXTENDED_SYS_STATE"}


def test_reboot_drops_requested_rates_keeps_parameters(copter: LockstepVehicle) -> None:
    copter.send(dialect.MAVLink_param_set_message(1, 1, b"SR1_EXTRA2", 4, 9))
    copter.send(dialect.MAVLink_request_data_stream_message(1, 1, 0, 2, 1))
    copter.command(511, 31, 50_000)
    assert kinds(copter, 4.0)["VFR_HUD"] == 8
    copter.vehicle.faults.begin("reboot 1")
    copter.step(2.0)
    counted = kinds(copter, 4.0)
    assert set(counted) <= {"HEARTBEAT", "TIMESYNC", "VFR_HUD"}
    assert counted["VFR_HUD"] == 16


def test_parameters_are_numbers_in_list_order_without_hash(copter: LockstepVehicle) -> None:
    copter.send(dialect.MAVLink_param_request_list_message(1, 1))
    copter.step(1.0)
    listed = [m for m in copter.receive() if m.get_type() == "PARAM_VALUE"]
    assert [m.param_index for m in listed] == list(range(listed[0].param_count))
    values = {m.param_id: (m.param_type, m.param_value) for m in listed}
    assert values["RTL_ALT"] == (6, 1500.0)
    assert values["DISARM_DELAY"] == (2, 10.0)
    assert values["GUID_TIMEOUT"] == (9, 3.0)
    assert "MPC_XY_CRUISE" not in values


def test_param_set_truncates_clamps_and_broadcasts(copter: LockstepVehicle) -> None:
    for value, kept in ((1.6, 1.0), (-1.6, -1.0), (1000.0, 127.0)):
        copter.send(dialect.MAVLink_param_set_message(1, 1, b"DISARM_DELAY", value, 9))
        copter.step(0.02)
        (echo,) = [m for m in copter.receive() if m.get_type() == "PARAM_VALUE"]
        assert (echo.param_value, echo.param_type, echo.param_index) == (kept, 2, 65535)
    copter.send(dialect.MAVLink_param_set_message(1, 1, b"COM_OF_LOSS_T", 1.0, 9))
    assert read(copter, "COM_OF_LOSS_T") is None


def test_requested_message_follows_its_acknowledgement(copter: LockstepVehicle) -> None:
    assert copter.command(512, 148) == "ACCEPTED"
    copter.step(0.02)
    names = [m.get_type() for m in copter.receive()]
    assert names.index("COMMAND_ACK") < names.index("AUTOPILOT_VERSION")
    version = copter.newest["onboard"]["AUTOPILOT_VERSION"]
    assert version.capabilities & 131072  # PARAM_ENCODE_C_CAST
    assert not version.capabilities & 16  # PARAM_ENCODE_BYTEWISE
    assert version.flight_sw_version >> 24 == 4
    assert copter.command(512, 410) == "FAILED"
    assert copter.command(2000) == "UNSUPPORTED"


def test_home_is_arming_position_with_true_local_position(copter: LockstepVehicle) -> None:
    copter.vehicle.airframe.position = (4.0, 0.0, 0.0)
    copter.step(0.1)
    copter.command(400, 1)
    copter.step(0.02)
    home = copter.newest["onboard"]["HOME_POSITION"]
    assert home.latitude - 473977432 == pytest.approx(360, abs=40)
    assert (home.x, home.y, home.z) == pytest.approx((4.0, 0.0, 0.0), abs=0.5)
    assert all(map(math.isnan, home.q))


@pytest.mark.parametrize("position", [(1.0,), (0.0, 0.0, 0.0, 0.0, 47.3977432, 8.545594, 488.0)])
def test_commanded_home_is_kept_at_arming(copter: LockstepVehicle, position: tuple[float, ...]) -> None:
    """ArduPilot locks home, set to a position or to "here"."""
    assert copter.command(179, *position) == "ACCEPTED"
    copter.vehicle.airframe.position = (4.0, 0.0, 0.0)
    copter.step(0.1)
    assert copter.command(400, 1) == "ACCEPTED"
    copter.step(0.02)
    assert copter.newest["onboard"]["HOME_POSITION"].latitude == pytest.approx(473977432, abs=40)


def test_texts_have_no_tab_and_go_to_every_active_link(copter: LockstepVehicle) -> None:
    copter.send(dialect.MAVLink_heartbeat_message(18, 8, 0, 0, 4, 3))
    copter.command(400, 1)
    copter.step(0.02)
    assert [m.text for m in copter.receive() if m.get_type() == "STATUSTEXT"] == ["Arming motors"]


def test_missions_are_refused(copter: LockstepVehicle) -> None:
    copter.send(dialect.MAVLink_mission_count_message(1, 1, 3))
    copter.send(dialect.MAVLink_mission_request_list_message(1, 1))
    copter.step(0.02)
    reported = copter.receive()
    assert [m.type for m in reported if m.get_type() == "MISSION_ACK"] == [3]
    assert [m.count for m in reported if m.get_type() == "MISSION_COUNT"] == [0]


def test_a_whole_flight_by_mavutil(tmp_path: Path) -> None:
    """A flight as in ArduPilot's tutorials: modes by name, arm, take off, go to a point, return."""
    with running_simulator(autopilot="ardupilot", ready_after=0.0, speed=6.0) as simulator:
        link = mavutil.mavlink_connection(
            simulator.pymavlink_device, source_system=255, dialect="ardupilotmega"
        )
        link.wait_heartbeat(timeout=20)
        assert link.mode_mapping()["GUIDED"] == 4

        def until(name: str, condition: Any = lambda message: True) -> Any:
            deadline = time.monotonic() + 40.0
            while time.monotonic() < deadline:
                message = link.recv_match(type=name, blocking=True, timeout=1.0)
                if message is not None and condition(message):
                    return message
            raise TimeoutError(name)

        deadline = time.monotonic() + 40.0
        positioned = None
        while positioned is None:  # a request may be lost, as any datagram
            assert time.monotonic() < deadline
            link.mav.request_data_stream_send(1, 1, 0, 10, 1)
            positioned = link.recv_match(condition="EKF_STATUS_REPORT.flags & 16", blocking=True, timeout=2.0)
        link.set_mode("GUIDED")
        until("HEARTBEAT", lambda m: m.custom_mode == 4)
        link.arducopter_arm()
        link.motors_armed_wait()
        link.mav.command_long_send(1, 1, 22, 0, 0, 0, 0, 0, 0, 0, 5)
        until("GLOBAL_POSITION_INT", lambda m: m.relative_alt > 4500)
        link.mav.set_position_target_local_ned_send(0, 1, 1, 1, 0b110111111000, 8, 0, -5, *([0] * 8))
        until("LOCAL_POSITION_NED", lambda m: m.x > 7.0)
        link.param_set_send("RTL_ALT", 300)
        link.param_set_send("RTL_LOIT_TIME", 0)
        link.set_mode("RTL")
        link.motors_disarmed_wait()
        assert abs(until("LOCAL_POSITION_NED").x) < 1.5
        assert "disarmed (after landing)" in simulator.wait_for_event("disarmed")
        link.close()
