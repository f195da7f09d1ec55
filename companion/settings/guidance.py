"""The settings of guidance: limits of the vehicle's motion."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from companion.geometry.fence import Fence, Polygon
from companion.geometry.points import points_from
from companion.settings.section import Section
from companion.settings.texts import CAMERA_NAME


class GuidanceSection(Section):
    """Limits of the vehicle's motion, and maximum ages of the data used."""

    rate_hz: Annotated[float, Field(ge=5, le=200)] = 20.0
    """update rate of behaviours, times a second"""
    max_horizontal_speed_mps: Annotated[float, Field(gt=0, le=30)] = 5.0
    """maximum commanded horizontal speed, metres a second"""
    max_climb_mps: Annotated[float, Field(gt=0, le=10)] = 2.0
    """maximum commanded climb rate, metres a second"""
    max_descend_mps: Annotated[float, Field(gt=0, le=10)] = 1.0
    """maximum commanded descent rate, metres a second"""
    max_yaw_rate_radps: Annotated[float, Field(gt=0, le=6)] = 1.0
    """maximum commanded yaw rate, radians a second"""
    max_acceleration_mps2: Annotated[float, Field(gt=0, le=20)] = 3.0
    """maximum rate of change of the commanded velocity, metres a second squared"""
    min_altitude_m: Annotated[float, Field(gt=0, le=1000)] = 1.0
    """minimum commanded altitude above home, except for landing (also on a marker), metres"""
    max_altitude_m: Annotated[float, Field(gt=0, le=5000)] = 50.0
    """maximum commanded altitude above home, metres"""
    max_distance_m: Annotated[float, Field(gt=0, le=100000)] = 200.0
    """maximum commanded distance from home, metres"""
    fence_include: str = ""
    """inclusion geofence, corners north,east of home in metres: "-50,-50 50,-50 50,50"; empty: none"""
    fence_exclude: str = ""
    """exclusion geofences, in the same form, separated by |"""
    min_separation_m: Annotated[float, Field(gt=0, le=100)] = 3.0
    """minimum commanded distance to another vehicle that shares its pose, metres"""
    setpoint_rate_hz: Annotated[float, Field(ge=5, le=250)] = 50.0
    """rate of setpoints on the link, Hz; PX4 needs more than 2"""
    setpoint_lifetime_s: Annotated[float, Field(ge=0.02, le=2)] = 0.3
    """maximum age of a setpoint, seconds; an older one is not sent"""
    brake_s: Annotated[float, Field(ge=0, le=5)] = 0.5
    """then braking setpoints for this time, then silence: PX4 leaves OFFBOARD, ArduPilot stops; seconds"""
    min_battery_percent: Annotated[float, Field(ge=0, le=100)] = 15.0
    """minimum battery charge to start or continue a flight, percent; 0: not checked"""
    low_battery: Literal["rtl", "land", "hold"] = "rtl"
    """action below min_battery_percent: return, land here, or hold under our command"""
    obstacles: Literal["off", "auto", "required"] = "auto"
    """slow down towards obstacles by depth: if available (auto), or refuse to fly without (required)"""
    obstacle_margin_m: Annotated[float, Field(gt=0, le=50)] = 2.0
    """minimum distance of obstacles from the vehicle's centre, metres"""
    avoid: bool = False
    """fly around obstacles that the depth camera sees: goto, follow-path, figure-eight, patrol, approach"""
    max_speed_unobserved_mps: Annotated[float | None, Field(gt=0, le=30)] = None
    """maximum speed in directions that the depth camera does not see, metres a second; unset: no limit"""
    range_finder_height: bool = False
    """use a range finder that looks down for ranges from the ground: only over slopes without objects"""
    send_obstacle_distance: bool = False
    """send OBSTACLE_DISTANCE to the autopilot, for its collision prevention in the pilot's Position mode"""
    perception_max_age_s: Annotated[float, Field(gt=0, le=10)] = 0.5
    """maximum age of detections and depth used by guidance, seconds since the capture"""
    camera: Annotated[str | None, CAMERA_NAME] = None
    """the steering camera; unset: the one of the sections source, camera and detector"""

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.min_altitude_m >= self.max_altitude_m:
            raise ValueError(
                f"min_altitude_m must be below max_altitude_m, got {self.min_altitude_m:g} "
                f"and {self.max_altitude_m:g}"
            )
        if self.setpoint_lifetime_s <= 1 / self.rate_hz:
            raise ValueError(
                f"setpoint_lifetime_s must be longer than one period of rate_hz ({1 / self.rate_hz:.3g} s), "
                f"got {self.setpoint_lifetime_s:g}: each setpoint would expire before the next"
            )
        for name in ("avoid", "send_obstacle_distance"):
            if getattr(self, name) and self.obstacles == "off":
                raise ValueError(f"{name} needs obstacles auto or required, got off")
        self.fence()
        return self

    def fence(self) -> Fence:
        """Return the geofence. Raises ValueError for an invalid polygon."""
        include = _corners("fence_include", self.fence_include) if self.fence_include else ()
        areas = [text for text in self.fence_exclude.split("|") if text.strip()]
        return Fence(include, tuple(_corners("fence_exclude", text) for text in areas))


def _corners(key: str, text: str) -> Polygon:
    try:
        points = points_from(text)
        if any(len(point) != 2 for point in points):
            raise ValueError("a corner must be north,east")
        corners = tuple((point[0], point[1]) for point in points)
        Fence(corners)
    except ValueError as error:
        raise ValueError(f"{key}: {error}") from None
    return corners
