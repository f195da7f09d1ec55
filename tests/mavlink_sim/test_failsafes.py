"""PX4's failsafe rules: the state machine alone, and on the vehicle."""

from __future__ import annotations

import pytest

from mavlink_sim.autopilot.failsafe_responses import Action
from mavlink_sim.autopilot.failsafes import Conditions, FailsafeMachine
from mavlink_sim.flight.transmitter import Sticks
from mavlink_sim.physics.battery import BatteryWarning
from mavlink_sim.px4.modes import Mode
from mavlink_sim.px4.parameters import Parameters
from mavlink_sim.releases import NEWEST, release_named
from mavlink_sim.wire.announcements import Text, event_identifier
from mavlink_sim.wire.messages import dialect
from tests.mavlink_sim.conftest import CALIBRATION, SimHarness, velocity_setpoint

GROUND_STATION = (245, 190)
REMOTE_CONTROL = {**CALIBRATION, "COM_RC_IN_MODE": 0, "COM_FLTMODE1": 2, "COM_FLTMODE4": 4}
STEP_S = 0.02

# STATUSTEXTs of PX4.
HOLD_FIRST = "Failsafe activated: entering Hold for 5 seconds\t"
ACTIVATED = "Failsafe activated\t"
GROUND_STATION_REGAINED = "GCS connection regained\t"
PILOT_TOOK_OVER = "Pilot took over using sticks\t"

# Event lines of the simulator.
STICKS_LOST_RTL = "failsafe: manual control lost, RTL"
GROUND_STATION_LOST = "the ground station's heartbeat is lost"


class Machine:
    """A state machine with a vehicle in the air, all links alive."""

    def __init__(self, **values: float) -> None:
        parameters = Parameters({"COM_RC_IN_MODE": 0, "COM_RCL_EXCEPT": 0, **values})
        self.announced: list[Text] = []
        self.impossible: set[Mode] = set()
        self.machine = FailsafeMachine(
            parameters, lambda mode: mode not in self.impossible, self.announced.append, release_named(NEWEST)
        )
        self.conditions = Conditions(
            manual_control_lost=False, ground_station_lost=False, offboard_signal_lost=False
        )
        self.intended = Mode.POSCTL
        self.run(0.1)

    @property
    def mode(self) -> Mode:
        return self.machine.mode(self.intended)

    def run(self, seconds: float, requested: Mode | None = None, sticks: bool = False) -> Mode:
        if requested is not None:
            self.intended = requested
        for number in range(round(seconds / STEP_S)):
            first = number == 0
            self.intended = self.machine.update(
                STEP_S,
                self.conditions,
                armed=True,
                intended=self.intended,
                mode_requested=first and requested is not None,
                sticks_request=first and sticks,
            )
        return self.mode

    @property
    def texts(self) -> list[str]:
        return [text.text for text in self.announced if text.text]


def test_losing_remote_control_holds_5_s_and_then_returns() -> None:
    machine = Machine(NAV_RCL_ACT=2, COM_FAIL_ACT_T=5)
    machine.conditions.manual_control_lost = True
    assert machine.run(4.9) is Mode.HOLD
    assert machine.run(0.2) is Mode.RTL
    assert machine.texts == [HOLD_FIRST, ACTIVATED]


@pytest.mark.parametrize(
    ("act", "mode"),
    [
        pytest.param(0, Mode.POSCTL, id="disabled"),
        pytest.param(1, Mode.HOLD, id="hold"),
        pytest.param(2, Mode.RTL, id="return"),
        pytest.param(3, Mode.LAND, id="land"),
    ],
)
def test_nav_rcl_act_and_nav_dll_act_choose_the_action(act: int, mode: Mode) -> None:
    for name, condition in (("NAV_RCL_ACT", "manual_control_lost"), ("NAV_DLL_ACT", "ground_station_lost")):
        machine = Machine(**{name: act, "COM_FAIL_ACT_T": 0})
        setattr(machine.conditions, condition, True)
        assert machine.run(0.1) is mode


