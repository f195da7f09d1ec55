"""The pose of a vehicle interpolated between its telemetry messages, by its clock, and the link they come by.

Attitude is from ATTITUDE_QUATERNION, or from ATTITUDE without a quaternion; position from LOCAL_POSITION_NED.
A simulator's truth, HIL_STATE_QUATERNION, replaces both where it is sent. Requests for these messages are all
that is sent on the link.
"""

from __future__ import annotations

import math
import re
import select
import socket
import time
from bisect import bisect_left
from collections import Counter, deque
from typing import Any, NamedTuple

from mavlink_sim.wire.endpoint import Address, UdpEndpoint
from mavlink_sim.wire.messages import Outgoing, dialect, parser
from vision.attitude import Quaternion, quaternion_from_euler, slerp

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


Vector = tuple[float, float, float]

KEPT_S = 3.0
"""Poses older than this are dropped."""
RESTART_S = 1.0
"""A clock that goes back by more than this indicates a restart of the vehicle."""
CLOCK_WINDOW_S = 2.0
"""The smallest delay of the last one to two of these windows is used: long enough to contain an undelayed
message, short enough to follow a simulation that runs a little slower than real time."""
QUATERNION_LOST_S = 1.0
"""Without ATTITUDE_QUATERNION for this time ATTITUDE is used."""
EARTH_RADIUS_M = 6_371_000.0
MESSAGES = ("ATTITUDE_QUATERNION", "ATTITUDE", "LOCAL_POSITION_NED", "HIL_STATE_QUATERNION")


class Pose(NamedTuple):
    """Position and velocity NED (m, m/s), and the (w, x, y, z) quaternion of `ned_from_body`."""

    position: Vector
    velocity: Vector
    attitude: Quaternion


class BootClock:
    """The vehicle's time since boot on CLOCK_MONOTONIC, from the message with the least delay.

    The error is that smallest delay: below a millisecond on one host.
    """

    def __init__(self) -> None:
        self._window_start_ns: int | None = None
        self._before_ns: int | None = None
        self._offset_ns: int | None = None

    def add(self, boot_ns: int, arrived_ns: int) -> None:
        """Add a message of time `boot_ns` that arrived at `arrived_ns` (CLOCK_MONOTONIC)."""
        offset_ns = arrived_ns - boot_ns
        if self._window_start_ns is None or arrived_ns - self._window_start_ns >= CLOCK_WINDOW_S * 1e9:
            self._window_start_ns = arrived_ns
            self._before_ns, self._offset_ns = self._offset_ns, offset_ns
        elif self._offset_ns is None or offset_ns < self._offset_ns:
            self._offset_ns = offset_ns

    def monotonic_ns(self, boot_ns: int) -> int:
        """CLOCK_MONOTONIC nanoseconds at a time since boot. Raises ValueError before the first message."""
        known = [offset for offset in (self._before_ns, self._offset_ns) if offset is not None]
        if not known:
            raise ValueError("no message with the vehicle's time received")
        return boot_ns + min(known)


class _Track:
    """Values by time, oldest first."""

    def __init__(self) -> None:
        self.stamps_ns: deque[int] = deque()
        self.values: deque[tuple[float, ...]] = deque()

    def add(self, stamp_ns: int, value: tuple[float, ...]) -> None:
        if self.stamps_ns and stamp_ns <= self.stamps_ns[-1]:
            return  # a duplicate, or out of order
        self.stamps_ns.append(stamp_ns)
        self.values.append(value)
        while stamp_ns - self.stamps_ns[0] > KEPT_S * 1e9:
            self.stamps_ns.popleft()
            self.values.popleft()

    def around(self, stamp_ns: int) -> tuple[tuple[float, ...], tuple[float, ...], float]:
        """The values before and after a time within the track, and the fraction between them, 0..1."""
        after = bisect_left(self.stamps_ns, stamp_ns)
        if self.stamps_ns[after] == stamp_ns:
            return self.values[after], self.values[after], 0.0
        start_ns, end_ns = self.stamps_ns[after - 1], self.stamps_ns[after]
        return self.values[after - 1], self.values[after], (stamp_ns - start_ns) / (end_ns - start_ns)


