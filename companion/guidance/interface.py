"""Input and output values of guidance. Plain data: no link, no clock, no I/O."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

from companion.guidance.behaviour import Behaviour, Outcome, VelocityInput
from companion.guidance.formation.neighbours import Neighbourhood
from companion.guidance.objects.from_markers import NO_MARKERS, MarkerSight
from companion.guidance.objects.ranging import ALL_MEANS, RangeMeans
from companion.guidance.objects.target import Target
from companion.guidance.objects.tracked_object import GimbalGoal, TrackedObject
from companion.guidance.search_pattern import Footprint
from companion.host.clock import Standstill
from companion.vehicle.autopilot_parameters import NOTHING_READ, AutopilotParameters
from companion.vehicle.gimbal import GimbalAim
from companion.vehicle.landing_target import LandingTarget
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, VehicleState
from companion.vehicle.streamer import StreamState
from vision.obstacle_sectors import ObstacleSectors
from vision.path_planner import PathRequest, PlannedPath


@dataclass(frozen=True, slots=True)
class SetMode:
    """Set a flight mode; done when the vehicle shows it."""

    mode: FlightMode


@dataclass(frozen=True, slots=True)
class Arm:
    """Arm; done when the vehicle shows it."""


@dataclass(frozen=True, slots=True)
class Disarm:
    """Disarm, never forced in the air; done when the vehicle shows it."""


@dataclass(frozen=True, slots=True)
class TakeOff:
    """The autopilot's own take-off to a height above home, metres; done when it is accepted."""

    altitude_m: float


@dataclass(frozen=True, slots=True)
class FindGimbal:
    """Request a gimbal manager and its streams; refused when none responds."""


@dataclass(frozen=True, slots=True)
class TakeGimbal:
    """Take primary control of the gimbal."""


@dataclass(frozen=True, slots=True)
class PointGimbal:
    """Point the gimbal; done when it is accepted, before it has turned."""

    aim: GimbalAim


@dataclass(frozen=True, slots=True)
class ReleaseGimbal:
    """Release primary control of the gimbal."""


Action = SetMode | Arm | Disarm | TakeOff | FindGimbal | TakeGimbal | PointGimbal | ReleaseGimbal


# How long a request may be sent or repeated: after guidance's decision (a take-off waits up to 3 s for home),
# and what the operator's command directly causes after its reception. The longest waits of a command: 4 s for
# the gimbal, home or detections, 3 s for each of hold, pre-arm checks, arming and home.
REQUEST_VALID_S, COMMAND_VALID_S = 8.0, 15.0


@dataclass(frozen=True, slots=True)
class Request:
    """A request to the vehicle. It is answered once, by an `Answer` with the same identifier.

    `valid_until_ns`: it is not sent or repeated after that, CLOCK_MONOTONIC nanoseconds.
    """

    identifier: int
    action: Action
    valid_until_ns: int


@dataclass(frozen=True, slots=True)
class Answer:
    """The result of a request. `refused` is the reason in words; None: it was done.

    `taken_over`: the reason is a change of mode or arming by someone else, or by the autopilot itself. It may
    no longer show.
    """

    identifier: int
    refused: str | None = None
    taken_over: bool = False


@dataclass(frozen=True, slots=True)
class CommandSource:
    """What a command's behaviour was built from besides its text (`BuildContext`), for a replay."""

    attachment: str
    footprint: Footprint | None
    class_names: tuple[str, ...] | None


