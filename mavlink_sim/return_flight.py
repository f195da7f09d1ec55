"""Where RTL leads (RTL_TYPE) and how it lands there (RTL_PLD_MD)."""

from __future__ import annotations

import enum
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from mavlink_sim import flight, mission_items
from mavlink_sim.mission_items import MissionItem
from mavlink_sim.mission_plan import Mission
from mavlink_sim.parameters import Parameters
from mavlink_sim.physics import Multirotor, Vector
from mavlink_sim.precision_landing import Precision

if TYPE_CHECKING:
    from mavlink_sim.navigator import Navigator

# A rally point this close to home is no alternative to it (MAX_DIST_FROM_HOME_FOR_LAND_APPROACHES).
TOO_CLOSE_TO_HOME_M = 10.0
# Another destination must be that much nearer to be worth it (MIN_DIST_THRESHOLD).
WORTH_M = 2.0
USABLE_FRAMES = frozenset({mission_items.GLOBAL, mission_items.GLOBAL_RELATIVE_ALT})


class Goal(enum.Enum):
    """What kind of place RTL leads to."""

    HOME = "home"
    RALLY = "rally point"
    MISSION_LANDING = "mission landing"
    HERE = "here"


@dataclass(frozen=True, slots=True)
class Destination:
    """Local NED metres of the place to land at."""

    kind: Goal
    position: Vector


def destination(
    rally: tuple[MissionItem, ...],
    mission: Mission,
    parameters: Parameters,
    home: Vector,
    position: Vector,
) -> tuple[Destination, list[str]]:
    """The nearest place that RTL_TYPE allows, and what PX4 complains of on the way.

    0: home or a rally point. 1: a rally point or the mission's landing. 3: any of the three. 5: rally points
    alone, without one here. A multirotor with RTL_TYPE 2 or 4 follows its mission (see `follows_mission`).
    """
    kind = int(parameters.number("RTL_TYPE"))
    best, nearest = Destination(Goal.HOME, home), math.inf
    if kind not in (1, 5):
        nearest = math.dist(home[:2], position[:2])
    landing = mission.landing() if mission.valid else None
    if landing is not None and kind in (1, 3):
        place = mission.items[landing].place(home)
        away = math.dist(place[:2], position[:2])
        if away + WORTH_M < nearest:
            best, nearest = Destination(Goal.MISSION_LANDING, place), away
    complaints = []
    for item in rally:
        if item.command != mission_items.RALLY_POINT:
            continue
        if item.frame not in USABLE_FRAMES:
            complaints.append("RTL: unsupported MAV_FRAME\t")
            continue
        place = item.place(home)
        if kind != 5 and math.dist(place[:2], home[:2]) <= TOO_CLOSE_TO_HOME_M:
            continue
        away = math.dist(place[:2], position[:2])
        if away + WORTH_M < nearest:
            best, nearest = Destination(Goal.RALLY, place), away
    if kind == 5 and best.kind is not Goal.RALLY:
        best = Destination(Goal.HERE, position)
    return best, complaints


class ReturnFlight(flight.Return):
    """RTL to a destination; `make_landing` gives the task of the final descent, None for a plain landing."""

    def __init__(
        self,
        airframe: Multirotor,
        parameters: Parameters,
        place: Vector,
        make_landing: Callable[[Vector], flight.TrajectoryTask] | None,
    ) -> None:
        super().__init__(airframe, parameters, place)
        self._make_landing = make_landing
        self.destination = place

    def landing_task(self, place: Vector) -> flight.TrajectoryTask:
        """The descent at a place."""
        return super().landing_task(place) if self._make_landing is None else self._make_landing(place)


def return_task(
    navigator: Navigator, airframe: Multirotor, parameters: Parameters, found: Destination
) -> ReturnFlight:
    """The task of RTL to a destination."""
    mode = int(parameters.number("RTL_PLD_MD"))
    make: Callable[[Vector], flight.TrajectoryTask] | None = None
    if mode in (Precision.OPPORTUNISTIC, Precision.REQUIRED):

        def make(place: Vector) -> flight.TrajectoryTask:
            here = airframe.position
            return navigator.precision_landing(Precision(mode), (place[0], place[1], here[2]))

    return ReturnFlight(airframe, parameters, found.position, make)
