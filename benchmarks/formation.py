"""A fleet in one process: each vehicle with its guidance, its own clock and local origin, and a bad network.

Only driver and sockets differ from the real service; the messages are those of the bus. The
vehicles are the built-in one in lockstep, or points that follow a velocity late, of which many can be flown.
"""

from __future__ import annotations

import itertools
import json
import math
import random
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from companion.bench.lockstep_flight import TICK_S, LockstepFlight, plain_settings
from companion.bench.simulated_driver import SimulatedDriver
from companion.bus.vehicle_messages import pose_message
from companion.geometry.geodesy import GeodeticOrigin
from companion.guidance.behaviour import Behaviour, Outcome
from companion.guidance.behaviours.formation import FormationBehaviour
from companion.guidance.behaviours.hold import HoldBehaviour
from companion.guidance.formation.pose import pose_from_message
from companion.guidance.interface import Answer, EventKind, Request, SetMode
from companion.guidance.limits.envelope import Limits
from companion.service.factory import guidance_options
from companion.vehicle.landing_target import LandingTarget
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, LandedState, Vector3, VehicleState
from companion.vehicle.telemetry import TELEMETRY_MESSAGES
from companion.vehicle.vision_position import VisionPosition
from mavlink_sim import LockstepVehicle
from mavlink_sim.vehicles.vehicle import BACKGROUND_GUSTS_MPS, GUST_SHARE_OF_WIND
from mavlink_sim.wire.streams import ONBOARD_RATES_HZ
from vision.attitude import quaternion_from_euler, wrap_angle
from vision.obstacle_sectors import ObstacleSectors

POSES_HZ = 10.0
# Of what PX4 sends a companion by itself, what its state is made of.
_FOLDED_RATES_HZ = {name: rate_hz for name, rate_hz in ONBOARD_RATES_HZ.items() if name in TELEMETRY_MESSAGES}
# Where the fleet's common frame has its origin; any place away from the poles would do.
_ORIGIN = GeodeticOrigin(47.3977, 8.5456, 488.0)


