"""Landing on a target that LANDING_TARGET reports: PX4's precision landing (PLD_*).

Start → horizontal approach → descend above the target → final approach; when the target is lost high above
ground it returns to the start, climbs to PLD_SRCH_ALT and searches, and finally lands at its position.
"""

from __future__ import annotations

import enum
import math
from collections.abc import Callable
from dataclasses import dataclass

from mavlink_sim.flight import tasks as flight
from mavlink_sim.flight.position_control import TrajectorySetpoint
from mavlink_sim.physics.airframe import Multirotor
from mavlink_sim.physics.rotations import Vector
from mavlink_sim.px4.parameters import Parameters

SETTLE_S = 2.0  # above the start point or the target, before going on
SEARCH_SETTLE_S = 1.0
CLIMB_ON_M = 1.0  # how far a climb continues after the target came in sight
LOW_TIMEOUT_S = 0.5  # close to the ground a target times out sooner


@dataclass(frozen=True, slots=True)
class LandingTarget:
    """The newest LANDING_TARGET: local NED metres, and its time of arrival, seconds since boot."""

    position: Vector
    stamp_s: float


class Precision(enum.IntEnum):
    """PRECISION_LAND_MODE: parameter 2 of NAV_LAND, RTL_PLD_MD."""

    DISABLED = 0
    OPPORTUNISTIC = 1
    REQUIRED = 2


class Phase(enum.Enum):
    """PX4's states of a precision landing."""

    START = "start"
    APPROACH = "horizontal approach"
    DESCEND = "descend"
    FINAL = "final approach"
    SEARCH = "search"
    FALLBACK = "fallback"


