"""Whose vehicle it is: tells our own mode changes from a pilot's.

What we asked for is known, but not when it shows: a HEARTBEAT comes once a second, a request takes its time,
and the autopilot moves on by itself (take-off ends in hold, landing ends disarmed). Every mode that none of
this explains was chosen by someone else, and someone else always wins. So does one who steers the vehicle
without a change of mode (`setpoint_monitor`).
"""

from __future__ import annotations

from companion.guidance.limits.setpoint_monitor import SetpointMonitor
from companion.vehicle.px4_modes import among_modes
from companion.vehicle.report import Report, words_of
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, LandedState, VehicleState
from companion.vehicle.streamer import SILENCE_S, StreamState

# A heartbeat's period and some: so long may the vehicle show an old mode after it acknowledged a new one.
SHOW_DELAY_S = 2.0
# PX4 ends a take-off inside NAV_MC_ALT_RAD (0.8 m); heights measured in two ways differ by some more. A hold
# that appears lower than this below the wanted height was asked for by a pilot.
TAKEOFF_SHORT_M = 1.3
# What the autopilot says of a failsafe comes so shortly before or after its change of mode.
SAID_S = 1.0
_FAILSAFES = "commander_failsafe_enter"
_LASTING_FAILSAFES = ("commander_failsafe_enter", "commander_failsafe_enter_generic")
GOING_DOWN = (FlightMode.LAND, FlightMode.RETURN, FlightMode.PRECISION_LAND)