class PoseHistory:
    """The last seconds of one vehicle's pose.

    Attributes:
        truth: the poses are a simulator's truth, not the estimate of the autopilot.
    """

    def __init__(self) -> None:
        self.truth = False
        self._fix: tuple[int, int, int] | None = None
        self._restart()

    def _restart(self) -> None:
        self._clock = BootClock()
        self._attitudes, self._motions = _Track(), _Track()
        self._quaternion_ns: int | None = None
        self._newest_ns: int | None = None

    def add(self, message: Any, arrived_ns: int) -> None:
        """Add a message of the vehicle, of any kind, received at CLOCK_MONOTONIC nanoseconds."""
        kind = message.get_type()
        if kind not in MESSAGES or (self.truth and kind != "HIL_STATE_QUATERNION"):
            return
        if kind == "HIL_STATE_QUATERNION":
            if not self.truth:
                self.truth = True
                self._restart()
            # PX4 leaves its time at zero: then the time of arrival is used.
            stamp_ns = message.time_usec * 1000 or arrived_ns
        else:
            stamp_ns = message.time_boot_ms * 1_000_000
        values = _values_of(message)
        if not all(map(math.isfinite, values)):
            return
        if self._newest_ns is not None and stamp_ns < self._newest_ns - RESTART_S * 1e9:
            self._restart()
        self._newest_ns = max(stamp_ns, self._newest_ns or stamp_ns)
        self._clock.add(stamp_ns, arrived_ns)
        if kind == "LOCAL_POSITION_NED":
            self._motions.add(stamp_ns, values)
        elif kind == "ATTITUDE_QUATERNION":
            self._quaternion_ns = arrived_ns
            self._add_attitude(stamp_ns, values)
        elif kind == "ATTITUDE":
            if self._quaternion_ns is None or arrived_ns - self._quaternion_ns > QUATERNION_LOST_S * 1e9:
                self._add_attitude(stamp_ns, quaternion_from_euler(*values))
        else:
            self._add_attitude(stamp_ns, values)
            self._motions.add(stamp_ns, self._local(message))

    def _add_attitude(self, stamp_ns: int, values: tuple[float, ...]) -> None:
        if any(values):  # all zeros are no rotation
            self._attitudes.add(stamp_ns, values)

    def _local(self, message: Any) -> tuple[float, ...]:
        """Position NED in metres from the first fix, on a sphere; velocity NED in m/s."""
        if self._fix is None:
            self._fix = (message.lat, message.lon, message.alt)
        lat, lon, alt_mm = self._fix
        per_unit_m = math.radians(1e-7) * EARTH_RADIUS_M
        return (
            (message.lat - lat) * per_unit_m,
            (message.lon - lon) * per_unit_m * math.cos(math.radians(lat * 1e-7)),
            (alt_mm - message.alt) / 1000.0,
            message.vx / 100.0,
            message.vy / 100.0,
            message.vz / 100.0,
        )

    @property
    def missing(self) -> tuple[str, ...]:
        """The messages still missing for a pose."""
        attitude = () if self._attitudes.stamps_ns else ("ATTITUDE_QUATERNION",)
        return attitude + (() if self._motions.stamps_ns else ("LOCAL_POSITION_NED",))

    @property
    def span_ns(self) -> tuple[int, int] | None:
        """The interval, by the vehicle's clock, in which its pose is known; None: none."""
        tracks = self._attitudes.stamps_ns, self._motions.stamps_ns
        if not all(tracks):
            return None
        start_ns, end_ns = max(track[0] for track in tracks), min(track[-1] for track in tracks)
        return (start_ns, end_ns) if start_ns <= end_ns else None

    def at(self, boot_ns: int) -> Pose:
        """The pose at a time within `span_ns`: position linear, attitude along the shorter arc (slerp)."""
        first, second, share = self._attitudes.around(boot_ns)
        attitude = slerp(_quaternion(first), _quaternion(second), share)
        before, after, share = self._motions.around(boot_ns)
        n, e, d, vn, ve, vd = (p + (q - p) * share for p, q in zip(before, after, strict=True))
        return Pose((n, e, d), (vn, ve, vd), attitude)

    def monotonic_ns(self, boot_ns: int) -> int:
        """CLOCK_MONOTONIC nanoseconds at a time of the vehicle's clock."""
        return self._clock.monotonic_ns(boot_ns)


def _quaternion(values: tuple[float, ...]) -> Quaternion:
    w, x, y, z = values
    return w, x, y, z


def _values_of(message: Any) -> tuple[float, ...]:
    match message.get_type():
        case "ATTITUDE_QUATERNION":
            return (message.q1, message.q2, message.q3, message.q4)
        case "ATTITUDE":
            return (message.roll, message.pitch, message.yaw)
        case "LOCAL_POSITION_NED":
            return (message.x, message.y, message.z, message.vx, message.vy, message.vz)
        case _:
            return tuple(message.attitude_quaternion)
