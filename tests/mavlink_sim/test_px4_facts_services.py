"""Measured on a real PX4: requests, TIMESYNC, PING, events, parameters; one test per statement.

"Source" marks what is from PX4's source instead of measured.
"""

import os
import struct
import zlib
from pathlib import Path
from typing import Any

import pytest

from mavlink_sim.px4.parameters import INT32, REAL32, Parameter, Parameters, is_volatile, parameter_hash
from mavlink_sim.services.event_protocol import EVENTS_KEPT
from mavlink_sim.wire.messages import dialect, parser
from tests.mavlink_sim.conftest import SimHarness
from tests.mavlink_sim.plan_client import upload, waypoint

pytestmark = pytest.mark.streams("everything")

DATA = Path(os.environ.get("COMPANION_TEST_DATA", Path(__file__).parents[2] / "../shared/data"))
PARAMETERS = DATA / "px4" / "parameters.txt"
ACCEPTED, TEMPORARILY_REJECTED, DENIED, UNSUPPORTED, FAILED = range(5)
DOES_NOT_EXIST, READ_ONLY, TYPE_UNSUPPORTED, TYPE_MISMATCH = 1, 5, 6, 7


@pytest.fixture
def ready(harness: SimHarness) -> SimHarness:
    harness.wait_ready()
    harness.forget()
    return harness


def kinds_in_order(harness: SimHarness, *kinds: str) -> list[str]:
    return [
        item.message.get_type() for _, item in harness.inbox["onboard"] if item.message.get_type() in kinds
    ]


# ---- requests


@pytest.mark.parametrize(
    ("message_id", "kind"),
    [
        (148, "AUTOPILOT_VERSION"),
        (242, "HOME_POSITION"),
        (49, "GPS_GLOBAL_ORIGIN"),
        (436, "CURRENT_MODE"),
        (397, "COMPONENT_METADATA"),
        (411, "CURRENT_EVENT_SEQUENCE"),
    ],
)
def test_request_message__message_then_accepted(ready: SimHarness, message_id: int, kind: str) -> None:
    assert ready.command(512, message_id) == [ACCEPTED]
    assert kinds_in_order(ready, kind, "COMMAND_ACK")[:2] == [kind, "COMMAND_ACK"]


@pytest.mark.parametrize("message_id", [259, 280, 27, 60000, -1])
def test_request_message__unknown_id_or_nothing_to_send_denied(ready: SimHarness, message_id: int) -> None:
    assert ready.command(512, message_id) == [DENIED]


@pytest.mark.parametrize("command", [(512, 148), (520, 1)], ids=["512_148", "520"])
def test_autopilot_version_by_512_148_or_520__before_ack(ready: SimHarness, command: tuple[int, int]) -> None:
    assert ready.command(*command) == [ACCEPTED]
    assert kinds_in_order(ready, "AUTOPILOT_VERSION", "COMMAND_ACK") == ["AUTOPILOT_VERSION", "COMMAND_ACK"]
    version = ready.received("AUTOPILOT_VERSION")[0]
    # MISSION_FLOAT, PARAM_FLOAT, MISSION_INT, COMMAND_INT, PARAM_ENCODE_BYTEWISE, FTP, SET_ATTITUDE_TARGET…
    assert version.capabilities == 59647
    assert version.capabilities & (1 << 5)  # FTP
    assert version.flight_sw_version == 0x011100FF
    assert (version.board_version, version.vendor_id, version.product_id) == (1, 0, 0)
    assert bytes(version.flight_custom_version) == bytes([0, 0, 0, 253, 175, 214, 222, 89])
    assert version.uid == 5283920058631409231
    assert not any(version.uid2)


