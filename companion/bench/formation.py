"""A fleet in one process: each vehicle with its guidance, its own clock and local origin, and a bad network.

Everything but the driver and the sockets is what flies for real: behaviours, envelope, neighbours, and the
messages as they go over the bus. The vehicles are the built-in one in lockstep, or points that follow a
velocity late, of which many can be flown.
"""

from __future__ import annotations

import itertools
import json
import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

from companion.guidance.behaviour import Behaviour, Outcome, Situation
from companion.guidance.envelope import Envelope, Limits
from companion.guidance.formation import FormationBehaviour
from companion.guidance.hold import HoldBehaviour
from companion.guidance.neighbours import Anchor, Neighbours
from companion.guidance.pose import pose_from_message, pose_message, pose_of
from companion.guidance.refusal import refusal
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, LandedState, Vector3, VehicleState
from companion.vehicle.telemetry_fold import FOLDED_MESSAGES, fold
from mavlink_sim import LockstepVehicle
from mavlink_sim.vehicle import BACKGROUND_GUSTS_MPS, GUST_SHARE_OF_WIND
from mavlink_sim.wire.messages import dialect
from mavlink_sim.wire.streams import ONBOARD_RATES_HZ
from vision.attitude import quaternion_from_euler, wrap_angle

GUIDANCE_HZ = 20.0
POSES_EVERY = 2  # guidance turns: 10 Hz
# Of what PX4 sends a companion by itself, what its state is made of.
_FOLDED_RATES_HZ = {name: rate_hz for name, rate_hz in ONBOARD_RATES_HZ.items() if name in FOLDED_MESSAGES}
# Where the fleet's common frame has its origin; any place away from the poles would do.
_ORIGIN = Anchor(47.3977, 8.5456, 488.0, (0.0, 0.0, 0.0))


class Airframe(Protocol):
    """Something that flies setpoints, in a local frame of its own."""

    def state(self) -> VehicleState:
        """What its telemetry has told, stamped by its own clock."""

    def now_ns(self) -> int:
        """Its own clock."""

    def place(self) -> Vector3:
        """Where it really is, in the fleet's common frame (NED)."""

    def fly(self, setpoint: Setpoint | None, dt_s: float) -> None:
        """Let time pass with this setpoint."""


class LockstepAirframe:
    """The built-in vehicle, hovering.

    Args:
        start: (north, east) metres in the common frame. clock_ns: its clock at the beginning.
        wind_mps: steady, towards (north, east); gusts are the seed's.
    """

    def __init__(
        self,
        system_id: int,
        seed: int,
        start: tuple[float, float],
        height_m: float,
        clock_ns: int,
        wind_mps: tuple[float, float],
    ) -> None:
        self.vehicle = LockstepVehicle(
            {"onboard": _FOLDED_RATES_HZ},
            system_id=system_id,
            seed=seed,
            parameters={"SIH_WIND_N": wind_mps[0], "SIH_WIND_E": wind_mps[1]},
            gusts_mps=BACKGROUND_GUSTS_MPS + GUST_SHARE_OF_WIND * math.hypot(*wind_mps),
            start_ned_m=start,
            ready_after_s=0.0,
        )
        self._start, self._clock_ns = start, clock_ns
        self._state = VehicleState()
        self.vehicle.take_off(height_m)
        self._fold()

    def engage(self) -> None:
        """Into OFFBOARD, standing."""
        self._send(Setpoint.brake(0))
        self.vehicle.step(0.1)
        self.vehicle.set_mode("OFFBOARD")
        self._fold()

    def now_ns(self) -> int:
        return self._clock_ns + round(self.vehicle.now_s * 1e9)

    def state(self) -> VehicleState:
        return self._state

    def place(self) -> Vector3:
        north, east, down = self.vehicle.truth.position_ned_m
        return (self._start[0] + north, self._start[1] + east, down)

    def fly(self, setpoint: Setpoint | None, dt_s: float) -> None:
        if setpoint is not None:
            self._send(setpoint)
        self.vehicle.step(dt_s)
        self._fold()

    def _send(self, setpoint: Setpoint) -> None:
        place = setpoint.position_ned_m or (0.0, 0.0, 0.0)
        velocity = setpoint.velocity_ned_mps or (0.0, 0.0, 0.0)
        self.vehicle.send(
            dialect.MAVLink_set_position_target_local_ned_message(
                0,
                self.vehicle.vehicle.system_id,
                1,
                dialect.MAV_FRAME_LOCAL_NED,
                setpoint.type_mask,
                *place,
                *velocity,
                0.0,
                0.0,
                0.0,
                setpoint.yaw_rad or 0.0,
                setpoint.yaw_rate_radps or 0.0,
            )
        )

    def _fold(self) -> None:
        now_ns = self.now_ns()
        newest = {message.get_type(): message for message in self.vehicle.receive()}
        for name, message in newest.items():
            if name in FOLDED_MESSAGES:
                self._state = fold(self._state, name, message.to_dict(), now_ns)


