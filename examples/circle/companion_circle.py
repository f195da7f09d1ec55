"""A behaviour plug-in: `circle radius=6 speed=2` circles around the point ahead, nose to the centre."""

import math
from typing import Annotated

from companion import Behaviour, BehaviourContext, Command, Number, Requirement, Setpoint, behaviour


@behaviour("circle", "fly a circle around the point ahead, nose to its centre")
class Circle(Command):
    endless = True  # until another command
    radius_m: Annotated[float, Number("radius", "m", 2.0, 50.0, "radius of the circle")] = 8.0
    speed_mps: Annotated[float, Number("speed", "m/s", 0.2, 5.0, "speed along the circle")] = 2.0

    def build(self, context: object) -> Behaviour:
        return CircleBehaviour(self)


class CircleBehaviour(Behaviour):
    name = "circle"
    requirements = frozenset({Requirement.POSITION, Requirement.IN_AIR})

    def __init__(self, command: Circle) -> None:
        self._radius_m, self._speed_mps = command.radius_m, command.speed_mps

    def on_activate(self, context: BehaviourContext) -> None:
        north, east, self._down_m = context.state.position_ned_m or (0.0, 0.0, 0.0)
        yaw = context.state.yaw_rad or 0.0
        self._centre = (north + self._radius_m * math.cos(yaw), east + self._radius_m * math.sin(yaw))

    def update(self, dt_s: float, context: BehaviourContext) -> Setpoint:
        north, east, down = context.state.position_ned_m or (0.0, 0.0, 0.0)
        angle = math.atan2(east - self._centre[1], north - self._centre[0])
        outward_mps = 0.8 * (self._radius_m - math.hypot(east - self._centre[1], north - self._centre[0]))
        north_mps = outward_mps * math.cos(angle) - self._speed_mps * math.sin(angle)
        east_mps = outward_mps * math.sin(angle) + self._speed_mps * math.cos(angle)
        velocity = (north_mps, east_mps, self._down_m - down)
        return Setpoint.velocity(velocity, context.now_ns, yaw_rad=angle + math.pi)
