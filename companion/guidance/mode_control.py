"""Our command of the vehicle: OFFBOARD or one of the autopilot's own modes, and the requests for them."""

from __future__ import annotations

from enum import StrEnum

from companion.guidance.authority import Authority, stream_interruption
from companion.guidance.behaviour import BehaviourContext, ModeRequest
from companion.guidance.interface import Answer, Arm, Disarm, GuidanceInput, OutputCollector, SetMode, TakeOff
from companion.guidance.motion import Lasting
from companion.guidance.setpoint_output import SetpointOutput
from companion.vehicle.setpoint_loss import setpoint_loss_outcome
from companion.vehicle.state import FlightMode, LandedState, VehicleState
from companion.vehicle.streamer import StreamState

# PX4 accepts OFFBOARD after one setpoint; two more cost 60 ms and tolerate a lost packet.
SETPOINTS_BEFORE_OFFBOARD = 3
ENGAGE_TIMEOUT_S = 3.0
# After a loss of command: wait this long for the autopilot's reason. Nothing is streamed meanwhile.
REASON_WAIT_S = 0.3
# After a change of mode PX4 runs its pre-arm checks again; the result comes with the next heartbeat.
READY_TIMEOUT_S = 3.0


class Phase(StrEnum):
    """State of our command of the vehicle."""

    IDLE = "idle"  # not in command
    READY = "ready"  # in command, nothing requested of the vehicle yet
    ENGAGING = "engaging"  # streaming a brake and requesting OFFBOARD
    OFFBOARD = "offboard"  # the vehicle flies our setpoints
    REQUESTING = "requesting"  # requesting one of the autopilot's own modes
    DELEGATED = "delegated"  # the autopilot flies that mode