def test_set_message_interval__100000_us_gives_9_8_hz(ready: SimHarness) -> None:
    assert ready.command(511, 30, 100_000) == [ACCEPTED]
    ready.fly(1.0)
    ready.forget()
    ready.fly(20.0)
    assert len(ready.received("ATTITUDE")) / 20.0 == pytest.approx(9.8, abs=0.1)
    # by the same clock as the streams that PX4 is configured to send every 100 ms
    assert len(ready.received("ATTITUDE")) == pytest.approx(len(ready.received("VFR_HUD")), abs=1)
    assert ready.command(511, 30, -1) == [ACCEPTED]
    ready.forget()
    ready.fly(2.0)
    assert not ready.received("ATTITUDE")
    assert ready.command(511, 30, 0) == [ACCEPTED]
    ready.forget()
    ready.fly(2.0)
    assert len(ready.received("ATTITUDE")) / 2.0 == pytest.approx(98.5, abs=2.0)


@pytest.mark.parametrize("message_id", [27, 0, 60000], ids=["RAW_IMU", "HEARTBEAT", "60000"])
def test_set_message_interval__unknown_or_unavailable_failed(ready: SimHarness, message_id: int) -> None:
    assert ready.command(511, message_id, 100_000) == [FAILED]


def test_get_message_interval__message_interval_and_accepted(ready: SimHarness) -> None:
    assert ready.command(510, 30) == [ACCEPTED]
    assert kinds_in_order(ready, "MESSAGE_INTERVAL", "COMMAND_ACK") == ["MESSAGE_INTERVAL", "COMMAND_ACK"]
    (interval,) = ready.received("MESSAGE_INTERVAL")
    assert (interval.message_id, interval.interval_us) == (30, 10_000)


@pytest.mark.parametrize(
    ("kind", "message_id", "interval_us"),
    [
        ("ATTITUDE", 30, 10_000),
        ("ATTITUDE_QUATERNION", 31, 20_000),
        ("LOCAL_POSITION_NED", 32, 33_333),
        ("VFR_HUD", 74, 100_000),
        ("GPS_RAW_INT", 24, 125_000),
        ("SYS_STATUS", 1, 200_000),
    ],
)
def test_source_configured_interval_changes_no_rate(
    ready: SimHarness, kind: str, message_id: int, interval_us: int
) -> None:
    ready.command(510, message_id)
    assert ready.received("MESSAGE_INTERVAL")[0].interval_us == interval_us
    rates = []
    for _ in range(2):
        ready.forget()
        ready.fly(10.0)
        rates.append(len(ready.received(kind)) / 10.0)
        ready.command(511, message_id, interval_us)
    assert rates[0] == pytest.approx(rates[1], rel=0.01, abs=0.1)


@pytest.mark.parametrize(
    ("target", "answered"), [((1, 1), 1), ((1, 0), 1), ((0, 0), 1), ((2, 1), 0), ((1, 100), 0)]
)
def test_commands_answered_for_1_0_and_0_0_not_2_1_or_1_100(
    ready: SimHarness, target: tuple[int, int], answered: int
) -> None:
    assert len(ready.command(512, 148, target=target)) == answered


# ---- TIMESYNC and PING


def test_timesync_request__ts1_echoed_tc1_boot_time_in_ns(ready: SimHarness) -> None:
    ready.send(dialect.MAVLink_timesync_message(0, 123_456_789_012))
    (answer,) = [message for message in ready.received("TIMESYNC") if message.tc1]
    assert answer.ts1 == 123_456_789_012
    assert answer.tc1 == ready.vehicle.boot_us * 1000


def test_ping_0_0__answered_to_sender_with_its_stamp(ready: SimHarness) -> None:
    ready.send(dialect.MAVLink_ping_message(55_000, 9, 0, 0))
    (answer,) = [message for message in ready.received("PING") if message.target_system]
    assert (answer.target_system, answer.target_component) == (1, 191)
    assert (answer.time_usec, answer.seq) == (55_000, 9)


