"""Flight modes: their encodings, DO_SET_MODE and SET_MODE, and PX4's releases where they differ."""

import pytest

from mavlink_sim.px4.modes import Mode, base_mode, mode_of
from mavlink_sim.releases import RELEASES
from mavlink_sim.wire.messages import dialect
from tests.mavlink_sim.conftest import SimHarness, velocity_setpoint

ALL_MODES = [(1, 0), (2, 0), (3, 0), (3, 2), (4, 2), (4, 3), (4, 4), (4, 5), (4, 6), (5, 0), (6, 0), (7, 0)]
FOLLOW, PRECISION_LAND, ORBIT = (4, 8), (4, 9), (3, 1)
MODE_REFUSED = "Switching to {} is currently not available\t"  # STATUSTEXT of PX4


@pytest.mark.parametrize(("main", "sub"), ALL_MODES)
def test_disarmed_accepts_every_known_mode(harness: SimHarness, main: int, sub: int) -> None:
    harness.fly(0.1)
    assert harness.set_mode(main, sub) == [0, 0]
    assert harness.heartbeat().custom_mode == main << 16 | sub << 24


@pytest.mark.parametrize(
    ("request_of", "shown", "base_mode"),
    [
        pytest.param(FOLLOW, 0x08040000, 17, id="FOLLOW"),
        pytest.param(PRECISION_LAND, 0x09040000, 29, id="PRECLAND"),
        pytest.param(ORBIT, 0x00030000, 81, id="ORBIT, which shows as POSCTL"),
    ],
)
def test_disarmed_accepts_follow_precland_and_orbit(
    harness: SimHarness, request_of: tuple[int, int], shown: int, base_mode: int
) -> None:
    harness.wait_ready()
    assert harness.set_mode(*request_of) == [0, 0]
    beat = harness.heartbeat()
    assert (beat.custom_mode, beat.base_mode) == (shown, base_mode)


def test_first_answer_at_once_second_within_10_ms(harness: SimHarness) -> None:
    harness.fly(0.1)
    harness.forget()
    harness.send(dialect.MAVLink_command_long_message(1, 1, 176, 0, 1, 4, 3, 0, 0, 0, 0))
    assert len(harness.received("COMMAND_ACK")) == 1
    harness.fly(0.012)
    assert len(harness.received("COMMAND_ACK")) == 2


def test_consecutive_commands_execute_in_order(harness: SimHarness) -> None:
    harness.take_off(4.0)
    for _ in range(3):
        harness.send(dialect.MAVLink_command_long_message(1, 1, 176, 0, 1, 4, 3, 0, 0, 0, 0))
        harness.send(dialect.MAVLink_command_long_message(1, 1, 21, 0, 0, 0, 0, 0, 0, 0, 0))
    harness.fly(0.1)
    assert harness.mode == "LAND"


@pytest.mark.parametrize(("main", "sub", "base"), [(8, 0, 1), (4, 1, 1), (4, 99, 1), (77, 0, 1), (4, 3, 0)])
def test_unknown_mode_accepted_then_rejected(harness: SimHarness, main: int, sub: int, base: int) -> None:
    harness.fly(0.1)
    assert harness.set_mode(main, sub, base) == [0, 1]
    assert harness.mode == "HOLD"


@pytest.mark.parametrize(("main", "sub"), [(3, 0), (2, 0), (7, 0), (1, 0), (4, 4), (6, 0)])
def test_unavailable_mode_in_air_accepted_then_rejected(harness: SimHarness, main: int, sub: int) -> None:
    harness.take_off()
    assert harness.set_mode(main, sub) == [0, 1]
    assert harness.heartbeat().custom_mode == 0x03040000


def test_denial_text_goes_to_requesting_ground_station(harness: SimHarness) -> None:
    harness.heartbeats.append(("gcs", (245, 190), 6))
    harness.take_off()
    harness.forget()
    harness.set_mode(6)  # requested by the companion: no text
    assert harness.texts() == []
    harness.set_mode(6, source=(245, 190), link="gcs")
    assert harness.texts() == [MODE_REFUSED.format("Offboard")]
    harness.set_mode(3, source=(245, 190), link="gcs")
    assert len(harness.texts()) == 1  # once a second is enough
    harness.fly(1.0)
    harness.set_mode(3, source=(245, 190), link="gcs")
    assert harness.texts()[1:] == [MODE_REFUSED.format("Position")]


def test_set_mode_message_has_one_real_answer(harness: SimHarness) -> None:
    harness.take_off()
    harness.forget()
    harness.send(dialect.MAVLink_set_mode_message(1, 1, 0x00030000))
    harness.fly(0.05)
    harness.send(dialect.MAVLink_set_mode_message(1, 1, 0x05040000))
    harness.fly(0.05)
    answers = harness.received("COMMAND_ACK")
    assert [(answer.command, answer.result) for answer in answers] == [(176, 1), (176, 0)]
    assert harness.mode == "RTL"


