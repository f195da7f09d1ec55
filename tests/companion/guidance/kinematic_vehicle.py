"""A vehicle for tests in lockstep: it follows velocity, position, yaw and yaw rate with a short lag."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from companion.guidance.targets.target import RangeSource, Target
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, LandedState, Vector3, VehicleState
from vision.attitude import quaternion_from_euler, wrap_angle

START_NS = 1_000_000_000_000


@dataclass
class KinematicVehicle:
    """Local NED. Velocity and yaw rate answer as a first-order lag, like a multirotor's outer loops."""

    position: list[float] = field(default_factory=lambda: [0.0, 0.0, -5.0])
    velocity: list[float] = field(default_factory=lambda: [0.0, 0.0, 0.0])
    yaw_rad: float = 0.0
    yaw_rate_radps: float = 0.0
    now_ns: int = START_NS
    mode: FlightMode = FlightMode.OFFBOARD
    armed: bool = True
    landed: LandedState = LandedState.IN_AIR
    lag_s: float = 0.3

    @property
    def state(self) -> VehicleState:
        return VehicleState(
            heartbeat_ns=self.now_ns,
            attitude_ns=self.now_ns,
            position_ns=self.now_ns,
            landed_ns=self.now_ns,
            armed=self.armed,
            mode=self.mode,
            landed=self.landed,
            ready_to_arm=True,
            position_ned_m=self.place,
            velocity_ned_mps=(self.velocity[0], self.velocity[1], self.velocity[2]),
            attitude=quaternion_from_euler(0.0, 0.0, self.yaw_rad),
            home_altitude_amsl_m=489.0,
            home_position_ned_m=(0.0, 0.0, 0.0),
        )

    @property
    def place(self) -> Vector3:
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
            self.velocity[axis] += (wanted[axis] - self.velocity[axis]) * mix
            self.position[axis] += self.velocity[axis] * dt_s
        self.yaw_rate_radps += (rate - self.yaw_rate_radps) * dt_s / (0.15 + dt_s)
        self.yaw_rad = wrap_angle(self.yaw_rad + self.yaw_rate_radps * dt_s)
        self.now_ns += round(dt_s * 1e9)


@dataclass
class SeenObject:
    """Something that stands on the ground, with the camera's view of it."""

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


def look(
    vehicle: KinematicVehicle,
    objects: Sequence[SeenObject],
    captured_ns: int,
    *,
    half_view_rad: float = math.radians(40),
    noise: Callable[[], float] = lambda: 0.0,
) -> tuple[Target, ...]:
    """What a level camera looking forward makes of them."""
    targets = []
    for thing in objects:
        north, east = thing.north - vehicle.position[0], thing.east - vehicle.position[1]
        distance = math.hypot(north, east)
        bearing = math.atan2(east, north)
        if not thing.visible or abs(wrap_angle(bearing - vehicle.yaw_rad)) > half_view_rad:
            continue
        range_m = max(0.1, (distance - thing.radius_m) * (1.0 + noise()))
        place = (
            vehicle.position[0] + range_m * math.cos(bearing),
            vehicle.position[1] + range_m * math.sin(bearing),
            0.0,
        )
        targets.append(
            Target(
                thing.class_name,
                thing.confidence,
                captured_ns,
                bearing,
                math.atan2(vehicle.position[2], distance),
                range_m if thing.with_range else math.nan,
                thing.source if thing.with_range else RangeSource.NONE,
                place if thing.with_range else None,
                track_id=thing.track_id,
                track_score=thing.track_score,
                trusted=thing.trusted,
            )
        )
    return tuple(targets)
