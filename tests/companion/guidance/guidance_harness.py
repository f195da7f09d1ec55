"""Guidance in lockstep with a scripted autopilot: PX4's modes and landed states, a simulated clock."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from types import MappingProxyType
from typing import Any, TypeVar

from companion.bench.lockstep_flight import LockstepFlight, vehicle_in_the_air
from companion.guidance.behaviour import Behaviour, BehaviourContext, BehaviourOutput, Outcome
from companion.guidance.command import NO_CONTEXT
from companion.guidance.core import Guidance, GuidanceOptions
from companion.guidance.grammar import parse
from companion.guidance.interface import (
    Action,
    Answer,
    Arm,
    CommandInput,
    Disarm,
    EventKind,
    GuidanceEvent,
    GuidanceInput,
    GuidanceOutput,
    PointGimbal,
    ReleaseGimbal,
    Request,
    SetMode,
    StreamStatus,
    TakeGimbal,
    TakeOff,
)
from companion.guidance.limits.envelope import Limits
from companion.guidance.missions.mission_file import plan_from
from companion.guidance.missions.sequence import SequenceBehaviour
from companion.guidance.mode_control import Phase
from companion.guidance.objects.from_markers import object_detections
from companion.guidance.objects.table import ObjectTable
from companion.guidance.objects.target import Target
from companion.host.clock import StandstillWatch
from companion.service.requests import apply_output
from companion.vehicle.gimbal import NOBODY, Address, GimbalAim, GimbalState, YawFrame
from companion.vehicle.landing_target import LandingTarget
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, LandedState, VehicleState, with_fields
from companion.vehicle.streamer import Streamer
from mavlink_sim.lockstep import LockstepVehicle
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle, SeenObject, look
from vision.attitude import quaternion_from_euler, wrap_angle
from vision.obstacle_sectors import ObstacleSectors
from vision.path_planner import PathRequest

T = TypeVar("T")

CLIMB_MPS = 1.5
DISARM_AFTER_LANDING_S = 2.0
STEP_S = 0.04  # the service steps every 0.05 s (`guidance.rate_hz`)
SHOWN_TIMEOUT_S = 3.0

_airborne = cache(vehicle_in_the_air)


def in_the_air(**options: Any) -> LockstepVehicle:
    """As `vehicle_in_the_air`, which flies there once: copies are equal bit for bit."""
    return _airborne(**options).copy()


@dataclass
class ScriptedGimbal:
    """A gimbal whose manager reports its state in every step, and which reaches its aim at once.

    Attributes:
        primary: the component in control.
        refuses: why pointing is denied; None: it is not.
        follows: it moves. reports_attitude: else its newest attitude gets older.
    """

    primary: Address = NOBODY
    refuses: str | None = None
    follows: bool = True
    reports_attitude: bool = True
    pitch_rad: float = 0.0
    _attitude_ns: int = 0

    def answer(self, action: Action) -> str | None:
        """Execute a request; returns why it is refused."""
        match action:
            case TakeGimbal():
                self.primary = VehicleState.own_address
            case ReleaseGimbal():
                self.primary = NOBODY
            case PointGimbal(aim):
                if self.follows and self.refuses is None:
                    self.pitch_rad = aim.pitch_rad
                return self.refuses
        return None

    def state(self, now_ns: int) -> GimbalState:
        """The reported state now."""
        if self.reports_attitude:
            self._attitude_ns = now_ns
        attitude = quaternion_from_euler(0.0, self.pitch_rad, 0.0)
        return GimbalState(
            1,
            now_ns,
            now_ns,
            self._attitude_ns,
            attitude,
            YawFrame.NOSE,
            lowest_pitch_rad=-math.pi / 2,
            highest_pitch_rad=math.radians(30.0),
            primary_control=self.primary,
        )


class ScriptedAutopilot:
    """Answers guidance's requests. A mode shows `lag_s` after its change, as in a HEARTBEAT.

    Attributes:
        gimbal: None: there is none.
    """

    def __init__(self, vehicle: KinematicVehicle, lag_s: float = 0.0) -> None:
        self.vehicle = vehicle
        self.lag_s = lag_s
        self.gimbal: ScriptedGimbal | None = None
        self.refuse: dict[FlightMode, str] = {}
        self.refuse_arming: str | None = None
        self.refuse_takeoff: str | None = None
        self.linked = True
        self.failsafe = False
        self.position_alive = True
        self.battery_fraction: float | None = 0.9
        self.battery_alive = True
        self._battery_ns = vehicle.now_ns
        self.takeoff_short_m = 0.0
        self.requests: list[str] = []
        self.setpoints: list[Setpoint] = []
        self.landing_targets: list[LandingTarget] = []
        self.obstacle_distances: list[ObstacleSectors] = []
        self.mode_changes = 0
        self._shown = (vehicle.armed, vehicle.mode)
        self._changes: list[tuple[int, tuple[bool, FlightMode]]] = []
        self._takeoff_m = 0.0
        self._landed_ns: int | None = None
        self._mode_before_landing = vehicle.mode
        self._heartbeat_ns = vehicle.now_ns
        self._position_ns = vehicle.now_ns
        self._pending: list[tuple[int, int, Callable[[], bool]]] = []
        self._answers: list[Answer] = []

    @property
    def state(self) -> VehicleState:
        armed, mode = self._shown
        return with_fields(
            self.vehicle.state,
            heartbeat_ns=self._heartbeat_ns,
            position_ns=self._position_ns,
            attitude_ns=self._position_ns,
            armed=armed,
            mode=mode,
            failsafe=self.failsafe,
            battery_fraction=self.battery_fraction,
            battery_ns=self._battery_ns,
            gimbal=None if self.gimbal is None else self.gimbal.state(self.vehicle.now_ns),
        )

    def start(self, request: Request) -> None:
        """Start a request of guidance."""
        match request.action:
            case SetMode(mode):
                self.requests.append(mode.value)
                if mode in self.refuse:
                    self._answers.append(Answer(request.identifier, self.refuse[mode]))
                    return
                self.change_mode(mode)
                self._wait(request, lambda: self._shown[1] is mode)
            case Arm() if self.refuse_arming is not None:
                self._answers.append(Answer(request.identifier, self.refuse_arming))
            case Arm():
                self.requests.append("arm")
                self.vehicle.armed = True
                self._wait(request, lambda: self._shown[0])
            case Disarm():
                self.requests.append("disarm")
                self.vehicle.armed = False
                self._wait(request, lambda: not self._shown[0])
            case TakeOff() if self.refuse_takeoff is not None:
                self._answers.append(Answer(request.identifier, self.refuse_takeoff))
            case TakeOff(altitude_m):
                self.requests.append(f"takeoff {altitude_m:g}")
                self._takeoff_m = altitude_m
                self.change_mode(FlightMode.TAKEOFF)
                self._answers.append(Answer(request.identifier))
            case _:
                refused = "no gimbal" if self.gimbal is None else self.gimbal.answer(request.action)
                self._answers.append(Answer(request.identifier, refused))

    def cancel(self, identifier: int) -> None:
        """Abandon a request."""
        self._pending = [pending for pending in self._pending if pending[0] != identifier]

    def take_answers(self) -> tuple[Answer, ...]:
        """The answers since the last call."""
        now_ns = self.vehicle.now_ns
        for pending in list(self._pending):
            identifier, since_ns, shown = pending
            late = now_ns - since_ns > SHOWN_TIMEOUT_S * 1e9
            if shown() or late:
                self._pending.remove(pending)
                words = None if shown() else f"not shown in 3 s: {self._shown[1].value} mode"
                self._answers.append(Answer(identifier, words))
        answers, self._answers = tuple(self._answers), []
        return answers

    def change_mode(self, mode: FlightMode) -> None:
        """Change the mode, as requested by us or by a pilot."""
        if mode is FlightMode.LAND and self.vehicle.mode is not FlightMode.LAND:
            self._mode_before_landing = self.vehicle.mode
        self.vehicle.mode = mode

    def step(self, dt_s: float) -> None:
        """Advance the vehicle; changes show after the lag."""
        vehicle, dt_ns = self.vehicle, round(dt_s * 1e9)
        altitude = -vehicle.position[2]
        still = Setpoint.brake(vehicle.now_ns)
        if vehicle.mode is FlightMode.OFFBOARD and vehicle.armed and self.setpoints:
            vehicle.fly(self.setpoints[-1], dt_s)
        elif vehicle.mode is FlightMode.TAKEOFF and vehicle.armed:
            vehicle.landed = LandedState.TAKING_OFF
            vehicle.fly(Setpoint.velocity((0, 0, -CLIMB_MPS), vehicle.now_ns), dt_s)
            if altitude >= self._takeoff_m - self.takeoff_short_m - 0.3:
                vehicle.mode, vehicle.landed = FlightMode.HOLD, LandedState.IN_AIR
        elif vehicle.mode in (FlightMode.LAND, FlightMode.RETURN) and altitude > 0.0:
            vehicle.landed = LandedState.LANDING
            vehicle.fly(Setpoint.velocity((0, 0, 1.0), vehicle.now_ns), dt_s)
        elif vehicle.landed is LandedState.IN_AIR:
            vehicle.fly(still, dt_s)
        else:
            vehicle.now_ns += dt_ns
        if vehicle.landed is LandedState.LANDING and vehicle.position[2] >= 0.0:
            vehicle.landed, self._landed_ns = LandedState.ON_GROUND, vehicle.now_ns
        if self._landed_ns and vehicle.now_ns - self._landed_ns > DISARM_AFTER_LANDING_S * 1e9:
            vehicle.armed, vehicle.mode, self._landed_ns = False, self._mode_before_landing, None
        self._changes.append((vehicle.now_ns, (vehicle.armed, vehicle.mode)))
        while self._changes and vehicle.now_ns - self._changes[0][0] >= self.lag_s * 1e9:
            shown = self._changes.pop(0)[1]
            self.mode_changes += shown != self._shown
            self._shown = shown
        if self.linked:
            self._heartbeat_ns = vehicle.now_ns
            if self.position_alive:
                self._position_ns = vehicle.now_ns
            if self.battery_alive:
                self._battery_ns = vehicle.now_ns

    def _wait(self, request: Request, shown: Callable[[], bool]) -> None:
        self._pending.append((request.identifier, self.vehicle.now_ns, shown))


class Pending:
    """A command, and its outcome once it has one."""

    def __init__(self, results: dict[int, Outcome], identifier: int) -> None:
        self._results, self._identifier = results, identifier

    def done(self) -> bool:
        return self._identifier in self._results

    def result(self) -> Outcome:
        return self._results[self._identifier]


class GuidanceHarness:
    """Autopilot, streamer and guidance in steps of `STEP_S` of a simulated clock.

    Args:
        options: of guidance.
        inputs: modifies the input of guidance.

    Attributes:
        streaming: the streamer runs.
        perception_age_s: of the newest, empty frame; None: none received.
        outputs: of guidance, one per step.
    """

    def __init__(
        self,
        vehicle: KinematicVehicle,
        lag_s: float = 0.0,
        class_names: tuple[str, ...] | None = None,
        options: GuidanceOptions | None = None,
        inputs: Callable[[GuidanceInput], GuidanceInput] = lambda inputs: inputs,
    ) -> None:
        self.autopilot = ScriptedAutopilot(vehicle, lag_s)
        self.events: list[GuidanceEvent] = []
        self.outputs: list[GuidanceOutput] = []
        self.path_requests: list[PathRequest] = []
        self._suspended_ns = 0
        self.watch = StandstillWatch(lambda: vehicle.now_ns, lambda: vehicle.now_ns - self._suspended_ns)
        self.streamer = Streamer(self.autopilot.setpoints.append, clock_ns=self.watch.now_ns)
        self.guidance = Guidance(options)
        self.vehicle = vehicle
        self.streaming = True
        self.perception_age_s: float | None = 0.05
        self.results: dict[int, Outcome] = {}
        self.table, self.marker_table, self.table_below = ObjectTable(), ObjectTable(), ObjectTable()
        self._class_names, self._inputs = class_names, inputs
        self._identifiers = itertools.count(1)

    @property
    def now_ns(self) -> int:
        """CLOCK_MONOTONIC of the companion; the vehicle's clock is CLOCK_BOOTTIME."""
        return self.vehicle.now_ns - self._suspended_ns

    def run(self, seconds: float = STEP_S) -> None:
        """Advance time."""
        for _ in range(max(1, round(seconds / STEP_S))):
            self.autopilot.step(STEP_S)
            self.step()
            if self.streaming:
                self.streamer.tick(self.watch.now_ns())

    def stand_still(self, seconds: float, *, suspended: bool) -> None:
        """The vehicle goes on alone: the computer is suspended, or the process is stopped (SIGSTOP)."""
        for _ in range(round(seconds / STEP_S)):
            self.autopilot.step(STEP_S)
            self._suspended_ns += round(STEP_S * 1e9) if suspended else 0

    def step(self, *commands: CommandInput, ending: bool = False) -> GuidanceOutput:
        """One step of guidance, now."""
        now_ns, age_s = self.now_ns, self.perception_age_s
        seen = self.watch.observe()
        inputs = GuidanceInput(
            self._state(),
            StreamStatus(self.streamer.state, self.streamer.sent_count),
            seen_ns=None if age_s is None else now_ns - round(age_s * 1e9),
            class_names=self._class_names,
            mode_changes=self.autopilot.mode_changes,
            answers=self.autopilot.take_answers(),
            commands=commands,
            ending=ending,
            standstill=seen.standstill,
        )
        output = self.guidance.step(now_ns, self._with_objects(self._inputs(inputs)))
        apply_output(
            output,
            self.streamer,
            start=self.autopilot.start,
            cancel=self.autopilot.cancel,
            send_landing_target=self.autopilot.landing_targets.append,
            send_obstacle_distance=self.autopilot.obstacle_distances.append,
            request_path=self.path_requests.append,
        )
        self.watch.acknowledge(seen)
        self.events += output.events
        self.outputs.append(output)
        self.results |= {result.identifier: result.outcome for result in output.results}
        return output

    def _with_objects(self, inputs: GuidanceInput) -> GuidanceInput:
        """The input with the objects that its targets and markers are, as `InputAssembler` makes them."""
        if inputs.seen_ns is not None:
            captured_ns = inputs.targets[0].captured_ns if inputs.targets else inputs.seen_ns
            self.table.update(inputs.targets, self.vehicle.position_ned_m, captured_ns)
        pairs = ((self.marker_table, inputs.steering_markers), (self.table_below, inputs.markers))
        for table, markers in pairs:
            if markers.captured_ns:
                seen = object_detections(markers.targets, self.vehicle.position_ned_m)
                table.update(seen, self.vehicle.position_ned_m, markers.captured_ns)
        return replace(
            inputs,
            objects=self.table.objects,
            marker_objects=self.marker_table.objects,
            objects_below=self.table_below.objects,
        )

    def _state(self) -> VehicleState:
        """The vehicle's state, stamped by the companion's clock."""
        state, late_ns = self.autopilot.state, self._suspended_ns
        if not late_ns:
            return state
        return with_fields(
            state,
            heartbeat_ns=state.heartbeat_ns - late_ns,
            position_ns=state.position_ns - late_ns,
            attitude_ns=state.attitude_ns - late_ns,
            battery_ns=state.battery_ns - late_ns,
        )

    def command(
        self, command: Behaviour | str | None = None, *, aim: GimbalAim | None = None, endless: bool = False
    ) -> Pending:
        """Give a command, as an operator writes it or as its behaviour, and step guidance once."""
        identifier = next(self._identifiers)
        behaviour = None if command is None else built(command)
        text = "gimbal" if behaviour is None else behaviour.name
        self.step(CommandInput(identifier, text, behaviour, aim, endless))
        return Pending(self.results, identifier)

    def silent(self, seconds: float) -> bool:
        """Advance time. True: no setpoint was sent."""
        before = len(self.autopilot.setpoints)
        self.run(seconds)
        return len(self.autopilot.setpoints) == before

    def close(self) -> None:
        """The service ends."""
        self.step(ending=True)

    def until(self, condition: Callable[[], object], seconds: float = 60.0) -> None:
        """Advance time until a condition holds. Raises AssertionError after `seconds`."""
        for _ in range(round(seconds / STEP_S)):
            if condition():
                return
            self.run()
        raise AssertionError(f"not in {seconds} s of flight: {[e.message for e in self.events]}")

    def outcome(self, pending: Pending, seconds: float = 120.0) -> Outcome:
        """The outcome of a command, once it has ended."""
        self.until(pending.done, seconds)
        return pending.result()


