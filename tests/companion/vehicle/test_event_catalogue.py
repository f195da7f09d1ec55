"""Texts of PX4's events, by the autopilot's metadata."""

import json
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.host.peer_data import PeerDataError
from companion.vehicle.report import ALL_MODES, Report
from companion.vehicle.report_reader import Event, EventCatalogue

ERROR, INFO, PROTOCOL = 0x63, 0x66, 0x68


def catalogue() -> EventCatalogue:
    def event(message: str, *kinds: str, **more: str) -> dict[str, object]:
        arguments = [{"name": f"arg{number}", "type": kind} for number, kind in enumerate(kinds)]
        return {"name": "an_event", "message": message, "arguments": arguments, **more}

    default = {
        "1": event("{3}: switching to {2}", "uint32_t", "px4::failsafe_action_t", "px4::failsafe_cause_t"),
        "2": event("RTL: {1m_v} above, {2:.1m/s}, {3:.3}", "int32_t", "float", "double_t"),
        "3": event("Airspeed max \\< 5 m/s, <param>FW_AIRSPD_MAX</param> set"),
        "4": event("parts: {1}", "parts_t"),
        "5": {"message": "Landing detected"},
    }
    checks = {
        "6": event("No valid data from Compass {3}", "navigation_mode_group_t", "uint8_t", "uint8_t"),
        "7": event("summary", "uint8_t", type="summary"),
    }
    enums = {
        "failsafe_action_t": {"type": "uint8_t", "entries": {"6": {"name": "rtl", "description": "RTL"}}},
        "failsafe_cause_t": {"type": "uint8_t", "entries": {"3": {"name": "low", "description": ""}}},
        "parts_t": {
            "type": "uint16_t",
            "is_bitfield": True,
            "entries": {"1": {"name": "a", "description": "gyro"}, "4": {"name": "b", "description": "baro"}},
        },
        "navigation_mode_group_t": {"type": "uint32_t", "is_bitfield": True, "entries": {}},
    }
    groups = {"default": {"events": default}, "arming_check": {"events": checks}}
    px4 = {"namespace": "px4", "enums": enums, "event_groups": groups}
    return EventCatalogue(json.dumps({"version": 2, "components": {"1": px4}}).encode())


def report_of(number: int, arguments: bytes = b"", levels: int = ERROR) -> Report | None:
    return catalogue().report(Event(1 << 24 | number, 9, levels, arguments.ljust(40, b"\0")), 5)


@pytest.mark.parametrize(
    ("number", "arguments", "text"),
    [
        (1, struct.pack("<IBB", 0, 6, 3), "low: switching to RTL"),
        (1, struct.pack("<IBB", 0, 9, 3), "low: switching to 9"),  # newer than its metadata
        (2, struct.pack("<if", -3, 1.25), "RTL: -3 m above, 1.2 m/s, ?"),  # an argument of an unknown type
        (3, b"", "Airspeed max < 5 m/s, FW_AIRSPD_MAX set"),
        (4, struct.pack("<H", 5), "parts: gyro, baro"),
        (4, struct.pack("<H", 0), "parts: none"),
        (5, b"", "Landing detected"),
        (9, b"", "event 0x01000009 (not in the metadata)"),
    ],
)
def test_event_text(number: int, arguments: bytes, text: str) -> None:
    report = report_of(number, arguments)
    assert report is not None
    assert (report.text, report.level, report.stamp_ns, report.modes) == (text, 3, 5, ALL_MODES)


def test_check_has_its_group_and_modes() -> None:
    report = report_of(6, struct.pack("<IBB", 0x4000, 0, 2))
    text = "No valid data from Compass 2"
    assert report == Report(5, 3, text, "arming_check", "an_event", 0x4000)
    assert report is not None
    assert report.is_check
    info = report_of(6, struct.pack("<IBB", 0x4000, 0, 2), INFO)
    assert info is not None
    assert info.is_check  # such as a missing mission


@pytest.mark.parametrize(("level", "is_check"), [(3, True), (6, False)])
def test_ground_stations_link_is_a_check_only_as_an_error(level: int, is_check: bool) -> None:
    """With NAV_DLL_ACT 0 PX4 reports it for all modes at level info, and arms."""
    report = Report(5, level, "No connection", "arming_check", "check_rc_dl_no_dllink")
    assert report.is_check is is_check


def test_internal_events_are_not_reported() -> None:
    assert report_of(7) is None
    assert report_of(5, levels=PROTOCOL) is None


def test_events_without_metadata_have_numbers() -> None:
    report = EventCatalogue(None).report(Event(0x01ABCDEF, 1, INFO, bytes(40)), 5)
    assert report is not None
    assert report.text.startswith("event 0x01abcdef")


def metadata_with(**event: object) -> bytes:
    """Events metadata of one event, number 1, and a bit field."""
    named = {"name": "an_event", "message": "text", "arguments": [], **event}
    enum = {"type": "uint8_t", "is_bitfield": True, "entries": {"1": {"name": "a", "description": "x" * 900}}}
    group = {"default": {"events": {"1": named}}}
    component = {"namespace": "px4", "enums": {"e": enum}, "event_groups": group}
    return json.dumps({"components": {"1": component}}).encode()


@pytest.mark.parametrize(
    "message",
    [
        "{1:.1000000000}",
        "{1:.99}",
        "{" + "9" * 900 + "}",
        "{1" * 300,
        "<" * 1000,
        "{1}" * 300,
        "{1:>1000000000}",
        "{0}",
        "\\" * 999,
    ],
)
def test_text_of_an_event_is_bounded(message: str) -> None:
    for kind in ("float", "double", "uint64_t", "e", "px4::e"):
        known = EventCatalogue(metadata_with(message=message, arguments=[{"type": kind}]))
        for packed in (b"\0" * 40, b"\xff" * 40, struct.pack("<f", 3e38) + bytes(36)):
            report = known.report(Event(1 << 24 | 1, 9, ERROR, packed), 5)
            assert report is not None
            assert len(report.text) <= 500


def _any_json() -> st.SearchStrategy[object]:
    plain = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5)
    return st.recursive(
        plain,
        lambda each: st.lists(each, max_size=3) | st.dictionaries(st.text(max_size=3), each, max_size=3),
    )


@given(
    st.fixed_dictionaries(
        {}, optional={"name": _any_json(), "message": st.text() | _any_json(), "type": _any_json()}
    ),
    st.lists(st.fixed_dictionaries({}, optional={"type": st.sampled_from(["e", "float"]) | _any_json()})),
    st.binary(min_size=40, max_size=40),
)
def test_any_metadata_is_refused_or_reported(
    event: dict[str, object], arguments: list[dict[str, object]], packed: bytes
) -> None:
    try:
        known = EventCatalogue(metadata_with(**event, arguments=arguments))
    except PeerDataError:
        return
    report = known.report(Event(1 << 24 | 1, 9, ERROR, packed), 5)
    assert report is None or len(report.text) <= 500
