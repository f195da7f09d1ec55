"""A ground station of pymavlink: records what cameras send, and sends an operator's commands."""

from __future__ import annotations

import math
import select
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from pymavlink import mavutil
from pymavlink.dialects.v20 import common as mavlink

from companion.ground_station.objects import TargetRelative
from companion.vehicle.framing import TARGET_RELATIVE_ID, Framer
from mavlink_sim.testing import free_port

CAMERA = 100
_HEARTBEAT_S = 0.5
_ANSWER_S = 15.0


class OperatorStation:
    """A station.

    Attributes:
        messages: CLOCK_MONOTONIC nanoseconds of arrival, and the message, of one camera.
        targets: TARGET_RELATIVE of it, which pymavlink does not know: time (UNIX, microseconds), and north,
            east and down of the vehicle (m).

    Args:
        device: as pymavlink names it, `udpin:HOST:PORT` or `tcp:HOST:PORT`. camera: its component id.
    """

    def __init__(self, device: str, camera: int = CAMERA) -> None:
        self._camera = camera
        self._connection: Any = mavutil.mavlink_connection(device)
        self.messages: list[tuple[int, Any]] = []
        self.targets: list[tuple[int, tuple[float, float, float]]] = []
        self._codec, self._decoder = mavlink.MAVLink(None, 255, 190), mavlink.MAVLink(None)
        self._framer, self._datagram = Framer(), device.startswith("udp")
        self._system_id = 0
        self._changed, self._closing = threading.Condition(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="station", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._closing.set()
        self._thread.join(5.0)
        self._connection.close()

    def of(self, kind: str, since: int = 0) -> list[tuple[int, Any]]:
        """The messages of a type, from an index of `messages` on."""
        return [each for each in self.messages[since:] if each[1].get_type() == kind]

    def until(self, condition: Callable[[], object], timeout_s: float, what: str) -> None:
        with self._changed:
            if not self._changed.wait_for(condition, timeout_s):
                raise TimeoutError(f"not {what} within {timeout_s:g} s: {self.texts()}")

    def texts(self) -> list[str]:
        return [message.text for _, message in self.of("STATUSTEXT")]

    def command(self, number: int, *parameters: float) -> list[int]:
        """Send a command; returns the results that were acknowledged, the last one is final."""
        self.until(lambda: self.of("HEARTBEAT"), 60.0, "a camera")
        begun = len(self.messages)
        values = [*parameters, *[0.0] * (7 - len(parameters))]
        self._send(mavlink.MAVLink_command_long_message(self._system_id, self._camera, number, 0, *values))

        def results() -> list[int]:
            acks = [message for _, message in self.of("COMMAND_ACK", begun)]
            return [ack.result for ack in acks if ack.command == number]

        final = mavlink.MAV_RESULT_IN_PROGRESS
        self.until(lambda: any(each != final for each in results()), _ANSWER_S, f"an answer to {number}")
        return results()

    def _send(self, message: Any) -> None:
        self._connection.write(message.pack(self._codec))

    def _run(self) -> None:
        next_s = -math.inf
        heartbeat = mavlink.MAVLink_heartbeat_message(
            mavlink.MAV_TYPE_GCS, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, 4, 3
        )
        while not self._closing.is_set():
            if time.monotonic() > next_s:
                next_s = time.monotonic() + _HEARTBEAT_S
                self._send(heartbeat)
            if not select.select([self._connection.fd], [], [], 0.1)[0]:
                continue
            data = self._connection.recv(65535)
            now_ns = time.monotonic_ns()
            for frame in self._framer.feed(data, datagram=self._datagram):
                if frame.component_id == self._camera and frame.message_id == TARGET_RELATIVE_ID:
                    layout = TargetRelative.unpacker
                    time_us, *offset_m = layout.unpack(frame.padded(layout.size))[:4]
                    self.targets.append((time_us, (offset_m[0], offset_m[1], offset_m[2])))
                if frame.component_id == self._camera and frame.message_id in mavlink.mavlink_map:
                    message = self._decoder.decode(bytearray(frame.raw))
                    with self._changed:
                        self._system_id = frame.system_id
                        self.messages.append((now_ns, message))
                        self._changed.notify_all()


@contextmanager
def operator_station(
    device: str | None = None, camera: int = CAMERA
) -> Iterator[tuple[OperatorStation, str]]:
    """A station, and the url of `ground_station.url` to it. `device`: None: UDP on a free port."""
    port = free_port()
    station = OperatorStation(device or f"udpin:127.0.0.1:{port}", camera)
    try:
        yield station, f"udpout://127.0.0.1:{port}"
    finally:
        station.close()
