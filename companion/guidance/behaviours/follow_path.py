"""Follow path: fly along a list of points, once or repeatedly, slowing down for corners."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, ClassVar

from companion.geometry.points import points_from
from companion.guidance.behaviour import Behaviour, BehaviourContext
from companion.guidance.behaviours.path_flight import PathFlight
from companion.guidance.command import (
    BuildContext,
    Command,
    EnumArgument,
    GrammarError,
    Number,
    Points,
    behaviour,
)
from companion.guidance.motion import home_of, laps_text, position_and_yaw
from companion.vehicle.state import Vector3


@behaviour("follow-path", "fly along a list of points, slowing down for corners")
class FollowPath(Command):
    renamed: ClassVar[Mapping[str, str]] = {"nose": "yaw_mode"}
    endless_without = "laps"
    points: Annotated[
        str, Points("points", 'north,east or north,east,height, metres from home: "0,0 10,0,5 10,10"')
    ]
    speed_mps: Annotated[float, Number("speed", "m/s", 0.2, 20.0, "maximum speed")] = 3.0
    laps: Annotated[float, Number("laps", "", 0.0, 1000.0, "how many; 0: until another command")] = 1.0
    yaw_mode: Annotated[
        str, EnumArgument("yaw_mode", ("path", "hold"), "yaw: along the path, or unchanged")
    ] = "path"

    def __post_init__(self) -> None:
        super().__post_init__()
        if 0.0 < self.laps < 1.0:
            raise GrammarError(f"follow-path: laps must be 0, or 1 or more, got {self.laps:g}")

    def build(self, context: BuildContext) -> Behaviour:
        along = self.yaw_mode == "path"
        return FollowPathBehaviour(points_from(self.points), self.speed_mps, laps=self.laps, nose_along=along)


class FollowPathBehaviour(PathFlight):
    """Flies from the current position to the first point, and along the others.

    Args:
        points: (north, east) or (north, east, height) metres from home; the default height is the previous.
        laps: 0: until another command; other than 1: a closed path, from the last point to the first.
        round_trip: a closed path also for a single lap.
    """

    name = "follow-path"

    def __init__(
        self,
        points: Sequence[tuple[float, ...]],
        speed_mps: float,
        *,
        laps: float = 1.0,
        nose_along: bool = True,
        round_trip: bool = False,
    ) -> None:
        super().__init__(speed_mps, closed=round_trip or laps != 1.0, laps=laps, nose_along=nose_along)
        self._from_home = tuple(points)

    def _points(self, context: BehaviourContext) -> list[Vector3]:
        position, _ = position_and_yaw(context.state)
        home = home_of(context.state)
        down, points = position[2], list[Vector3]()
        for north, east, *height in self._from_home:
            down = home[2] - height[0] if height else down
            points.append((home[0] + north, home[1] + east, down))
        return points

    def _success_text(self) -> str:
        if not self._closed:
            return f"all {len(self._from_home)} points flown"
        return f"{laps_text(self._laps)} of {len(self._from_home)} points flown"
