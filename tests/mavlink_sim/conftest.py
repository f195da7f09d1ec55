"""A harness for the vehicle in lockstep: send messages, advance time, read the answers."""

from __future__ import annotations

import gc
import math
import pickle
from collections import defaultdict
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, ClassVar

import pytest

from mavlink_sim.physics.geography import LocalFrame
from mavlink_sim.vehicles.vehicle import STEP_S, Vehicle
from mavlink_sim.wire import setpoints
from mavlink_sim.wire.messages import dialect
from mavlink_sim.wire.streams import GCS_RATES_HZ, ONBOARD_RATES_HZ

NAN = math.nan
COMPANION = (1, 191)
GROUND_STATION = (245, 190)
# Building these messages, up to a hundred of each per second, is most of a flight in lockstep. A test names
# those that it reads: `@pytest.mark.streams("ATTITUDE")`, `streams("everything")`.
FAST_HZ = 5.0
FAST_STREAMS = {
    name
    for rates_hz in (ONBOARD_RATES_HZ, GCS_RATES_HZ)
    for name, rate_hz in rates_hz.items()
    if rate_hz > FAST_HZ
}
EVERYTHING = "everything"
SIH_FRAME = LocalFrame()
SMALL = """
[ground]
kinds = ["concrete"]
tile_texels = 256
texel_m = 0.05
[camera]
width = 160
height = 120
"""
# RC_MAP_* of the usual order of channels; a vehicle without calibration has none, and ignores the sticks.
CALIBRATION: dict[str, float] = {
    "RC_MAP_ROLL": 1,
    "RC_MAP_PITCH": 2,
    "RC_MAP_THROTTLE": 3,
    "RC_MAP_YAW": 4,
    "RC_MAP_FLTMODE": 5,
    "RC_MAP_KILL_SW": 6,
    "RC_MAP_RETURN_SW": 7,
}


