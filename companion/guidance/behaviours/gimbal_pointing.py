"""Point the gimbal as a step of a mission: the vehicle holds until the gimbal has turned.

An operator's `gimbal` command does not use this behaviour (see `gimbal.controller`).
"""

from __future__ import annotations

import math
from typing import Annotated

from companion.guidance.behaviour import Behaviour, BehaviourContext, BehaviourOutput, Outcome, Requirement
from companion.guidance.behaviours.hold import HoldBehaviour
from companion.guidance.command import (
    BuildContext,
    Command,
    GrammarError,
    Number,
    TrackId,
    behaviour,
)
from companion.guidance.gimbal.controller import POINT_TIMEOUT_S, POINTED_RAD, direction_text
from companion.guidance.targets.chosen import TrackAim
from companion.vehicle.gimbal import GimbalAim


@behaviour("gimbal", "point the gimbal during any behaviour, or keep it on a track; default: level and ahead")
class Gimbal(Command):
    pitch_deg: Annotated[
        float, Number("pitch", "deg", -90.0, 90.0, "above the horizon; below is negative")
    ] = 0.0
    yaw_deg: Annotated[float, Number("yaw", "deg", -180.0, 180.0, "clockwise from the nose")] = 0.0
    track_id: Annotated[
        int | None, TrackId("track", "keep it on this track until it is lost, instead of pitch and yaw")
    ] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.track_id is not None and (self.pitch_deg or self.yaw_deg):
            raise GrammarError("gimbal: give either track, or pitch and yaw, got both")

    @property
    def aim(self) -> GimbalAim | TrackAim:
        """Where to point it."""
        if self.track_id is not None:
            return TrackAim(self.track_id)
        return GimbalAim(math.radians(self.pitch_deg), math.radians(self.yaw_deg))

    def build(self, context: BuildContext) -> Behaviour:
        return PointGimbalBehaviour(self.aim)


class PointGimbalBehaviour(HoldBehaviour):
    """Holds, and ends when the gimbal points at the aim."""

    name = "gimbal"
    requirements = frozenset({Requirement.POSITION, Requirement.IN_AIR, Requirement.GIMBAL})

    def __init__(self, aim: GimbalAim | TrackAim) -> None:
        super().__init__()
        self._track = aim if isinstance(aim, TrackAim) else None
        self._aim = aim if isinstance(aim, GimbalAim) else GimbalAim(0.0)
        if isinstance(aim, TrackAim):
            self.track_id = aim.track_id
        else:
            self.gimbal_pitches_rad = (aim.pitch_rad,)

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        # The first update still shows the previous owner's problem.
        if context.gimbal.problem and context.now_ns > self._since_ns:
            return Outcome(False, f"gimbal: {context.gimbal.problem}")
        state, gimbal = context.state, context.state.gimbal
        if self._track is not None:
            camera_pitch_rad = context.gimbal.camera_pitch_rad if context.gimbal.carries_camera else 0.0
            self._aim = self._track.direction(context.tracks, state, camera_pitch_rad) or self._aim
        off_rad = None if gimbal is None else gimbal.off_rad(self._aim, state.yaw_rad or 0.0)
        known = gimbal is not None and gimbal.attitude_fresh(context.now_ns)
        if known and off_rad is not None and off_rad <= POINTED_RAD:
            return Outcome(True, f"gimbal points {direction_text(self._aim)}")
        if context.now_ns - self._since_ns > POINT_TIMEOUT_S * 1e9:
            return Outcome(
                False, f"gimbal: not pointing {direction_text(self._aim)} after {POINT_TIMEOUT_S:g} s"
            )
        return super().update(dt_s, context)

    @property
    def gimbal_aim(self) -> GimbalAim | None:
        return self._aim

    @property
    def status(self) -> str:
        return f"pointing the gimbal {direction_text(self._aim)}"
