"""The destination of RTL (RTL_TYPE) and its landing (RTL_PLD_MD)."""

from __future__ import annotations

import enum
import math
from collections.abc import Callable
from dataclasses import dataclass

from mavlink_sim.flight import tasks as flight
from mavlink_sim.flight.position_control import TrajectorySetpoint
from mavlink_sim.missions import items as mission_items
from mavlink_sim.missions.items import MissionItem
from mavlink_sim.missions.plan import Mission
from mavlink_sim.physics.airframe import Multirotor
from mavlink_sim.physics.geography import LocalFrame
from mavlink_sim.physics.rotations import Vector
from mavlink_sim.px4.parameters import Parameters

# A rally point this close to home is no alternative to it (MAX_DIST_FROM_HOME_FOR_LAND_APPROACHES).
TOO_CLOSE_TO_HOME_M = 10.0
# Another destination must be nearer by this (MIN_DIST_THRESHOLD).
WORTH_M = 2.0
USABLE_FRAMES = frozenset({mission_items.GLOBAL, mission_items.GLOBAL_RELATIVE_ALT})


class Goal(enum.Enum):
    """The kind of RTL's destination."""

    HOME = "home"
    RALLY = "rally point"
    MISSION_LANDING = "mission landing"
    HERE = "here"


@dataclass(frozen=True, slots=True)
class Destination:
    """Where to land, local NED metres."""

    kind: Goal
    position: Vector


def destination(
    rally: tuple[MissionItem, ...],
    mission: Mission,
    parameters: Parameters,
    home: Vector,
    frame: LocalFrame,
    position: Vector,
) -> tuple[Destination, list[str]]:
    """The nearest destination that RTL_TYPE allows, and PX4's texts about unusable ones.

    0: home or a rally point. 1: a rally point or the mission's landing. 3: any of the three. 5: rally points
    only, without one the current position. With 2 and 4 the vehicle follows its mission instead (see
    `mission_route`).
    """
    kind = int(parameters.number("RTL_TYPE"))
    best, nearest = Destination(Goal.HOME, home), math.inf
    if kind not in (1, 5):
        nearest = math.dist(home[:2], position[:2])
    landing = mission.landing() if mission.valid else None
    if landing is not None and kind in (1, 3):
        point = mission.items[landing].local_position(home, frame)
        away = math.dist(point[:2], position[:2])
        if away + WORTH_M < nearest:
            best, nearest = Destination(Goal.MISSION_LANDING, point), away
    complaints = []
    for item in rally:
        if item.command != mission_items.RALLY_POINT:
            continue
        if item.frame not in USABLE_FRAMES:
            complaints.append("RTL: unsupported MAV_FRAME\t")
            continue
        point = item.local_position(home, frame)
        if kind != 5 and math.dist(point[:2], home[:2]) <= TOO_CLOSE_TO_HOME_M:
            continue
        away = math.dist(point[:2], position[:2])
        if away + WORTH_M < nearest:
            best, nearest = Destination(Goal.RALLY, point), away
    if kind == 5 and best.kind is not Goal.RALLY:
        best = Destination(Goal.HERE, position)
    return best, complaints


def mission_route(
    mission: Mission, parameters: Parameters, home: Vector, frame: LocalFrame
) -> tuple[list[Vector], Vector] | None:
    """The return along a valid mission (RTL_TYPE 2 and 4) and where it lands; None for the direct return.

    Forward to the mission's landing, without waiting at items; without a landing, or with RTL_TYPE 4 where
    that is nearer, backwards along the flown items to a landing at home.
    """
    kind = int(parameters.number("RTL_TYPE"))
    if kind not in (2, 4) or not mission.valid:
        return None
    start, landing = mission.land_start(), mission.landing()
    if landing is not None and not all(
        map(math.isfinite, mission.items[landing].local_position(home, frame))
    ):
        landing = None
    forward = start is not None and landing is not None and mission.current <= landing
    if forward and start is not None and kind == 4:
        forward = (
            start - mission.current < mission.current
        )  # PX4's measure: remaining items against flown items
    if forward and landing is not None:
        points = _points(mission.items[mission.current : landing], home, frame)
        return points, mission.items[landing].local_position(home, frame)
    return _points(mission.items[: mission.current], home, frame)[::-1], home


