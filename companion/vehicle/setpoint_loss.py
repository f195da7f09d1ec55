"""What the autopilot does when our setpoints stop, from its firmware version and parameters.

PX4's rules are those of `Failsafe::checkModeFallback` in v1.14.4, v1.15.4, v1.16.2, v1.17.0, v1.18.0-beta1.
COM_RCL_EXCEPT, COM_FAIL_ACT_T and NAV_DLL_ACT change nothing here: the loss of setpoints has no delay, and a
mode of sticks that replaces OFFBOARD is not checked for lost sticks again. COM_RC_IN_MODE decides, with the
receiver, whether there are sticks, which PX4 reports. A position estimate and a home
position are assumed to be valid; without them PX4 replaces a return by a landing or a descent.
ArduPilot's are those of Copter's GUIDED mode (4.1 and newer).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

from companion.vehicle.autopilot_parameters import (
    RELEASE_CANDIDATE,
    AutopilotParameters,
    FirmwareVersion,
    ground_station_name,
)
from companion.vehicle.state import FlightMode, VehicleState

# A longer flight without setpoints is a warning.
LONG_S = 2.0
# PX4 checks its setpoints ten times a second; measured 1.05 to 1.15 s for COM_OF_LOSS_T 1.
PX4_CHECK_S = 0.1
# ArduPilot's shortest GUID_TIMEOUT.
SHORTEST_GUIDED_S = 0.1


class SetpointLossEffect(StrEnum):
    """What happens to a flying vehicle without setpoints."""

    RETURN = "return"
    LAND = "land"
    HOLD = "hold"
    PILOT = "pilot"  # it is flown by a pilot's sticks
    SINK = "sink"  # a mode of sticks without sticks: it descends to the ground where it is
    DRIFT = "drift"  # stabilized mode without sticks: the last tilt and thrust, without control
    FALL = "fall"  # the motors stop
    FLY_ON = "fly_on"  # the last setpoint is flown without an end
    UNKNOWN = "unknown"


_DANGEROUS = frozenset(
    {
        SetpointLossEffect.SINK,
        SetpointLossEffect.DRIFT,
        SetpointLossEffect.FALL,
        SetpointLossEffect.FLY_ON,
        SetpointLossEffect.UNKNOWN,
    }
)


@dataclass(frozen=True, slots=True)
class SetpointLossOutcome:
    """The result of `setpoint_loss_outcome`.

    Attributes:
        effect: what happens. mode: the mode then; UNKNOWN where none is entered or it is not known.
        after_s: from the last setpoint to it; None: not known, or never.
        text: one sentence. warning: it endangers the vehicle, takes longer than `LONG_S`, or is not known.
    """

    effect: SetpointLossEffect
    mode: FlightMode
    after_s: float | None
    text: str

    @property
    def warning(self) -> bool:
        late = self.after_s is None or self.after_s > LONG_S
        return late or self.effect in _DANGEROUS


# COM_OBL_RC_ACT, apart from the modes flown by sticks
_PX4_ACTIONS = {
    3: (SetpointLossEffect.RETURN, FlightMode.RETURN),
    4: (SetpointLossEffect.LAND, FlightMode.LAND),
    5: (SetpointLossEffect.HOLD, FlightMode.HOLD),
    6: (SetpointLossEffect.FALL, FlightMode.UNKNOWN),
    7: (SetpointLossEffect.FALL, FlightMode.UNKNOWN),
}
_STICK_MODES = {1: FlightMode.ALTITUDE, 2: FlightMode.STABILIZED}  # of COM_OBL_RC_ACT; any other: POSITION
# NAV_RCL_ACT; any other is no action: the vehicle stays in OFFBOARD
_STICKS_LOST_ACTIONS = {
    1: (SetpointLossEffect.HOLD, FlightMode.HOLD),
    2: (SetpointLossEffect.RETURN, FlightMode.RETURN),
    3: (SetpointLossEffect.LAND, FlightMode.LAND),
    5: (SetpointLossEffect.FALL, FlightMode.UNKNOWN),
    6: (SetpointLossEffect.FALL, FlightMode.UNKNOWN),
}
_GROUND_STATION_ACTIONS = {1: "RTL", 2: "RTL", 3: "SmartRTL", 4: "SmartRTL", 5: "LAND", 6: "RTL", 7: "BRAKE"}
_OLDEST_PX4, _NEWEST_PX4 = (1, 14), (1, 18)
_OLDEST_ARDUPILOT = (4, 1)


def setpoint_loss_outcome(read: AutopilotParameters, *, sticks_present: bool) -> SetpointLossOutcome:
    """Return what the autopilot does in flight when our setpoints stop.

    Args:
        read: firmware version and parameters. sticks_present: as in `VehicleState`.
    """
    if read.autopilot == "PX4":
        return _px4(read, sticks_present)
    if read.autopilot == "ArduPilot":
        return _ardupilot(read)
    return _unknown("the autopilot's version and parameters are not read yet")


def without_service_text(state: VehicleState, read: AutopilotParameters, *, has_vehicle: bool) -> str:
    """Return what the vehicle does if the service ends now, as one sentence without a full stop.

    Args:
        read: firmware version and parameters. has_vehicle: an autopilot is expected (`vehicle.url` is not
            `none`).
    """
    if not has_vehicle:
        return "there is no vehicle"
    if state.autopilot is None:
        return "no autopilot was received"
    if not state.armed:
        return "the vehicle was disarmed"
    if state.mode is FlightMode.OFFBOARD:
        return setpoint_loss_outcome(read, sticks_present=state.sticks_present).text
    mode = "an unknown" if state.mode is FlightMode.UNKNOWN else state.mode.value.replace("_", " ")
    return f"the vehicle was in {mode} mode, which its autopilot flies without the service"


def _px4(read: AutopilotParameters, sticks_present: bool) -> SetpointLossOutcome:
    loss_s, act = read.get("COM_OF_LOSS_T"), read.get("COM_OBL_RC_ACT")
    if loss_s is None or act is None:
        name = "COM_OF_LOSS_T" if loss_s is None else "COM_OBL_RC_ACT"
        return _unknown(f"{name} could not be read", read)
    after_s = loss_s + PX4_CHECK_S
    act = int(act)
    because = f"COM_OBL_RC_ACT {act}"
    if read.version is not None and not _OLDEST_PX4 <= _release(read.version) <= _NEWEST_PX4:
        return _unknown("this version was not examined (1.14 to 1.18 were)", read)
    if act in _PX4_ACTIONS:
        return _outcome(read, *_PX4_ACTIONS[act], after_s, because)
    mode = _STICK_MODES.get(act, FlightMode.POSITION)
    if sticks_present:
        return _outcome(read, SetpointLossEffect.PILOT, mode, after_s, because)
    because += ", no sticks"
    if (replaced := _replaces_stick_modes(read.version)) is None:
        return _unknown(
            f"{because}: releases before 1.17 sink to the ground, later ones perform NAV_RCL_ACT", read
        )
    if not replaced:
        effect = SetpointLossEffect.DRIFT if mode is FlightMode.STABILIZED else SetpointLossEffect.SINK
        return _outcome(read, effect, mode, after_s, because)
    lost = read.get("NAV_RCL_ACT")
    if lost is None:
        return _unknown("NAV_RCL_ACT could not be read", read)
    stays = (SetpointLossEffect.FLY_ON, FlightMode.OFFBOARD)
    effect, mode = _STICKS_LOST_ACTIONS.get(int(lost), stays)
    return _outcome(read, effect, mode, after_s, f"{because}: NAV_RCL_ACT {lost:g}")


def _replaces_stick_modes(version: FirmwareVersion | None) -> bool | None:
    """Whether PX4 performs NAV_RCL_ACT instead of entering a mode of sticks without sticks.

    It does since v1.17.0-rc1. Alphas and betas of 1.17 exist with and without it: None.
    """
    if version is None or ((version.major, version.minor) == (1, 17) and version.kind < RELEASE_CANDIDATE):
        return None
    return _release(version) >= (1, 17)


def _ardupilot(read: AutopilotParameters) -> SetpointLossOutcome:
    if read.version is None or _release(read.version) < _OLDEST_ARDUPILOT:
        return _unknown("this version was not examined (4.1 and newer were)", read)
    guided_s = read.get("GUID_TIMEOUT")
    if guided_s is None:
        return _unknown("GUID_TIMEOUT could not be read", read)
    after_s = max(guided_s, SHORTEST_GUIDED_S)
    text = (
        f"without setpoints {read.firmware} flies the last velocity on, as GUID_TIMEOUT is {guided_s:g} s, "
        f"then stops and stays in GUIDED; if the service ends too: {_without_heartbeats(read)}"
    )
    if after_s > LONG_S:
        text += "; set GUID_TIMEOUT to 1"
    return SetpointLossOutcome(SetpointLossEffect.HOLD, FlightMode.OFFBOARD, after_s, text)


def _without_heartbeats(read: AutopilotParameters) -> str:
    """What ArduPilot does without our heartbeats, as text."""
    enabled, name = read.get("FS_GCS_ENABLE"), ground_station_name(read.version)
    if enabled is None:
        return "not known, FS_GCS_ENABLE could not be read"
    if int(enabled) == 0:
        return "the same (FS_GCS_ENABLE 0)"
    station = read.get(name)
    if station is None:
        return f"not known, {name} could not be read"
    if int(station) != read.system_id:
        return f"the same (its ground station is {name} {station:g}, not this system {read.system_id})"
    timeout_s = read.get("FS_GCS_TIMEOUT")
    action = _GROUND_STATION_ACTIONS.get(int(enabled), "an unknown action")
    return f"{action} {'some' if timeout_s is None else f'{timeout_s:g}'} s later (FS_GCS_ENABLE {enabled:g})"


def _release(version: FirmwareVersion) -> tuple[int, int]:
    return (version.major, version.minor)


_WORDS = {
    SetpointLossEffect.RETURN: "returns home",
    SetpointLossEffect.LAND: "lands where it is",
    SetpointLossEffect.HOLD: "holds its position",
    SetpointLossEffect.PILOT: "changes to {mode} mode, flown by the sticks",
    SetpointLossEffect.SINK: "changes to {mode} mode and sinks to the ground where it is",
    SetpointLossEffect.DRIFT: "changes to {mode} mode and drifts with its last tilt and thrust",
    SetpointLossEffect.FALL: "stops its motors and falls",
    SetpointLossEffect.FLY_ON: "stays in OFFBOARD and flies the last setpoint on",
}


def _outcome(
    read: AutopilotParameters, effect: SetpointLossEffect, mode: FlightMode, after_s: float, because: str
) -> SetpointLossOutcome:
    words = _WORDS[effect].format(mode=mode.value)
    if effect is SetpointLossEffect.FLY_ON:
        return SetpointLossOutcome(
            effect, mode, None, f"without setpoints {read.firmware} {words} ({because})"
        )
    text = f"without setpoints {read.firmware} {words} after {after_s:.1f} s ({because})"
    return SetpointLossOutcome(effect, mode, after_s, text)


def _unknown(why: str, read: AutopilotParameters | None = None) -> SetpointLossOutcome:
    who = "the autopilot" if read is None else read.firmware
    text = f"what {who} does without setpoints is not known: {why}"
    return SetpointLossOutcome(SetpointLossEffect.UNKNOWN, FlightMode.UNKNOWN, None, text)