def built(command: Behaviour | str) -> Behaviour:
    """The behaviour of a command that is written as an operator does."""
    return parse(command).build(NO_CONTEXT) if isinstance(command, str) else command


def assert_succeeded(outcome: BehaviourOutput | None, *words: str) -> Outcome:
    """Assert a success whose reason contains all words."""
    assert isinstance(outcome, Outcome)
    assert outcome.success, outcome.reason
    assert [word for word in words if word not in outcome.reason] == [], outcome.reason
    return outcome


def assert_failed(outcome: BehaviourOutput | None, *words: str) -> Outcome:
    """Assert a failure whose reason contains all words."""
    assert isinstance(outcome, Outcome)
    assert not outcome.success, outcome.reason
    assert [word for word in words if word not in outcome.reason] == [], outcome.reason
    return outcome


def with_state(**changes: Any) -> Callable[[GuidanceInput], GuidanceInput]:
    """Inputs with another state."""
    return lambda inputs: replace(inputs, state=with_fields(inputs.state, **changes))


def known(value: T | None) -> T:
    """The value, which is there."""
    assert value is not None
    return value


def flying(mode: FlightMode = FlightMode.HOLD) -> KinematicVehicle:
    """In the air."""
    return KinematicVehicle(mode=mode)


def parked(mode: FlightMode = FlightMode.HOLD) -> KinematicVehicle:
    """On the ground, disarmed."""
    return KinematicVehicle(position=[0.0, 0.0, 0.0], mode=mode, armed=False, landed=LandedState.ON_GROUND)