class Authority:
    """Follows the modes and the motion of one vehicle while we are in command of it.

    Attributes:
        monitor: compares its motion with our setpoints.
    """

    def __init__(self) -> None:
        self.monitor = SetpointMonitor()
        self._mode: FlightMode | None = None
        self._leaving: set[FlightMode] = set()
        self._leaving_until_ns: float = 0
        self._dropped: dict[FlightMode, float] = {}
        self._takeoff_altitude_m = 0.0
        self._was_armed = False
        self._failsafe_before = False

    @property
    def mode(self) -> FlightMode | None:
        """The mode we last asked for; None while we are not in command."""
        return self._mode

    def take(self, state: VehicleState) -> None:
        """We take command of a vehicle as it is now."""
        self._mode = state.mode
        self._leaving = set()
        self._leaving_until_ns = 0
        self._dropped = {}
        self._takeoff_altitude_m = state.altitude_m or 0.0
        self._was_armed = state.armed
        self._failsafe_before = state.failsafe

    def release(self) -> None:
        """We are not in command any more; nothing is compared."""
        self._mode = None

    def request(self, mode: FlightMode, state: VehicleState, altitude_m: float | None = None) -> None:
        """We ask for a mode: until `settled`, what it was before may still be shown."""
        self._leaving |= {state.mode}
        if self._mode is not None:
            self._leaving |= {self._mode}
        if mode is FlightMode.TAKEOFF:
            self._leaving |= {FlightMode.HOLD}
            self._takeoff_altitude_m = altitude_m if altitude_m is not None else 0.0
            # From the ground, disarmed after a landing of ours, it begins anew.
            self._was_armed = state.armed
        self._mode = mode
        self._leaving_until_ns = float("inf")

    def settled(self, now_ns: int) -> None:
        """The request is done; the old mode may still show for a heartbeat, if the new one never showed."""
        self._leaving_until_ns = now_ns + SHOW_DELAY_S * 1e9

    def dropped(self, now_ns: int) -> None:
        """We do not wait for the request any more; it may still take effect, and show after the next one."""
        if self._mode is not None:
            self._dropped[self._mode] = now_ns + SHOW_DELAY_S * 1e9
        self.settled(now_ns)

    def refused(self, mode: FlightMode) -> None:
        """The request came to nothing: the mode from before is ours again."""
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
    ) -> str | None:
        """Why we are not in command any more; None while we are. Call it once for every step.

        Args:
            sent: the setpoint that the vehicle is to fly now; None: none. landing: it leads to the ground.
        """
        shown = sent if state.mode is self._mode else None
        ignored = self.monitor.update(shown, state, landing=landing)
        if self._mode is None:
            return None
        if not state.connected(now_ns):
            silent_s = (now_ns - state.heartbeat_ns) / 1e9
            return f"the link to the autopilot is lost: no heartbeat for {silent_s:.1f} s"
        explained = self._explained(state, now_ns)
        self._failsafe_before &= state.failsafe
        if state.failsafe and not self._failsafe_before and (flying_by_setpoint or not explained):
            return f"autopilot failsafe: {_shown(state.mode)}"
        if not explained:
            # A pilot's change moves the intended mode along, a failsafe leaves it as we asked for it.
            by_itself = state.intended_beside is state.mode and state.intended_mode is self._mode
            who = "autopilot failsafe" if by_itself else "the pilot took over"
            return f"{who}: {_shown(state.mode)}"
        self._was_armed |= state.armed
        if self._was_armed and not state.armed and self._mode not in GOING_DOWN:
            return "the vehicle was disarmed"
        return ignored

    def reason_is_logged(self, state: VehicleState, now_ns: int) -> bool:
        """Whether what `lost` said is all that the autopilot will say of it.

        A HEARTBEAT may show a new mode a moment before CURRENT_MODE tells whose it was, and either before
        the autopilot says in words what it does.
        """
        if state.mode is self._mode:
            return True  # not for a mode
        silent = not state.reports or bool(self.reasons_for(state, now_ns))
        if state.reports and self._holds_by_itself(state):
            # What is wrong is said first; whether the hold is to last, only in the event of the failsafe.
            silent = any(one.name.startswith(_FAILSAFES) for one in _warnings(state, now_ns))
        whose = state.intended_beside in (FlightMode.UNKNOWN, state.mode) or state.failsafe
        return whose and (silent or state.intended_mode is state.mode)

    def reasons_for(self, state: VehicleState, now_ns: int) -> str:
        """What the autopilot warned of when it took command, in its own words; empty if it did not."""
        warnings = _warnings(state, now_ns)
        return words_of(one for one in warnings if self._mode is None or among_modes(self._mode, one.modes))

    def chose_hold(self, state: VehicleState, now_ns: int) -> bool:
        """A failsafe took it out of OFFBOARD into a hold that is meant to last.

        Not one that waits for COM_FAIL_ACT_T before what PX4 does in earnest: its events have other names.
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
            # Shown while the request is still under way, an old mode may flicker; after it, no more.
            if self._leaving_until_ns != float("inf"):
                self._leaving = set()
            return True
        if state.mode in self._leaving and now_ns <= self._leaving_until_ns:
            return True
        if now_ns <= self._dropped.get(state.mode, 0):
            return True
        if self._mode in GOING_DOWN and (not state.armed or state.landed is LandedState.ON_GROUND):
            # Landed and disarmed, PX4 shows the mode that was chosen before the landing.
            return True
        if FlightMode.TAKEOFF in (self._mode, *self._leaving) and state.mode is FlightMode.HOLD:
            short_m = self._takeoff_altitude_m - (state.altitude_m or 0.0)
            return short_m <= TAKEOFF_SHORT_M
        return False


def silence(stream: StreamState, state: VehicleState, paused_s: float) -> str | None:
    """Why our setpoints failed to go out, if they did. `paused_s`: since the step of guidance before.

    PX4 would take OFFBOARD up again by itself if setpoints came back; only an operator may.
    """
    if paused_s > SILENCE_S:
        return f"our own guidance stood still for {paused_s:.1f} s"
    if stream is StreamState.EXPIRED:
        return f"no setpoint left for too long: {state.without_setpoints}"
    return None


def _shown(mode: FlightMode) -> str:
    return f"{mode.value.replace('_', ' ')} mode"


def _warnings(state: VehicleState, now_ns: int) -> list[Report]:
    return state.warnings_since(now_ns - round(SAID_S * 1e9))
