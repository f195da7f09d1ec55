"""The behaviour interface: requirements and four hooks. A behaviour never accesses the link."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum

from companion.guidance.formation.neighbours import Neighbour, Neighbourhood
from companion.guidance.formation.pose import FormationNote
from companion.guidance.objects.closing_check import Approached
from companion.guidance.objects.from_markers import NO_MARKERS, MarkerSight
from companion.guidance.objects.in_view import ObjectsInView
from companion.guidance.objects.ranging import ALL_MEANS, RangeMeans
from companion.guidance.objects.target import Target
from companion.guidance.objects.tracked_object import Subject
from companion.vehicle.autopilot_parameters import NOTHING_READ, AutopilotParameters
from companion.vehicle.gimbal import GimbalAim
from companion.vehicle.landing_target import LandingTarget
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, Vector3, VehicleState
from vision.obstacle_sectors import ObstacleSectors
from vision.path_planner import PlannedPath


class Requirement(StrEnum):
    """What a behaviour needs to begin. A missing requirement is named in the reply.

    >>> from companion import Requirement
    >>> Requirement("in_air") is Requirement.IN_AIR
    True
    """

    POSITION = "position"  # fresh and valid local position and attitude
    IN_AIR = "in_air"
    ON_GROUND = "on_ground"
    PERCEPTION = "perception"  # a perception worker that delivers frames
    BATTERY = "battery"  # more charge than guidance.min_battery_percent
    DEPTH_OR_SIZE = "depth_or_size"  # a range: depth, the ground in the image, or classes of known height
    MARKER = "marker"  # marker detection with a camera that looks down
    STEERING_MARKER = "steering_marker"  # marker detection with the steering camera
    GIMBAL = "gimbal"  # a gimbal manager that responds
    NEIGHBOURS = "neighbours"  # fresh poses of other vehicles
    HOME = "home"  # home's altitude, if the autopilot's take-off needs it


# Requirements that change in the course of a mission: checked when their step begins.
OF_THE_MOMENT = frozenset({Requirement.IN_AIR, Requirement.ON_GROUND})


@dataclass(frozen=True, slots=True)
class GimbalStatus:
    """Control and mounting of the gimbal.

    Attributes:
        carries_camera: the steering camera is mounted on it.
        direction_fault: why that camera's direction is unknown; empty: it is known, or it has no gimbal.
        controlled_by: another owner of primary control, which is not displaced; empty: none.
        problem: why the gimbal is not moved any more for the active behaviour; empty: it is.
        camera_pitch_rad: pitch of that camera above the gimbal's axis; 0 if it is not on the gimbal.
    """

    carries_camera: bool = False
    direction_fault: str = ""
    controlled_by: str = ""
    problem: str = ""
    camera_pitch_rad: float = 0.0


NO_GIMBAL = GimbalStatus()


@dataclass(frozen=True, slots=True)
class VelocityInput:
    """The newest message of one sender on the topic `velocity`. Stamps are CLOCK_MONOTONIC nanoseconds.

    Attributes:
        source: identifier of the sender.
        forward_mps, right_mps: horizontally, along and across the heading. up_mps: vertically.
        turn_radps: clockwise seen from above.
        expires_ns: it must not be used after that.
    """

    source: str
    received_ns: int
    expires_ns: int
    forward_mps: float = 0.0
    right_mps: float = 0.0
    up_mps: float = 0.0
    turn_radps: float = 0.0


@dataclass(frozen=True, slots=True)
class BehaviourContext:
    """The input of one update of a behaviour.

    Attributes:
        now_ns: CLOCK_MONOTONIC nanoseconds.
        state: the vehicle.
        targets: of the newest frame, in the level world frame; empty: none, or the frame is too old.
        perception_age_s: age of the newest detection message by its capture stamp; None: none received.
        perception_fresh: that age is within the configured maximum.
        obstacles: from the newest depth image, of any age; None: none received.
        planned: the newest path around obstacles, of any age; None: none received.
        avoiding: paths around obstacles are flown (`guidance.avoid`): return `RoutedSetpoint`.
        sent: the last setpoint after the envelope; None before the first.
        held_at_height: a limit of height acted on it.
        neighbourhood: the other vehicles; None: poses are not shared.
        min_separation_m: minimum distance to each of them.
        markers: detected markers of cameras that look down, or why there can be none.
        steering_markers: the same of the steering camera.
        gimbal: control and mounting of the gimbal; its attitude is in `state`.
        ranging: which means of range estimation are available.
        max_acceleration_mps2: the envelope's limit.
        goal_ned_m: `Outcome.goal_ned_m` of the previous behaviour; None: it had none.
        velocities: the newest message of each sender on the topic `velocity`, the first sender first.
        camera_fault: why nothing that the steering camera shows is used; empty: it is.
        parameters: of the autopilot.
        objects: what the steering camera shows and has shown, and which object a command means.
        below: the same of the markers of cameras that look down.

    >>> from companion import BehaviourContext
    >>> from companion.vehicle.state import VehicleState
    >>> context = BehaviourContext(now_ns=0, state=VehicleState(position_ned_m=(1.0, 2.0, -5.0)))
    >>> context.state.position_ned_m, context.targets, context.perception_fresh
    ((1.0, 2.0, -5.0), (), False)
    """

    now_ns: int
    state: VehicleState
    targets: tuple[Target, ...] = ()
    perception_age_s: float | None = None
    perception_fresh: bool = False
    obstacles: ObstacleSectors | None = None
    sent: Setpoint | None = None
    markers: MarkerSight = NO_MARKERS
    neighbourhood: Neighbourhood | None = None
    min_separation_m: float = 3.0
    gimbal: GimbalStatus = NO_GIMBAL
    ranging: RangeMeans = ALL_MEANS
    max_acceleration_mps2: float = 3.0
    goal_ned_m: Vector3 | None = None
    steering_markers: MarkerSight = NO_MARKERS
    planned: PlannedPath | None = None
    avoiding: bool = False
    velocities: tuple[VelocityInput, ...] = ()
    camera_fault: str = ""
    parameters: AutopilotParameters = NOTHING_READ
    objects: ObjectsInView = field(default_factory=ObjectsInView)
    below: ObjectsInView = field(default_factory=ObjectsInView)
    held_at_height: bool = False

    def perception_fault(self, default: str) -> str:
        """Why targets cannot be used, in words; `default` where neither gimbal nor camera is the reason."""
        why = self.gimbal.direction_fault
        return f"camera direction unknown ({why})" if why else self.camera_fault or default

    def gimbal_pitch_to(self, elevation_rad: float) -> float:
        """The reachable pitch of the gimbal nearest to an elevation of the steering camera's axis."""
        pitch_rad, gimbal = elevation_rad - self.gimbal.camera_pitch_rad, self.state.gimbal
        return pitch_rad if gimbal is None else gimbal.nearest_pitch_rad(pitch_rad)

    @property
    def neighbours(self) -> tuple[Neighbour, ...]:
        """The other vehicles with a known position."""
        return () if self.neighbourhood is None else self.neighbourhood.vehicles


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a behaviour ended.

    Attributes:
        success: the command was carried out. reason: how it ended, for people.
        goal_ned_m: position to hold now, local NED metres; None: where the vehicle comes to rest.

    >>> from companion import Outcome
    >>> Outcome(True, "arrived", goal_ned_m=(10.0, 0.0, -5.0)).success
    True
    """

    success: bool
    reason: str
    goal_ned_m: Vector3 | None = None


@dataclass(frozen=True, slots=True)
class ModeRequest:
    """Request one of the autopilot's own modes (take-off, land, return, hold) until the next output.

    `altitude_m` is for FlightMode.TAKEOFF: height above home. `arm`: arm first, in HOLD. Only TAKEOFF does,
    and HOLD, from which a take-off climbs by setpoints.

    >>> from companion import ModeRequest
    >>> from companion.vehicle.state import FlightMode
    >>> ModeRequest(FlightMode.TAKEOFF, altitude_m=5.0, arm=True).mode.value
    'takeoff'
    """

    mode: FlightMode
    altitude_m: float | None = None
    arm: bool = False

    def __post_init__(self) -> None:
        if self.mode is FlightMode.TAKEOFF and self.altitude_m is None:
            raise ValueError("ModeRequest(TAKEOFF) needs altitude_m")


@dataclass(frozen=True, slots=True)
class RoutedSetpoint:
    """A velocity setpoint along a route, for a path around obstacles near that route.

    Attributes:
        setpoint: what to fly without obstacles; its horizontal speed and vertical velocity are kept. It does
            not contain a correction of the velocity error, which follows for the path that is flown.
        route: the line ahead, local NED, from about the vehicle on; at least one point.
        facing: the yaw stays near the setpoint's (an object in view); False: it follows the path.
    """

    setpoint: Setpoint
    route: tuple[Vector3, ...]
    facing: bool = False


# What an update returns: a setpoint, an autopilot mode, or the end of the behaviour.
BehaviourOutput = Setpoint | RoutedSetpoint | ModeRequest | Outcome


class Behaviour(ABC):
    """Base class of behaviours. `name` is its word in the command grammar.

    >>> from companion import Behaviour, BehaviourContext, Requirement, Setpoint
    >>> from companion.vehicle.state import VehicleState
    >>> class Climb(Behaviour):
    ...     name = "climb"
    ...     requirements = frozenset({Requirement.POSITION, Requirement.IN_AIR})
    ...
    ...     def update(self, dt_s: float, context: BehaviourContext) -> Setpoint:
    ...         return Setpoint.velocity((0.0, 0.0, -1.0), context.now_ns)
    >>> Climb().update(0.05, BehaviourContext(now_ns=0, state=VehicleState())).velocity_ned_mps
    (0.0, 0.0, -1.0)
    """

    name: str
    requirements: frozenset[Requirement] = frozenset()
    # The object that it flies to, if it is about one: that must be visible (`needs`), and a track be there.
    subject: Subject | None = None
    # Further classes that the detector must know.
    class_names: tuple[str, ...] = ()
    # Vehicles whose poses must be fresh, if it requires NEIGHBOURS.
    neighbour_names: tuple[str, ...] = ()
    # Pitches that the gimbal must reach, radians above the horizon, if it requires GIMBAL.
    gimbal_pitches_rad: tuple[float, ...] = ()
    # Its part in a formation, published with the vehicle's pose.
    note: FormationNote | None = None
    # Behaviours that it begins later. What they need is checked before it begins, except `OF_THE_MOMENT`.
    later: Sequence[Behaviour] = ()
    # Replaced, never extended: a subclass need not call an `__init__`.
    _new_notes: Sequence[str] = ()

    @property
    def needs(self) -> frozenset[Requirement]:
        """`requirements`, and those of seeing the subject."""
        if self.subject is None:
            return self.requirements
        if self.subject.marker_id is not None:
            return self.requirements | {Requirement.STEERING_MARKER}
        return self.requirements | {Requirement.PERCEPTION, Requirement.DEPTH_OR_SIZE}

    def goals(self, context: BehaviourContext) -> tuple[Vector3, ...]:
        """Points it would fly to if it began now, local NED metres, as far as they are known.

        For one of `later` the horizontal position is NaN, and a point with a NaN is not checked. Raises
        ValueError with the reason if they cannot be known now; only one of `later` may begin then.
        """
        return ()

    def blocked_by(self, active: Behaviour, context: BehaviourContext) -> str | None:
        """Why it must not replace the active behaviour now, in words; None: it may."""
        return None

    def on_activate(self, context: BehaviourContext) -> None:  # noqa: B027  (an optional hook)
        """Called once, before the first update."""

    @abstractmethod
    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        """Called at the guidance rate. `dt_s` is the time since the last update (0 at the first)."""

    def on_deactivate(self) -> None:  # noqa: B027  (an optional hook)
        """Called once, when the behaviour has ended or was replaced."""

    def request_failed(self, why: str) -> bool:
        """A mode request was refused. True: the behaviour goes on without it; False: it ends."""
        return False

    def add_notes(self, *texts: str) -> None:
        """Add notes for people: each becomes an event."""
        self._new_notes = [*self._new_notes, *texts]

    def take_notes(self) -> Sequence[str]:
        """Notes for people since the last call."""
        if not self._new_notes:  # nothing is assigned: the behaviour may be frozen
            return ()
        notes, self._new_notes = self._new_notes, ()
        return notes

    @property
    def active(self) -> Behaviour:
        """The behaviour that is active now: itself, or the current one of a sequence."""
        return self

    @property
    def approached(self) -> Approached | None:
        """The object that it flies to now; None: none. Its distance must fall as the vehicle flies there."""
        return None

    @property
    def landing_target(self) -> LandingTarget | None:
        """The target for the autopilot's own precision landing; None: none."""
        return None

    @property
    def gimbal_aim(self) -> GimbalAim | None:
        """Where to point the gimbal now; None: this behaviour does not use it (any more)."""
        return None

    @property
    def landing(self) -> bool:
        """Whether it descends to the ground on purpose: the minimum altitude does not apply then."""
        return False

    @property
    def status(self) -> str:
        """What it is doing now, in a few words."""
        return self.name
