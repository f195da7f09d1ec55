"""Applies a gimbal's messages to the vehicle state. Pure functions, as in `telemetry`.

With several gimbals, the first one received is used.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from companion.vehicle.gimbal import LAST_ATTACHED_DEVICE, GimbalState, Quaternion, YawFrame
from companion.vehicle.state import VehicleState, with_fields
from vision.attitude import unit_quaternion

Fields = Mapping[str, Any]

ATTITUDE_STATUS = "GIMBAL_DEVICE_ATTITUDE_STATUS"
# GIMBAL_DEVICE_FLAGS
_NEUTRAL, _YAW_LOCK, _YAW_IN_VEHICLE_FRAME, _YAW_IN_EARTH_FRAME = 2, 16, 32, 64
_UNKNOWN_YAW = (
    "gimbal yaw reference ambiguous: its flags are neutral and yaw lock at once "
    "(PX4 sends this for gimbals on servo outputs, which measure nothing)"
)


def apply_information(state: VehicleState, fields: Fields, now_ns: int) -> VehicleState:
    """Apply GIMBAL_MANAGER_INFORMATION: the gimbal's end stops."""
    gimbal = _gimbal_of(state, fields)
    if gimbal is None:
        return state
    low, high = _number(fields["pitch_min"]), _number(fields["pitch_max"])
    return with_fields(
        state,
        gimbal=replace(
            gimbal,
            information_ns=now_ns,
            lowest_pitch_rad=low if math.isfinite(low) else -math.inf,
            highest_pitch_rad=high if math.isfinite(high) else math.inf,
        ),
    )


def apply_status(state: VehicleState, fields: Fields, now_ns: int) -> VehicleState:
    """Apply GIMBAL_MANAGER_STATUS: the owner of primary control."""
    gimbal = _gimbal_of(state, fields)
    if gimbal is None:
        return state
    primary = (int(fields["primary_control_sysid"]), int(fields["primary_control_compid"]))
    return with_fields(state, gimbal=replace(gimbal, status_ns=now_ns, primary_control=primary))


def apply_attitude(state: VehicleState, fields: Fields, now_ns: int) -> VehicleState:
    """Apply GIMBAL_DEVICE_ATTITUDE_STATUS."""
    gimbal = _gimbal_of(state, fields)
    if gimbal is None:
        return state
    frame = _yaw_frame(int(fields["flags"]))
    if frame is None:
        return with_fields(state, gimbal=replace(gimbal, attitude=None, attitude_problem=_UNKNOWN_YAW))
    attitude = _unit(fields["q"])
    if attitude is None:
        return state if gimbal is state.gimbal else with_fields(state, gimbal=gimbal)
    return with_fields(
        state,
        gimbal=replace(gimbal, attitude_ns=now_ns, attitude=attitude, yaw_frame=frame, attitude_problem=""),
    )


def from_gimbal_device(state: VehicleState, name: str, component_id: int) -> bool:
    """Whether a message of a component other than the autopilot is the used gimbal's attitude."""
    return (
        name == ATTITUDE_STATUS
        and state.gimbal is not None
        and component_id > LAST_ATTACHED_DEVICE
        and component_id == state.gimbal.device
    )


def _gimbal_of(state: VehicleState, fields: Fields) -> GimbalState | None:
    """Return the gimbal that a message is about; None for another than the used one."""
    device = int(fields.get("gimbal_device_id") or 0)
    gimbal = state.gimbal
    if gimbal is None:
        return GimbalState(device)
    if device in (0, gimbal.device):
        return gimbal
    if gimbal.device == 0:
        return replace(gimbal, device=device)
    return None


def _yaw_frame(flags: int) -> YawFrame | None:
    """Return the yaw reference of an attitude; None if the flags are ambiguous."""
    if flags & _YAW_IN_EARTH_FRAME:
        return None if flags & _YAW_IN_VEHICLE_FRAME else YawFrame.NORTH
    if flags & _YAW_IN_VEHICLE_FRAME:
        return YawFrame.NOSE
    # Older devices set neither flag: the yaw lock decides, which a neutral gimbal overrides.
    if flags & _YAW_LOCK:
        return None if flags & _NEUTRAL else YawFrame.NORTH
    return YawFrame.NOSE


def _unit(values: Any) -> Quaternion | None:
    """Normalize a quaternion; None if it is invalid."""
    if not isinstance(values, list | tuple) or len(values) != 4:
        return None
    w, x, y, z = (_number(value) for value in values)
    if not 0.5 < math.hypot(w, x, y, z) < 2.0:  # NaN also fails the comparison
        return None
    return unit_quaternion((w, x, y, z))


def _number(value: float | None) -> float:
    """Convert to float; None is NaN, which JSON lacks."""
    return math.nan if value is None else float(value)


GIMBAL_STEPS: dict[str, Callable[[VehicleState, Fields, int], VehicleState]] = {
    "GIMBAL_MANAGER_INFORMATION": apply_information,
    "GIMBAL_MANAGER_STATUS": apply_status,
    ATTITUDE_STATUS: apply_attitude,
}
