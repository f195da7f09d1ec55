"""Tracks of several vehicles that are one object."""

from __future__ import annotations

from typing import Any

import pytest

from companion.dashboard.merge import Sighting, merged
from companion.geometry.geodesy import latitude_longitude, north_east

HOME = (47.3977, 8.5456)


def seen(
    vehicle: str,
    track: int,
    north_m: float,
    east_m: float = 0.0,
    sigma_m: float = 0.5,
    name: str = "car",
    east_sigma_m: float | None = None,
) -> Sighting:
    variances = sigma_m**2, 0.0, (sigma_m if east_sigma_m is None else east_sigma_m) ** 2
    return Sighting(vehicle, track, name, *latitude_longitude(HOME, north_m, east_m), variances)


def groups(*sightings: Sighting) -> list[list[tuple[str, int]]]:
    return sorted(sorted((one.vehicle, one.track_id) for one in seen.sightings) for seen in merged(sightings))


def test_near_tracks_of_two_vehicles_are_one_object() -> None:
    # The gate is 99 %: sqrt(9.2) sigma of both errors together, 3.03 * sqrt(0.5) = 2.14 m
    assert groups(seen("a", 1, 0.0), seen("b", 5, 2.13)) == [[("a", 1), ("b", 5)]]
    assert groups(seen("a", 1, 0.0), seen("b", 5, 2.16)) == [[("a", 1)], [("b", 5)]]
    assert groups(seen("a", 1, 0.0), seen("b", 5, 5.0, sigma_m=2.0)) == [[("a", 1), ("b", 5)]]


def test_gate_has_the_shape_of_the_errors() -> None:
    long: dict[str, Any] = {"sigma_m": 3.0, "east_sigma_m": 0.3}
    assert len(groups(seen("a", 1, 0.0), seen("b", 5, 8.0, 0.0, **long))) == 1
    assert len(groups(seen("a", 1, 0.0), seen("b", 5, 0.0, 8.0, **long))) == 2


def test_other_class_or_same_vehicle_is_another_object() -> None:
    assert len(groups(seen("a", 1, 0.0), seen("b", 5, 0.0, name="person"))) == 2
    assert len(groups(seen("a", 1, 0.0), seen("a", 2, 0.1))) == 2


def test_nearest_tracks_are_joined_first() -> None:
    found = groups(seen("a", 1, 0.0), seen("a", 2, 2.0), seen("b", 5, 1.8), seen("b", 6, 0.1))
    assert found == [[("a", 1), ("b", 6)], [("a", 2), ("b", 5)]]


def test_three_vehicles_join_only_if_all_are_near() -> None:
    assert groups(seen("a", 1, 0.0), seen("b", 2, 1.0), seen("c", 3, 2.0)) == [[("a", 1), ("b", 2), ("c", 3)]]
    chain = groups(seen("a", 1, 0.0), seen("b", 2, 2.0), seen("c", 3, 4.2))
    assert chain == [[("a", 1), ("b", 2)], [("c", 3)]]


def test_position_is_weighted_by_the_range_errors() -> None:
    (found,) = merged([seen("a", 1, 0.0, 10.0, sigma_m=0.5), seen("b", 2, 1.0, 10.0, sigma_m=1.0)])
    assert found.class_name == "car"
    place = north_east(HOME, (found.latitude_deg, found.longitude_deg))
    assert place == pytest.approx((0.2, 10.0), abs=0.01)  # weights 4 and 1
    assert merged([]) == []
