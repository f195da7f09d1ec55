"""The values that go into guidance and those that come out of it. Plain data: no link, no clock, no I/O."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

from companion.guidance.behaviour import Behaviour, Outcome
from companion.guidance.formation.neighbours import Neighbourhood
from companion.guidance.targets.from_markers import NO_MARKERS, MarkerSight
from companion.guidance.targets.ranging import ALL_MEANS, RangeMeans
from companion.guidance.targets.target import Target
from companion.vehicle.gimbal import GimbalAim
from companion.vehicle.landing_target import LandingTarget
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, VehicleState
from companion.vehicle.streamer import StreamState
from vision.obstacle_sectors import ObstacleSectors


@dataclass(frozen=True, slots=True)
class SetMode:
    """Ask for a flight mode; done when the vehicle shows it."""

    mode: FlightMode


@dataclass(frozen=True, slots=True)
class Arm:
    """Arm; done when the vehicle shows it."""


@dataclass(frozen=True, slots=True)
class TakeOff:
    """The autopilot's own take-off to a height above home, metres; done when it is accepted."""

    altitude_m: float


@dataclass(frozen=True, slots=True)
class FindGimbal:
    """Ask for a gimbal manager and its streams; refused when none answers."""


@dataclass(frozen=True, slots=True)
class TakeGimbal:
    """Take primary control of the gimbal."""


@dataclass(frozen=True, slots=True)
class PointGimbal:
    """Point the gimbal; done when it is accepted, before it has turned."""

    aim: GimbalAim


@dataclass(frozen=True, slots=True)
class ReleaseGimbal:
    """Give primary control of the gimbal back."""


Action = SetMode | Arm | TakeOff | FindGimbal | TakeGimbal | PointGimbal | ReleaseGimbal


@dataclass(frozen=True, slots=True)
class Request:
    """Something to ask of the vehicle. It is answered once, by an `Answer` with the same identifier."""

    identifier: int
    action: Action


@dataclass(frozen=True, slots=True)
class Answer:
    """What became of a request. `refused` is the reason in words; None: it was done."""

    identifier: int
    refused: str | None = None


@dataclass(frozen=True, slots=True)
class CommandInput:
    """An operator's command. It is answered once, by a `CommandResult` with the same identifier.

    Attributes:
        text: as it is written, for messages.
        behaviour: what is to be flown; None: the command only points the gimbal.
        aim: where the gimbal is to look; None for a behaviour.
        endless: the command has no end of its own, so it is answered when the vehicle flies it.
        mode_changes: `GuidanceInput.mode_changes` when the command was given; None: not known. A change of
            mode or arming since then supersedes it: it was given to the vehicle as it was.
    """

    identifier: int
    text: str
    behaviour: Behaviour | None = None
    aim: GimbalAim | None = None
    endless: bool = False
    mode_changes: int | None = None

    def __post_init__(self) -> None:
        if (self.behaviour is None) == (self.aim is None):
            raise ValueError(f"{self.text}: a command is a behaviour or a gimbal aim, exactly one of them")


@dataclass(frozen=True, slots=True)
class CommandResult:
    """How a command ended, was refused, or that it is in progress (an endless one)."""

    identifier: int
    outcome: Outcome


@dataclass(frozen=True, slots=True)
class StreamStatus:
    """What became of our setpoints: the streamer's state and how many setpoints have left."""

    state: StreamState = StreamState.SILENT
    sent_count: int = 0


class EventKind(StrEnum):
    """What can happen to a behaviour, or to the gimbal."""

    STARTED = "started"
    ENGAGED = "engaged"  # the vehicle shows OFFBOARD and flies our setpoints
    NOTED = "noted"  # something that people should know
    ENDED = "ended"
    REFUSED = "refused"
    LOST = "lost"  # command was taken from us
    BLIND = "blind"  # it brakes for want of depth
    BATTERY = "battery"  # too little charge to fly on, or its state is unknown
    GIMBAL = "gimbal"


