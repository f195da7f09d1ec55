"""Which objects of several vehicles are one."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass

from companion.geometry.gate import GATE, squared_distance
from companion.geometry.geodesy import latitude_longitude, north_east


@dataclass(frozen=True, slots=True)
class Sighting:
    """A vehicle's confirmed object. Degrees, WGS 84.

    Attributes:
        track_id: its newest.
        covariance_m2: of its position: north, north with east, east; the vehicle's own error included.
    """

    vehicle: str
    track_id: int
    class_name: str
    latitude_deg: float
    longitude_deg: float
    covariance_m2: tuple[float, float, float]

    @property
    def variance_m2(self) -> float:
        """Mean of the two axes."""
        return (self.covariance_m2[0] + self.covariance_m2[2]) / 2.0


@dataclass(frozen=True, slots=True)
class SeenObject:
    """An object. Degrees, WGS 84: the mean of its sightings, weighted by their inverse variance."""

    class_name: str
    latitude_deg: float
    longitude_deg: float
    sightings: tuple[Sighting, ...]


def merged(sightings: Iterable[Sighting]) -> list[SeenObject]:
    """Return the objects that the vehicles see.

    Those of different vehicles are one if their classes are equal and their distance is inside the gate of a
    vehicle's own objects, with both covariances. The best fits are joined first. Objects of one vehicle are
    different ones, so each has at most one of each vehicle, and all of these are inside the gate.
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
        (squared, first, second)
        for first, one in enumerate(placed)
        for second, other in enumerate(placed[:first])
        if (squared := _squared(one, other)) <= GATE
    )
    for _, first, second in pairs:
        group, joining = group_of[first], group_of[second]
        if group.keys().isdisjoint(joining) and all(
            _squared(one, other) <= GATE for one in group.values() for other in joining.values()
        ):
            group |= joining
            for index, joined in group_of.items():
                if joined is joining:
                    group_of[index] = group
    return [list(group.values()) for group in {id(group): group for group in group_of.values()}.values()]


def _squared(one: _Placed, other: _Placed) -> float:
    """Squared Mahalanobis distance; infinite between those of one vehicle."""
    if one[2].vehicle == other[2].vehicle:
        return math.inf
    (nn, ne, ee), (nn2, ne2, ee2) = one[2].covariance_m2, other[2].covariance_m2
    return squared_distance(one[0] - other[0], one[1] - other[1], (nn + nn2, ne + ne2, ee + ee2))


def _object(class_name: str, origin_deg: tuple[float, float], group: list[_Placed]) -> SeenObject:
    weights = [1.0 / one[2].variance_m2 for one in group]
    north_m = sum(weight * one[0] for weight, one in zip(weights, group, strict=True)) / sum(weights)
    east_m = sum(weight * one[1] for weight, one in zip(weights, group, strict=True)) / sum(weights)
    sightings = sorted((one[2] for one in group), key=lambda one: (one.vehicle, one.track_id))
    return SeenObject(class_name, *latitude_longitude(origin_deg, north_m, east_m), tuple(sightings))
