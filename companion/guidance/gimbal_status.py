"""What behaviours see of the gimbal besides its state, and what of it is missing before they begin."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from companion.vehicle.state import VehicleState


@dataclass(frozen=True, slots=True)
class GimbalStatus:
    """How the gimbal stands to what flies.

    Attributes:
        carries_camera: the camera that steers sits on it.
        undirected: why it is not known where that camera looks; empty: it is, or it sits on no gimbal.
        elsewhere: who else has control of the gimbal; empty: nobody from whom it may not be taken.
        problem: why it is not moved any more for what flies now; empty: it is.
        camera_pitch_rad: how far above the gimbal's axis that camera looks.
    """

    carries_camera: bool = False
    undirected: str = ""
    elsewhere: str = ""
    problem: str = ""
    camera_pitch_rad: float = 0.0


NO_GIMBAL = GimbalStatus()


def missing_gimbal(
    state: VehicleState, now_ns: int, sight: GimbalStatus, pitches_rad: Sequence[float]
) -> list[str]:
    """What is missing before a gimbal can be moved, in words.

    Args:
        pitches_rad: above the horizon; what it must reach.
    """
    gimbal = state.gimbal
    if gimbal is None:
        return ["a gimbal (none answers)"]
    missing = []
    if (why := gimbal.why_not_looking(now_ns)) is not None:
        missing.append(f"a gimbal that tells where it looks ({why})")
    if not gimbal.control_known(now_ns):
        missing.append("to know who has control of it (its manager does not tell)")
    elif sight.elsewhere:
        missing.append(f"control of the gimbal ({sight.elsewhere} has it, and must give it back)")
    beyond = [pitch for pitch in pitches_rad if not gimbal.reaches(pitch)]
    if beyond:
        wanted = " and ".join(f"{math.degrees(pitch):.0f}°" for pitch in beyond)
        low, high = math.degrees(gimbal.lowest_pitch_rad), math.degrees(gimbal.highest_pitch_rad)
        missing.append(f"a gimbal that pitches to {wanted} (it goes from {low:.0f}° to {high:.0f}°)")
    return missing
