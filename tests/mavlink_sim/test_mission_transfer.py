"""The mission protocol, message by message."""

from __future__ import annotations

import math
import struct
from typing import Any

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from mavlink_sim.missions.items import ItemRejectedError, PlanType, item_of, message_of
from mavlink_sim.services.mission_messages import MissionCurrent
from mavlink_sim.wire.messages import dialect, parser
from tests.mavlink_sim.conftest import SimHarness
from tests.mavlink_sim.plan_client import (
    COMPANION,
    RETURN,
    circle,
    download,
    item,
    land,
    listen,
    message,
    newest,
    polygon,
    rally,
    takeoff,
    upload,
    waypoint,
)

NAN = math.nan
SQUARE = [(-50.0, -50.0), (-50.0, 50.0), (50.0, 50.0), (50.0, -50.0)]

# STATUSTEXTs of PX4.
TIMED_OUT = "Mission sync timeout\t"
OTHER_PARTNER = "REJ. MIS ITEM: partner id mismatch\t"
NO_TRANSFER = "IGN MISSION_ITEM: No transfer\t"
NOT_IN_LIST = "WPM: WP CURR CMD: Not in list\t"


@pytest.fixture
def harness() -> SimHarness:
    """A vehicle that is ready at once."""
    return SimHarness(ready_after_s=0.0)


def count(number: int, plan: int = 0, target: tuple[int, int] = (1, 1)) -> Any:
    return dialect.MAVLink_mission_count_message(*target, number, plan)


def test_uploaded_mission_downloaded_as_px4_stores_it(harness: SimHarness) -> None:
    harness.wait_ready()
    plan = [
        takeoff(5.0),
        waypoint(10, 0, 5, 2.5, 1.5, 9.0, -90.0),
        item(178, None, 1, 3, -1),
        item(19, (10, 10, 5), 4, 1, 0, 45),
        item(177, None, 1, 2),
        land(10, 10),
    ]
    assert upload(harness, plan) == 0
    got = download(harness)
    assert [(m.seq, m.command, m.frame, m.current) for m in got] == [
        (0, 22, 6, 1),
        (1, 16, 6, 0),
        (2, 178, 2, 0),
        (3, 19, 6, 0),
        (4, 177, 2, 0),
        (5, 21, 6, 0),
    ]
    assert [(m.x, m.y, m.z) for m in got] == [(i["x"], i["y"], i["z"]) for i in plan]
    # a waypoint keeps its time, radius and heading (from 0 to 360°), and loses its third parameter
    assert (got[1].param1, got[1].param2, got[1].param3, got[1].param4) == (2.5, 1.5, 0.0, 270.0)
    assert got[3].param4 == 1.0  # PX4 returns "leave on a tangent" instead of a heading
    assert (got[4].param1, got[4].param2) == (1.0, 2.0)


@pytest.mark.parametrize(
    ("plan", "items"),
    [
        (
            1,
            [*polygon(SQUARE), *polygon([(90, 90), (90, 99), (99, 90)], inclusion=False), circle(0, 0, 80.0)],
        ),
        (2, [rally(40, 0), rally(0, 40, 3.0)]),
    ],
    ids=["fence", "rally"],
)
def test_fence_and_rally_points_go_there_and_back(harness: SimHarness, plan: int, items: list[Any]) -> None:
    harness.wait_ready()
    assert upload(harness, items, plan) == 0
    got = download(harness, plan)
    assert [(m.command, m.param1, m.x, m.y, m.mission_type) for m in got] == [
        (i["command"], i["param1"], i["x"], i["y"], plan) for i in items
    ]
    assert download(harness, 0) == []


