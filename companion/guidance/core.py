"""Guidance as a function: `Guidance.step(now_ns, GuidanceInput) -> GuidanceOutput`.

One behaviour is active at a time. Guidance engages OFFBOARD for it, keeps its setpoints inside the envelope
and yields to the pilot. There is no asyncio, no clock and no I/O here: the service, the campaigns and the
tests call this one function. Only behaviours made of others, and unit tests of single updates, call a
behaviour elsewhere.

When the vehicle shows a mode that was not requested, or does not follow the setpoints, our command ends at
once and nothing is streamed until the operator's next command, even if OFFBOARD comes back by itself.
"""

from __future__ import annotations

import logging
import math
from dataclasses import asdict, dataclass, replace

from companion.guidance.behaviour import NO_GIMBAL, Behaviour, BehaviourContext, Outcome, Requirement
from companion.guidance.behaviour_runner import BehaviourRunner
from companion.guidance.behaviours.stop import StopBehaviour
from companion.guidance.command_queue import CommandQueue, ends_flight
from companion.guidance.gimbal.controller import ENDING, GimbalController, GimbalMounting
from companion.guidance.interface import (
    ChangedLimits,
    CommandInput,
    EventKind,
    GuidanceInput,
    GuidanceOutput,
    OutputCollector,
)
from companion.guidance.limits.battery import NO_MINIMUM, BatteryMinimum
from companion.guidance.limits.envelope import Limits
from companion.guidance.limits.obstacles import NO_RULES, ObstacleRules
from companion.guidance.mode_control import ModeControl, Phase
from companion.guidance.objects.closing_check import ClosingCheck
from companion.guidance.objects.in_view import Choice, ObjectsInView
from companion.guidance.objects.tracked_object import Subject, TrackedObject
from companion.guidance.requirements import check_requirements
from companion.guidance.setpoint_output import SetpointOutput
from companion.host.clock import BUFFERED_S, Standstill
from companion.vehicle.landing_target import LandingTarget
from companion.vehicle.setpoint import DEFAULT_LIFETIME_S
from vision.obstacle_sectors import ObstacleSectors

logger = logging.getLogger(__name__)

OBSTACLE_DISTANCE_PERIOD_NS = 100_000_000
# Behaviours with one of these use what the steering camera shows.
_STEERED = frozenset({Requirement.PERCEPTION, Requirement.STEERING_MARKER})


@dataclass(frozen=True, slots=True)
class GuidanceOptions:
    """The operator's settings of guidance.

    Attributes:
        lifetime_s: lifetime of every setpoint; overrides the behaviour's.
        perception_max_age_s: maximum age of targets.
        track_max_age_s: a track unseen for so long has ended.
    """

    limits: Limits = Limits()  # noqa: RUF009 - frozen
    lifetime_s: float = DEFAULT_LIFETIME_S
    battery: BatteryMinimum = NO_MINIMUM
    obstacles: ObstacleRules = NO_RULES
    avoid: bool = False
    send_obstacle_distance: bool = False
    perception_max_age_s: float = 0.5
    track_max_age_s: float = 2.0
    gimbal: GimbalMounting = GimbalMounting()  # noqa: RUF009 - frozen


