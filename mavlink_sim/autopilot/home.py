"""Home: the reference of relative heights and the destination of a return."""

from __future__ import annotations

from typing import Protocol

from mavlink_sim.physics.rotations import Vector
from mavlink_sim.px4.parameters import Parameters


class Pose(Protocol):
    """A position, local NED in metres, and an attitude; the airframe and its estimate have them."""

    @property
    def position(self) -> Vector: ...

    @property
    def roll_rad(self) -> float: ...

    @property
    def pitch_rad(self) -> float: ...

    @property
    def yaw_rad(self) -> float: ...


class Home:
    """HOME_POSITION, and whether a command has set it.

    Attributes:
        position: local NED, metres.
        attitude_rad: roll, pitch and yaw there; NaN: unknown.
    """

    def __init__(self, pose: Pose) -> None:
        self.is_here(pose)

    def is_here(self, pose: Pose) -> None:
        """Set home to a pose; `follow` may move it again."""
        self.position = pose.position
        self.attitude_rad: Vector = (pose.roll_rad, pose.pitch_rad, pose.yaw_rad)
        self._is_manual = False

    def is_at(self, position: Vector, attitude_rad: Vector) -> None:
        """Set home by a command: `follow` does not move it."""
        self.position, self.attitude_rad = position, attitude_rad
        self._is_manual = True

    def follow(self, pose: Pose, parameters: Parameters) -> None:
        """Set home at arming or landing, unless a command has set it or COM_HOME_EN forbids it.

        (ArduPilot has no such parameter: its home always follows.)
        """
        enabled = parameters.get("COM_HOME_EN")
        if not self._is_manual and (enabled is None or enabled.value):
            self.is_here(pose)