def mission(
    flight: GuidanceHarness | LockstepFlight,
    *steps: str | Mapping[str, Any],
    each: Mapping[str, Any] = MappingProxyType({}),
    **top: Any,
) -> SequenceBehaviour:
    """A mission of commands, or of whole tables of steps. each: in every step. top: before the steps."""
    tables = [dict(each) | ({"do": step} if isinstance(step, str) else dict(step)) for step in steps]
    rows = [f"{key} = {value!r}" for key, value in top.items()]
    for table in tables:
        rows += ["[[step]]", *(f"{key} = {value!r}" for key, value in table.items())]
    return SequenceBehaviour(plan_from("\n".join(rows), "test.toml"), flight.guidance.check_requirements)


def hovering(vehicle: KinematicVehicle | None = None, **options: Any) -> GuidanceHarness:
    """A harness whose first states were received; by default in the air."""
    harness = GuidanceHarness(vehicle or flying(), **options)
    harness.run(0.1 + harness.autopilot.lag_s)
    return harness


def standing(**options: Any) -> GuidanceHarness:
    """The same on the ground, disarmed."""
    return hovering(parked(), **options)


def engaged(harness: GuidanceHarness, command: Behaviour | str = "hold") -> Pending:
    """Flying a command in OFFBOARD."""
    harness.run(0.1)
    pending = harness.command(command)
    harness.until(lambda: harness.guidance.phase is Phase.OFFBOARD, 5.0)
    harness.run(0.5)
    return pending


