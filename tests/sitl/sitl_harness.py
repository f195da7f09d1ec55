"""A service as a process of its own before a real or simulated autopilot, and what both of them send.

`AutopilotLink` listens where the service would, passes on every byte, records both sides on one clock, cuts
the link, and sends what a pilot at a ground station sends.
World frame: the autopilot's local NED.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import select
import socket
import struct
import threading
import time
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import pytest
import zenoh

from companion.bus.client import listen, send_command
from companion.vehicle.link_url import LinkScheme, LinkUrl
from mavlink_sim.camera.autopilot_link import AutopilotLink as TruthLink
from mavlink_sim.camera.vehicle_pose import Pose as TruePose
from mavlink_sim.camera.vehicle_pose import PoseHistory
from mavlink_sim.testing import free_port
from mavlink_sim.wire.messages import dialect
from tests.companion.service_process import ServiceProcess

PX4, ARDUPILOT = dialect.MAV_AUTOPILOT_PX4, dialect.MAV_AUTOPILOT_ARDUPILOTMEGA
NAMES = {PX4: "PX4", ARDUPILOT: "ArduPilot"}
PILOT = (245, 190)
OFFBOARD = {PX4: 6 << 16, ARDUPILOT: 4}
HOLD = {PX4: 4 << 16 | 3 << 24, ARDUPILOT: 17}  # ArduPilot's BRAKE
PARKED = {PX4: HOLD[PX4], ARDUPILOT: 0}  # disarmed: PX4 is never ready in LAND, ArduPilot boots in STABILIZE
LAND = {PX4: 4 << 16 | 6 << 24, ARDUPILOT: 9}
NAMED_BY = "CURRENT_MODE, by which a failsafe is distinguished from a pilot's change of mode,"
STANDING_MPS = 0.3
SIGNING_EPOCH_S, SIGNING_MINUTE = 1_420_070_400, 6_000_000  # 2015-01-01, and units of 10 us from then on
PREARM_CHECK = dialect.MAV_SYS_STATUS_PREARM_CHECK
_ARMED = dialect.MAV_MODE_FLAG_SAFETY_ARMED
_DOWN = (dialect.MAV_LANDED_STATE_ON_GROUND, dialect.MAV_LANDED_STATE_UNDEFINED)
_ANSWER_S = 3.0
READY_S, GROUNDED_S = 180.0, 120.0
SILENT_S = 1.0
# A rebooting autopilot closes its TCP port for seconds.
CONNECT_S, RECONNECT_S, RECONNECT_EVERY_S = 10.0, 60.0, 0.2
ORBIT_M, ORBIT_MPS = 10.0, 2.8
# A shell command that restarts a simulated autopilot that refuses to reboot, as PX4's does.
RESTART = "COMPANION_SITL_RESTART"
# The port of a simulation's true pose, HIL_STATE_QUATERNION.
TRUTH_URL = "COMPANION_SITL_TRUTH_URL"
# Measured: by autopilot and driver, by what was flown.
FIGURES: dict[str, dict[str, dict[str, float | None]]] = {}


@dataclass(frozen=True, slots=True)
class Pose:
    """One LOCAL_POSITION_NED. `time_s`: CLOCK_MONOTONIC of its arrival."""

    time_s: float
    position_ned_m: tuple[float, float, float]
    velocity_ned_mps: tuple[float, float, float]
    yaw_rad: float

    @property
    def speed_mps(self) -> float:
        """Over ground."""
        return math.hypot(*self.velocity_ned_mps[:2])


class AutopilotLink:
    """One autopilot, and the port at which the service finds it.

    Attributes:
        service_port: the service listens there. address: where the autopilot's messages arrive.
        camera_port: a rendered camera listens there; None: none.
        cut: nothing is passed on while it is true; what the autopilot sends is still recorded.
        uplink_deaf: what the service sends is not passed on while it is true; it is still recorded.
        autopilot, vehicle_type, system_id: MAV_AUTOPILOT and MAV_TYPE of its heartbeat, and who sent it; None
            and 0 before.
        version: major and minor of its AUTOPILOT_VERSION; (0, 0) before.
        modes: (time_s, custom_mode) of every change.
        poses, setpoints_s: everything since the start; when each setpoint of the service came.
        commands: time and number of each COMMAND_LONG of the service.
        visions: capture time, north and east of each VISION_POSITION_ESTIMATE of the service.
        texts: STATUSTEXT of the autopilot. results: the newest MAV_RESULT of each command, whoever gave it.
        home_ned_m: of its newest HOME_POSITION. global_deg: latitude and longitude of its newest position.
        boots: how often its clock has begun again.
        other_senders: other addresses from which datagrams came; those are dropped.
        signed: its newest message bears a signature.
        attitude_rad: its newest roll, pitch and yaw.
        parameters: the newest value and MAV_PARAM_TYPE of each, whoever asked for it.
        sticks: the first four channels of its newest RC_CHANNELS.
    """

    def __init__(self, url: LinkUrl) -> None:
        self.service_port, self.address = free_port(), url.address
        self.camera_port: int | None = None
        self.cut = self.uplink_deaf = False
        self.autopilot: int | None = None
        self.system_id = self.vehicle_type = 0
        self.version = (0, 0)
        self.modes: list[tuple[float, int]] = []
        self.poses: list[Pose] = []
        self.setpoints_s: list[float] = []
        self.commands: list[tuple[float, int]] = []
        self.visions: list[tuple[float, float, float]] = []
        self.texts: list[str] = []
        self.results: dict[int, int] = {}
        self.armed = self.ready = False
        self.landed = dialect.MAV_LANDED_STATE_UNDEFINED
        self.boots = 0
        self.other_senders: set[tuple[str, int]] = set()
        self.signed = False
        self.home_ned_m = (0.0, 0.0, 0.0)
        self.global_deg = (math.nan, math.nan)
        self._heartbeat_s = -math.inf
        self._boot_ms = 0
        self._yaw_rad = math.nan
        self.attitude_rad = (0.0, 0.0, 0.0)
        self.sticks: tuple[int, ...] = ()
        self.parameters: dict[str, tuple[float, int]] = {}
        self._ftp_reply, self._shell_said = b"", ""
        self._changed = threading.Condition()
        self._peer: tuple[str, int] | None = None
        self._peer_s = -math.inf
        self._lost_s: float | None = None
        if url.scheme is LinkScheme.UDP_IN:
            self._far = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
            self._far.bind(url.address)
        elif url.scheme is LinkScheme.TCP:
            self._far = socket.create_connection(url.address, CONNECT_S)
        else:
            raise ValueError(f"COMPANION_SITL_URL={url}: expected udpin://HOST:PORT or tcp://HOST:PORT")
        self._near = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._near.bind(("127.0.0.1", 0))
        self._pilot = dialect.MAVLink(None, *PILOT)
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._run, name="autopilot-link", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread, then the sockets."""
        self._closing.set()
        self._thread.join(5.0)
        self._far.close()
        self._near.close()

    # --- what is waited for ------------------------------------------------------------------------------

    def until(self, condition: Callable[[], object], timeout_s: float, what: str) -> float:
        """Wait; returns how many seconds it took. Raises TimeoutError with `what` and the newest words."""
        since_s = time.monotonic()
        with self._changed:
            if not self._changed.wait_for(condition, timeout_s):
                raise TimeoutError(f"not {what} within {timeout_s:g} s; the autopilot said {self.texts[-5:]}")
        return time.monotonic() - since_s

    def after(self, seconds: float) -> None:
        """Record for so long."""
        with self._changed:
            self._changed.wait_for(lambda: False, seconds)

    def read_version(self) -> None:
        """Request AUTOPILOT_VERSION until it is received."""
        until_s = time.monotonic() + READY_S
        while self.version == (0, 0):
            self.command(dialect.MAV_CMD_REQUEST_MESSAGE, dialect.MAVLINK_MSG_ID_AUTOPILOT_VERSION)
            self.after(_ANSWER_S / 3)
            if time.monotonic() > until_s:
                raise TimeoutError(f"no AUTOPILOT_VERSION within {READY_S:g} s")

    @property
    def name(self) -> str:
        """Of the autopilot, with its version."""
        return f"{NAMES[self.autopilot or 0]} {self.version[0]}.{self.version[1]}"

    @property
    def connected(self) -> bool:
        """A heartbeat of the autopilot is no older than 3 s."""
        return time.monotonic() - self._heartbeat_s <= 3.0

    @property
    def offboard(self) -> bool:
        """It shows OFFBOARD (GUIDED)."""
        return (
            bool(self.modes) and self.autopilot is not None and self.modes[-1][1] == OFFBOARD[self.autopilot]
        )

    @property
    def grounded(self) -> bool:
        """Landed (if it reports that) and disarmed."""
        return not self.armed and self.landed in _DOWN

    @property
    def height_m(self) -> float:
        """Above home."""
        return self.home_ned_m[2] - self.poses[-1].position_ned_m[2]

    def trajectory(self, since_s: float, until_s: float = math.inf) -> list[Pose]:
        """The poses of that time."""
        first = bisect_left(self.poses, since_s, key=lambda pose: pose.time_s)
        return self.poses[first : bisect_right(self.poses, until_s, key=lambda pose: pose.time_s)]

    def left_offboard_s(self, since_s: float) -> float | None:
        """How long after a moment another mode was shown."""
        left = [
            at - since_s for at, mode in self.modes if at >= since_s and mode != OFFBOARD[self.autopilot or 0]
        ]
        return left[0] if left else None

    # --- a pilot at a ground station ----------------------------------------------------------------------

    def send(self, message: Any, component: int | None = None) -> None:
        """Put one message on the autopilot's link, from 245/190, or from a component of its own system."""
        if component is not None:
            self._to_autopilot(message.pack(dialect.MAVLink(None, self.system_id, component)))
            return
        self._pilot.signing.timestamp = max(self._pilot.signing.timestamp, signing_time())
        self._to_autopilot(message.pack(self._pilot))
        self._pilot.seq = (self._pilot.seq + 1) % 256

    def shell(self, line: str) -> None:
        """Have PX4's shell run a line. Skips where there is none."""
        data = f"{line}\n".encode()
        flags = dialect.SERIAL_CONTROL_FLAG_RESPOND | dialect.SERIAL_CONTROL_FLAG_EXCLUSIVE
        padded = [*data.ljust(70, b"\0")]
        shell, self._shell_said = dialect.SERIAL_CONTROL_DEV_SHELL, ""
        self.send(dialect.MAVLink_serial_control_message(shell, flags, 0, 0, len(data), padded))
        try:
            self.until(lambda: line in self._shell_said, _ANSWER_S, f"answered to {line}")
        except TimeoutError:
            pytest.skip(f"the autopilot has no shell for {line!r}")

    def write_file(self, path: str, content: bytes) -> None:
        """Replace a file of the autopilot by MAVLink FTP, with at most 239 bytes."""
        for sequence, opcode, data in (
            (1, dialect.MAV_FTP_OPCODE_CREATEFILE, path.encode()),
            (3, dialect.MAV_FTP_OPCODE_WRITEFILE, content),
            (5, dialect.MAV_FTP_OPCODE_TERMINATESESSION, b""),
        ):
            self._ftp_reply = b""
            payload = bytes([sequence, 0, 0, opcode, len(data), 0, 0, 0, 0, 0, 0, 0]) + data
            padded = [*payload.ljust(251, b"\0")]
            self.send(dialect.MAVLink_file_transfer_protocol_message(0, self.system_id, 1, padded))
            self.until(lambda: self._ftp_reply, _ANSWER_S, f"answered for {path}")
            assert self._ftp_reply[3] == dialect.MAV_FTP_OPCODE_ACK, self._ftp_reply[:16]

    def set_up_signing(self, key: bytes | None) -> None:
        """As a ground station does: the autopilot signs with this key from now on, and so does the pilot.

        Args:
            key: 32 bytes; None ends it.
        """
        # Copter counts from a minute after what it is given, and refuses what is older than a minute.
        since = 0 if key is None else signing_time() - SIGNING_MINUTE
        secret = bytes(32) if key is None else key
        self.send(dialect.MAVLink_setup_signing_message(self.system_id, 1, [*secret], since))
        self.sign_with(key)

    def sign_with(self, key: bytes | None) -> None:
        """The pilot signs from now on. None: not any more."""
        signing = self._pilot.signing
        signing.secret_key, signing.sign_outgoing = key, key is not None

    def command(self, number: int, *parameters: float) -> None:
        """One COMMAND_LONG; what it does is seen, not what it answers."""
        seven = (*parameters, *[0.0] * (7 - len(parameters)))
        self.send(dialect.MAVLink_command_long_message(self.system_id, 1, number, 0, *seven))

    def set_mode(self, custom_mode: int) -> None:
        """By DO_SET_MODE, as a ground station does."""
        if self.autopilot == PX4:
            self.command(176, 1, (custom_mode >> 16) & 0xFF, custom_mode >> 24)
        else:
            self.command(176, 1, custom_mode)

    def parameter(self, name: str) -> float | None:
        """Its value; None: there is none of that name."""
        self.parameters.pop(name, None)
        self.send(dialect.MAVLink_param_request_read_message(self.system_id, 1, name.encode(), -1))
        try:
            self.until(lambda: name in self.parameters, _ANSWER_S, f"answered for {name}")
        except TimeoutError:
            return None
        return self.parameters[name][0]

    def set_parameter(self, name: str, value: float) -> None:
        """Set one that `parameter` has read, and wait for its echo."""
        kind = self.parameters[name][1]
        wire = value
        if self.autopilot == PX4 and kind != dialect.MAV_PARAM_TYPE_REAL32:
            (wire,) = struct.unpack("<f", struct.pack("<i", round(value)))
        self.send(dialect.MAVLink_param_set_message(self.system_id, 1, name.encode(), wire, kind))
        self.until(
            lambda: math.isclose(self.parameters[name][0], value, rel_tol=1e-6), _ANSWER_S, f"{name} set"
        )

    # --- the thread ---------------------------------------------------------------------------------------

    def _run(self) -> None:
        from_autopilot, from_service = dialect.MAVLink(None), dialect.MAVLink(None)
        from_autopilot.robust_parsing = from_service.robust_parsing = True
        while not self._closing.is_set():
            open_sockets = [self._near] if self._lost_s is not None else [self._far, self._near]
            received = select.select(open_sockets, [], [], RECONNECT_EVERY_S)[0]
            if self._lost_s is not None and time.monotonic() - self._lost_s < RECONNECT_S:
                self._reconnect()
            for ready in received:
                try:
                    data, sender = ready.recvfrom(65536)
                except ConnectionError:
                    data, sender = b"", None
                if not data and ready is self._far and ready.type is socket.SOCK_STREAM:
                    self._lost_s = time.monotonic()
                    continue
                if ready is self._near:
                    sent = from_service.parse_buffer(data) or []
                    now_s = time.monotonic()
                    self.setpoints_s += [now_s for message in sent if message.get_msgId() == 84]
                    self.commands += [
                        (now_s, message.command) for message in sent if message.get_type() == "COMMAND_LONG"
                    ]
                    self.visions += [
                        (message.usec / 1e6, message.x, message.y)
                        for message in sent
                        if message.get_type() == "VISION_POSITION_ESTIMATE"
                    ]
                    if not (self.cut or self.uplink_deaf):
                        self._to_autopilot(data)
                    continue
                if not self._from_peer(sender):
                    with self._changed:
                        self._changed.notify_all()
                    continue
                if not self.cut:
                    for port in (self.service_port, self.camera_port):
                        if port is not None:
                            self._near.sendto(data, ("127.0.0.1", port))
                messages = from_autopilot.parse_buffer(data) or []
                with self._changed:
                    for message in messages:
                        if message.get_srcComponent() == 1 and self.system_id in (0, message.get_srcSystem()):
                            self._note(message, time.monotonic())
                    self._changed.notify_all()

    def _from_peer(self, sender: tuple[str, int] | None) -> bool:
        """Whether the one autopilot sent it. A restarted one may have another address."""
        now_s = time.monotonic()
        if sender not in (None, self._peer):
            if now_s - self._peer_s < SILENT_S:
                assert sender is not None
                self.other_senders.add(sender)
                return False
            self._peer = sender
            self.other_senders.discard(sender)
        self._peer_s = now_s
        return True

    def _reconnect(self) -> None:
        """Try once to connect again to an autopilot that has closed its TCP port."""
        with contextlib.suppress(OSError):
            connected = socket.create_connection(self.address, RECONNECT_EVERY_S)
            connected.settimeout(CONNECT_S)
            lost, self._far, self._lost_s = self._far, connected, None
            lost.close()

    def _to_autopilot(self, data: bytes) -> None:
        if self._far.type is socket.SOCK_STREAM:
            with contextlib.suppress(OSError):  # closed: reading notices it too
                self._far.sendall(data)
        elif self._peer is not None:
            self._far.sendto(data, self._peer)

    def _note(self, message: Any, now_s: float) -> None:
        self.signed = bool(message.get_header().incompat_flags & dialect.MAVLINK_IFLAG_SIGNED)
        match message.get_type():
            case "HEARTBEAT":
                self._heartbeat_s = now_s
                self.autopilot, self.system_id = message.autopilot, message.get_srcSystem()
                self.vehicle_type = message.type
                self.armed = bool(message.base_mode & _ARMED)
                self._note_mode(message.custom_mode, now_s)
            case "AUTOPILOT_VERSION":
                self.version = (message.flight_sw_version >> 24, message.flight_sw_version >> 16 & 0xFF)
            case "CURRENT_MODE":
                self._note_mode(message.custom_mode, now_s)
            case "SYS_STATUS":
                self.ready = bool(message.onboard_control_sensors_health & PREARM_CHECK)
            case "EXTENDED_SYS_STATE":
                self.landed = message.landed_state
            case "HOME_POSITION":
                self.home_ned_m = (message.x, message.y, message.z)
            case "ATTITUDE_QUATERNION":
                w, x, y, z = message.q1, message.q2, message.q3, message.q4
                self._yaw_rad = math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
                roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
                pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
                self.attitude_rad = (roll, pitch, self._yaw_rad)
            case "LOCAL_POSITION_NED":
                self.boots += message.time_boot_ms + 1000 < self._boot_ms
                self._boot_ms = message.time_boot_ms
                place, velocity = (message.x, message.y, message.z), (message.vx, message.vy, message.vz)
                self.poses.append(Pose(now_s, place, velocity, self._yaw_rad))
            case "GLOBAL_POSITION_INT":
                self.global_deg = (message.lat * 1e-7, message.lon * 1e-7)
            case "RC_CHANNELS":
                self.sticks = (message.chan1_raw, message.chan2_raw, message.chan3_raw, message.chan4_raw)
            case "SERIAL_CONTROL":
                self._shell_said += bytes(message.data[: message.count]).decode(errors="replace")
            case "FILE_TRANSFER_PROTOCOL":
                self._ftp_reply = bytes(message.payload)
            case "COMMAND_ACK":
                self.results[message.command] = message.result
            case "STATUSTEXT":
                self.texts.append(message.text.strip())
            case "PARAM_VALUE":
                value = message.param_value
                if self.autopilot == PX4 and message.param_type != dialect.MAV_PARAM_TYPE_REAL32:
                    (value,) = struct.unpack("<i", struct.pack("<f", value))
                self.parameters[message.param_id] = (float(value), message.param_type)

    def _note_mode(self, custom_mode: int, now_s: float) -> None:
        if not self.modes or self.modes[-1][1] != custom_mode:
            self.modes.append((now_s, custom_mode))