class PrecisionLanding(flight.TrajectoryTask):
    """Land on the target.

    Args:
        point: where to search for the target first; the altitude to start from.
        newest: gives the newest target, None before the first.
        now_s: gives the time since boot.

    Attributes:
        phase: the current state. landing: on the descent.
    """

    def __init__(
        self,
        airframe: Multirotor,
        parameters: Parameters,
        precision: Precision,
        newest: Callable[[], LandingTarget | None],
        now_s: Callable[[], float],
        point: Vector | None = None,
        on_phase: Callable[[str], None] | None = None,
    ) -> None:
        super().__init__(airframe, parameters)
        self._precision = precision
        self._newest = newest
        self._now_s = now_s
        self._on_phase = on_phase
        self.goal: Vector = self._trajectory.stopping_point() if point is None else point
        self._land: flight.Land | None = None
        self._seen: LandingTarget | None = None
        self._is_new = False
        self._searches = 0
        self._arrived_s: float | None = None
        self._acquired_s: float | None = None
        self._phase_since_s = 0.0
        self.phase = Phase.START
        self._searches += 1

    # ---- one step ---------------------------------------------------------------------------------------

    def update(self, dt_s: float) -> TrajectorySetpoint:
        newest = self._newest()
        self._is_new = newest is not None and newest is not self._seen
        self._seen = newest
        _STEPS[self.phase](self)
        if self._land is not None:
            self.landing = True
            return self._land.update(dt_s)
        self.landing = False
        return self._trajectory.towards(self.goal, dt_s)

    def _start(self) -> None:
        if self._can_approach():
            self._approach_target()
        elif self._precision is Precision.OPPORTUNISTIC:
            self._fall_back()
        elif math.dist(self.goal[:2], self._airframe.position[:2]) < self._parameters.number("NAV_ACC_RAD"):
            if not self._parameters.number("PLD_SRCH_TOUT") > 0.0:
                self._fall_back()
            elif self._waited(SETTLE_S):
                self._search()

    def _approach(self) -> None:
        target = self._target()
        if self._within_acceptance(target) and not self._target_is_fresh():
            self._lost()
            return
        if self._is_new and self._within_acceptance(target) and self._waited(SETTLE_S):
            self._enter(Phase.DESCEND)
            self._land_at(target.position)
            return
        self.goal = (target.position[0], target.position[1], self.goal[2])

    def _descend(self) -> None:
        target = self._target()
        low = self._can_finish()
        if (self._age_s() < LOW_TIMEOUT_S) if low else self._target_is_fresh():
            self._land_at(target.position)
        elif low:
            self._enter(Phase.FINAL)
        else:
            self._lost()

    def _final(self) -> None:
        """Descend to the ground at the current position."""

    def _searching(self) -> None:
        now = self._now_s()
        if self._acquired_s is None and self._can_approach():
            self._acquired_s = now
            # NED: the higher of two altitudes has the smaller z
            self.goal = (
                self.goal[0],
                self.goal[1],
                max(self._airframe.position[2] - CLIMB_ON_M, self.goal[2]),
            )
        if self._acquired_s is not None and now - self._acquired_s > SEARCH_SETTLE_S and self._can_approach():
            self._approach_target()
        elif now - self._phase_since_s > self._parameters.number("PLD_SRCH_TOUT"):
            self._fall_back()

    # ---- transitions ------------------------------------------------------------------------------------

    def _enter(self, phase: Phase) -> None:
        self.phase = phase
        self._phase_since_s = self._now_s()
        self._arrived_s = None
        if self._on_phase is not None:
            self._on_phase(f"precision landing: {phase.value}")

    def _approach_target(self) -> None:
        self._enter(Phase.APPROACH)
        self.goal = (self.goal[0], self.goal[1], self._airframe.position[2])

    def _lost(self) -> None:
        """Hold here and restart, as often as PLD_MAX_SRCH allows."""
        self._resume_flight(self._airframe.position)
        if self._searches <= self._parameters.number("PLD_MAX_SRCH"):
            self._searches += 1
            self._enter(Phase.START)
        else:
            self._fall_back()

    def _search(self) -> None:
        self._acquired_s = None
        self._resume_flight((self.goal[0], self.goal[1], -self._parameters.number("PLD_SRCH_ALT")))
        self._enter(Phase.SEARCH)

    def _fall_back(self) -> None:
        self._enter(Phase.FALLBACK)
        self._land = flight.Land(self._airframe, self._parameters)
        self.goal = self._land.goal or self.goal

    def _land_at(self, point: Vector) -> None:
        if self._land is None:
            self._land = flight.Land(self._airframe, self._parameters, point)
        self._land.goal = self.goal = point

    def _resume_flight(self, goal: Vector) -> None:
        if self._land is not None:
            self._land = None
            self._trajectory = flight.Trajectory(self._airframe, self._parameters)
        self.goal = goal

    # ---- conditions -------------------------------------------------------------------------------------

    def _target(self) -> LandingTarget:
        assert self._seen is not None  # these phases begin with a target
        return self._seen

    def _age_s(self) -> float:
        return math.inf if self._seen is None else self._now_s() - self._seen.stamp_s

    def _target_is_fresh(self) -> bool:
        return self._age_s() <= self._parameters.number("PLD_BTOUT")

    def _can_approach(self) -> bool:
        """The target is in sight now."""
        return self._is_new and self._target_is_fresh()

    def _can_finish(self) -> bool:
        """Low enough above a recently seen target to continue without it."""
        height = self._target().position[2] - self._airframe.position[2]
        return self._target_is_fresh() and height < self._parameters.number("PLD_FAPPR_ALT")

    def _within_acceptance(self, target: LandingTarget) -> bool:
        radius = self._parameters.number("PLD_HACC_RAD")
        return all(abs(target.position[axis] - self._airframe.position[axis]) < radius for axis in (0, 1))

    def _waited(self, seconds: float) -> bool:
        """Whether the first call in this phase was longer ago than that."""
        if self._arrived_s is None:
            self._arrived_s = self._now_s()
        return self._now_s() - self._arrived_s > seconds


_STEPS: dict[Phase, Callable[[PrecisionLanding], None]] = {
    Phase.START: PrecisionLanding._start,
    Phase.APPROACH: PrecisionLanding._approach,
    Phase.DESCEND: PrecisionLanding._descend,
    Phase.FINAL: PrecisionLanding._final,
    Phase.SEARCH: PrecisionLanding._searching,
    Phase.FALLBACK: PrecisionLanding._final,
}