def test_float_items_are_requested_as_floats(harness: SimHarness) -> None:
    harness.wait_ready()
    harness.send(count(2))
    assert newest(harness, "MISSION_REQUEST_INT", 0).seq == 0
    wanted = dialect.MAVLink_mission_item_message(1, 1, 0, 3, 22, 1, 1, 0, 0, 0, NAN, 47.3977, 8.5456, 5, 0)
    harness.send(wanted)
    assert newest(harness, "MISSION_REQUEST", 0).seq == 1
    harness.send(
        dialect.MAVLink_mission_item_message(1, 1, 1, 3, 16, 0, 1, 0, 0, 0, NAN, 47.3978, 8.5456, 5, 0)
    )
    assert newest(harness, "MISSION_ACK", 0).type == 0
    harness.send(dialect.MAVLink_mission_request_list_message(1, 1, 0))
    harness.send(dialect.MAVLink_mission_request_message(1, 1, 0, 0))
    got = newest(harness, "MISSION_ITEM", 0)
    assert (got.frame, got.x) == (3, pytest.approx(47.3977, abs=1e-6))


def test_unanswered_request_repeats_then_aborts(harness: SimHarness) -> None:
    listen(harness)
    harness.send(count(2))
    harness.send(message(0, takeoff(5.0)))
    harness.forget()
    harness.fly(4.5)
    asked = [m.seq for m in harness.received("MISSION_REQUEST_INT")]
    assert asked == [1] * 17  # every 250 ms
    harness.fly(2.0)
    assert TIMED_OUT in harness.texts("gcs")  # on every link, as all of PX4's texts
    assert len(harness.received("MISSION_REQUEST_INT")) <= 20
    assert upload(harness, [takeoff(5.0), RETURN]) == 0


def test_a_lost_acknowledgement_is_sent_again(harness: SimHarness) -> None:
    harness.wait_ready()
    assert upload(harness, [takeoff(5.0), waypoint(5, 0, 5)]) == 0
    harness.send(message(1, waypoint(5, 0, 5)))
    assert [m.type for m in harness.received("MISSION_ACK")] == [0, 0]


def test_item_out_of_sequence_ignored(harness: SimHarness) -> None:
    harness.send(count(2))
    harness.send(message(1, waypoint(5, 0, 5)))
    assert harness.received("MISSION_ACK") == []
    harness.send(message(0, takeoff(5.0)))
    harness.send(message(1, waypoint(5, 0, 5)))
    assert newest(harness, "MISSION_ACK", 0).type == 0


def test_an_item_without_a_transfer_is_an_error(harness: SimHarness) -> None:
    listen(harness)
    harness.send(message(3, waypoint(5, 0, 5)), "gcs", (245, 190))
    harness.fly(0.01)
    assert harness.texts()[-1:] == [OTHER_PARTNER]
    harness.send(count(0), "gcs", (245, 190))
    harness.send(message(3, waypoint(5, 0, 5)), "gcs", (245, 190))
    assert [m.type for m in harness.received("MISSION_ACK", "gcs")] == [0, 1]
    harness.fly(0.01)
    assert harness.texts()[-1:] == [NO_TRANSFER]


@pytest.mark.parametrize(
    ("fields", "plan", "result"),
    [
        (item(16, (0, 0, 5), frame=1), 0, 2),
        (item(16, (0, 0, 5), frame=10), 0, 2),
        (item(183, None, 1, 1500), 0, 3),
        (item(2900, (0, 0, 5)), 0, 3),
        (item(201, None, 3), 0, 6),
        (item(201, (0, 0, 5), 2), 0, 6),
        (item(5001, (0, 0, 0), 4, frame=0), 0, 1),
        (item(5001, (0, 0, 0), 2, frame=0, plan=1), 1, 1),
    ],
    ids=[
        "local frame",
        "terrain frame",
        "servo",
        "unknown with place",
        "roi location without place",
        "roi index with place",
        "fence in a mission",
        "polygon of two",
    ],
)
def test_unsupported_item_ends_upload(
    harness: SimHarness, fields: dict[str, Any], plan: int, result: int
) -> None:
    harness.wait_ready()
    assert upload(harness, [fields, fields], plan) == result
    assert upload(harness, [takeoff(5.0)]) == 0  # the next client is accepted


