"""A remote control: the pilot's transmitter, and how the autopilot reads its channels.

The channels are pulse widths in microseconds, 1000 to 2000, centred at 1500. RC_MAP_* assign the channels,
RC_*_TH are the thresholds of the switches, COM_FLTMODE1..6 the modes of the six positions of the mode switch.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from mavlink_sim.px4.modes import Mode
from mavlink_sim.px4.parameters import Parameters

LOWEST_US, CENTRE_US, HIGHEST_US = 1000, 1500, 2000
DEAD_ZONE_US = 10  # RCn_DZ
CHANNELS = 18  # of RC_CHANNELS and RC_CHANNELS_OVERRIDE
MODE_SLOTS = 6
TRANSMITTER_CHANNELS = 8

# COM_FLTMODE1..6
MODE_OF_SETTING: dict[int, Mode] = {
    0: Mode.MANUAL,
    1: Mode.ALTCTL,
    2: Mode.POSCTL,
    3: Mode.MISSION,
    4: Mode.HOLD,
    5: Mode.RTL,
    6: Mode.ACRO,
    7: Mode.OFFBOARD,
    8: Mode.STABILIZED,
    9: Mode.POSITION_SLOW,
    10: Mode.TAKEOFF,
    11: Mode.LAND,
    12: Mode.FOLLOW,
    13: Mode.PRECLAND,
}


@dataclass(frozen=True, slots=True)
class Sticks:
    """Stick positions, each -1..1: roll right, pitch (forward), yaw (clockwise), throttle (up) positive."""

    roll: float = 0.0
    pitch: float = 0.0
    yaw: float = 0.0
    throttle: float = 0.0


CENTRED = Sticks()


@dataclass(frozen=True, slots=True)
class Switches:
    """Switch positions; None: not mapped. `mode_slot` is 1..6, the others are on or off."""

    mode_slot: int | None = None
    arm: bool | None = None
    kill: bool | None = None
    back: bool | None = None  # the return switch
    hold: bool | None = None  # the loiter switch
    offboard: bool | None = None


class Transmitter:
    """The pilot's transmitter: set its attributes as a pilot would.

    Attributes:
        on: it transmits; switched off, the autopilot loses it after COM_RC_LOSS_T.
        sticks: their positions. mode_slot: the position of the mode switch, 1..6.
        kill, back, hold, offboard, arm: switches.
    """

    def __init__(self, parameters: Parameters) -> None:
        self._parameters = parameters
        self.on = False
        self.sticks = CENTRED
        self.mode_slot = 1
        self.arm = self.kill = self.back = self.hold = self.offboard = False

    def select(self, mode: Mode) -> None:
        """Set the mode switch to the position of this mode. Raises ValueError if it has none."""
        for slot in range(1, MODE_SLOTS + 1):
            setting = int(self._parameters.number(f"COM_FLTMODE{slot}"))
            if MODE_OF_SETTING.get(setting) is mode:
                self.mode_slot = slot
                return
        raise ValueError(
            f"no position of the mode switch selects {mode.name}; set one of COM_FLTMODE1..6 to it"
        )

    def channels(self) -> list[int]:
        """The pulse widths it sends, in microseconds, by RC_MAP_*."""
        widths = [LOWEST_US] * TRANSMITTER_CHANNELS
        sticks = self.sticks
        positions = {
            "RC_MAP_ROLL": sticks.roll,
            "RC_MAP_PITCH": sticks.pitch,
            "RC_MAP_YAW": sticks.yaw,
            "RC_MAP_THROTTLE": sticks.throttle,
            "RC_MAP_FLTMODE": 2.0 * (self.mode_slot - 0.5) / MODE_SLOTS - 1.0,
            "RC_MAP_ARM_SW": 1.0 if self.arm else -1.0,
            "RC_MAP_KILL_SW": 1.0 if self.kill else -1.0,
            "RC_MAP_RETURN_SW": 1.0 if self.back else -1.0,
            "RC_MAP_LOITER_SW": 1.0 if self.hold else -1.0,
            "RC_MAP_OFFB_SW": 1.0 if self.offboard else -1.0,
        }
        for name, position in positions.items():
            channel = int(self._parameters.number(name))
            if 1 <= channel <= CHANNELS:
                widths.extend([LOWEST_US] * (channel - len(widths)))
                widths[channel - 1] = round(CENTRE_US + 500.0 * min(max(position, -1.0), 1.0))
        return widths


def read_sticks(widths_us: Sequence[int], parameters: Parameters) -> Sticks | None:
    """The sticks in a frame of channels; None unless all four are mapped and present."""
    values = []
    for name in ("RC_MAP_ROLL", "RC_MAP_PITCH", "RC_MAP_YAW", "RC_MAP_THROTTLE"):
        position = _position(widths_us, int(parameters.number(name)))
        if position is None:
            return None
        values.append(position)
    return Sticks(*values)


def read_switches(widths_us: Sequence[int], parameters: Parameters) -> Switches:
    """The switches in a frame of channels."""

    def switch(name: str, threshold: str) -> bool | None:
        position = _position(widths_us, int(parameters.number(name)))
        if position is None:
            return None
        level = parameters.number(threshold)
        fraction = 0.5 * position + 0.5
        return fraction > level if level >= 0.0 else fraction < -level  # a negative one inverts the switch

    mode = _position(widths_us, int(parameters.number("RC_MAP_FLTMODE")))
    return Switches(
        mode_slot=None if mode is None else min(int((mode + 1.0) / 2.0 * MODE_SLOTS) + 1, MODE_SLOTS),
        arm=switch("RC_MAP_ARM_SW", "RC_ARMSWITCH_TH"),
        kill=switch("RC_MAP_KILL_SW", "RC_KILLSWITCH_TH"),
        back=switch("RC_MAP_RETURN_SW", "RC_RETURN_TH"),
        hold=switch("RC_MAP_LOITER_SW", "RC_LOITER_TH"),
        offboard=switch("RC_MAP_OFFB_SW", "RC_OFFB_TH"),
    )


def _position(widths_us: Sequence[int], channel: int) -> float | None:
    """-1..1 of a channel (from 1); None if it is not mapped, or not in the frame."""
    if not 1 <= channel <= len(widths_us) or widths_us[channel - 1] == 0:
        return None
    off_centre = min(max(widths_us[channel - 1], LOWEST_US), HIGHEST_US) - CENTRE_US
    if abs(off_centre) <= DEAD_ZONE_US:
        return 0.0
    beyond = abs(off_centre) - DEAD_ZONE_US
    return (1.0 if off_centre > 0 else -1.0) * beyond / (500 - DEAD_ZONE_US)
