"""The contract of a behaviour: what it needs, and four hooks. A behaviour never touches the link."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum

from companion.guidance.formation.neighbours import Neighbour, Neighbourhood
from companion.guidance.gimbal_status import NO_GIMBAL, GimbalStatus
from companion.guidance.targets.from_markers import NO_MARKERS, MarkerSight
from companion.guidance.targets.ranging import ALL_MEANS, RangeMeans
from companion.guidance.targets.target import Target
from companion.vehicle.gimbal import GimbalAim
from companion.vehicle.landing_target import LandingTarget
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, Vector3, VehicleState
from vision.obstacle_sectors import ObstacleSectors


class Requirement(StrEnum):
    """What a behaviour cannot do without. A missing one is a refusal that names it."""

    POSITION = "position"  # fresh and valid local position and attitude
    IN_AIR = "in_air"
    ON_GROUND = "on_ground"
    PERCEPTION = "perception"  # a perception worker that delivers
    BATTERY = "battery"  # more charge than guidance.min_battery_percent
    DEPTH_OR_SIZE = "depth_or_size"  # a range: depth, the ground in the picture, or classes of known height
    MARKER = "marker"  # perception that looks for markers
    GIMBAL = "gimbal"  # one that answers
    NEIGHBOURS = "neighbours"  # other vehicles whose poses are fresh


@dataclass(frozen=True, slots=True)
class BehaviourContext:
    """Everything a behaviour may look at in one update.

    Attributes:
        now_ns: CLOCK_MONOTONIC nanoseconds.
        state: the vehicle.
        targets: what is seen now, in the level world frame; empty when nothing is or when it is too old.
        perception_age_s: age of the newest detection message by its capture stamp; None: none ever came.
        perception_fresh: that age is within the declared maximum.
        obstacles: what the newest depth image says, however old; None: none came.
        sent: what the envelope let through of the last setpoint; None before the first.
        neighbourhood: the other vehicles; None: nobody listens for them.
        min_separation_m: what is kept to each of them.
        markers: what is seen of markers, or why none can be.
        gimbal: how the gimbal stands to what flies; where it looks is in `state`.
        ranging: what there is to tell how far away something is.
        max_acceleration_mps2: the envelope's.
        goal_ned_m: `Outcome.goal_ned_m` of the behaviour that ended just before; None: it had none.
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

    def why_blind(self, usually: str) -> str:
        """Why nothing that is seen can be steered by, in words; `usually` where it is not the gimbal."""
        why = self.gimbal.undirected
        return f"where the camera looks is not known ({why})" if why else usually

    @property
    def neighbours(self) -> tuple[Neighbour, ...]:
        """The other vehicles that are known and placed."""
        return () if self.neighbourhood is None else self.neighbourhood.vehicles


@dataclass(frozen=True, slots=True)
class Outcome:
    """A behaviour has ended.

    Attributes:
        success: it did what was asked. reason: how it ended, for people.
        goal_ned_m: where the vehicle is to stand now, local NED metres; None: where it comes to rest.
    """

    success: bool
    reason: str
    goal_ned_m: Vector3 | None = None


@dataclass(frozen=True, slots=True)
class ModeRequest:
    """Let the autopilot fly one of its own modes (take-off, land, return, hold) until further notice.

    `altitude_m` is for FlightMode.TAKEOFF: height above home. `arm` asks to arm first (only take-off does).
    """

    mode: FlightMode
    altitude_m: float | None = None
    arm: bool = False

    def __post_init__(self) -> None:
        if self.mode is FlightMode.TAKEOFF and self.altitude_m is None:
            raise ValueError("a take-off needs an altitude")


# What an update may answer: a setpoint to fly, a mode of the autopilot's own, or the end.
BehaviourOutput = Setpoint | ModeRequest | Outcome


class Behaviour(ABC):
    """One way of flying. `name` is its word in the command grammar."""

    name: str
    requirements: frozenset[Requirement] = frozenset()
    # Classes that perception must know for this behaviour to make sense.
    class_names: tuple[str, ...] = ()
    # Vehicles whose poses must be fresh, where it requires NEIGHBOURS.
    neighbour_names: tuple[str, ...] = ()
    # Above the horizon, radians; what the gimbal must reach, where it requires GIMBAL.
    gimbal_pitches_rad: tuple[float, ...] = ()

    def goals(self, context: BehaviourContext) -> tuple[Vector3, ...]:
        """Where it would fly to if it began now, local NED metres, as far as that is known before."""
        return ()

    def on_activate(self, context: BehaviourContext) -> None:  # noqa: B027  (a hook that may be left out)
        """Called once, before the first update."""

    @abstractmethod
    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        """Called at the guidance rate. `dt_s` is the time since the last update (0 at the first)."""

    def on_deactivate(self) -> None:  # noqa: B027  (a hook that may be left out)
        """Called once, when it ended or was replaced."""

    def request_failed(self, why: str) -> bool:
        """The autopilot did not do what was asked. True: another way is known; False: that is the end."""
        return False

    def take_notes(self) -> Sequence[str]:
        """What happened that people should know, since it was last asked for."""
        return ()

    @property
    def active(self) -> Behaviour:
        """What flies now: itself, or of several in turn the one whose turn it is."""
        return self

    @property
    def landing_target(self) -> LandingTarget | None:
        """What the autopilot is to be told of a target that it lands on by itself; None: nothing."""
        return None

    @property
    def gimbal_aim(self) -> GimbalAim | None:
        """Where the gimbal is to look now; None: it is nothing to this behaviour, or no more."""
        return None

    @property
    def landing(self) -> bool:
        """Whether it comes down to the ground on purpose: the lowest altitude does not hold then."""
        return False

    @property
    def status(self) -> str:
        """A few words on what it is doing now, for people."""
        return self.name
