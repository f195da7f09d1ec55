"""Kinematic vehicle for lockstep tests: follows velocity, position, yaw and yaw rate with a short lag."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from companion.guidance.objects.target import RangeSource, Target
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, LandedState, Vector3, VehicleState, with_fields
from vision.attitude import quaternion_from_euler, wrap_angle

START_NS = 1_000_000_000_000
# What does not change in flight.
STATE = VehicleState(ready_to_arm=True, home_altitude_amsl_m=489.0, home_position_ned_m=(0.0, 0.0, 0.0))


@dataclass
class KinematicVehicle:
    """Local NED. First-order lag of velocity and yaw rate, like a multirotor's outer loops.

    Attributes:
        velocity_error: of the estimated velocity, which is the one that setpoints set.
    """

    position: list[float] = field(default_factory=lambda: [0.0, 0.0, -5.0])
    velocity: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    yaw_rad: float = 0.0
    yaw_rate_radps: float = 0.0
    now_ns: int = START_NS
    mode: FlightMode = FlightMode.OFFBOARD
    armed: bool = True
    landed: LandedState = LandedState.IN_AIR
    lag_s: float = 0.3
    velocity_error: Vector3 = (0.0, 0.0, 0.0)

    @property
    def state(self) -> VehicleState:
        return with_fields(
            STATE,
            heartbeat_ns=self.now_ns,
            attitude_ns=self.now_ns,
            position_ns=self.now_ns,
            armed=self.armed,
            mode=self.mode,
            landed=self.landed,
            position_ned_m=self.position_ned_m,
            velocity_ned_mps=self.estimated_velocity,
            attitude=quaternion_from_euler(0.0, 0.0, self.yaw_rad),
        )

    @property
    def estimated_velocity(self) -> Vector3:
        north, east, down = (v + e for v, e in zip(self.velocity, self.velocity_error, strict=True))
        return (north, east, down)

    @property
    def position_ned_m(self) -> Vector3:
        return (self.position[0], self.position[1], self.position[2])

    def fly(self, setpoint: Setpoint, dt_s: float) -> None:
        wanted: Sequence[float] = setpoint.velocity_ned_mps or (0.0, 0.0, 0.0)
        if setpoint.position_ned_m is not None:
            error = [a - b for a, b in zip(setpoint.position_ned_m, self.position, strict=True)]
            length = max(1e-9, math.hypot(*error))
            wanted = [0.95 * e * min(1.0, 5.0 / (0.95 * length)) for e in error]
        rate = setpoint.yaw_rate_radps or 0.0
        if setpoint.yaw_rad is not None:
            rate = max(-1.5, min(1.5, 2.0 * wrap_angle(setpoint.yaw_rad - self.yaw_rad)))
        mix = dt_s / (self.lag_s + dt_s)
        for axis in range(3):
            self.velocity[axis] += (wanted[axis] - self.estimated_velocity[axis]) * mix
            self.position[axis] += self.velocity[axis] * dt_s
        self.yaw_rate_radps += (rate - self.yaw_rate_radps) * dt_s / (0.15 + dt_s)
        self.yaw_rad = wrap_angle(self.yaw_rad + self.yaw_rate_radps * dt_s)
        self.now_ns += round(dt_s * 1e9)


@dataclass
class SeenObject:
    """An object on the ground and how the camera sees it.

    Attributes:
        then: seconds of the flight → what of it changes.
    """

    class_name: str
    north: float
    east: float
    confidence: float = 0.8
    radius_m: float = 0.0
    visible: bool = True
    with_range: bool = True
    source: RangeSource = RangeSource.GROUND_PLANE
    track_id: int | None = None
    track_score: float | None = None
    trusted: bool = True
    then: Callable[[float], Mapping[str, Any]] = lambda seconds: {}

    def change(self, seconds: float) -> None:
        for name, value in self.then(seconds).items():
            setattr(self, name, value)


def look(
    vehicle: KinematicVehicle,
    objects: Sequence[SeenObject],
    captured_ns: int,
    *,
    half_view_rad: float = math.radians(40),
    noise: Callable[[], float] = lambda: 0.0,
) -> tuple[Target, ...]:
    """Targets of a level forward-looking camera."""
    targets = []
    for scene_object in objects:
        north, east = scene_object.north - vehicle.position[0], scene_object.east - vehicle.position[1]
        distance = math.hypot(north, east)
        bearing = math.atan2(east, north)
        if not scene_object.visible or abs(wrap_angle(bearing - vehicle.yaw_rad)) > half_view_rad:
            continue
        range_m = max(0.1, (distance - scene_object.radius_m) * (1.0 + noise()))
        point = (
            vehicle.position[0] + range_m * math.cos(bearing),
            vehicle.position[1] + range_m * math.sin(bearing),
            0.0,
        )
        targets.append(
            Target(
                scene_object.class_name,
                scene_object.confidence,
                captured_ns,
                bearing,
                math.atan2(vehicle.position[2], distance),
                range_m if scene_object.with_range else math.nan,
                scene_object.source if scene_object.with_range else RangeSource.NONE,
                point if scene_object.with_range else None,
                track_id=scene_object.track_id,
                track_score=scene_object.track_score,
                trusted=scene_object.trusted,
            )
        )
    return tuple(targets)