def test_ping_addressed_1_1__not_answered_own_ping_1_hz(ready: SimHarness) -> None:
    ready.send(dialect.MAVLink_ping_message(55_000, 9, 1, 1))
    ready.fly(10.0)
    pings = ready.received("PING")
    assert len(pings) == pytest.approx(10, abs=1)
    assert all((message.target_system, message.target_component) == (0, 0) for message in pings)


# ---- events


def request_event(harness: SimHarness, first: int, last: int, target: tuple[int, int] = (1, 1)) -> None:
    """REQUEST_EVENT packed by a dialect that has it, decoded by one that lacks it."""
    payload = struct.pack("<HHBB", first, last, *target)
    body = struct.pack("<BBBBBBHB", len(payload), 0, 0, 0, 1, 191, 412, 0) + payload
    crc = dialect.x25crc(body)
    crc.accumulate(bytes([33]))
    (message,) = parser().parse_buffer(b"\xfd" + body + struct.pack("<H", crc.crc))
    harness.forget()
    harness.vehicle.handle("onboard", message)
    harness.fly(0.01)


def active(harness: SimHarness) -> list[Any]:
    harness.take_off(2.5)
    harness.command(21)
    harness.until(lambda: not harness.armed, 40.0)
    harness.fly(3.0)  # the checks have changed
    return list(harness.received("EVENT"))


def test_events__on_every_link_with_increasing_numbers(harness: SimHarness) -> None:
    first = active(harness)
    assert len(first) >= 5
    assert [message.sequence for message in first] == list(range(1, len(first) + 1))
    assert [message.id for message in harness.received("EVENT", "gcs")] == [message.id for message in first]


def test_source_request_event__stored_events_are_repeated(harness: SimHarness) -> None:
    kept = active(harness)[-EVENTS_KEPT:]
    request_event(harness, kept[1].sequence, kept[3].sequence)
    again = harness.received("EVENT")
    assert [(m.id, m.sequence, m.event_time_boot_ms, m.arguments) for m in again] == [
        (m.id, m.sequence, m.event_time_boot_ms, m.arguments) for m in kept[1:4]
    ]


def test_source_response_event_error__for_a_missing_event(harness: SimHarness) -> None:
    kept = active(harness)[-EVENTS_KEPT:]
    oldest, newest = kept[0].sequence, kept[-1].sequence
    request_event(harness, 65535, 0)
    errors = harness.received("RESPONSE_EVENT_ERROR")
    assert [(message.sequence, message.sequence_oldest_available) for message in errors] == [
        (65535, oldest),
        (0, oldest),
    ]
    assert {(message.target_system, message.target_component) for message in errors} == {(1, 191)}
    request_event(harness, newest + 1, 60000)
    assert 1 <= len(harness.received("RESPONSE_EVENT_ERROR")) <= 25  # not one for each of 60000
    request_event(harness, oldest, oldest + 2, target=(1, 100))
    assert not harness.received("EVENT")


def test_current_event_sequence__0_3_hz_with_the_newest_number(harness: SimHarness) -> None:
    newest = active(harness)[-1].sequence
    harness.forget()
    harness.fly(10.0)
    received = harness.received("CURRENT_EVENT_SEQUENCE")
    assert len(received) == pytest.approx(3, abs=1)
    assert {message.sequence for message in received} == {newest}


# ---- parameters


def name_of(message: Any) -> str:
    text = message.param_id
    return (text.decode() if isinstance(text, bytes) else text).rstrip("\0")


def recorded_parameters() -> tuple[int, list[Parameter]]:
    """The recorded _HASH_CHECK and its parameters."""
    if not PARAMETERS.exists():
        pytest.skip(f"needs the recorded parameters {PARAMETERS}")
    rows = [line.split() for line in PARAMETERS.read_text().splitlines()]
    received = next(float(value) for name, _, value in rows if name == "_HASH_CHECK")
    parameters = [
        Parameter(name, int(kind), int(value) if int(kind) == INT32 else float(value))
        for name, kind, value in rows
        if name != "_HASH_CHECK"
    ]
    return struct.unpack("<I", struct.pack("<f", received))[0], parameters


