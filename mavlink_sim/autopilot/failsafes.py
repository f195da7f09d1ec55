"""PX4's failsafe state machine: conditions, their actions, and when the pilot may override them.

Every failed check has one action; the worst of all active actions is selected. Most actions first hold the
position for COM_FAIL_ACT_T seconds, so that a pilot can take over. An action ends with its condition, or only
with the next change of mode or disarming. The rules are those of PX4 v1.14 to v1.18, which differ where
`releases` says so. Names in capitals are PX4's parameters; times are seconds.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from mavlink_sim.autopilot.failsafe_responses import (
    UNTIL_MODE_CHANGE,
    Action,
    Cause,
    Clears,
    Response,
    Takeover,
    battery_response,
    geofence_response,
    link_loss_response,
    motor_response,
)
from mavlink_sim.autopilot.failsafe_texts import INFO_LEVELS, failsafe_entered, failsafe_event
from mavlink_sim.physics.battery import BatteryWarning
from mavlink_sim.px4.modes import Mode
from mavlink_sim.px4.parameters import Parameters
from mavlink_sim.releases import Release, SticksCheck
from mavlink_sim.wire.announcements import Text


@dataclass(slots=True)
class Conditions:
    """The conditions that are active now; each check sets its field.

    Attributes:
        manual_control_lost: neither a remote control nor a joystick is valid.
        ground_station_lost: no ground station's heartbeat (true until the first one).
        battery_warning: of the emptiest battery.
        offboard_signal_lost: no setpoint stream.
        geofence_breached, mission_failed, wind_exceeded, flight_time_exceeded, motor_failed: as named.
        mission_finished: the mission's last item is done.
    """

    manual_control_lost: bool = True
    ground_station_lost: bool = True
    battery_warning: BatteryWarning = BatteryWarning.NONE
    offboard_signal_lost: bool = True
    geofence_breached: bool = False
    mission_failed: bool = False
    mission_finished: bool = False
    wind_exceeded: bool = False
    flight_time_exceeded: bool = False
    motor_failed: bool = False

    def snapshot(self) -> tuple[object, ...]:
        """All fields, to compare with an earlier state."""
        return (
            self.manual_control_lost,
            self.ground_station_lost,
            self.battery_warning,
            self.offboard_signal_lost,
            self.geofence_breached,
            self.mission_failed,
            self.mission_finished,
            self.wind_exceeded,
            self.flight_time_exceeded,
            self.motor_failed,
        )


MANUAL_CONTROL_DISABLED = 4  # COM_RC_IN_MODE
DELAY_RECOVERY = (
    0.25  # a used delay recovers this much slower, so that a flickering condition cannot extend it
)


@dataclass(slots=True)
class _Held:
    response: Response
    failing: bool = True
    checked: bool = True


_MODE_OF_ACTION = {
    Action.FALLBACK_POSITION: Mode.POSCTL,
    Action.FALLBACK_ALTITUDE: Mode.ALTCTL,
    Action.FALLBACK_STABILIZED: Mode.STABILIZED,
    Action.HOLD: Mode.HOLD,
    Action.RETURN: Mode.RTL,
    Action.LAND: Mode.LAND,
    Action.DESCEND: Mode.LAND,  # PX4 shows its descent without position as LAND
}
_PARAMETERS = (
    "COM_ACT_FAIL_ACT",
    "COM_DLL_EXCEPT",
    "COM_LOW_BAT_ACT",
    "COM_OBL_RC_ACT",
    "COM_RCL_EXCEPT",
    "COM_RC_IN_MODE",
    "COM_WIND_MAX_ACT",
    "GF_ACTION",
    "NAV_DLL_ACT",
    "NAV_RCL_ACT",
)
# Actions with autonomous flight, from which a pilot can take over.
_OVERRULABLE = frozenset({Action.HOLD, Action.RETURN, Action.LAND, Action.DESCEND})
# If an action is not possible, the next one is tried.
_FALLBACK_ORDER = (
    Action.FALLBACK_POSITION,
    Action.FALLBACK_ALTITUDE,
    Action.FALLBACK_STABILIZED,
    Action.HOLD,
    Action.RETURN,
    Action.LAND,
    Action.DESCEND,
)
_EXCEPTION_BITS = {
    Mode.MISSION: 1,
    Mode.HOLD: 2,
    Mode.TAKEOFF: 2,
    Mode.LAND: 2,
    Mode.RTL: 2,
    Mode.FOLLOW: 2,
    Mode.PRECLAND: 2,
    Mode.OFFBOARD: 4,
}


_STICK_ACTIONS = (Action.FALLBACK_POSITION, Action.FALLBACK_ALTITUDE, Action.FALLBACK_STABILIZED)
_RETURN = Response(Action.RETURN)
_FALLBACKS = {action: Response(action, takeover=Takeover.ALWAYS) for action in Action}


class FailsafeMachine:
    """The state machine. `can_fly(mode)`: whether a mode is possible now, apart from the sticks.

    Attributes:
        action: the active action.
        reason: its cause in words; empty without a failsafe.
        user_took_over: a pilot has overridden the action.
    """

    def __init__(
        self,
        parameters: Parameters,
        can_fly: Callable[[Mode], bool],
        announce: Callable[[Text], None],
        release: Release,
    ) -> None:
        self._parameters = parameters
        self._release = release
        self._can_fly = can_fly
        self._announce = announce
        self.action = Action.NONE
        self.reason = ""
        self.user_took_over = False
        self._revision = -1
        self._values: dict[str, int] = {}
        self._held: dict[str, _Held] = {}
        self._failed_before: set[str] = set()
        self._delay_s = 0.0  # remaining hold time before the action
        self._act_delay_s = parameters.number("COM_FAIL_ACT_T")
        self._start_delay_s = self._act_delay_s
        self._was_armed = False
        self._last_intended: Mode | None = None
        self._must_notify = False
        self._manual_control_optional = True
        self._warning_at_arming = BatteryWarning.NONE
        self._quiet_situation: tuple[object, ...] | None = None
        self._load()

    @property
    def in_failsafe(self) -> bool:
        return self.action > Action.WARN

    def mode(self, intended: Mode) -> Mode:
        """The resulting mode, from the one that the user wants."""
        return _MODE_OF_ACTION.get(self.action, intended)

    def update(
        self,
        dt_s: float,
        conditions: Conditions,
        *,
        armed: bool,
        intended: Mode,
        mode_requested: bool = False,
        sticks_request: bool = False,
    ) -> Mode:
        """Advance one step. Returns the mode that the user wants, which a takeover by sticks changes to
        POSCTL.

        Args:
            mode_requested: `intended` was requested since the last step, even if it was set before.
            sticks_request: a pilot moved the sticks enough for a takeover.
        """
        situation = (
            armed,
            intended,
            self._parameters.revision,
            self._can_fly(intended),
            self._can_fly(Mode.HOLD),
            conditions.snapshot(),
        )
        if situation == self._quiet_situation and not (mode_requested or sticks_request):
            return intended  # no failsafe before, and no change: the usual case
        if armed != self._was_armed:
            self._remove_settled()
            self.user_took_over = False
        mode_requested = mode_requested or (
            self._last_intended is not None and intended is not self._last_intended
        )
        if mode_requested or self.user_took_over:
            self._remove_settled()
        self._load()
        self._delay_s = max(self._delay_s - dt_s, 0.0)
        self._check_all(conditions, armed, intended)
        self._drop_unchecked()
        if self.action > Action.HOLD or not self._can_fly(Mode.HOLD) or self.user_took_over:
            self._delay_s = 0.0
        intended = self._select(dt_s, conditions, armed, intended, mode_requested, sticks_request)
        self._was_armed = armed
        self._last_intended = intended
        quiet = not (self._held or self.user_took_over) and self._start_delay_s >= self._act_delay_s
        self._quiet_situation = situation if quiet and self.action is Action.NONE else None
        return intended

    # ---- the checks -------------------------------------------------------------------------------------

    def _check_all(self, conditions: Conditions, armed: bool, intended: Mode) -> None:
        value = self._value
        if armed and not self._was_armed:
            self._manual_control_optional = conditions.manual_control_lost
            self._warning_at_arming = conditions.battery_warning
        elif not armed:
            self._manual_control_optional = conditions.manual_control_lost
        if not conditions.manual_control_lost:
            self._manual_control_optional = False
        rcl_excepted = bool(value("COM_RCL_EXCEPT") & _EXCEPTION_BITS.get(intended, 0))
        manual_disabled = value("COM_RC_IN_MODE") == MANUAL_CONTROL_DISABLED
        if not (manual_disabled or rcl_excepted or self._manual_control_optional):
            lost = conditions.manual_control_lost
            self._check("manual control lost", lost, self._on_manual_control_loss)
        dll_excepted = bool(value("COM_DLL_EXCEPT") & _EXCEPTION_BITS.get(intended, 0))
        if value("NAV_DLL_ACT") and not dll_excepted and intended not in (Mode.LAND, Mode.PRECLAND):
            lost = conditions.ground_station_lost
            self._check("ground station lost", lost, self._on_ground_station_loss)
        if intended is Mode.MISSION:
            self._check("mission failed", conditions.mission_failed, _RETURN)
            unled = (manual_disabled or rcl_excepted) and not value("NAV_DLL_ACT")
            alone = unled and conditions.mission_finished and conditions.ground_station_lost
            self._check("mission finished without a link", alone, _RETURN)
        self._check("wind exceeded", conditions.wind_exceeded, self._on_wind)
        self._check("flight time exceeded", conditions.flight_time_exceeded, _RETURN)
        self._check("geofence breached", conditions.geofence_breached, self._on_breach)
        warning = conditions.battery_warning
        if warning is not BatteryWarning.NONE:
            act = value("COM_LOW_BAT_ACT") if warning > self._warning_at_arming else 0
            self._check(f"battery {warning.name.lower()}", True, battery_response(act, warning))
        self._check("motor failed", conditions.motor_failed, self._on_motor_failure)
        fallback = self._mode_fallback(conditions, intended)
        name = "offboard setpoints lost" if intended is Mode.OFFBOARD else "the mode cannot be flown"
        self._check(name, fallback is not Action.NONE, _FALLBACKS[fallback])

    def _value(self, name: str) -> int:
        return self._values[name]

    def _mode_fallback(self, conditions: Conditions, intended: Mode) -> Action:
        """The fallback of a mode that is no longer possible."""
        action, wanted = Action.NONE, intended
        checks = self._release.checks_sticks if conditions.manual_control_lost else SticksCheck.NEVER
        if intended is Mode.OFFBOARD and conditions.offboard_signal_lost:
            action, wanted = self._offboard_loss()
            if action >= Action.HOLD:
                return action  # it needs no sticks; `_possible` checks whether it is possible
            if checks is not SticksCheck.NEVER:
                action = self._without_sticks()
        if wanted in (Mode.POSCTL, Mode.POSITION_SLOW) and not self._can_fly(wanted):
            action, wanted = Action.FALLBACK_ALTITUDE, Mode.ALTCTL
        if wanted is Mode.ALTCTL and not self._can_fly(wanted):
            action, wanted = Action.FALLBACK_STABILIZED, Mode.STABILIZED
        if checks is SticksCheck.ALWAYS and action in _STICK_ACTIONS:
            action = self._without_sticks()
        return action if self._can_fly(wanted) else Action.RETURN

    def _without_sticks(self) -> Action:
        """NAV_RCL_ACT instead of a mode of sticks. NONE: OFFBOARD stays, with its last setpoint."""
        return link_loss_response(self._value("NAV_RCL_ACT"), Cause.GENERIC).action

    def _offboard_loss(self) -> tuple[Action, Mode]:
        """COM_OBL_RC_ACT: 0 position, 1 altitude, 2 stabilized, 3 return, 4 land, 5 hold, 6 and 7 stop it."""
        return {
            1: (Action.FALLBACK_ALTITUDE, Mode.ALTCTL),
            2: (Action.FALLBACK_STABILIZED, Mode.STABILIZED),
            3: (Action.RETURN, Mode.RTL),
            4: (Action.LAND, Mode.LAND),
            5: (Action.HOLD, Mode.HOLD),
            6: (Action.TERMINATE, Mode.LAND),
            7: (Action.DISARM, Mode.HOLD),
        }.get(self._value("COM_OBL_RC_ACT"), (Action.FALLBACK_POSITION, Mode.POSCTL))

    # ---- active actions ---------------------------------------------------------------------------------

    def _check(self, name: str, failing: bool, response: Response) -> None:
        held = self._held.get(name)
        if failing:
            self._failed_before.add(name)
            if held is not None:
                held.failing = held.checked = True
                held.response = replace(held.response, action=response.action)
            else:
                self._hold(name, response)
        elif name in self._failed_before:
            self._failed_before.discard(name)
            self._condition_over(name)

    def _hold(self, name: str, response: Response) -> None:
        if response.takeover is Takeover.AFTER_DELAY:
            delayed = self._act_delay_s > 0.1
            if delayed and response.action is not Action.WARN and self._delay_s == 0.0:
                self._delay_s = self._start_delay_s
            takeover = Takeover.ALWAYS if delayed else Takeover.MODE_SWITCH_ONLY
            response = replace(response, takeover=takeover)
        self._held[name] = _Held(response)
        self._must_notify = self._must_notify or response.action is Action.WARN
        if response.action >= Action.HOLD:
            self.user_took_over = False

    def _condition_over(self, name: str) -> None:
        held = self._held.get(name)
        if held is None:
            return
        if held.response.clears is Clears.WITH_CONDITION:
            del self._held[name]
        else:
            held.failing = False

    def _drop_unchecked(self) -> None:
        """End the actions of checks that were not made in this step."""
        for name, held in list(self._held.items()):
            if not held.checked:
                self._condition_over(name)
            held.checked = False

    def _remove_settled(self) -> None:
        """End the actions whose condition is over, and that end with a change of mode or with disarming."""
        for name, held in list(self._held.items()):
            if not held.failing and held.response.clears is UNTIL_MODE_CHANGE:
                del self._held[name]

    def _load(self) -> None:
        if self._revision == self._parameters.revision:
            return
        self._revision = self._parameters.revision
        self._values = {name: int(self._parameters.number(name)) for name in _PARAMETERS}
        value = self._value
        self._on_manual_control_loss = link_loss_response(value("NAV_RCL_ACT"), Cause.MANUAL_CONTROL_LOSS)
        self._on_ground_station_loss = link_loss_response(value("NAV_DLL_ACT"), Cause.GROUND_STATION_LOSS)
        self._on_wind = geofence_response(value("COM_WIND_MAX_ACT"))
        self._on_breach = geofence_response(value("GF_ACTION"))
        self._on_motor_failure = motor_response(value("COM_ACT_FAIL_ACT"))
        configured = self._parameters.number("COM_FAIL_ACT_T")
        if configured != self._act_delay_s:
            self._act_delay_s = self._start_delay_s = configured

    # ---- selection --------------------------------------------------------------------------------------

    def _select(
        self,
        dt_s: float,
        conditions: Conditions,
        armed: bool,
        intended: Mode,
        mode_requested: bool,
        sticks_request: bool,
    ) -> Mode:
        before = self.action
        action, delayed, cause, reason = Action.NONE, Action.NONE, Cause.GENERIC, ""
        took_over = False
        if before is Action.TERMINATE:
            action, reason = Action.TERMINATE, self.reason  # until a reboot
        elif armed:
            action, cause, reason, takeover = self._worst()
            if (
                self._delay_s > 0.0
                and not self.user_took_over
                and takeover <= Takeover.MODE_SWITCH_ONLY
                and action not in (Action.NONE, Action.WARN, Action.HOLD, Action.DISARM, Action.TERMINATE)
            ):
                action, delayed, takeover = Action.HOLD, action, Takeover.MODE_SWITCH_ONLY
            by_switch = mode_requested and before > Action.WARN
            by_sticks = sticks_request and takeover is Takeover.ALWAYS
            allowed = takeover in (Takeover.ALWAYS, Takeover.MODE_SWITCH_ONLY)
            if action in _OVERRULABLE and allowed and (by_switch or by_sticks or self.user_took_over):
                if sticks_request and not self.user_took_over:
                    intended = Mode.POSCTL
                if not self.user_took_over:
                    self._announce(failsafe_event("failsafe_rc_override", INFO_LEVELS))
                took_over, delayed = True, Action.NONE
                action = max(Action.WARN, self._mode_fallback(conditions, intended))
            action, cause = self._possible(action, cause)
            action, delayed = self._softened(action, delayed, intended)
        self._use_delay(dt_s, delayed is not Action.NONE)
        if action > before or (action is not Action.NONE and self._must_notify):
            self._announce(failsafe_entered(intended, action, delayed, cause, self._delay_s))
        self._must_notify = False
        if before > Action.WARN >= action and intended is Mode.ORBIT:
            intended = Mode.HOLD  # the orbit is dropped
        self.action = action
        self.reason = reason if action > Action.WARN else ""
        self.user_took_over = took_over
        return intended

    def _worst(self) -> tuple[Action, Cause, str, Takeover]:
        action, cause, reason, takeover = Action.NONE, Cause.GENERIC, "", Takeover.ALWAYS
        for name, held in self._held.items():
            takeover = max(takeover, held.response.takeover)
            if held.response.action > action:
                action, cause, reason = held.response.action, held.response.cause, name
        return action, cause, reason, takeover

    def _possible(self, action: Action, cause: Cause) -> tuple[Action, Cause]:
        """The action, or the first worse one that is possible."""
        if action not in _FALLBACK_ORDER:
            return action, cause
        for candidate in _FALLBACK_ORDER[_FALLBACK_ORDER.index(action) :]:
            if candidate is Action.DESCEND or self._can_fly(_MODE_OF_ACTION[candidate]):
                return candidate, cause if candidate is action else Cause.GENERIC
        raise AssertionError("a descent is always possible")

    def _softened(self, action: Action, delayed: Action, intended: Mode) -> tuple[Action, Action]:
        """Keep a landing or a return that is already in progress."""
        flyable = {
            Mode.LAND: {Action.RETURN},
            Mode.RTL: {Action.RETURN},
            Mode.PRECLAND: {Action.RETURN, Action.LAND},
        }.get(intended, set())
        if (action in flyable or delayed in flyable) and self._can_fly(intended):
            return Action.WARN, Action.NONE
        return action, delayed

    def _use_delay(self, dt_s: float, delaying: bool) -> None:
        if delaying:
            self._start_delay_s = max(self._start_delay_s - dt_s, 0.0)
        else:
            self._start_delay_s = min(self._start_delay_s + DELAY_RECOVERY * dt_s, self._act_delay_s)