class Flight:
    """A service of its own process, the autopilot that it flies, and what both say.

    Attributes:
        events: texts of the topic `events`. status: the newest of the topic `status`.
    """

    def __init__(
        self, link: AutopilotLink, service: ServiceProcess, session: zenoh.Session, driver: str
    ) -> None:
        self.link, self.service, self.driver = link, service, driver
        self._session = session
        self.events: list[str] = []
        self.status: dict[str, Any] = {}
        self._subscribers = [
            listen(session, "events", lambda _, text: self.events.append(json.loads(text)["text"])),
            listen(session, "status", lambda _, text: self.status.update(json.loads(text))),
        ]

    def command(self, text: str, timeout_s: float = 120.0) -> dict[str, Any]:
        """What `companion send` does."""
        return send_command(self._session, "vehicle1", text, timeout_s=timeout_s)

    def fly(self, text: str, timeout_s: float = 120.0) -> dict[str, Any]:
        """A command that has to succeed."""
        reply = self.command(text, timeout_s)
        assert reply["success"], (reply, self.link.modes[-6:], self.link.commands[-12:])
        return reply

    def take_off(self, height_m: float) -> None:
        """Again while it is refused: estimators of real autopilots are ready when they are."""
        until_s = time.monotonic() + READY_S
        while not (reply := self.command(f"takeoff {height_m:g}"))["success"]:
            refused = " needs " in reply["reason"] or "refused" in reply["reason"]
            assert refused, reply
            assert time.monotonic() < until_s, reply
            self.link.after(1.0)
        self.link.until(lambda: self.link.height_m > height_m - 1.0, 5.0, "at its height")

    def said(self, text: str) -> Callable[[], bool]:
        """Whether an event with these words came from now on."""
        already = len(self.events)
        return lambda: any(text in event for event in self.events[already:])

    def note(self, name: str, **figures: float | None) -> None:
        """Keep measured figures for the report."""
        title = f"{self.link.name}, {self.driver}"
        rounded = {key: None if value is None else round(value, 2) for key, value in figures.items()}
        FIGURES.setdefault(title, {})[name] = rounded


