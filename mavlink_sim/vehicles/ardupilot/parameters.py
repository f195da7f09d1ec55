"""Copter's parameters: a subset, encoded as by ArduPilot.

ArduPilot sends every value as a number in the float field, whatever its type (the "C cast" encoding,
MAV_PROTOCOL_CAPABILITY_PARAM_ENCODE_C_CAST); PX4 puts an integer's bytes there.

The control loops are the PX4-like vehicle's and read its parameters; those are hidden from clients and follow
Copter's (`_LOOPS`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from functools import cache

from mavlink_sim.px4.parameters import REAL32, Parameter, Parameters, single

TAKEOFF_RAMP_S = 1.5  # from the first thrust to leaving the ground
INT8, INT16, INT32 = 2, 4, 6  # MAV_PARAM_TYPE
_RANGES = {INT8: (-(2**7), 2**7 - 1), INT16: (-(2**15), 2**15 - 1), INT32: (-(2**31), 2**31 - 1)}


@dataclass(frozen=True, slots=True)
class CopterParameter(Parameter):
    """One parameter of ArduPilot's."""

    @property
    def wire_value(self) -> float:
        """The value as PARAM_VALUE.param_value carries it: the number itself."""
        return float(self.value)


_GROUPS = "RAW_SENS EXT_STAT RC_CHAN RAW_CTRL POSITION EXTRA1 EXTRA2 EXTRA3 PARAMS"
# Copter 4.5's names, types and defaults. SR0 is the ground station's link, SR1 the companion's.
_DEFAULTS: tuple[tuple[str, int, float], ...] = (
    ("SYSID_THISMAV", INT16, 1),
    ("SYSID_MYGCS", INT16, 255),
    ("PILOT_THR_BHV", INT16, 0),
    ("RTL_ALT", INT32, 1500),
    ("RTL_CONE_SLOPE", REAL32, 3.0),
    ("RTL_SPEED", INT16, 0),
    ("RTL_ALT_FINAL", INT16, 0),
    ("RTL_CLIMB_MIN", INT16, 0),
    ("RTL_LOIT_TIME", INT32, 5000),
    ("RTL_ALT_TYPE", INT8, 0),
    ("FS_GCS_ENABLE", INT8, 0),
    ("FS_GCS_TIMEOUT", REAL32, 5.0),
    ("FS_EKF_ACTION", INT8, 1),
    ("FS_THR_ENABLE", INT8, 0),
    ("WP_YAW_BEHAVIOR", INT8, 2),
    ("LAND_SPEED", INT16, 50),
    ("LAND_SPEED_HIGH", INT16, 0),
    ("LAND_ALT_LOW", INT16, 1000),
    ("PILOT_SPEED_UP", INT16, 250),
    ("PILOT_SPEED_DN", INT16, 0),
    ("PILOT_ACCEL_Z", INT16, 250),
    ("PILOT_TKOFF_ALT", REAL32, 0.0),
    ("PILOT_Y_RATE", REAL32, 202.5),
    ("DISARM_DELAY", INT8, 10),
    ("ANGLE_MAX", INT16, 3000),
    ("FRAME_CLASS", INT8, 1),
    ("FRAME_TYPE", INT8, 1),
    ("ARMING_CHECK", INT32, 1),
    ("GUID_TIMEOUT", REAL32, 3.0),
    ("GUID_OPTIONS", INT32, 0),
    ("WPNAV_SPEED", REAL32, 1000.0),
    ("WPNAV_RADIUS", REAL32, 200.0),
    ("WPNAV_SPEED_UP", REAL32, 250.0),
    ("WPNAV_SPEED_DN", REAL32, 150.0),
    ("WPNAV_ACCEL", REAL32, 250.0),
    ("WPNAV_ACCEL_Z", REAL32, 100.0),
    ("LOIT_SPEED", REAL32, 1250.0),
    ("LOIT_ACC_MAX", REAL32, 500.0),
    ("ATC_SLEW_YAW", REAL32, 6000.0),
    ("FENCE_ENABLE", INT8, 0),
    ("FENCE_TYPE", INT8, 3),
    ("FENCE_ACTION", INT8, 1),
    ("FENCE_ALT_MAX", REAL32, 100.0),
    ("FENCE_RADIUS", REAL32, 300.0),
    ("FENCE_MARGIN", REAL32, 2.0),
    ("AVOID_ENABLE", INT8, 3),
    ("PLND_ENABLED", INT8, 0),
    ("PLND_TYPE", INT8, 0),
    ("PLND_XY_DIST_MAX", REAL32, 2.5),
    ("PLND_STRICT", INT8, 1),
    ("PLND_TIMEOUT", REAL32, 4.0),
    ("PLND_ALT_MAX", REAL32, 8.0),
    ("PLND_ALT_MIN", REAL32, 0.75),
    ("SIM_WIND_SPD", REAL32, 0.0),
    ("SIM_WIND_DIR", REAL32, 180.0),
    *((f"SR{link}_{group}", INT16, 0) for link in (0, 1) for group in _GROUPS.split()),
)


def _hundredth(*names: str) -> Callable[[Parameters], float]:
    """A hundredth of the largest of these parameters."""
    return lambda own: max(own.number(name) for name in names) / 100.0


def _wind(component: Callable[[float], float]) -> Callable[[Parameters], float]:
    # ArduPilot has the direction that the wind blows from
    return lambda own: -own.number("SIM_WIND_SPD") * component(math.radians(own.number("SIM_WIND_DIR")))