@dataclass(frozen=True, slots=True)
class CommandInput:
    """An operator's command. It is answered once, by a `CommandResult` with the same identifier.

    Attributes:
        text: the command as written, for messages.
        behaviour: what to fly; None: the command only points the gimbal.
        aim: where to point the gimbal; None for a behaviour.
        endless: the command does not end by itself, so it is answered when the vehicle flies it.
        mode_changes: `GuidanceInput.mode_changes` when the command was given; None: not known. A later
            change of mode or arming supersedes the command.
        source: None where the behaviour was not built from a text.
        received_ns: when it was given; None: in the step that takes it.
    """

    identifier: int
    text: str
    behaviour: Behaviour | None = None
    aim: GimbalGoal | None = None
    endless: bool = False
    mode_changes: int | None = None
    source: CommandSource | None = None
    received_ns: int | None = None

    def __post_init__(self) -> None:
        if (self.behaviour is None) == (self.aim is None):
            raise ValueError(f"{self.text}: expected exactly one of behaviour and aim")


@dataclass(frozen=True, slots=True)
class CommandResult:
    """The result of a command: ended, refused, or in progress (an endless one); in `endings` how it ended."""

    identifier: int
    outcome: Outcome


@dataclass(frozen=True, slots=True)
class StreamStatus:
    """The streamer's state and the number of setpoints sent."""

    state: StreamState = StreamState.SILENT
    sent_count: int = 0


class EventKind(StrEnum):
    """Kinds of events of behaviours and the gimbal."""

    STARTED = "started"
    ENGAGED = "engaged"  # the vehicle shows OFFBOARD and flies our setpoints
    NOTED = "noted"  # a note for people
    ENDED = "ended"
    REFUSED = "refused"
    LOST = "lost"  # command was lost
    BLIND = "blind"  # braking: no depth
    BATTERY = "battery"  # low battery, or its state is unknown
    GIMBAL = "gimbal"


@dataclass(frozen=True, slots=True)
class GuidanceEvent:
    """One event for the log.

    Attributes:
        behaviour: its word; empty where no behaviour is concerned.
        outcome: set when a behaviour ended or was refused.
    """

    stamp_ns: int
    kind: EventKind
    behaviour: str
    message: str
    outcome: Outcome | None = None
    level: Literal["info", "warning"] = "info"


@dataclass(frozen=True, slots=True)
class ChangedLimits:
    """The limits that can be changed while the service runs, as of `guidance.limits.envelope.Limits`."""

    max_horizontal_speed_mps: float
    max_climb_mps: float
    max_descend_mps: float
    min_altitude_m: float
    max_altitude_m: float
    max_distance_m: float


@dataclass(frozen=True, slots=True)
class GuidanceInput:
    """The input of one guidance step. Stamps are CLOCK_MONOTONIC nanoseconds.

    Attributes:
        state: the vehicle.
        stream: the setpoint stream of the previous steps.
        targets: from the steering camera's newest frame, local NED.
        seen_ns: capture stamp of that frame; None: none received yet.
        obstacles: from the newest depth image, of any age; None: none received.
        planned: the newest path around obstacles, of any age; None: none received.
        markers: detected markers of cameras that look down, or why there can be none.
        steering_markers: the same of the steering camera.
        neighbourhood: the other vehicles; None: poses are not shared.
        ranging: which means of range estimation are available.
        class_names: the detector's classes; None: not known, so not checked.
        mode_changes: how often the reported number of the mode, or armed, changed since the link opened,
            including a change that was reverted between two steps.
        answers: to requests of earlier steps. commands: the new ones, oldest first.
        ending: the service ends: no command begins, and control is released.
        velocities: the newest message of each sender on the topic `velocity`, the first sender first.
        camera_fault: why nothing that the steering camera shows is used, in words; empty: it is.
        parameters: what was read from the autopilot when the link opened or returned.
        standstill: of the computer or the process, since the previous step; None: none.
        objects: of the steering camera, as of its newest frame. marker_objects: its markers in the same form.
        objects_below: the markers of cameras that look down.
        limits: as they are now; None: as in the options, never changed.
    """

    state: VehicleState
    stream: StreamStatus = StreamStatus()
    targets: tuple[Target, ...] = ()
    seen_ns: int | None = None
    obstacles: ObstacleSectors | None = None
    planned: PlannedPath | None = None
    markers: MarkerSight = NO_MARKERS
    neighbourhood: Neighbourhood | None = None
    ranging: RangeMeans = ALL_MEANS
    class_names: tuple[str, ...] | None = None
    mode_changes: int = 0
    answers: tuple[Answer, ...] = ()
    # A behaviour has no encoding: commands are recorded by what they were built from (`CommandSource`).
    commands: tuple[CommandInput, ...] = field(default=(), metadata={"recorded": False})
    ending: bool = False
    steering_markers: MarkerSight = NO_MARKERS
    velocities: tuple[VelocityInput, ...] = ()
    parameters: AutopilotParameters = NOTHING_READ
    standstill: Standstill | None = None
    camera_fault: str = ""
    objects: tuple[TrackedObject, ...] = ()
    marker_objects: tuple[TrackedObject, ...] = ()
    objects_below: tuple[TrackedObject, ...] = ()
    limits: ChangedLimits | None = field(default=None, metadata={"recorded": "if set"})


