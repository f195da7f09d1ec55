"""A behaviour flown with the built-in vehicle in lockstep: no sockets, no clock, the same every time.

What a flight in the service has is here too, with the service's own parts: telemetry as messages, folded into
the state; targets from boxes through the history of poses; the envelope; setpoints at 50 Hz. In place of the
network stands a detector made of the truth (`drawn_detector`), whose results come late and pass a
tracker.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from companion.guidance.behaviour import Behaviour, ModeRequest, Outcome, Situation
from companion.guidance.envelope import Envelope, Limited, Limits
from companion.guidance.gimbal_control import GimbalAsk, GimbalControl, GimbalRequest
from companion.guidance.gimbal_sight import GimbalSight
from companion.guidance.obstacles import NO_RULES, ObstacleMemory, ObstacleRules
from companion.guidance.target import Target
from companion.guidance.targets import HistoryError, StateHistory, mount_at, targets_from_detections
from companion.settings.perception import DetectorSection
from companion.vehicle.gimbal import GimbalAim
from companion.vehicle.gimbal_commands import CONFIGURE, FOLLOWING_NOSE, PITCHYAW, RELEASE, UNCHANGED
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import Vector3, VehicleState
from companion.vehicle.telemetry_fold import FOLDED_MESSAGES, fold
from mavlink_sim.lockstep import COMPANION, LockstepVehicle, Truth
from mavlink_sim.wire.messages import dialect
from vision.attitude import Quaternion
from vision.camera_model import CameraModel, CameraMount
from vision.detections import Detections
from vision.tracking import AttitudeHistory, CameraView, Tracker, TrackerSettings

# What the drivers ask of an autopilot (`manners.Manners.rates_hz`), and home.
RATES_HZ = {
    "HEARTBEAT": 1.0,
    "ATTITUDE_QUATERNION": 50.0,
    "LOCAL_POSITION_NED": 30.0,
    "GLOBAL_POSITION_INT": 5.0,
    "SYS_STATUS": 2.0,
    "EXTENDED_SYS_STATE": 5.0,
    "CURRENT_MODE": 10.0,
    "HOME_POSITION": 0.5,
}
# The same where there is a gimbal (`gimbal_commands`).
GIMBAL_RATES_HZ = {"GIMBAL_DEVICE_ATTITUDE_STATUS": 50.0, "GIMBAL_MANAGER_STATUS": 5.0}
TICK_S = 0.01
WARM_UP_S = 1.5
GUIDANCE_TICKS = 5  # 20 Hz, the default of guidance.rate_hz
SETPOINT_RATE_HZ = 50.0
PERCEPTION_MAX_AGE_S = 0.5
START_NS = 1_000_000_000_000
# An envelope of setpoints is not one of gusts: by so much the truth may be beyond a limit.
SPEED_TOLERANCE_MPS = 1.0
PLACE_TOLERANCE_M = 0.5
_HEIGHTS_M = DetectorSection().heights()
_GIMBAL_MANAGER_INFORMATION_ID = 280
_GIMBAL_COMMANDS = (PITCHYAW, CONFIGURE)


@dataclass(frozen=True, slots=True)
class Sight:
    """A detector in lockstep.

    Attributes:
        camera, mount: as the service has them.
        detect: true position (NED), true attitude (FRD to NED) and seconds of the flight → detections.
        rate_hz: frames a second. latency_s: from capture until the result can steer.
        tracker: how identities are given; None: no tracking.
    """

    camera: CameraModel
    mount: CameraMount
    detect: Callable[[Vector3, Quaternion, float], Detections]
    rate_hz: float = 15.0
    latency_s: float = 0.08
    tracker: TrackerSettings | None = field(default_factory=TrackerSettings)


@dataclass(frozen=True, slots=True)
class Moment:
    """One turn of guidance. `seconds` since the behaviour began."""

    seconds: float
    truth: Truth
    situation: Situation
    asked: Setpoint
    sent: Setpoint
    limited_by: tuple[str, ...]


@dataclass
class FlightLog:
    """How it went.

    Attributes:
        outcome: how the behaviour ended; None: it flew on until the time was over.
        violations: every kind of limit that was left, in words, told once with its worst.
    """

    outcome: Outcome | None = None
    moments: list[Moment] = field(default_factory=list)
    violations: dict[str, float] = field(default_factory=dict)

    def violated(self, what: str, by: float) -> None:
        """Remember the worst of each kind."""
        self.violations[what] = max(by, self.violations.get(what, 0.0))


class LockstepFlight:
    """One vehicle, in the air and in OFFBOARD, that a behaviour can fly.

    Args:
        height_m: above home, where the behaviour begins.
        sight: what it sees with; None: nothing.
        wind_mps, seed: of the vehicle; the direction of the wind follows from the seed.
        options: further ones of `LockstepVehicle`; with `gimbal` it is moved as the service does.

    Raises:
        NotReachedError, CommandRefusedError: the vehicle did not take off.
    """

    def __init__(
        self,
        *,
        seed: int,
        height_m: float = 5.0,
        wind_mps: float = 0.0,
        sight: Sight | None = None,
        limits: Limits | None = None,
        **options: Any,
    ) -> None:
        gimbal = bool(options.get("gimbal", False))
        rates_hz = RATES_HZ | GIMBAL_RATES_HZ if gimbal else RATES_HZ
        self.vehicle = LockstepVehicle({"onboard": rates_hz}, seed=seed, wind_mps=wind_mps, **options)
        self.gimbal = GimbalControl(COMPANION) if gimbal else None
        self.limits = limits or Limits()
        self.state = VehicleState()
        self.history = StateHistory()
        self._attitudes = AttitudeHistory()
        self._sight = sight
        tracked = sight is not None and sight.tracker is not None
        self._tracker = Tracker(sight.tracker) if sight is not None and tracked else None
        self._late: deque[tuple[int, int, Detections]] = deque()
        self._targets: tuple[Target, ...] = ()
        self._seen_ns: int | None = None
        if gimbal:
            self.vehicle.command(dialect.MAV_CMD_REQUEST_MESSAGE, _GIMBAL_MANAGER_INFORMATION_ID)
        self.vehicle.take_off(height_m)
        still = Setpoint.brake(self.now_ns)
        self._stream = self.vehicle.repeat(setpoint_message(still), SETPOINT_RATE_HZ)
        self.vehicle.step(0.5)
        self._take()
        self.vehicle.set_mode("OFFBOARD")
        self._take()
        self.begun_s = self.vehicle.now_s
        self._next_frame_s = self.vehicle.now_s

    @property
    def now_ns(self) -> int:
        """The flight's clock, as CLOCK_MONOTONIC would be."""
        return START_NS + round(self.vehicle.now_s * 1e9)

    @property
    def seconds(self) -> float:
        """Since OFFBOARD."""
        return self.vehicle.now_s - self.begun_s

    def turn_to(self, yaw_rad: float, limit_s: float = 15.0) -> None:
        """Turn on the spot before the behaviour begins."""
        self._stream.message = setpoint_message(
            Setpoint.velocity((0.0, 0.0, 0.0), self.now_ns, yaw_rad=yaw_rad)
        )
        self.vehicle.run_until(
            lambda truth: abs(math.remainder(truth.yaw_rad - yaw_rad, math.tau)) < 0.05, limit_s
        )
        self._take()
        self.begun_s = self._next_frame_s = self.vehicle.now_s

    def fly(
        self,
        behaviour: Behaviour,
        limit_s: float,
        each: Callable[[Moment], None] | None = None,
        situated: Callable[[Situation], Situation] = lambda situation: situation,
        rules: ObstacleRules = NO_RULES,
    ) -> FlightLog:
        """Fly it until it ends or the time is over.

        Args:
            each: called with every turn of guidance.
            situated: adds what the service would to what the behaviour sees.
            rules: for the obstacles that `situated` tells of.

        Raises:
            TypeError: the behaviour asks for a mode of the autopilot's own.
        """
        log, envelope, memory = FlightLog(), Envelope(self.limits), ObstacleMemory()
        self._watch(WARM_UP_S)
        self.begun_s = self.vehicle.now_s
        sent, activated, stepped_ns, ticks = None, False, self.now_ns, 0
        while self.seconds < limit_s:
            if ticks % GUIDANCE_TICKS == 0:
                now_ns = self.now_ns
                situation = situated(replace(self._situation(now_ns), sent=sent))
                dt_s = (now_ns - stepped_ns) / 1e9
                stepped_ns = now_ns
                if not activated:
                    behaviour.on_activate(situation)
                    activated = True
                step = behaviour.update(dt_s, situation)
                self._move_gimbal(now_ns, behaviour, isinstance(step, Outcome))
                if isinstance(step, Outcome):
                    log.outcome = step
                    break
                if isinstance(step, ModeRequest):
                    raise TypeError(
                        f"{behaviour.name} asks for {step.mode.value}: only setpoints are flown here"
                    )
                envelope.near = rules.rows(memory.filled(situation))
                if (blind := rules.blind(situation)) is not None:
                    envelope.reset()
                    sent, reasons = Limited(Setpoint.brake(now_ns), (blind,))
                else:
                    sent, reasons = envelope.apply(step, situation.state, now_ns, dt_s)
                self._stream.message = setpoint_message(sent)
                moment = Moment(self.seconds, self.vehicle.truth, situation, step, sent, reasons)
                log.moments.append(moment)
                self._judge(moment, log)
                if each is not None:
                    each(moment)
            self._pass_tick()
            ticks += 1
        return log

    def move_gimbal_on(self, seconds: float = 1.0) -> None:
        """Nothing flies any more: what was taken is given back."""
        for _ in range(round(seconds / TICK_S)):
            self._ask_gimbal(self.now_ns, None, None)
            self._pass_tick()

    def _watch(self, seconds: float) -> None:
        """Perception is at work before a command comes: stand still and let it see."""
        for _ in range(round(seconds / TICK_S)):
            self._pass_tick()

    def _pass_tick(self) -> None:
        now_s = self.vehicle.now_s
        if self._sight is not None and now_s >= self._next_frame_s:
            self._look(self._sight)
            self._next_frame_s += 1.0 / self._sight.rate_hz
        self.vehicle.step(TICK_S)
        self._take()
        self._show()

    def _situation(self, now_ns: int) -> Situation:
        age_s = None if self._seen_ns is None else (now_ns - self._seen_ns) / 1e9
        fresh = age_s is not None and age_s <= PERCEPTION_MAX_AGE_S
        carried = self._sight is not None and self._sight.mount.on_gimbal
        problem = "" if self.gimbal is None else self.gimbal.problem
        return Situation(
            now_ns,
            self.state,
            self._targets if fresh else (),
            age_s,
            fresh,
            gimbal=GimbalSight(
                carried,
                problem=problem,
                camera_pitch_rad=0.0 if self._sight is None else self._sight.mount.pitch_rad,
            ),
        )

    def _move_gimbal(self, now_ns: int, behaviour: Behaviour, ended: bool) -> None:
        """As `GimbalHand` does, without waiting."""
        flown = None if ended else behaviour.flown
        self._ask_gimbal(now_ns, None if flown is None else flown.gimbal_aim, flown)

    def _ask_gimbal(self, now_ns: int, aim: GimbalAim | None, owner: object | None) -> None:
        if self.gimbal is None:
            return
        request = self.gimbal.update(now_ns, self.state.gimbal, aim, owner)
        if request is not None:
            self.vehicle.send(gimbal_message(request))

    def _take(self) -> None:
        """Messages into the state, as the driver does."""
        now_ns = self.now_ns
        for message in self.vehicle.receive():
            name = message.get_type()
            if name == "COMMAND_ACK" and message.command in _GIMBAL_COMMANDS and self.gimbal is not None:
                self.gimbal.answered(now_ns, None if message.result == 0 else f"result {message.result}")
            if name in FOLDED_MESSAGES:
                self.state = fold(self.state, name, message.to_dict(), now_ns)
        self.history.add(self.state)
        if self.state.attitude is not None:
            self._attitudes.add(self.state.attitude_ns, self.state.attitude)

    def _look(self, sight: Sight) -> None:
        truth = self.vehicle.truth
        detections = sight.detect(truth.position_ned_m, truth.quaternion, self.seconds)
        now_ns = self.now_ns
        self._late.append((now_ns + round(sight.latency_s * 1e9), now_ns, detections))

    def _show(self) -> None:
        """What has arrived: through the tracker, into the level frame."""
        sight = self._sight
        while sight is not None and self._late and self._late[0][0] <= self.now_ns:
            _, captured_ns, detections = self._late.popleft()
            if self._tracker is not None:
                view = self._view(sight, captured_ns)
                detections = self._tracker.update(detections, captured_ns, view).detections
            self._seen_ns = captured_ns
            try:
                self._targets = targets_from_detections(
                    detections.records(), captured_ns, sight.camera, sight.mount, self.history, _HEIGHTS_M
                )
            except HistoryError:
                self._targets = ()  # as in the service: seen, not steered by

    def _view(self, sight: Sight, captured_ns: int) -> CameraView | None:
        ned_from_body = self._attitudes.at(captured_ns)
        if ned_from_body is None:
            return None
        try:
            mount = mount_at(sight.mount, self.history, captured_ns)
        except HistoryError:
            return None
        return CameraView(sight.camera, mount.ned_from_optical(ned_from_body))

    def _judge(self, moment: Moment, log: FlightLog) -> None:
        """Against the limits: what was sent, exactly; what was flown, by the truth, within the tolerances."""
        limits, truth = self.limits, moment.truth
        north, east, down = truth.velocity_ned_mps
        home = moment.situation.state.home_position_ned_m or (0.0, 0.0, 0.0)
        height_m = truth.height_m
        away = (truth.position_ned_m[0] - home[0], truth.position_ned_m[1] - home[1])
        flown = {
            "speed": math.hypot(north, east) - limits.max_horizontal_speed_mps - SPEED_TOLERANCE_MPS,
            "climb": -down - limits.max_climb_mps - SPEED_TOLERANCE_MPS,
            "descent": down - limits.max_descend_mps - SPEED_TOLERANCE_MPS,
            "height": height_m - limits.max_altitude_m - PLACE_TOLERANCE_M,
            "lowness": limits.min_altitude_m - PLACE_TOLERANCE_M - height_m,
            "distance": math.hypot(*away) - limits.max_distance_m - PLACE_TOLERANCE_M,
            "fence": 0.0 if limits.fence.holds(away) else 1.0,
            "crash": 1.0 if truth.crashed or truth.on_ground else 0.0,
        }
        if moment.sent.velocity_ned_mps is not None:
            north, east, down = moment.sent.velocity_ned_mps
            flown["speed sent"] = math.hypot(north, east) - limits.max_horizontal_speed_mps * (1 + 1e-9)
            flown["climb sent"] = -down - limits.max_climb_mps * (1 + 1e-9)
            flown["descent sent"] = down - limits.max_descend_mps * (1 + 1e-9)
        for what, by in flown.items():
            if by > 0.0:
                log.violated(what, by)


