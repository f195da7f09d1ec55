"""From a command of the grammar to the behaviour that flies it."""

from __future__ import annotations

import math

from companion.guidance import commands
from companion.guidance.approach import ApproachBehaviour
from companion.guidance.approach_again import PersistentApproach
from companion.guidance.behaviour import Behaviour
from companion.guidance.figure_eight import FigureEightBehaviour
from companion.guidance.follow import FollowBehaviour
from companion.guidance.follow_path import FollowPathBehaviour
from companion.guidance.formation import FormationBehaviour
from companion.guidance.gimbal_pointing import PointGimbalBehaviour
from companion.guidance.gimbal_sweep import GimbalSweep
from companion.guidance.gimbal_tracking import GimbalTracking
from companion.guidance.goto import GotoBehaviour
from companion.guidance.hold import HoldBehaviour
from companion.guidance.land import LandBehaviour, ReturnBehaviour
from companion.guidance.land_on_marker import LandOnMarkerBehaviour
from companion.guidance.orbit import OrbitBehaviour
from companion.guidance.patrol import PatrolBehaviour
from companion.guidance.search import SearchBehaviour
from companion.guidance.search_pattern import Footprint
from companion.guidance.seek import SeekBehaviour
from companion.guidance.stop import StopBehaviour
from companion.guidance.takeoff import TakeoffBehaviour

# What a camera sees across at least, where nobody says what it does.
NARROW_FIELD_RAD = math.radians(40.0)


def behaviour_for(command: commands.Command, footprint: Footprint | None = None) -> Behaviour:
    """A new behaviour, ready for guidance. Raises TypeError for a command no behaviour is written for.

    Args:
        footprint: of the camera that steers; where it is not known, searches must be given a spacing.
    """
    match command:
        case commands.Takeoff(altitude_m):
            return TakeoffBehaviour(altitude_m)
        case commands.Land():
            return LandBehaviour()
        case commands.Rtl():
            return ReturnBehaviour()
        case commands.Stop():
            return StopBehaviour()
        case commands.Hold(duration_s):
            return HoldBehaviour(duration_s)
        case commands.Goto():
            return _goto(command)
        case commands.FollowPath(_, speed_mps, laps, nose):
            return FollowPathBehaviour(command.places, speed_mps, laps=laps, nose_along=nose == "along")
        case commands.FigureEight(radius_m, speed_mps, laps, nose):
            return FigureEightBehaviour(radius_m, speed_mps, laps, nose_along=nose == "along")
        case commands.Orbit(class_name, radius_m, speed_mps, laps, direction):
            clockwise = direction == "clockwise"
            return OrbitBehaviour(radius_m, speed_mps, laps, clockwise=clockwise, class_name=class_name)
        case commands.Seek() if command.pattern != "turn":
            return SearchBehaviour(
                command.class_name,
                radius_m=command.radius_m,
                size_m=_pair(command.width_m, command.height_m),
                spacing_m=command.spacing_m,
                footprint=footprint,
                speed_mps=command.speed_mps,
                confidence=command.confidence,
            )
        case commands.Seek():
            return _seek(command, footprint)
        case commands.Gimbal():
            return PointGimbalBehaviour(command.aim)
        case commands.Approach():
            return _approach(command, footprint)
        case commands.Follow():
            return _follow(command)
        case commands.Patrol():
            return PatrolBehaviour(
                command.places,
                command.names,
                speed_mps=command.speed_mps,
                laps=command.laps,
                approach_m=command.distance_m if command.do == "approach" else None,
                wait_s=command.wait_s,
                again_s=command.again_s,
                apart_m=command.apart_m,
                confidence=command.confidence,
            )
        case commands.Formation(shape, leader, spacing_m):
            return FormationBehaviour(
                shape,
                leader,
                spacing_m,
                command.slot_number,
                points=command.places,
                speed_mps=command.speed_mps,
                laps=command.laps,
                lost_timeout_s=command.lost_timeout_s,
            )
        case commands.LandOnMarker(identifier, method, pad, attempts, search_m, speed_mps):
            return LandOnMarkerBehaviour(
                int(identifier),
                by_autopilot=method == "autopilot",
                moving=pad == "moving",
                attempts=int(attempts),
                search_m=search_m,
                speed_mps=speed_mps,
            )
    raise TypeError(f"no behaviour is written for {type(command).__name__}")


def _seek(command: commands.Seek, footprint: Footprint | None) -> SeekBehaviour:
    sweep = None
    if command.sweep_deg is not None:
        sweep_rad, rate_radps = math.radians(command.sweep_deg), math.radians(command.sweep_rate_dps)
        sweep = GimbalSweep(sweep_rad, rate_radps, _field_rad(footprint))
    return SeekBehaviour(
        command.class_name,
        laps=command.laps,
        rate_radps=command.rate_radps,
        confidence=command.confidence,
        clockwise=command.direction == "clockwise",
        whole_turn=True,
        sweep=sweep,
    )


def _field_rad(footprint: Footprint | None) -> float:
    return NARROW_FIELD_RAD if footprint is None else footprint.horizontal_fov_rad


def _approach(command: commands.Approach, footprint: Footprint | None) -> PersistentApproach:
    tracking = _tracking(command)
    return PersistentApproach(
        lambda: ApproachBehaviour(
            command.class_name,
            distance_m=command.distance_m,
            speed_mps=command.speed_mps,
            confidence=command.confidence,
            lost_timeout_s=command.lost_timeout_s,
            tracking=tracking,
        ),
        command.class_name,
        retries=int(command.retries),
        confidence=command.confidence,
        tracking=tracking,
        field_rad=_field_rad(footprint),
    )


def _goto(command: commands.Goto) -> GotoBehaviour:
    heading = command.heading_deg
    return GotoBehaviour(
        from_home_m=_pair(command.north_m, command.east_m),
        from_here_m=_pair(command.forward_m, command.right_m),
        global_deg=_pair(command.latitude_deg, command.longitude_deg),
        altitude_m=command.altitude_m,
        speed_mps=command.speed_mps,
        heading_rad=None if heading is None else math.radians(heading),
    )


def _follow(command: commands.Follow) -> FollowBehaviour:
    return FollowBehaviour(
        command.class_name,
        distance_m=command.distance_m,
        bearing=command.bearing,
        angle_rad=math.radians(command.angle_deg),
        speed_mps=command.speed_mps,
        confidence=command.confidence,
        occlusion_s=command.occlusion_s,
        duration_s=command.duration_s,
        tracking=_tracking(command),
    )


def _tracking(command: commands.Approach | commands.Follow) -> GimbalTracking | None:
    """One for all of a command's approaches: they look for the same object."""
    return GimbalTracking() if command.gimbal == "track" else None


def _pair(first: float | None, second: float | None) -> tuple[float, float] | None:
    return None if first is None or second is None else (first, second)
