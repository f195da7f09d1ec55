"""Figure eight: a level lemniscate about the position where it begins."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar

from companion.guidance.behaviour import Behaviour, BehaviourContext
from companion.guidance.behaviours.path_flight import PathFlight
from companion.guidance.command import BuildContext, Command, EnumArgument, Number, behaviour
from companion.guidance.motion import laps_text, position_and_yaw
from companion.vehicle.state import Vector3

_POINTS = 96


@behaviour("figure-eight", "fly a level eight about the current position, first towards the nose")
class FigureEight(Command):
    renamed: ClassVar[Mapping[str, str]] = {"nose": "yaw_mode"}
    endless_without = "laps"
    radius_m: Annotated[float, Number("radius", "m", 3.0, 200.0, "from its centre to either end")] = 10.0
    speed_mps: Annotated[float, Number("speed", "m/s", 0.2, 20.0, "maximum speed; bends are slower")] = 2.0
    laps: Annotated[float, Number("laps", "", 0.0, 1000.0, "how many; 0: until another command")] = 1.0
    yaw_mode: Annotated[
        str, EnumArgument("yaw_mode", ("path", "hold"), "yaw: along the path, or unchanged")
    ] = "path"

    def build(self, context: BuildContext) -> Behaviour:
        along = self.yaw_mode == "path"
        return FigureEightBehaviour(self.radius_m, self.speed_mps, self.laps, nose_along=along)


class FigureEightBehaviour(PathFlight):
    """Bernoulli's lemniscate; starts at its centre towards the nose; each loop extends to `radius_m`."""

    name = "figure-eight"

    def __init__(self, radius_m: float, speed_mps: float, laps: float, *, nose_along: bool = True) -> None:
        super().__init__(speed_mps, closed=True, laps=laps, nose_along=nose_along)
        self._radius_m = radius_m

    def _points(self, context: BehaviourContext) -> list[Vector3]:
        centre, yaw_rad = position_and_yaw(context.state)
        return lemniscate(centre, yaw_rad, self._radius_m)

    def _success_text(self) -> str:
        return f"{laps_text(self._laps)} of the eight flown"


def lemniscate(centre: Vector3, bearing_rad: float, radius_m: float) -> list[Vector3]:
    """Points of one lap of Bernoulli's lemniscate, from its centre.

    Args:
        centre: local NED metres. bearing_rad: of the long axis. radius_m: from the centre to either end.
    """
    points = []
    for step in range(_POINTS):
        angle = math.tau * step / _POINTS + math.pi / 2
        scale = radius_m / (1.0 + math.sin(angle) ** 2)
        along, across = -scale * math.cos(angle), -scale * math.cos(angle) * math.sin(angle)
        north = along * math.cos(bearing_rad) - across * math.sin(bearing_rad)
        east = along * math.sin(bearing_rad) + across * math.cos(bearing_rad)
        points.append((centre[0] + north, centre[1] + east, centre[2]))
    return points
