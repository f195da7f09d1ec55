"""A camera's parameters: settings of the running service, and the file that describes them to stations.

https://mavlink.io/en/services/parameter_ext.html and https://mavlink.io/en/services/camera_def.html. CAM_MODE
is none of them: without it stations send MAV_CMD_SET_CAMERA_MODE, which is accepted while armed too. Pure:
the bus and the link are elsewhere.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, cast
from xml.etree import ElementTree

import numpy as np
from pymavlink.dialects.v20 import common as mavlink

from companion.bus.bodies.service import LiveSettingBody, StatusBody
from companion.bus.bodies.vehicle import VehicleBody
from companion.ground_station.camera import VENDOR
from companion.ground_station.component import Message, RequestTable
from companion.ground_station.tracking import Reply, Say
from vision.class_names import class_named

Query = Callable[[Mapping[str, Any] | None, Callable[[Reply], None]], None]
"""Sets settings of the service, or only asks for them (None). The reply arrives in the same loop: `settings`,
key → LiveSettingBody, or {"success": False, "reason": …, "refused": whether by the service}.
"""
VEHICLE_MAX_AGE_NS = 2_000_000_000
_PROGRESS_NS = 500_000_000
_REAL32, _UINT32 = mavlink.MAV_PARAM_EXT_TYPE_REAL32, mavlink.MAV_PARAM_EXT_TYPE_UINT32
_ACCEPTED, _UNSUPPORTED, _FAILED, _IN_PROGRESS = (
    mavlink.PARAM_ACK_ACCEPTED,
    mavlink.PARAM_ACK_VALUE_UNSUPPORTED,
    mavlink.PARAM_ACK_FAILED,
    mavlink.PARAM_ACK_IN_PROGRESS,
)
# Name: key, description, unit, step.
_CONFIDENCE = {"CONFIDENCE": ("detector.confidence", "Minimum confidence of detections", "", 0.01)}
_LIMITS = {
    "MAX_SPEED": ("guidance.max_horizontal_speed_mps", "Maximum horizontal speed", "m/s", 0.1),
    "MAX_CLIMB": ("guidance.max_climb_mps", "Maximum climb rate", "m/s", 0.1),
    "MAX_DESCENT": ("guidance.max_descend_mps", "Maximum descent rate", "m/s", 0.1),
    "MAX_ALT": ("guidance.max_altitude_m", "Maximum altitude above home", "m", 0.5),
    "MIN_ALT": ("guidance.min_altitude_m", "Minimum altitude above home", "m", 0.5),
    "MAX_DIST": ("guidance.max_distance_m", "Maximum distance from home", "m", 1.0),
}


@dataclass(frozen=True, slots=True)
class Parameter:
    """A parameter as it is now.

    Attributes:
        name: at most 16 bytes. key: of its setting. value: of now. default: of the file.
        minimum, maximum, step: of a number. options: lists of classes, of which `value` is an index; empty:
            it is a number, REAL32.
    """

    name: str
    key: str
    description: str
    value: float
    default: float
    unit: str = ""
    minimum: float = 0.0
    maximum: float = math.inf
    step: float = 0.0
    options: tuple[tuple[str, ...], ...] = ()

    @property
    def type(self) -> int:
        """MAV_PARAM_EXT_TYPE."""
        return int(_UINT32 if self.options else _REAL32)

    @property
    def packed(self) -> bytes:
        """The value as messages have it, 128 bytes."""
        packed = struct.pack("<I", int(self.value)) if self.options else struct.pack("<f", self.value)
        return packed.ljust(128, b"\0")

    def setting(self, packed: bytes, kind: int) -> float | list[str]:
        """Return the value of the setting that a station asks for. Raises ValueError: it has none."""
        if kind != self.type:
            raise ValueError(f"its type is {kind}, expected {self.type}")
        if self.options:
            (index,) = struct.unpack_from("<I", packed)
            if index >= len(self.options):
                raise ValueError(f"{index} is none of its {len(self.options)} options")
            return list(self.options[index])
        (value,) = struct.unpack_from("<f", packed)
        if not self.minimum <= value <= self.maximum:  # nor NaN
            raise ValueError(f"{value:g}, expected {self.minimum:g} to {self.maximum:g}")
        return float(str(np.float32(value)))  # 0.3 rather than 0.30000001


class Parameters:
    """The parameters of a camera. They are read-only unless the vehicle is known to be disarmed.

    Args:
        camera: its name; None: the first, which has the limits of guidance too. detects: it has a detector.
        requests: of its component. query: asks the service. say: sends a STATUSTEXT.

    Attributes:
        now: those that are known, CLASSES last: the classes come with the model.
    """

    def __init__(
        self, camera: str | None, requests: RequestTable, *, detects: bool, query: Query, say: Say
    ) -> None:
        self.now: tuple[Parameter, ...] = ()
        self._camera, self._detects, self._query, self._say = camera, detects, query, say
        self._prefix = "" if camera is None else f"cameras.{camera}."
        self._table = {**(_CONFIDENCE if detects else {}), **(_LIMITS if camera is None else {})}
        self._class_names: Sequence[str] = ()
        self._seen: object = None
        self._armed: bool | None = None
        self._vehicle_ns = self._progress_ns = self._now_ns = 0
        self._is_stale = self._is_asking = False
        self._waiting: dict[str, tuple[bytes, float | list[str]]] = {}
        self._setting: tuple[str, bytes] | None = None  # name and value that the service sets now
        self._unsent: list[Message] = []
        requests.listeners |= {
            "PARAM_EXT_REQUEST_LIST": lambda _: list(map(self._value, self.now)),
            "PARAM_EXT_REQUEST_READ": self._on_read,
            "PARAM_EXT_SET": self._on_set,
        }

    @property
    def are_complete(self) -> bool:
        """Whether all are known that there will be."""
        return bool(self.now) and (not self._detects or self._find("CLASSES") is not None)

    def on_vehicle(self, vehicle: VehicleBody, now_ns: int) -> None:
        """Use the vehicle's state. `now_ns`: of the arrival."""
        self._armed, self._vehicle_ns = (vehicle["armed"] if vehicle["connected"] else None), now_ns

    def on_status(self, status: StatusBody) -> None:
        """Ask for the values if they have changed: others change them too."""
        about = status["perception"] if self._camera is None else status["cameras"][self._camera]
        seen = (status["service"], status["changed_settings"], about["class_names"])
        self._class_names = about["class_names"]
        self._is_stale |= seen != self._seen
        self._seen = seen
        self._ask_next()

    def due(self, now_ns: int) -> list[Message]:
        """Return what is to be sent now."""
        self._now_ns = now_ns
        if self._setting is not None and now_ns >= self._progress_ns:
            self._progress_ns = now_ns + _PROGRESS_NS
            self._unsent += self._ack(self._setting[0], _IN_PROGRESS)
        messages, self._unsent = self._unsent, []
        return messages

    # --- requests of stations ------------------------------------------------------------------------

    def _on_read(self, message: Message) -> list[Message]:
        index = message.param_index
        if index < 0:
            found = self._find(_name(message))
            return [] if found is None else [self._value(found)]
        return [self._value(each) for each in self.now[index : index + 1]]

    def _on_set(self, message: Message) -> list[Message]:
        name, packed = _name(message), bytes(message._param_value_raw).ljust(128, b"\0")
        if (parameter := self._find(name)) is None:
            if message.target_component == 0:
                return []  # it is for another component
            return self._refuse(
                name, "there is no such parameter" if self.now else "the service does not run"
            )
        if (reason := self._read_only_reason()) is not None:
            return self._refuse(name, reason)
        try:
            setting = parameter.setting(packed, message.param_type)
        except ValueError as error:
            return self._refuse(name, str(error), _UNSUPPORTED)
        if self._setting == (name, packed):
            return self._ack(name, _IN_PROGRESS)
        self._waiting[name] = packed, setting  # in place of an older one
        self._ask_next()
        return []

    def _read_only_reason(self) -> str | None:
        if self._armed is None or self._now_ns - self._vehicle_ns > VEHICLE_MAX_AGE_NS:
            return "not known whether armed"
        return "read-only while armed" if self._armed else None

    def _refuse(self, name: str, reason: str, result: int = _FAILED) -> list[Message]:
        """Return the answer and the value that remains: QGroundControl repeats a FAILED one with its own."""
        self._say(mavlink.MAV_SEVERITY_WARNING, f"{name} not set: {reason}")
        found = self._find(name)
        return [*self._ack(name, result), *([] if found is None else [self._value(found)])]

    # --- the service ---------------------------------------------------------------------------------

    def _ask_next(self) -> None:
        """Send what waits, one query at a time: so no reply is older than the one before."""
        if self._is_asking:
            return
        while self._waiting:
            name = next(iter(self._waiting))
            packed, setting = self._waiting.pop(name)
            parameter, reason = self._find(name), self._read_only_reason()
            if parameter is None or reason is not None:  # since it was asked for
                self._unsent += self._refuse(name, reason or "there is no such parameter any more")
                continue
            self._is_asking, self._setting = True, (name, packed)
            self._progress_ns = self._now_ns + _PROGRESS_NS
            self._query({parameter.key: setting}, partial(self._on_reply, name))
            return
        if self._is_stale:
            self._is_asking, self._is_stale = True, False
            self._query(None, partial(self._on_reply, None))

    def _on_reply(self, name: str | None, reply: Reply) -> None:
        self._is_asking, self._setting = False, None
        if reply["success"]:
            self._use(reply["settings"])
            self._unsent += [] if name is None else self._ack(name, _ACCEPTED)
        elif name is not None:
            self._unsent += self._refuse(name, reply["reason"], _UNSUPPORTED if reply["refused"] else _FAILED)
        else:  # asked again with the next status
            self._seen = None
            return
        self._ask_next()

    def _use(self, settings: Mapping[str, LiveSettingBody]) -> None:
        before, self.now = self.now, (*self._numbers(settings), *self._classes(settings))
        if before:
            self._unsent += [self._value(each) for each in self.now if each not in before]

    def _numbers(self, settings: Mapping[str, LiveSettingBody]) -> list[Parameter]:
        return [
            Parameter(
                name,
                self._prefix + key,
                description,
                float(cast("float", body["value"])),
                float(cast("float", body["file"])),
                unit,
                -math.inf if body["minimum"] is None else body["minimum"],
                math.inf if body["maximum"] is None else body["maximum"],
                step,
            )
            for name, (key, description, unit, step) in self._table.items()
            for body in [settings[self._prefix + key]]
        ]

    def _classes(self, settings: Mapping[str, LiveSettingBody]) -> list[Parameter]:
        """CLASSES, which is all, one, or several classes where the file or the service has these."""
        if not self._detects or not self._class_names:
            return []
        body = settings[key := f"{self._prefix}detector.classes"]
        file, value = self._names(body["file"]), self._names(body["value"])
        options = tuple(dict.fromkeys([(), *((name,) for name in self._class_names), file, value]))
        now, default = options.index(value), options.index(file)
        return [Parameter("CLASSES", key, "Classes that are detected", now, default, options=options)]

    def _names(self, classes: object) -> tuple[str, ...]:
        """Return the model's spelling of classes, given by name or id."""
        return tuple(_spelled(each, self._class_names) for each in cast("list[str | int]", classes))

    # --- messages ------------------------------------------------------------------------------------

    def _find(self, name: str) -> Parameter | None:
        return next((each for each in self.now if each.name == name), None)

    def _value(self, parameter: Parameter) -> Message:
        return mavlink.MAVLink_param_ext_value_message(
            parameter.name.encode(),
            parameter.packed,
            parameter.type,
            len(self.now),
            [each.name for each in self.now].index(parameter.name),
        )

    def _ack(self, name: str, result: int) -> list[Message]:
        """PARAM_EXT_ACK with the value of now."""
        found = self._find(name)
        packed, kind = (bytes(128), _REAL32) if found is None else (found.packed, found.type)
        return [mavlink.MAVLink_param_ext_ack_message(name.encode()[:16], packed, kind, result)]