class ModeControl:
    """Requests OFFBOARD and the autopilot's modes for behaviours, and detects the loss of our command.

    Args:
        setpoints: stopped when we give up command or an autopilot mode begins.
        out: receives the requests.

    Attributes:
        phase: state of our command.
        requested: the mode request that is pending or active; None: none.
        request: identifier of the pending request; None: none.
        armed_on_ground: we have armed the vehicle, and it has not taken off since.
    """

    def __init__(self, setpoints: SetpointOutput, out: OutputCollector) -> None:
        self.phase = Phase.IDLE
        self.requested: ModeRequest | None = None
        self.request: int | None = None
        self._setpoints = setpoints
        self._out = out
        self._authority = Authority()
        self._sequence: _ModeSequence | None = None
        self._engaging_since_ns = 0
        self._sent_before_engaging = 0
        self._yielded: tuple[int, str] | None = None
        self.armed_on_ground = False
        self._disarm: int | None = None
        self._commanded_ns: int | None = None

    @property
    def yielded(self) -> str | None:
        """Why command was lost, while the autopilot's own reason is awaited; None: it was not."""
        return None if self._yielded is None else self._yielded[1]

    def prepare(self, state: VehicleState, received_ns: int) -> None:
        """A command begins: take command of the vehicle, or drop the autopilot mode of the one before.

        `received_ns`: of the command; its first request is not sent long after that.
        """
        if self._disarm is not None:
            self._out.cancel(self._disarm)
            self._disarm = None
        if self.phase is Phase.IDLE:
            self._authority.acquire(state)
            self.phase = Phase.READY
        elif self.phase is Phase.REQUESTING:
            self.drop_request()
        elif self.phase is Phase.DELEGATED:
            self.phase, self.requested = Phase.READY, None
        self._commanded_ns = received_ns

    def decide_alone(self) -> None:
        """What is requested from now on is guidance's own decision, not directly caused by a command."""
        self._commanded_ns = None

    def lost(
        self, context: BehaviourContext, inputs: GuidanceInput, paused_s: float, *, landing: bool
    ) -> str | None:
        """Why command was lost; None while in command. Call it once per step. `paused_s`: since the last."""
        self.armed_on_ground &= context.state.landed is LandedState.ON_GROUND
        stream = inputs.stream.state
        interrupted = None
        if self._setpoints.streaming:
            interrupted = stream_interruption(stream, paused_s)
            if stream is StreamState.EXPIRED and interrupted is not None:
                outcome = setpoint_loss_outcome(
                    inputs.parameters, sticks_present=context.state.sticks_present
                )
                interrupted = f"{interrupted}: {outcome.text}"
        active = stream is StreamState.FRESH and self.phase is Phase.OFFBOARD
        return interrupted or self._authority.lost(
            context.state,
            context.now_ns,
            flying_by_setpoint=self.phase in (Phase.ENGAGING, Phase.OFFBOARD),
            sent=self._setpoints.sent if active else None,
            landing=landing,
            altitude_acceptance_m=self._setpoints.altitude_acceptance_m,
        )

    def yield_command(self, why: str | None, context: BehaviourContext) -> str | None:
        """Stop streaming at once. Returns the reason when the autopilot has reported its own; None: wait."""
        since_ns, first = self._yielded or (context.now_ns, why or "")
        reason = why or first
        self._yielded = (since_ns, reason)
        self._setpoints.stop()
        state, now_ns = context.state, context.now_ns
        waited_s = (now_ns - since_ns) / 1e9
        known = why is None or waited_s >= REASON_WAIT_S or self._authority.reason_is_logged(state, now_ns)
        if not known:
            return None
        reasons = self._authority.reasons_for(state, now_ns)
        if self._authority.chose_hold(state, now_ns):
            # Else PX4 treats the setpoints as lost and leaves hold for a return after 1.2 s.
            self._out.request(SetMode(FlightMode.HOLD))
        return f"{reason} ({reasons})" if reasons else reason

    def start_engaging(self, context: BehaviourContext, sent_count: int) -> None:
        """Stream a brake; OFFBOARD is requested after `SETPOINTS_BEFORE_OFFBOARD` setpoints."""
        self.drop_request()
        self.phase = Phase.ENGAGING
        self._setpoints.streaming = True
        self._engaging_since_ns = context.now_ns
        self._sent_before_engaging = sent_count
        self._authority.request(FlightMode.OFFBOARD, context.state)

    def engage(self, context: BehaviourContext, sent_count: int) -> str | None:
        """Request OFFBOARD when enough setpoints were sent. Returns why that failed; None: it did not."""
        if self.request is not None:
            return None
        if sent_count - self._sent_before_engaging >= SETPOINTS_BEFORE_OFFBOARD:
            self.request = self._out.request(SetMode(FlightMode.OFFBOARD), self._commanded_ns)
        elif context.now_ns - self._engaging_since_ns > ENGAGE_TIMEOUT_S * 1e9:
            return f"offboard not requested: no setpoint sent within {ENGAGE_TIMEOUT_S:g} s"
        return None

    def start_request(self, request: ModeRequest, context: BehaviourContext) -> None:
        """Request an autopilot mode. From OFFBOARD, a brake is streamed until the mode shows."""
        self.drop_request()
        self.phase, self.requested = Phase.REQUESTING, request
        self._authority.request(request.mode, context.state, request.altitude_m)
        self._sequence = _ModeSequence(request, context.state)
        self.request_next(context)

    def request_next(self, context: BehaviourContext) -> None:
        """Request the next action of a mode sequence, once the previous one is done."""
        if self._sequence is not None and self.request is None:
            action = self._sequence.next(context.now_ns, context.state)
            if action is not None:
                self.request = self._out.request(action, self._commanded_ns)
                self.armed_on_ground |= isinstance(action, Arm)

    def take_answer(self, answer: Answer, now_ns: int) -> str | None:
        """Handle the answer to the pending request. Returns why it failed; None: it did not."""
        self.request = None
        if answer.refused is not None:
            self._sequence = self._commanded_ns = None
            return answer.refused
        if self._sequence is not None and not self._sequence.finished:
            return None
        self._sequence = self._commanded_ns = None
        self._authority.settled(now_ns)
        if self.phase is Phase.ENGAGING:
            self.phase = Phase.OFFBOARD
            self._setpoints.reset()
        else:
            self.phase = Phase.DELEGATED
            self._setpoints.stop()
        return None

    def resume(self, shown: FlightMode) -> None:
        """The request failed: go on with our setpoints, or in the mode that shows."""
        if self.phase is Phase.REQUESTING and self._setpoints.streaming:
            # If the mode changed nevertheless, that ends our command.
            self._authority.refused(FlightMode.OFFBOARD)
            self.phase = Phase.OFFBOARD
        else:
            self._setpoints.stop()
            # The mode that shows now is the previous one: a pilot's would have ended our command already.
            self._authority.refused(shown)
            self.phase = Phase.READY
        self.requested = None

    def drop_request(self) -> None:
        """Abandon the pending request: it is not repeated, but may still take effect."""
        pending = self.request is not None or self._sequence is not None
        self.requested = self._sequence = None
        if self.request is not None:
            self._out.cancel(self.request)
            self.request = None
        if pending:
            self._commanded_ns = None
            self._authority.dropped(self._out.now_ns)
        if self.phase in (Phase.REQUESTING, Phase.DELEGATED):
            self.phase = Phase.READY

    def release(self, ended_in: VehicleState | None = None) -> None:
        """Give up command.

        Args:
            ended_in: the state in which the behaviour ended by itself: a vehicle that was armed by us and is
                still on the ground is disarmed. None: someone else is in command.
        """
        if ended_in is not None and self.armed_on_ground and ended_in.armed:
            self._disarm = self._out.request(Disarm())
        self.armed_on_ground = False
        self._yielded = self._commanded_ns = None
        self.drop_request()
        self._setpoints.stop()
        self._authority.release()
        self.phase = Phase.IDLE


class _ModeSequence:
    """The actions of one mode request. Only a take-off with `arm` set arms, by setpoints in HOLD."""

    def __init__(self, request: ModeRequest, state: VehicleState) -> None:
        self._actions: list[SetMode | Arm | TakeOff] = []
        self._waiting = Lasting()
        arms = request.mode in (FlightMode.TAKEOFF, FlightMode.HOLD)
        if request.arm and arms and not state.armed:
            # After a landing PX4 may show the mode from before the landing, in which it does not arm.
            if state.mode is not FlightMode.HOLD:
                self._actions.append(SetMode(FlightMode.HOLD))
            self._actions.append(Arm())
            if request.mode is FlightMode.HOLD:
                return
        if request.mode is FlightMode.TAKEOFF and request.altitude_m is not None:
            self._actions.append(TakeOff(request.altitude_m))
        else:
            self._actions.append(SetMode(request.mode))

    @property
    def finished(self) -> bool:
        """Whether every action was returned by `next`."""
        return not self._actions

    def next(self, now_ns: int, state: VehicleState) -> SetMode | Arm | TakeOff | None:
        """The next action, once the previous one is done. None: the pre-arm checks still run.

        After `READY_TIMEOUT_S` arming is requested anyway: the autopilot then reports what is wrong.
        """
        if not self._actions:
            return None
        waits = isinstance(self._actions[0], Arm) and not state.ready_to_arm
        if waits and self._waiting.held_s(True, now_ns) <= READY_TIMEOUT_S:
            return None
        return self._actions.pop(0)
