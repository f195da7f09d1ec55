"""A behaviour plug-in: `circle-object car radius=8` circles about an object that it sees, nose to it."""

import math
from typing import Annotated

import companion as c


@c.behaviour("circle-object", "fly a circle about an object of the class, a track or a marker")
class CircleObject(c.Command):
    endless = True  # until another command
    subject: c.Subject
    radius_m: Annotated[float, c.Number("radius", "m", 3.0, 50.0, "of the circle")] = 8.0
    speed_mps: Annotated[float, c.Number("speed", "m/s", 0.2, 5.0, "along the circle")] = 2.0

    def build(self, context: object) -> c.Behaviour:
        return CircleObjectBehaviour(self)


class CircleObjectBehaviour(c.Behaviour):
    name = "circle-object"
    requirements = frozenset({c.Requirement.POSITION, c.Requirement.IN_AIR})

    def __init__(self, command: CircleObject) -> None:
        self.subject: c.Subject = command.subject
        self._radius_m, self._speed_mps = command.radius_m, command.speed_mps

    def on_activate(self, context: c.BehaviourContext) -> None:
        *_, self._down_m = context.state.position_ned_m or (0.0, 0.0, 0.0)

    def update(self, dt_s: float, context: c.BehaviourContext) -> c.Setpoint | c.Outcome:
        north, east, down = context.state.position_ned_m or (0.0, 0.0, 0.0)
        if (why := context.objects.lost(self.subject, after_s=3.0)) is not None:
            return c.Outcome(False, why)
        if (seen := context.objects.of(self.subject)) is None:  # none is chosen yet
            return c.Setpoint.velocity((0.0, 0.0, self._down_m - down), context.now_ns, yaw_rate_radps=0.0)
        there, (north_mps, east_mps) = seen.position_at(context.now_ns), seen.velocity_ned_mps
        angle = math.atan2(east - there[1], north - there[0])
        out_mps = self._radius_m - math.dist((north, east), there[:2])
        out_mps = max(-self._speed_mps, min(self._speed_mps, out_mps))
        north_mps += out_mps * math.cos(angle) - self._speed_mps * math.sin(angle)
        east_mps += out_mps * math.sin(angle) + self._speed_mps * math.cos(angle)
        own = context.state.velocity_ned_mps or (north_mps, east_mps, 0.0)
        velocity = (2.0 * north_mps - own[0], 2.0 * east_mps - own[1], self._down_m - down)
        return c.Setpoint.velocity(velocity, context.now_ns, yaw_rad=angle + math.pi)