def definition(camera: str, parameters: Sequence[Parameter]) -> tuple[bytes, int]:
    """Return a camera definition file, and its version, another one for another content.

    Args:
        camera: the name that CAMERA_INFORMATION has.
    """
    root = ElementTree.Element("mavlinkcamera")
    about = ElementTree.SubElement(root, "definition", version="0")
    ElementTree.SubElement(about, "model").text = camera
    ElementTree.SubElement(about, "vendor").text = VENDOR
    listed = ElementTree.SubElement(root, "parameters")
    for each in parameters:
        attributes = {"name": each.name, "type": "uint32" if each.options else "float"}
        attributes["default"] = f"{each.default:g}"
        if not each.options:
            # 0 is outside the range of limits, which must be larger.
            lowest = max(each.minimum, each.step if each.unit else 0.0)
            attributes |= {"min": f"{lowest:g}", "max": f"{each.maximum:g}", "step": f"{each.step:g}"}
        if each.unit:
            attributes["unit"] = each.unit
        element = ElementTree.SubElement(listed, "parameter", attributes)
        ElementTree.SubElement(element, "description").text = each.description
        if each.options:
            options = ElementTree.SubElement(element, "options")
            for index, classes in enumerate(each.options):
                label = "".join(char if char.isprintable() else "?" for char in ", ".join(classes))
                ElementTree.SubElement(options, "option", name=label or "all", value=str(index))
    version = zlib.crc32(ElementTree.tostring(root)) & 0xFFFF or 1
    about.set("version", str(version))
    return ElementTree.tostring(root, encoding="utf-8", xml_declaration=True), version


def _spelled(name: str | int, class_names: Sequence[str]) -> str:
    if isinstance(name, int):
        return class_names[name] if name < len(class_names) else str(name)
    try:
        return class_named(name, class_names)
    except ValueError:  # of another model
        return name


def _name(message: Message) -> str:
    return bytes(message._param_id_raw).partition(b"\0")[0].decode(errors="replace")