@pytest.mark.parametrize(("plan", "most"), [(0, 10000), (1, 64), (2, 32)])
def test_too_many_items_refused(harness: SimHarness, plan: int, most: int) -> None:
    harness.send(count(most + 1, plan))
    assert newest(harness, "MISSION_ACK", 0).type == 4
    harness.send(count(most, plan))
    assert newest(harness, "MISSION_REQUEST_INT", 0).seq == 0


@pytest.mark.parametrize(("items", "result"), [(1, 4), (0, 0)])
def test_unknown_plan_type_has_no_space(harness: SimHarness, items: int, result: int) -> None:
    harness.send(count(items, 7))
    ack = newest(harness, "MISSION_ACK", 0)
    assert (ack.type, ack.mission_type) == (result, 7)


def test_one_client_uploads_at_a_time_over_all_links(harness: SimHarness) -> None:
    harness.send(count(2))
    harness.send(count(2), "onboard", (1, 195))
    assert [(m.type, m.target_component) for m in harness.received("MISSION_ACK")] == [(1, 195)]
    harness.send(count(2), "gcs", (245, 190))
    assert [m.type for m in harness.received("MISSION_ACK", "gcs")] == [1]
    harness.send(message(0, takeoff(5.0)))
    harness.send(message(1, RETURN))
    harness.send(count(2), "gcs", (245, 190))
    assert len(harness.received("MISSION_REQUEST_INT", "gcs")) == 1


def test_a_cancelled_upload_leaves_the_old_mission(harness: SimHarness) -> None:
    harness.wait_ready()
    assert upload(harness, [takeoff(5.0)]) == 0
    harness.send(count(5))
    harness.send(message(0, takeoff(9.0)))
    harness.send(dialect.MAVLink_mission_ack_message(1, 1, 15, 0))
    harness.forget()
    harness.fly(1.0)
    assert harness.received("MISSION_REQUEST_INT") == []
    assert [m.z for m in download(harness)] == [5.0]


def test_a_download_asked_out_of_order_ends_with_an_error(harness: SimHarness) -> None:
    harness.wait_ready()
    upload(harness, [takeoff(5.0), waypoint(5, 0, 5), RETURN])
    harness.send(dialect.MAVLink_mission_request_list_message(1, 1, 0))
    harness.send(dialect.MAVLink_mission_request_int_message(1, 1, 0, 0))
    harness.send(dialect.MAVLink_mission_request_int_message(1, 1, 0, 0))  # once more is no error
    harness.send(dialect.MAVLink_mission_request_int_message(1, 1, 2, 0))
    assert [m.seq for m in harness.received("MISSION_ITEM_INT")] == [0, 0]
    assert [m.type for m in harness.received("MISSION_ACK")] == [0, 1]


@pytest.mark.parametrize("kind", [0, 1, 2, 255])
def test_clear_removes_named_plan(harness: SimHarness, kind: int) -> None:
    harness.wait_ready()
    upload(harness, [takeoff(5.0)])
    upload(harness, polygon(SQUARE), 1)
    upload(harness, [rally(30, 0)], 2)
    harness.send(dialect.MAVLink_mission_clear_all_message(1, 1, kind))
    ack = harness.received("MISSION_ACK")[-1]
    assert (ack.type, ack.mission_type) == (0, kind)
    left = [len(download(harness, plan)) for plan in range(3)]
    assert left == [0 if kind in (plan, 255) else full for plan, full in enumerate([1, 4, 1])]


def test_messages_for_others_or_broadcast_ignored(harness: SimHarness) -> None:
    harness.send(count(1, target=(2, 1)))
    harness.send(count(1, target=(0, 0)))
    assert harness.received("MISSION_REQUEST_INT") == harness.received("MISSION_ACK") == []
    harness.send(count(1, target=(1, 0)))
    assert len(harness.received("MISSION_REQUEST_INT")) == 1


