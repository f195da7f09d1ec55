"""The vehicle's parameters: PX4's names, types and values, with integers sent bytewise in the float field.

`parameters.txt` beside this file has all that a PX4 lists, one `NAME TYPE VALUE` per line. As in PX4, a
parameter that no module has used yet (`parameters_mission.txt`) can be read and set, but is not listed.
"""

from __future__ import annotations

import math
import re
import struct
import zlib
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from typing import Any

INT32 = 6  # MAV_PARAM_TYPE_INT32
REAL32 = 9  # MAV_PARAM_TYPE_REAL32
UINT32 = 5  # MAV_PARAM_TYPE_UINT32, of _HASH_CHECK alone
HASH_CHECK = "_HASH_CHECK"
NO_INDEX = 65535  # of what is not listed: _HASH_CHECK, and a parameter that no module has used yet
_FILE = "parameters.txt"
_MISSION_FILE = "parameters_mission.txt"
_GIMBAL_FILE = "parameters_gimbal.txt"
OVERRIDE_SPEED = "MAN_OVERRIDE_SPD"
_FORMER_OVERRIDE = ("COM_RC_OVERRIDE", "COM_RC_STICK_OV")
_TYPES = {"INT32": INT32, "REAL32": REAL32}
# PX4's `volatile` parameters: the vehicle itself changes them, so _HASH_CHECK excludes them.
_VOLATILE = re.compile(
    r"CAL_ACC\d_[XYZ](OFF|SCALE)|CAL_GYRO\d_[XYZ]OFF|CAL_BARO\d_OFF"
    r"|CAL_MAG\d_[XYZ](OFF|SCALE|ODIAG|COMP)|EKF2_MAG_DECL|ASPD_SCALE_\d|SENS_DPRES_OFF"
    r"|COM_FLIGHT_UUID|COM_MODE\d_HASH|LND_FLIGHT_T_(HI|LO)"
)


@dataclass(frozen=True, slots=True)
class Parameter:
    """One parameter; `kind` is its MAV_PARAM_TYPE."""

    name: str
    kind: int
    value: int | float

    @property
    def wire_value(self) -> float:
        """The value as PARAM_VALUE.param_value carries it: an integer's bytes read as a float."""
        if self.kind == INT32:
            return float(struct.unpack("<f", struct.pack("<i", int(self.value)))[0])
        return float(self.value)


def is_volatile(name: str) -> bool:
    """Whether PX4 excludes a parameter from _HASH_CHECK because the vehicle changes it by itself."""
    return _VOLATILE.fullmatch(name) is not None


def parameter_hash(parameters: Iterable[Parameter]) -> int:
    """_HASH_CHECK by PX4's recipe: CRC-32 without inversions over names and values, in alphabetical order.

    Args:
        parameters: all that are listed, in order; volatile ones are left out here.
    """
    crc = 0xFFFFFFFF
    for parameter in parameters:
        if not is_volatile(parameter.name):
            packed = struct.pack("<i" if parameter.kind == INT32 else "<f", parameter.value)
            crc = zlib.crc32(parameter.name.encode() + packed, crc)
    return crc ^ 0xFFFFFFFF


class UnknownParameterError(KeyError):
    """No parameter of that name."""


def decode_wire_value(kind: int, wire_value: float) -> int | float:
    """The number in PARAM_SET.param_value: bytewise for INT32."""
    if kind == INT32:
        return int(struct.unpack("<i", struct.pack("<f", wire_value))[0])
    return float(wire_value)


def default_parameters(gimbal: bool = False) -> list[Parameter]:
    """`parameters.txt` and its additions, with `gimbal` those of one too, in alphabetical order."""
    found = [*_read(_FILE), *_read(_MISSION_FILE), *(_read(_GIMBAL_FILE) if gimbal else ())]
    unique = {parameter.name: parameter for parameter in found}  # the last entry of a name is used
    return sorted(unique.values(), key=lambda parameter: parameter.name)


@cache
def _defaults(gimbal: bool, override_by_speed: bool) -> Mapping[str, Parameter]:
    found = {parameter.name: parameter for parameter in default_parameters(gimbal)}
    if not override_by_speed:
        return found
    found[OVERRIDE_SPEED] = Parameter(OVERRIDE_SPEED, REAL32, 1.0)
    return {name: found[name] for name in sorted(found) if name not in _FORMER_OVERRIDE}


@cache
def _read(file_name: str) -> tuple[Parameter, ...]:
    text = resources.files(__package__).joinpath(file_name).read_text(encoding="utf-8")
    found = []
    for line in text.splitlines():
        if line and not line.startswith("#"):
            name, kind, value = line.split()
            number = int(value) if kind == "INT32" else single(float(value))
            found.append(Parameter(name, _TYPES[kind], number))
    return tuple(found)