def kinds(harness: GuidanceHarness) -> list[EventKind]:
    """Kinds of the events so far, in order."""
    return [event.kind for event in harness.events]


@dataclass
class Flight:
    """A command flown through guidance, with a 10 Hz camera of 0.1 s latency.

    Attributes:
        command: as an operator writes it, or its behaviour.
        seconds: of its last step.
        steps: outputs of the behaviour in OFFBOARD, the last one its outcome.
        track: positions of the vehicle.
        notes: the behaviour's, and those of its objects.
    """

    command: Behaviour | str
    vehicle: KinematicVehicle = field(default_factory=KinematicVehicle)
    objects: Sequence[SeenObject] = ()
    perception_alive: bool = True
    noise: Callable[[], float] = lambda: 0.0
    limits: Limits = field(default_factory=Limits)
    camera_hz: float = 10.0
    latency_s: float = 0.1
    steps: list[BehaviourOutput] = field(default_factory=list)
    track: list[tuple[float, float, float]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    seconds: float = 0.0

    def __post_init__(self) -> None:
        self.behaviour = built(self.command)

    def distance_m(self, number: int = 0) -> float:
        """Over ground, from the vehicle to an object's surface now."""
        seen = self.objects[number]
        return math.dist(self.vehicle.position[:2], (seen.north, seen.east)) - seen.radius_m

    def off_nose_rad(self, number: int = 0) -> float:
        """Between the nose and the direction to an object now."""
        seen, (north, east, _) = self.objects[number], self.vehicle.position
        return abs(wrap_angle(math.atan2(seen.east - east, seen.north - north) - self.vehicle.yaw_rad))

    def run(
        self, seconds: float, each: Callable[[float, KinematicVehicle], None] = lambda t, v: None
    ) -> Outcome | None:
        """Fly until it ends; None after the time limit. `each(seconds, vehicle)` runs every step."""
        self.vehicle.mode = FlightMode.HOLD
        pending: list[tuple[int, tuple[Target, ...]]] = []
        shown: tuple[Target, ...] = ()
        newest_ns, next_frame_ns = 0, self.vehicle.now_ns

        def seen(inputs: GuidanceInput) -> GuidanceInput:
            return replace(inputs, targets=shown, seen_ns=newest_ns or None)

        harness = GuidanceHarness(self.vehicle, options=GuidanceOptions(self.limits), inputs=seen)
        recording = _Recording(self.behaviour, self.steps)
        command: Pending | None = None
        start_ns = self.vehicle.now_ns
        while self.vehicle.now_ns - start_ns < seconds * 1e9:
            now_ns = self.vehicle.now_ns
            self.seconds = (now_ns - start_ns) / 1e9
            each(self.seconds, self.vehicle)
            for scene_object in self.objects:
                scene_object.change(self.seconds)
            if now_ns >= next_frame_ns and self.perception_alive:
                pending.append((now_ns, look(self.vehicle, self.objects, now_ns, noise=self.noise)))
                next_frame_ns += round(1e9 / self.camera_hz)
            while pending and now_ns - pending[0][0] >= self.latency_s * 1e9:
                newest_ns, shown = pending.pop(0)
            if command is None:
                command = harness.command(recording)
            harness.run()
            self.track.append(self.vehicle.position_ned_m)
            self.notes = [event.message for event in harness.events if event.kind is EventKind.NOTED]
            if command.done():
                return command.result()
        return None


def flown(
    command: Behaviour | str,
    *objects: SeenObject,
    seconds: float = 90.0,
    each: Callable[[float, KinematicVehicle], None] = lambda t, v: None,
    **options: Any,
) -> tuple[Flight, Outcome | None]:
    """A flight with copies of the objects, and its outcome; None: it flies on."""
    flight = Flight(command, objects=[replace(seen) for seen in objects], **options)
    return flight, flight.run(seconds, each)


class _Recording(Behaviour):
    """Wraps a behaviour and records its outputs. Has no requirements."""

    def __init__(self, inner: Behaviour, steps: list[BehaviourOutput]) -> None:
        self._inner, self._steps = inner, steps
        self.name = inner.name

    def on_activate(self, context: BehaviourContext) -> None:
        self._inner.on_activate(context)

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        step = self._inner.update(dt_s, context)
        self._steps.append(step)
        return step

    def on_deactivate(self) -> None:
        self._inner.on_deactivate()

    def take_notes(self) -> Sequence[str]:
        return self._inner.take_notes()

    @property
    def active(self) -> Behaviour:
        return self._inner.active

    @property
    def status(self) -> str:
        return self._inner.status