class Guidance:
    """One vehicle's guidance.

    Attributes:
        options: the operator's settings, fixed at construction; `GuidanceInput.limits` change later.
        gimbal, setpoints, runner: its parts; for their status.
        context: the input of behaviours at the newest step; None before the first.
    """

    def __init__(self, options: GuidanceOptions | None = None) -> None:
        self.options = options = options or GuidanceOptions()
        self.gimbal = GimbalController(options.gimbal)
        self._out = OutputCollector()
        self.setpoints = SetpointOutput(options.limits, options.obstacles, options.lifetime_s, self._out)
        self._modes = ModeControl(self.setpoints, self._out)
        self._objects: tuple[TrackedObject, ...] = ()
        self._marker_objects: tuple[TrackedObject, ...] = ()
        self._objects_below: tuple[TrackedObject, ...] = ()
        self._choices: dict[Subject, Choice] = {}
        self._choices_below: dict[Subject, Choice] = {}
        self._has_gimbal = False
        self._queue = CommandQueue(self.gimbal)
        self.runner = BehaviourRunner(self.setpoints, self._modes, options.battery, self._queue, self._out)
        # Of the steering camera, and of those that look down.
        self._closing, self._closing_below = ClosingCheck(), ClosingCheck()
        self._approaching: tuple[Behaviour | None, int] = None, 0
        self.context: BehaviourContext | None = None
        self._class_names: tuple[str, ...] | None = None
        self._mode_changes = 0
        self._landing_target_ns = self._obstacle_distance_ns = 0
        self._standstill: Standstill | None = None
        self._refuse_until_ns = 0
        self._changed_limits: ChangedLimits | None = None

    @property
    def behaviour(self) -> Behaviour | None:
        """The active behaviour, including the hold between commands; None: none."""
        return self.runner.behaviour

    @property
    def phase(self) -> Phase:
        """State of our command."""
        return self._modes.phase

    @property
    def busy(self) -> bool:
        """A commanded behaviour has not ended yet."""
        return self.runner.busy

    @property
    def in_command(self) -> bool:
        """Whether we are in command of the vehicle, as far as known."""
        return self.phase is not Phase.IDLE

    @property
    def armed_on_ground(self) -> bool:
        """Whether the active command has armed the vehicle, and it has not taken off since."""
        return self._modes.armed_on_ground

    @property
    def status(self) -> str:
        """A few words for people."""
        behaviour = self.behaviour
        if behaviour is None:
            return "not in command"
        try:
            words = behaviour.status
        except Exception:
            logger.exception("%s has no status", behaviour.name)
            words = behaviour.name
        if self.phase is Phase.ENGAGING:
            words += ", engaging offboard"
        return words if self.busy else f"{words}, no command"

    def step(self, now_ns: int, inputs: GuidanceInput) -> GuidanceOutput:
        """Advance guidance by one step.

        Args:
            now_ns: CLOCK_MONOTONIC nanoseconds; never decreasing.
        """
        out = self._out
        out.now_ns = now_ns
        out.requests, out.cancelled, out.events, out.results, out.endings = [], [], [], [], []
        if inputs.limits is not None and inputs.limits != self._changed_limits:
            self._changed_limits = inputs.limits
            self.setpoints.use_limits(replace(self.options.limits, **asdict(inputs.limits)))
        self.setpoints.use_autopilot(inputs.parameters)
        for answer in inputs.answers:
            self.gimbal.take_answer(answer, now_ns, out)
        if inputs.mode_changes != self._mode_changes and self.phase is Phase.IDLE:
            self.runner.goal_ned_m = None  # flown by someone else since
        self._mode_changes = inputs.mode_changes
        before, context = self.context, self._observe(now_ns, inputs)
        self.context, self._class_names = context, inputs.class_names
        if inputs.ending:
            self._queue.close(out)
            for command in inputs.commands:
                out.ended(command.identifier, Outcome(False, ENDING))
            self.runner.end(Outcome(False, ENDING))
            self._modes.release()
            self.gimbal.end(now_ns, inputs.state, out)
            return self._output(None, released=self.gimbal.released)
        if inputs.mode_changes != self._queue.mode_changes:
            self._queue.watch(inputs.mode_changes, inputs.state, out)
        if inputs.standstill is not None:
            self._end_after(inputs.standstill, now_ns)
        for command in inputs.commands:
            if (why := self._outdated(command, inputs.standstill, now_ns)) is not None:
                out.ended(command.identifier, Outcome(False, why))
                continue
            self._queue.add(command, context, self.runner.gimbal_user, out)
        if self._queue.due or self._queue.waiting:
            for command in self._queue.take_due(context, out):
                self._begin_command(command, context)
        landing_target = None
        try:
            self.runner.update(context, before, inputs)
            landing_target = self._new_landing_target()
            if self._has_gimbal:
                self.gimbal.update(context, self.runner.active, out)
        except Exception as error:
            self.runner.handle_error(error, context, inputs.stream.sent_count)
        else:
            self.runner.failure = ""  # this step raised nothing
        self.runner.answer_endless(inputs)
        return self._output(landing_target)

    def check_requirements(self, behaviour: Behaviour) -> str | None:
        """Why this behaviour could not begin now, in words; None: it could."""
        options, context = self.options, self.context
        missing = check_requirements(
            behaviour, context, self._class_names, options.battery, options.obstacles
        )
        if missing is not None or context is None:
            return missing
        home = context.state.home_position_ned_m or (0.0, 0.0, 0.0)
        _, _, down = context.state.position_ned_m or home
        elsewhere = replace(context, state=replace(context.state, position_ned_m=(math.nan, math.nan, down)))
        for each, begun in ((behaviour, context), *((later, elsewhere) for later in behaviour.later)):
            try:
                goals = each.goals(begun)
            except ValueError as error:
                if each is behaviour:
                    return f"{each.name}: {error}"
                continue  # it may be known when it begins
            if (why := self.setpoints.check_goals(goals, context.state)) is not None:
                return f"{each.name} would leave the limits: {why}"
        return None

    def _end_after(self, standstill: Standstill, now_ns: int) -> None:
        """The computer or the process stood still: whatever was commanded before ends, also what waits."""
        self._queue.supersede(f"an event ({standstill.why})", self._out)
        self.runner.end_after_standstill(standstill.why)
        self._objects = self._marker_objects = self._objects_below = ()
        if standstill.long or standstill.suspended:
            self._standstill = standstill
            self._refuse_until_ns = now_ns + round(standstill.late_commands_s * 1e9)

    def _outdated(self, command: CommandInput, standstill: Standstill | None, now_ns: int) -> str | None:
        """Why a command is refused that may be from before a standstill; None: it is not.

        A command that was sent to a process that stands still waits in a buffer, and arrives when it goes on;
        one that was sent to a suspended computer is sent again by its sender's TCP.
        """
        if ends_flight(command.behaviour):
            return None
        if standstill is None and now_ns < self._refuse_until_ns:
            standstill = self._standstill
        if standstill is None:
            return None
        left_s = max(self._refuse_until_ns - now_ns, 0) / 1e9
        again = (
            f"give the command again in {left_s:.0f} s" if left_s > BUFFERED_S else "give the command again"
        )
        return f"{standstill.why}, and this command may be from before: {again}"

    def _observe(self, now_ns: int, inputs: GuidanceInput) -> BehaviourContext:
        """The input of behaviours, without targets that are too old or whose camera direction is unknown."""
        if inputs.state.gimbal is not None or self.gimbal.mounting.carries_camera:
            self._has_gimbal = True
        gimbal = self.gimbal.snapshot(now_ns, inputs.state) if self._has_gimbal else NO_GIMBAL
        age_s = None if inputs.seen_ns is None else (now_ns - inputs.seen_ns) / 1e9
        fresh = (
            age_s is not None and age_s <= self.options.perception_max_age_s and not gimbal.direction_fault
        )
        targets = inputs.targets if fresh else ()
        context = BehaviourContext(
            now_ns,
            inputs.state,
            targets,
            age_s,
            fresh,
            inputs.obstacles,
            self.setpoints.sent,
            markers=inputs.markers,
            neighbourhood=inputs.neighbourhood,
            min_separation_m=self.options.limits.min_separation_m,
            max_acceleration_mps2=self.options.limits.max_acceleration_mps2,
            goal_ned_m=self.runner.goal_ned_m,
            gimbal=gimbal,
            ranging=inputs.ranging,
            steering_markers=inputs.steering_markers,
            planned=inputs.planned,
            avoiding=self.options.avoid,
            velocities=inputs.velocities,
            camera_fault=inputs.camera_fault,
            parameters=inputs.parameters,
            held_at_height=self.setpoints.held_at_height,
        )
        context = self._without_wrong_cameras(context)
        # What a camera shows that is not used is not remembered either.
        if context.perception_fresh:
            self._objects = inputs.objects
        if context.steering_markers.fresh:
            self._marker_objects = inputs.marker_objects
        if context.markers.fresh:
            shown = inputs.marker_objects if context.camera_fault else ()
            self._objects_below = tuple(each for each in inputs.objects_below if each not in shown)
        fault = context.perception_fault("no detections received")
        in_view = ObjectsInView(
            self._objects,
            self._marker_objects,
            now_ns,
            0.0 if context.state.yaw_rad is None else context.state.yaw_rad,
            context.state.position_ned_m,
            "" if context.perception_fresh else fault,
            "" if context.steering_markers.fresh else fault,
            self.options.track_max_age_s,
            self._choices,
        )
        below = replace(
            in_view,
            objects=(),
            markers=self._objects_below,
            marker_fault=context.markers.fault,
            _choices=self._choices_below,
        )
        return replace(context, objects=in_view, below=below)

    def _without_wrong_cameras(self, context: BehaviourContext) -> BehaviourContext:
        """The context without what a camera shows that does not fit the vehicle's motion (`ClosingCheck`)."""
        active, position = self.runner.active, context.state.position_ned_m
        if not self.runner.busy:
            self._closing.reset()
            self._closing_below.reset()
        resets = context.state.reset_count
        # The next step of a mission: another object. A reset of the height: other ranges by the ground.
        if active is not self._approaching[0] or resets != self._approaching[1]:
            self._approaching = active, resets
            self._closing.begin_again()
            self._closing_below.begin_again()
        if position is not None:
            needs, stamp_ns = self.runner.needs, context.state.position_ns
            below = Requirement.MARKER in needs
            ahead, beneath = (None, self.runner.approached) if below else (self.runner.approached, None)
            known = self._closing.fault, self._closing_below.fault
            self._closing.update(ahead, context.targets, stamp_ns, position, used=bool(needs & _STEERED))
            self._closing_below.update(beneath, (), stamp_ns, position)
            for before, fault in zip(known, (self._closing.fault, self._closing_below.fault), strict=True):
                if fault and not before and (behaviour := self.runner.behaviour) is not None:
                    self._out.event(EventKind.NOTED, behaviour.name, fault, warning=True)
        if self._closing.fault:
            context = _blinded(context, self._closing.fault)
        if fault := self._closing_below.fault:
            markers = replace(context.markers, targets=(), fresh=False, fault=fault)
            context = replace(context, markers=markers)
        return context

    def _output(self, landing_target: LandingTarget | None, *, released: bool = False) -> GuidanceOutput:
        out = self._out
        return GuidanceOutput(
            self.setpoints.sent if self.setpoints.streaming else None,
            tuple(out.requests),
            tuple(out.cancelled),
            landing_target,
            self._due_obstacles(),
            self.setpoints.take_path_request() if self.options.avoid else None,
            tuple(out.events),
            tuple(out.results),
            released,
            tuple(out.endings),
        )

    def _begin_command(self, command: CommandInput, context: BehaviourContext) -> None:
        """Replace the active behaviour by a command's; if that is refused, the active one goes on."""
        behaviour = command.behaviour
        assert behaviour is not None
        try:
            missing = self.check_requirements(behaviour)
            # One that has just begun is not known as active yet.
            active = self.runner.active or self.runner.behaviour
            if missing is None and active is not None:
                missing = behaviour.blocked_by(active, context)
        except Exception as error:
            logger.exception("%s cannot be checked", behaviour.name)
            missing = f"{behaviour.name} cannot begin: {type(error).__name__}: {error}"
        if missing is not None:
            outcome = Outcome(False, missing)
            self._out.ended(command.identifier, outcome)
            self._out.event(EventKind.REFUSED, behaviour.name, f"refused: {missing}", outcome)
            return
        self._closing.reset()
        self._closing_below.reset()
        self._choices.clear()
        self._choices_below.clear()
        self.runner.begin_command(behaviour, command, context)
        if isinstance(behaviour, StopBehaviour):
            self.gimbal.end_goal(behaviour.name, self._out)

    def _new_landing_target(self) -> LandingTarget | None:
        """The target of the autopilot's precision landing, once per frame that shows it."""
        target = None if self.runner.behaviour is None else self.runner.behaviour.landing_target
        if target is None or target.captured_ns <= self._landing_target_ns:
            return None
        self._landing_target_ns = target.captured_ns
        return target

    def _due_obstacles(self) -> ObstacleSectors | None:
        """The sectors for the autopilot, also while a pilot flies; None: not due, or stale."""
        context = self.context
        if not self.options.send_obstacle_distance or context is None:
            return None
        if context.now_ns < self._obstacle_distance_ns or not self.options.obstacles.fresh(context):
            return None
        # On a grid, so that the steps' own period does not lower the rate.
        due_ns = self._obstacle_distance_ns + OBSTACLE_DISTANCE_PERIOD_NS
        late = context.now_ns >= due_ns
        self._obstacle_distance_ns = context.now_ns + OBSTACLE_DISTANCE_PERIOD_NS if late else due_ns
        return context.obstacles


def _blinded(context: BehaviourContext, fault: str) -> BehaviourContext:
    """The context without anything that the steering camera shows: behaviours brake, and end with the fault.

    Where that camera looks down, its markers are missing below too.
    """
    shown = context.steering_markers
    others = tuple(target for target in context.markers.targets if target not in shown.targets)
    return replace(
        context,
        targets=(),
        perception_fresh=False,
        markers=replace(context.markers, targets=others),
        steering_markers=replace(shown, targets=(), fresh=False, fault=fault),
        camera_fault=fault,
    )
