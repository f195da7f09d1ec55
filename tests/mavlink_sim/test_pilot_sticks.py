"""Joysticks and remote controls: the source used, channels, and the pilot's requests."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavlink_sim.autopilot.manual_control import ManualControl, RequestKind, Source
from mavlink_sim.flight.transmitter import Sticks, Switches, Transmitter, read_sticks, read_switches
from mavlink_sim.px4.modes import Mode
from mavlink_sim.px4.parameters import Parameters
from mavlink_sim.wire.announcements import event_identifier
from mavlink_sim.wire.messages import dialect
from tests.mavlink_sim.conftest import CALIBRATION, SimHarness

JOYSTICK = {"COM_RC_IN_MODE": 1}
REMOTE_CONTROL = {**CALIBRATION, "COM_RC_IN_MODE": 0, "COM_FLTMODE1": 2, "COM_FLTMODE4": 4, "COM_FLTMODE6": 8}
MAVLINK_0, MAVLINK_1 = Source.MAVLINK, Source.MAVLINK + 1
GROUND_STATION = (245, 190)

# STATUSTEXTs of PX4.
ARMED_BY_STICKS = "Armed by stick gesture\t"
DISARMED_BY_STICKS = "Disarmed by stick gesture\t"
DISARMED_BY_SWITCH = "Disarmed by kill-switch\t"
DENIED_ABOVE_CENTER = "Arming denied: throttle above center\t"
DENIED_HIGH_THROTTLE = "Arming denied: high throttle\t"
DENIED_IN_AUTO_MODE = "Arming denied: switch to manual mode first\t"
MISSION_REFUSED = "Switching to Mission is currently not available\t"
KILL_SWITCH_ENGAGED = "Preflight Fail: Kill switch engaged"


def selector(mode: int, **values: float) -> ManualControl:
    return ManualControl(Parameters({"COM_RC_IN_MODE": mode, **values}))


@pytest.mark.parametrize(
    ("mode", "order", "chosen"),
    [
        pytest.param(0, [MAVLINK_0, Source.REMOTE_CONTROL], Source.REMOTE_CONTROL, id="remote control only"),
        pytest.param(0, [MAVLINK_0], None, id="remote control only, a joystick does not count"),
        pytest.param(1, [Source.REMOTE_CONTROL, MAVLINK_1], MAVLINK_1, id="joystick only"),
        pytest.param(1, [MAVLINK_1, MAVLINK_0], MAVLINK_1, id="joystick only, the first one stays"),
        pytest.param(
            2, [Source.REMOTE_CONTROL, MAVLINK_0], Source.REMOTE_CONTROL, id="either, as long as it lasts"
        ),
        pytest.param(3, [MAVLINK_0, Source.REMOTE_CONTROL], MAVLINK_0, id="the first forever"),
        pytest.param(4, [Source.REMOTE_CONTROL, MAVLINK_0], None, id="disabled"),
        pytest.param(
            5, [MAVLINK_1, MAVLINK_0, Source.REMOTE_CONTROL], Source.REMOTE_CONTROL, id="remote control first"
        ),
        pytest.param(5, [MAVLINK_0, MAVLINK_1], MAVLINK_0, id="then joysticks ascending"),
        pytest.param(
            6, [Source.REMOTE_CONTROL, MAVLINK_1, MAVLINK_0], MAVLINK_0, id="joysticks ascending first"
        ),
        pytest.param(6, [MAVLINK_0, Source.REMOTE_CONTROL], MAVLINK_0, id="then the remote control"),
        pytest.param(7, [MAVLINK_0, MAVLINK_1], MAVLINK_1, id="joysticks descending"),
        pytest.param(
            7, [MAVLINK_1, Source.REMOTE_CONTROL, MAVLINK_1], Source.REMOTE_CONTROL, id="remote, descending"
        ),
        pytest.param(
            8, [MAVLINK_1, MAVLINK_0, Source.REMOTE_CONTROL], MAVLINK_1, id="joysticks descending first"
        ),
    ],
)
def test_com_rc_in_mode_selects_source(mode: int, order: list[int], chosen: int | None) -> None:
    control = selector(mode)
    for number, source in enumerate(order):
        control.offer(Sticks(), source, 1.0 + 0.01 * number)
    assert (control.source if control.valid else None) == chosen


def test_source_changes_after_silence_unless_kept() -> None:
    for mode, takes_over in ((2, True), (3, False)):
        control = selector(mode)
        control.offer(Sticks(), Source.REMOTE_CONTROL, 1.0)
        control.offer(Sticks(), MAVLINK_0, 1.6)
        assert control.valid is takes_over


def test_sticks_expire_after_com_rc_loss_t() -> None:
    control = selector(1, COM_RC_LOSS_T=0.5)
    control.offer(Sticks(roll=0.5), MAVLINK_0, 1.0)
    control.update(1.49)
    assert control.valid
    assert control.sticks.roll == 0.5
    control.update(1.51)
    assert not control.valid
    assert control.sticks == Sticks()


def test_only_fast_sticks_are_moved() -> None:
    for step, moved in ((0.002, False), (0.02, True)):
        control = selector(1)
        for number in range(50):
            control.offer(Sticks(pitch=step * number), MAVLINK_0, 1.0 + 0.02 * number)
        assert control.take_moved() is moved
        assert not control.take_moved()


def test_the_arming_gesture_takes_a_second_in_the_corner() -> None:
    control = selector(1)
    asked = []
    for number in range(80):
        now_s = 1.0 + 0.02 * number
        control.offer(Sticks(yaw=1.0, throttle=-1.0), MAVLINK_0, now_s)
        asked += [(now_s, request) for request in control.update(now_s)]
    assert [request.kind for _, request in asked] == [RequestKind.ARM]
    assert asked[0][0] == pytest.approx(2.0, abs=0.03)
    assert asked[0][1].by == "stick gesture"


def test_switches_request_once_not_on_first_armed_frame() -> None:
    control = selector(0, COM_FLTMODE1=2, COM_FLTMODE2=4)
    control.offer(Sticks(), Source.REMOTE_CONTROL, 1.0)
    control.offer_switches(Switches(mode_slot=1, kill=False), armed=True)
    assert control.update(1.0) == []
    control.offer_switches(Switches(mode_slot=2, kill=True), armed=True)
    requests = control.update(1.0)
    assert [(request.kind, request.mode) for request in requests] == [
        (RequestKind.SWITCH_MODE, Mode.HOLD),
        (RequestKind.KILL, None),
    ]
    control.offer_switches(Switches(mode_slot=2, kill=False, back=True), armed=True)
    control.offer_switches(Switches(mode_slot=2, kill=False, back=False), armed=True)
    assert [(request.kind, request.mode) for request in control.update(1.0)] == [
        (RequestKind.SWITCH_MODE, Mode.RTL),
        (RequestKind.UNKILL, None),
        (RequestKind.SWITCH_MODE, Mode.HOLD),  # the return switch off: back to the mode switch
    ]


@given(st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4), st.integers(1, 6), st.booleans())
def test_transmitter_channels_round_trip(positions: list[float], slot: int, kill: bool) -> None:
    parameters = Parameters(CALIBRATION)
    transmitter = Transmitter(parameters)
    transmitter.sticks, transmitter.mode_slot, transmitter.kill = Sticks(*positions), slot, kill
    widths = transmitter.channels()
    sticks = read_sticks(widths, parameters)
    assert sticks is not None
    got = (sticks.roll, sticks.pitch, sticks.yaw, sticks.throttle)
    assert got == pytest.approx(positions, abs=0.03)  # the dead zone is 2 % of the way
    switches = read_switches(widths, parameters)
    assert (switches.mode_slot, switches.kill, switches.back) == (slot, kill, False)


@given(st.lists(st.integers(0, 65535), max_size=18))
def test_any_channels_give_sticks_within_range_or_none(widths: list[int]) -> None:
    parameters = Parameters(CALIBRATION)
    sticks = read_sticks(widths, parameters)
    read_switches(widths, parameters)
    if sticks is not None:
        assert all(abs(value) <= 1.0 for value in (sticks.roll, sticks.pitch, sticks.yaw, sticks.throttle))


def test_a_position_of_the_mode_switch_without_a_mode_is_named() -> None:
    transmitter = Transmitter(Parameters({"COM_FLTMODE3": 2}))
    transmitter.select(Mode.POSCTL)
    assert transmitter.mode_slot == 3
    with pytest.raises(ValueError, match="COM_FLTMODE"):
        transmitter.select(Mode.ACRO)


# ---- on the vehicle


def stick_message(pitch: int = 0, roll: int = 0, throttle: int = 500, yaw: int = 0, target: int = 1) -> Any:
    return dialect.MAVLink_manual_control_message(target, pitch, roll, throttle, yaw, 0)


def push(harness: SimHarness, seconds: float, message: Any, until: Any = None) -> None:
    """A joystick's stream at 25 Hz."""
    end_s = harness.now_s + seconds
    while harness.now_s < end_s - 1e-9 and not (until is not None and until()):
        harness.send(message)
        harness.fly(0.04)


