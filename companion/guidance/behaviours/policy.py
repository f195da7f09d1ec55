"""Policy: fly to an object by a trained network, see `companion.guidance.policy_file`."""

from __future__ import annotations

import math
from typing import Annotated

from companion.guidance.behaviour import (
    Behaviour,
    BehaviourContext,
    BehaviourOutput,
    Outcome,
    Requirement,
)
from companion.guidance.behaviours.approach import LOST_AFTER_S
from companion.guidance.command import (
    BuildContext,
    Command,
    FileName,
    GrammarError,
    Number,
    behaviour,
)
from companion.guidance.motion import Arrival, Standing, position_and_yaw, speed_of
from companion.guidance.objects.closing_check import Approached
from companion.guidance.objects.tracked_object import Subject, TrackedObject
from companion.guidance.policy_file import LoadedPolicy, PolicyError, Quantity, find_policy, load_policy
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import Vector3

# What a policy can observe and command, with units. `forward` and `right` are horizontal, by the yaw; the
# target is the filtered point on the object's surface, `target_age_s` the age of its newest detection.
OBSERVATIONS = {
    "target_forward_m": "m",
    "target_right_m": "m",
    "target_up_m": "m",
    "velocity_forward_m_s": "m/s",
    "velocity_right_m_s": "m/s",
    "velocity_up_m_s": "m/s",
    "target_age_s": "s",
    "distance_wanted_m": "m",
}
ACTIONS = {"forward_m_s": "m/s", "right_m_s": "m/s", "up_m_s": "m/s", "turn_rad_s": "rad/s"}
# Without these a policy does not know what it flies to.
NEEDED = ("target_forward_m", "target_right_m", "target_age_s", "distance_wanted_m")
# An observation may be outside its range by this fraction of it. The age of the target may not.
MARGIN = 0.05
CONFIDENCE = 0.3
# How long to wait for an object with a known range.
LOOK_S = 10.0


@behaviour("policy", "fly to an object by a trained policy and stop before it")
class Policy(Command):
    file: Annotated[str, FileName("file", "an ONNX file on the service's computer, or a bundled policy")]
    subject: Subject
    distance_m: Annotated[
        float, Number("distance", "m", 1.0, 100.0, "where to stop, over ground to its nearest surface")
    ] = 5.0
    limit_s: Annotated[float, Number("limit", "s", 1.0, 3600.0, "give up after this long")] = 120.0

    def build(self, context: BuildContext) -> Behaviour:
        try:
            loaded = load_policy(find_policy(self.file))
            check_quantities(loaded)
            rate_hz, loop_hz = loaded.description.rate_hz, context.loop_rate_hz
            if loop_hz is not None and rate_hz > loop_hz:
                raise PolicyError(
                    f"{loaded.name} steps at {rate_hz:g} Hz, guidance only at {loop_hz:g} Hz: "
                    "set guidance.rate_hz to at least that of the policy"
                )
            return PolicyBehaviour(self, loaded)
        except PolicyError as error:
            raise GrammarError(f"policy: {error}") from error


def check_quantities(policy: LoadedPolicy) -> None:
    """Raises PolicyError for a quantity that is not known, has another unit, or is missing."""
    described = policy.description
    for what, known, quantities in (
        ("observation", OBSERVATIONS, described.observation),
        ("action", ACTIONS, described.action),
    ):
        for quantity in quantities:
            if quantity.name not in known:
                raise PolicyError(
                    f"{policy.name} ({described.environment}): unknown {what} {quantity.name!r}; "
                    f"known: {', '.join(known)}"
                )
            if quantity.unit != known[quantity.name]:
                raise PolicyError(
                    f"{policy.name}: {what} {quantity.name} must be in {known[quantity.name]}, "
                    f"got {quantity.unit!r}"
                )
    missing = [name for name in NEEDED if name not in {each.name for each in described.observation}]
    if missing:
        raise PolicyError(f"{policy.name}: does not observe {', '.join(missing)}")


