"""Measured on a real PX4's links: messages, data rate, forwarding."""

from __future__ import annotations

import itertools
from collections import Counter

import pytest
from pymavlink.dialects.v20 import common

from mavlink_sim.wire.messages import dialect, parser
from tests.mavlink_sim.conftest import SimHarness, velocity_setpoint

pytestmark = pytest.mark.streams("everything")

GCS = 6
ONBOARD_CONTROLLER = 18
# Messages of PX4 that pip's pymavlink 2.4.50 does not have in its `common` dialect.
UNKNOWN_TO_COMMON = {8, 300, 380, 395, 397, 410, 411, 435, 436}
SIGNATURE_BYTES = 13  # the measured vehicle signed its messages


def names(harness: SimHarness, link: str = "onboard") -> Counter[str]:
    return Counter(item.message.get_type() for _, item in harness.inbox[link])


def test_streams_independent_of_companion_heartbeat() -> None:
    alone, received = SimHarness(["everything"]), SimHarness(["everything"])
    received.heartbeats.append(("onboard", (1, 191), ONBOARD_CONTROLLER))
    for harness in (alone, received):
        harness.wait_ready()
        harness.forget()
        harness.fly(10.0)
    assert names(alone) == names(received)


@pytest.mark.parametrize("flying", [False, True], ids=["disarmed", "in flight"])
def test_the_onboard_link_carries_29_kilobytes_a_second(flying: bool) -> None:
    """Of whole frames with their signatures, as in the recorded flight: 28.7 kB/s before arming."""
    harness = SimHarness(["everything"], noise=True, gusts_mps=None)
    if flying:
        harness.take_off()
    harness.fly(6.0)  # until the last unrequested PARAM_VALUE
    harness.forget()
    harness.fly(20.0)
    codec = parser()
    size = sum(len(item.pack(codec)) + SIGNATURE_BYTES for _, item in harness.inbox["onboard"]) / 20.0
    assert size == pytest.approx(29_000, rel=0.05)


def test_unknown_messages_of_common_dialect_match_px4(harness: SimHarness) -> None:
    harness.take_off()
    harness.command(519, 1)
    codec, reader = parser(), common.MAVLink(None)
    unknown = set()
    for _, item in harness.inbox["onboard"]:
        (message,) = reader.parse_buffer(item.pack(codec))
        if message.get_type().startswith("UNKNOWN_"):
            unknown.add(int(message.get_type().removeprefix("UNKNOWN_")))
    assert {8, 300, 380, 410, 411, 436} <= unknown <= UNKNOWN_TO_COMMON


def test_position_target_global_sent_except_in_offboard(harness: SimHarness) -> None:
    harness.wait_ready()
    assert "POSITION_TARGET_GLOBAL_INT" not in names(harness)  # not on the ground
    harness.take_off(4.0)
    stream = velocity_setpoint(0, 0, 0)
    harness.offboard(stream)
    harness.forget()
    harness.fly(2.0, stream)
    assert "POSITION_TARGET_GLOBAL_INT" not in names(harness)
    for command in (21, 20):
        harness.command(command)
        harness.forget()
        harness.fly(1.0)
        assert 9 <= names(harness)["POSITION_TARGET_GLOBAL_INT"] <= 10


def test_heartbeat_at_1_hz_always(harness: SimHarness) -> None:
    harness.wait_ready()
    harness.forget()
    started = harness.now_s
    harness.command(400, 1)
    harness.command(22, *[float("nan")] * 7)
    harness.fly(9.0)
    stream = velocity_setpoint(0, 0, 0)
    harness.offboard(stream)
    harness.until(lambda: harness.mode == "RTL", 10.0)
    harness.command(21)
    harness.until(lambda: not harness.armed)
    stamps = [stamp for stamp, item in harness.inbox["onboard"] if item.message.get_type() == "HEARTBEAT"]
    assert len(stamps) == pytest.approx(harness.now_s - started, abs=1.01)
    gaps = [later - earlier for earlier, later in itertools.pairwise(stamps)]
    assert min(gaps) == pytest.approx(1.0, abs=0.01)
    assert max(gaps) == pytest.approx(1.0, abs=0.01)


def test_what_a_heartbeat_shows_lags_by_up_to_a_second(harness: SimHarness) -> None:
    harness.wait_ready()
    harness.heartbeat()
    harness.fly(0.02)
    harness.command(400, 1)
    changed = harness.now_s
    assert harness.heartbeat().base_mode == 157
    assert 0.9 < harness.now_s - changed <= 1.0


def test_the_old_request_for_a_data_stream_is_ignored(harness: SimHarness) -> None:
    harness.fly(0.1)
    harness.forget()
    for start in (0, 1):
        harness.send(dialect.MAVLink_request_data_stream_message(1, 1, 0, 50, start))
    harness.fly(2.0)
    assert 196 <= names(harness)["ATTITUDE"] <= 198
    assert 1 <= names(harness)["HEARTBEAT"] <= 2
    assert "COMMAND_ACK" not in names(harness)


def test_timesync_and_ping_are_broadcast_requests(harness: SimHarness) -> None:
    harness.fly(5.0)
    requests = harness.received("TIMESYNC")
    assert len(requests) == pytest.approx(49, abs=1)
    assert all(request.tc1 == 0 and request.ts1 > 0 for request in requests)
    pings = harness.received("PING")
    assert [(ping.target_system, ping.target_component) for ping in pings] == [(0, 0)] * len(pings)
    assert [ping.seq for ping in pings] == list(range(pings[0].seq, pings[0].seq + len(pings)))


def test_ground_station_heartbeat_keeps_its_source(harness: SimHarness) -> None:
    harness.heartbeats += [("gcs", (245, 190), GCS), ("onboard", (1, 191), ONBOARD_CONTROLLER)]
    harness.fly(5.0)
    sources = Counter((item.system, item.component) for _, item in harness.inbox["onboard"] if item.forwarded)
    assert sources[245, 190] == pytest.approx(5, abs=1)
    own = [
        item.message
        for _, item in harness.inbox["onboard"]
        if (item.system, item.component) == (1, 1) and item.message.get_type() == "HEARTBEAT"
    ]
    assert {message.autopilot for message in own} == {12}
