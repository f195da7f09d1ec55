"""Guidance: behaviours, limits, and the core that steps one behaviour at a time.

The behaviours are imported here because each adds its command to `command.COMMANDS`; help texts list them in
this order.
"""

# isort: off
from companion.guidance.behaviours.takeoff import Takeoff
from companion.guidance.behaviours.land import Land, Rtl
from companion.guidance.behaviours.stop import Stop
from companion.guidance.behaviours.hold import Hold
from companion.guidance.behaviours.velocity import Velocity
from companion.guidance.behaviours.goto import Goto
from companion.guidance.behaviours.follow_path import FollowPath
from companion.guidance.behaviours.figure_eight import FigureEight
from companion.guidance.behaviours.orbit import Orbit
from companion.guidance.behaviours.seek import Seek
from companion.guidance.behaviours.approach import Approach
from companion.guidance.behaviours.follow import Follow
from companion.guidance.behaviours.policy import Policy
from companion.guidance.behaviours.patrol import Patrol
from companion.guidance.missions.mission_file import Mission
from companion.guidance.behaviours.formation import Formation
from companion.guidance.behaviours.land_on_marker import LandOnMarker
from companion.guidance.behaviours.gimbal_pointing import Gimbal
from companion.guidance.behaviours.select import Select

__all__ = [
    "Approach",
    "FigureEight",
    "Follow",
    "FollowPath",
    "Formation",
    "Gimbal",
    "Goto",
    "Hold",
    "Land",
    "LandOnMarker",
    "Mission",
    "Orbit",
    "Patrol",
    "Policy",
    "Rtl",
    "Seek",
    "Select",
    "Stop",
    "Takeoff",
    "Velocity",
]