class LockstepAirframe(SimulatedDriver):
    """The simulated vehicle, hovering.

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
        vehicle = LockstepVehicle(
            {"onboard": _FOLDED_RATES_HZ},
            system_id=system_id,
            seed=seed,
            parameters={"SIH_WIND_N": wind_mps[0], "SIH_WIND_E": wind_mps[1]},
            gusts_mps=BACKGROUND_GUSTS_MPS + GUST_SHARE_OF_WIND * math.hypot(*wind_mps),
            start_ned_m=start,
            ready_after_s=0.0,
        )
        self._start = start
        vehicle.take_off(height_m)
        super().__init__(vehicle, clock_ns)

    def place(self) -> Vector3:
        north, east, down = self.vehicle.truth.position_ned_m
        return (self._start[0] + north, self._start[1] + east, down)


class PointAirframe:
    """A point that follows velocities by a first-order lag, in gusts; its estimate errs by centimetres.

    The estimate is new with every second step, as an autopilot's at 50 Hz.
    """

    LAG_S = 0.35

    def __init__(self, seed: int, start: tuple[float, float], height_m: float, clock_ns: int) -> None:
        self._chance = random.Random(seed)
        self._start, self.now_ns = start, clock_ns
        self._place = [start[0], start[1], -height_m]
        self._velocity = [0.0, 0.0, 0.0]
        self._gust = [0.0, 0.0, 0.0]
        self._yaw_rad = self._yaw_rate_radps = 0.0
        self._setpoint: Setpoint | None = None
        self._mode = FlightMode.HOLD
        self._answers: list[Answer] = []
        self._steps = 0
        self.state = self._estimate()

    def place(self) -> Vector3:
        return (self._place[0], self._place[1], self._place[2])

    def send_setpoint(self, setpoint: Setpoint) -> None:
        self._setpoint = setpoint

    def send_landing_target(self, target: LandingTarget) -> None:
        raise NotImplementedError("a point lands on nothing")

    def send_obstacle_distance(self, sectors: ObstacleSectors) -> None:
        raise NotImplementedError("a point sees no obstacles")

    def send_vision_position(self, vision: VisionPosition) -> None:
        raise NotImplementedError("a point knows its position")

    def start(self, request: Request) -> None:
        """It does at once what it is asked."""
        if isinstance(request.action, SetMode):
            self._mode = request.action.mode
        self._answers.append(Answer(request.identifier))

    def cancel(self, identifier: int) -> None:
        """Every request was answered at once."""

    def take_answers(self) -> tuple[Answer, ...]:
        answers, self._answers = tuple(self._answers), []
        return answers

    def _estimate(self) -> VehicleState:
        now_ns = self.now_ns
        north, east, down = (value + self._chance.gauss(0.0, 0.03) for value in self._place)
        latitude, longitude, altitude_m = _ORIGIN.place((north, east, down))
        v_north, v_east, v_down = (value + self._chance.gauss(0.0, 0.05) for value in self._velocity)
        return VehicleState(
            heartbeat_ns=now_ns,
            attitude_ns=now_ns,
            position_ns=now_ns,
            global_ns=now_ns,
            battery_ns=now_ns,
            battery_fraction=0.9,
            armed=True,
            mode=self._mode,
            landed=LandedState.IN_AIR,
            position_ned_m=(north - self._start[0], east - self._start[1], down),
            velocity_ned_mps=(v_north, v_east, v_down),
            attitude=quaternion_from_euler(0.0, 0.0, self._yaw_rad),
            angular_velocity_frd_radps=(0.0, 0.0, self._yaw_rate_radps),
            latitude_deg=latitude,
            longitude_deg=longitude,
            altitude_amsl_m=altitude_m,
            home_altitude_amsl_m=_ORIGIN.altitude_amsl_m,
            home_position_ned_m=(0.0, 0.0, 0.0),
        )

    def step(self, dt_s: float) -> None:
        setpoint = self._setpoint if self._mode is FlightMode.OFFBOARD else None
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
        self.now_ns += round(dt_s * 1e9)
        self._steps += 1
        if self._steps % 2 == 0:
            self.state = self._estimate()


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
        flight: its guidance and all around it.
        muted: its poses do not go out. deaf: none come in.
        limited: the words of every limit that has acted.
    """

    name: str
    airframe: LockstepAirframe | PointAirframe
    flight: LockstepFlight
    muted: bool = False
    deaf: bool = False
    limited: set[str] = field(default_factory=set)
    commanded: int | None = None
    inbox: list[tuple[float, int, Any]] = field(default_factory=list)

    @property
    def behaviour(self) -> Behaviour | None:
        """The active command."""
        return self.flight.guidance.behaviour

    @property
    def outcome(self) -> Outcome | None:
        """How its last commanded behaviour ended; None: it has not, or none was commanded."""
        return None if self.commanded is None else self.flight.outcome(self.commanded)


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
        self._ticks = 0
        self._numbers = itertools.count()
        self.members: dict[str, Member] = {}
        self.least_m = math.inf
        self.sent_bytes: list[int] = []

    @property
    def now_s(self) -> float:
        return self._ticks * TICK_S

    def add(self, name: str, airframe: LockstepAirframe | PointAirframe) -> Member:
        """A vehicle that hovers where it is, under its companion's hold."""
        settings = plain_settings({"vehicle.name": name})
        options = replace(guidance_options(settings), limits=self._limits)
        member = Member(name, airframe, LockstepFlight(airframe, settings, options=options))
        member.flight.command(HoldBehaviour())
        self.members[name] = member
        return member

    def command(self, name: str, behaviour: Behaviour) -> str | None:
        """Let a vehicle fly it; why not, if it is refused."""
        member = self.members[name]
        before = len(member.flight.events)
        commanded = member.flight.command(behaviour)
        member.flight.step()
        for event in member.flight.events[before:]:
            if event.kind is EventKind.REFUSED and event.outcome is not None:
                return event.outcome.reason
        member.commanded = commanded
        return None

    def remove(self, name: str) -> None:
        """A vehicle is there no more, and says nothing more."""
        del self.members[name]

    def run(self, seconds: float, each: Callable[[], object] = lambda: None) -> None:
        """Let time pass; `each` is called at every step."""
        until_s = self.now_s + seconds
        while self.now_s < until_s - TICK_S / 2:
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
        """As long as a period of guidance."""
        members = list(self.members.values())
        period = round(1.0 / (POSES_HZ * TICK_S))
        for _ in range(period // 2):
            self._ticks += 1
            for index, member in enumerate(members):
                # Nobody publishes at the same moment as the others.
                if (self._ticks + index) % period == 0:
                    self._publish(member)
            for member in members:
                self._deliver(member)
                member.flight.tick()
                member.limited.update(member.flight.guidance.setpoints.limited_by)
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

    def _publish(self, member: Member) -> None:
        flight = member.flight
        note = None if member.behaviour is None else member.behaviour.note
        pose = flight.inputs.poses.pose(
            flight.state, note, flight.now_ns, in_command=flight.guidance.in_command
        )
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
            # It came between two ticks; the receiver stamps it as it comes.
            receipt_ns = member.flight.now_ns - round((self.now_s - came_s) * 1e9)
            member.flight.inputs.poses.ingest(pose, receipt_ns)
