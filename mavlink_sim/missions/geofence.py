"""The geofence: polygons and circles to stay in or out of, and the greatest distances from home.

All positions are local NED metres; the polygon test counts crossings of a ray (even-odd rule).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

from mavlink_sim.missions import items as mission_items
from mavlink_sim.missions.items import MissionItem
from mavlink_sim.physics.geography import LocalFrame
from mavlink_sim.physics.rotations import Vector
from mavlink_sim.px4.parameters import Parameters

Point = tuple[float, float]  # north, east, metres

# PX4's text of each kind of breach; the health report sends them without the usual tab.
TOO_FAR = "Geofence: exceeding maximum distance to Home"
TOO_HIGH = "Geofence: exceeding maximum altitude above Home"
OUTSIDE = "Geofence: approaching or outside geofence"


class Action(IntEnum):
    """GF_ACTION."""

    NONE = 0
    WARN = 1
    HOLD = 2
    RETURN = 3
    TERMINATE = 4
    LAND = 5


@dataclass(frozen=True, slots=True)
class Area:
    """A polygon (`vertices`) or, with `radius_m`, a circle around the one vertex.

    `inclusion`: the vehicle must stay inside, else outside.
    """

    vertices: tuple[Point, ...]
    inclusion: bool
    radius_m: float | None = None

    def allows(self, point: Point) -> bool:
        """Whether the vehicle may be there."""
        if self.radius_m is None:
            return inside_polygon(self.vertices, point) == self.inclusion
        return (math.dist(self.vertices[0], point) < self.radius_m) == self.inclusion


def inside_polygon(vertices: Sequence[Point], point: Point) -> bool:
    """Whether a point is inside a polygon that does not cross itself; on the edge the result is undefined.

    The crossing test of W. R. Franklin (PNPOLY). Fewer than three vertices contain no point.
    """
    north, east = point
    inside = False
    last_north, last_east = vertices[-1] if vertices else (0.0, 0.0)
    for vertex_north, vertex_east in vertices:
        if (vertex_east >= east) != (last_east >= east):
            share = (east - vertex_east) / (last_east - vertex_east)
            if north <= vertex_north + share * (last_north - vertex_north):
                inside = not inside
        last_north, last_east = vertex_north, vertex_east
    return inside


def areas_of(items: Sequence[MissionItem], frame: LocalFrame) -> list[Area]:
    """The areas of an uploaded fence. Vertices that are missing at its end are left out."""
    areas: list[Area] = []
    index = 0
    while index < len(items):
        item = items[index]
        circle = item.command in (mission_items.FENCE_CIRCLE_INCLUSION, mission_items.FENCE_CIRCLE_EXCLUSION)
        count = 1
        if item.command in mission_items.FENCE_POLYGONS:
            count = max(int(item.parameters[0]), 1)
        if circle or item.command in mission_items.FENCE_POLYGONS:
            inclusion = item.command in (
                mission_items.FENCE_CIRCLE_INCLUSION,
                mission_items.FENCE_POLYGON_INCLUSION,
            )
            vertices = tuple(_point(vertex, frame) for vertex in items[index : index + count])
            areas.append(Area(vertices, inclusion, item.parameters[0] if circle else None))
        index += count
    return areas


def _point(item: MissionItem, frame: LocalFrame) -> Point:
    north, east, _ = frame.local(item.parameters[4], item.parameters[5], 0.0)
    return north, east


class Geofence:
    """The limits of the vehicle's position: uploaded areas and GF_MAX_HOR_DIST, GF_MAX_VER_DIST from home."""

    def __init__(self, parameters: Parameters, frame: LocalFrame) -> None:
        self._parameters = parameters
        self._frame = frame
        self._areas: list[Area] = []

    @property
    def action(self) -> Action:
        """GF_ACTION; an unknown number warns, as in PX4."""
        value = int(self._parameters.number("GF_ACTION"))
        return Action(value) if value in tuple(Action) else Action.WARN

    def load(self, items: Sequence[MissionItem], home: Vector | None, flying_at: Vector | None) -> list[str]:
        """Load a new fence; areas that home or the flying vehicle breaches at once are left out.

        Args:
            home: None before there is one.
            flying_at: the vehicle's position, None on the ground.

        Returns PX4's text for each area left out.
        """
        self._areas = []
        complaints = []
        for area in areas_of(items, self._frame):
            home_allowed = home is None or area.allows(home[:2])
            here_allowed = flying_at is None or self.action is Action.NONE or area.allows(flying_at[:2])
            if not home_allowed:
                complaints.append("Geofence invalid, doesn't contain Home position\t")
            if not here_allowed:
                complaints.append("Geofence invalid, doesn't contain current vehicle position\t")
            if home_allowed and here_allowed:
                self._areas.append(area)
        return complaints

    def breaches(self, point: Vector, home: Vector | None) -> list[str]:
        """PX4's text for each limit that a position breaches; empty where the vehicle may be there."""
        found = []
        farthest = self._parameters.number("GF_MAX_HOR_DIST")
        highest = self._parameters.number("GF_MAX_VER_DIST")
        if home is not None and farthest > 0.0 and math.dist(point[:2], home[:2]) >= farthest:
            found.append(TOO_FAR)
        if home is not None and highest > 0.0 and home[2] - point[2] >= highest:
            found.append(TOO_HIGH)
        if not all(area.allows(point[:2]) for area in self._areas):
            found.append(OUTSIDE)
        return found

    def allows_goal(self, point: Vector, home: Vector | None) -> bool:
        """Whether a command may send the vehicle there; always, if GF_ACTION does not more than warn."""
        return self.action in (Action.NONE, Action.WARN) or not self.breaches(point, home)