def test_disarm_and_terminate_act_at_once() -> None:
    for act, action in ((6, Action.DISARM), (5, Action.TERMINATE)):
        machine = Machine(NAV_RCL_ACT=act)
        machine.conditions.manual_control_lost = True
        machine.run(0.1)
        assert machine.machine.action is action
    machine.conditions.manual_control_lost = False
    machine.run(1.0, requested=Mode.HOLD)
    assert machine.machine.action is Action.TERMINATE  # it takes a reboot


def test_return_ends_by_mode_change_not_by_regained_link() -> None:
    machine = Machine(COM_FAIL_ACT_T=0)
    machine.conditions.manual_control_lost = True
    assert machine.run(0.1) is Mode.RTL
    machine.conditions.manual_control_lost = False
    assert machine.run(1.0) is Mode.RTL
    assert machine.run(0.1, requested=Mode.POSCTL) is Mode.POSCTL
    assert not machine.machine.in_failsafe


def test_regained_link_during_hold_keeps_hold() -> None:
    machine = Machine(COM_FAIL_ACT_T=5)
    machine.conditions.manual_control_lost = True
    machine.run(2.0)
    machine.conditions.manual_control_lost = False
    assert machine.run(0.2, requested=Mode.ALTCTL) is Mode.ALTCTL


def test_sticks_take_over_from_return_not_from_hold() -> None:
    machine = Machine(NAV_DLL_ACT=2, COM_FAIL_ACT_T=5)
    machine.intended = Mode.MISSION
    machine.conditions.ground_station_lost = True
    assert machine.run(1.0) is Mode.HOLD
    assert machine.run(0.1, sticks=True) is Mode.HOLD
    assert machine.run(5.0) is Mode.RTL
    assert machine.run(0.1, sticks=True) is Mode.POSCTL
    assert machine.intended is Mode.POSCTL
    assert machine.machine.user_took_over
    assert not machine.machine.in_failsafe
    assert [text.event[0] for text in machine.announced if text.event][-1] == event_identifier(
        "failsafe_rc_override"
    )


def test_without_the_delay_only_a_mode_switch_takes_over() -> None:
    machine = Machine(NAV_DLL_ACT=2, COM_FAIL_ACT_T=0)
    machine.conditions.ground_station_lost = True
    assert machine.run(0.1) is Mode.RTL
    assert machine.run(0.1, sticks=True) is Mode.RTL
    assert machine.run(0.1, requested=Mode.POSCTL) is Mode.POSCTL


@pytest.mark.parametrize(
    ("mode", "exception"),
    [
        pytest.param(Mode.MISSION, 1, id="mission"),
        pytest.param(Mode.HOLD, 2, id="hold"),
        pytest.param(Mode.TAKEOFF, 2, id="takeoff"),
        pytest.param(Mode.OFFBOARD, 4, id="offboard"),
        pytest.param(Mode.POSCTL, 0, id="position, never excepted"),
    ],
)
def test_com_rcl_except_excludes_modes(mode: Mode, exception: int) -> None:
    for bits in (0, 7):
        machine = Machine(COM_RCL_EXCEPT=bits, COM_FAIL_ACT_T=0)
        machine.intended = mode
        machine.conditions.manual_control_lost = True
        machine.run(0.1)
        assert machine.machine.in_failsafe is not bool(bits & exception)


def test_no_rc_loss_if_armed_without_rc() -> None:
    machine = Machine()
    machine.machine.update(STEP_S, machine.conditions, armed=False, intended=Mode.HOLD)
    machine.intended = Mode.HOLD
    machine.conditions.manual_control_lost = True
    assert machine.run(1.0) is Mode.HOLD
    assert not machine.machine.in_failsafe
    machine.conditions.manual_control_lost = False
    machine.run(0.1)
    machine.conditions.manual_control_lost = True
    machine.run(0.1)
    assert machine.machine.in_failsafe  # a loss needs a first heartbeat