def events(harness: SimHarness, name: str) -> list[Any]:
    return [message for message in harness.received("EVENT") if message.id == event_identifier(name)]


def test_uncalibrated_vehicle_ignores_sticks(harness: SimHarness) -> None:
    harness.wait_ready()
    push(harness, 0.5, stick_message())
    assert not harness.vehicle.autopilot.pilot_has_sticks
    assert harness.mode == "HOLD"


def test_first_joystick_selects_position_mode() -> None:
    harness = SimHarness(parameters=JOYSTICK)
    harness.wait_ready()
    push(harness, 0.2, stick_message(target=7))
    assert harness.mode == "HOLD"  # it was for another vehicle
    push(harness, 0.2, stick_message())
    assert harness.mode == "POSCTL"
    assert harness.vehicle.autopilot.can_arm


def test_sticks_arm_fly_and_disarm() -> None:
    harness = SimHarness(parameters=JOYSTICK)
    harness.heartbeats.append(("gcs", GROUND_STATION, 6))
    harness.wait_ready()
    push(harness, 0.2, stick_message())
    push(harness, 1.5, stick_message(throttle=0, yaw=1000), until=lambda: harness.armed)
    assert harness.armed
    assert ARMED_BY_STICKS in harness.texts()
    push(harness, 8.0, stick_message(throttle=1000), until=lambda: harness.height_m > 3.0)
    assert harness.height_m > 3.0
    push(harness, 20.0, stick_message(throttle=0), until=lambda: harness.vehicle.autopilot.landed)
    assert harness.vehicle.autopilot.landed
    push(harness, 1.5, stick_message(throttle=0, yaw=-1000), until=lambda: not harness.armed)
    assert not harness.armed
    assert DISARMED_BY_STICKS in harness.texts()


