"""Behaviours that fly to an object require a means of range estimation."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.guidance.behaviour import BehaviourContext
from companion.guidance.command import NO_CONTEXT
from companion.guidance.grammar import parse
from companion.guidance.objects.ranging import ALL_MEANS, RangeMeans, sees_ground
from companion.guidance.requirements import check_requirements
from tests.companion.guidance.guidance_harness import known
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle
from vision.camera_model import CameraModel

NEEDING = (
    "approach kite",
    "follow kite",
    "orbit kite",
    'patrol "0,0 9,9" classes=kite on_detection=approach',
)
OTHERS = ("seek kite", "orbit", 'patrol "0,0 9,9" classes=kite')


def why(command: str, means: RangeMeans) -> str | None:
    vehicle = KinematicVehicle()
    context = BehaviourContext(vehicle.now_ns, vehicle.state, (), 0.05, True, ranging=means)
    return check_requirements(parse(command).build(NO_CONTEXT), context, None)


@pytest.mark.parametrize("command", NEEDING)
def test_refused_without_any_means_of_ranging(command: str) -> None:
    reason = why(command, RangeMeans(False, False, frozenset({"car"})))
    assert "range to a kite" in known(reason)


@pytest.mark.parametrize(
    "means",
    [
        ALL_MEANS,
        RangeMeans(True, False),
        RangeMeans(False, True),
        RangeMeans(False, False, frozenset({"kite"})),
    ],
)
@pytest.mark.parametrize("command", NEEDING)
def test_any_single_means_is_enough(command: str, means: RangeMeans) -> None:
    assert why(command, means) is None


@pytest.mark.parametrize("command", OTHERS)
def test_other_behaviours_need_no_range(command: str) -> None:
    assert why(command, RangeMeans(False, False)) is None


@pytest.mark.parametrize(("pitch_deg", "seen"), [(-90.0, True), (0.0, True), (29.0, True), (31.0, False)])
def test_camera_sees_the_ground_unless_pitched_up(pitch_deg: float, seen: bool) -> None:
    """80° across are 64° from top to bottom: the lower edge is 32° below the axis."""
    camera = CameraModel.from_horizontal_fov(640, 480, math.radians(80.0))
    assert sees_ground(camera, math.radians(pitch_deg)) is seen


def test_ground_is_seen_by_a_lens_that_folds_at_its_edge() -> None:
    folded = CameraModel(640, 480, 300.0, 300.0, 320.0, 240.0, (-0.8, 0.0, 0.0, 0.0))
    assert not np.isfinite(folded.rays(np.array([[320.0, 479.0]]))).any()
    assert sees_ground(folded, math.radians(-20.0))
    assert not sees_ground(folded, math.radians(60.0))
