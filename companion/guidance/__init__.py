"""From what is seen to where to go: behaviours, limits, and the core that steps one behaviour at a time.

The behaviours are imported here because each of them adds its command to `registry.COMMANDS`; help texts list
them in this order.
"""

# isort: off
from companion.guidance.takeoff import Takeoff
from companion.guidance.land import Land, Rtl
from companion.guidance.stop import Stop
from companion.guidance.hold import Hold
from companion.guidance.goto import Goto
from companion.guidance.follow_path import FollowPath
from companion.guidance.figure_eight import FigureEight
from companion.guidance.orbit import Orbit
from companion.guidance.search import Seek
from companion.guidance.approach_again import Approach
from companion.guidance.follow import Follow
from companion.guidance.patrol import Patrol
from companion.guidance.missions.mission_file import Mission
from companion.guidance.formation import Formation
from companion.guidance.land_on_marker import LandOnMarker
from companion.guidance.gimbal_pointing import Gimbal

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
    "Rtl",
    "Seek",
    "Stop",
    "Takeoff",
]