def test_arming_denied_with_high_throttle() -> None:
    harness = SimHarness(parameters=JOYSTICK)
    harness.heartbeats.append(("gcs", GROUND_STATION, 6))
    harness.wait_ready()
    push(harness, 1.2, stick_message(throttle=900))
    assert harness.command(400, 1) == [1]
    assert DENIED_ABOVE_CENTER in harness.texts()
    harness.set_mode(7)
    push(harness, 0.2, stick_message(throttle=500))
    assert harness.command(400, 1) == [1]
    assert DENIED_HIGH_THROTTLE in harness.texts()
    harness.set_mode(4, 3)
    push(harness, 1.2, stick_message(throttle=0, yaw=1000))
    assert not harness.armed
    assert DENIED_IN_AUTO_MODE in harness.texts()


def test_losing_and_regaining_the_joystick_is_an_event() -> None:
    harness = SimHarness(parameters=JOYSTICK)
    harness.wait_ready()
    push(harness, 0.2, stick_message())
    lost_s = harness.until(lambda: bool(events(harness, "commander_rc_lost")), 2.0)
    assert lost_s == pytest.approx(0.5, abs=0.1)
    harness.fly(1.0)
    push(harness, 0.2, stick_message())
    assert len(events(harness, "commander_rc_regained")) == 1
    assert any("regained after 1." in line for line in harness.events)


def remote_control(**values: float) -> SimHarness:
    harness = SimHarness(parameters={**REMOTE_CONTROL, **values})
    harness.heartbeats.append(("gcs", GROUND_STATION, 6))
    harness.vehicle.transmitter.on = True
    return harness


