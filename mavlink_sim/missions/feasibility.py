"""PX4's checks of a plan before it is flown, and the texts of what they find."""

from __future__ import annotations

import math

from mavlink_sim.missions import items as mission_items
from mavlink_sim.missions.geofence import Geofence
from mavlink_sim.missions.items import MissionItem
from mavlink_sim.physics.geography import LocalFrame
from mavlink_sim.physics.rotations import Vector
from mavlink_sim.px4.parameters import Parameters

# Commands that the transfer accepts but no mission may have: CONDITION_DELAY, CONDITION_DISTANCE and this
# one.
_NOT_FLYABLE = frozenset({112, 114, mission_items.FENCE_RETURN_POINT})
_VTOL = frozenset({mission_items.VTOL_TAKEOFF, mission_items.VTOL_LAND, mission_items.VTOL_TRANSITION})
# Items that count as positions in PX4's search for "the first item with a position".
_COUNTED_AS_POSITIONS = mission_items.POSITION_COMMANDS | {
    mission_items.RETURN_TO_LAUNCH,
    mission_items.GATE,
    mission_items.GRIPPER,
    mission_items.WINCH,
    mission_items.AUTOTUNE,
    mission_items.ARM_DISARM,
}
BOTH_OR_NEITHER = (4, 5)  # MIS_TKO_LAND_REQ


def complaints(
    items: tuple[MissionItem, ...],
    parameters: Parameters,
    fence: Geofence,
    home: Vector,
    frame: LocalFrame,
    *,
    landed: bool,
) -> tuple[bool, list[str]]:
    """Whether the mission may be flown, and PX4's texts about it.

    A far first waypoint is only a warning (as in PX4 v1.16).
    """
    if not items:
        return False, []
    parameters.use("MIS_DIST_1WP", "MIS_TKO_LAND_REQ")
    said: list[str] = []
    for index, item in enumerate(items):
        broken = _broken_item(index, item, landed=landed)
        if broken:
            return False, [*said, broken]
    distant = _far_first_waypoint(items, parameters, home, frame)
    failures = [
        *_takeoffs(items, home, frame),
        *(
            ["Mission rejected: Mission contains VTOL items but vehicle is not a VTOL\t"]
            if _vtol(items)
            else []
        ),
        *_required_ends(items, int(parameters.number("MIS_TKO_LAND_REQ")), landed=landed),
    ]
    outside = _outside_fence(items, fence, home, frame)
    failures += outside
    return not failures, [*distant, *failures]


def _broken_item(index: int, item: MissionItem, *, landed: bool) -> str | None:
    if item.command in _NOT_FLYABLE:
        return f"Mission rejected: item {index + 1}: unsupported cmd: {item.command}\t"
    if index == 0 and item.command == mission_items.LAND and landed:
        return "Mission rejected: starts with landing\t"
    return None


def _vtol(items: tuple[MissionItem, ...]) -> bool:
    return any(item.command in _VTOL for item in items)


def _far_first_waypoint(
    items: tuple[MissionItem, ...], parameters: Parameters, home: Vector, frame: LocalFrame
) -> list[str]:
    limit = parameters.number("MIS_DIST_1WP")
    first = next((item for item in items if item.has_position), None)
    if limit <= 0.0 or first is None:
        return []
    away = math.dist(first.local_position(home, frame)[:2], home[:2])
    if not limit <= away < math.inf:
        return []
    return [f"First waypoint far away from home: {int(away)}m. Correct mission loaded?\t"]


def _takeoffs(items: tuple[MissionItem, ...], home: Vector, frame: LocalFrame) -> list[str]:
    after_position = False
    for item in items:
        if item.command in (mission_items.TAKEOFF, mission_items.VTOL_TAKEOFF):
            if not home[2] - item.local_position(home, frame)[2] > 0.0:
                return ["Mission rejected: Takeoff altitude below home altitude!\t"]
            if after_position:
                return ["Mission rejected: takeoff not first waypoint item\t"]
        after_position = after_position or item.command in _COUNTED_AS_POSITIONS
    return []


def _required_ends(items: tuple[MissionItem, ...], required: int, *, landed: bool) -> list[str]:
    """MIS_TKO_LAND_REQ: 1 take-off, 2 landing, 3 both, 4 both or neither, 5 like 4, in the air a landing."""
    takeoff = any(item.command in (mission_items.TAKEOFF, mission_items.VTOL_TAKEOFF) for item in items)
    landing = any(item.command == mission_items.LAND for item in items)
    if required == 1 and not takeoff:
        return ["Mission rejected: Takeoff waypoint required.\t"]
    if required == 2 and not landing:
        return ["Mission rejected: Landing waypoint/pattern required.\t"]
    if required == 3 and not (takeoff and landing):
        return ["Mission rejected: Takeoff or Landing item missing.\t"]
    if required == 5 and not landed:
        return [] if landing else ["Mission rejected: Landing waypoint/pattern required."]
    if required in BOTH_OR_NEITHER and takeoff != landing:
        if takeoff:
            return ["Mission rejected: Add Landing item or remove Takeoff.\t"]
        return ["Mission rejected: Add Takeoff item or remove Landing.\t"]
    return []


def _outside_fence(
    items: tuple[MissionItem, ...], fence: Geofence, home: Vector, frame: LocalFrame
) -> list[str]:
    for index, item in enumerate(items):
        if item.has_position and fence.breaches(item.local_position(home, frame), home):
            return [f"Geofence violation for waypoint {index + 1}\t"]
    return []
