"""Selection of the stick source, and the pilot's requests: PX4's manual_control module.

Sources are a remote control and the joysticks of ground stations (MANUAL_CONTROL, one source per link);
COM_RC_IN_MODE selects among them, COM_RC_LOSS_T is how long one stays valid. Gestures (MAN_ARM_GESTURE,
MAN_KILL_GEST_T), switches, and sticks moved faster than COM_RC_STICK_OV (v1.18: MAN_OVERRIDE_SPD) become
requests and `moved`.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass
from enum import Enum, IntEnum

from mavlink_sim.flight.transmitter import CENTRED, MODE_OF_SETTING, Sticks, Switches
from mavlink_sim.px4.modes import Mode
from mavlink_sim.px4.parameters import OVERRIDE_SPEED, Parameters

MOVEMENT_FILTER_S = 0.1
OVERRIDE_FILTER_S, OVERRIDE_SAMPLES = 0.05, 3  # of MAN_OVERRIDE_SPD: that many samples in one direction
GESTURE_S = 1.0  # duration of the sticks in the corner
_LOW = -0.8
_CORNER = 0.9
_NEAR_CENTRE = 0.1


class Source(IntEnum):
    """The source of sticks, by PX4's numbers; a joystick on the vehicle's n-th link is MAVLINK + n."""

    UNKNOWN = 0
    REMOTE_CONTROL = 1
    MAVLINK = 2


class RequestKind(Enum):
    """The kind of a pilot's request by sticks or switches."""

    ARM = "arm"
    DISARM = "disarm"
    KILL = "kill"
    UNKILL = "unkill"
    SWITCH_MODE = "switch mode"


@dataclass(frozen=True, slots=True)
class Request:
    """One request; `by` is PX4's name of its source."""

    kind: RequestKind
    by: str
    mode: Mode | None = None


GESTURE = "stick gesture"
SWITCH = "RC switch"


