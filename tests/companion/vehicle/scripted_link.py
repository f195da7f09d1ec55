"""A driver on a link without a socket: frames go in by hand, and sent frames are kept."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle.autopilot_driver import AutopilotDriver
from companion.vehicle.byte_link import Received, Source
from companion.vehicle.drivers import DriverKind, open_driver
from companion.vehicle.framing import Frame, frames_of

AUTOPILOT: Source = ("127.0.0.1", 14580)
QUADROTOR, PX4, ARDUPILOT = 2, 12, 3  # MAV_TYPE, MAV_AUTOPILOT


class ScriptedLink:
    """Implements `ByteLink`."""

    datagrams = True
    dropped_count = 0

    def __init__(self) -> None:
        self.sent: list[bytes] = []
        self.received: Received = lambda data, source: None

    def send(self, data: bytes) -> None:
        self.sent.append(data)

    def answer_to(self, source: Source) -> None:
        pass

    def discard_received(self) -> None:
        pass

    async def close(self) -> None:
        pass


class ScriptedDriver:
    """A driver with its link open, before `connect` and without its tasks.

    Attributes:
        driver: the driver. link: its link.
    """

    def __init__(self, kind: DriverKind, *, other_component_ids: Sequence[int] = ()) -> None:
        driver = open_driver(kind, "udpin://127.0.0.1:14540", other_component_ids=other_component_ids)
        assert isinstance(driver, AutopilotDriver)
        self.driver, self.link = driver, ScriptedLink()
        driver._link = self.link
        self._codecs: dict[tuple[int, int], mavlink.MAVLink] = {}

    def receive(self, message: Any, *, address: tuple[int, int] = (1, 1), source: Source = AUTOPILOT) -> None:
        """Pass a message to the driver as received."""
        codec = self._codecs.setdefault(address, mavlink.MAVLink(None, *address))
        data = bytes(message.pack(codec))
        codec.seq = (codec.seq + 1) % 256
        self.driver._received(data, source)

    def heartbeat(
        self, mav_type: int = QUADROTOR, autopilot: int = PX4, *, mode: int = 0, source: Source = AUTOPILOT
    ) -> None:
        """A heartbeat of the autopilot, armed in the air."""
        self.receive(mavlink.MAVLink_heartbeat_message(mav_type, autopilot, 0x81, mode, 4, 3), source=source)

    def vtol_state(self, vtol_state: int, landed_state: int = 2) -> None:
        """An EXTENDED_SYS_STATE."""
        self.receive(mavlink.MAVLink_extended_sys_state_message(vtol_state, landed_state))

    def program(self, *, is_plane: bool | None = False) -> None:
        """The answer of an ArduPilot to a request for its parameters; None: neither was received."""
        if is_plane is not None:
            self.driver._telemetry.use_program(is_plane=is_plane)

    def taken(self) -> list[Frame]:
        """Return and forget what was sent."""
        frames = [frame for data in self.link.sent for frame in frames_of(data)]
        self.link.sent.clear()
        return frames
