"""Which tracks of several vehicles are one object."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass

from companion.geometry.geodesy import latitude_longitude, north_east

MARGIN_M = 1.0
"""For the positions of the vehicles themselves."""
UNKNOWN_SIGMA_M = 1.0


@dataclass(frozen=True, slots=True)
class Sighting:
    """A confirmed track of a vehicle. Degrees, WGS 84; `sigma_m`: one sigma of its range, None: unknown."""

    vehicle: str
    track_id: int
    class_name: str
    latitude_deg: float
    longitude_deg: float
    sigma_m: float | None = None

    @property
    def variance_m2(self) -> float:
        """Square of the range error."""
        return (UNKNOWN_SIGMA_M if self.sigma_m is None else max(self.sigma_m, 0.01)) ** 2


@dataclass(frozen=True, slots=True)
class SeenObject:
    """An object. Degrees, WGS 84: the mean of its sightings, weighted by their inverse variance."""

    class_name: str
    latitude_deg: float
    longitude_deg: float
    sightings: tuple[Sighting, ...]


def merged(sightings: Iterable[Sighting]) -> list[SeenObject]:
    """Return the objects that the vehicles see.

    Two tracks of different vehicles are one object if their classes are equal and they are at most two sigma
    of both range errors together plus `MARGIN_M` apart. The nearest are joined first. Tracks of one vehicle
    are different objects, so an object has at most one track of each vehicle, and all its tracks are within
    that distance of each other.
    """
    of_class: dict[str, list[Sighting]] = defaultdict(list)
    for sighting in sightings:
        of_class[sighting.class_name].append(sighting)
    return [
        _object(name, origin, group)
        for name, alike in of_class.items()
        for origin in [(alike[0].latitude_deg, alike[0].longitude_deg)]
        for group in _groups([(*_place(origin, one), one) for one in alike])
    ]


_Placed = tuple[float, float, Sighting]
"""Metres north and east, sighting."""


def _place(origin_deg: tuple[float, float], one: Sighting) -> tuple[float, float]:
    return north_east(origin_deg, (one.latitude_deg, one.longitude_deg))


def _groups(placed: list[_Placed]) -> list[list[_Placed]]:
    # Vehicle → its sighting.
    group_of = {index: {one[2].vehicle: one} for index, one in enumerate(placed)}
    pairs = sorted(
        (math.dist(one[:2], other[:2]), first, second)
        for first, one in enumerate(placed)
        for second, other in enumerate(placed[:first])
        if _one_object(one, other)
    )
    for _, first, second in pairs:
        group, joining = group_of[first], group_of[second]
        if group.keys().isdisjoint(joining) and all(
            _one_object(one, other) for one in group.values() for other in joining.values()
        ):
            group |= joining
            for index, joined in group_of.items():
                if joined is joining:
                    group_of[index] = group
    return [list(group.values()) for group in {id(group): group for group in group_of.values()}.values()]


def _one_object(one: _Placed, other: _Placed) -> bool:
    reach_m = 2.0 * math.sqrt(one[2].variance_m2 + other[2].variance_m2) + MARGIN_M
    return one[2].vehicle != other[2].vehicle and math.dist(one[:2], other[:2]) <= reach_m


def _object(class_name: str, origin_deg: tuple[float, float], group: list[_Placed]) -> SeenObject:
    weights = [1.0 / one[2].variance_m2 for one in group]
    north_m = sum(weight * one[0] for weight, one in zip(weights, group, strict=True)) / sum(weights)
    east_m = sum(weight * one[1] for weight, one in zip(weights, group, strict=True)) / sum(weights)
    sightings = sorted((one[2] for one in group), key=lambda one: (one.vehicle, one.track_id))
    return SeenObject(class_name, *latitude_longitude(origin_deg, north_m, east_m), tuple(sightings))