def test_current_mode_sent_at_2_hz_and_on_change(harness: SimHarness) -> None:
    """Whatever the requested rate: a real PX4 asked for 20 Hz sent 1.75 to 2."""
    harness.fly(0.1)
    assert harness.command(511, 436, 50_000) == [0]
    harness.fly(0.7)
    harness.forget()
    harness.set_mode(4, 5)
    harness.fly(0.03)
    assert len(harness.received("CURRENT_MODE")) == 1
    harness.fly(4.0)
    seen = harness.received("CURRENT_MODE")
    assert 8 <= len(seen) <= 9
    assert {(m.standard_mode, m.custom_mode, m.intended_custom_mode) for m in seen} == {
        (5, 0x05040000, 0x05040000)
    }


def test_another_system_may_change_the_mode(harness: SimHarness) -> None:
    harness.take_off()
    stream = velocity_setpoint(1, 0, 0)
    harness.offboard(stream)
    assert harness.set_mode(4, 3, source=(245, 190), link="gcs") == [0, 0]
    harness.fly(5.0, stream)  # the companion continues to send
    assert harness.mode == "HOLD"
    assert abs(harness.vehicle.airframe.velocity[0]) < 0.2


@pytest.mark.parametrize(
    ("mode", "custom"),
    [
        (Mode.MANUAL, 0x00010000),
        (Mode.ALTCTL, 0x00020000),
        (Mode.POSCTL, 0x00030000),
        (Mode.POSITION_SLOW, 0x02030000),
        (Mode.TAKEOFF, 0x02040000),
        (Mode.HOLD, 0x03040000),
        (Mode.MISSION, 0x04040000),
        (Mode.RTL, 0x05040000),
        (Mode.LAND, 0x06040000),
        (Mode.FOLLOW, 0x08040000),
        (Mode.PRECLAND, 0x09040000),
        (Mode.ACRO, 0x00050000),
        (Mode.OFFBOARD, 0x00060000),
        (Mode.STABILIZED, 0x00070000),
    ],
)
def test_a_mode_has_px4s_custom_mode_and_is_found_by_it(mode: Mode, custom: int) -> None:
    assert mode.custom_mode == custom
    assert mode_of(custom >> 16 & 0xFF, custom >> 24) is mode


@pytest.mark.parametrize(("main", "sub"), [(8, 0), (4, 1), (4, 99), (0, 0), (10, 0), (99, 0)])
def test_modes_that_px4_refuses_are_no_modes(main: int, sub: int) -> None:
    assert mode_of(main, sub) is None


def test_an_orbit_request_shows_as_position_mode() -> None:
    assert mode_of(3, 1) is Mode.POSCTL


@pytest.mark.parametrize(
    ("mode", "armed", "has_setpoints", "expected"),
    [
        (Mode.HOLD, False, False, 29),
        (Mode.HOLD, True, False, 157),
        (Mode.RTL, True, False, 157),
        (Mode.OFFBOARD, False, True, 17),
        (Mode.OFFBOARD, True, True, 145),
        (Mode.OFFBOARD, False, False, 1),
        (Mode.POSCTL, False, False, 81),
        (Mode.MANUAL, False, True, 81),
        (Mode.ACRO, False, False, 65),
        (Mode.FOLLOW, False, False, 17),
    ],
)
def test_the_base_mode_is_as_measured(mode: Mode, armed: bool, has_setpoints: bool, expected: int) -> None:
    assert base_mode(mode, armed, has_setpoints) == expected


@pytest.mark.parametrize("release", ["1.14", "1.15", "1.18"])
def test_other_release_answers_mode_request_once(release: str) -> None:
    harness = SimHarness(px4=release)
    harness.take_off()
    assert harness.set_mode(6) == [1]
    assert harness.set_mode(4, 5) == [0]


@pytest.mark.parametrize("release", ["1.16", "1.17"])
def test_v1_16_and_v1_17_answer_it_twice(release: str) -> None:
    harness = SimHarness(px4=release)
    harness.take_off()
    assert harness.set_mode(6) == [0, 1]


@pytest.mark.parametrize(("release", "sent"), [("1.14", False), ("1.15", True)])
def test_current_mode_since_v1_15_only(release: str, sent: bool) -> None:
    harness = SimHarness(px4=release)
    harness.fly(3.0)
    assert bool(harness.received("CURRENT_MODE")) is sent
    assert harness.command(512, 436) == [0 if sent else 2]
    assert harness.command(511, 436, 100_000) == [0 if sent else 4]


@pytest.mark.parametrize(("release", "answers"), [("1.16", 0), ("1.17", 1)])
def test_parameter_errors_since_v1_17_only(release: str, answers: int) -> None:
    harness = SimHarness(px4=release)
    for request in (
        dialect.MAVLink_param_request_read_message(1, 1, b"NO_SUCH", -1),
        dialect.MAVLink_param_set_message(1, 1, b"COM_OF_LOSS_T", 1.0, 6),
    ):
        harness.forget()
        harness.send(request)
        harness.fly(0.05)
        assert harness.received("PARAM_VALUE") == []
        assert len(harness.received("PARAM_ERROR")) == answers


@pytest.mark.parametrize("release", RELEASES)
def test_reported_version_is_the_releases(release: str) -> None:
    harness = SimHarness(px4=release)
    harness.fly(0.1)
    harness.command(512, 148)
    version = harness.received("AUTOPILOT_VERSION")[0].flight_sw_version
    assert f"{version >> 24}.{version >> 16 & 0xFF}" == release
