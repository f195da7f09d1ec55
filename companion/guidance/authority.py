"""Command authority: distinguish our own mode changes from those of a pilot.

The requested mode is known, but not when it shows: a HEARTBEAT comes once a second, a request takes time, and
the autopilot changes mode by itself (take-off ends in hold, landing ends disarmed). Any other mode was chosen
by someone else, and our command ends. It also ends when someone else steers the vehicle without a change of
mode (`setpoint_monitor`).
"""

from __future__ import annotations

import math

from companion.guidance.limits.setpoint_monitor import SetpointMonitor
from companion.vehicle.autopilot_parameters import DEFAULT_ACCEPTANCE_M
from companion.vehicle.px4_modes import among_modes
from companion.vehicle.report import Report, words_of
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, LandedState, VehicleState
from companion.vehicle.streamer import SILENCE_S, StreamState

# The vehicle may show the old mode for this long after acknowledging a new one: a heartbeat period and more.
SHOW_DELAY_S = 2.0
# PX4 ends a take-off inside NAV_MC_ALT_RAD, 0.8 m by default; the two height estimates differ by some more. A
# hold further below the wanted height was requested by a pilot. PX4 allows up to 200 m: above the largest
# value here it is no sign of how a take-off ended.
LARGEST_ACCEPTANCE_M, HEIGHT_MARGIN_M = 2.0, 0.5
# The autopilot reports a failsafe within this time of its change of mode.
REPORT_WINDOW_S = 1.0
# Of a vehicle that may have landed.
STANDING_MPS, NEAR_GROUND_M = 0.3, 1.0
_FAILSAFES = "commander_failsafe_enter"
_LASTING_FAILSAFES = ("commander_failsafe_enter", "commander_failsafe_enter_generic")
GOING_DOWN = (FlightMode.LAND, FlightMode.RETURN, FlightMode.PRECISION_LAND)