def test_transmitter_reported_in_rc_channels_and_sys_status() -> None:
    harness = SimHarness(parameters=REMOTE_CONTROL)
    harness.fly(1.0)
    assert harness.received("RC_CHANNELS") == []
    harness.vehicle.transmitter.on = True
    harness.vehicle.transmitter.sticks = Sticks(roll=1.0, throttle=-1.0)
    harness.forget()
    harness.fly(2.0)
    channels = harness.received("RC_CHANNELS")
    assert len(channels) == pytest.approx(40, abs=2)
    last = channels[-1]
    assert (last.chancount, last.chan1_raw, last.chan2_raw, last.chan3_raw) == (8, 2000, 1500, 1000)
    assert last.chan9_raw == 65535
    status = harness.received("SYS_STATUS")[-1]
    assert status.onboard_control_sensors_present & status.onboard_control_sensors_health & 0x10000
    harness.vehicle.transmitter.on = False
    harness.fly(0.4)
    harness.forget()
    harness.fly(1.0)
    assert harness.received("RC_CHANNELS") == []
    assert not harness.received("SYS_STATUS")[-1].onboard_control_sensors_health & 0x10000


def test_rc_channels_override_is_a_remote_control() -> None:
    harness = SimHarness(parameters=REMOTE_CONTROL)
    harness.wait_ready()
    widths = [1500, 1500, 1000, 1500, 1080, 1000, 1000, 65535]
    message = dialect.MAVLink_rc_channels_override_message(1, 1, *widths, *[0] * 10)
    for _ in range(10):
        harness.send(message)
        harness.fly(0.05)
    assert harness.vehicle.autopilot.supervision.sticks.throttle == -1.0
    assert harness.mode == "POSCTL"  # the first position of the mode switch, while disarmed
    assert harness.received("RC_CHANNELS")[-1].chancount == 7


def test_mode_switch_changes_mode_or_reports_why_not() -> None:
    harness = remote_control(COM_FLTMODE5=3)
    transmitter = harness.vehicle.transmitter
    harness.take_off()
    transmitter.select(Mode.POSCTL)
    harness.fly(0.1)
    transmitter.mode_slot = 4
    harness.fly(0.1)
    assert harness.mode == "HOLD"
    transmitter.select(Mode.STABILIZED)
    harness.fly(0.1)
    assert harness.mode == "STABILIZED"
    transmitter.mode_slot = 1
    harness.fly(0.1)
    assert harness.mode == "POSCTL"
    transmitter.mode_slot = 5
    harness.fly(0.1)
    assert harness.mode == "POSCTL"
    assert MISSION_REFUSED in harness.texts()


def test_kill_switch_stops_motors_and_disarms_after_five_seconds() -> None:
    harness = remote_control(COM_DISARM_LAND=-1)
    harness.take_off(6.0)
    harness.vehicle.transmitter.kill = True
    harness.until(lambda: "kill switch engaged" in harness.events, 1.0)
    harness.fly(0.02)
    assert "Kill engaged\t" in harness.texts()
    fell_s = harness.until(lambda: harness.vehicle.airframe.on_ground, 4.0)
    assert fell_s < 2.5
    assert harness.armed
    rest_s = harness.until(lambda: not harness.armed, 6.0)
    assert fell_s + rest_s == pytest.approx(5.0, abs=0.2)
    assert DISARMED_BY_SWITCH in harness.texts()
    assert not harness.vehicle.autopilot.can_arm
    assert harness.command(400, 1) == [1]
    assert KILL_SWITCH_ENGAGED in harness.texts()
    harness.vehicle.transmitter.kill = False
    harness.fly(0.2)
    assert "Kill disengaged\t" in harness.texts()
    assert harness.vehicle.autopilot.can_arm


def test_short_kill_recovers() -> None:
    harness = remote_control()
    harness.take_off(15.0)
    harness.vehicle.transmitter.kill = True
    harness.fly(0.4)
    harness.vehicle.transmitter.kill = False
    harness.fly(5.0)
    assert harness.armed
    assert harness.height_m > 8.0