class PointAirframe:
    """A point that follows velocities by a first-order lag, in gusts; its estimate errs by centimetres."""

    LAG_S = 0.35

    def __init__(self, seed: int, start: tuple[float, float], height_m: float, clock_ns: int) -> None:
        self._chance = random.Random(seed)
        self._start, self._clock_ns = start, clock_ns
        self._place = [start[0], start[1], -height_m]
        self._velocity = [0.0, 0.0, 0.0]
        self._gust = [0.0, 0.0, 0.0]
        self._yaw_rad = self._yaw_rate_radps = 0.0

    def engage(self) -> None:
        """It always does what it is told."""

    def now_ns(self) -> int:
        return self._clock_ns

    def place(self) -> Vector3:
        return (self._place[0], self._place[1], self._place[2])

    def state(self) -> VehicleState:
        now_ns = self._clock_ns
        north, east, down = (value + self._chance.gauss(0.0, 0.03) for value in self._place)
        latitude, longitude, altitude_m = _ORIGIN.globally((north, east, down))
        v_north, v_east, v_down = (value + self._chance.gauss(0.0, 0.05) for value in self._velocity)
        return VehicleState(
            heartbeat_ns=now_ns,
            attitude_ns=now_ns,
            position_ns=now_ns,
            global_ns=now_ns,
            landed_ns=now_ns,
            armed=True,
            mode=FlightMode.OFFBOARD,
            landed=LandedState.IN_AIR,
            position_ned_m=(north - self._start[0], east - self._start[1], down),
            velocity_ned_mps=(v_north, v_east, v_down),
            attitude=quaternion_from_euler(0.0, 0.0, self._yaw_rad),
            angular_velocity_frd_radps=(0.0, 0.0, self._yaw_rate_radps),
            latitude_deg=latitude,
            longitude_deg=longitude,
            altitude_amsl_m=altitude_m,
            home_altitude_amsl_m=_ORIGIN.altitude_m,
            home_position_ned_m=(0.0, 0.0, 0.0),
        )

    def fly(self, setpoint: Setpoint | None, dt_s: float) -> None:
        wanted: Vector3 = (0.0, 0.0, 0.0)
        rate = 0.0
        if setpoint is not None:
            if setpoint.velocity_ned_mps is not None:
                wanted = setpoint.velocity_ned_mps
            elif setpoint.position_ned_m is not None:
                here = (self._place[0] - self._start[0], self._place[1] - self._start[1], self._place[2])
                north, east, down = (
                    0.95 * (p - h) for p, h in zip(setpoint.position_ned_m, here, strict=True)
                )
                wanted = (north, east, down)
            rate = setpoint.yaw_rate_radps or 0.0
            if setpoint.yaw_rad is not None:
                rate = max(-1.0, min(1.0, 2.0 * wrap_angle(setpoint.yaw_rad - self._yaw_rad)))
        share = dt_s / (self.LAG_S + dt_s)
        for axis in range(3):
            # Gusts of 0.1 m/s that last two seconds.
            self._gust[axis] += -self._gust[axis] * dt_s / 2.0 + self._chance.gauss(
                0.0, 0.1 * math.sqrt(dt_s)
            )
            self._velocity[axis] += (wanted[axis] + self._gust[axis] - self._velocity[axis]) * share
            self._place[axis] += self._velocity[axis] * dt_s
        self._yaw_rate_radps += (rate - self._yaw_rate_radps) * share
        self._yaw_rad = wrap_angle(self._yaw_rad + self._yaw_rate_radps * dt_s)
        self._clock_ns += round(dt_s * 1e9)