class SimHarness:
    """A vehicle with an onboard and a ground-station link, without sockets and without a clock.

    Args:
        streams: the fast streams that are not switched off at the start, or everything.
    """

    # Most tests begin ready or in the air: a vehicle with default options gets there once and is copied
    # afterwards.
    _stored: ClassVar[dict[str, tuple[bytes, dict[str, list[tuple[float, Any]]]]]] = {}

    def __init__(self, streams: Collection[str] = (), **options: Any) -> None:
        if unknown := set(streams) - FAST_STREAMS - {EVERYTHING}:
            raise ValueError(f"no fast streams: {sorted(unknown)}; there are {sorted(FAST_STREAMS)}")
        self._switched_off = set() if EVERYTHING in streams else FAST_STREAMS - set(streams)
        self._options = {"gusts_mps": 0.0, "noise": False, **options}
        self._vehicle: Vehicle | None = None
        self._events: list[str] = []
        self._inbox: dict[str, list[tuple[float, Any]]] = defaultdict(list)
        self.heartbeats: list[tuple[str, tuple[int, int], int]] = []
        self._next_heartbeat_s = 0.0

    @property
    def vehicle(self) -> Vehicle:
        return self._made()

    @property
    def events(self) -> list[str]:
        self._made()  # a list that a test keeps must be the one that is filled
        return self._events

    def _made(self) -> Vehicle:
        if self._vehicle is None:
            self._vehicle = Vehicle(on_event=self._events.append, **self._options)
            self._vehicle.add_link("onboard")
            self._vehicle.add_link("gcs", GCS_RATES_HZ)
            for link in self._vehicle.links.values():
                for name in self._switched_off:
                    if name in link.streams:
                        link.streams.set_interval(name, -1, 0)
        return self._vehicle

    # ---- time

    @property
    def now_s(self) -> float:
        return self.vehicle.now_s

    def fly(self, seconds: float, setpoint: Any = None, rate_hz: float = 20.0) -> None:
        """Advance time, sending `setpoint` at a rate and the enabled heartbeats."""
        self.until(lambda: False, seconds, setpoint, rate_hz, must=False)

    def until(
        self,
        condition: Callable[[], bool],
        limit_s: float = 60.0,
        setpoint: Any = None,
        rate_hz: float = 20.0,
        must: bool = True,
    ) -> float:
        """Advance time until `condition`; returns the duration."""
        vehicle = self.vehicle
        clock = vehicle.faults  # it goes on through a reboot
        started = clock.now_s
        next_setpoint = started
        while clock.now_s - started < limit_s - STEP_S / 2:
            if self.heartbeats and clock.now_s >= self._next_heartbeat_s:
                self._next_heartbeat_s = clock.now_s + 1.0
                for link, source, kind in self.heartbeats:
                    self.send(dialect.MAVLink_heartbeat_message(kind, 8, 0, 0, 4, 3), link, source)
            if setpoint is not None and clock.now_s >= next_setpoint - 1e-9:
                next_setpoint += 1.0 / rate_hz
                self.send(setpoint)
            vehicle.step(STEP_S)
            self._take()
            if condition():
                return clock.now_s - started
        if must:
            raise AssertionError(f"not within {limit_s} s; mode {self.mode}, events {self.events}")
        return limit_s

    def _take(self) -> None:
        vehicle = self.vehicle
        for name, link in vehicle.links.items():
            if link.outbox:
                now_s = vehicle.now_s
                self._inbox[name] += [(now_s, item) for item in vehicle.outgoing(name)]

    # ---- messages

    def send(self, message: Any, link: str = "onboard", source: tuple[int, int] = COMPANION) -> None:
        header = message.get_header()
        header.srcSystem, header.srcComponent = source
        self.vehicle.handle(link, message)
        self._take()

    def received(self, kind: str, link: str = "onboard") -> list[Any]:
        if kind in self._switched_off:
            raise LookupError(
                f'{kind} is not received: mark the test with streams("{kind}"), or SimHarness(["{kind}"])'
            )
        return [item.message for _, item in self._inbox[link] if item.message.get_type() == kind]

    @property
    def inbox(self) -> dict[str, list[tuple[float, Any]]]:
        """Every message received on each link since the last `forget`, as (time, message)."""
        if self._switched_off:
            raise LookupError('mark the test with streams("everything"), or SimHarness(EVERYTHING) so')
        return self._inbox

    def forget(self) -> None:
        self._inbox.clear()

    def command(
        self,
        command: int,
        *values: float,
        target: tuple[int, int] = (1, 1),
        source: tuple[int, int] = COMPANION,
        link: str = "onboard",
    ) -> list[int]:
        """Send COMMAND_LONG; the MAV_RESULTs of every COMMAND_ACK to it within 40 ms."""
        padded = (*values, *([0.0] * (7 - len(values))))
        return self._answers(
            dialect.MAVLink_command_long_message(*target, command, 0, *padded), command, source, link
        )

    def command_int(
        self, command: int, values: tuple[float, ...], x: int, y: int, z: float, frame: int = 5
    ) -> list[int]:
        message = dialect.MAVLink_command_int_message(1, 1, frame, command, 0, 0, *values, x, y, z)
        return self._answers(message, command, COMPANION, "onboard")

    def _answers(self, message: Any, command: int, source: tuple[int, int], link: str) -> list[int]:
        before = len(self.received("COMMAND_ACK", link))
        self.send(message, link, source)
        self.fly(0.04)
        answers = self.received("COMMAND_ACK", link)[before:]
        assert all((answer.target_system, answer.target_component) == source for answer in answers)
        assert all(answer.command == command and answer.progress == 0 for answer in answers)
        return [answer.result for answer in answers]

    def set_mode(self, main: int, sub: int = 0, base: int = 1, **options: Any) -> list[int]:
        return self.command(176, base, main, sub, **options)

    def heartbeat(self) -> Any:
        """The next HEARTBEAT of the vehicle."""
        self.forget()
        self.until(lambda: bool(self.received("HEARTBEAT")), 1.1)
        return self.received("HEARTBEAT")[-1]

    def texts(self, link: str = "gcs") -> list[str]:
        """The received STATUSTEXTs, with their chunks joined."""
        whole: list[str] = []
        for message in self.received("STATUSTEXT", link):
            text = message.text.decode() if isinstance(message.text, bytes) else message.text
            text = text.rstrip("\0")
            if message.id and message.chunk_seq:
                whole[-1] += text
            else:
                whole.append(text)
        return whole

    # ---- flying

    @property
    def mode(self) -> str:
        return self.vehicle.autopilot.mode.name

    @property
    def armed(self) -> bool:
        return self.vehicle.autopilot.armed

    @property
    def height_m(self) -> float:
        return -self.vehicle.airframe.position[2]

    def wait_ready(self) -> None:
        self._once("ready", lambda: self.until(lambda: self.vehicle.autopilot.can_arm, 10.0))

    def take_off(self, height_m: float | None = None) -> None:
        """Arm, take off, wait for HOLD and a short time more."""
        self._once(f"at {height_m} m", lambda: self._fly_up(height_m))

    def _once(self, what: str, get_there: Callable[[], object]) -> None:
        """Get there, or copy the vehicle with the same options that got there before."""
        plain = all(isinstance(value, (str, int, float, tuple, dict)) for value in self._options.values())
        if self._vehicle is not None or self.heartbeats or not plain:
            get_there()
            return
        key = repr((sorted(self._options.items()), sorted(self._switched_off), what))
        if key not in self._stored:
            get_there()
            inbox = {link: list(messages) for link, messages in self._inbox.items()}
            self._stored[key] = (pickle.dumps((self._vehicle, self._events)), inbox)
            gc.collect()
            gc.freeze()  # thousands of permanent messages: excluded from garbage collection
        stored, inbox = self._stored[key]
        self._vehicle, self._events = pickle.loads(stored)
        self._inbox = defaultdict(list, {link: list(messages) for link, messages in inbox.items()})

    def _fly_up(self, height_m: float | None) -> None:
        self.wait_ready()
        assert self.command(400, 1) == [0]
        altitude = NAN if height_m is None else 489.4 + height_m
        assert self.command(22, NAN, 0, 0, NAN, NAN, NAN, altitude) == [0]
        self.until(lambda: self.mode == "HOLD")
        self.fly(4.0)

    def offboard(self, setpoint: Any) -> None:
        """Switch to OFFBOARD with a stream of this setpoint."""
        self.fly(0.2, setpoint)
        twice = self.vehicle.release.acknowledges_modes_twice
        assert self.set_mode(6) == [0] * (2 if twice else 1)
        self.fly(0.1, setpoint)
        assert self.mode == "OFFBOARD"


def velocity_setpoint(
    forward: float, right: float, down: float, yaw_rate: float = 0.0, frame: int = 8
) -> Any:
    """A velocity setpoint as in the flight recorded from a real vehicle (type mask 1479)."""
    return dialect.MAVLink_set_position_target_local_ned_message(
        0, 1, 1, frame, 1479, 0, 0, 0, forward, right, down, 0, 0, 0, 0, yaw_rate
    )


def position_setpoint(north: float, east: float, down: float, yaw: float = 0.0) -> Any:
    """A position setpoint in LOCAL_NED, with a heading."""
    return setpoints.position_setpoint(north, east, down, yaw)


@pytest.fixture
def harness(request: pytest.FixtureRequest) -> SimHarness:
    """A vehicle in still air, on the ground, just booted."""
    marker = request.node.get_closest_marker("streams")
    return SimHarness(streams=() if marker is None else marker.args)


@pytest.fixture
def small(tmp_path: Path) -> str:
    """A scene that is made and rendered quickly."""
    path = tmp_path / "small.toml"
    path.write_text(SMALL)
    return str(path)