# What the shared control loops read, from Copter's parameters (cm, cm/s, centidegrees there).
_LOOPS: dict[str, Callable[[Parameters], float]] = {
    "MPC_XY_CRUISE": _hundredth("WPNAV_SPEED"),
    "MPC_XY_VEL_MAX": _hundredth("WPNAV_SPEED", "LOIT_SPEED"),
    "MPC_VEL_MANUAL": _hundredth("LOIT_SPEED"),
    "MPC_ACC_HOR": _hundredth("WPNAV_ACCEL"),
    "MPC_Z_V_AUTO_UP": _hundredth("WPNAV_SPEED_UP"),
    "MPC_Z_V_AUTO_DN": _hundredth("WPNAV_SPEED_DN"),
    "MPC_Z_VEL_MAX_UP": _hundredth("WPNAV_SPEED_UP", "PILOT_SPEED_UP"),
    "MPC_Z_VEL_MAX_DN": _hundredth("WPNAV_SPEED_DN", "PILOT_SPEED_DN", "LAND_SPEED_HIGH"),
    "MPC_ACC_DOWN_MAX": _hundredth("WPNAV_ACCEL_Z", "PILOT_ACCEL_Z"),
    "MPC_ACC_UP_MAX": _hundredth("WPNAV_ACCEL_Z", "PILOT_ACCEL_Z"),
    "MPC_LAND_SPEED": _hundredth("LAND_SPEED"),
    "MPC_XY_ERR_MAX": lambda own: 4.0,  # ArduPilot is faster, and its target has a longer lead
    "MPC_TKO_SPEED": _hundredth("WPNAV_SPEED_UP"),
    "MPC_TKO_RAMP_T": lambda own: TAKEOFF_RAMP_S,
    "MPC_TILTMAX_AIR": _hundredth("ANGLE_MAX"),
    "MPC_YAWRAUTO_MAX": _hundredth("ATC_SLEW_YAW"),
    "SIH_WIND_N": _wind(math.cos),
    "SIH_WIND_E": _wind(math.sin),
    "MAV_SYS_ID": lambda own: own.number("SYSID_THISMAV"),
    # ArduPilot requires signatures on every link except USB, as soon as there is a key
    "MAV_SIGN_CFG": lambda own: 1.0,
}
# Names of the shared vehicle and Copter's names for the same.
_ALIASES = {"MAV_SYS_ID": "SYSID_THISMAV"}


@cache
def _copter_defaults() -> Mapping[str, Parameter]:
    return {
        name: CopterParameter(name, kind, value if kind == REAL32 else int(value))
        for name, kind, value in _DEFAULTS
    }


class CopterParameters(Parameters):
    """Copter's set as clients see it; `number` also finds the hidden parameters of the loops."""

    def __init__(
        self,
        values: Mapping[str, float] | None = None,
        gimbal: bool = False,
        override_by_speed: bool = False,
    ) -> None:
        """Raises UnknownParameterError or ValueError for an unknown name or an invalid value in `values`."""
        self._loops = Parameters()
        self._defaults = self._default_set()
        self._parameters = dict(self._defaults)
        self._unused = set()
        self._number_listed()
        self.revision = 0
        for name, value in (values or {}).items():
            self._set_own(name, value)
        self._follow()

    def _default_set(self) -> Mapping[str, Parameter]:
        return _copter_defaults()

    def number(self, name: str) -> float:
        own = self._parameters.get(name)
        return self._loops.number(name) if own is None else own.value

    def set(self, name: str, value: float) -> Parameter:
        """Set a value, also of a loop (wind by components). Raises UnknownParameterError, ValueError."""
        name = _ALIASES.get(name, name)
        if name in self._parameters or name not in self._loops:
            changed = self._set_own(name, value)
            self._follow()
            return changed
        self.revision += 1
        if name in ("SIH_WIND_N", "SIH_WIND_E"):
            return self._set_wind(name, value)
        return self._loops.set(name, value)

    def reset(self, keep: Collection[str] = ()) -> list[Parameter]:
        changed = super().reset(keep)
        self._follow()
        return changed

    def _set_own(self, name: str, value: float) -> Parameter:
        """Truncate a value for an integer and clamp it to its range, as ArduPilot does."""
        parameter = self[name]
        if not math.isfinite(value):
            raise ValueError(f"parameter {name} needs a finite number, got {value}")
        if parameter.kind in _RANGES:
            low, high = _RANGES[parameter.kind]
            number: int | float = min(max(int(value), low), high)
        else:
            number = single(value)
        changed = replace(parameter, value=number)
        self._parameters[name] = changed
        self.revision += 1
        return changed

    def _set_wind(self, name: str, value: float) -> Parameter:
        parts = {part: self._loops.number(part) for part in ("SIH_WIND_N", "SIH_WIND_E")} | {name: value}
        north, east = parts["SIH_WIND_N"], parts["SIH_WIND_E"]
        self._set_own("SIM_WIND_SPD", math.hypot(north, east))
        self._set_own("SIM_WIND_DIR", math.degrees(math.atan2(-east, -north)) % 360.0)
        self._follow()
        return self._loops[name]

    def _follow(self) -> None:
        for name, formula in _LOOPS.items():
            value = formula(self)
            self._loops.set(name, round(value) if self._loops[name].kind == INT32 else value)