def setpoint_message(setpoint: Setpoint) -> object:
    """SET_POSITION_TARGET_LOCAL_NED as the drivers send it."""
    zero = (0.0, 0.0, 0.0)  # the type mask says what counts
    return dialect.MAVLink_set_position_target_local_ned_message(
        0,
        1,
        1,
        dialect.MAV_FRAME_LOCAL_NED,
        setpoint.type_mask,
        *(setpoint.position_ned_m or zero),
        *(setpoint.velocity_ned_mps or zero),
        *zero,
        setpoint.yaw_rad or 0.0,
        setpoint.yaw_rate_radps or 0.0,
    )


def gimbal_message(request: GimbalRequest) -> object:
    """What is asked of a gimbal's manager, as the drivers send it."""
    if request.aim is not None:
        pitch, yaw = math.degrees(request.aim.pitch_rad), math.degrees(request.aim.yaw_rad)
        values = (pitch, yaw, math.nan, math.nan, FOLLOWING_NOSE, 0.0, 0.0)
        return dialect.MAVLink_command_long_message(1, 1, PITCHYAW, 0, *values)
    who = (RELEASE, RELEASE) if request.ask is GimbalAsk.GIVE_BACK else COMPANION
    return dialect.MAVLink_command_long_message(1, 1, CONFIGURE, 0, *who, UNCHANGED, UNCHANGED, 0.0, 0.0, 0.0)
