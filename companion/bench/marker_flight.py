"""A landing on a marker in lockstep, with the service's own parts: no sockets, no clock, the same every time.

Telemetry comes as messages folded into the state; the markers of a frame become places through the history of
poses; setpoints pass the envelope and go out at 50 Hz; the autopilot's own modes are asked for by command.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from companion.bench.lockstep_flight import setpoint_message
from companion.guidance.behaviour import Behaviour, ModeRequest, Outcome, Situation
from companion.guidance.envelope import Envelope, Limits
from companion.guidance.marker_target import MarkerSight, MarkerTarget, marker_targets
from companion.guidance.targets import HistoryError, StateHistory
from companion.vehicle.landing_target import landing_target_fields
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, VehicleState
from companion.vehicle.telemetry_fold import FOLDED_MESSAGES, fold
from mavlink_sim.lockstep import LockstepVehicle, Truth
from mavlink_sim.wire.messages import dialect
from vision.camera_model import CameraMount
from vision.markers import Marker, PadMarker

RATES_HZ = {
    "HEARTBEAT": 1.0,
    "ATTITUDE_QUATERNION": 50.0,
    "LOCAL_POSITION_NED": 30.0,
    "SYS_STATUS": 2.0,
    "EXTENDED_SYS_STATE": 5.0,
    "CURRENT_MODE": 10.0,
    "HOME_POSITION": 0.5,
}
TICK_S = 0.01
GUIDANCE_TICKS = 5  # 20 Hz, the default of guidance.rate_hz
SETPOINT_RATE_HZ = 50.0
MAX_AGE_S = 0.5  # guidance.perception_max_age_s
START_NS = 1_000_000_000_000
AUTOPILOT_PX4 = 12
_MODES = {FlightMode.LAND: "LAND", FlightMode.PRECISION_LAND: "PRECLAND", FlightMode.HOLD: "HOLD"}

# What a frame shows at the true state of the vehicle and a time of the flight; None: the frame is missed.
Look = Callable[[Truth, float], tuple[Marker, ...] | None]


@dataclass
class LandingFlight:
    """One vehicle in lockstep that a behaviour lands.

    Attributes:
        vehicle: not yet in the air.
        mount: of the camera, as the service believes it to be.
        look: the camera.
        rate_hz: frames a second. latency_s: from capture until what it shows can steer.
        states: phase words of the behaviour, as they changed.
    """

    vehicle: LockstepVehicle
    mount: CameraMount
    look: Look
    on_pads: Mapping[int, PadMarker] = field(default_factory=dict)
    rate_hz: float = 20.0
    latency_s: float = 0.08
    limits: Limits = field(default_factory=Limits)
    states: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.state = VehicleState()
        self._history = StateHistory()
        self._late: deque[tuple[int, int, tuple[Marker, ...]]] = deque()
        self._seen: tuple[MarkerTarget, ...] = ()
        self._seen_ns = 0
        self._told_ns = 0
        self._stream = self.vehicle.repeat(setpoint_message(Setpoint.brake(0)), SETPOINT_RATE_HZ)
        self._stream.stop()
        self._offboard = False

    @property
    def now_ns(self) -> int:
        """The flight's clock, as CLOCK_MONOTONIC would be."""
        return START_NS + round(self.vehicle.now_s * 1e9)

    def fly(
        self, behaviour: Behaviour, limit_s: float, each: Callable[[Truth], None] = lambda truth: None
    ) -> Outcome:
        """Fly it from here until it ends.

        Args:
            each: called with every turn of guidance.

        Raises:
            CommandRefusedError, NotReachedError: the vehicle did not take a mode.
        """
        envelope, sent = Envelope(self.limits), None
        begun_s, frames, ticks, activated = self.vehicle.now_s, 0, 0, False
        stepped_ns = self.now_ns
        requested: FlightMode | None = None
        while (seconds := self.vehicle.now_s - begun_s) < limit_s:
            if seconds >= frames / self.rate_hz:
                self._capture(seconds)
                frames += 1
            self._show()
            if ticks % GUIDANCE_TICKS == 0:
                now_ns = self.now_ns
                situation = Situation(now_ns, self.state, sent=sent, markers=self._sight(now_ns))
                dt_s, stepped_ns = (now_ns - stepped_ns) / 1e9, now_ns
                if not activated:
                    behaviour.on_activate(situation)
                    activated = True
                step = behaviour.update(dt_s, situation)
                words = behaviour.status.split(",")[0]
                if not self.states or self.states[-1] != words:
                    self.states.append(words)
                if isinstance(step, Outcome):
                    return step
                if isinstance(step, ModeRequest):
                    if step.mode is not requested:
                        requested, sent = step.mode, None
                        self._leave_offboard(step.mode)
                else:
                    if not self._offboard:
                        requested = None
                        self._enter_offboard()
                        envelope.reset()
                    sent, _ = envelope.apply(step, situation.state, now_ns, dt_s, landing=behaviour.landing)
                    self._stream.message = setpoint_message(sent)
                self._tell(behaviour)
                each(self.vehicle.truth)
            self.vehicle.step(TICK_S)
            self._take()
            ticks += 1
        return Outcome(False, f"not landed after {limit_s:g} s: {behaviour.status}")

    def settle(self, seconds: float) -> None:
        """Let time pass, and remember what the vehicle tells."""
        for _ in range(round(seconds / TICK_S)):
            self.vehicle.step(TICK_S)
            self._take()

    def _enter_offboard(self) -> None:
        self._stream = self.vehicle.repeat(setpoint_message(Setpoint.brake(0)), SETPOINT_RATE_HZ)
        self.settle(0.1)
        self.vehicle.set_mode("OFFBOARD")
        self._take()
        self._offboard = True

    def _leave_offboard(self, mode: FlightMode) -> None:
        self.vehicle.set_mode(_MODES[mode])
        self._take()
        self._stream.stop()
        self._offboard = False

    def _take(self) -> None:
        now_ns = self.now_ns
        for message in self.vehicle.receive():
            name = message.get_type()
            if name in FOLDED_MESSAGES:
                self.state = fold(self.state, name, message.to_dict(), now_ns)
        self._history.add(self.state)

    def _capture(self, seconds: float) -> None:
        markers = self.look(self.vehicle.truth, seconds)
        if markers is not None:
            now_ns = self.now_ns
            self._late.append((now_ns + round(self.latency_s * 1e9), now_ns, markers))

    def _show(self) -> None:
        while self._late and self._late[0][0] <= self.now_ns:
            _, captured_ns, markers = self._late.popleft()
            self._seen_ns = captured_ns
            try:
                self._seen = marker_targets(markers, captured_ns, self.mount, self._history, self.on_pads)
            except HistoryError:
                self._seen = ()  # as in the service: seen, not steered by

    def _sight(self, now_ns: int) -> MarkerSight:
        if not self._seen_ns:
            return MarkerSight(missing="")
        age_s = (now_ns - self._seen_ns) / 1e9
        fresh = age_s <= MAX_AGE_S
        return MarkerSight(self._seen if fresh else (), self._seen_ns, age_s, fresh, "")

    def _tell(self, behaviour: Behaviour) -> None:
        target = behaviour.landing_target
        if target is not None and target.captured_ns > self._told_ns:
            self._told_ns = target.captured_ns
            fields = landing_target_fields(target, AUTOPILOT_PX4)
            self.vehicle.send(dialect.MAVLink_landing_target_message(**fields))


def beside_m(truth: Truth, place: tuple[float, float]) -> float:
    """Over ground, of the vehicle's true place from another."""
    return math.dist(truth.position_ned_m[:2], place)
