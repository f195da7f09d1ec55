"""Goto: fly straight to a point given from home, from the current position, or by latitude and longitude."""

from __future__ import annotations

import math
from typing import Annotated

from companion.guidance.behaviour import Behaviour, BehaviourContext
from companion.guidance.behaviours.path_flight import PathFlight
from companion.guidance.command import BuildContext, Command, GrammarError, Number, behaviour
from companion.guidance.motion import home_of, local_from_global, position_and_yaw
from companion.guidance.path import Path
from companion.vehicle.state import Vector3

NEAREST_M = 0.05


@behaviour(
    "goto",
    "fly straight to a point, given by one pair: forward and right, north and east, latitude and longitude",
)
class Goto(Command):
    north_m: Annotated[
        float | None, Number("north", "m", -5000.0, 5000.0, "distance north of home; needs east")
    ] = None
    east_m: Annotated[
        float | None, Number("east", "m", -5000.0, 5000.0, "distance east of home; needs north")
    ] = None
    altitude_m: Annotated[
        float | None, Number("altitude", "m", 1.0, 500.0, "height above home; default: unchanged")
    ] = None
    forward_m: Annotated[
        float | None, Number("forward", "m", -5000.0, 5000.0, "distance ahead of here; needs right")
    ] = None
    right_m: Annotated[
        float | None, Number("right", "m", -5000.0, 5000.0, "distance right of here; needs forward")
    ] = None
    latitude_deg: Annotated[
        float | None, Number("latitude", "deg", -90.0, 90.0, "WGS 84; needs longitude")
    ] = None
    longitude_deg: Annotated[
        float | None, Number("longitude", "deg", -180.0, 180.0, "WGS 84; needs latitude")
    ] = None
    speed_mps: Annotated[float, Number("speed", "m/s", 0.2, 20.0, "maximum speed")] = 3.0
    heading_deg: Annotated[
        float | None,
        Number("heading", "deg", -360.0, 360.0, "yaw, clockwise from north; default: along the path"),
    ] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        pairs = {
            "north and east": (self.north_m, self.east_m),
            "forward and right": (self.forward_m, self.right_m),
            "latitude and longitude": (self.latitude_deg, self.longitude_deg),
        }
        given = [name for name, pair in pairs.items() if pair != (None, None)]
        if len(given) != 1:
            got = " and ".join(given) if given else "none of them"
            raise GrammarError(f"goto: give exactly one pair of {', '.join(pairs)}; got {got}")
        if None in pairs[given[0]]:
            raise GrammarError(f"goto: give both {given[0]}; one is missing")

    def build(self, context: BuildContext) -> Behaviour:
        return GotoBehaviour(
            from_home_m=_pair(self.north_m, self.east_m),
            from_here_m=_pair(self.forward_m, self.right_m),
            global_deg=_pair(self.latitude_deg, self.longitude_deg),
            altitude_m=self.altitude_m,
            speed_mps=self.speed_mps,
            heading_rad=None if self.heading_deg is None else math.radians(self.heading_deg),
        )


class GotoBehaviour(PathFlight):
    """Flies to a point given by exactly one pair.

    Args:
        from_home_m: (north, east) of home. from_here_m: (forward, right) of the position where it begins.
        global_deg: (latitude, longitude), WGS 84. altitude_m: above home; None: unchanged.
    """

    name = "goto"

    def __init__(
        self,
        *,
        from_home_m: tuple[float, float] | None = None,
        from_here_m: tuple[float, float] | None = None,
        global_deg: tuple[float, float] | None = None,
        altitude_m: float | None = None,
        speed_mps: float = 3.0,
        heading_rad: float | None = None,
    ) -> None:
        super().__init__(speed_mps, heading_rad=heading_rad)
        given = [pair for pair in (from_home_m, from_here_m, global_deg) if pair is not None]
        if len(given) != 1:
            raise ValueError("goto needs exactly one of from_home_m, from_here_m and global_deg")
        self._from_home_m, self._from_here_m, self._global_deg = from_home_m, from_here_m, global_deg
        self._altitude_m = altitude_m

    def _path(self, context: BehaviourContext) -> Path:
        position, _ = position_and_yaw(context.state)
        goal = self._goal(context)
        if math.dist(goal, position) < NEAREST_M:
            # A path needs a length: at the goal already, it starts 5 cm above.
            position = (goal[0], goal[1], goal[2] - NEAREST_M)
        return Path([position, goal], self._speed_mps)

    def goals(self, context: BehaviourContext) -> tuple[Vector3, ...]:
        """See Behaviour."""
        try:
            return (self._goal(context),)
        except ValueError:
            return ()  # reported when it begins

    def _goal(self, context: BehaviourContext) -> Vector3:
        state = context.state
        position, yaw_rad = position_and_yaw(state)
        down = position[2] if self._altitude_m is None else home_of(state)[2] - self._altitude_m
        if self._from_home_m is not None:
            home = home_of(state)
            return (home[0] + self._from_home_m[0], home[1] + self._from_home_m[1], down)
        if self._from_here_m is not None:
            forward, right = self._from_here_m
            north = forward * math.cos(yaw_rad) - right * math.sin(yaw_rad)
            east = forward * math.sin(yaw_rad) + right * math.cos(yaw_rad)
            return (position[0] + north, position[1] + east, down)
        assert self._global_deg is not None
        return (*local_from_global(state, context.now_ns, self._global_deg), down)

    def _success_text(self) -> str:
        return "goal reached"


def _pair(first: float | None, second: float | None) -> tuple[float, float] | None:
    return None if first is None or second is None else (first, second)
