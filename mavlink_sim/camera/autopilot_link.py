"""The link to an autopilot whose telemetry has the pose of its vehicle.

Requests for these messages are all that is sent on it.
"""

from __future__ import annotations

import re
import select
import socket
import time
from collections import Counter
from typing import Any

from mavlink_sim.wire.endpoint import UdpEndpoint
from mavlink_sim.wire.faulty_socket import Address
from mavlink_sim.wire.messages import Outgoing, dialect, parser

REQUESTED_HZ = {"ATTITUDE_QUATERNION": 50.0, "LOCAL_POSITION_NED": 30.0}
"""Requested rates: those of PX4's onboard link."""
ENOUGH_HZ = 15.0
"""A message with at least this rate is not requested."""
REQUEST_PERIOD_S = 1.0
CONNECT_S = 5.0

_ADDRESS = re.compile(r"(udpin|udpout|tcp)://([^/:\[\]\s]+):(\d{1,5})/?")


class LinkError(ValueError):
    """A link cannot be used. The text is one line for the user."""


class _TcpEndpoint:
    """A connection to an autopilot that listens, as ArduPilot's SITL does on port 5760."""

    def __init__(self, host: str, port: int) -> None:
        self._address = (host, port)
        self._socket = socket.create_connection(self._address, timeout=CONNECT_S)
        self._socket.setblocking(False)
        self._codec = parser()
        self._closed = False

    def fileno(self) -> int:
        return self._socket.fileno()

    def receive_from(self) -> list[tuple[Any, Address]]:
        """The messages that have arrived, each with its sender."""
        messages: list[Any] = []
        while not self._closed:
            try:
                data = self._socket.recv(65536)
            except BlockingIOError:
                break
            except OSError:
                data = b""
            self._closed = not data
            messages += self._codec.parse_buffer(data) or []
        if self._closed and not messages:
            raise ConnectionError("the autopilot closed its TCP connection")
        return [(message, self._address) for message in messages if message.get_type() != "BAD_DATA"]

    def send(self, outgoing: list[Outgoing]) -> None:
        try:
            self._socket.sendall(b"".join(item.pack(self._codec) for item in outgoing))
        except BlockingIOError:
            pass  # requests are repeated every second
        except OSError:
            self._closed = True  # a request may be lost; a closed connection ends the pose

    def close(self) -> None:
        self._socket.close()


class AutopilotLink:
    """Receives from one autopilot, and requests the messages that it does not send.

    The requests are SET_MESSAGE_INTERVAL, from the vehicle's own system id and MAV_COMP_ID_CAMERA. There are
    no heartbeats, so that it is not mistaken for a ground station or an onboard controller.

    Args:
        url: `udpin://HOST:PORT` binds, `udpout://HOST:PORT` sends first, `tcp://HOST:PORT` connects.
        listen_only: never send.

    Raises:
        LinkError: an invalid address. OSError: the port is taken, or there is no listener.

    Attributes:
        systems: of the autopilots received, system id → armed.
        senders: of the heartbeats of these autopilots: (system id, address).
        system_id: of the one whose messages `receive` returns; None: not yet selected.
    """

    def __init__(self, url: str, listen_only: bool = False) -> None:
        match = _ADDRESS.fullmatch(url)
        if match is None or not 1 <= int(match[3]) <= 65535:
            raise LinkError(
                f"link {url!r}: expected udpin://HOST:PORT, udpout://HOST:PORT or tcp://HOST:PORT"
            )
        scheme, host, port = match[1], match[2], int(match[3])
        if listen_only and scheme == "udpout":
            raise LinkError(f"link {url!r}: udpout:// must send first; listen only with udpin:// or tcp://")
        self.systems: dict[int, bool] = {}
        self.senders: set[tuple[int, Address]] = set()
        self.system_id: int | None = None
        self._listen_only = listen_only
        self._sends_first = scheme == "udpout"
        self._counts: Counter[str] = Counter()
        self._request_s = 0.0
        if scheme == "tcp":
            try:
                self._endpoint: UdpEndpoint | _TcpEndpoint = _TcpEndpoint(host, port)
            except OSError as error:
                raise OSError(f"link {url!r}: {error.strerror or error}") from error
        elif scheme == "udpin":
            self._endpoint = UdpEndpoint(host, port, port)
        else:
            endpoint = UdpEndpoint("0.0.0.0", 0, port)
            endpoint.peer = (host, port)
            self._endpoint = endpoint

    def receive(self, timeout_s: float) -> list[Any]:
        """The messages of the autopilot; waits up to `timeout_s` for the first. Requests what is missing.

        Raises:
            ConnectionError: its TCP connection has ended.
        """
        select.select([self._endpoint], [], [], timeout_s)
        wanted = []
        for message, sender in self._endpoint.receive_from():
            system = message.get_srcSystem()
            if message.get_srcComponent() != dialect.MAV_COMP_ID_AUTOPILOT1:
                continue
            if message.get_type() == "HEARTBEAT" and message.autopilot != dialect.MAV_AUTOPILOT_INVALID:
                self.systems[system] = bool(message.base_mode & dialect.MAV_MODE_FLAG_SAFETY_ARMED)
                if self.system_id is None:
                    self.senders.add((system, sender))
            elif message.get_type() == "HIL_STATE_QUATERNION":
                self.systems.setdefault(
                    system, False
                )  # PX4's link for a viewer of the simulator: no heartbeat
            if self.system_id in (None, system):
                self._counts[message.get_type()] += 1
                wanted.append(message)
        self._request()
        return wanted

    def _request(self) -> None:
        """Once per second request each needed message whose rate in the last second was too low."""
        now_s = time.monotonic()
        elapsed_s = now_s - self._request_s
        if self._listen_only or elapsed_s < REQUEST_PERIOD_S or not (self.systems or self._sends_first):
            return
        counts, self._counts, self._request_s = self._counts, Counter(), now_s
        if counts["HIL_STATE_QUATERNION"]:
            return
        system = self.system_id or next(iter(self.systems), 0)
        requests = [
            Outgoing(
                dialect.MAVLink_command_long_message(
                    system,
                    dialect.MAV_COMP_ID_AUTOPILOT1 if system else 0,
                    dialect.MAV_CMD_SET_MESSAGE_INTERVAL,
                    0,
                    getattr(dialect, f"MAVLINK_MSG_ID_{name}"),
                    round(1e6 / rate_hz),
                    *(0.0,) * 5,
                ),
                system or 1,
                dialect.MAV_COMP_ID_CAMERA,
            )
            for name, rate_hz in REQUESTED_HZ.items()
            if counts[name] < ENOUGH_HZ * elapsed_s
        ]
        self._endpoint.send(requests)

    def close(self) -> None:
        self._endpoint.close()