class ManualControl:
    """The selector. `offer` takes samples, `update` advances time.

    Attributes:
        valid: a source is selected.
        sticks: of the selected source; all zero without one.
        source: the number of the selected source.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self.valid = False
        self.sticks = CENTRED
        self.source = int(Source.UNKNOWN)
        self._sampled_s = -math.inf
        self._first_source = int(Source.UNKNOWN)
        self._rates = [0.0] * 4  # filtered, of roll, pitch, yaw, throttle in 1/s
        self._runs = [0] * 4  # of each: how many changes in one direction, negative ones as negative numbers
        self._moved = False
        self._gesture_since: dict[RequestKind, float | None] = {}
        self._switches: Switches | None = None
        self._requests: list[Request] = []

    def offer(self, sticks: Sticks, source: int, now_s: float) -> bool:
        """Take a sample. Returns whether its source is selected."""
        self._expire(now_s)
        if not self._matches(source) or self._parameters.number("COM_RC_LOSS_T") <= 0.0:
            return False
        if self._first_source == Source.UNKNOWN:
            self._first_source = source
        if self.valid:
            self._watch_movement(sticks, now_s - self._sampled_s)
        self.valid, self.sticks, self.source, self._sampled_s = True, sticks, source, now_s
        self._watch_gestures(sticks, now_s)
        return True

    def offer_switches(self, switches: Switches, armed: bool) -> None:
        """Take switch positions of the remote control; they are used while its sticks are."""
        if not self.valid or self.source != Source.REMOTE_CONTROL:
            self._switches = None
            return
        before = self._switches
        self._switches = switches
        if before is None:
            if not armed:
                self._mode_slot(switches)
            return
        if switches.mode_slot != before.mode_slot:
            self._mode_slot(switches)
        if switches.arm != before.arm and switches.arm is not None:
            self._request(RequestKind.ARM if switches.arm else RequestKind.DISARM, SWITCH)
        for now, then, mode in (
            (switches.back, before.back, Mode.RTL),
            (switches.hold, before.hold, Mode.HOLD),
            (switches.offboard, before.offboard, Mode.OFFBOARD),
        ):
            if now is not None and now != then:
                if now:
                    self._request(RequestKind.SWITCH_MODE, SWITCH, mode)
                elif then is not None:
                    self._mode_slot(switches)
        if switches.kill != before.kill and switches.kill is not None:
            self._request(RequestKind.KILL if switches.kill else RequestKind.UNKILL, SWITCH)

    def update(self, now_s: float) -> list[Request]:
        """Drop expired samples. Returns the pilot's requests since the last call, in order."""
        self._expire(now_s)
        requests, self._requests = self._requests, []
        return requests

    def take_moved(self) -> bool:
        """Whether the sticks moved faster than the threshold of an override since the last call."""
        moved, self._moved = self._moved, False
        return moved

    @property
    def kill_switch_on(self) -> bool:
        return self._switches is not None and self._switches.kill is True

    @property
    def return_switch_on(self) -> bool:
        return self._switches is not None and self._switches.back is True

    # ---- selection --------------------------------------------------------------------------------------

    def _expire(self, now_s: float) -> None:
        if not self.valid:
            return
        timeout = self._parameters.number("COM_RC_LOSS_T")
        if now_s - self._sampled_s >= timeout or not self._matches(self.source):
            self.valid = False
            self.sticks = CENTRED
            self.source = int(Source.UNKNOWN)
            self._rates, self._runs = [0.0] * 4, [0] * 4
            self._moved = False
            self._gesture_since.clear()
            self._switches = None

    def _matches(self, source: int) -> bool:
        """COM_RC_IN_MODE."""
        mode = int(self._parameters.number("COM_RC_IN_MODE"))
        remote = source == Source.REMOTE_CONTROL
        current = self.source
        free = not self.valid
        if mode == 0:
            return remote
        if mode == 1:
            return not remote and (free or source == current)
        if mode == 2:
            return free or source == current
        if mode == 3:
            return self._first_source in (Source.UNKNOWN, source)
        current_is_remote = current == Source.REMOTE_CONTROL
        if mode == 5:
            return free or source <= current
        if mode == 6:
            return free or (current_is_remote if remote else current_is_remote or source <= current)
        if mode == 7:
            return free or remote or (not current_is_remote and source >= current)
        if mode == 8:
            return free or source >= current
        return False  # 4, and unknown values: manual control is disabled

    # ---- gestures and switches --------------------------------------------------------------------------

    def _watch_movement(self, sticks: Sticks, dt_s: float) -> None:
        if dt_s <= 0.0:
            return
        by_speed = OVERRIDE_SPEED in self._parameters
        blend = dt_s / (dt_s + (OVERRIDE_FILTER_S if by_speed else MOVEMENT_FILTER_S))
        rates = [
            (after - before) / dt_s
            for after, before in zip(astuple(sticks), astuple(self.sticks), strict=True)
        ]
        self._rates = [old + blend * (new - old) for old, new in zip(self._rates, rates, strict=True)]
        if by_speed:
            limit, samples = self._parameters.number(OVERRIDE_SPEED), OVERRIDE_SAMPLES
        else:
            limit, samples = 0.01 * self._parameters.number("COM_RC_STICK_OV"), 0
        self._runs = [_run(run, rate) for run, rate in zip(self._runs, rates, strict=True)]
        self._moved = self._moved or (
            limit >= 0.0
            and any(
                abs(rate) > limit and abs(run) >= samples
                for rate, run in zip(self._rates, self._runs, strict=True)
            )
        )

    def _watch_gestures(self, sticks: Sticks, now_s: float) -> None:
        centred = abs(sticks.roll) < _NEAR_CENTRE and abs(sticks.pitch) < _NEAR_CENTRE
        low = sticks.throttle < _LOW
        by_gesture = self._parameters.number("MAN_ARM_GESTURE") != 0
        self._gesture(RequestKind.ARM, low and sticks.yaw > _CORNER and centred, GESTURE_S, now_s, by_gesture)
        lower_left = low and sticks.yaw < -_CORNER
        self._gesture(RequestKind.DISARM, lower_left and centred, GESTURE_S, now_s, by_gesture)
        kill_s = self._parameters.number("MAN_KILL_GEST_T")
        lower_right = sticks.pitch < -_CORNER and sticks.roll > _CORNER
        self._gesture(RequestKind.KILL, lower_left and lower_right, kill_s, now_s, kill_s > 0.0)

    def _gesture(self, kind: RequestKind, held: bool, hold_s: float, now_s: float, enabled: bool) -> None:
        """Track a gesture; `_gesture_since`: when it began, infinity once the request is made."""
        since = self._gesture_since.get(kind)
        if not held:
            self._gesture_since[kind] = None
        elif since is None:
            self._gesture_since[kind] = now_s
        elif now_s - since >= hold_s:
            self._gesture_since[kind] = math.inf
            if enabled:
                self._request(kind, GESTURE)

    def _mode_slot(self, switches: Switches) -> None:
        if switches.mode_slot is None:
            return
        setting = int(self._parameters.number(f"COM_FLTMODE{switches.mode_slot}"))
        mode = MODE_OF_SETTING.get(setting)
        if mode is not None:
            self._request(RequestKind.SWITCH_MODE, SWITCH, mode)

    def _request(self, kind: RequestKind, by: str, mode: Mode | None = None) -> None:
        self._requests.append(Request(kind, by, mode))


def _run(run: int, rate: float) -> int:
    """Return how many changes have had one direction, with the newest; no change does not count."""
    if rate == 0.0:
        return run
    direction = 1 if rate > 0.0 else -1
    return run + direction if run * direction > 0 else direction
