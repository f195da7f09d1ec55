import math
from collections.abc import Sequence
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from companion.guidance.behaviours.seek import SearchBehaviour, Seek
from companion.guidance.command import NO_CONTEXT
from companion.guidance.grammar import parse
from companion.guidance.objects.target import DOUBTED
from companion.guidance.search_pattern import Footprint, expanding_square, lawnmower
from tests.companion.guidance.guidance_harness import Flight, assert_succeeded, known
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle, SeenObject


def beside(point: tuple[float, float], points: Sequence[tuple[float, float]]) -> float:
    """Chebyshev distance of a point from a polyline."""
    nearest = max(abs(p - q) for p, q in zip(point, points[0], strict=True))
    for start, end in pairwise(points):
        # Legs are north or east: the nearest point is computed per axis.
        near = [min(max(p, min(a, b)), max(a, b)) for p, a, b in zip(point, start, end, strict=True)]
        nearest = min(nearest, max(abs(p - q) for p, q in zip(point, near, strict=True)))
    return nearest


unit = st.floats(-1.0, 1.0)


@given(st.floats(1, 100), st.floats(2, 40), unit, unit)
def test_square_covers_its_area_within_half_a_spacing(
    radius: float, spacing: float, north: float, east: float
) -> None:
    points = expanding_square(radius, spacing)
    assert beside((north * radius, east * radius), points) <= spacing / 2 + 1e-6
    assert all(max(map(abs, point)) <= radius + spacing / 2 + 1e-6 for point in points)


@given(st.floats(1, 200), st.floats(1, 200), st.floats(2, 40), unit, unit)
def test_lawnmower_covers_its_area_within_half_a_spacing(
    width: float, height: float, spacing: float, north: float, east: float
) -> None:
    points = lawnmower(width, height, spacing)
    assert beside((north * height / 2, east * width / 2), points) <= spacing / 2 + 1e-6
    assert all(abs(p[0]) <= height / 2 + 1e-9 and abs(p[1]) <= width / 2 + 1e-9 for p in points)


@settings(max_examples=30)
@given(st.floats(0.2, 2.5), st.floats(-0.5, 1.5), st.floats(1, 60))
def test_spacing_is_less_than_the_footprint(fov: float, depression: float, height: float) -> None:
    spacing = Footprint(fov, depression).spacing_m(height)
    assert 1.0 <= spacing <= max(1.0, 2 * 25.0 * math.tan(fov / 2))
    assert Footprint(fov, depression).spacing_m(height * 2) >= spacing


def test_steep_camera_needs_narrow_strips() -> None:
    down = Footprint(math.radians(80), math.radians(90)).spacing_m(10.0)
    assert down == pytest.approx(0.8 * 2 * 10 * math.tan(math.radians(40)))
    assert Footprint(math.radians(80), 0.0).spacing_m(10.0) == pytest.approx(
        0.8 * 2 * 25 * math.tan(math.radians(40))
    )


@pytest.mark.parametrize(
    "text", ["pattern=square radius=12 spacing=8", "pattern=lawnmower width=24 height=16 spacing=8"]
)
def test_search_finds_an_object_hidden_from_the_centre(text: str) -> None:
    car = SeenObject("car", 6.0, -9.0, track_id=4)

    def each(seconds: float, vehicle: KinematicVehicle) -> None:
        # Small objects are seen only from near.
        car.visible = math.dist((car.north, car.east), vehicle.position[:2]) < 9.0

    vehicle = KinematicVehicle()
    outcome = assert_succeeded(
        Flight(parse(f"seek car {text}").build(NO_CONTEXT), vehicle, [car]).run(240.0, each)
    )
    bearing = math.atan2(car.east - vehicle.position[1], car.north - vehicle.position[0])
    assert abs(math.remainder(bearing - vehicle.yaw_rad, math.tau)) < math.radians(5)
    assert outcome.reason.startswith("found a car")


def test_search_covers_the_area_and_reports_the_reason() -> None:
    doubtful = SeenObject("car", 6.0, 2.0, trusted=False)
    flight = Flight(
        SearchBehaviour(Seek("car", pattern="square", radius_m=8.0, spacing_m=8.0)),
        KinematicVehicle(),
        [doubtful],
    )
    outcome = known(flight.run(120.0))
    assert outcome.reason.endswith(DOUBTED)


def test_search_without_footprint_needs_spacing() -> None:
    outcome = known(
        Flight(SearchBehaviour(Seek("car", pattern="square", radius_m=30.0)), KinematicVehicle()).run(1.0)
    )
    assert outcome.reason.endswith("set spacing")