def test_hash_check__reproduced_from_recorded_parameters() -> None:
    received, parameters = recorded_parameters()
    assert len(parameters) == 887
    assert parameter_hash(parameters) == received == 0x6AF5A894


def test_hash_check__vehicle_itself_answers_what_px4_answered(ready: SimHarness) -> None:
    (answer,) = read(ready, b"_HASH_CHECK")
    assert struct.unpack("<I", struct.pack("<f", answer.param_value))[0] == 0x6AF5A894
    assert (answer.param_type, answer.param_index, answer.param_count) == (5, 65535, 887)


def test_names_types_and_values_are_those_recorded(ready: SimHarness) -> None:
    _, parameters = recorded_parameters()
    assert list(ready.vehicle.parameters) == parameters


def test_source_hash_check__volatile_parameters_do_not_count(harness: SimHarness) -> None:
    received, parameters = recorded_parameters()
    changed = [
        Parameter(item.name, item.kind, item.value + 1) if is_volatile(item.name) else item
        for item in parameters
    ]
    assert sum(is_volatile(item.name) for item in parameters) == 58
    assert parameter_hash(changed) == received
    everything = 0xFFFFFFFF
    for item in parameters:
        packed = struct.pack("<i" if item.kind == INT32 else "<f", item.value)
        everything = zlib.crc32(item.name.encode() + packed, everything)
    assert everything ^ 0xFFFFFFFF != received


def test_request_list__hash_first_then_index_order(ready: SimHarness) -> None:
    total = len(ready.vehicle.parameters)
    started = ready.now_s
    ready.send(dialect.MAVLink_param_request_list_message(1, 1))
    ready.until(lambda: len(ready.received("PARAM_VALUE")) == total + 1, 2.0)
    stamped = [
        (time, item.message)
        for time, item in ready.inbox["onboard"]
        if item.message.get_type() == "PARAM_VALUE"
    ]
    first_s, first = stamped[0]
    assert first_s - started == pytest.approx(0.01, abs=0.005)
    assert (name_of(first), first.param_type, first.param_index, first.param_count) == (
        "_HASH_CHECK",
        5,
        65535,
        total,
    )
    assert [message.param_index for _, message in stamped[1:]] == list(range(total))
    names = [name_of(message) for _, message in stamped[1:]]
    assert names == sorted(names)
    assert {message.param_count for _, message in stamped} == {total}
    assert total == 887
    assert stamped[-1][0] - first_s == pytest.approx(0.89, abs=0.02)
    kinds = [message.param_type for _, message in stamped[1:]]
    assert (kinds.count(REAL32), kinds.count(INT32)) == (604, 283)


def test_source_request_list__repeat_restarts_without_hash(ready: SimHarness) -> None:
    ready.send(dialect.MAVLink_param_request_list_message(1, 1))
    ready.fly(0.1)
    ready.forget()
    ready.send(dialect.MAVLink_param_request_list_message(1, 1))
    ready.fly(1.5)
    names = [name_of(message) for message in ready.received("PARAM_VALUE")]
    assert "_HASH_CHECK" not in names
    first = next(iter(ready.vehicle.parameters)).name
    listed = names[names.index(first) :]
    assert listed == [parameter.name for parameter in ready.vehicle.parameters]


def read(harness: SimHarness, name: bytes, index: int = -1) -> list[Any]:
    harness.forget()
    harness.send(dialect.MAVLink_param_request_read_message(1, 1, name, index))
    harness.fly(0.1)
    return [*harness.received("PARAM_VALUE"), *harness.received("PARAM_ERROR")]


def write(harness: SimHarness, name: bytes, value: float, kind: int) -> list[Any]:
    harness.forget()
    harness.send(dialect.MAVLink_param_set_message(1, 1, name, value, kind))
    harness.fly(0.1)
    return [*harness.received("PARAM_VALUE"), *harness.received("PARAM_ERROR")]