class Parameters:
    """The parameter set of one vehicle. `revision` grows with every change.

    Its length, its iteration and its indices are those of the list that clients get, in alphabetical order.
    """

    def __init__(
        self,
        values: Mapping[str, float] | None = None,
        gimbal: bool = False,
        override_by_speed: bool = False,
    ) -> None:
        """Start from the defaults, with `gimbal` those of a gimbal too.

        Args:
            override_by_speed: see `releases.Release`.

        Raises UnknownParameterError or ValueError for an unknown name or an invalid value in `values`.
        """
        self._gimbal, self._override_by_speed = gimbal, override_by_speed
        self._defaults = self._default_set()
        self._parameters = dict(self._defaults)
        self._unused = {parameter.name for parameter in _read(_MISSION_FILE)}
        self._number_listed()
        self.revision = 0
        for name, value in (values or {}).items():
            self.set(name, value)

    def _default_set(self) -> Mapping[str, Parameter]:
        """The defaults by name, shared by all vehicles with the same ones."""
        return _defaults(self._gimbal, self._override_by_speed)

    def __getstate__(self) -> dict[str, Any]:
        """Only what differs from the defaults: a copy of a vehicle shares them."""
        state = {**vars(self), "_parameters": self.customised()}
        del state["_defaults"], state["_names"], state["_index"]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state)
        self._defaults = self._default_set()
        self._parameters = {**self._defaults, **{item.name: item for item in state["_parameters"]}}
        self._number_listed()

    def _number_listed(self) -> None:
        self._names = [name for name in self._parameters if name not in self._unused]
        self._index = {name: index for index, name in enumerate(self._names)}

    def __len__(self) -> int:
        return len(self._names)

    def __iter__(self) -> Iterator[Parameter]:
        return (self._parameters[name] for name in self._names)

    def __contains__(self, name: str) -> bool:
        return name in self._parameters

    def __getitem__(self, name: str) -> Parameter:
        try:
            return self._parameters[name]
        except KeyError:
            raise UnknownParameterError(
                f"this vehicle has no parameter {name!r}; PARAM_REQUEST_LIST names all {len(self)}"
            ) from None

    def get(self, name: str) -> Parameter | None:
        return self._parameters.get(name)

    def number(self, name: str) -> float:
        try:
            return self._parameters[name].value
        except KeyError:
            return self[name].value  # its message names the error

    def positive(self, name: str) -> float:
        """A value that is safe as a divisor or under a root: above zero, though PX4 accepts any."""
        value = self.number(name)
        return value if value > 0.01 else 0.01

    def use(self, *names: str) -> None:
        """List these parameters from now on: a module that reads them has started."""
        if not self._unused.isdisjoint(names):
            self._unused.difference_update(names)
            self._number_listed()

    def at(self, index: int) -> Parameter | None:
        """The parameter at an index of the list, None outside it."""
        return self._parameters[self._names[index]] if 0 <= index < len(self._names) else None

    def index(self, name: str) -> int:
        """Its index in the list, NO_INDEX if it is not listed."""
        return self._index.get(name, NO_INDEX)

    def set(self, name: str, value: float) -> Parameter:
        """Set a value; PX4 checks no range. Raises UnknownParameterError or ValueError."""
        parameter = self[name]
        if not math.isfinite(value):
            raise ValueError(f"parameter {name} needs a finite number, got {value}")
        if parameter.kind == INT32:
            if value != int(value) or not -(2**31) <= value < 2**31:
                raise ValueError(f"parameter {name} is an INT32, got {value}; give a whole number")
            value = int(value)
        else:
            value = single(float(value))
        changed = replace(parameter, value=value)
        self._parameters[name] = changed
        self.revision += 1
        return changed

    def reset(self, keep: Collection[str] = ()) -> list[Parameter]:
        """Restore the values of `default_parameters`, except those to keep. Returns what changed."""
        changed = []
        for name, default in self._defaults.items():
            if name not in keep and self._parameters[name].value != default.value:
                self._parameters[name] = default
                changed.append(default)
        self.revision += bool(changed)
        return changed

    def customised(self) -> list[Parameter]:
        """The parameters whose value is not the default: what PX4 stores in its file."""
        return [item for name, item in self._parameters.items() if item.value != self._defaults[name].value]

    def hash(self) -> int:
        """The set's _HASH_CHECK."""
        return parameter_hash(self)

    def hash_wire_value(self) -> float:
        """The hash as PARAM_VALUE carries it: its bytes read as a float."""
        return float(struct.unpack("<f", struct.pack("<I", self.hash()))[0])


def single(value: float) -> float:
    """The nearest float32, which is what the vehicle stores."""
    try:
        return float(struct.unpack("<f", struct.pack("<f", value))[0])
    except OverflowError:
        raise ValueError(f"{value} does not fit a 32-bit float") from None
