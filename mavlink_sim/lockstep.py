"""A vehicle in the caller's process, stepped by the caller: no sockets, no threads, no sleeping, no clock.

>>> from mavlink_sim import LockstepVehicle
>>> vehicle = LockstepVehicle(seed=1)
>>> vehicle.take_off(5.0)                           # arms, climbs, waits for HOLD: 13 s of flight in 0.1 s
>>> vehicle.truth.position_ned_m[2] < -4.0
True

Setpoints are `set_velocity` and `set_position`. Everything else is done by MAVLink messages, as with a real
vehicle: `send` one, `step`, read what it sent.
The same seed and the same calls give the same flight and the same bytes.
"""

from __future__ import annotations

import math
import pickle
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from mavlink_sim.faults.context import FaultTarget
from mavlink_sim.vehicles.firmware import PX4, vehicle_class
from mavlink_sim.vehicles.vehicle import STEP_S
from mavlink_sim.wire.links import Link
from mavlink_sim.wire.messages import Outgoing, dialect, parser
from mavlink_sim.wire.setpoints import position_setpoint, velocity_setpoint
from mavlink_sim.wire.streams import ONBOARD_RATES_HZ

if TYPE_CHECKING:
    from mavlink_sim.physics.contact import Collision


class LockstepWire:
    """One link's wire. `codec` numbers what the vehicle packs on it."""

    def __init__(self, vehicle: FaultTarget, link: Link) -> None:
        self._vehicle = vehicle
        self._link = link
        self._stage = vehicle.faults.stage(link.name)
        self.codec = parser(vehicle.system_id)
        self._reader = parser()
        self._vehicle_reader = parser(vehicle.system_id)
        self._senders: dict[tuple[int, int], Any] = {}

    @property
    def engaged(self) -> bool:
        """A fault is on the link, or datagrams are still in transit."""
        return self._stage.inbound.engaged or self._stage.outbound.engaged

    @property
    def matters(self) -> bool:
        """Messages have to become datagrams: the link is engaged or signs."""
        return self.engaged or self._link.signing.has_key

    def outbound(self, outgoing: Iterable[Outgoing]) -> list[Outgoing]:
        """Send messages; returns those that have arrived at the client by now, corrupted ones as BAD_DATA."""
        now_s, channel, signing = self._vehicle.faults.now_s, self._stage.outbound, self._link.signing
        for item in outgoing:
            frame = item.pack(self.codec)
            channel.push(now_s, frame if item.forwarded else signing.signed(frame))
        return [
            self._sealed(message)
            for datagram, _ in channel.due(now_s)
            for message in self._reader.parse_buffer(datagram) or []
        ]

    def sealed(self, outgoing: Iterable[Outgoing]) -> list[Outgoing]:
        """The same messages as packed bytes with sequence numbers."""
        found = []
        for item in outgoing:
            if item.forwarded:
                found.append(item)
            else:
                messages = self._reader.parse_buffer(item.pack(self.codec)) or []
                found += [self._sealed(message) for message in messages]
        return found

    @staticmethod
    def _sealed(message: Any) -> Outgoing:
        return Outgoing(message, message.get_srcSystem(), message.get_srcComponent(), True)

    def send(self, message: Any, source: tuple[int, int]) -> int:
        """Send a message of a client, unsigned. Returns the number of messages delivered to the vehicle."""
        sender = self._senders.get(source)
        if sender is None:
            sender = self._senders[source] = parser(*source)
        frame = bytes(message.pack(sender))
        sender.seq = (sender.seq + 1) % 256
        return self.send_bytes(frame)

    def send_bytes(self, datagram: bytes) -> int:
        """Send a datagram of a client. Returns the number of messages delivered to the vehicle."""
        if not self._stage.inbound.engaged:
            return self._read(datagram)
        self._stage.inbound.push(self._vehicle.faults.now_s, datagram)
        return self.deliver()

    def deliver(self) -> int:
        """Deliver what has arrived by now. Returns the number of messages."""
        arrived = self._stage.inbound.due(self._vehicle.faults.now_s)
        return sum(self._read(datagram) for datagram, _ in arrived)

    def _read(self, datagram: bytes) -> int:
        count = 0
        for message in self._vehicle_reader.parse_buffer(datagram) or []:
            if message.get_type() != "BAD_DATA" and self._link.signing.accepts(bytes(message.get_msgbuf())):
                self._vehicle.handle(self._link.name, message)
                count += 1
        return count


