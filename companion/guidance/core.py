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
from dataclasses import dataclass, replace
from enum import StrEnum

from companion.guidance.authority import Authority, silence
from companion.guidance.avoidance import Avoidance
from companion.guidance.behaviour import (
    Behaviour,
    BehaviourContext,
    BehaviourOutput,
    ModeRequest,
    Outcome,
    Requirement,
    RoutedSetpoint,
)
from companion.guidance.behaviours.hold import HoldBehaviour
from companion.guidance.behaviours.stop import StopBehaviour
from companion.guidance.command_queue import CommandQueue
from companion.guidance.gimbal.controller import ENDING, GimbalController, GimbalMounting
from companion.guidance.interface import (
    Answer,
    CommandInput,
    EventKind,
    GuidanceInput,
    GuidanceOutput,
    OutputCollector,
    SetMode,
)
from companion.guidance.limits.battery import ENDINGS, NO_MINIMUM, BatteryMinimum, BatteryMonitor
from companion.guidance.limits.envelope import Envelope, Limits
from companion.guidance.limits.obstacles import NO_RULES, Constraint, ObstacleMemory, ObstacleRules
from companion.guidance.mode_sequence import ModeSequence
from companion.guidance.requirements import check_requirements
from companion.guidance.targets.chosen import RecentTracks
from companion.vehicle.gimbal import Address
from companion.vehicle.landing_target import LandingTarget
from companion.vehicle.setpoint import DEFAULT_LIFETIME_S, Setpoint
from companion.vehicle.state import FlightMode, Vector3
from companion.vehicle.streamer import StreamState
from vision.obstacle_sectors import ObstacleSectors
from vision.occupancy_grid import Point

logger = logging.getLogger(__name__)

# PX4 accepts OFFBOARD after one setpoint; two more cost 60 ms and tolerate a lost packet.
SETPOINTS_BEFORE_OFFBOARD = 3
ENGAGE_TIMEOUT_S = 3.0
# After a loss of command: wait this long for the autopilot's reason. Nothing is streamed meanwhile.
REASON_WAIT_S = 0.3
# In OFFBOARD without a position estimate: brake for this long, then hand over to the autopilot.
POSITION_LOSS_S = 2.0
OBSTACLE_DISTANCE_PERIOD_NS = 100_000_000


class Phase(StrEnum):
    """State of our command of the vehicle."""

    IDLE = "idle"  # not in command
    READY = "ready"  # in command, nothing requested of the vehicle yet
    ENGAGING = "engaging"  # streaming a brake and requesting OFFBOARD
    OFFBOARD = "offboard"  # the vehicle flies our setpoints
    REQUESTING = "requesting"  # requesting one of the autopilot's own modes
    DELEGATED = "delegated"  # the autopilot flies that mode


