"""Commander's supervision of links, battery and pilot: sets the failsafe conditions, executes pilot requests.

The autopilot calls `update` once per step. Other checks (fence, motors) set their field of `conditions`.
Times are seconds since boot. Names in capitals are PX4's parameters.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from typing import Protocol

from mavlink_sim.autopilot.failsafe_responses import Action
from mavlink_sim.autopilot.failsafe_texts import INFO_LEVELS
from mavlink_sim.autopilot.failsafes import Conditions, FailsafeMachine
from mavlink_sim.autopilot.health_report import CheckedAutopilot, health_report
from mavlink_sim.autopilot.manual_control import GESTURE, ManualControl, Request, RequestKind, Source
from mavlink_sim.autopilot.position_failsafe import needs_position
from mavlink_sim.flight.transmitter import Sticks, Transmitter, read_sticks, read_switches
from mavlink_sim.physics.airframe import Multirotor
from mavlink_sim.physics.battery import Battery, BatteryWarning
from mavlink_sim.px4.modes import MANUAL_MODES, Mode
from mavlink_sim.px4.parameters import OVERRIDE_SPEED, Parameters
from mavlink_sim.releases import Release
from mavlink_sim.wire.announcements import CRITICAL, INFO, Text, event_identifier

EMERGENCY = 0  # MAV_SEVERITY_EMERGENCY
WARNING = 4  # MAV_SEVERITY_WARNING
ACCEPTED = 0  # MAV_RESULT

REPORTS_APART_S = 2.0  # of PX4's checks, when they change
PERIOD_S = 0.02  # Commander's own loop is about as fast; requests are processed immediately
KILL_EVENT_LEVELS_IN_THE_AIR = 0x62
# arm_disarm_reason_t of PX4's events
REASONS = {"stick gesture": 1, "RC switch": 2, "external command": 4, "kill-switch": 8, "failsafe": 14}
THROTTLE_ABOVE_CENTRE = 0.2
THROTTLE_LOW = -0.8
REARMING_GRACE_S = 5.0
# an enum's member takes as long as a call on Python 3.11: these are read at every control step
_NONE = Action.NONE
_TERMINATE = Action.TERMINATE
_NO_FAILSAFE = (_NONE, Mode.HOLD)
# Modes in which the throttle is a climb rate; in the other manual modes it is thrust.
CLIMB_RATE_MODES = frozenset({Mode.POSCTL, Mode.POSITION_SLOW, Mode.ALTCTL})
AUTO_OVERRIDE, OFFBOARD_OVERRIDE = 1, 2  # COM_RC_OVERRIDE
_BATTERY_TEXTS = {
    BatteryWarning.LOW: (CRITICAL, "Low battery\t"),
    BatteryWarning.CRITICAL: (CRITICAL, "Critical battery\t"),
    BatteryWarning.EMERGENCY: (EMERGENCY, "Emergency battery level\t"),
}


class SupervisedAutopilot(CheckedAutopilot, Protocol):
    """What the supervision uses of the autopilot; see `commander.Autopilot`."""

    now_s: float
    intended_mode: Mode
    failsafe: bool
    texts: deque[Text]

    @property
    def landed(self) -> bool: ...

    def arm(self, by: str = ...) -> int: ...

    def disarm(self, force: bool = False, by: str = ...) -> int: ...

    def set_mode(self, mode: Mode, report: bool = False) -> int: ...

    def adopt_intention(self, mode: Mode) -> None: ...

    def follow_failsafes(self, mode: Mode) -> None: ...

    def announce(self, line: str) -> None: ...


class Supervision:
    """The supervision of one vehicle.

    Attributes:
        manual_control: the stick sources. transmitter: the pilot's remote control, initially switched off.
        channels_us: the newest frame of a remote control, empty without one; channels_s: its time.
        battery, conditions, failsafes: see their modules.
        ground_station_seen_s: its newest heartbeat.
        killed: the kill switch is engaged, the motors are off.
        pilot_attached: sticks are assumed to be present and centred, whatever COM_RC_IN_MODE is.
    """

    def __init__(self, autopilot: SupervisedAutopilot, parameters: Parameters, release: Release) -> None:
        self._autopilot = autopilot
        self._parameters = parameters
        self.manual_control = ManualControl(parameters)
        self.transmitter = Transmitter(parameters)
        self.battery = Battery(parameters)
        self.conditions = Conditions()
        self.failsafes = FailsafeMachine(parameters, self._can_fly, autopilot.texts.append, release)
        self.channels_us: list[int] = []
        self.channels_s = -math.inf
        self.ground_station_seen_s = -math.inf
        self.killed = False
        self.pilot_attached = False
        self._since_watch_s = 0.0
        self._had_manual_control = False
        self._had_ground_station = False
        self._had_position = True
        self._manual_control_seen_s = 0.0
        self._killed_since_s = 0.0
        self._mode_requested = False
        self._ever_had_mode = False
        self._disarmed_s = -math.inf
        self._announced_failsafe = _NO_FAILSAFE
        self._reported: list[Text] = []
        self._report_compared_s = 0.0

    def keep_equipment(self, before: Supervision) -> None:
        """Keep battery and transmitter over a reboot: they are no part of the autopilot."""
        self.battery, self.transmitter = before.battery, before.transmitter
        self.pilot_attached = before.pilot_attached

    # ---- state ------------------------------------------------------------------------------------------

    @property
    def sticks(self) -> Sticks:
        """Of the selected source; centred without one."""
        return self.manual_control.sticks

    def read_sticks(self) -> Sticks:
        """`sticks`, as a function for tasks."""
        return self.sticks

    @property
    def pilot_has_sticks(self) -> bool:
        return self.pilot_attached or self.manual_control.valid

    @property
    def terminated(self) -> bool:
        return self.failsafes.action is _TERMINATE

    @property
    def motors_stopped(self) -> bool:
        """Killed or terminated: the motors are off in every mode."""
        return self.killed or self.failsafes.action is _TERMINATE

    @property
    def lacks_ground_station(self) -> bool:
        """NAV_DLL_ACT requires a ground station, and none is connected."""
        return self._parameters.number("NAV_DLL_ACT") > 0 and self.conditions.ground_station_lost

    @property
    def requires_mission(self) -> bool:
        """COM_ARM_MIS_REQ: nothing is armed without a mission."""
        return self._parameters.number("COM_ARM_MIS_REQ") > 0

    @property
    def allows_arming(self) -> bool:
        return self._arming_problem() is None

    def _arming_problem(self) -> tuple[int, str] | None:
        """(severity, text) of what prevents arming in every mode."""
        if self.killed or self.manual_control.kill_switch_on:
            return CRITICAL, "Preflight Fail: Kill switch engaged"
        if self.manual_control.return_switch_on:
            return CRITICAL, "Preflight Fail: RTL switch engaged"
        battery = self.battery
        warning = battery.checked_warning
        lowest = self._parameters.number("COM_ARM_BAT_MIN")
        if battery.connected and battery.is_checked:
            if lowest >= 0.0:
                if battery.remaining < lowest:
                    return _BATTERY_TEXTS[max(warning, BatteryWarning.LOW)]
            elif warning >= BatteryWarning.CRITICAL:
                return _BATTERY_TEXTS[warning]
        if self.lacks_ground_station:
            return WARNING, "Preflight Fail: No connection to the GCS"
        return None

    # ---- inputs -----------------------------------------------------------------------------------------

    def joystick(self, sticks: Sticks, link_number: int) -> None:
        """Take MANUAL_CONTROL of the vehicle's n-th link (from 0)."""
        self.manual_control.offer(sticks, Source.MAVLINK + link_number, self._autopilot.now_s)

    def remote_control(self, widths_us: list[int]) -> None:
        """Take a frame of a remote control's channels, in microseconds; zero: no such channel."""
        now_s = self._autopilot.now_s
        self.channels_us, self.channels_s = widths_us, now_s
        sticks = read_sticks(widths_us, self._parameters)
        if sticks is None:
            return
        self.manual_control.offer(sticks, Source.REMOTE_CONTROL, now_s)
        switches = read_switches(widths_us, self._parameters)
        self.manual_control.offer_switches(switches, self._autopilot.armed)

    # ---- arming -----------------------------------------------------------------------------------------

    def refuses_arming(self, by: str) -> Text | None:
        """Why arming is denied, as PX4's text; None if the supervision allows it."""
        autopilot = self._autopilot
        manual = autopilot.mode in MANUAL_MODES
        by_pilot = by != "external command"
        if by == "RC switch" and autopilot.now_s - self._disarmed_s < REARMING_GRACE_S:
            return None
        if manual and self.manual_control.valid:
            throttle = self.sticks.throttle
            if autopilot.mode in CLIMB_RATE_MODES and throttle > THROTTLE_ABOVE_CENTRE:
                return _denied("throttle above center", "commander_arm_denied_throttle_center")
            if autopilot.mode not in CLIMB_RATE_MODES and throttle >= THROTTLE_LOW:
                return _denied("high throttle", "commander_arm_denied_throttle_high")
        if not manual and by_pilot:
            return _denied("switch to manual mode first", "commander_arm_denied_not_manual")
        problem = self._arming_problem()
        if problem is not None:
            autopilot.texts.append(Text(*problem))
        return None

    def may_disarm_in_the_air(self, by: str) -> bool:
        """COM_DISARM_MAN: by the pilot's gesture or switch, where the throttle is thrust."""
        autopilot = self._autopilot
        thrust_mode = autopilot.mode in MANUAL_MODES and autopilot.mode not in CLIMB_RATE_MODES
        by_pilot = by in (GESTURE, "RC switch")
        return thrust_mode and by_pilot and self._parameters.number("COM_DISARM_MAN") != 0

    def mode_was_requested(self) -> None:
        """Note a mode request, also of the current mode."""
        self._mode_requested = self._ever_had_mode = True

    def disarmed(self) -> None:
        self._disarmed_s = self._autopilot.now_s

    # ---- one step ---------------------------------------------------------------------------------------

    def update(self, dt_s: float, airframe: Multirotor) -> None:
        """Every PERIOD_S: read the remote control, run the checks, act."""
        self._since_watch_s += dt_s
        if self._since_watch_s < PERIOD_S - 1e-9:
            return
        dt_s, self._since_watch_s = self._since_watch_s, 0.0
        autopilot = self._autopilot
        now_s = autopilot.now_s
        if self.transmitter.on:
            self.remote_control(self.transmitter.channels())
        for request in self.manual_control.update(now_s):
            self._carry_out(request)
        self.battery.step(dt_s, autopilot.armed, airframe.thrust_mps2)
        self._check_manual_control()
        self._check_ground_station()
        self._monitor_battery()
        self._check_position()
        breached = autopilot.navigator.is_breached
        if breached and not self.conditions.geofence_breached:
            self.report_checks()
        self.conditions.geofence_breached = breached
        if now_s - self._report_compared_s >= REPORTS_APART_S:
            self._report_compared_s = now_s
            if health_report(autopilot) != self._reported:
                self.report_checks()
        sticks_request = self._check_sticks()
        autopilot.follow_failsafes(self.run_failsafes(dt_s, sticks_request))
        killed_s = now_s - self._killed_since_s
        if self.killed and autopilot.armed and killed_s >= self._parameters.number("COM_KILL_DISARM"):
            autopilot.disarm(force=True, by="kill-switch")
        if self.failsafes.action is Action.DISARM and autopilot.armed:
            autopilot.disarm(force=True, by="failsafe")

    def report_checks(self) -> None:
        """Send the health and arming report."""
        self._reported = health_report(self._autopilot)
        self._report_compared_s = self._autopilot.now_s
        self._autopilot.texts.extend(self._reported)

    def run_failsafes(self, dt_s: float = 0.0, sticks_request: bool = False) -> Mode:
        """Run the failsafe state machine. Returns the resulting mode."""
        autopilot, machine = self._autopilot, self.failsafes
        # the current value: OFFBOARD is requested right after the first setpoint, before the next check
        self.conditions.offboard_signal_lost = not autopilot.has_setpoints
        was_in_failsafe, reason = machine.in_failsafe, machine.reason
        wanted = autopilot.intended_mode
        intended = machine.update(
            dt_s,
            self.conditions,
            armed=autopilot.armed,
            intended=wanted,
            mode_requested=self._mode_requested,
            sticks_request=sticks_request,
        )
        self._mode_requested = False
        if intended is not wanted:
            autopilot.adopt_intention(intended)
            if sticks_request:
                autopilot.announce("the pilot took over using the sticks")
        if machine.action is _NONE and not was_in_failsafe:  # the usual case
            autopilot.failsafe, self._announced_failsafe = False, _NO_FAILSAFE
            return intended
        autopilot.failsafe = machine.in_failsafe
        mode = machine.mode(intended)
        announced = (machine.action, mode)
        if machine.in_failsafe and announced != self._announced_failsafe:
            autopilot.announce(f"failsafe: {machine.reason}, {mode.name}")
        elif was_in_failsafe and not machine.in_failsafe:
            back = reason == "offboard setpoints lost" and mode is Mode.OFFBOARD and autopilot.armed
            autopilot.announce("offboard setpoints are back" if back else "failsafe over")
        self._announced_failsafe = announced
        return mode

    def _can_fly(self, mode: Mode) -> bool:
        """Whether a mode is possible, apart from the sticks: their loss is a failsafe condition."""
        if mode in MANUAL_MODES or mode is Mode.OFFBOARD:
            return self._autopilot.position_valid or not needs_position(mode)
        return self._autopilot.can_run(mode)

    # ---- checks -----------------------------------------------------------------------------------------

    def _check_manual_control(self) -> None:
        autopilot = self._autopilot
        lost = not self.pilot_has_sticks
        if lost != self.conditions.manual_control_lost:
            self.conditions.manual_control_lost = lost
            if lost:
                self._event("commander_rc_lost")
                autopilot.announce("manual control lost")
            elif self._had_manual_control:
                away_s = autopilot.now_s - self._manual_control_seen_s
                self._event("commander_rc_regained", struct.pack("<f", away_s))
                autopilot.announce(f"manual control regained after {away_s:.1f} s")
        if not lost:
            self._had_manual_control = True
            self._manual_control_seen_s = autopilot.now_s

    def _check_position(self) -> None:
        """Report a lost position and its return; `_can_fly` has the effect on the modes."""
        autopilot = self._autopilot
        if autopilot.position_valid is not self._had_position:
            self._had_position = autopilot.position_valid
            autopilot.announce("the position is " + ("back" if self._had_position else "lost"))

    def _check_ground_station(self) -> None:
        autopilot = self._autopilot
        seen_s = self.ground_station_seen_s
        lost = autopilot.now_s - seen_s > self._parameters.number("COM_DL_LOSS_T")
        if lost == self.conditions.ground_station_lost:
            return
        first, self._had_ground_station = not self._had_ground_station, True
        self.conditions.ground_station_lost = lost
        if lost:
            event = (event_identifier("commander_gcs_lost"), 0x64, b"")
            autopilot.texts.append(Text(INFO, "Connection to ground station lost\t", event))
            autopilot.announce("the ground station's heartbeat is lost")
        elif not first:
            event = (event_identifier("commander_dl_regained"), INFO_LEVELS, b"")
            autopilot.texts.append(Text(INFO, "GCS connection regained\t", event))
            autopilot.announce("the ground station's heartbeat is back")

    def _monitor_battery(self) -> None:
        autopilot = self._autopilot
        warning = self.battery.checked_warning
        before = self.conditions.battery_warning
        if autopilot.armed:
            warning = max(warning, before)  # while armed it does not decrease
        if warning is before:
            return
        self.conditions.battery_warning = warning
        if warning > before:
            severity, text = _BATTERY_TEXTS[warning]
            autopilot.texts.append(Text(severity, text))
            autopilot.announce(f"battery {warning.name.lower()}: {self.battery.remaining:.0%}")

    def _check_sticks(self) -> bool:
        """Let the pilot take over by moved sticks in AUTO or OFFBOARD. True: from a failsafe."""
        autopilot = self._autopilot
        moved = self.manual_control.take_moved()
        if not self.manual_control.valid:
            return False
        if not autopilot.armed:
            mapped = self._parameters.number("RC_MAP_FLTMODE") > 0
            by_joystick = self.manual_control.source > Source.REMOTE_CONTROL
            if not self._ever_had_mode and (by_joystick or not mapped):
                autopilot.set_mode(Mode.POSCTL)  # Position is the initial mode once sticks are received
            return False
        if not moved or autopilot.mode in MANUAL_MODES:
            return False
        if OVERRIDE_SPEED not in self._parameters:
            bit = OFFBOARD_OVERRIDE if autopilot.mode is Mode.OFFBOARD else AUTO_OVERRIDE
            if not int(self._parameters.number("COM_RC_OVERRIDE")) & bit:
                return False
        if self.failsafes.in_failsafe:
            return True
        if autopilot.set_mode(Mode.POSCTL) == ACCEPTED:
            event = (event_identifier("commander_rc_override"), INFO_LEVELS, b"")
            autopilot.texts.append(Text(INFO, "Pilot took over using sticks\t", event))
            autopilot.announce("the pilot took over using the sticks")
        return False

    # ---- acting -----------------------------------------------------------------------------------------

    def _carry_out(self, request: Request) -> None:
        autopilot = self._autopilot
        if request.kind is RequestKind.ARM:
            autopilot.arm(by=request.by)
        elif request.kind is RequestKind.DISARM:
            autopilot.disarm(by=request.by)
        elif request.kind is RequestKind.SWITCH_MODE:
            assert request.mode is not None
            autopilot.announce(f"the pilot asks for {request.mode.name}")
            autopilot.set_mode(request.mode, report=True)
        else:
            self._kill(request.kind is RequestKind.KILL)

    def _kill(self, engaged: bool) -> None:
        autopilot = self._autopilot
        if engaged is self.killed:
            return
        self.killed = engaged
        self._killed_since_s = autopilot.now_s
        if not engaged:
            event = (event_identifier("commander_kill_sw_disengaged"), INFO_LEVELS, b"")
            autopilot.texts.append(Text(INFO, "Kill disengaged\t", event))
        else:
            identifier = event_identifier("commander_kill_sw_engaged")
            if autopilot.landed:
                autopilot.texts.append(Text(INFO, "Kill engaged\t", (identifier, INFO_LEVELS, b"")))
            else:
                event = (identifier, KILL_EVENT_LEVELS_IN_THE_AIR, b"")
                autopilot.texts.append(Text(CRITICAL, "Kill engaged\t", event))
        autopilot.announce("kill switch " + ("engaged" if engaged else "disengaged"))

    def _event(self, name: str, arguments: bytes = b"") -> None:
        """Queue an event without text."""
        self._autopilot.texts.append(Text(INFO, "", (event_identifier(name), INFO_LEVELS, arguments)))


def _denied(why: str, event: str) -> Text:
    return Text(CRITICAL, f"Arming denied: {why}\t", (event_identifier(event), 0x62, b""))
