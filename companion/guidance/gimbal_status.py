"""The gimbal's control and mounting as behaviours see it, and the check of gimbal requirements."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from companion.vehicle.state import VehicleState


@dataclass(frozen=True, slots=True)
class GimbalStatus:
    """Control and mounting of the gimbal.

    Attributes:
        carries_camera: the steering camera is mounted on it.
        direction_fault: why that camera's direction is unknown; empty: it is known, or it has no gimbal.
        controlled_by: another owner of primary control, which is not displaced; empty: none.
        problem: why the gimbal is not moved any more for the active behaviour; empty: it is.
        camera_pitch_rad: pitch of that camera above the gimbal's axis.
    """

    carries_camera: bool = False
    direction_fault: str = ""
    controlled_by: str = ""
    problem: str = ""
    camera_pitch_rad: float = 0.0


NO_GIMBAL = GimbalStatus()


def missing_gimbal(
    state: VehicleState, now_ns: int, status: GimbalStatus, pitches_rad: Sequence[float]
) -> list[str]:
    """What is missing before the gimbal can be moved, in words.

    Args:
        pitches_rad: pitches it must reach, above the horizon.
    """
    gimbal = state.gimbal
    if gimbal is None:
        return ["a gimbal (gimbal manager not responding)"]
    missing = []
    if (why := gimbal.why_not_looking(now_ns)) is not None:
        missing.append(f"the gimbal's attitude ({why})")
    if not gimbal.control_known(now_ns):
        missing.append("the gimbal's primary control (not reported by its manager)")
    elif status.controlled_by:
        missing.append(f"control of the gimbal ({status.controlled_by} has it and must release it)")
    beyond = [pitch for pitch in pitches_rad if not gimbal.reaches(pitch)]
    if beyond:
        wanted = " and ".join(f"{math.degrees(pitch):.0f}°" for pitch in beyond)
        low, high = math.degrees(gimbal.lowest_pitch_rad), math.degrees(gimbal.highest_pitch_rad)
        missing.append(f"a gimbal that pitches to {wanted} (its range is {low:.0f}° to {high:.0f}°)")
    return missing