class PolicyBehaviour(Behaviour):
    """Flies the actions of a policy, each clipped to its trained range, until it stands before the object.

    It holds until the object's range is known, and brakes and holds while the object has not been detected
    for `LOST_AFTER_S`. An observation outside its trained range, a target that is too old, or an action that
    is no number end it.

    Args:
        policy: checked by `check_quantities`.

    Raises:
        PolicyError: it was not trained for this distance.
    """

    name = "policy"
    requirements = frozenset({Requirement.POSITION, Requirement.IN_AIR})

    def __init__(self, command: Policy, policy: LoadedPolicy) -> None:
        self._command, self._policy = command, policy
        self.subject: Subject = command.subject
        trained = next(q for q in policy.description.observation if q.name == "distance_wanted_m")
        if not trained.low <= command.distance_m <= trained.high:
            raise PolicyError(
                f"{policy.name} was trained for a distance of {trained.allowed}, not {command.distance_m:g} m"
            )
        self._begin(0)

    def _begin(self, now_ns: int) -> None:
        self._arrival = Arrival()
        self._object: TrackedObject | None = None
        self._standing: Standing | None = None
        self._action = dict.fromkeys(ACTIONS, 0.0)
        self._begun_ns = self._due_ns = now_ns
        self._range_m = math.nan

    def on_activate(self, context: BehaviourContext) -> None:
        self._begin(context.now_ns)
        context.objects.forget(self.subject)

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        position, yaw_rad = position_and_yaw(context.state)
        elapsed_s = (context.now_ns - self._begun_ns) / 1e9
        self._object = seen = context.objects.of(self.subject, CONFIDENCE)
        if seen is None:
            if (why := context.objects.lost(self.subject, LOOK_S)) is not None:
                return Outcome(False, why)
            return self._wait(dt_s, context)
        values = self._observation(seen, context, position, yaw_rad)
        self._range_m = math.hypot(values["target_forward_m"], values["target_right_m"])
        at_m = abs(self._range_m - self._command.distance_m)
        lost = values["target_age_s"] > LOST_AFTER_S
        if not lost and self._arrival.update(at_m, speed_of(context.state), context.now_ns):
            return Outcome(True, f"reached {self.subject.name} at {self._range_m:.1f} m")
        if elapsed_s > self._command.limit_s:
            return Outcome(False, f"not there after {elapsed_s:.0f} s: {self._range_m:.1f} m away")
        if (fault := self._untrained(values)) is not None:
            why = context.perception_fault("")
            return Outcome(False, f"{self._policy.name} ended: {fault}" + (f" ({why})" if why else ""))
        if lost:
            return self._wait(dt_s, context)
        self._standing = None
        # A little early rather than a whole update late.
        if context.now_ns >= self._due_ns - 5_000_000:
            period_ns = round(1e9 / self._policy.description.rate_hz)
            self._due_ns = max(self._due_ns, context.now_ns - period_ns) + period_ns
            if (fault := self._act(values)) is not None:
                return Outcome(False, f"{self._policy.name} ended: {fault}")
        north, east = _rotated(self._action["forward_m_s"], self._action["right_m_s"], yaw_rad)
        velocity = (north, east, -self._action["up_m_s"])
        return Setpoint.velocity(velocity, context.now_ns, yaw_rate_radps=self._action["turn_rad_s"])

    def _wait(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        """Brake, and hold where the vehicle comes to rest."""
        if self._standing is None:
            self._standing, self._arrival = Standing(), Arrival()
        return self._standing.setpoint(context.state, context.now_ns, dt_s, None)

    def _observation(
        self, seen: TrackedObject, context: BehaviourContext, position: Vector3, yaw_rad: float
    ) -> dict[str, float]:
        there_ned_m = seen.position_at(context.now_ns)
        north, east, down = (there - here for there, here in zip(there_ned_m, position, strict=True))
        target_forward, target_right = _rotated(north, east, -yaw_rad)
        north_mps, east_mps, down_mps = context.state.velocity_ned_mps or (math.nan,) * 3
        forward_mps, right_mps = _rotated(north_mps, east_mps, -yaw_rad)
        age_s = seen.unseen_s(context.now_ns)
        values = (target_forward, target_right, -down, forward_mps, right_mps, -down_mps, age_s)
        return dict(zip(OBSERVATIONS, (*values, self._command.distance_m), strict=True))

    def _untrained(self, values: dict[str, float]) -> str | None:
        """Which value the policy was not trained for; None: none."""
        for quantity in self._policy.description.observation:
            value = values[quantity.name]
            margin = 0.0 if quantity.name == "target_age_s" else MARGIN * (quantity.high - quantity.low)
            if not quantity.low - margin <= value <= quantity.high + margin:
                return f"{quantity.name} is {value:.2f}, trained for {quantity.allowed}"
        return None

    def _act(self, values: dict[str, float]) -> str | None:
        """Step the policy. Returns what is wrong with its action; None: nothing."""
        described = self._policy.description
        action = self._policy.act([_clipped(each, values[each.name]) for each in described.observation])
        for quantity, value in zip(described.action, action, strict=True):
            if not math.isfinite(value):
                return f"its action {quantity.name} is {value}"
            self._action[quantity.name] = _clipped(quantity, value)
        return None

    @property
    def approached(self) -> Approached | None:
        return None if self._object is None else Approached(self._object.detection)

    @property
    def status(self) -> str:
        if self._object is None:
            return f"policy {self._policy.name}, looking for {self.subject.phrase}"
        if self._standing is not None:
            return f"policy {self._policy.name}, lost {self.subject.phrase}, waiting"
        return f"policy {self._policy.name}, {self.subject.name} {self._range_m:.1f} m away"


def _clipped(quantity: Quantity, value: float) -> float:
    return max(quantity.low, min(quantity.high, value))


def _rotated(first: float, second: float, angle_rad: float) -> tuple[float, float]:
    """A horizontal vector turned clockwise: by the yaw, forward and right become north and east."""
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    return (first * cos - second * sin, first * sin + second * cos)
