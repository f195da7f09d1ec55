"""The commands: what an operator, a mission or a program may ask for."""

from __future__ import annotations

from companion.guidance.command import Command
from companion.guidance.commands_of_flight import (
    FigureEight,
    FollowPath,
    Formation,
    Goto,
    Hold,
    Land,
    Mission,
    Rtl,
    Stop,
    Takeoff,
)
from companion.guidance.commands_of_sight import (
    Approach,
    Follow,
    Gimbal,
    LandOnMarker,
    Orbit,
    Patrol,
    Seek,
)

__all__ = [
    "COMMANDS",
    "Approach",
    "Command",
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

COMMANDS: dict[str, type[Command]] = {
    kind.word: kind
    for kind in (
        Takeoff,
        Land,
        Rtl,
        Stop,
        Hold,
        Goto,
        FollowPath,
        FigureEight,
        Orbit,
        Seek,
        Approach,
        Follow,
        Patrol,
        Mission,
        Formation,
        LandOnMarker,
        Gimbal,
    )
}
