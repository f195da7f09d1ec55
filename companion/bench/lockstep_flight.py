"""Flights in lockstep: the service's own parts without asyncio, sockets or a clock, the same every time.

It flies `Guidance.step` with inputs from the service's `InputAssembler` and its setpoints through the
service's `Streamer`. Only the driver is another one, and the perception worker's process: a camera here is
either a detector made of the truth (`synthetic_camera`) or the rendered camera with the real pipeline
(`rendered_camera`); simulated time stands still while it computes.
"""

from __future__ import annotations

import itertools
import math
import os
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

from companion.bench.simulated_driver import GIMBAL_RATES_HZ, RATES_HZ, LockstepDriver, SimulatedDriver
from companion.guidance.behaviour import Behaviour, BehaviourContext, BehaviourOutput, Outcome, Requirement
from companion.guidance.behaviours.select import Select
from companion.guidance.command import GrammarError
from companion.guidance.core import Guidance, GuidanceOptions
from companion.guidance.interface import CommandInput, GuidanceEvent, StreamStatus
from companion.guidance.limits.envelope import Limits
from companion.guidance.limits.obstacles import ObstacleRules
from companion.guidance.mode_control import Phase
from companion.guidance.motion import position_and_yaw
from companion.guidance.objects.from_detections import StateHistory
from companion.perception.cameras import PerceptionCamera
from companion.service.factory import guidance_options, streamer_of
from companion.service.inputs import InputAssembler
from companion.service.requests import apply_output
from companion.settings import Settings
from companion.settings.reading import load_settings
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import Vector3, VehicleState
from mavlink_sim.lockstep import LockstepVehicle, Truth
from vision.pipeline import PerceptionResult

TICK_S = 0.01
WARM_UP_S = 1.5
# An envelope of setpoints is not one of gusts: by so much the truth may be beyond a limit.
SPEED_TOLERANCE_MPS = 1.0
PLACE_TOLERANCE_M = 0.5


class Camera(Protocol):
    """A camera with its perception, in lockstep.

    Attributes:
        perceived: what its results are placed by.
        rate_hz: frames a second. latency_s: from capture until what it shows can steer.
    """

    perceived: PerceptionCamera
    rate_hz: float
    latency_s: float

    def on_state(self, state: VehicleState, history: StateHistory) -> None:
        """A new snapshot of the vehicle, already in the history, as it is sent to the perception worker."""

    def capture(self, flight: LockstepFlight) -> Callable[[], PerceptionResult | None]:
        """Take a frame now. What is returned is called when its result is due; None: the frame is lost."""


@dataclass(frozen=True, slots=True)
class Moment:
    """One step of guidance that was flown by setpoints. `seconds` since the command was given."""

    seconds: float
    truth: Truth
    context: BehaviourContext
    asked: Setpoint
    sent: Setpoint
    limited_by: tuple[str, ...]


@dataclass
class FlightLog:
    """How it went.

    Attributes:
        outcome: how the command ended; None: it flew on until the time was over.
        violations: every kind of limit that was left, in words, once each with the worst value.
    """

    outcome: Outcome | None = None
    moments: list[Moment] = field(default_factory=list)
    violations: dict[str, float] = field(default_factory=dict)


def vehicle_in_the_air(
    *, seed: int, height_m: float = 5.0, wind_mps: float = 0.0, **options: Any
) -> LockstepVehicle:
    """A vehicle in HOLD, with the streams of `SimulatedDriver`.

    Arguments and errors as `LockstepFlight.airborne`.
    """
    rates_hz = RATES_HZ | GIMBAL_RATES_HZ if options.get("gimbal") else RATES_HZ
    vehicle = LockstepVehicle({"onboard": rates_hz}, seed=seed, wind_mps=wind_mps, **options)
    vehicle.take_off(height_m, limit_s=90.0)
    vehicle.receive()  # the take-off's messages, of no use: a copy is made in an eighth of the time
    return vehicle


