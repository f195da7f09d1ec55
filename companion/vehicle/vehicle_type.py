"""Which vehicles are flown, by type (HEARTBEAT) and VTOL state (EXTENDED_SYS_STATE).

The modes, the take-off and the setpoints of this program are those of a multicopter. They mean something else
to another vehicle: mode 4 of ArduPilot is GUIDED in Copter, ACRO in Plane and HOLD in Rover; mode 17 is BRAKE
in Copter and QSTABILIZE, without throttle, in Plane. So a vehicle that is not listed here gets no command.

    type                                     PX4                               ArduPilot
    multicopters, helicopters                flown, unless in forward flight   flown, if it is Copter
    VTOLs                                    flown while vtol_state is MC      not flown
    every other type                         not flown                         not flown

ArduPilot's quadplanes are vehicles of Plane, whose modes have other numbers, in hover too. They report the
type that the parameter Q_MAV_TYPE says, by default a fixed wing, but also a quadrotor, and in hover the
vtol_state that Copter always has (MC; 4.7, measured). So the driver asks for a parameter that only Plane has,
and for one that only Copter has (`PLANE_PARAMETER`, `COPTER_PARAMETER`), until one is answered: ArduPilot
answers no request for a parameter that it does not have. With ArduPilot no type is known before that, nor
before EXTENDED_SYS_STATE.
"""

from __future__ import annotations

from enum import IntEnum
from functools import lru_cache

PX4, ARDUPILOT = 12, 3  # MAV_AUTOPILOT
# The one that the autopilot answers for shows which program it runs (Rover has FRAME_CLASS too, and a type
# of its own).
PLANE_PARAMETER, COPTER_PARAMETER = "Q_ENABLE", "FRAME_CLASS"
AUTOPILOT_NAMES = {PX4: "PX4", ARDUPILOT: "ArduPilot"}


class VtolState(IntEnum):
    """MAV_VTOL_STATE. Of a vehicle that is no VTOL it is UNDEFINED, of ArduPilot's Copter MC."""

    UNDEFINED = 0
    TRANSITION_TO_FW = 1
    TRANSITION_TO_MC = 2
    MC = 3
    FW = 4


# MAV_TYPE, MAVLink common: the numbers of each kind, with the words for people.
MULTICOPTERS = {
    2: "quadrotor",
    3: "coaxial helicopter",
    4: "helicopter",
    13: "hexarotor",
    14: "octorotor",
    15: "tricopter",
    29: "dodecarotor",
    35: "decarotor",
}
VTOLS = {
    19: "VTOL tailsitter with two rotors",
    20: "VTOL tailsitter with four rotors",
    21: "VTOL tiltrotor",
    22: "VTOL with separate rotors",
    23: "VTOL tailsitter",
    24: "VTOL tiltwing",
    25: "VTOL of a reserved type",
}
_OTHERS = {
    0: "vehicle of an unspecified type",
    1: "fixed wing",
    5: "antenna tracker",
    6: "ground station",
    7: "airship",
    8: "free balloon",
    9: "rocket",
    10: "rover",
    11: "boat",
    12: "submarine",
    16: "flapping wing",
    17: "kite",
    18: "onboard controller",
    28: "parafoil",
    43: "multirotor of an unspecified type",
    45: "spacecraft",
    46: "ground quadruped",
    47: "gyrodyne",
}
_VTOL_WORDS = {
    VtolState.UNDEFINED: "unknown",
    VtolState.TRANSITION_TO_FW: "in transition to forward flight",
    VtolState.TRANSITION_TO_MC: "in transition to hover",
    VtolState.FW: "in forward flight",
}
_FLOWN = "only multicopters and helicopters are flown, and PX4's VTOLs while they hover"
# Not an answer yet: EXTENDED_SYS_STATE comes after the first heartbeat.
VTOL_STATE_MISSING = "it is not known yet whether the vehicle hovers: EXTENDED_SYS_STATE not received"
PROGRAM_MISSING = (
    f"it is not known yet whether this ArduPilot is Copter: neither {COPTER_PARAMETER} nor {PLANE_PARAMETER} "
    "received; both are requested until one is answered"
)
NOT_KNOWN_YET = (VTOL_STATE_MISSING, PROGRAM_MISSING)


def type_text(mav_type: int) -> str:
    """Return a vehicle's type for people: 'a fixed wing (MAV_TYPE 1)'."""
    words = (MULTICOPTERS | VTOLS | _OTHERS).get(mav_type, "component that is no vehicle")
    return f"{'an' if words[0] in 'aeiou' else 'a'} {words} (MAV_TYPE {mav_type})"


def autopilot_text(autopilot: int) -> str:
    """Return a MAV_AUTOPILOT for people."""
    return AUTOPILOT_NAMES.get(autopilot, f"MAV_AUTOPILOT {autopilot}")


@lru_cache(maxsize=64)  # asked in every step
def why_not_flown(
    mav_type: int, autopilot: int, vtol_state: VtolState | None, *, is_plane: bool | None = None
) -> str | None:
    """Return why a vehicle gets no flight command, in words; None: it is flown.

    Args:
        mav_type, autopilot: MAV_TYPE and MAV_AUTOPILOT of its newest heartbeat.
        vtol_state: of its newest EXTENDED_SYS_STATE; None: none received.
        is_plane: of an ArduPilot, whether it has `PLANE_PARAMETER` or `COPTER_PARAMETER`; None: not known.
    """
    what = f"the vehicle is {type_text(mav_type)} of {autopilot_text(autopilot)}"
    if autopilot not in AUTOPILOT_NAMES or mav_type not in MULTICOPTERS | VTOLS:
        return f"{what}: {_FLOWN}"
    if autopilot == ARDUPILOT:
        if mav_type in VTOLS:
            return f"{what}: {_FLOWN}"
        if is_plane:
            return f"{what} and has the parameter {PLANE_PARAMETER}, so it is a quadplane: {_FLOWN}"
        if vtol_state is None:
            return VTOL_STATE_MISSING
        if vtol_state not in (VtolState.UNDEFINED, VtolState.MC):
            return f"{what} {_VTOL_WORDS[vtol_state]}, so it is a quadplane: {_FLOWN}"
        return PROGRAM_MISSING if is_plane is None else None
    if vtol_state is VtolState.MC or (mav_type in MULTICOPTERS and not vtol_state):
        return None
    if vtol_state is None:
        return VTOL_STATE_MISSING
    return f"{what}, its VTOL state is {_VTOL_WORDS[vtol_state]}: {_FLOWN}"