@dataclass(frozen=True, slots=True)
class GuidanceOptions:
    """The operator's settings of guidance.

    Attributes:
        own_address: system and component id of our messages.
        lifetime_s: lifetime of every setpoint; overrides the behaviour's.
        perception_max_age_s: maximum age of targets.
        track_max_age_s: a track unseen for so long has ended.
    """

    limits: Limits = Limits()  # noqa: RUF009 - frozen
    own_address: Address = (1, 191)
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

    A behaviour that flew by setpoints is followed by a hold until the next command. After one that ended in
    an autopilot mode nothing is streamed.

    Attributes:
        asked: the last setpoint of a behaviour; None: none is active.
        sent: the same after the envelope (or the brake that is streamed while a mode is requested).
        limited_by: which limits acted on it.
        path: (north, east) points of the active path around obstacles; empty: none.
        phase: state of our command.
        gimbal: the gimbal controller; for its status.
    """

    def __init__(self, options: GuidanceOptions | None = None) -> None:
        self.options = options = options or GuidanceOptions()
        self.gimbal = GimbalController(options.own_address, options.gimbal)
        self.asked: Setpoint | None = None
        self.sent: Setpoint | None = None
        self.limited_by: tuple[str, ...] = ()
        self.path: tuple[Point, ...] = ()
        self.phase = Phase.IDLE
        self._out = OutputCollector()
        self._envelope = Envelope(options.limits)
        self._authority = Authority()
        self._battery = BatteryMonitor(options.battery)
        self._memory = ObstacleMemory()
        self._constrained: tuple[BehaviourContext, tuple[Constraint, ...]] | None = None
        self._avoidance = Avoidance(options.obstacles.margin_m)
        self._tracks = RecentTracks(max_age_s=options.track_max_age_s)
        self._queue = CommandQueue(self.gimbal)
        self._behaviour: Behaviour | None = None
        self._command: CommandInput | None = None
        self._busy = self._after_battery = False
        self._activated = False
        self._context: BehaviourContext | None = None
        self._class_names: tuple[str, ...] | None = None
        self._stepped_ns: int | None = None
        self._streaming = False
        self._sequence: ModeSequence | None = None
        self._request: int | None = None
        self._requested: ModeRequest | None = None
        self._engaging_since_ns = 0
        self._sent_before_engaging = 0
        self._position_lost_ns: int | None = None
        self._yielded: tuple[int, str] | None = None
        self._blind = False
        self._goal_ned_m: Vector3 | None = None
        self._mode_changes = 0
        self._landing_target_ns = self._obstacle_distance_ns = 0
        # Read once in each step, where an exception is handled.
        self._active: Behaviour | None = None
        self._landing = False
        self._gimbal_user = ""
        self._failure = ""  # of the step before, in words

    @property
    def active(self) -> Behaviour | None:
        """The active behaviour, inside a sequence its current one; None: none has been updated yet."""
        return self._active

    @property
    def behaviour(self) -> Behaviour | None:
        """The active behaviour, including the hold between commands; None: none."""
        return self._behaviour

    @property
    def context(self) -> BehaviourContext | None:
        """The input of behaviours at the newest step; None before the first."""
        return self._context

    @property
    def busy(self) -> bool:
        """A commanded behaviour has not ended yet."""
        return self._busy

    @property
    def in_command(self) -> bool:
        """Whether we are in command of the vehicle, as far as known."""
        return self.phase is not Phase.IDLE

    @property
    def status(self) -> str:
        """A few words for people."""
        if self._behaviour is None:
            return "not in command"
        try:
            words = self._behaviour.status
        except Exception:
            logger.exception("%s has no status", self._behaviour.name)
            words = self._behaviour.name
        if self.phase is Phase.ENGAGING:
            words += ", engaging offboard"
        return words if self.busy else f"{words}, no command"

    def step(self, now_ns: int, inputs: GuidanceInput) -> GuidanceOutput:
        """Advance guidance by one step.

        Args:
            now_ns: CLOCK_MONOTONIC nanoseconds; never decreasing.
        """
        out = self._out
        out.begin(now_ns)
        for answer in inputs.answers:
            self.gimbal.take_answer(answer, now_ns, out)
        if inputs.mode_changes != self._mode_changes and self.phase is Phase.IDLE:
            self._goal_ned_m = None  # flown by someone else since
        self._mode_changes = inputs.mode_changes
        before, context = self._context, self._observe(now_ns, inputs)
        self._context, self._class_names = context, inputs.class_names
        if inputs.ending:
            self._queue.close(out)
            for command in inputs.commands:
                out.result(command.identifier, Outcome(False, ENDING))
            self._end(Outcome(False, ENDING))
            self._release()
            self.gimbal.end(now_ns, inputs.state, out)
            return self._output(None, released=self.gimbal.released)
        self._queue.watch(inputs.mode_changes, inputs.state, out)
        for command in inputs.commands:
            self._queue.add(command, now_ns, inputs.state, self._gimbal_user, out)
        for command in self._queue.take_due(context, out):
            self._begin_command(command, context)
        landing_target = None
        try:
            if self._behaviour is not None:
                paused_s = 0.0 if before is None else (now_ns - before.now_ns) / 1e9
                self._report_reset(self._behaviour, before, context)
                self._update(context, inputs, paused_s)
            landing_target = self._new_landing_target()
            self.gimbal.update(context, self._active, out)
        except Exception as error:
            self._behaviour_failed(error, context, inputs.stream.sent_count)
        else:
            self._failure = ""
        self._answer_endless(inputs)
        return self._output(landing_target)

    def check_requirements(self, behaviour: Behaviour) -> str | None:
        """Why this behaviour could not begin now, in words; None: it could."""
        options, context = self.options, self._context
        missing = check_requirements(
            behaviour, context, self._class_names, options.battery, options.obstacles
        )
        if missing is not None or context is None:
            return missing
        for goal in behaviour.goals(context):
            if (why := self._envelope.check_goal(goal, context.state)) is not None:
                return f"{behaviour.name} would leave the limits: {why}"
        return None

    def _observe(self, now_ns: int, inputs: GuidanceInput) -> BehaviourContext:
        """The input of behaviours, without targets that are too old or whose camera direction is unknown."""
        gimbal = self.gimbal.snapshot(now_ns, inputs.state)
        age_s = None if inputs.seen_ns is None else (now_ns - inputs.seen_ns) / 1e9
        fresh = (
            age_s is not None and age_s <= self.options.perception_max_age_s and not gimbal.direction_fault
        )
        targets = inputs.targets if fresh else ()
        self._tracks = self._tracks.updated(targets)
        return BehaviourContext(
            now_ns,
            inputs.state,
            targets,
            age_s,
            fresh,
            inputs.obstacles,
            self.sent,
            markers=inputs.markers,
            neighbourhood=inputs.neighbourhood,
            min_separation_m=self.options.limits.min_separation_m,
            max_acceleration_mps2=self.options.limits.max_acceleration_mps2,
            goal_ned_m=self._goal_ned_m,
            gimbal=gimbal,
            ranging=inputs.ranging,
            tracks=self._tracks,
            steering_markers=inputs.steering_markers,
            planned=inputs.planned,
            avoiding=self.options.avoid,
            velocities=inputs.velocities,
        )

    def _output(self, landing_target: LandingTarget | None, *, released: bool = False) -> GuidanceOutput:
        out = self._out
        return GuidanceOutput(
            self.sent if self._streaming else None,
            tuple(out.requests),
            tuple(out.cancelled),
            landing_target,
            self._due_obstacles(),
            self._avoidance.take_request(),
            tuple(out.events),
            tuple(out.results),
            released,
        )

    # --- commands ----------------------------------------------------------------------------------------

    def _begin_command(self, command: CommandInput, context: BehaviourContext) -> None:
        """Replace the active behaviour by a command's; if that is refused, the active one goes on."""
        behaviour = command.behaviour
        assert behaviour is not None
        try:
            missing = self.check_requirements(behaviour)
            active = self._active or self._behaviour  # one that has just begun is not known as active yet
            if missing is None and active is not None:
                missing = behaviour.blocked_by(active, context)
        except Exception as error:
            logger.exception("%s cannot be checked", behaviour.name)
            missing = f"{behaviour.name} cannot begin: {type(error).__name__}: {error}"
        if missing is not None:
            outcome = Outcome(False, missing)
            self._out.result(command.identifier, outcome)
            self._out.event(EventKind.REFUSED, behaviour.name, f"refused: {missing}", outcome)
            return
        self._end(Outcome(False, f"replaced by {behaviour.name}"))
        if self.phase is Phase.IDLE:
            self._authority.acquire(context.state)
            self.phase = Phase.READY
        elif self.phase is Phase.REQUESTING:
            self._drop_request()
        elif self.phase is Phase.DELEGATED:
            self.phase, self._requested = Phase.READY, None
        self._battery.reset()
        self._begin(behaviour, command)
        self._out.event(EventKind.STARTED, behaviour.name, "started")
        if isinstance(behaviour, StopBehaviour):
            self.gimbal.end_goal(behaviour.name, self._out)

    def _answer_endless(self, inputs: GuidanceInput) -> None:
        """Answer an endless command when the vehicle flies it."""
        command = self._command
        if command is None or not command.endless or self.phase is not Phase.OFFBOARD:
            return
        if inputs.state.mode is FlightMode.OFFBOARD and inputs.stream.state is StreamState.FRESH:
            self._out.result(command.identifier, Outcome(True, "in progress"))
            self._command = None

    def _new_landing_target(self) -> LandingTarget | None:
        """The target of the autopilot's precision landing, once per frame that shows it."""
        target = None if self._behaviour is None else self._behaviour.landing_target
        if target is None or target.captured_ns <= self._landing_target_ns:
            return None
        self._landing_target_ns = target.captured_ns
        return target

    def _due_obstacles(self) -> ObstacleSectors | None:
        """The sectors for the autopilot, also while a pilot flies; None: not due, or stale."""
        context = self._context
        if not self.options.send_obstacle_distance or context is None:
            return None
        if context.now_ns < self._obstacle_distance_ns or not self.options.obstacles.fresh(context):
            return None
        # On a grid, so that the steps' own period does not lower the rate.
        due_ns = self._obstacle_distance_ns + OBSTACLE_DISTANCE_PERIOD_NS
        late = context.now_ns >= due_ns
        self._obstacle_distance_ns = context.now_ns + OBSTACLE_DISTANCE_PERIOD_NS if late else due_ns
        return context.obstacles

    # --- one step of the behaviour -----------------------------------------------------------------------

    def _update(self, context: BehaviourContext, inputs: GuidanceInput, paused_s: float) -> None:
        assert self._behaviour is not None
        fresh = inputs.stream.state is StreamState.FRESH
        why = (
            silence(inputs.stream.state, context.state, paused_s) if self._streaming else None
        ) or self._authority.lost(
            context.state,
            context.now_ns,
            flying_by_setpoint=self.phase in (Phase.ENGAGING, Phase.OFFBOARD),
            sent=self.sent if fresh and self.phase is Phase.OFFBOARD else None,
            landing=self._landing,
            altitude_acceptance_m=inputs.altitude_acceptance_m,
        )
        if why is not None or self._yielded is not None:
            self._yield(why, context)
            return
        # Before any hook of the behaviour: its exception must not lose the autopilot's answers.
        for answer in inputs.answers:
            if answer.identifier == self._request:
                self._take_answer(answer, context)
        if self._behaviour is not None:
            self._monitor_battery(self._behaviour, context)
        self._ask_next(context)
        if self.phase is Phase.ENGAGING and self._activated:
            self._engage(context, inputs.stream.sent_count)
        elif self._behaviour is not None:
            self._run(self._behaviour, context, inputs.stream.sent_count)
        if self._streaming and self.phase is not Phase.OFFBOARD:
            self._brake(context)

    def _begin(self, behaviour: Behaviour, command: CommandInput | None, *, busy: bool = True) -> None:
        self._behaviour, self._command, self._busy = behaviour, command, busy
        self._activated, self._position_lost_ns, self._blind = False, None, False
        self._active, self._landing, self._gimbal_user = None, False, ""

    def _run(self, behaviour: Behaviour, context: BehaviourContext, sent_count: int) -> None:
        """Update the behaviour and act on its output."""
        self.path = ()
        if Requirement.POSITION in behaviour.requirements and not self._position_known(context):
            return
        if not self._activated:
            self._activated, self._stepped_ns = True, None
            self._avoidance.reset()
            behaviour.on_activate(context)
            if self.busy:
                self._goal_ned_m = None
        dt_s = 0.0 if self._stepped_ns is None else (context.now_ns - self._stepped_ns) / 1e9
        step: BehaviourOutput = behaviour.update(dt_s, context)
        for note in behaviour.take_notes():
            self._out.event(EventKind.NOTED, behaviour.name, note)
        self._stepped_ns = context.now_ns
        if isinstance(step, RoutedSetpoint):
            flying = self.phase is Phase.OFFBOARD
            step = self._avoidance.steer(step, context, self._obstacle_constraints(context), flying=flying)
            for note, warning in self._avoidance.take_notes():
                self._out.event(EventKind.NOTED, behaviour.name, note, warning=warning)
            self.path = self._avoidance.path
        self._active = active = behaviour.active
        self._landing = active.landing
        self._gimbal_user = active.name if active.gimbal_aim is not None else ""
        match step:
            case Outcome():
                self._conclude(step, context, sent_count)
            case ModeRequest():
                if step != self._requested:
                    self._start_request(step, context)
            case Setpoint() if self.phase is Phase.OFFBOARD:
                self._limit(behaviour, step, context, dt_s)
            case Setpoint():
                if self.phase is not Phase.ENGAGING:
                    self._start_engaging(context, sent_count)
            case _:
                got = type(step).__name__
                raise TypeError(f"update returned {got}, expected Setpoint, ModeRequest or Outcome")

    def _behaviour_failed(self, error: Exception, context: BehaviourContext, sent_count: int) -> None:
        """A hook of the behaviour raised: hold. Call it from the exception handler."""
        name = "guidance" if self._behaviour is None else self._behaviour.name
        failure = f"{type(error).__name__}: {error}"
        if failure != self._failure:  # the gimbal's would be logged with every step
            logger.exception("%s failed", name)
        self._failure = failure
        why = f"{name} failed: {failure}"
        if self._yielded is not None:
            self._lose(self._yielded[1])
        elif self.busy:
            try:
                self._conclude(Outcome(False, why), context, sent_count)
            except Exception:
                logger.exception("the hold after %s failed", name)
                self._lose(why)
        else:
            self._lose(why)

    def _limit(
        self, behaviour: Behaviour, setpoint: Setpoint, context: BehaviourContext, dt_s: float
    ) -> None:
        """Stream a setpoint after the envelope; a brake where required depth is missing."""
        rules = self.options.obstacles
        # The lifetime is the operator's setting, not the behaviour's.
        asked = replace(setpoint, deadline_ns=context.now_ns + round(self.options.lifetime_s * 1e9))
        blind = rules.blind(context)
        self._report_perception_fault(behaviour, blind)
        if blind is not None:
            self._brake(context)
            self.asked, self.limited_by = asked, (blind,)
            return
        self._envelope.obstacle_constraints = self._obstacle_constraints(context)
        self.asked = asked
        self.sent, self.limited_by = self._envelope.apply(
            asked,
            context.state,
            context.now_ns,
            dt_s,
            context.neighbours,
            landing=self._landing,
        )

    def _obstacle_constraints(self, context: BehaviourContext) -> tuple[Constraint, ...]:
        """The obstacle limits of this step."""
        if self._constrained is None or self._constrained[0] is not context:
            rules = self.options.obstacles
            filled = self._memory.filled(context, rules.margin_m)
            self._constrained = (context, rules.constraints(filled))
        return self._constrained[1]

    def _report_perception_fault(self, behaviour: Behaviour, blind: str | None) -> None:
        """Log once that the vehicle brakes without depth, and once that depth is back."""
        if (blind is not None) is not self._blind:
            self._blind = blind is not None
            if blind is None:
                self._out.event(EventKind.NOTED, behaviour.name, "depth is back")
            else:
                self._out.event(EventKind.BLIND, behaviour.name, f"braking: {blind}", warning=True)

    def _report_reset(
        self, behaviour: Behaviour, before: BehaviourContext | None, context: BehaviourContext
    ) -> None:
        """Log a reset of the estimate. Goals keep their position on the ground (`vehicle.state`)."""
        if before is not None and context.state.reset_count > before.state.reset_count:
            words = context.state.reset_words(before.state)
            self._out.event(
                EventKind.NOTED, behaviour.name, f"position estimate {words}; goals moved with it"
            )

    def _conclude(self, outcome: Outcome, context: BehaviourContext, sent_count: int) -> None:
        """The behaviour ended by itself: hold if setpoints are active, else hand over to the autopilot."""
        behaviour = self._behaviour
        if behaviour is not None and self.busy and self._command is None and not self._after_battery:
            # An endless command was answered when it began: nobody waits for how it ends.
            text = f"{behaviour.name} ended: {outcome.reason}"
            self._out.event(EventKind.NOTED, behaviour.name, text, warning=not outcome.success)
        self._end(outcome)
        self._goal_ned_m = outcome.goal_ned_m
        # The requested mode may show before the answer to the request.
        handed_over = self._requested is not None and context.state.mode is self._requested.mode
        if self.phase is Phase.REQUESTING:
            self._drop_request()
        if not self._streaming or handed_over:
            self._release()
            return
        hold = HoldBehaviour()
        self._begin(hold, None, busy=False)
        if self.phase is Phase.OFFBOARD:
            self._run(hold, replace(context, goal_ned_m=self._goal_ned_m), sent_count)

    def _monitor_battery(self, behaviour: Behaviour, context: BehaviourContext) -> None:
        """Low battery ends the behaviour; the vehicle brakes until the configured action begins."""
        state, now_ns = context.state, context.now_ns
        if (why := self._battery.unknown(behaviour, state, now_ns)) is not None:
            self._battery_event(behaviour, why)
        if (why := self._battery.ending(behaviour, state, now_ns)) is None:
            return
        ending = ENDINGS[self._battery.minimum.action]()
        self._battery_event(behaviour, f"{why}: {behaviour.name} ends, {ending.name} follows")
        self._end(Outcome(False, why))
        if self.phase in (Phase.REQUESTING, Phase.DELEGATED):
            self._drop_request()
        self._begin(ending, None)
        self._after_battery = True

    def _battery_event(self, behaviour: Behaviour, message: str) -> None:
        self._out.event(EventKind.BATTERY, behaviour.name, message, warning=True)
        self._queue.supersede(f"an event ({message})", self._out)

    def _position_known(self, context: BehaviourContext) -> bool:
        """Check the position estimate; without it brake, and after `POSITION_LOSS_S` give up command."""
        fault = context.state.position_fault(context.now_ns)
        if fault is None:
            self._position_lost_ns = None
            return True
        if self._position_lost_ns is None:
            logger.warning("position or attitude lost (%s): braking", fault)
            self._position_lost_ns = context.now_ns
        if context.now_ns - self._position_lost_ns > POSITION_LOSS_S * 1e9:
            self._lose(f"position or attitude lost for {POSITION_LOSS_S:g} s ({fault})")
        elif self.phase is Phase.OFFBOARD:
            self._brake(context)
        return False

    def _brake(self, context: BehaviourContext) -> None:
        self.asked, self.limited_by = None, ()
        self.sent = Setpoint.brake(context.now_ns, self.options.lifetime_s)
        self._envelope.reset()

    # --- requests to the vehicle -------------------------------------------------------------------------

    def _start_engaging(self, context: BehaviourContext, sent_count: int) -> None:
        """Stream a brake; OFFBOARD is requested after `SETPOINTS_BEFORE_OFFBOARD` setpoints."""
        self._drop_request()
        self.phase, self._streaming = Phase.ENGAGING, True
        self._engaging_since_ns = context.now_ns
        self._sent_before_engaging = sent_count
        self._authority.request(FlightMode.OFFBOARD, context.state)

    def _engage(self, context: BehaviourContext, sent_count: int) -> None:
        if self._request is not None:
            return
        if sent_count - self._sent_before_engaging >= SETPOINTS_BEFORE_OFFBOARD:
            self._request = self._out.request(SetMode(FlightMode.OFFBOARD))
        elif context.now_ns - self._engaging_since_ns > ENGAGE_TIMEOUT_S * 1e9:
            self._fail(f"offboard not requested: no setpoint sent within {ENGAGE_TIMEOUT_S:g} s")

    def _start_request(self, request: ModeRequest, context: BehaviourContext) -> None:
        """Request an autopilot mode. From OFFBOARD, a brake is streamed until the mode shows."""
        self._drop_request()
        self.phase, self._requested = Phase.REQUESTING, request
        self._authority.request(request.mode, context.state, request.altitude_m)
        self._sequence = ModeSequence(request, context.state)
        self._ask_next(context)

    def _ask_next(self, context: BehaviourContext) -> None:
        """Request the next action of a mode sequence, once the previous one is done."""
        if self._sequence is not None and self._request is None:
            action = self._sequence.next(context.now_ns, context.state)
            if action is not None:
                self._request = self._out.request(action)

    def _take_answer(self, answer: Answer, context: BehaviourContext) -> None:
        """Handle the answer to the pending request."""
        self._request = None
        if answer.refused is not None:
            self._sequence = None
            self._fail(answer.refused)
            return
        if self._sequence is not None and not self._sequence.finished:
            return
        self._sequence = None
        self._authority.settled(context.now_ns)
        if self.phase is Phase.ENGAGING:
            self.phase, self._stepped_ns = Phase.OFFBOARD, None
            self._envelope.reset()
            if self._behaviour is not None:
                self._out.event(EventKind.ENGAGED, self._behaviour.name, "offboard engaged")
        else:
            self.phase = Phase.DELEGATED
            self._silence()

    def _fail(self, why: str) -> None:
        """The autopilot refused the request."""
        behaviour, context = self._behaviour, self._context
        if behaviour is not None and context is not None and behaviour.request_failed(why):
            flying = self.phase is Phase.REQUESTING and self._streaming
            if not flying:
                self._silence()
            # The mode that shows now is the previous one: a pilot's would have ended our command already.
            self._authority.refused(FlightMode.OFFBOARD if flying else context.state.mode)
            self.phase, self._requested = Phase.OFFBOARD if flying else Phase.READY, None
            return
        self._end(Outcome(False, why))
        if self.phase is Phase.REQUESTING and self._streaming:
            # Still flying setpoints: hold. If the mode changed nevertheless, that ends our command.
            self._authority.refused(FlightMode.OFFBOARD)
            self.phase, self._requested = Phase.OFFBOARD, None
            self._begin(HoldBehaviour(), None, busy=False)
        else:
            self._release()

    # --- the end of a behaviour, or of our command -------------------------------------------------------

    def _yield(self, why: str | None, context: BehaviourContext) -> None:
        """Stop streaming at once; report the reason when the autopilot has reported its own."""
        since_ns, first = self._yielded or (context.now_ns, why or "")
        self._yielded = (since_ns, why or first)
        self._silence()
        state, now_ns = context.state, context.now_ns
        waited_s = (now_ns - since_ns) / 1e9
        if why is None or waited_s >= REASON_WAIT_S or self._authority.reason_is_logged(state, now_ns):
            reasons = self._authority.reasons_for(state, now_ns)
            if self._authority.chose_hold(state, now_ns):
                # Else PX4 treats the setpoints as lost and leaves hold for a return after 1.2 s.
                self._out.request(SetMode(FlightMode.HOLD))
            self._lose(f"{self._yielded[1]} ({reasons})" if reasons else self._yielded[1])

    def _lose(self, why: str) -> None:
        """Command was lost: stop streaming and end the behaviour."""
        self._yielded = None
        self._silence()
        self._goal_ned_m = None
        behaviour, outcome = self._behaviour, Outcome(False, why)
        self._end(outcome, reported=True)
        self._release()
        if behaviour is not None:
            message = f"command lost: {why}"
            self._out.event(EventKind.LOST, behaviour.name, message, outcome, warning=True)
            self._queue.supersede(f"an event ({message})", self._out)

    def _end(self, outcome: Outcome, *, reported: bool = False) -> None:
        """Remove the active behaviour and answer its command."""
        behaviour, command, busy = self._behaviour, self._command, self._busy
        after_battery, self._after_battery = self._after_battery, False
        self._behaviour = self._command = self._active = None
        self._busy, self._landing, self._gimbal_user = False, False, ""
        if behaviour is None:
            return
        if self._activated:
            try:
                behaviour.on_deactivate()
            except Exception:
                logger.exception("%s failed to deactivate", behaviour.name)
        if command is not None:
            self._out.result(command.identifier, outcome)
        if after_battery:
            # No command waits for its result: log how it ended.
            self._battery_event(behaviour, f"{behaviour.name} after low battery: {outcome.reason}")
        if busy and not reported:
            self._out.event(EventKind.ENDED, behaviour.name, outcome.reason, outcome)

    def _release(self) -> None:
        """Give up command."""
        self._yielded = None
        self._drop_request()
        self._silence()
        self._authority.release()
        self.phase = Phase.IDLE

    def _silence(self) -> None:
        self._envelope.reset()
        self._streaming = False
        self.asked = self.sent = None
        self.limited_by = self.path = ()

    def _drop_request(self) -> None:
        """Abandon the pending request: it is not repeated, but may still take effect."""
        pending = self._request is not None or self._sequence is not None
        self._requested = self._sequence = None
        if self._request is not None:
            self._out.cancel(self._request)
            self._request = None
        if pending and self._context is not None:
            self._authority.dropped(self._context.now_ns)
        if self.phase in (Phase.REQUESTING, Phase.DELEGATED):
            self.phase = Phase.READY
