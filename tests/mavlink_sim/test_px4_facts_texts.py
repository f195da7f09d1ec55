"""Every STATUSTEXT recorded from a real PX4: text, severity, closing tab, chunks."""

from __future__ import annotations

import pytest

from mavlink_sim.wire.messages import dialect
from tests.mavlink_sim.conftest import SimHarness, velocity_setpoint

INFO, CRITICAL = 6, 2
GROUND_STATION = (245, 190)

# As PX4 sends them, with their severities.
ARMED = (INFO, "Armed by external command\t")
LANDED = (INFO, "Landing detected\t")
DISARMED = (INFO, "Disarmed by landing\t")
DISARMED_BY_COMMAND = (INFO, "Disarmed by external command\t")
DISARMED_ON_GROUND = (INFO, "Disarmed by auto preflight disarming\t")
RETURN_STARTED = (INFO, "RTL: start return at 493 m (4 m above destination)\t")
RETURN_LANDS = (INFO, "RTL: land at destination\t")
FLIGHT = [
    ARMED,
    (INFO, "Using default takeoff altitude: 2.5 m\t"),
    (INFO, "Takeoff detected\t"),
    (INFO, "Landing at current position\t"),
    LANDED,
    DISARMED,
]
RETURN = [(INFO, "Returning to launch\t"), RETURN_STARTED, RETURN_LANDS, LANDED, DISARMED]
DENIALS = [
    "Preflight Fail: heading estimate not stable",
    "Arming denied: Resolve system health failures first\t",
    "Unsupported main mode\t",
    "SET_POSITION_TARGET_LOCAL_NED coordinate frame 9 unsupported\t",
    "SET_POSITION_TARGET_LOCAL_NED invalid\t",
    "SET_POSITION_TARGET_LOCAL_NED force not supported\t",
    "Disarming denied: not landed\t",
    "Switching to Offboard is currently not available\t",
]
COMPANION_LOST = (CRITICAL, "Connection to mission computer lost\t")
LOSSES = [
    (CRITICAL, "Failsafe activated\t"),
    RETURN_STARTED,
    RETURN_LANDS,
    COMPANION_LOST,
    (INFO, "Onboard controller regained\t"),
]
TAKEOFF_BELOW = (CRITICAL, "Already higher than takeoff altitude\t")


def sent(harness: SimHarness, link: str = "gcs") -> list[tuple[int, str]]:
    """(severity, whole text) of every STATUSTEXT received."""
    severities = [
        message.severity for message in harness.received("STATUSTEXT", link) if not message.chunk_seq
    ]
    return list(zip(severities, harness.texts(link), strict=True))


@pytest.fixture
def received() -> SimHarness:
    """A vehicle whose ground-station link has a ground station on it."""
    harness = SimHarness()
    harness.heartbeats.append(("gcs", GROUND_STATION, 6))
    return harness


def test_texts_of_a_flight_by_command(received: SimHarness) -> None:
    received.wait_ready()
    received.command(400, 1)
    received.command(22, *[float("nan")] * 7)
    received.until(lambda: received.mode == "HOLD")
    received.fly(4.0)
    received.command(21)
    received.until(lambda: not received.armed)
    received.fly(0.1)
    assert sent(received) == FLIGHT


def test_texts_of_a_return_are_info(received: SimHarness) -> None:
    received.take_off(4.0)
    received.fly(4.0)
    received.forget()
    received.command(20)
    received.until(lambda: not received.armed)
    received.fly(0.1)
    assert sent(received) == RETURN


def test_disarming_text_has_reason(received: SimHarness) -> None:
    received.wait_ready()
    received.command(400, 1)
    received.command(400, 0)
    received.command(400, 1)
    received.until(lambda: not received.armed, 15.0)
    received.fly(0.1)
    assert [text for text in sent(received) if "Disarmed" in text[1]] == [
        DISARMED_BY_COMMAND,
        DISARMED_ON_GROUND,
    ]


def test_denial_texts_are_critical_and_end_with_tab(received: SimHarness) -> None:
    received.fly(0.1)
    received.command(400, 1)
    received.set_mode(77)
    received.send(dialect.MAVLink_set_position_target_local_ned_message(0, 1, 1, 9, 1479, *[0] * 11))
    received.send(dialect.MAVLink_set_position_target_local_ned_message(0, 1, 1, 1, 4095 - 512, *[0] * 11))
    received.send(dialect.MAVLink_set_position_target_local_ned_message(0, 1, 1, 1, 512, *[0] * 11))
    received.fly(0.1)
    received.take_off()
    received.command(400, 0)
    received.set_mode(6, source=GROUND_STATION, link="gcs")
    texts = sent(received)
    critical = [text for severity, text in texts if severity == CRITICAL]
    assert critical == DENIALS
    assert {severity for severity, _ in texts} == {INFO, CRITICAL}


def test_texts_of_setpoint_and_companion_loss(received: SimHarness) -> None:
    received.heartbeats.append(("onboard", (1, 191), 18))
    received.take_off(4.0)
    stream = velocity_setpoint(0, 0, 0)
    received.offboard(stream)
    del received.heartbeats[1]
    received.forget()
    last = received.now_s
    received.until(lambda: COMPANION_LOST in sent(received), 10.0)
    assert received.now_s - last == pytest.approx(7.0, abs=1.1)
    received.heartbeats.append(("onboard", (1, 191), 18))
    received.fly(1.5)
    assert sent(received) == LOSSES


def test_takeoff_below_current_altitude_sends_text(received: SimHarness) -> None:
    received.wait_ready()
    received.command(400, 1)
    assert received.command(22, 0, 0, 0, float("nan"), float("nan"), float("nan"), 5.0) == [0]
    received.until(lambda: not received.armed, 15.0)
    received.fly(0.1)
    assert TAKEOFF_BELOW in sent(received)
    assert received.height_m < 0.1
    assert sent(received)[-1] == DISARMED_ON_GROUND


def test_text_over_50_characters_is_chunked(received: SimHarness) -> None:
    received.fly(0.1)
    received.command(400, 1)
    received.fly(0.05)
    short, *chunks = received.received("STATUSTEXT", "gcs")
    assert (short.id, short.chunk_seq) == (0, 0)
    assert [chunk.chunk_seq for chunk in chunks] == [0, 1]
    assert chunks[0].id == chunks[1].id != 0
    assert len(chunks[0].text) == 50


def test_texts_follow_ground_station_heartbeat() -> None:
    harness = SimHarness()
    harness.heartbeats.append(("onboard", GROUND_STATION, 6))
    harness.wait_ready()
    harness.command(400, 1)
    harness.fly(0.1)
    assert harness.texts("onboard") == [ARMED[1]]
    assert harness.texts("gcs") == []
