"""A client of the mission protocol for vehicles in lockstep, and short ways to write items."""

from __future__ import annotations

import math
from typing import Any

from mavlink_sim.wire.messages import dialect
from tests.mavlink_sim.conftest import SIH_FRAME, SimHarness

NAN = math.nan
COMPANION = (1, 191)


def item(
    command: int,
    position: tuple[float, float, float] | None = None,
    *parameters: float,
    frame: int | None = None,
    autocontinue: int = 1,
    plan: int = 0,
) -> dict[str, Any]:
    """An item. `position`: (north, east, height above home) metres; without it MAV_FRAME_MISSION.

    `parameters`: 1 to 4, then 5 to 7 for an item without a position.
    """
    values = [*parameters, *([0.0] * 7)][:7]
    x, y, z = round(values[4]), round(values[5]), float(values[6])
    if position is not None:
        latitude, longitude, _ = SIH_FRAME.geographic((position[0], position[1], 0.0))
        x, y, z = round(latitude * 1e7), round(longitude * 1e7), position[2]
    if frame is None:
        frame = 2 if position is None else 6
    return {
        "frame": frame,
        "command": command,
        "autocontinue": autocontinue,
        **{f"param{index}": value for index, value in enumerate(values[:4], start=1)},
        "x": x,
        "y": y,
        "z": z,
        "mission_type": plan,
    }


def waypoint(north: float, east: float, height: float, *parameters: float) -> dict[str, Any]:
    return item(16, (north, east, height), *(parameters or (0.0, 0.0, 0.0, NAN)))


def takeoff(height: float) -> dict[str, Any]:
    return item(22, (0.0, 0.0, height), 0, 0, 0, NAN)


def land(north: float = 0.0, east: float = 0.0, precision: int = 0) -> dict[str, Any]:
    return item(21, (north, east, 0.0), 0, precision, 0, NAN)


RETURN = item(20)


def polygon(vertices: list[tuple[float, float]], inclusion: bool = True) -> list[dict[str, Any]]:
    """A fence polygon with vertices (north, east)."""
    command = 5001 if inclusion else 5002
    return [item(command, (*vertex, 0.0), len(vertices), frame=0, plan=1) for vertex in vertices]


def circle(north: float, east: float, radius: float, inclusion: bool = True) -> dict[str, Any]:
    return item(5003 if inclusion else 5004, (north, east, 0.0), radius, frame=0, plan=1)


def rally(north: float, east: float, height: float = 0.0, frame: int = 3) -> dict[str, Any]:
    return item(5100, (north, east, height), frame=frame, plan=2)


def message(sequence: int, fields: dict[str, Any], current: int = 0) -> Any:
    """MISSION_ITEM_INT of an item."""
    return dialect.MAVLink_mission_item_int_message(1, 1, sequence, current=current, **fields)


def newest(harness: SimHarness, kind: str, before: int) -> Any:
    """Wait for the message of a kind after the `before`th."""
    if len(harness.received(kind)) <= before:
        harness.until(lambda: len(harness.received(kind)) > before, 1.0)
    return harness.received(kind)[before]


def upload(harness: SimHarness, items: list[dict[str, Any]], plan: int = 0, current: int = 0) -> int:
    """Upload a plan; the MAV_MISSION_RESULT."""
    requests = len(harness.received("MISSION_REQUEST_INT"))
    acks = len(harness.received("MISSION_ACK"))
    harness.send(dialect.MAVLink_mission_count_message(1, 1, len(items), plan))
    for sequence, fields in enumerate(items):
        request = newest(harness, "MISSION_REQUEST_INT", requests + sequence)
        assert (request.seq, request.mission_type) == (sequence, plan)
        assert (request.target_system, request.target_component) == COMPANION
        harness.send(message(sequence, fields, int(plan == 0 and sequence == current)))
        if len(harness.received("MISSION_ACK")) > acks:
            break
    ack = newest(harness, "MISSION_ACK", acks)
    assert ack.mission_type == plan
    return int(ack.type)


def download(harness: SimHarness, plan: int = 0) -> list[Any]:
    """The MISSION_ITEM_INTs on board."""
    counts = len(harness.received("MISSION_COUNT"))
    harness.send(dialect.MAVLink_mission_request_list_message(1, 1, plan))
    count = newest(harness, "MISSION_COUNT", counts)
    found = []
    for sequence in range(count.count):
        items = len(harness.received("MISSION_ITEM_INT"))
        harness.send(dialect.MAVLink_mission_request_int_message(1, 1, sequence, plan))
        found.append(newest(harness, "MISSION_ITEM_INT", items))
    harness.send(dialect.MAVLink_mission_ack_message(1, 1, 0, plan))
    return found


def reached(harness: SimHarness) -> list[int]:
    """The items reached, in order, repetitions left out."""
    found: list[int] = []
    for received in harness.received("MISSION_ITEM_REACHED"):
        if found[-1:] != [received.seq]:
            found.append(received.seq)
    return found


def listen(harness: SimHarness) -> None:
    """A ground station on the second link, so that status texts are sent."""
    harness.heartbeats.append(("gcs", (245, 190), 6))
    harness.fly(1.1)