@dataclass(frozen=True, slots=True)
class Network:
    """How poses travel: each is lost with a probability, or comes after a delay.

    Attributes:
        delay_s: of all. jitter_s: mean of what comes on top, exponentially distributed.
    """

    loss: float = 0.1
    delay_s: float = 0.03
    jitter_s: float = 0.03


@dataclass
class Member:
    """One vehicle of the fleet, and what its companion knows.

    Attributes:
        muted: its poses do not go out. deaf: none come in.
        outcome: how its last behaviour ended, while nothing but a hold flies.
        limited: the words of every limit that has acted.
    """

    name: str
    airframe: Any
    neighbours: Neighbours
    envelope: Envelope
    behaviour: Behaviour
    muted: bool = False
    deaf: bool = False
    outcome: Outcome | None = None
    limited: set[str] = field(default_factory=set)
    commanded: bool = False
    activated: bool = False
    sent: Setpoint | None = None
    inbox: list[tuple[float, int, Any]] = field(default_factory=list)


class Fleet:
    """Vehicles side by side in time.

    Args:
        as_text: poses go as the JSON they are on the bus; False: as values, which is faster.

    Attributes:
        now_s: since the fleet began. least_m: the smallest distance two vehicles ever had, really.
    """

    def __init__(
        self, seed: int, network: Network | None = None, limits: Limits | None = None, *, as_text: bool = True
    ) -> None:
        self._chance = random.Random(seed)
        self._network = network or Network()
        self._limits = limits or Limits()
        self._as_text = as_text
        self._turn = 0
        self._numbers = itertools.count()
        self.members: dict[str, Member] = {}
        self.now_s = 0.0
        self.least_m = math.inf
        self.sent_bytes: list[int] = []

    def add(self, name: str, airframe: LockstepAirframe | PointAirframe) -> Member:
        """A vehicle that hovers where it is, under its companion's hold."""
        airframe.engage()
        member = Member(name, airframe, Neighbours(name, name), Envelope(self._limits), HoldBehaviour())
        self.members[name] = member
        return member

    def command(self, name: str, behaviour: Behaviour) -> str | None:
        """Let a vehicle fly it; the words of the refusal, if it is refused."""
        member = self.members[name]
        situation = self._situation(member)
        refused = refusal(behaviour, situation, None)
        if refused is None:
            self._begin(member, behaviour)
            member.outcome, member.commanded = None, True
        return refused

    def remove(self, name: str) -> None:
        """A vehicle is there no more, and says nothing more."""
        del self.members[name]

    def run(self, seconds: float, each: Callable[[], object] = lambda: None) -> None:
        """Let time pass; `each` is called at every turn."""
        for _ in range(round(seconds * GUIDANCE_HZ)):
            self.step()
            each()

    def run_until(self, condition: Callable[[], bool], limit_s: float) -> bool:
        """Let time pass until something is so; whether it came to be."""
        until_s = self.now_s + limit_s
        while not condition():
            if self.now_s >= until_s:
                return False
            self.step()
        return True

    def step(self) -> None:
        """One turn of everybody's guidance."""
        dt_s = 1.0 / GUIDANCE_HZ
        self._turn += 1
        members = list(self.members.values())
        for index, member in enumerate(members):
            # Nobody publishes at the same moment as the others.
            if (self._turn + index) % POSES_EVERY == 0:
                self._publish(member)
        for member in members:
            self._deliver(member)
            self._fly(member, dt_s)
        for member in members:
            member.airframe.fly(member.sent, dt_s)
        self.now_s += dt_s
        for one, other in itertools.combinations(members, 2):
            self.least_m = min(self.least_m, math.dist(one.airframe.place(), other.airframe.place()))

    def slot_errors(self) -> dict[str, float]:
        """How far from its slot each follower really is, metres; of those that have one."""
        errors = {}
        for name, member in self.members.items():
            behaviour = member.behaviour
            if (
                isinstance(behaviour, FormationBehaviour)
                and (slot := behaviour.slot_offset_ned_m) is not None
            ):
                leader = self.members.get(behaviour.leader_name)
                if leader is not None:
                    centre = leader.airframe.place()
                    wanted = tuple(c + s for c, s in zip(centre, slot, strict=True))
                    errors[name] = math.dist(wanted, member.airframe.place())
        return errors

    def _situation(self, member: Member) -> Situation:
        state, now_ns = member.airframe.state(), member.airframe.now_ns()
        return Situation(
            now_ns,
            state,
            sent=member.sent,
            neighbourhood=member.neighbours.around(state, now_ns),
            min_separation_m=self._limits.min_separation_m,
        )

    def _begin(self, member: Member, behaviour: Behaviour) -> None:
        if member.activated:
            member.behaviour.on_deactivate()
        member.behaviour, member.activated = behaviour, False

    def _fly(self, member: Member, dt_s: float) -> None:
        situation = self._situation(member)
        if not member.activated:
            member.behaviour.on_activate(situation)
            member.activated = True
        step = member.behaviour.update(dt_s, situation)
        if isinstance(step, Outcome):
            # As the pilot does: what follows a behaviour that flew by setpoints is a hold.
            if member.commanded:
                member.outcome, member.commanded = step, False
            self._begin(member, HoldBehaviour())
            member.behaviour.on_activate(situation)
            member.activated = True
            step = member.behaviour.update(dt_s, situation)
        if not isinstance(step, Setpoint):
            raise TypeError(f"{member.name}: {member.behaviour.name} does not fly by setpoints: {step}")
        limited = member.envelope.apply(step, situation.state, situation.now_ns, dt_s, situation.neighbours)
        member.sent = limited.sent
        member.limited.update(limited.reasons)

    def _publish(self, member: Member) -> None:
        state, now_ns = member.airframe.state(), member.airframe.now_ns()
        behaviour = member.behaviour
        note = behaviour.note if isinstance(behaviour, FormationBehaviour) else None
        pose = pose_of(state, now_ns, vehicle=member.name, source=member.name, formation=note)
        if pose is None or member.muted:
            return
        message: Any = pose
        if self._as_text:
            message = json.dumps(pose_message(pose), separators=(",", ":"))
            self.sent_bytes.append(len(message))
        network = self._network
        for other in self.members.values():
            if other is not member and self._chance.random() >= network.loss:
                late_s = network.delay_s + self._chance.expovariate(1.0 / network.jitter_s)
                other.inbox.append((self.now_s + late_s, next(self._numbers), message))

    def _deliver(self, member: Member) -> None:
        due = sorted(item for item in member.inbox if item[0] <= self.now_s)
        member.inbox = [item for item in member.inbox if item[0] > self.now_s]
        for came_s, _, message in due:
            if member.deaf:
                continue
            pose = pose_from_message(json.loads(message)) if self._as_text else message
            # It came between two turns; the receiver stamps it as it comes.
            receipt_ns = member.airframe.now_ns() - round((self.now_s - came_s) * 1e9)
            member.neighbours.hear(pose, receipt_ns)
