"""Runs one behaviour at a time: engages OFFBOARD for it, keeps it inside the envelope, yields to the pilot.

Everything happens in `update`, called at the guidance rate; it never waits. Requests to the autopilot run in
a task of their own, one at a time. When the vehicle shows a mode that we did not ask for, our command ends at
once and nothing is sent any more until an operator's next command, even if OFFBOARD comes back by itself.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from enum import StrEnum

from companion.guidance.authority import Authority
from companion.guidance.battery import ENDINGS, NO_MINIMUM, BatteryMinimum, BatteryWatch
from companion.guidance.behaviour import Behaviour, ModeRequest, Outcome, Requirement, Situation, Step
from companion.guidance.envelope import Envelope
from companion.guidance.hold import HoldBehaviour
from companion.guidance.mode_request import perform
from companion.guidance.obstacles import NO_RULES, ObstacleMemory, ObstacleRules
from companion.guidance.pilot_event import PilotEvent, PilotEventKind
from companion.guidance.refusal import refusal
from companion.vehicle.driver import CommandRefusedError, Driver, LinkError
from companion.vehicle.setpoint import DEFAULT_LIFETIME_S, Setpoint
from companion.vehicle.state import FlightMode
from companion.vehicle.streamer import SILENCE_S, Streamer, StreamState

logger = logging.getLogger(__name__)

# PX4 takes OFFBOARD after one setpoint; a few more cost 60 ms and survive a lost packet.
SETPOINTS_BEFORE_OFFBOARD = 3
ENGAGE_TIMEOUT_S = 3.0
# In OFFBOARD without knowing where we are: brake so long, then leave it to the autopilot.
POSITION_LOSS_S = 2.0


class _Phase(StrEnum):
    IDLE = "idle"  # not in command
    READY = "ready"  # in command, nothing asked of the vehicle yet
    ENGAGING = "engaging"  # sending a brake and asking for OFFBOARD
    OFFBOARD = "offboard"  # the vehicle flies our setpoints
    REQUESTING = "requesting"  # asking for one of the autopilot's own modes
    DELEGATED = "delegated"  # the autopilot flies that mode


class Pilot:
    """One vehicle's pilot. All methods are called from the loop in which the driver lives.

    After a behaviour that flew by setpoints a hold goes on, until the next command; after one that ended in a
    mode of the autopilot's own nothing is sent.

    Args:
        class_names: tells what the detector knows now; None where that is not known.

    Attributes:
        asked: the last setpoint a behaviour gave; None while none is flown.
        sent: what the envelope made of it (or the brake that is sent while a mode is asked for).
        limited_by: which limits acted on it.
    """

    def __init__(
        self,
        driver: Driver,
        streamer: Streamer,
        envelope: Envelope,
        *,
        on_event: Callable[[PilotEvent], None],
        class_names: Callable[[], Sequence[str] | None] = lambda: None,
        lifetime_s: float = DEFAULT_LIFETIME_S,
        battery: BatteryMinimum = NO_MINIMUM,
        obstacles: ObstacleRules = NO_RULES,
    ) -> None:
        self._lifetime_s = lifetime_s
        self._driver, self._streamer, self._envelope = driver, streamer, envelope
        self._on_event, self._class_names = on_event, class_names
        self._authority = Authority()
        self._battery = BatteryWatch(battery)
        self._obstacles, self._memory = obstacles, ObstacleMemory()
        self._phase = _Phase.IDLE
        self._behaviour: Behaviour | None = None
        self._future: asyncio.Future[Outcome] | None = None
        self._activated = False
        self._situation: Situation | None = None
        self._stepped_ns: int | None = None
        self._streaming = False
        self._task: asyncio.Task[None] | None = None
        self._requested: ModeRequest | None = None
        self._engaging_since_ns = 0
        self._sent_before_engaging = 0
        self._position_lost_ns: int | None = None
        self._blind = False
        self.asked: Setpoint | None = None
        self.sent: Setpoint | None = None
        self.limited_by: tuple[str, ...] = ()

    @property
    def behaviour(self) -> Behaviour | None:
        """What runs now, also the hold that goes on when nothing else does; None: nothing."""
        return self._behaviour

    @property
    def busy(self) -> bool:
        """A commanded behaviour has not ended yet."""
        return self._future is not None

    @property
    def in_command(self) -> bool:
        """The vehicle does what we ask, as far as we know."""
        return self._phase is not _Phase.IDLE

    @property
    def phase(self) -> str:
        """idle, ready, engaging, offboard, requesting or delegated."""
        return self._phase.value

    @property
    def status(self) -> str:
        """A few words for people."""
        if self._behaviour is None:
            return "not in command"
        words = self._behaviour.status
        if self._phase is _Phase.ENGAGING:
            words += ", engaging offboard"
        return words if self.busy else f"{words}, no command"

    def command(self, behaviour: Behaviour) -> asyncio.Future[Outcome]:
        """Let a behaviour take the place of the current one. The future tells how it ended.

        Refused when something it needs is missing: the future is then done, and the current one goes on.
        """
        future: asyncio.Future[Outcome] = asyncio.get_running_loop().create_future()
        missing = self.refusal_of(behaviour)
        if missing is not None or self._situation is None:
            outcome = Outcome(False, missing or "the vehicle's state is not known yet")
            future.set_result(outcome)
            self._tell(PilotEventKind.REFUSED, behaviour, f"refused: {outcome.reason}", outcome)
            return future
        self._end(Outcome(False, f"replaced by {behaviour.name}"))
        if self._phase is _Phase.IDLE:
            self._authority.take(self._situation.state)
            self._phase = _Phase.READY
        elif self._phase is _Phase.REQUESTING:
            self._drop_request()
        elif self._phase is _Phase.DELEGATED:
            self._phase, self._requested = _Phase.READY, None
        self._battery.reset()
        self._begin(behaviour, future)
        self._tell(PilotEventKind.STARTED, behaviour, "started")
        return future

    def refusal_of(self, behaviour: Behaviour) -> str | None:
        """Why this behaviour could not begin now; None: it could."""
        situation = self._situation
        missing = refusal(behaviour, situation, self._class_names(), self._battery.minimum, self._obstacles)
        if missing is not None or situation is None:
            return missing
        for goal in behaviour.goals(situation):
            if (why := self._envelope.why_not_there(goal, situation.state)) is not None:
                return f"{behaviour.name} would leave the limits: {why}"
        return None

    def update(self, situation: Situation) -> None:
        """One turn of the guidance loop. Never waits."""
        situation = replace(situation, sent=self.sent)
        before, self._situation = self._situation, situation
        if self._behaviour is None:
            return
        paused_s = 0.0 if before is None else (situation.now_ns - before.now_ns) / 1e9
        why = self._silent(paused_s) or self._authority.lost(
            situation.state,
            situation.now_ns,
            flying_by_setpoint=self._phase in (_Phase.ENGAGING, _Phase.OFFBOARD),
        )
        if why is not None:
            self._lose(why)
            return
        self._watch_battery(self._behaviour, situation)
        if self._task is not None and self._task.done():
            self._finish_request(self._task, situation)
        if self._phase is _Phase.ENGAGING and self._activated:
            self._engage(situation)
        elif self._behaviour is not None:
            self._run(self._behaviour, situation)
        if self._streaming and self._phase is not _Phase.OFFBOARD:
            self._brake(situation)

    def close(self, reason: str = "the service ends") -> None:
        """End the behaviour and send nothing more."""
        self._end(Outcome(False, reason))
        self._release()

    def _begin(self, behaviour: Behaviour, future: asyncio.Future[Outcome] | None) -> None:
        self._behaviour, self._future = behaviour, future
        self._activated, self._position_lost_ns, self._blind = False, None, False

    def _run(self, behaviour: Behaviour, situation: Situation) -> None:
        """One step of the behaviour, and what follows from it."""
        if Requirement.POSITION in behaviour.requirements and not self._position_known(situation):
            return
        try:
            if not self._activated:
                self._activated, self._stepped_ns = True, None
                behaviour.on_activate(situation)
            dt_s = 0.0 if self._stepped_ns is None else (situation.now_ns - self._stepped_ns) / 1e9
            step: Step = behaviour.update(dt_s, situation)
            for note in behaviour.take_notes():
                self._tell(PilotEventKind.NOTED, behaviour, note)
        except Exception as error:
            # Whatever a behaviour does wrong, the vehicle must be held; the traceback is in the log.
            logger.exception("%s failed", behaviour.name)
            if not self.busy:
                self._lose(f"{behaviour.name} failed: {type(error).__name__}: {error}")
                return
            dt_s, step = 0.0, Outcome(False, f"{behaviour.name} failed: {type(error).__name__}: {error}")
        self._stepped_ns = situation.now_ns
        match step:
            case Outcome():
                self._conclude(step, situation)
            case ModeRequest():
                if step != self._requested:
                    self._start_request(step, situation)
            case Setpoint() if self._phase is _Phase.OFFBOARD:
                # How long a setpoint counts is the operator's setting, whatever its behaviour wrote.
                deadline_ns = situation.now_ns + round(self._lifetime_s * 1e9)
                blind = self._obstacles.blind(situation)
                self._tell_blindness(behaviour, blind)
                if blind is not None:
                    self._brake(situation)
                    self.asked, self.limited_by = replace(step, deadline_ns=deadline_ns), (blind,)
                    return
                self._envelope.near = self._obstacles.rows(self._memory.filled(situation))
                self.asked = replace(step, deadline_ns=deadline_ns)
                self.sent, self.limited_by = self._envelope.apply(
                    self.asked,
                    situation.state,
                    situation.now_ns,
                    dt_s,
                    situation.neighbours,
                    landing=behaviour.flown.landing,
                )
                self._streamer.submit(self.sent)
            case Setpoint() if self._phase is not _Phase.ENGAGING:
                self._start_engaging(situation)

    def _tell_blindness(self, behaviour: Behaviour, blind: str | None) -> None:
        """Say once that the vehicle brakes for want of depth, and once that it flies on."""
        if (blind is not None) is not self._blind:
            self._blind = blind is not None
            if blind is None:
                self._tell(PilotEventKind.NOTED, behaviour, "depth is back")
            else:
                self._tell(PilotEventKind.BLIND, behaviour, f"braking: {blind}")

    def _conclude(self, outcome: Outcome, situation: Situation) -> None:
        """It ended by itself: hold where setpoints are flown, else leave it to the autopilot."""
        self._end(outcome)
        if self._phase is _Phase.REQUESTING:
            self._drop_request()
        if not self._streaming:
            self._release()
            return
        hold = HoldBehaviour()
        self._begin(hold, None)
        if self._phase is _Phase.OFFBOARD:
            self._run(hold, situation)

    def _watch_battery(self, behaviour: Behaviour, situation: Situation) -> None:
        """Too little charge ends what flies; the vehicle brakes until what the operator chose begins."""
        state, now_ns = situation.state, situation.now_ns
        if (why := self._battery.unknown(behaviour, state, now_ns)) is not None:
            self._tell(PilotEventKind.BATTERY, behaviour, why)
        if (why := self._battery.ending(behaviour, state, now_ns)) is None:
            return
        ending = ENDINGS[self._battery.minimum.action]()
        self._tell(PilotEventKind.BATTERY, behaviour, f"{why}: {behaviour.name} ends, {ending.name} follows")
        self._end(Outcome(False, why))
        if self._phase in (_Phase.REQUESTING, _Phase.DELEGATED):
            self._drop_request()
        ended: asyncio.Future[Outcome] = asyncio.get_running_loop().create_future()
        # Nobody asked for it, so nobody else tells how it went.
        ended.add_done_callback(
            lambda done: self._tell(
                PilotEventKind.BATTERY, ending, f"{ending.name} after low battery: {done.result().reason}"
            )
        )
        self._begin(ending, ended)

    def _silent(self, paused_s: float) -> str | None:
        """Why our setpoints failed to go out, if they did.

        PX4 would take OFFBOARD up again by itself if setpoints came back; only an operator may.
        """
        if not self._streaming:
            return None
        if paused_s > SILENCE_S:
            return f"our own guidance stood still for {paused_s:.1f} s"
        if self._streamer.state is StreamState.EXPIRED:
            return "no setpoint left for too long, the autopilot's failsafe has the vehicle"
        return None

    def _position_known(self, situation: Situation) -> bool:
        """False: brake for now; for too long: give the command up."""
        if situation.state.position_fresh(situation.now_ns):
            self._position_lost_ns = None
            return True
        if self._position_lost_ns is None:
            logger.warning("position or attitude is too old: braking")
            self._position_lost_ns = situation.now_ns
        if situation.now_ns - self._position_lost_ns > POSITION_LOSS_S * 1e9:
            self._lose(f"position or attitude has been missing for {POSITION_LOSS_S:g} s")
        elif self._phase is _Phase.OFFBOARD:
            self._brake(situation)
        return False

    def _brake(self, situation: Situation) -> None:
        self.asked, self.limited_by = None, ()
        self.sent = Setpoint.brake(situation.now_ns, self._lifetime_s)
        self._envelope.reset()
        self._streamer.submit(self.sent)

    def _start_engaging(self, situation: Situation) -> None:
        """Setpoints first; OFFBOARD is asked for when some have left."""
        self._drop_request()
        self._phase, self._streaming = _Phase.ENGAGING, True
        self._engaging_since_ns = situation.now_ns
        self._sent_before_engaging = self._streamer.sent_count
        self._authority.request(FlightMode.OFFBOARD, situation.state)

    def _engage(self, situation: Situation) -> None:
        if self._task is not None:
            return
        if self._streamer.sent_count - self._sent_before_engaging >= SETPOINTS_BEFORE_OFFBOARD:
            self._task = asyncio.get_running_loop().create_task(self._driver.set_mode(FlightMode.OFFBOARD))
        elif situation.now_ns - self._engaging_since_ns > ENGAGE_TIMEOUT_S * 1e9:
            self._fail(f"offboard not asked for: no setpoint left within {ENGAGE_TIMEOUT_S:g} s")

    def _start_request(self, request: ModeRequest, situation: Situation) -> None:
        """Ask for a mode of the autopilot's own. Out of OFFBOARD, a brake is sent until it shows."""
        self._drop_request()
        self._phase, self._requested = _Phase.REQUESTING, request
        self._authority.request(request.mode, situation.state, request.altitude_m)
        self._task = asyncio.get_running_loop().create_task(perform(self._driver, request))

    def _finish_request(self, task: asyncio.Task[None], situation: Situation) -> None:
        """The request in flight is over: what was asked for shows, or was refused."""
        self._task = None
        error = None if task.cancelled() else task.exception()
        if task.cancelled():
            error = CommandRefusedError("the request was cancelled")
        if error is not None:
            if not isinstance(error, CommandRefusedError | LinkError):
                logger.error("a request to the autopilot failed", exc_info=error)
            self._fail(str(error) or type(error).__name__)
            return
        self._authority.settled(situation.now_ns)
        if self._phase is _Phase.ENGAGING:
            self._phase, self._stepped_ns = _Phase.OFFBOARD, None
            self._envelope.reset()
            if self._behaviour is not None:
                self._tell(PilotEventKind.ENGAGED, self._behaviour, "offboard engaged")
        else:
            self._phase = _Phase.DELEGATED
            self._silence()

    def _fail(self, why: str) -> None:
        """The autopilot did not do what was asked."""
        behaviour, situation = self._behaviour, self._situation
        if behaviour is not None and situation is not None and behaviour.request_failed(why):
            flying = self._phase is _Phase.REQUESTING and self._streaming
            if not flying:
                self._silence()
            # What shows now is the mode from before: a pilot's would have ended our command already.
            self._authority.refused(FlightMode.OFFBOARD if flying else situation.state.mode)
            self._phase, self._requested = _Phase.OFFBOARD if flying else _Phase.READY, None
            return
        self._end(Outcome(False, why))
        if self._phase is _Phase.REQUESTING and self._streaming:
            # Still flying setpoints: hold. If the mode changed after all, that ends our command.
            self._authority.refused(FlightMode.OFFBOARD)
            self._phase, self._requested = _Phase.OFFBOARD, None
            self._begin(HoldBehaviour(), None)
        else:
            self._release()

    def _lose(self, why: str) -> None:
        """Command was taken from us: not one setpoint more."""
        self._silence()
        behaviour = self._behaviour
        outcome = Outcome(False, why)
        self._end(outcome, told=True)
        self._release()
        if behaviour is not None:
            self._tell(PilotEventKind.LOST, behaviour, f"command lost: {why}", outcome)

    def _end(self, outcome: Outcome, *, told: bool = False) -> None:
        """Take the current behaviour off, and tell who asked for it."""
        behaviour, future = self._behaviour, self._future
        self._behaviour = self._future = None
        if behaviour is None:
            return
        if self._activated:
            try:
                behaviour.on_deactivate()
            except Exception:
                logger.exception("%s failed to deactivate", behaviour.name)
        if future is not None:
            if not future.done():
                future.set_result(outcome)
            if not told:
                self._tell(PilotEventKind.ENDED, behaviour, outcome.reason, outcome)

    def _release(self) -> None:
        """Not in command any more."""
        self._drop_request()
        self._silence()
        self._authority.release()
        self._phase = _Phase.IDLE

    def _silence(self) -> None:
        self._streamer.stop()
        self._envelope.reset()
        self._streaming = False
        self.asked = self.sent = None
        self.limited_by = ()

    def _drop_request(self) -> None:
        """Forget a request in flight: it is not repeated, but it may still take effect."""
        self._requested = None
        if self._task is not None:
            self._task.cancel()
            self._task = None
            if self._situation is not None:
                self._authority.dropped(self._situation.now_ns)
        if self._phase in (_Phase.REQUESTING, _Phase.DELEGATED):
            self._phase = _Phase.READY

    def _tell(
        self, kind: PilotEventKind, behaviour: Behaviour, message: str, outcome: Outcome | None = None
    ) -> None:
        stamp_ns = 0 if self._situation is None else self._situation.now_ns
        # Whoever listens writes the record; here it is only for finding faults.
        logger.debug("%s: %s", behaviour.name, message)
        try:
            self._on_event(PilotEvent(stamp_ns, kind, behaviour.name, message, outcome))
        except Exception:
            # Who listens must not be able to bring the vehicle down.
            logger.exception("an event listener failed")