COMPANION = (1, 191)  # MAV_COMP_ID_ONBOARD_COMPUTER
ANSWER_LIMIT_S = 1.0
SECOND_ANSWER_S = 0.04  # Commander's answer, after the receiver's
# Unread messages are kept up to this many per link: a minute of all streams.
MAX_WAITING = 50_000
_ARM_DISARM, _TAKEOFF, _LAND, _SET_MODE = 400, 22, 21, 176
SETPOINT_RATE_HZ = 20.0
_RESULTS = ("ACCEPTED", "TEMPORARILY_REJECTED", "DENIED", "UNSUPPORTED", "FAILED", "IN_PROGRESS", "CANCELLED")


class NotReachedError(TimeoutError):
    """A condition was not reached within its limit of simulated time."""


class CommandRefusedError(RuntimeError):
    """The vehicle did not accept a command."""


@dataclass(frozen=True, slots=True)
class Truth:
    """The true state at one time.

    Attributes:
        time_s: since boot. position_ned_m, velocity_ned_mps: local NED, its origin at the start.
        quaternion: `ned_from_body` (w, x, y, z). roll_rad, pitch_rad, yaw_rad: the same.
        rates_radps: body FRD.
        mode: PX4's name of the flight mode. on_ground: touching it, or on top of an obstacle.
        landed: by the land detector.
        collisions: count of those with the scene.
        collision: the newest; None before the first.

    >>> from mavlink_sim import LockstepVehicle
    >>> truth = LockstepVehicle(seed=1).truth
    >>> truth.mode, truth.landed, truth.collisions
    ('HOLD', True, 0)
    """

    time_s: float
    position_ned_m: tuple[float, float, float]
    velocity_ned_mps: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]
    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    rates_radps: tuple[float, float, float]
    mode: str
    armed: bool
    landed: bool
    on_ground: bool
    crashed: bool
    collisions: int = 0
    collision: Collision | None = None

    @property
    def height_m(self) -> float:
        return -self.position_ned_m[2]