class LockstepFlight:
    """One vehicle with its guidance.

    Args:
        driver: the vehicle.
        settings: as the service reads them.
        cameras: the first is the first camera's of the settings, and so on; none: nothing is seen.
        options: replace what the settings say.

    Attributes:
        events: every event of guidance.
        state_words: what the active behaviours were doing, as it changed (their status up to a comma).
    """

    def __init__(
        self,
        driver: LockstepDriver,
        settings: Settings,
        cameras: Sequence[Camera] = (),
        options: GuidanceOptions | None = None,
    ) -> None:
        self.driver, self.settings, self.cameras = driver, settings, tuple(cameras)
        self.notes: list[tuple[str, str]] = []
        perceived = [camera.perceived for camera in cameras] or [PerceptionCamera(settings.of_camera(None))]
        self.inputs = InputAssembler(
            settings, perceived, lambda level, text: self.notes.append((level, text))
        )
        if isinstance(driver, SimulatedDriver):
            self.inputs.parameters = driver.parameters
        self.guidance = Guidance(options or guidance_options(settings))
        self.streamer = streamer_of(settings, driver.send_setpoint, lambda: driver.now_ns)
        self.events: list[GuidanceEvent] = []
        self.state_words: list[str] = []
        self.begun_ns = driver.now_ns
        self._scene_begun_ns: int | None = driver.now_ns
        self._identifiers = itertools.count(1)
        self._new: list[CommandInput] = []
        self._ending = False
        self._results: dict[int, Outcome] = {}
        self._next_frame_ns = [driver.now_ns] * len(self.cameras)
        self._late: deque[tuple[int, PerceptionCamera, Callable[[], PerceptionResult | None]]] = deque()
        self._step_due_ns = self._stream_due_ns = driver.now_ns
        self._seen_state: VehicleState | None = None
        self._take_state()

    @classmethod
    def airborne(
        cls,
        *,
        seed: int,
        height_m: float = 5.0,
        wind_mps: float = 0.0,
        camera: Callable[[LockstepVehicle], Camera] | None = None,
        settings: Settings | None = None,
        limits: Limits | None = None,
        rules: ObstacleRules | None = None,
        **options: Any,
    ) -> LockstepFlight:
        """The simulated vehicle in the air, in HOLD.

        Args:
            height_m: above home, where the flight begins.
            wind_mps, seed: of the vehicle; the direction of the wind follows from the seed.
            camera: makes the camera of a vehicle. limits, rules: replace what the settings say.
            options: further ones of `LockstepVehicle`.

        Raises:
            NotReachedError, CommandRefusedError: the vehicle did not take off.
        """
        vehicle = vehicle_in_the_air(seed=seed, height_m=height_m, wind_mps=wind_mps, **options)
        seen = None if camera is None else camera(vehicle)
        return cls.of_vehicle(vehicle, camera=seen, settings=settings, limits=limits, rules=rules)

    @classmethod
    def of_vehicle(
        cls,
        vehicle: LockstepVehicle,
        *,
        camera: Camera | None = None,
        settings: Settings | None = None,
        limits: Limits | None = None,
        rules: ObstacleRules | None = None,
    ) -> LockstepFlight:
        """As `airborne`, with a vehicle that is ready, for example a copy of `vehicle_in_the_air`."""
        chosen = settings or (plain_settings() if camera is None else camera.perceived.settings)
        guided = guidance_options(chosen)
        guided = replace(guided, limits=limits or guided.limits, obstacles=rules or guided.obstacles)
        driver = SimulatedDriver(vehicle, range_finder_height=chosen.guidance.range_finder_height)
        return cls(driver, chosen, [] if camera is None else [camera], guided)

    @property
    def vehicle(self) -> LockstepVehicle:
        """The simulated vehicle. Raises TypeError where another one is flown."""
        if not isinstance(self.driver, SimulatedDriver):
            raise TypeError(f"{type(self.driver).__name__} is not the simulated vehicle")
        return self.driver.vehicle

    @property
    def state(self) -> VehicleState:
        """The telemetry of the vehicle."""
        return self.driver.state

    @property
    def now_ns(self) -> int:
        """The flight's clock."""
        return self.driver.now_ns

    @property
    def seconds(self) -> float:
        """Since the newest command of `fly`."""
        return (self.driver.now_ns - self.begun_ns) / 1e9

    @property
    def scene_seconds(self) -> float:
        """Time of what moves in the scene: as `seconds`; 0 while the vehicle turns and perception warms up.

        Otherwise everything would jump back to its beginning when the command is given.
        """
        return 0.0 if self._scene_begun_ns is None else (self.driver.now_ns - self._scene_begun_ns) / 1e9

    # --- commands ----------------------------------------------------------------------------------------

    def command(self, command: str | Behaviour) -> int:
        """Give a command, for the next step. Returns its identifier; see `outcome`.

        Raises:
            GrammarError, MissionError: the text is none.
        """
        identifier = next(self._identifiers)
        if isinstance(command, str):
            read = self.inputs.read_command(identifier, command, self.state, self.guidance.check_requirements)
            if isinstance(read, Select):
                raise GrammarError("select: here by `RenderedCamera.select`")
        else:
            read = CommandInput(identifier, command.name, command)
        self._new.append(read)
        self._step_due_ns = self.now_ns
        return identifier

    def outcome(self, identifier: int) -> Outcome | None:
        """How a command ended; None: it has not."""
        return self._results.get(identifier)

    def fly(
        self,
        command: str | Behaviour,
        limit_s: float,
        each: Callable[[Moment], None] = lambda moment: None,
        on_tick: Callable[[], None] = lambda: None,
        warm_up_s: float = WARM_UP_S,
    ) -> FlightLog:
        """Fly it until it ends or the time is over.

        Args:
            each: called with every step of guidance that is flown by setpoints.
            on_tick: called with every tick.
            warm_up_s: perception is at work before the command comes.
        """
        log = FlightLog()
        self._scene_begun_ns = None
        self.run(warm_up_s)
        self.begun_ns = self.now_ns
        if not isinstance(command, _Turn):
            self._scene_begun_ns = self.now_ns
        identifier = self.command(command)
        while self.seconds < limit_s:
            stepped = self.tick()
            on_tick()
            log.outcome = self.outcome(identifier)
            if log.outcome is not None:
                break
            moment = self._moment() if stepped else None
            if moment is not None:
                log.moments.append(moment)
                self._judge(moment, log)
                each(moment)
        return log

    def turn_to(self, yaw_rad: float, limit_s: float = 15.0) -> None:
        """Turn on the spot before the flight that counts."""
        self.fly(_Turn(yaw_rad), limit_s, warm_up_s=0.0)

    def run(self, seconds: float) -> None:
        """Let time pass."""
        for _ in range(round(seconds / TICK_S)):
            self.tick()

    def run_until(self, condition: Callable[[], object], limit_s: float) -> bool:
        """Let time pass until something is so; whether it came to be."""
        until_ns = self.now_ns + limit_s * 1e9
        while not condition():
            if self.now_ns >= until_ns:
                return False
            self.tick()
        return True

    # --- time --------------------------------------------------------------------------------------------

    def tick(self) -> bool:
        """`TICK_S` of everything; whether guidance was stepped."""
        now_ns = self.now_ns
        for index, camera in enumerate(self.cameras):
            if now_ns >= self._next_frame_ns[index]:
                self._next_frame_ns[index] += round(1e9 / camera.rate_hz)
                due_ns = now_ns + round(camera.latency_s * 1e9)
                self._late.append((due_ns, camera.perceived, camera.capture(self)))
        seen = self._deliver(now_ns)
        stepped = seen or now_ns >= self._step_due_ns
        if stepped:
            self._step_due_ns = now_ns + round(1e9 / self.settings.guidance.rate_hz)
            self.step()
        if seen:
            self.streamer.send_now(now_ns)
        if now_ns >= self._stream_due_ns:
            self._stream_due_ns += round(1e9 / self.settings.guidance.setpoint_rate_hz)
            self.streamer.tick(now_ns)
        self.driver.step(TICK_S)
        self._take_state()
        return stepped

    def step(self, *, ending: bool = False) -> None:
        """One step of guidance, now. `ending`: from now on as in a shutdown."""
        self._ending |= ending
        now_ns = self.now_ns
        commands, self._new = tuple(self._new), []
        output = self.guidance.step(
            now_ns,
            self.inputs.assemble(
                now_ns,
                self.state,
                StreamStatus(self.streamer.state, self.streamer.sent_count),
                answers=self.driver.take_answers(),
                commands=commands,
                ending=self._ending,
            ),
        )
        apply_output(
            output,
            self.streamer,
            start=self.driver.start,
            cancel=self.driver.cancel,
            send_landing_target=self.driver.send_landing_target,
            send_obstacle_distance=self.driver.send_obstacle_distance,
            request_path=self.inputs.steering.request_path,
        )
        self.events += output.events
        self._results |= {result.identifier: result.outcome for result in output.results}
        if self.guidance.behaviour is not None:
            words = self.guidance.behaviour.status.split(",")[0]
            if not self.state_words or self.state_words[-1] != words:
                self.state_words.append(words)

    def _deliver(self, now_ns: int) -> bool:
        """The results that are due; whether the steering camera has seen something."""
        seen = False
        while self._late and self._late[0][0] <= now_ns:
            _, camera, finish = self._late.popleft()
            result = finish()
            if result is None:
                continue
            camera.update(result)
            markers = self.inputs.on_result(camera, result)
            if markers is not None and markers.vision is not None:
                self.driver.send_vision_position(markers.vision)
            seen = seen or camera is self.inputs.steering or markers is not None
        return seen

    def _take_state(self) -> None:
        state = self.driver.state
        if state is not self._seen_state:
            self._seen_state = state
            self.inputs.on_state(state)
            for camera in self.cameras:
                camera.on_state(state, self.inputs.history)

    def _moment(self) -> Moment | None:
        guidance, setpoints = self.guidance, self.guidance.setpoints
        active = guidance.phase is Phase.OFFBOARD and guidance.busy
        if not active or setpoints.asked is None or setpoints.sent is None or guidance.context is None:
            return None
        return Moment(
            self.seconds,
            self.vehicle.truth,
            guidance.context,
            setpoints.asked,
            setpoints.sent,
            setpoints.limited_by,
        )

    def _judge(self, moment: Moment, log: FlightLog) -> None:
        """Against the limits: what was sent, exactly; what was flown, by the truth, within the tolerances."""
        limits, truth = self.guidance.options.limits, moment.truth
        north, east, down = truth.velocity_ned_mps
        home = moment.context.state.home_position_ned_m or (0.0, 0.0, 0.0)
        height_m = truth.height_m
        away = (truth.position_ned_m[0] - home[0], truth.position_ned_m[1] - home[1])
        landing = self.guidance.behaviour is not None and self.guidance.behaviour.active.landing
        active = {
            "speed": math.hypot(north, east) - limits.max_horizontal_speed_mps - SPEED_TOLERANCE_MPS,
            "climb": -down - limits.max_climb_mps - SPEED_TOLERANCE_MPS,
            "descent": down - limits.max_descend_mps - SPEED_TOLERANCE_MPS,
            "height": height_m - limits.max_altitude_m - PLACE_TOLERANCE_M,
            "lowness": 0.0 if landing else limits.min_altitude_m - PLACE_TOLERANCE_M - height_m,
            "distance": math.hypot(*away) - limits.max_distance_m - PLACE_TOLERANCE_M,
            "fence": 0.0 if limits.fence.contains(away) else 1.0,
            "crash": 1.0 if truth.crashed or (truth.on_ground and not landing) else 0.0,
        }
        if moment.sent.velocity_ned_mps is not None:
            north, east, down = moment.sent.velocity_ned_mps
            active["speed sent"] = math.hypot(north, east) - limits.max_horizontal_speed_mps * (1 + 1e-9)
            active["climb sent"] = -down - limits.max_climb_mps * (1 + 1e-9)
            active["descent sent"] = down - limits.max_descend_mps * (1 + 1e-9)
        for what, by in active.items():
            if by > 0.0:
                log.violations[what] = max(by, log.violations.get(what, 0.0))


def plain_settings(changes: Mapping[str, str] | None = None) -> Settings:
    """The default settings with changes, whatever is configured on this machine."""
    return load_settings(os.devnull, dict(changes or {}), {})


class _Turn(Behaviour):
    """Turns on the spot; ends when the nose is there."""

    name = "turn"
    requirements = frozenset({Requirement.POSITION, Requirement.IN_AIR})

    def __init__(self, yaw_rad: float) -> None:
        self._yaw_rad = yaw_rad
        self._place: Vector3 | None = None

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        position, yaw_rad = position_and_yaw(context.state)
        if self._place is None:
            self._place = position
        if abs(math.remainder(yaw_rad - self._yaw_rad, math.tau)) < 0.05:
            return Outcome(True, "turned")
        return Setpoint.position(self._place, context.now_ns, yaw_rad=self._yaw_rad)
