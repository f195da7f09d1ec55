"""Fast packing of MAVLink 2: payloads by one `struct` call, the checksum by the standard library.

pymavlink spends most of its time on the message object and on a checksum in Python. A `Packed` message is its
payload; the pymavlink object is made only when a field is read. A fleet sends some 15000 messages a second,
nearly all of a dozen kinds: `telemetry` makes those with `packer`.
"""

from __future__ import annotations

import binascii
import inspect
import struct
from collections.abc import Callable
from typing import Any

from pymavlink.dialects.v20 import development as dialect

_HEADER = struct.Struct("<BBBBBBBH")  # length, two flags, sequence, system, component, message id (24 bit)
_REVERSED = bytes(int(f"{value:08b}"[::-1], 2) for value in range(256))


def checksum(data: bytes) -> bytes:
    """CRC-16/MCRF4XX (MAVLink's X.25) as in a packet: two bytes, the lower first.

    `binascii.crc_hqx` has the same polynomial in reversed bit order; so bits are reversed before and after.
    """
    return binascii.crc_hqx(data.translate(_REVERSED), 0xFFFF).to_bytes(2, "big").translate(_REVERSED)


class Packed:
    """A message as its payload; it has the attributes of the pymavlink message it represents."""

    __slots__ = ("_form", "payload")

    def __init__(self, form: Form, payload: bytes) -> None:
        self._form = form
        self.payload = payload

    def get_type(self) -> str:
        return self._form.name

    def get_msgId(self) -> int:  # noqa: N802 - pymavlink's name
        return self._form.identifier

    @property
    def message(self) -> Any:
        """The pymavlink message, a new one at every call."""
        return self._form.unpacked(self.payload)

    def to_dict(self) -> dict[str, Any]:
        """As pymavlink's, without its message."""
        return {"mavpackettype": self._form.name, **self._form.fields(self.payload)}

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self.message, name)

    def __copy__(self) -> Any:
        """A pymavlink message, whose fields can be changed."""
        return self.message

    def pack(self, codec: Any) -> bytes:
        """The packet, with the sequence and source that the codec has now."""
        if codec.signing.sign_outgoing:
            packed: bytes = self.message.pack(codec)
            return packed
        payload = self.payload.rstrip(b"\0") or b"\0"
        form = self._form
        body = (
            _HEADER.pack(
                len(payload), 0, 0, codec.seq, codec.srcSystem, codec.srcComponent, form.low, form.high
            )
            + payload
        )
        return b"\xfd" + body + checksum(body + form.crc_extra)


class Form:
    """The layout of one kind of message."""

    __slots__ = ("_class", "_has_arrays", "crc_extra", "high", "identifier", "low", "name")

    def __init__(self, message_class: Any) -> None:
        self._class = message_class
        self._has_arrays = any(message_class.array_lengths)
        self.name: str = message_class.msgname
        self.identifier: int = message_class.id
        self.low, self.high = self.identifier & 0xFF, self.identifier >> 8
        self.crc_extra = bytes([message_class.crc_extra])

    def __reduce__(self) -> tuple[type[Form], tuple[Any]]:
        return Form, (self._class,)

    def fields(self, payload: bytes) -> dict[str, Any]:
        """The fields of a payload by name."""
        values = self._class.unpacker.unpack(payload)
        if not self._has_arrays:
            return dict(zip(self._class.ordered_fieldnames, values, strict=True))
        rest, fields = list(values), {}
        for name, length in zip(self._class.ordered_fieldnames, self._class.array_lengths, strict=True):
            if length:
                fields[name], rest = rest[:length], rest[length:]
            else:
                fields[name] = rest.pop(0)
        return fields

    def unpacked(self, payload: bytes) -> Any:
        """The pymavlink message of a payload."""
        return self._class(**self.fields(payload))


def packer(message_class: Any) -> Callable[..., Packed]:
    """A function with the arguments of a pymavlink message class that makes the `Packed` message.

    Raises:
        ValueError: the message has a text field, which no frequent message has.
    """
    if "char" in message_class.fieldtypes:
        raise ValueError(f"{message_class.msgname} has text; make it with pymavlink's own class")
    signature = inspect.signature(message_class.__init__)
    parameters = list(signature.parameters.values())[1:]
    defaults = {
        f"_{item.name}": item.default for item in parameters if item.default is not inspect.Parameter.empty
    }
    head = ", ".join(
        f"{item.name}=_{item.name}" if f"_{item.name}" in defaults else item.name for item in parameters
    )
    lengths = dict(zip(message_class.ordered_fieldnames, message_class.array_lengths, strict=True))
    wire = ", ".join(f"*{name}" if lengths[name] else name for name in message_class.ordered_fieldnames)
    # generated source, as in collections.namedtuple: the order on the wire (by size) then costs nothing
    source = f"lambda {head}: _packed(_form, _pack({wire}))"
    names = {
        "_packed": Packed,
        "_form": Form(message_class),
        "_pack": message_class.unpacker.pack,
        **defaults,
    }
    made: Callable[..., Packed] = eval(source, names)
    return made


attitude = packer(dialect.MAVLink_attitude_message)
attitude_quaternion = packer(dialect.MAVLink_attitude_quaternion_message)
attitude_target = packer(dialect.MAVLink_attitude_target_message)
altitude = packer(dialect.MAVLink_altitude_message)
distance_sensor = packer(dialect.MAVLink_distance_sensor_message)
global_position_int = packer(dialect.MAVLink_global_position_int_message)
gps_raw_int = packer(dialect.MAVLink_gps_raw_int_message)
highres_imu = packer(dialect.MAVLink_highres_imu_message)
local_position_ned = packer(dialect.MAVLink_local_position_ned_message)
odometry = packer(dialect.MAVLink_odometry_message)
position_target_local_ned = packer(dialect.MAVLink_position_target_local_ned_message)
servo_output_raw = packer(dialect.MAVLink_servo_output_raw_message)
vfr_hud = packer(dialect.MAVLink_vfr_hud_message)
