"""Commands other than flight commands: the addressees answered, and the MAV_RESULT."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavlink_sim.wire.messages import dialect
from tests.mavlink_sim.conftest import SimHarness

pytestmark = pytest.mark.streams("everything")


@pytest.mark.parametrize(
    ("command", "values", "result"),
    [
        (178, (1, 5, -1, 0), 0),
        (179, (1,), 0),
        (179, (0, 0, 0, 0, 47.4, 8.5, float("nan")), 2),
        (401, (), 0),
        (245, (1,), 0),
        (185, (0,), 2),
        (193, (0,), 3),
        (92, (), 3),
        (183, (), 3),
        (252, (), 3),
        (2000, (), 3),
        (31010, (), 3),
        (43000, (), 3),
        (60000, (), 3),
        (187, (0.5,), 0),
        (241, (), 0),
        (246, (), 0),
        (310, (0.1, 0.5, 0, 0, 33), 0),
        (410, (), 0),
    ],
)
def test_the_result_of_a_command_is_as_measured(
    harness: SimHarness, command: int, values: tuple[float, ...], result: int
) -> None:
    harness.wait_ready()
    assert harness.command(command, *values) == [result]


def test_home_is_not_set_while_its_parameter_forbids_it() -> None:
    harness = SimHarness(["everything"], parameters={"COM_HOME_EN": 0})
    harness.wait_ready()
    assert harness.command(179, 1) == [2]


@pytest.mark.parametrize("command", [0, 205, 310, 531, 2510])
def test_commands_of_other_modules_not_answered(harness: SimHarness, command: int) -> None:
    harness.fly(0.1)
    assert harness.command(command) == []


@pytest.mark.parametrize(("command", "result"), [(241, 1), (310, 2)])
def test_armed_vehicle_refuses_calibration_and_actuator_test(
    harness: SimHarness, command: int, result: int
) -> None:
    harness.wait_ready()
    assert harness.command(400, 1) == [0]
    assert harness.command(command, 0, 0, 0, 0, 1) == [result]


def test_get_home_position_sends_it_before_the_acknowledgement(harness: SimHarness) -> None:
    harness.wait_ready()
    harness.forget()
    assert harness.command(410) == [0]
    kinds = [item.message.get_type() for _, item in harness.inbox["onboard"]]
    assert kinds.index("HOME_POSITION") < kinds.index("COMMAND_ACK")


def test_available_modes_lists_one_or_all(harness: SimHarness) -> None:
    harness.fly(0.1)
    assert harness.command(512, 435, 0) == [0]
    listed = harness.received("AVAILABLE_MODES")
    assert [reported.mode_index for reported in listed] == list(range(1, listed[0].number_modes + 1))
    assert {reported.custom_mode for reported in listed} >= {0x00010000, 0x03040000, 0x04040000, 0x00060000}
    harness.forget()
    assert harness.command(512, 435, 1) == [0]
    (manual,) = harness.received("AVAILABLE_MODES")
    assert (manual.custom_mode, manual.standard_mode, manual.properties) == (0x00010000, 0, 1)
    assert manual.mode_name.rstrip("\0") == "Manual"
    assert harness.command(512, 435, 200) == [2]


def test_flight_information_has_arming_and_takeoff_times(harness: SimHarness) -> None:
    harness.wait_ready()
    assert harness.command(512, 264) == [0]
    before = harness.received("FLIGHT_INFORMATION")[-1]
    assert (before.arming_time_utc, before.takeoff_time_utc, before.flight_uuid) == (0, 0, 0)
    armed_us = harness.now_s * 1e6
    harness.command(400, 1)
    harness.command(22, *[float("nan")] * 7)
    harness.until(lambda: not harness.vehicle.autopilot.landed, 5.0)
    left_us = harness.now_s * 1e6
    assert harness.command(512, 264) == [0]
    flying = harness.received("FLIGHT_INFORMATION")[-1]
    assert flying.arming_time_utc == pytest.approx(armed_us, abs=20_000)
    assert flying.takeoff_time_utc == pytest.approx(left_us, abs=20_000)


def test_the_protocol_version_is_sent_on_request(harness: SimHarness) -> None:
    harness.fly(0.1)
    assert harness.command(519, 1) == [0]
    version = harness.received("PROTOCOL_VERSION")[0]
    assert (version.version, version.min_version, version.max_version) == (200, 100, 200)


def test_another_system_id_is_answered_under_it() -> None:
    harness = SimHarness(["everything"], system_id=7)
    harness.fly(0.1)
    assert harness.command(401, target=(1, 1)) == []
    assert harness.command(401, target=(7, 1)) == [0]
    assert {item.system for _, item in harness.inbox["onboard"]} == {7}
    assert harness.vehicle.parameters.number("MAV_SYS_ID") == 7


def test_home_denied_before_known(harness: SimHarness) -> None:
    harness.fly(0.5)
    assert harness.command(512, 242) == [2]
    harness.wait_ready()
    assert harness.command(512, 242) == [0]
    assert harness.received("HOME_POSITION")[-1].altitude == 489400


def test_an_interval_set_on_one_link_leaves_the_other_alone(harness: SimHarness) -> None:
    harness.fly(0.1)
    harness.command(511, 30, -1)
    harness.forget()
    harness.fly(1.0)
    assert harness.received("ATTITUDE", "onboard") == []
    assert len(harness.received("ATTITUDE", "gcs")) == 49


def test_the_interval_can_be_read_back(harness: SimHarness) -> None:
    harness.fly(0.1)
    harness.command(511, 32, 250_000)
    for identifier, interval in ((32, 250_000), (30, 10_000), (27, -1)):
        assert harness.command(510, identifier) == [0]
        answer = harness.received("MESSAGE_INTERVAL")[-1]
        assert (answer.message_id, answer.interval_us) == (identifier, interval)
    assert harness.command(512, 244, 32) == [0]
    answer = harness.received("MESSAGE_INTERVAL")[-1]
    assert (answer.message_id, answer.interval_us) == (32, 250_000)


def test_a_timesync_answer_is_not_answered(harness: SimHarness) -> None:
    harness.send(dialect.MAVLink_timesync_message(5, 123))
    assert harness.received("TIMESYNC") == []


def test_there_is_no_mission_on_board(harness: SimHarness) -> None:
    harness.send(dialect.MAVLink_mission_request_list_message(1, 1, 1))
    count = harness.received("MISSION_COUNT")[0]
    assert (count.count, count.mission_type, count.target_component) == (0, 1, 191)
    assert harness.command(300) == [2]


numbers = st.one_of(
    st.sampled_from([0.0, 1.0, -1.0, float("nan"), float("inf"), 3.0e38, -3.0e38, 21196.0, 192.0]),
    st.floats(width=32),
)
COMMANDS = [16, 20, 21, 22, 176, 178, 179, 185, 192, 193, 245, 300, 400, 401, 510, 511, 512, 519, 520]


@settings(max_examples=40, deadline=None)
@given(
    st.lists(
        st.tuples(st.sampled_from(COMMANDS), st.lists(numbers, min_size=7, max_size=7)),
        min_size=1,
        max_size=6,
    )
)
def test_no_command_raises(requests: list[tuple[int, list[float]]]) -> None:
    harness = SimHarness(["everything"], ready_after_s=0.0)
    harness.command(400, 1)
    for command, values in requests:
        for result in harness.command(command, *values):
            assert 0 <= result <= 4
    harness.fly(1.0)
    codec = dialect.MAVLink(None, 1, 1)
    for _, item in harness.inbox["onboard"]:
        assert item.pack(codec)
