"""The settings of flight: how the vehicle may be moved, and where."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from companion.geometry.fence import Fence, Polygon
from companion.geometry.points import points_from
from companion.settings.section import Section
from companion.settings.texts import VIEW_NAME


class GuidanceSection(Section):
    """How the vehicle may be moved, and when what we know is too old to move by."""

    rate_hz: Annotated[float, Field(ge=5, le=200)] = 20.0
    """how often a behaviour is asked where to go, times a second"""
    max_horizontal_speed_mps: Annotated[float, Field(gt=0, le=30)] = 5.0
    """largest horizontal speed asked for, metres a second"""
    max_climb_mps: Annotated[float, Field(gt=0, le=10)] = 2.0
    """largest climb rate asked for, metres a second"""
    max_descend_mps: Annotated[float, Field(gt=0, le=10)] = 1.0
    """largest descent rate asked for, metres a second"""
    max_yaw_rate_radps: Annotated[float, Field(gt=0, le=6)] = 1.0
    """largest turn rate asked for, radians a second"""
    max_acceleration_mps2: Annotated[float, Field(gt=0, le=20)] = 3.0
    """largest change of the velocity asked for, metres a second squared"""
    min_altitude_m: Annotated[float, Field(gt=0, le=1000)] = 1.0
    """never asks to fly lower than this above home, unless to land (on a marker, too), metres"""
    max_altitude_m: Annotated[float, Field(gt=0, le=5000)] = 50.0
    """never asks to fly higher than this above home, metres"""
    max_distance_m: Annotated[float, Field(gt=0, le=100000)] = 200.0
    """never asks to fly farther than this from home, metres"""
    fence_include: str = ""
    """corners of the area never left, north,east of home in metres: "-50,-50 50,-50 50,50"; empty: none"""
    fence_exclude: str = ""
    """areas never entered, written the same way and parted by |"""
    min_separation_m: Annotated[float, Field(gt=0, le=100)] = 3.0
    """never asks to fly nearer than this to another vehicle that shares its pose, metres"""
    setpoint_rate_hz: Annotated[float, Field(ge=5, le=250)] = 50.0
    """setpoints a second on the link; PX4 needs more than 2"""
    setpoint_lifetime_s: Annotated[float, Field(ge=0.02, le=2)] = 0.3
    """a setpoint older than this is not sent any more, seconds"""
    brake_s: Annotated[float, Field(ge=0, le=5)] = 0.5
    """after that a brake is sent for so long, then nothing: PX4 leaves OFFBOARD, ArduPilot stands; seconds"""
    min_battery_percent: Annotated[float, Field(ge=0, le=100)] = 15.0
    """no flight begins with less charge than this, and one ends below it; percent, 0: not watched"""
    low_battery: Literal["rtl", "land", "hold"] = "rtl"
    """what follows a flight that ended for its battery: return, land here, or hold under our command"""
    obstacles: Literal["off", "auto", "required"] = "auto"
    """depth slows flight towards obstacles: where it comes (auto), or nothing flies without it (required)"""
    obstacle_margin_m: Annotated[float, Field(gt=0, le=50)] = 2.0
    """distance kept from obstacles, from the vehicle's middle, metres"""
    max_speed_unobserved_mps: Annotated[float | None, Field(gt=0, le=30)] = None
    """largest speed towards what the depth camera does not see; unset: not limited, metres a second"""
    perception_max_age_s: Annotated[float, Field(gt=0, le=10)] = 0.5
    """detections older than this do not steer, seconds from capture"""
    camera: Annotated[str | None, VIEW_NAME] = None
    """the camera that steers; unset: the one of the sections source, camera and detector"""

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
        self.fence()
        return self

    def fence(self) -> Fence:
        """The same as polygons. Raises ValueError for what is none."""
        include = _corners("fence_include", self.fence_include) if self.fence_include else ()
        areas = [text for text in self.fence_exclude.split("|") if text.strip()]
        return Fence(include, tuple(_corners("fence_exclude", text) for text in areas))


def _corners(key: str, text: str) -> Polygon:
    try:
        points = points_from(text)
        if any(len(point) != 2 for point in points):
            raise ValueError("a corner is north,east")
        corners = tuple((point[0], point[1]) for point in points)
        Fence(corners)
    except ValueError as error:
        raise ValueError(f"{key}: {error}") from None
    return corners
