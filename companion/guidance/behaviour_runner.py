"""The active behaviour: begin, update, act on its output, end; and the loss of our command."""

from __future__ import annotations

import logging
from dataclasses import replace

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
from companion.guidance.command_queue import CommandQueue
from companion.guidance.interface import Answer, CommandInput, EventKind, GuidanceInput, OutputCollector
from companion.guidance.limits.battery import ENDINGS, BatteryMinimum, BatteryMonitor
from companion.guidance.mode_control import ModeControl, Phase
from companion.guidance.motion import Lasting, VelocityBias
from companion.guidance.objects.closing_check import Approached
from companion.guidance.setpoint_output import SetpointOutput
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, LandedState, Vector3, VehicleState
from companion.vehicle.streamer import StreamState

logger = logging.getLogger(__name__)

# In OFFBOARD without a position estimate: brake for this long, then hand over to the autopilot.
POSITION_LOSS_S = 2.0


class BehaviourRunner:
    """Begins, updates and ends the active behaviour, and acts on its output.

    A behaviour that flew by setpoints is followed by a hold until the next command. After one that ended in
    an autopilot mode nothing is streamed.

    Args:
        setpoints, modes: what the outputs of a behaviour act on.
        queue: its waiting commands are superseded by a loss of command or a low battery.

    Attributes:
        behaviour: the active behaviour, including the hold between commands; None: none.
        active: the same, inside a sequence its current one; None: none has been updated yet.
        busy: a commanded behaviour has not ended yet.
        approached: the object that it flies to; None: none. needs: the requirements of `active`.
        gimbal_user: name of the behaviour that moves the gimbal; empty: none.
        goal_ned_m: where the behaviour before wanted the vehicle; None: unknown.
        failure: exception of the step before, in words; empty: none.
        command: the command of `behaviour`; None: it has none.
    """

    def __init__(
        self,
        setpoints: SetpointOutput,
        modes: ModeControl,
        battery: BatteryMinimum,
        queue: CommandQueue,
        out: OutputCollector,
    ) -> None:
        self.behaviour: Behaviour | None = None
        self.busy = False
        self.goal_ned_m: Vector3 | None = None
        self.failure = ""
        # Read once in each step, where an exception is handled.
        self.active: Behaviour | None = None
        self.gimbal_user = ""
        self.approached: Approached | None = None
        self.needs: frozenset[Requirement] = frozenset()
        self._landing = False
        self._taken_from: FlightMode | None = None
        self._took_over = ""
        self._setpoints = setpoints
        self._modes = modes
        self._battery = BatteryMonitor(battery)
        self._queue = queue
        self._out = out
        self.command: CommandInput | None = None
        self._answered = False
        self._after_battery = self._activated = False
        self._stepped_ns: int | None = None
        self._position_lost = Lasting()
        self._velocity_bias = VelocityBias()

    def begin_command(self, behaviour: Behaviour, command: CommandInput, context: BehaviourContext) -> None:
        """Replace the active behaviour by a command's."""
        self.end(Outcome(False, f"replaced by {behaviour.name}"))
        self._note_mode(context.state)
        received_ns = context.now_ns if command.received_ns is None else command.received_ns
        self._modes.prepare(context.state, received_ns)
        self._battery.reset()
        self._begin(behaviour, command)
        self._out.event(EventKind.STARTED, behaviour.name, "started")

    def update(
        self, context: BehaviourContext, before: BehaviourContext | None, inputs: GuidanceInput
    ) -> None:
        """Advance the active behaviour by one step. `before`: the previous step's input."""
        self._velocity_bias.update(context.state)
        if self.behaviour is None:
            return
        paused_s = 0.0 if before is None else (context.now_ns - before.now_ns) / 1e9
        self._report_reset(self.behaviour, before, context)
        why = self._modes.lost(context, inputs, paused_s, landing=self._landing)
        if why is not None or self._modes.yielded is not None:
            if (reason := self._modes.yield_command(why, context)) is not None:
                self._lose(reason)
            return
        # Before any hook of the behaviour: its exception must not lose the autopilot's answers.
        for answer in inputs.answers:
            if answer.identifier == self._modes.request:
                self._take_answer(answer, context)
        if self.behaviour is not None:
            self._monitor_battery(self.behaviour, context)
        self._modes.request_next(context)
        if self._modes.phase is Phase.ENGAGING and self._activated:
            if (why := self._modes.engage(context, inputs.stream.sent_count)) is not None:
                self._request_failed(why, context)
        elif self.behaviour is not None:
            self._run(self.behaviour, context, inputs.stream.sent_count)
        if self._setpoints.streaming and self._modes.phase is not Phase.OFFBOARD:
            self._setpoints.brake(context)

    def answer_endless(self, inputs: GuidanceInput) -> None:
        """Answer an endless command when the vehicle flies it."""
        command = self.command
        if command is None or not command.endless or self._answered:
            return
        offboard = self._modes.phase is Phase.OFFBOARD and inputs.state.mode is FlightMode.OFFBOARD
        if offboard and inputs.stream.state is StreamState.FRESH:
            self._out.in_progress(command.identifier, self._with_takeover(Outcome(True, "in progress")))
            self._answered = True

    def end_after_standstill(self, why: str) -> None:
        """The computer or the process stood still: our command ends in every phase."""
        self.goal_ned_m = None
        if self.behaviour is not None:
            self._lose(why)

    def handle_error(self, error: Exception, context: BehaviourContext, sent_count: int) -> None:
        """A hook of the behaviour raised: hold. Call it from the exception handler."""
        name = "guidance" if self.behaviour is None else self.behaviour.name
        failure = f"{type(error).__name__}: {error}"
        if failure != self.failure:  # the gimbal's would be logged with every step
            logger.exception("%s failed", name)
        self.failure = failure
        why = f"{name} failed: {failure}"
        if self._modes.yielded is not None:
            self._lose(self._modes.yielded)
        elif self.busy:
            try:
                self._conclude(Outcome(False, why), context, sent_count)
            except Exception:
                logger.exception("the hold after %s failed", name)
                self._lose(why, context.state)
        else:
            self._lose(why, context.state)

    def end(self, outcome: Outcome, *, reported: bool = False) -> None:
        """Remove the active behaviour; its command has ended."""
        behaviour, command, busy = self.behaviour, self.command, self.busy
        after_battery, self._after_battery = self._after_battery, False
        self.behaviour = self.command = self.active = self.approached = None
        self.busy, self._landing, self.gimbal_user = False, False, ""
        self.needs = frozenset()
        if behaviour is None:
            return
        if self._activated:
            try:
                behaviour.on_deactivate()
            except Exception:
                logger.exception("%s failed to deactivate", behaviour.name)
        if command is not None:
            self._out.ended(command.identifier, self._with_takeover(outcome), answered=self._answered)
        self._took_over = ""
        if after_battery:
            # No command waits for its result: log how it ended.
            self._battery_event(behaviour, f"{behaviour.name} after low battery: {outcome.reason}")
        if busy and not reported:
            self._out.event(EventKind.ENDED, behaviour.name, outcome.reason, outcome)

    def _begin(self, behaviour: Behaviour, command: CommandInput | None, *, busy: bool = True) -> None:
        self.behaviour, self.command, self.busy = behaviour, command, busy
        self._answered = False
        if command is None:
            self._modes.decide_alone()
        self._activated, self._position_lost = False, Lasting()
        self._setpoints.blind = False

    def _run(self, behaviour: Behaviour, context: BehaviourContext, sent_count: int) -> None:
        """Update the behaviour and act on its output."""
        self._setpoints.path = ()
        if Requirement.POSITION in behaviour.needs and not self._position_known(context):
            return
        if not self._activated:
            self._activated, self._stepped_ns = True, None
            self._setpoints.activate()
            behaviour.on_activate(context)
            if self.busy:
                self.goal_ned_m = None
        dt_s = 0.0 if self._stepped_ns is None else (context.now_ns - self._stepped_ns) / 1e9
        state = self._velocity_bias.fitting(context.state)
        seen = context if state is context.state else replace(context, state=state)
        step: BehaviourOutput = behaviour.update(dt_s, seen)
        for note in (*behaviour.take_notes(), *context.objects.take_notes()):
            self._out.event(EventKind.NOTED, behaviour.name, note)
        self._stepped_ns = context.now_ns
        if isinstance(step, RoutedSetpoint):
            offboard = self._modes.phase is Phase.OFFBOARD
            step = self._setpoints.steer(step, seen, behaviour.name, offboard=offboard)
        self.active = active = behaviour.active
        self._landing, self.approached, self.needs = active.landing, active.approached, active.needs
        self.gimbal_user = active.name if active.gimbal_aim is not None else ""
        match step:
            case Outcome():
                self._conclude(step, context, sent_count)
            case ModeRequest():
                if step != self._modes.requested:
                    self._modes.start_request(step, context)
            case Setpoint() if self._modes.phase is Phase.OFFBOARD:
                self._setpoints.limit(
                    step, seen, dt_s, behaviour.name, self._velocity_bias, landing=self._landing
                )
            case Setpoint():
                if self._modes.phase is not Phase.ENGAGING:
                    self._modes.start_engaging(context, sent_count)
            case _:
                got = type(step).__name__
                raise TypeError(f"update returned {got}, expected Setpoint, ModeRequest or Outcome")
        if self._modes.phase not in (Phase.ENGAGING, Phase.REQUESTING):
            self._modes.decide_alone()  # the command has not caused a request

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
        """The behaviour ended by itself: hold if setpoints are active, else hand over to the autopilot.

        A vehicle that we have armed and that is still on the ground is not held there, but disarmed.
        """
        behaviour = self.behaviour
        if behaviour is not None and self.busy and self._answered:
            # An endless command was answered when it began: its reply does not say how it ends.
            text = f"{behaviour.name} ended: {outcome.reason}"
            self._out.event(EventKind.NOTED, behaviour.name, text, warning=not outcome.success)
        self.end(outcome)
        self.goal_ned_m = outcome.goal_ned_m
        # The requested mode may show before the answer to the request.
        requested = self._modes.requested
        handed_over = requested is not None and context.state.mode is requested.mode
        if self._modes.phase is Phase.REQUESTING:
            self._modes.drop_request()
        if not self._setpoints.streaming or handed_over or self._modes.armed_on_ground:
            self._modes.release(context.state)
            return
        hold = HoldBehaviour()
        self._begin(hold, None, busy=False)
        if self._modes.phase is Phase.OFFBOARD:
            self._run(hold, replace(context, goal_ned_m=self.goal_ned_m), sent_count)

    def _monitor_battery(self, behaviour: Behaviour, context: BehaviourContext) -> None:
        """Low battery ends the behaviour; the vehicle brakes until the configured action begins."""
        state, now_ns = context.state, context.now_ns
        if (why := self._battery.unknown(behaviour, state, now_ns)) is not None:
            self._battery_event(behaviour, why)
        if (why := self._battery.ending(behaviour, state, now_ns)) is None:
            return
        ending = ENDINGS[self._battery.minimum.action]()
        self._battery_event(behaviour, f"{why}: {behaviour.name} ends, {ending.name} follows")
        self.end(Outcome(False, why))
        if self._modes.phase in (Phase.REQUESTING, Phase.DELEGATED):
            self._modes.drop_request()
        self._begin(ending, None)
        self._after_battery = True

    def _battery_event(self, behaviour: Behaviour, message: str) -> None:
        self._out.event(EventKind.BATTERY, behaviour.name, message, warning=True)
        self._queue.supersede(f"an event ({message})", self._out)

    def _position_known(self, context: BehaviourContext) -> bool:
        """Check the position estimate; without it brake, and after `POSITION_LOSS_S` give up command."""
        fault = context.state.position_fault(context.now_ns)
        lost_s = self._position_lost.held_s(fault is not None, context.now_ns)
        if fault is None:
            return True
        if lost_s == 0.0:
            logger.warning("position or attitude lost (%s): braking", fault)
        if lost_s > POSITION_LOSS_S:
            why = f"position or attitude lost for {POSITION_LOSS_S:g} s ({fault})"
            self._lose(why, context.state)
        elif self._modes.phase is Phase.OFFBOARD:
            self._setpoints.brake(context)
        return False

    def _note_mode(self, state: VehicleState) -> None:
        """Note the mode of an armed vehicle that somebody else flies, before we are in command."""
        if self._modes.phase is not Phase.IDLE:
            return
        flying = state.armed and state.landed is not LandedState.ON_GROUND
        self._taken_from = state.mode if flying and state.mode is not FlightMode.HOLD else None

    def _report_takeover(self, behaviour: Behaviour) -> None:
        """Report from which mode a command took over, once the vehicle has left it."""
        before, self._taken_from = self._taken_from, None
        if before is not None:
            self._took_over = f"took over from {before.value.replace('_', ' ')} mode"
            words = f"{behaviour.name} {self._took_over}"
            self._out.event(EventKind.NOTED, behaviour.name, words, warning=True)

    def _with_takeover(self, outcome: Outcome) -> Outcome:
        """A command's outcome, with the mode from which it took over."""
        if not self._took_over:
            return outcome
        return replace(outcome, reason=f"{outcome.reason}; {self._took_over}")

    def _take_answer(self, answer: Answer, context: BehaviourContext) -> None:
        """Handle the answer to the pending request."""
        engaging = self._modes.phase is Phase.ENGAGING
        if answer.taken_over and answer.refused is not None:
            # Where that change no longer shows, our message has arrived after it; the driver undoes that.
            self._lose(answer.refused)
            return
        why = self._modes.take_answer(answer, context.now_ns)
        if self._modes.phase in (Phase.OFFBOARD, Phase.DELEGATED) and self.behaviour is not None:
            self._report_takeover(self.behaviour)
        if why is not None:
            self._request_failed(why, context)
        elif engaging and self._modes.phase is Phase.OFFBOARD:
            self._stepped_ns = None
            if self.behaviour is not None:
                self._out.event(EventKind.ENGAGED, self.behaviour.name, "offboard engaged")

    def _request_failed(self, why: str, context: BehaviourContext) -> None:
        """The autopilot refused the request."""
        behaviour = self.behaviour
        if behaviour is not None and behaviour.request_failed(why):
            self._modes.resume(context.state.mode)
            return
        self.end(Outcome(False, why))
        streaming = self._setpoints.streaming and not self._modes.armed_on_ground
        if self._modes.phase is Phase.REQUESTING and streaming:
            self._modes.resume(context.state.mode)
            self._begin(HoldBehaviour(), None, busy=False)
        else:
            self._modes.release(context.state)

    def _lose(self, why: str, ended_in: VehicleState | None = None) -> None:
        """Command was lost: stop streaming and end the behaviour. `ended_in`: see `ModeControl.release`."""
        self._setpoints.stop()
        self.goal_ned_m = None
        behaviour, outcome = self.behaviour, Outcome(False, why)
        self.end(outcome, reported=True)
        self._modes.release(ended_in)
        if behaviour is not None:
            message = f"command lost: {why}"
            self._out.event(EventKind.LOST, behaviour.name, message, outcome, warning=True)
            self._queue.supersede(f"an event ({message})", self._out)