@dataclass(frozen=True, slots=True)
class GuidanceEvent:
    """One line for the record.

    Attributes:
        behaviour: its word; empty where the event is of no behaviour.
        outcome: there when a behaviour ended or was refused.
    """

    stamp_ns: int
    kind: EventKind
    behaviour: str
    message: str
    outcome: Outcome | None = None
    level: Literal["info", "warning"] = "info"


@dataclass(frozen=True, slots=True)
class GuidanceInput:
    """Everything that guidance is told at one step. Stamps are CLOCK_MONOTONIC nanoseconds.

    Attributes:
        state: the vehicle.
        stream: what became of the setpoints of the steps before.
        targets: what the steering camera saw in its newest frame, local NED.
        seen_ns: capture stamp of that frame; None: none came yet.
        obstacles: what the newest depth image says, however old; None: none came.
        markers: what is seen of markers, or why none can be.
        neighbourhood: the other vehicles; None: nobody listens for them.
        ranging: what there is to tell how far away an object is.
        class_names: what the detector knows; None: not known, so not checked.
        mode_changes: how often mode or armed changed since the link opened. A change that was reverted
            between two steps counts too.
        answers: to requests of earlier steps. commands: the new ones, the oldest first.
        ending: the service ends: no command begins, and what is held is given back.
    """

    state: VehicleState
    stream: StreamStatus = StreamStatus()
    targets: tuple[Target, ...] = ()
    seen_ns: int | None = None
    obstacles: ObstacleSectors | None = None
    markers: MarkerSight = NO_MARKERS
    neighbourhood: Neighbourhood | None = None
    ranging: RangeMeans = ALL_MEANS
    class_names: tuple[str, ...] | None = None
    mode_changes: int = 0
    answers: tuple[Answer, ...] = ()
    commands: tuple[CommandInput, ...] = ()
    ending: bool = False


@dataclass(frozen=True, slots=True)
class GuidanceOutput:
    """What is to be done after one step.

    Attributes:
        setpoint: to stream from now on, a brake included; None: stop streaming.
        requests: new ones. cancelled: identifiers of requests that nobody waits for any more.
        landing_target: for the autopilot, once for every frame that shows one.
        released: after `ending`: nothing is asked and nothing is held any more.
    """

    setpoint: Setpoint | None
    requests: tuple[Request, ...] = ()
    cancelled: tuple[int, ...] = ()
    landing_target: LandingTarget | None = None
    events: tuple[GuidanceEvent, ...] = ()
    results: tuple[CommandResult, ...] = ()
    released: bool = False


@dataclass(slots=True)
class OutputCollector:
    """Gathers what one step puts out. Identifiers of requests go on from step to step."""

    now_ns: int = 0
    requests: list[Request] = field(default_factory=list)
    cancelled: list[int] = field(default_factory=list)
    events: list[GuidanceEvent] = field(default_factory=list)
    results: list[CommandResult] = field(default_factory=list)
    _identifier: int = 0

    def begin(self, now_ns: int) -> None:
        """A new step."""
        self.now_ns = now_ns
        self.requests, self.cancelled, self.events, self.results = [], [], [], []

    def request(self, action: Action) -> int:
        """Ask for something; returns the request's identifier."""
        self._identifier += 1
        self.requests.append(Request(self._identifier, action))
        return self._identifier

    def cancel(self, identifier: int) -> None:
        """Nobody waits for this request any more; one of this very step is not made at all."""
        kept = [request for request in self.requests if request.identifier != identifier]
        if len(kept) == len(self.requests):
            self.cancelled.append(identifier)
        self.requests = kept

    def event(
        self,
        kind: EventKind,
        behaviour: str,
        message: str,
        outcome: Outcome | None = None,
        *,
        warning: bool = False,
    ) -> None:
        """Tell people."""
        level: Literal["info", "warning"] = "warning" if warning else "info"
        self.events.append(GuidanceEvent(self.now_ns, kind, behaviour, message, outcome, level))

    def result(self, identifier: int | None, outcome: Outcome) -> None:
        """Answer a command; None: nobody asked, or it was answered before."""
        if identifier is not None:
            self.results.append(CommandResult(identifier, outcome))