def test_worst_failsafe_wins_then_the_next_one() -> None:
    machine = Machine(NAV_DLL_ACT=1, COM_LOW_BAT_ACT=2, COM_FAIL_ACT_T=0)
    machine.intended = Mode.MISSION
    machine.conditions.ground_station_lost = True
    assert machine.run(0.1) is Mode.HOLD
    machine.conditions.battery_warning = BatteryWarning.CRITICAL
    assert machine.run(0.1) is Mode.LAND
    machine.conditions.battery_warning = BatteryWarning.NONE
    assert machine.run(0.1) is Mode.HOLD


@pytest.mark.parametrize(
    ("act", "critical", "emergency"),
    [
        pytest.param(0, Mode.POSCTL, Mode.POSCTL, id="warn"),
        pytest.param(1, Mode.RTL, Mode.RTL, id="return"),
        pytest.param(2, Mode.LAND, Mode.LAND, id="land"),
        pytest.param(3, Mode.RTL, Mode.LAND, id="return, then land"),
    ],
)
def test_com_low_bat_act_chooses_the_action(act: int, critical: Mode, emergency: Mode) -> None:
    machine = Machine(COM_LOW_BAT_ACT=act, COM_FAIL_ACT_T=0)
    machine.conditions.battery_warning = BatteryWarning.LOW
    assert machine.run(0.1) is Mode.POSCTL
    assert machine.machine.action is Action.WARN
    machine.conditions.battery_warning = BatteryWarning.CRITICAL
    assert machine.run(0.1) is critical
    machine.conditions.battery_warning = BatteryWarning.EMERGENCY
    assert machine.run(0.1) is emergency


def test_a_battery_that_was_critical_at_arming_only_warns() -> None:
    machine = Machine(COM_LOW_BAT_ACT=3, COM_FAIL_ACT_T=0)
    machine.conditions.battery_warning = BatteryWarning.CRITICAL
    machine.machine.update(STEP_S, machine.conditions, armed=False, intended=Mode.POSCTL)
    assert machine.run(0.1) is Mode.POSCTL
    machine.conditions.battery_warning = BatteryWarning.EMERGENCY
    assert machine.run(0.1) is Mode.LAND


def test_landing_or_returning_vehicle_keeps_its_mode() -> None:
    for mode in (Mode.LAND, Mode.RTL):
        machine = Machine(COM_LOW_BAT_ACT=3)
        machine.intended = mode
        machine.conditions.battery_warning = BatteryWarning.CRITICAL
        assert machine.run(1.0) is mode
        assert machine.machine.action is Action.WARN


def test_offboard_loss_acts_at_once_ends_with_setpoints() -> None:
    machine = Machine(COM_OBL_RC_ACT=0)
    machine.intended = Mode.OFFBOARD
    machine.conditions.offboard_signal_lost = True
    assert machine.run(0.1) is Mode.POSCTL  # a pilot has sticks
    machine.conditions.manual_control_lost = True
    machine.machine._parameters.set("COM_RCL_EXCEPT", 4)
    assert machine.run(0.1) is Mode.RTL
    machine.conditions.offboard_signal_lost = False
    assert machine.run(0.1) is Mode.OFFBOARD


def test_impossible_action_falls_back_to_next() -> None:
    machine = Machine(COM_FAIL_ACT_T=0)
    machine.conditions.manual_control_lost = True
    machine.impossible = {Mode.RTL}
    assert machine.run(0.1) is Mode.LAND
    machine.impossible = {Mode.RTL, Mode.LAND, Mode.HOLD, Mode.POSCTL, Mode.ALTCTL}
    machine.run(0.1)
    assert machine.machine.action is Action.DESCEND


def test_fence_action_ends_only_by_mode_switch() -> None:
    machine = Machine(GF_ACTION=2)
    machine.intended = Mode.MISSION
    machine.conditions.geofence_breached = True
    assert machine.run(0.1) is Mode.HOLD
    assert machine.run(0.1, sticks=True) is Mode.HOLD
    assert machine.run(0.1, requested=Mode.POSCTL) is Mode.POSCTL