def landing_route(mission: Mission, home: Vector, frame: LocalFrame) -> tuple[list[Vector], Vector]:
    """The points of the mission's landing pattern, from DO_LAND_START on, and the landing itself."""
    start, landing = mission.land_start(), mission.landing()
    assert start is not None  # called only for a mission's landing
    assert landing is not None
    return _points(mission.items[start:landing], home, frame), mission.items[landing].local_position(
        home, frame
    )


def _points(items: tuple[MissionItem, ...], home: Vector, frame: LocalFrame) -> list[Vector]:
    """The positions of the items that have one; incomplete ones (NaN) are left out."""
    points = [item.local_position(home, frame) for item in items if item.has_position]
    return [point for point in points if all(map(math.isfinite, point))]


class ReturnFlight(flight.Return):
    """RTL directly to a destination; `make_landing` creates the task of the final descent."""

    def __init__(
        self,
        airframe: Multirotor,
        parameters: Parameters,
        point: Vector,
        yaw_rad: float,
        make_landing: Callable[[Vector, float], flight.TrajectoryTask],
    ) -> None:
        super().__init__(airframe, parameters, point, yaw_rad)
        self._make_landing = make_landing

    def landing_task(self, point: Vector, yaw_rad: float) -> flight.TrajectoryTask:
        """The descent at a point, with a heading; NaN: unchanged."""
        return self._make_landing(point, yaw_rad)


class RouteReturn(flight.TrajectoryTask):
    """RTL along the waypoints of a mission, with a landing at the last one.

    Args:
        points: local NED, in the order of flight. landing: where to land; its height is ignored.
        climb_to_z: NED height to climb to first, and to keep until the first point; None: no climb.
    """

    def __init__(
        self,
        airframe: Multirotor,
        parameters: Parameters,
        points: list[Vector],
        landing: Vector,
        make_landing: Callable[[Vector, float], flight.TrajectoryTask],
        climb_to_z: float | None = None,
    ) -> None:
        super().__init__(airframe, parameters)
        self._make_landing = make_landing
        self._landing = landing
        self._descent: flight.TrajectoryTask | None = None
        x, y, z = self._trajectory.stopping_point()
        self._ahead = [*points, (landing[0], landing[1], math.nan)]
        if climb_to_z is not None:
            z = min(z, climb_to_z)
            first = self._ahead[0]
            self._ahead = [(x, y, z), (first[0], first[1], z), *self._ahead]
        self.goal: Vector = (x, y, z)
        self._next()

    def _next(self) -> None:
        """Set the next point as the goal; one without a height keeps the current height."""
        x, y, z = self._ahead.pop(0)
        self.goal = (x, y, z if math.isfinite(z) else self.goal[2])

    def update(self, dt_s: float) -> TrajectorySetpoint:
        if self._descent is not None:
            self.goal = self._descent.goal or self.goal
            return self._descent.update(dt_s)
        x, y, z = self._airframe.position
        away = math.hypot(self.goal[0] - x, self.goal[1] - y)
        radius = self._parameters.number("NAV_ACC_RAD") if self._ahead else 1.0
        if away < radius and abs(self.goal[2] - z) < self._parameters.number("NAV_MC_ALT_RAD"):
            if self._ahead:
                self._next()
            else:
                self._descent = self._make_landing(self._landing, math.nan)
                self.landing = True
                return self._descent.update(dt_s)
        far = away > self._parameters.number("NAV_ACC_RAD")
        yaw = math.atan2(self.goal[1] - y, self.goal[0] - x) if far else math.nan
        return self._trajectory.towards(self.goal, dt_s, yaw)
