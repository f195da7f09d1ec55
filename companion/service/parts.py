"""The parts of a service as its settings want them."""

from __future__ import annotations

from companion.guidance.battery import BatteryMinimum
from companion.guidance.envelope import Limits
from companion.guidance.obstacles import ObstacleRules
from companion.settings import Settings
from companion.vehicle.driver import Driver
from companion.vehicle.drivers import open_driver
from companion.vehicle.signing import read_key


def driver_of(settings: Settings) -> Driver:
    """The link to the autopilot, not open yet."""
    return open_driver(
        settings.vehicle.driver,
        settings.vehicle.url,
        system_id=settings.vehicle.system_id,
        own_system_id=settings.vehicle.system_id,
        signing_key=None
        if settings.vehicle.signing_key_file is None
        else read_key(settings.vehicle.signing_key_file),
    )


def limits_of(settings: Settings) -> Limits:
    """The envelope's limits, from the settings of the same names."""
    guidance = settings.guidance
    return Limits(
        max_horizontal_speed_mps=guidance.max_horizontal_speed_mps,
        max_climb_mps=guidance.max_climb_mps,
        max_descend_mps=guidance.max_descend_mps,
        max_yaw_rate_radps=guidance.max_yaw_rate_radps,
        max_acceleration_mps2=guidance.max_acceleration_mps2,
        min_altitude_m=guidance.min_altitude_m,
        max_altitude_m=guidance.max_altitude_m,
        max_distance_m=guidance.max_distance_m,
        fence=guidance.fence(),
        min_separation_m=guidance.min_separation_m,
    )


def battery_minimum_of(settings: Settings) -> BatteryMinimum:
    """How much charge a flight needs, and what follows one that ended for its lack."""
    guidance = settings.guidance
    return BatteryMinimum(guidance.min_battery_percent / 100.0, guidance.low_battery)


def obstacle_rules_of(settings: Settings) -> ObstacleRules:
    """How far to stay from what the depth camera sees."""
    guidance = settings.guidance
    return ObstacleRules(guidance.obstacles, guidance.obstacle_margin_m, guidance.unknown_speed_mps)