class Authority:
    """Monitors the modes and the motion of one vehicle while we are in command of it.

    Attributes:
        monitor: compares the motion with our setpoints.
    """

    def __init__(self) -> None:
        self.monitor = SetpointMonitor()
        self._mode: FlightMode | None = None
        self._leaving: set[FlightMode] = set()
        self._leaving_until_ns: float = 0
        self._dropped: dict[FlightMode, float] = {}
        self._takeoff_altitude_m = self._begun_altitude_m = 0.0
        self._acceptance_m: float | None = None
        self._was_armed = False
        self._failsafe_before = False
        self._changed_ns: int | None = None

    @property
    def mode(self) -> FlightMode | None:
        """The mode last requested; None while not in command."""
        return self._mode

    def acquire(self, state: VehicleState) -> None:
        """Take command of a vehicle in its current state."""
        self._mode = state.mode
        self._changed_ns = None
        self._leaving = set()
        self._leaving_until_ns = 0
        self._dropped = {}
        self._takeoff_altitude_m = self._begun_altitude_m = state.altitude_m or 0.0
        self._was_armed = state.armed
        self._failsafe_before = state.failsafe

    def release(self) -> None:
        """Give up command; nothing is compared any more."""
        self._mode = None

    def request(self, mode: FlightMode, state: VehicleState, altitude_m: float | None = None) -> None:
        """Note a mode request: until `settled`, the previous mode may still show."""
        self._leaving |= {state.mode}
        if self._mode is not None:
            self._leaving |= {self._mode}
        if mode is FlightMode.TAKEOFF:
            self._leaving |= {FlightMode.HOLD}
            self._takeoff_altitude_m = altitude_m if altitude_m is not None else 0.0
            # Not below home: where the height has drifted, arming moves home.
            self._begun_altitude_m = max(state.altitude_m or 0.0, 0.0)
        # Disarmed after our own landing; a disarming in flight was noticed before.
        self._was_armed &= state.armed
        self._mode = mode
        self._changed_ns = None
        self._leaving_until_ns = float("inf")

    def settled(self, now_ns: int) -> None:
        """The request is done; until the new mode shows, the old one may show for one more heartbeat."""
        self._leaving_until_ns = now_ns + SHOW_DELAY_S * 1e9

    def dropped(self, now_ns: int) -> None:
        """The request is abandoned; it may still take effect, and show after the next one."""
        if self._mode is not None:
            self._dropped[self._mode] = now_ns + SHOW_DELAY_S * 1e9
        self.settled(now_ns)

    def refused(self, mode: FlightMode) -> None:
        """The request was refused: the previous mode is the expected one again."""
        self._mode = mode
        self._leaving = set()

    def lost(
        self,
        state: VehicleState,
        now_ns: int,
        *,
        flying_by_setpoint: bool,
        sent: Setpoint | None = None,
        landing: bool = False,
        altitude_acceptance_m: float | None = None,
    ) -> str | None:
        """Why command was lost; None while in command. Call it once per step.

        Args:
            sent: the setpoint the vehicle should fly now; None: none. landing: it leads to the ground.
            altitude_acceptance_m: how far below its goal PX4 ends a climb (NAV_MC_ALT_RAD); None: not known.
        """
        self._acceptance_m = altitude_acceptance_m
        if altitude_acceptance_m is not None and not 0.0 <= altitude_acceptance_m <= LARGEST_ACCEPTANCE_M:
            self._acceptance_m = None  # NaN too
        shown = sent if state.mode is self._mode else None
        ignored = self.monitor.update(shown, state, landing=landing)
        if self._mode is None:
            return None
        if not state.connected(now_ns):
            silent_s = (now_ns - state.heartbeat_ns) / 1e9
            return f"autopilot heartbeat lost: none for {silent_s:.1f} s"
        if (why := state.not_flown) is not None:
            return why
        explained = self._explained(state, now_ns)
        self._failsafe_before &= state.failsafe
        if state.failsafe and not self._failsafe_before and (flying_by_setpoint or not explained):
            return f"autopilot failsafe: {_shown(state.mode)}"
        if not explained:
            # A pilot's change also changes the intended mode; a failsafe keeps the one we requested.
            by_itself = state.intended_beside is state.mode and state.intended_mode is self._mode
            if not by_itself and self._may_have_finished(state, now_ns):
                short_m = self._short_m(state)
                return (
                    f"the take-off ended {short_m:.1f} m short: a pilot or the autopilot changed to hold mode"
                )
            who = "autopilot failsafe" if by_itself else "the pilot took over"
            return f"{who}: {_shown(state.mode)}"
        self._was_armed |= state.armed
        if self._was_armed and not state.armed and self._mode not in GOING_DOWN:
            return "the vehicle was disarmed"
        return ignored

    def reason_is_logged(self, state: VehicleState, now_ns: int) -> bool:
        """Whether the autopilot has reported everything it will report about the reason.

        A HEARTBEAT may show a new mode shortly before CURRENT_MODE reports the intended mode, and both may
        come before the autopilot's text message.
        """
        if state.mode is self._mode:
            return True  # not a change of mode
        complete = not state.reports or bool(self.reasons_for(state, now_ns))
        if state.reports and self._holds_by_itself(state):
            # The cause is reported first; only the failsafe's event shows whether the hold is lasting.
            complete = any(one.name.startswith(_FAILSAFES) for one in _warnings(state, now_ns))
        attributed = state.intended_beside in (FlightMode.UNKNOWN, state.mode) or state.failsafe
        return attributed and (complete or state.intended_mode is state.mode)

    def reasons_for(self, state: VehicleState, now_ns: int) -> str:
        """The autopilot's own warnings when it took command; empty: none."""
        warnings = _warnings(state, now_ns)
        return words_of(one for one in warnings if self._mode is None or among_modes(self._mode, one.modes))

    def chose_hold(self, state: VehicleState, now_ns: int) -> bool:
        """Whether a failsafe left OFFBOARD for a lasting hold.

        Not the hold during COM_FAIL_ACT_T, before PX4's actual failsafe action: its events have other names.
        """
        return self._holds_by_itself(state) and any(
            one.name in _LASTING_FAILSAFES for one in _warnings(state, now_ns)
        )

    def _holds_by_itself(self, state: VehicleState) -> bool:
        return (
            self._mode is FlightMode.OFFBOARD
            and state.mode is state.intended_beside is FlightMode.HOLD
            and state.intended_mode is FlightMode.OFFBOARD
        )

    def _explained(self, state: VehicleState, now_ns: int) -> bool:
        if state.mode is self._mode:
            # While the request is in progress the old mode may flicker; afterwards it may not.
            if self._leaving_until_ns != float("inf"):
                self._leaving = set()
            self._changed_ns = None
            return True
        if state.mode in self._leaving and now_ns <= self._leaving_until_ns:
            return True
        if now_ns <= self._dropped.get(state.mode, 0):
            return True
        if self._mode in GOING_DOWN:
            # Landed and disarmed, PX4 shows the mode selected before the landing: CURRENT_MODE at once, but
            # only the next heartbeat shows `armed`.
            if self._changed_ns is None:
                self._changed_ns = now_ns
            asking = self._leaving_until_ns == float("inf")  # a pilot's mode must not be asked away
            unknown = not asking and _may_have_landed(state) and state.heartbeat_ns <= self._changed_ns
            return unknown or not state.armed or state.landed is LandedState.ON_GROUND
        if self._holds_after_takeoff(state, now_ns):
            # More than half of the climb is missing: PX4's end only where the climb is low.
            half_m = (self._takeoff_altitude_m - self._begun_altitude_m) / 2.0
            return self._short_m(state) <= min(self._reach_m, max(half_m, DEFAULT_ACCEPTANCE_M))
        return False

    def _holds_after_takeoff(self, state: VehicleState, now_ns: int) -> bool:
        leaving = FlightMode.TAKEOFF in self._leaving and now_ns <= self._leaving_until_ns
        return (self._mode is FlightMode.TAKEOFF or leaving) and state.mode is FlightMode.HOLD

    @property
    def _reach_m(self) -> float:
        """How far below the wanted height PX4 may end a take-off."""
        acceptance_m = DEFAULT_ACCEPTANCE_M if self._acceptance_m is None else self._acceptance_m
        return acceptance_m + HEIGHT_MARGIN_M

    def _short_m(self, state: VehicleState) -> float:
        return self._takeoff_altitude_m - (state.altitude_m or 0.0)

    def _may_have_finished(self, state: VehicleState, now_ns: int) -> bool:
        """Whether a short take-off may be PX4's own: it accepts the height there, or where is not known."""
        accepted = self._acceptance_m is None or self._short_m(state) <= self._reach_m
        return accepted and state.autopilot == "PX4" and self._holds_after_takeoff(state, now_ns)


def stream_interruption(stream: StreamState, paused_s: float) -> str | None:
    """Why the setpoint stream was interrupted; None: it was not. `paused_s`: since the previous step.

    PX4 would resume OFFBOARD by itself if setpoints came back; only an operator may.
    """
    if paused_s > SILENCE_S:
        return f"guidance loop paused for {paused_s:.1f} s"
    if stream is StreamState.EXPIRED:
        return "setpoint stream interrupted"
    return None


def _may_have_landed(state: VehicleState) -> bool:
    """Whether it stands, or is near the height of home."""
    stands = state.velocity_ned_mps is not None and math.hypot(*state.velocity_ned_mps) < STANDING_MPS
    return stands or (state.altitude_m is not None and state.altitude_m < NEAR_GROUND_M)


def _shown(mode: FlightMode) -> str:
    return f"{mode.value.replace('_', ' ')} mode"


def _warnings(state: VehicleState, now_ns: int) -> list[Report]:
    return state.warnings_since(now_ns - round(REPORT_WINDOW_S * 1e9))
