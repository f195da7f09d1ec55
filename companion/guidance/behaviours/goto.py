"""Goto: fly straight to a point given from home, from the current position, or by latitude and longitude."""

from __future__ import annotations

import math
from typing import Annotated

from companion.guidance.behaviour import Behaviour, BehaviourContext
from companion.guidance.behaviours.path_flight import PathFlight
from companion.guidance.command import BuildContext, Command, GrammarError, Number, behaviour
from companion.guidance.motion import home_of, local_from_global, position_and_yaw
from companion.vehicle.state import Vector3


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
        return GotoBehaviour(self)


class GotoBehaviour(PathFlight):
    """Flies to the point."""

    name = "goto"

    def __init__(self, command: Goto) -> None:
        heading_rad = None if command.heading_deg is None else math.radians(command.heading_deg)
        super().__init__(command.speed_mps, heading_rad=heading_rad)
        self._command = command

    def _points(self, context: BehaviourContext) -> list[Vector3]:
        state, command = context.state, self._command
        position, yaw_rad = position_and_yaw(state)
        down = position[2] if command.altitude_m is None else home_of(state)[2] - command.altitude_m
        if command.north_m is not None and command.east_m is not None:
            home = home_of(state)
            return [(home[0] + command.north_m, home[1] + command.east_m, down)]
        if command.forward_m is not None and command.right_m is not None:
            north = command.forward_m * math.cos(yaw_rad) - command.right_m * math.sin(yaw_rad)
            east = command.forward_m * math.sin(yaw_rad) + command.right_m * math.cos(yaw_rad)
            return [(position[0] + north, position[1] + east, down)]
        assert command.latitude_deg is not None
        assert command.longitude_deg is not None
        place = (command.latitude_deg, command.longitude_deg)
        return [(*local_from_global(state, context.now_ns, place), down)]

    def _success_text(self) -> str:
        return "goal reached"