class LockstepVehicle:
    """A PX4-like quadrotor that moves only while `step` (or another method documented to step) runs.

    Args:
        links: its connections by name, each with the rates of its streams in Hz; None is one link "onboard"
            with a companion's full rates. `streams.GCS_RATES_HZ` is a ground station's; `{}` sends
            only answers (and once the origin and the parameters set at the start), which is the fastest.
        autopilot: the firmware to emulate, "px4" or "ardupilot" (`firmware`); the latter's streams are
            requested by messages, whatever `links` is.
        options: those of `Vehicle`: `seed`, `noise`, `wind_mps`, `gusts_mps`, `parameters`, `system_id`,
            `scene` (a scene file, an example's name, a `Scene` or a `World`), `obstacle_sensor`…

    Attributes:
        vehicle: the vehicle itself, with its parts (`airframe`, `autopilot`, `parameters`).
        events: one readable line per event so far ("armed", "mode HOLD", "landed"…).
        newest: of each link, the newest message of each type that it sent.
        dropped: of each link, the number of messages dropped because they were not read.

    >>> from mavlink_sim import LockstepVehicle
    >>> vehicle = LockstepVehicle(seed=1)
    >>> vehicle.step(1.0)
    >>> round(vehicle.truth.time_s, 3), vehicle.truth.on_ground
    (1.0, True)
    """

    def __init__(
        self, links: Mapping[str, Mapping[str, float]] | None = None, *, autopilot: str = PX4, **options: Any
    ) -> None:
        self.events: list[str] = []
        self.vehicle = vehicle_class(autopilot)(on_event=self.events.append, **options)
        self.newest: dict[str, dict[str, Any]] = {}
        self.dropped: dict[str, int] = {}
        self._waiting: dict[str, deque[Outgoing]] = {}
        self._wires: dict[str, LockstepWire] = {}
        self._repeated: list[_Repeated] = []
        self._answers: list[tuple[int, int]] = []
        self._owed_s = 0.0
        self._setpoints: Repeat | None = None
        for name, rates in ({"onboard": ONBOARD_RATES_HZ} if links is None else links).items():
            self.vehicle.add_link(name, dict.fromkeys(ONBOARD_RATES_HZ, 0.0) | dict(rates))
            self.newest[name] = {}
            self.dropped[name] = 0
            self._waiting[name] = deque(maxlen=MAX_WAITING)
            self._wires[name] = LockstepWire(self.vehicle, self.vehicle.links[name])
        self._main_link = next(iter(self._waiting), "")

    def copy(self, seed: int | None = None) -> LockstepVehicle:
        """An independent copy in the current state.

        With the same inputs both fly alike, bit for bit. It takes about 2 ms: use it to try several
        continuations of one state, or to begin every episode of a training in the air. `stop` of what
        `repeat` returned stops the first one's messages only.

        Args:
            seed: of the copy's gusts and estimation errors from now on; None: as the first one's.

        Raises:
            ValueError: a fault is active, which may refer to objects outside.
        """
        if self.vehicle.faults.active:
            names = ", ".join(one.fault.kind.name for one in self.vehicle.faults.active)
            raise ValueError(
                f"copy: fault {names} is active; end it first, and begin it again on each vehicle"
            )
        twin: LockstepVehicle = pickle.loads(pickle.dumps(self))
        if seed is not None:
            twin.vehicle.airframe.reseed(seed)
            twin.vehicle.estimate.reseed(seed)
        return twin

    # ---- time -------------------------------------------------------------------------------------------

    @property
    def now_s(self) -> float:
        """Simulated seconds since boot."""
        return self.vehicle.now_s

    @property
    def _elapsed_s(self) -> float:
        """Simulated seconds since it was created: independent of reboots and stalls."""
        return self.vehicle.faults.now_s

    def step(self, dt_s: float) -> None:
        """Advance simulated time, in steps of 4 ms; a remainder waits for the next call.

        Raises:
            ValueError: `dt_s` is negative or not finite.
        """
        if not dt_s >= 0.0:
            raise ValueError(f"step: expected seconds, zero or more, got {dt_s}")
        faults = self.vehicle.faults
        wired = bool(faults.active or faults.scheduled) or any(wire.engaged for wire in self._wires.values())
        if not (self._repeated or wired):
            self.vehicle.step(dt_s)
        else:
            self._step_and_repeat(dt_s, wired)
        self._drain()

    def _step_and_repeat(self, dt_s: float, wired: bool) -> None:
        """Advance from one repeated message to the next; each is sent with the first step at or after its
        time.

        `wired`: step by step, since a fault may delay, deliver or begin something at any of them.
        """
        self._owed_s += dt_s
        left = int(self._owed_s / STEP_S + 1e-6)
        self._owed_s -= left * STEP_S
        while left > 0:
            now_s = self._elapsed_s
            for repeated in self._repeated:
                if repeated.next_s <= now_s + 1e-9:
                    repeated.send(self)
            steps = 1
            if not wired:
                until_next_s = min(repeated.next_s for repeated in self._repeated) - now_s
                steps = min(max(math.ceil(until_next_s / STEP_S - 1e-6), 1), left)
            self.vehicle.step(steps * STEP_S)
            left -= steps
            if wired:
                for wire in self._wires.values():
                    wire.deliver()
                self._drain()

    def _drain(self) -> None:
        for name, waiting in self._waiting.items():
            outgoing = self.vehicle.outgoing(name)
            wire = self._wires[name]
            if wire.matters:
                if waiting and not waiting[-1].forwarded:  # those were sent before and have earlier numbers
                    sealed = wire.sealed(waiting)
                    waiting.clear()
                    waiting.extend(sealed)
                outgoing = wire.outbound(outgoing)
            if outgoing:
                self.dropped[name] += max(0, len(waiting) + len(outgoing) - MAX_WAITING)
                waiting.extend(outgoing)
                newest = self.newest[name]
                for item in outgoing:
                    message = item.message
                    kind = message.get_type()
                    newest[kind] = message
                    if kind == "COMMAND_ACK":
                        self._answers.append((message.command, message.result))

    def run_until(
        self, condition: Callable[[Truth], bool], limit_s: float = 60.0, every_s: float = 0.02
    ) -> float:
        """Advance until the truth meets a condition. Returns the simulated seconds that it took.

        Raises:
            NotReachedError: not within `limit_s` simulated seconds.
        """
        started_s = self._elapsed_s
        while not condition(self.truth):
            if self._elapsed_s - started_s >= limit_s:
                truth = self.truth
                raise NotReachedError(
                    f"not reached within {limit_s:g} s of simulated time: mode {truth.mode}, "
                    f"{'armed' if truth.armed else 'disarmed'}, at {truth.position_ned_m}; "
                    f"events so far: {', '.join(self.events[-6:]) or 'none'}"
                )
            self.step(every_s)
        return self._elapsed_s - started_s

    # ---- messages ---------------------------------------------------------------------------------------

    def send(self, message: Any, link: str = "", source: tuple[int, int] = COMPANION) -> None:
        """Send it a message (of any pymavlink dialect) on a link, the first by default.

        It is not signed: on a link with a signing key MAV_SIGN_CFG decides; `send_bytes` is for signed ones.
        """
        name = link or self._main_link
        if name in self._wires and self._wires[name].matters:
            self._wires[name].send(message, source)
        else:
            header = message.get_header()
            header.srcSystem, header.srcComponent = source
            self.vehicle.handle(name, message)
        self._drain()

    def send_bytes(self, data: bytes, link: str = "") -> int:
        """Send it bytes; returns the number of complete messages in them and in an earlier remainder.

        A link fault may delay or lose them, and a link with a signing key may refuse them.
        """
        count = self._wires[link or self._main_link].send_bytes(data)
        self._drain()
        return count

    def repeat(
        self, message: Any, rate_hz: float, link: str = "", source: tuple[int, int] = COMPANION
    ) -> Repeat:
        """Send this message at a rate while time advances (setpoints, heartbeats); `stop` ends it."""
        repeated = _Repeated(message, 1.0 / rate_hz, self._elapsed_s, link, source)
        self._repeated.append(repeated)
        return Repeat(self._repeated, repeated)

    def receive(self, link: str = "") -> list[Any]:
        """The messages that it sent on a link since the last call, in order: pymavlink's or equivalent."""
        waiting = self._waiting[link or self._main_link]
        messages = [item.message for item in waiting if item.message.get_type() != "BAD_DATA"]
        waiting.clear()
        return messages

    def receive_bytes(self, link: str = "") -> bytes:
        """The same as bytes."""
        name = link or self._main_link
        codec, waiting = self._wires[name].codec, self._waiting[name]
        packed = b"".join(item.pack(codec) for item in waiting)
        waiting.clear()
        return packed

    # ---- the usual commands -----------------------------------------------------------------------------

    def command(self, identifier: int, *parameters: float) -> str:
        """Send COMMAND_LONG and advance until it is answered. Returns the MAV_RESULT's name.

        DO_SET_MODE is answered twice; the second answer is returned.

        Raises:
            NotReachedError: no answer within a second of simulated time.
        """
        values = (*parameters, *([0.0] * (7 - len(parameters))))
        system = self.vehicle.system_id
        self._answers.clear()
        self.send(dialect.MAVLink_command_long_message(system, 1, identifier, 0, *values))
        started_s = self._elapsed_s
        while (waited_s := self._elapsed_s - started_s) < ANSWER_LIMIT_S:
            results = [result for command, result in self._answers if command == identifier]
            if results and (identifier != _SET_MODE or waited_s > SECOND_ANSWER_S):
                return _RESULTS[results[-1]] if results[-1] < len(_RESULTS) else str(results[-1])
            self.step(STEP_S)
        raise NotReachedError(f"command {identifier} was not answered within {ANSWER_LIMIT_S:g} s")

    def arm(self) -> None:
        """Wait until it can be armed, and arm it.

        Raises:
            NotReachedError: not ready within 30 s. CommandRefusedError: it refuses.
        """
        self.run_until(lambda truth: self.vehicle.autopilot.can_arm, 30.0)
        self._demand("arming", _ARM_DISARM, 1.0)

    def take_off(self, height_m: float = 2.5, limit_s: float = 60.0) -> None:
        """Arm, take off to a height above home, and wait until that is complete (HOLD; ArduPilot: GUIDED).

        Raises:
            NotReachedError: not within `limit_s`. CommandRefusedError: it refuses.
        """
        mode, altitude_m, is_over = self.vehicle.takeoff_plan(height_m)
        if mode is not None:
            self.set_mode(mode)
        self.arm()
        self._demand("taking off", _TAKEOFF, math.nan, 0.0, 0.0, math.nan, math.nan, math.nan, altitude_m)
        self.run_until(lambda truth: is_over(), limit_s)

    def land(self, limit_s: float = 120.0) -> None:
        """Land at its position and wait until it is disarmed. Raises as `take_off`."""
        self._demand("landing", _LAND)
        self.run_until(lambda truth: not truth.armed, limit_s)

    def set_mode(self, name: str) -> None:
        """Request a mode by its autopilot's name (PX4: `OFFBOARD`, `HOLD`…; ArduPilot: `GUIDED`…).

        Raises:
            ValueError: an unknown mode. CommandRefusedError: it is not available now.
        """
        try:
            mode = self.vehicle.modes[name]
        except KeyError:
            names = ", ".join(mode.name for mode in self.vehicle.modes)
            raise ValueError(f"mode {name!r}: expected one of {names}") from None
        self._demand(f"mode {name}", _SET_MODE, 1.0, *self.vehicle.mode_parameters(mode))

    # ---- setpoints --------------------------------------------------------------------------------------

    def set_velocity(
        self, north_mps: float, east_mps: float, down_mps: float, yaw_rad: float | None = None
    ) -> None:
        """Set a velocity over ground, local NED, metres per second.

        SET_POSITION_TARGET_LOCAL_NED is sent SETPOINT_RATE_HZ times per second while time advances, in
        OFFBOARD (ArduPilot: GUIDED), until another of these three is called. The first call advances 0.1 s
        before it requests the mode. A vehicle on the ground has to take off first.

        >>> vehicle = LockstepVehicle(seed=1)
        >>> vehicle.take_off(5.0)
        >>> vehicle.set_velocity(2.0, 0.0, 0.0, yaw_rad=0.5)
        >>> vehicle.step(5.0)
        >>> vehicle.truth.velocity_ned_mps[0] > 1.5
        True

        Args:
            yaw_rad: heading, clockwise from north; None: unchanged.

        Raises:
            CommandRefusedError: the mode is not available now; no setpoints are sent.
            ValueError: a number is not finite.
        """
        system_id = self.vehicle.system_id
        self._stream(velocity_setpoint(north_mps, east_mps, down_mps, yaw_rad, system_id=system_id))

    def set_position(
        self, north_m: float, east_m: float, down_m: float, yaw_rad: float | None = None
    ) -> None:
        """Set a position, local NED, metres. Otherwise as `set_velocity`."""
        self._stream(position_setpoint(north_m, east_m, down_m, yaw_rad, system_id=self.vehicle.system_id))

    def stop_setpoints(self) -> None:
        """Stop the setpoints; the vehicle reacts to their end (PX4: COM_OBL_RC_ACT)."""
        if self._setpoints is not None:
            self._setpoints.stop()
        self._setpoints = None

    def _stream(self, message: Any) -> None:
        if self._setpoints is not None:
            self._setpoints.message = message
        else:
            self._setpoints = self.repeat(message, SETPOINT_RATE_HZ)
            self.step(0.1)  # PX4 accepts OFFBOARD only with a setpoint stream
        mode = self.vehicle.setpoint_mode
        if self.truth.mode != mode:
            try:
                self.set_mode(mode)
            except CommandRefusedError:
                self.stop_setpoints()
                raise

    def _demand(self, what: str, identifier: int, *parameters: float) -> None:
        result = self.command(identifier, *parameters)
        if result != "ACCEPTED":
            raise CommandRefusedError(f"{what} was answered with {result}; events: {self.events[-6:]}")

    # ---- truth ------------------------------------------------------------------------------------------

    @property
    def truth(self) -> Truth:
        """The current truth."""
        airframe, autopilot = self.vehicle.airframe, self.vehicle.autopilot
        return Truth(
            self.now_s,
            airframe.position,
            airframe.velocity,
            airframe.quaternion,
            airframe.roll_rad,
            airframe.pitch_rad,
            airframe.yaw_rad,
            airframe.rates,
            autopilot.mode.name,
            autopilot.armed,
            autopilot.landed,
            airframe.on_ground,
            airframe.crashed,
            airframe.collisions,
            airframe.last_collision,
        )


class _Repeated:
    """A message that is sent repeatedly."""

    def __init__(
        self, message: Any, interval_s: float, next_s: float, link: str, source: tuple[int, int]
    ) -> None:
        self.message, self.link, self.source = message, link, source
        self.next_s = next_s
        self._interval_s = interval_s

    def send(self, vehicle: LockstepVehicle) -> None:
        self.next_s += self._interval_s
        vehicle.send(self.message, self.link, self.source)


class Repeat:
    """A repeated message; `message` may be replaced at any time."""

    def __init__(self, among: list[_Repeated], repeated: _Repeated) -> None:
        self._among, self._repeated = among, repeated

    @property
    def message(self) -> Any:
        return self._repeated.message

    @message.setter
    def message(self, message: Any) -> None:
        self._repeated.message = message

    def stop(self) -> None:
        """Stop sending it; a second call has no effect."""
        if self._repeated in self._among:
            self._among.remove(self._repeated)