def signing_time() -> int:
    """The time now in the unit of a MAVLink signature."""
    return round((time.time() - SIGNING_EPOCH_S) * 1e5)


def bring_down(link: AutopilotLink) -> None:
    """Land it as a pilot would, whatever the service does; then a mode that it can be armed in."""
    link.cut = False
    if not link.grounded:
        link.set_mode(LAND[link.autopilot or 0])
        link.until(lambda: link.grounded, GROUNDED_S, "landed and disarmed")
    parked = PARKED[link.autopilot or 0]
    link.set_mode(parked)
    # Else it is a pilot's change during the next command.
    link.until(lambda: link.modes[-1][1] == parked, _ANSWER_S, "in the mode that it can be armed in")


@contextlib.contextmanager
def repeated(period_s: float, act: Iterator[None]) -> Iterator[None]:
    """Advance an iterator again and again, in a thread."""
    ended = threading.Event()

    def run() -> None:
        while not ended.wait(period_s):
            next(act)

    thread = threading.Thread(target=run, name="repeated", daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join(5.0)


class Truth:
    """The simulation's own pose, in metres from where it began; `poses`: with CLOCK_MONOTONIC seconds."""

    def __init__(self, url: str) -> None:
        self._link, self._history = TruthLink(url, listen_only=True), PoseHistory()
        self.poses: list[tuple[float, TruePose]] = []

    def read(self) -> Iterator[None]:
        """Wait for the newest pose, and keep it."""
        while True:
            for message in self._link.receive(1.0):
                self._history.add(message, time.monotonic_ns())
            if self._history.truth and (span := self._history.span_ns):
                self.poses.append((self._history.monotonic_ns(span[1]) / 1e9, self._history.at(span[1])))
            yield

    def at(self, time_s: float) -> tuple[float, float]:
        """North and east when something else arrived."""
        pose = min(self.poses[-50:], key=lambda item: abs(item[0] - time_s))[1]
        return pose.position[0], pose.position[1]

    def close(self) -> None:
        self._link.close()


@contextlib.contextmanager
def true_poses(link: AutopilotLink) -> Iterator[Truth]:
    """The simulation's own pose, read in a thread. Skips where COMPANION_SITL_TRUTH_URL names no port."""
    if TRUTH_URL not in os.environ:
        pytest.skip(f"{TRUTH_URL} names no port with the simulation's true pose")
    truth = Truth(os.environ[TRUTH_URL])
    try:
        with repeated(0.0, truth.read()):
            link.until(lambda: truth.poses, 5.0, f"sending HIL_STATE_QUATERNION to {TRUTH_URL}")
            yield truth
    finally:
        truth.close()


def set_for_test(link: AutopilotLink, values: dict[str, float]) -> dict[str, float]:
    """Set parameters; what they were. Skips where the autopilot has no such parameter."""
    before = {}
    for name in values:
        value = link.parameter(name)
        if value is None:
            pytest.skip(f"this autopilot has no parameter {name}")
        before[name] = value
    try:
        for name, value in values.items():
            link.set_parameter(name, value)
    except TimeoutError:  # the caller does not get what to restore
        for name, value in before.items():
            link.set_parameter(name, value)
        raise
    return before


def needs_px4(link: AutopilotLink, version: tuple[int, int], what: str) -> None:
    """Skip for an older PX4, which does not have that; another autopilot is not judged."""
    if link.autopilot == PX4 and link.version < version:
        pytest.skip(f"{link.name}: {what} since PX4 {version[0]}.{version[1]}")


def command_or_skip(link: AutopilotLink, number: int, *parameters: float) -> None:
    """One COMMAND_LONG. Skips where it is not accepted, as by a built-in simulated vehicle."""
    link.results.pop(number, None)
    link.command(number, *parameters)
    link.until(lambda: number in link.results, _ANSWER_S, f"answered to command {number}")
    if link.results[number] != dialect.MAV_RESULT_ACCEPTED:
        pytest.skip(f"this autopilot does not take command {number}")


def orbiting(flight: Flight, height_m: float = 5.0) -> tuple[float, float]:
    """In the air, steadily at speed; north and east of the orbit's centre."""
    flight.take_off(height_m)
    link = flight.link
    start = link.poses[-1]
    flight.fly(f"orbit radius={ORBIT_M:g} speed={ORBIT_MPS:g}")
    link.until(lambda: link.poses[-1].speed_mps > 0.9 * ORBIT_MPS, 20.0, "at speed")
    link.after(1.0)
    north, east, _ = start.position_ned_m
    return north + ORBIT_M * math.cos(start.yaw_rad), east + ORBIT_M * math.sin(start.yaw_rad)
