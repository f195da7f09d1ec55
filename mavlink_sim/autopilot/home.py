"""Home: the place that heights are told from and a return leads to, and how the vehicle stands there."""

from __future__ import annotations

from typing import Protocol

from mavlink_sim.physics.airframe import Vector
from mavlink_sim.px4.parameters import Parameters


class Pose(Protocol):
    """Where something is, local NED in metres, and how it stands; what flies and its estimate are such."""

    @property
    def position(self) -> Vector: ...

    @property
    def roll_rad(self) -> float: ...

    @property
    def pitch_rad(self) -> float: ...

    @property
    def yaw_rad(self) -> float: ...


class Home:
    """HOME_POSITION, and who has said where it is.

    Attributes:
        position: local NED, metres.
        attitude_rad: roll, pitch and yaw there; NaN: not known.
    """

    def __init__(self, pose: Pose) -> None:
        self.is_here(pose)

    def is_here(self, pose: Pose) -> None:
        """Home is where that is now; `follow` may move it again."""
        self.position = pose.position
        self.attitude_rad: Vector = (pose.roll_rad, pose.pitch_rad, pose.yaw_rad)
        self._is_manual = False

    def is_at(self, position: Vector, attitude_rad: Vector) -> None:
        """A command has named the place: `follow` leaves it."""
        self.position, self.attitude_rad = position, attitude_rad
        self._is_manual = True

    def follow(self, pose: Pose, parameters: Parameters) -> None:
        """Arming or landing there: home is there now, unless a command has named it or COM_HOME_EN forbids.

        (ArduPilot has no such parameter: its home always follows.)
        """
        enabled = parameters.get("COM_HOME_EN")
        if not self._is_manual and (enabled is None or enabled.value):
            self.is_here(pose)
