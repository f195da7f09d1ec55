import math
from typing import Any

import pytest

from companion.guidance.grammar import parse
from tests.companion.guidance.guidance_harness import assert_failed, flown
from tests.companion.guidance.kinematic_vehicle import SeenObject


def moving(speed_mps: float, *hidden_s: float) -> SeenObject:
    """A car that drives ahead, unseen from the first of these seconds to the second."""
    begin, end = hidden_s or (math.inf, math.inf)

    def then(seconds: float) -> dict[str, Any]:
        return {"north": 12.0 + speed_mps * seconds, "visible": not begin <= seconds < end}

    return SeenObject("car", 12.0, 0.0, track_id=1, track_score=0.8, then=then)


@pytest.mark.parametrize("bearing", ["here", "course"])
def test_follow_keeps_its_distance_through_an_occlusion(bearing: str) -> None:
    flight, outcome = flown(f"follow car distance=8 bearing={bearing}", moving(3.0, 18.0, 19.5), seconds=30.0)
    assert outcome is None
    assert flight.distance_m() == pytest.approx(8.0, abs=0.8)
    assert flight.behaviour.status.startswith("following the car")
    assert flight.behaviour.status.endswith(" m away")


OTHER = SeenObject("car", 20.0, 4.0, track_id=2, track_score=0.9)


@pytest.mark.parametrize("others", [[], [OTHER]], ids=["alone", "beside another one"])
def test_follow_ends_when_its_object_is_lost(others: list[SeenObject]) -> None:
    speed_mps, occlusion = (0.5, "") if others else (3.0, " occlusion=2")
    _, outcome = flown(f"follow car{occlusion}", moving(speed_mps, 6.0, 99.0), *others, seconds=30.0)
    assert_failed(outcome, "lost the ", "car ")


def test_follow_is_endless_without_a_duration() -> None:
    assert parse("follow car").endless
    assert not parse("follow car duration=10").endless