def test_read_by_name_or_index__one_param_value(ready: SimHarness) -> None:
    (by_name,) = read(ready, b"COM_OF_LOSS_T")
    (by_index,) = read(ready, b"", by_name.param_index)
    assert by_name.param_value == by_index.param_value == 1.0
    assert by_name.param_type == REAL32
    assert name_of(by_index) == "COM_OF_LOSS_T"


def test_unknown__param_error_345_1_does_not_exist(ready: SimHarness) -> None:
    for answers in (read(ready, b"NO_SUCH"), read(ready, b"", 20_000), write(ready, b"NO_SUCH", 1.0, REAL32)):
        (error,) = answers
        assert (error.get_msgId(), error.error) == (345, DOES_NOT_EXIST)
        assert (error.target_system, error.target_component) == (1, 191)


def test_parameter_of_missions_listed_once_mission_was_checked(ready: SimHarness) -> None:
    (unlisted,) = read(ready, b"MIS_DIST_1WP")
    assert (unlisted.param_value, unlisted.param_index, unlisted.param_count) == (10_000.0, 65535, 887)
    assert upload(ready, [waypoint(10.0, 0.0, 5.0)]) == 0
    (listed,) = read(ready, b"MIS_DIST_1WP")
    assert listed.param_count == 889
    (by_index,) = read(ready, b"", listed.param_index)
    assert name_of(by_index) == "MIS_DIST_1WP"


def test_set__param_value_twice_at_0_and_10_to_20_ms(ready: SimHarness) -> None:
    started = ready.now_s
    write(ready, b"MIS_TAKEOFF_ALT", 4.0, REAL32)
    stamps = [
        time - started for time, item in ready.inbox["onboard"] if item.message.get_type() == "PARAM_VALUE"
    ]
    assert len(stamps) == 2
    assert stamps[0] < 0.005
    assert 0.01 <= stamps[1] - stamps[0] <= 0.02


def test_source_set__change_sent_on_every_link(ready: SimHarness) -> None:
    write(ready, b"MIS_TAKEOFF_ALT", 4.0, REAL32)
    assert [name_of(message) for message in ready.received("PARAM_VALUE", "gcs")] == ["MIS_TAKEOFF_ALT"]
    assert len(write(ready, b"MIS_TAKEOFF_ALT", 4.0, REAL32)) == 1
    assert not ready.received("PARAM_VALUE", "gcs")


def test_wrong_type__param_error_7_type_mismatch(ready: SimHarness) -> None:
    (error,) = write(ready, b"COM_OF_LOSS_T", 1.0, INT32)
    assert error.error == TYPE_MISMATCH
    assert ready.vehicle.parameters.number("COM_OF_LOSS_T") == 1.0


@pytest.mark.parametrize("kind", [1, 2, 3, 4, 5, 7, 8, 10, 0, 255])
def test_source_set__any_type_but_int32_and_real32_param_error_6(ready: SimHarness, kind: int) -> None:
    (error,) = write(ready, b"COM_OF_LOSS_T", 1.0, kind)
    assert error.error == TYPE_UNSUPPORTED


def test_source_set_hash_check__stops_list_and_param_error_5(ready: SimHarness) -> None:
    ready.send(dialect.MAVLink_param_request_list_message(1, 1))
    ready.fly(0.05)
    (error,) = write(ready, b"_HASH_CHECK", 0.0, 5)[-1:]
    assert error.error == READ_ONLY
    ready.forget()
    ready.fly(0.5)
    assert not ready.received("PARAM_VALUE")


def test_out_of_range_is_accepted_com_of_loss_t_1000(ready: SimHarness) -> None:
    assert [message.param_value for message in write(ready, b"COM_OF_LOSS_T", 1000.0, REAL32)] == [1000.0] * 2
    assert ready.vehicle.parameters.number("COM_OF_LOSS_T") == 1000.0