def test_set_current_confirmed_by_mission_current(harness: SimHarness) -> None:
    listen(harness)
    harness.wait_ready()
    upload(harness, [takeoff(5.0), waypoint(5, 0, 5), RETURN])
    harness.forget()
    harness.send(dialect.MAVLink_mission_set_current_message(1, 1, 2))
    harness.fly(0.01)
    assert {(m.seq, m.total) for m in harness.received("MISSION_CURRENT")} == {(2, 3)}
    harness.send(dialect.MAVLink_mission_set_current_message(1, 1, 3), "gcs", (245, 190))
    harness.fly(0.01)
    assert harness.texts()[-1] == NOT_IN_LIST
    assert harness.command(224, 1) == [3]  # DO_SET_MISSION_CURRENT is none of PX4's commands


def test_the_same_mission_again_changes_nothing(harness: SimHarness) -> None:
    harness.wait_ready()
    plan = [takeoff(5.0), waypoint(5, 0, 5), RETURN]
    upload(harness, plan)
    harness.send(dialect.MAVLink_mission_set_current_message(1, 1, 2))
    upload(harness, plan)
    assert harness.vehicle.autopilot.navigator.mission.current == 2
    upload(harness, [takeoff(6.0), waypoint(5, 0, 5), RETURN])
    assert harness.vehicle.autopilot.navigator.mission.current == 0


def test_plans_have_identifiers_that_newer_clients_can_read(harness: SimHarness) -> None:
    harness.wait_ready()
    upload(harness, [takeoff(5.0), RETURN])
    identifier = harness.received("MISSION_ACK")[-1].opaque_id
    assert identifier != 0
    harness.send(dialect.MAVLink_mission_request_list_message(1, 1, 0))
    assert harness.received("MISSION_COUNT")[-1].opaque_id == identifier
    harness.fly(1.1)
    assert harness.received("MISSION_CURRENT")[-1].mission_id == identifier
    packed = MissionCurrent(1, 2, 3, 1, 11, 12, 13).pack(parser())
    payload = packed[10:-2].ljust(18, b"\0")  # MAVLink 2 leaves out the zeros at the end
    assert struct.unpack("<HHBBIII", payload) == (1, 2, 3, 1, 11, 12, 13)
    (seen,) = dialect.MAVLink(None).parse_buffer(packed)  # an older client decodes the rest
    assert (seen.seq, seen.total, seen.mission_state) == (1, 2, 3)


floats = st.floats(width=32)
fields = st.fixed_dictionaries(
    {
        "frame": st.sampled_from([0, 1, 2, 3, 5, 6, 10, 255]),
        "command": st.one_of(
            st.integers(0, 65535), st.sampled_from([16, 17, 19, 21, 22, 31, 177, 201, 5001])
        ),
        "autocontinue": st.integers(0, 1),
        "param1": floats,
        "param2": floats,
        "param3": floats,
        "param4": floats,
        "x": st.integers(-(2**31), 2**31 - 1),
        "y": st.integers(-(2**31), 2**31 - 1),
        "z": floats,
        "mission_type": st.just(0),
    }
)


HEAD = {"frame": 0, "command": 21, "autocontinue": 0, "x": 0, "y": 0, "mission_type": 0}
TINY_YAW = {**HEAD, "param1": 0.0, "param2": 0.0, "param3": 0.0, "param4": -1e-45, "z": 0.0}


@settings(max_examples=150, deadline=None)
@given(fields)
@example(TINY_YAW)
def test_any_item_refused_or_round_trips(wanted: dict[str, Any]) -> None:
    try:
        stored = item_of(message(0, wanted))
    except ItemRejectedError:
        return
    for whole in (True, False):
        back = message_of(stored, 0, PlanType.MISSION, COMPANION, whole=whole)
        assert back.pack(parser())
    again = message_of(stored, 0, PlanType.MISSION, COMPANION)
    if stored.command not in (19, 201):  # of these PX4 forgets more
        assert repr(item_of(again).parameters[:4]) == repr(stored.parameters[:4])