@dataclass(frozen=True, slots=True)
class GuidanceOutput:
    """The output of one guidance step.

    Attributes:
        setpoint: to stream from now on, a brake included; None: stop streaming.
        requests: new ones. cancelled: identifiers of abandoned requests.
        landing_target: for the autopilot, once per frame that shows one.
        path_request: what path to plan around obstacles; None: none is needed.
        obstacle_distance: for the autopilot's collision prevention, 10 times a second; never stale.
        results: the answers of commands, one each. endings: of commands that have ended or were refused, also
            of those that were answered when they began; a command has one. Not recorded: the topic
            `command_state` is.
        released: after `ending`: no request is pending and no control is held.
    """

    setpoint: Setpoint | None
    requests: tuple[Request, ...] = ()
    cancelled: tuple[int, ...] = ()
    landing_target: LandingTarget | None = None
    obstacle_distance: ObstacleSectors | None = None
    path_request: PathRequest | None = None
    events: tuple[GuidanceEvent, ...] = ()
    results: tuple[CommandResult, ...] = ()
    released: bool = False
    endings: tuple[CommandResult, ...] = field(default=(), metadata={"recorded": False})


@dataclass(slots=True)
class OutputCollector:
    """Collects the output of one step. Request identifiers continue from step to step."""

    now_ns: int = 0
    requests: list[Request] = field(default_factory=list)
    cancelled: list[int] = field(default_factory=list)
    events: list[GuidanceEvent] = field(default_factory=list)
    results: list[CommandResult] = field(default_factory=list)
    endings: list[CommandResult] = field(default_factory=list)
    _identifier: int = 0

    def request(self, action: Action, commanded_ns: int | None = None) -> int:
        """Add a request; returns its identifier.

        Args:
            commanded_ns: reception of the command that directly causes it; None: guidance's own decision.
        """
        until_ns = self.now_ns + round(REQUEST_VALID_S * 1e9)
        if commanded_ns is not None:
            until_ns = min(until_ns, commanded_ns + round(COMMAND_VALID_S * 1e9))
        self._identifier += 1
        self.requests.append(Request(self._identifier, action, until_ns))
        return self._identifier

    def cancel(self, identifier: int) -> None:
        """Abandon a request; one added in this step is removed."""
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
        """Add an event."""
        level: Literal["info", "warning"] = "warning" if warning else "info"
        self.events.append(GuidanceEvent(self.now_ns, kind, behaviour, message, outcome, level))

    def in_progress(self, identifier: int, outcome: Outcome) -> None:
        """Answer a command that goes on."""
        self.results.append(CommandResult(identifier, outcome))

    def ended(self, identifier: int, outcome: Outcome, *, answered: bool = False) -> None:
        """A command has ended or is refused; answer it, unless it was answered when it began."""
        self.endings.append(CommandResult(identifier, outcome))
        if not answered:
            self.results.append(CommandResult(identifier, outcome))