def test_a_set_takes_effect_at_once(ready: SimHarness) -> None:
    write(ready, b"MIS_TAKEOFF_ALT", 6.0, REAL32)
    ready.command(400, 1)
    ready.command(22, *[float("nan")] * 7)
    ready.until(lambda: ready.mode == "HOLD", 30.0)
    ready.fly(6.0)
    assert ready.height_m == pytest.approx(6.0, abs=0.7)


def test_source_param_values_differing_from_defaults_at_start() -> None:
    harness = SimHarness(parameters={"COM_OF_LOSS_T": 0.5})
    harness.fly(2.0)
    for link in ("onboard", "gcs"):
        assert [name_of(message) for message in harness.received("PARAM_VALUE", link)] == ["COM_OF_LOSS_T"]


@pytest.mark.parametrize(
    "message",
    [
        dialect.MAVLink_param_map_rc_message(1, 1, b"COM_OF_LOSS_T", -1, 0, 1.0, 1.0, 0.0, 2.0),
        dialect.MAVLink_param_ext_request_list_message(1, 1),
        dialect.MAVLink_param_ext_request_read_message(1, 1, b"COM_OF_LOSS_T", -1),
        dialect.MAVLink_param_ext_set_message(1, 1, b"COM_OF_LOSS_T", b"2.0", 9),
    ],
    ids=["PARAM_MAP_RC", "PARAM_EXT_REQUEST_LIST", "PARAM_EXT_REQUEST_READ", "PARAM_EXT_SET"],
)
def test_source_rc_maps_and_extended_protocol_ignored(ready: SimHarness, message: Any) -> None:
    before = ready.vehicle.parameters.hash()
    ready.send(message)
    ready.fly(0.1)
    for kind in ("PARAM_VALUE", "PARAM_ERROR", "PARAM_EXT_VALUE", "PARAM_EXT_ACK", "STATUSTEXT"):
        assert not ready.received(kind)
    assert ready.vehicle.parameters.hash() == before


def test_other_components_parameters_ignored(ready: SimHarness) -> None:
    ready.send(dialect.MAVLink_param_set_message(1, 100, b"COM_OF_LOSS_T", 2.0, REAL32))
    ready.send(dialect.MAVLink_param_request_read_message(2, 1, b"COM_OF_LOSS_T", -1))
    ready.fly(0.1)
    assert not ready.received("PARAM_VALUE")
    assert ready.vehicle.parameters.number("COM_OF_LOSS_T") == 1.0


# ---- PREFLIGHT_STORAGE (245)


@pytest.mark.parametrize(("action", "reset"), [(0, False), (1, False), (2, True), (3, False), (4, True)])
def test_245_accepted_and_2_and_4_reset_the_parameters(ready: SimHarness, action: int, reset: bool) -> None:
    defaults = Parameters().hash()
    write(ready, b"COM_OF_LOSS_T", 3.0, REAL32)
    assert ready.command(245, action) == [ACCEPTED]
    assert ready.vehicle.parameters.number("COM_OF_LOSS_T") == (1.0 if reset else 3.0)
    assert (ready.vehicle.parameters.hash() == defaults) is reset


def test_source_245_of_an_armed_vehicle__temporarily_rejected(ready: SimHarness) -> None:
    write(ready, b"COM_OF_LOSS_T", 3.0, REAL32)
    assert ready.command(400, 1) == [ACCEPTED]
    assert ready.command(245, 2) == [TEMPORARILY_REJECTED]
    assert ready.vehicle.parameters.number("COM_OF_LOSS_T") == 3.0


@pytest.mark.parametrize("action", [-1.0, 5.0, 1.5, float("nan")])
def test_245_with_an_unknown_action__nothing_happens(ready: SimHarness, action: float) -> None:
    write(ready, b"COM_OF_LOSS_T", 3.0, REAL32)
    assert ready.command(245, action) == [UNSUPPORTED]
    assert ready.vehicle.parameters.number("COM_OF_LOSS_T") == 3.0