def test_a_flickering_condition_uses_up_the_delay() -> None:
    machine = Machine(COM_FAIL_ACT_T=5, NAV_DLL_ACT=2)
    machine.intended = Mode.MISSION
    for _ in range(20):
        machine.conditions.ground_station_lost = True
        machine.run(1.0)
        machine.conditions.ground_station_lost = False
        machine.run(0.2, requested=Mode.MISSION)
        if machine.mode is Mode.RTL:
            break
    machine.conditions.ground_station_lost = True
    assert machine.run(2.0) is Mode.RTL


# ---- on the vehicle


def flying(px4: str | None = None, **values: float) -> SimHarness:
    harness = SimHarness(parameters={**REMOTE_CONTROL, **values}, px4=px4)
    harness.heartbeats.append(("gcs", GROUND_STATION, 6))
    harness.vehicle.transmitter.on = True
    harness.take_off(12.0)
    harness.set_mode(3)
    harness.fly(1.0)
    assert harness.mode == "POSCTL"
    return harness


def test_remote_control_switched_off_in_flight_ends_in_return() -> None:
    harness = flying()
    harness.vehicle.transmitter.on = False
    holding_s = harness.until(lambda: harness.mode == "HOLD", 2.0)
    assert holding_s == pytest.approx(0.5, abs=0.1)
    returning_s = harness.until(lambda: harness.mode == "RTL", 6.0)
    assert returning_s == pytest.approx(5.0, abs=0.1)
    harness.fly(0.1)
    assert HOLD_FIRST in harness.texts()
    assert ACTIVATED in harness.texts()
    assert harness.heartbeat().system_status == 5
    assert STICKS_LOST_RTL in harness.events


def test_regained_rc_takes_over_by_sticks() -> None:
    harness = flying()
    transmitter = harness.vehicle.transmitter
    transmitter.on = False
    harness.until(lambda: harness.mode == "RTL", 7.0)
    transmitter.on = True
    harness.fly(1.0)
    assert harness.mode == "RTL"
    transmitter.sticks = Sticks(pitch=0.9)
    harness.until(lambda: harness.mode == "POSCTL", 1.0)
    assert any(
        message.id == event_identifier("failsafe_rc_override") for message in harness.received("EVENT")
    )


def test_rc_loss_excepted_in_offboard() -> None:
    harness = flying()
    harness.offboard(velocity_setpoint(0, 0, 0))
    harness.vehicle.transmitter.on = False
    harness.fly(3.0, velocity_setpoint(0, 0, 0))
    assert harness.mode == "OFFBOARD"


def test_losing_the_ground_station_returns_after_the_hold() -> None:
    harness = SimHarness(parameters={"NAV_DLL_ACT": 2, "COM_DL_LOSS_T": 3})
    harness.until(lambda: harness.vehicle.autopilot.sensors_ready, 5.0)
    harness.fly(0.2)
    assert not harness.vehicle.autopilot.can_arm
    harness.vehicle.autopilot.arm()
    harness.fly(0.2)
    events = [event.id for event in harness.received("EVENT")]
    assert event_identifier("check_rc_dl_no_dllink") in events
    harness.heartbeats.append(("gcs", GROUND_STATION, 6))
    harness.take_off(12.0)
    harness.heartbeats.clear()
    lost_s = harness.until(lambda: "failsafe: ground station lost, HOLD" in harness.events, 5.0)
    assert 2.0 < lost_s < 3.1
    harness.until(lambda: harness.mode == "RTL", 6.0)
    assert GROUND_STATION_LOST in harness.events
    harness.send(dialect.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3), "gcs", GROUND_STATION)
    harness.fly(0.2)
    assert GROUND_STATION_REGAINED in harness.texts()
    assert harness.mode == "RTL"


def test_missing_ground_station_is_no_loss_by_default(harness: SimHarness) -> None:
    harness.take_off()
    harness.fly(15.0)
    assert harness.mode == "HOLD"
    assert not any("ground station" in line for line in harness.events)


