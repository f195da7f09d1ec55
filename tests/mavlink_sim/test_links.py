"""Status texts, events and forwarding per link."""

from typing import Any

import pytest

from mavlink_sim.wire.announcements import INFO, Text
from mavlink_sim.wire.messages import dialect
from tests.mavlink_sim.conftest import SimHarness

pytestmark = pytest.mark.streams("everything")

GCS = 6
ONBOARD_CONTROLLER = 18

# STATUSTEXTs of PX4.
TAKEOFF = ["Armed by external command\t", "Using default takeoff altitude: 2.5 m\t", "Takeoff detected\t"]
ARMING_DENIED = [
    "Preflight Fail: heading estimate not stable",
    "Arming denied: Resolve system health failures first\t",
]
DISARMING_DENIED = "Disarming denied: not landed\t"
UNKNOWN_MODE = "Unsupported main mode\t"
COMPANION_LOST = "Connection to mission computer lost\t"
COMPANION_REGAINED = "Onboard controller regained\t"


def test_a_companion_gets_no_status_texts_but_gets_events(harness: SimHarness) -> None:
    harness.heartbeats.append(("onboard", (1, 191), ONBOARD_CONTROLLER))
    harness.take_off()
    assert harness.texts("onboard") == []
    assert harness.texts("gcs") == []
    assert harness.received("EVENT", "onboard")


def test_texts_go_to_link_of_ground_station(harness: SimHarness) -> None:
    harness.heartbeats.append(("gcs", (245, 190), GCS))
    harness.take_off()
    assert harness.texts("gcs") == TAKEOFF
    assert {message.severity for message in harness.received("STATUSTEXT", "gcs")} == {6}
    assert harness.texts("onboard") == []


def test_silent_ground_station_gets_no_texts(harness: SimHarness) -> None:
    harness.heartbeats.append(("gcs", (245, 190), GCS))
    harness.wait_ready()
    harness.heartbeats.clear()
    harness.fly(3.0)
    harness.command(400, 1)
    assert harness.texts("gcs") == []


def test_denials_have_severity_critical(harness: SimHarness) -> None:
    harness.heartbeats.append(("gcs", (245, 190), GCS))
    harness.fly(1.0)
    harness.command(400, 1)
    assert harness.texts() == ARMING_DENIED
    assert {message.severity for message in harness.received("STATUSTEXT", "gcs")} == {2}
    harness.take_off()
    harness.command(400, 0)
    assert harness.texts()[-1] == DISARMING_DENIED
    harness.set_mode(77)
    assert harness.texts()[-1] == UNKNOWN_MODE


def test_long_text_is_chunked(harness: SimHarness) -> None:
    harness.heartbeats.append(("gcs", (245, 190), GCS))
    harness.fly(0.1)
    long = "x" * 120 + "\t"
    harness.vehicle.autopilot.texts.append(Text(INFO, long))
    harness.fly(0.1)
    chunks = harness.received("STATUSTEXT", "gcs")
    assert [chunk.chunk_seq for chunk in chunks] == [0, 1, 2]
    assert len({chunk.id for chunk in chunks}) == 1
    assert chunks[0].id != 0
    assert harness.texts() == [long]


def test_companion_loss_reported_after_7_s(harness: SimHarness) -> None:
    harness.heartbeats += [("gcs", (245, 190), GCS), ("onboard", (1, 191), ONBOARD_CONTROLLER)]
    harness.fly(3.0)
    del harness.heartbeats[1]
    started = harness.now_s
    harness.until(lambda: COMPANION_LOST in harness.texts(), 10.0)
    assert 6.0 < harness.now_s - started < 7.5
    harness.heartbeats.append(("onboard", (1, 191), ONBOARD_CONTROLLER))
    harness.fly(1.5)
    assert harness.texts()[-1] == COMPANION_REGAINED


def heartbeat(kind: int = GCS) -> Any:
    message = dialect.MAVLink_heartbeat_message(kind, 8, 0, 0, 4, 3)
    codec = dialect.MAVLink(None, 245, 190)
    return dialect.MAVLink(None).parse_buffer(message.pack(codec))[0]


def test_heartbeat_forwarded_byte_for_byte(harness: SimHarness) -> None:
    harness.send(heartbeat(), "gcs", (245, 190))
    assert harness.inbox["onboard"] == []  # no component received there yet
    harness.send(dialect.MAVLink_heartbeat_message(ONBOARD_CONTROLLER, 8, 0, 0, 4, 3), "onboard")
    harness.forget()
    message = heartbeat()
    harness.send(message, "gcs", (245, 190))
    ((_, item),) = harness.inbox["onboard"]
    assert (item.system, item.component, item.forwarded) == (245, 190, True)
    assert item.pack(dialect.MAVLink(None, 1, 1)) == bytes(message.get_msgbuf())
    assert harness.inbox["gcs"] == []


def test_forwarding_follows_target_component(harness: SimHarness) -> None:
    harness.send(dialect.MAVLink_heartbeat_message(ONBOARD_CONTROLLER, 8, 0, 0, 4, 3), "onboard")
    harness.forget()
    source = (245, 190)
    harness.send(dialect.MAVLink_command_long_message(1, 191, 512, 0, 148, *[0] * 6), "gcs", source)
    harness.send(dialect.MAVLink_command_long_message(1, 55, 512, 0, 148, *[0] * 6), "gcs", source)
    harness.send(dialect.MAVLink_command_long_message(1, 1, 512, 0, 148, *[0] * 6), "gcs", source)
    forwarded = [item.message.target_component for _, item in harness.inbox["onboard"] if item.forwarded]
    assert forwarded == [191]


def test_its_own_messages_coming_back_are_ignored(harness: SimHarness) -> None:
    harness.send(dialect.MAVLink_heartbeat_message(2, 12, 0, 0, 3, 3), "onboard", (1, 1))
    assert harness.vehicle.links["onboard"].components == set()