# ---- a pilot taking over


@pytest.mark.parametrize(
    ("override", "taken_over"),
    [
        pytest.param(1, True, id="auto"),
        pytest.param(2, False, id="offboard only"),
        pytest.param(0, False, id="off"),
    ],
)
def test_sticks_moved_in_an_auto_mode_take_over(override: int, taken_over: bool) -> None:
    harness = flying(COM_RC_OVERRIDE=override)
    harness.set_mode(4, 3)
    harness.fly(0.5)
    harness.vehicle.transmitter.sticks = Sticks(roll=0.5)
    harness.fly(0.3)
    assert harness.mode == ("POSCTL" if taken_over else "HOLD")
    assert (PILOT_TOOK_OVER in harness.texts()) is taken_over


@pytest.mark.parametrize(
    ("override", "taken_over"),
    [pytest.param(3, True, id="offboard too"), pytest.param(1, False, id="auto only")],
)
def test_sticks_take_over_in_offboard_if_enabled(override: int, taken_over: bool) -> None:
    harness = flying(COM_RC_OVERRIDE=override)
    harness.offboard(velocity_setpoint(0.5, 0, 0))
    harness.vehicle.transmitter.sticks = Sticks(yaw=0.6)
    harness.fly(0.5, velocity_setpoint(0.5, 0, 0))
    assert harness.mode == ("POSCTL" if taken_over else "OFFBOARD")


@pytest.mark.parametrize("auto", [True, False], ids=["auto", "offboard"])
@pytest.mark.parametrize(
    ("speed_limit", "travel_per_s", "seconds", "taken_over"),
    [
        pytest.param(1.0, 2.0, 0.2, True, id="quickly"),
        pytest.param(1.0, 0.8, 1.0, False, id="slowly"),
        pytest.param(1.0, 40.0, 0.02, False, id="in one sample"),
        pytest.param(5.0, 3.0, 0.3, False, id="slower than the limit"),
        pytest.param(-1.0, 4.0, 0.2, False, id="off"),
    ],
)
def test_sticks_override_of_1_18(
    auto: bool, speed_limit: float, travel_per_s: float, seconds: float, taken_over: bool
) -> None:
    harness = flying("1.18", MAN_OVERRIDE_SPD=speed_limit)
    setpoint = None if auto else velocity_setpoint(0.5, 0, 0)
    if auto:
        harness.set_mode(4, 3)
    else:
        harness.offboard(setpoint)
    harness.fly(0.5, setpoint)
    before = harness.mode
    for number in range(round(seconds / 0.02)):
        harness.vehicle.transmitter.sticks = Sticks(pitch=0.02 * travel_per_s * (number + 1))
        harness.fly(0.02, setpoint)
    harness.fly(0.3, setpoint)
    assert harness.mode == ("POSCTL" if taken_over else before)
    assert (PILOT_TOOK_OVER in harness.texts()) is taken_over


@pytest.mark.parametrize("release", ["1.14", "1.15", "1.16", "1.17", "1.18"])
def test_each_release_has_its_own_parameters_of_the_override(release: str) -> None:
    parameters = SimHarness(px4=release).vehicle.parameters
    names = {"COM_RC_OVERRIDE", "COM_RC_STICK_OV", "MAN_OVERRIDE_SPD"}
    expected = {"MAN_OVERRIDE_SPD"} if release == "1.18" else {"COM_RC_OVERRIDE", "COM_RC_STICK_OV"}
    assert {parameter.name for parameter in parameters} & names == expected
    assert [parameter.name for parameter in parameters] == sorted(parameter.name for parameter in parameters)


def test_sticks_moved_slowly_do_not_take_over() -> None:
    harness = flying()
    harness.set_mode(4, 3)
    harness.fly(0.5)
    for number in range(100):  # 20 % a second; COM_RC_STICK_OV is 30
        harness.vehicle.transmitter.sticks = Sticks(pitch=0.004 * number)
        harness.fly(0.02)
    assert harness.mode == "HOLD"
