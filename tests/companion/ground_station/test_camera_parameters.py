"""PARAM_EXT over the service's settings, the camera definition, and both beside a real service."""

from __future__ import annotations

import math
import struct
import urllib.request
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.bus.client import set_settings
from companion.ground_station.camera import DEFINITION_WAIT_NS
from companion.ground_station.component import Message
from companion.ground_station.parameters import VEHICLE_MAX_AGE_NS, Parameters, definition
from companion.settings import Settings
from companion.settings.live import describe_live, live_values
from mavlink_sim.testing import QUICK_FLIGHT, free_port, running_simulator
from tests.companion.ground_station.operator_station import CAMERA, OperatorStation, operator_station
from tests.companion.ground_station.station_harness import (
    CAMERA_ID,
    SYSTEM,
    CameraHarness,
    command_long,
    received,
    types,
)
from tests.companion.service_process import running_service

CLASSES = ["person", "car", "boat"]
LIMITS = ["MAX_SPEED", "MAX_CLIMB", "MAX_DESCENT", "MAX_ALT", "MIN_ALT", "MAX_DIST"]
NAMES = ["CONFIDENCE", *LIMITS, "CLASSES"]
REAL32, UINT32 = mavlink.MAV_PARAM_EXT_TYPE_REAL32, mavlink.MAV_PARAM_EXT_TYPE_UINT32
ACCEPTED, UNSUPPORTED = mavlink.PARAM_ACK_ACCEPTED, mavlink.PARAM_ACK_VALUE_UNSUPPORTED
FAILED, IN_PROGRESS = mavlink.PARAM_ACK_FAILED, mavlink.PARAM_ACK_IN_PROGRESS
DISARMED = {"armed": False, "connected": True}
MS = 1_000_000


def number(value: float) -> bytes:
    return struct.pack("<f", value)


def whole(value: int) -> bytes:
    return struct.pack("<I", value)


def set_message(
    name: str, value: bytes, kind: int = REAL32, target: tuple[int, int] = (SYSTEM, CAMERA_ID)
) -> Message:
    return mavlink.MAVLink_param_ext_set_message(*target, name.encode(), value, kind)


class Bench:
    """The parameters of a camera and a service, whose answers the test gives."""

    def __init__(
        self, camera: str | None = None, *, detects: bool = True, classes: list[str] | None = None
    ) -> None:
        self.harness = CameraHarness(None)
        self.queries: list[tuple[Mapping[str, Any] | None, Callable[[Mapping[str, Any]], None]]] = []
        self.said: list[str] = []
        self.parameters = Parameters(
            camera,
            self.harness.camera.requests,
            detects=detects,
            query=lambda values, on_reply: self.queries.append((values, on_reply)),
            say=lambda _, text: self.said.append(text),
        )
        self.harness.camera.sources.append(self.parameters.due)
        settings = Settings.model_validate({"cameras": {"down": {"source": {"uri": "none"}}}})
        self.file, self.now = live_values(settings), live_values(settings)
        self.class_names = CLASSES if classes is None else classes
        self.service = "a"
        self.vehicle(DISARMED)
        self.status()
        if self.queries:
            self.answer()
        self.harness.due()

    def vehicle(self, body: Any) -> None:
        self.parameters.on_vehicle(body, self.harness.now_ns)

    def status(self) -> None:
        about = {"class_names": self.class_names}
        changed = [key for key, value in self.now.items() if value != self.file[key]]
        status: Any = {"perception": about, "cameras": {"down": about}, "service": self.service}
        self.parameters.on_status(status | {"changed_settings": [(key, self.now[key]) for key in changed]})

    def answer(self, failure: tuple[str, bool] | None = None) -> Mapping[str, Any] | None:
        """Answer the oldest query as the service does, or with (reason, refused); returns its values."""
        values, on_reply = self.queries.pop(0)
        if failure is not None:
            on_reply({"success": False, "reason": failure[0], "refused": failure[1]})
            return values
        self.now |= values or {}
        settings = {
            key: {"value": value, "file": self.file[key], **describe_live(key)}
            for key, value in self.now.items()
        }
        on_reply({"success": True, "settings": settings})
        return values

    def ask(self, message: Message) -> list[Message]:
        """What it answers and sends then."""
        return [*self.harness.ask(received(message)), *self.due()]

    def due(self) -> list[Message]:
        return [each for each in self.harness.due() if each.get_type().startswith("PARAM")]

    def values(self) -> dict[str, Any]:
        messages = self.ask(mavlink.MAVLink_param_ext_request_list_message(SYSTEM, CAMERA_ID))
        assert [each.param_index for each in messages] == list(range(len(messages)))
        assert {each.param_count for each in messages} <= {len(messages)}
        return {each.param_id: value_of(each) for each in messages}


def value_of(message: Message) -> float:
    layout = {REAL32: "<f", UINT32: "<I"}[message.param_type]
    (value,) = struct.unpack_from(layout, message._param_value_raw.ljust(4, b"\0"))
    return float(value)


def results(messages: list[Message]) -> list[int]:
    return [each.param_result for each in messages if each.get_type() == "PARAM_EXT_ACK"]


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_list_has_every_parameter_of_the_first_camera(bench: Bench) -> None:
    values = bench.values()
    assert list(values) == NAMES
    assert values == pytest.approx(dict(zip(NAMES, [0.25, 5, 2, 1, 50, 1, 200, 0], strict=True)))


@pytest.mark.parametrize(
    ("camera", "detects", "classes", "names"),
    [
        ("down", True, CLASSES, ["CONFIDENCE", "CLASSES"]),
        (None, False, [], LIMITS),
        (None, True, [], ["CONFIDENCE", *LIMITS]),
        ("down", False, [], []),
    ],
)
def test_parameters_of_a_camera(
    camera: str | None, detects: bool, classes: list[str], names: list[str]
) -> None:
    bench = Bench(camera, detects=detects, classes=classes)
    assert list(bench.values()) == names
    assert bench.parameters.are_complete == (bool(names) and (bool(classes) or not detects))


@pytest.mark.parametrize(
    ("name", "index", "found"),
    [
        (b"CONFIDENCE", -1, ["CONFIDENCE"]),
        (b"CLASSES", -1, ["CLASSES"]),
        (b"", 4, ["MAX_ALT"]),
        (b"CLASSES", 0, ["CONFIDENCE"]),
        (b"", 7, ["CLASSES"]),
        (b"", 8, []),
        (b"", 32767, []),
        (b"", -1, []),
        (b"confidence", -1, []),
        (b"\xff\xfe\x00X", -1, []),
        (b"0123456789abcdef", -1, []),
    ],
)
def test_read_by_name_and_by_index(bench: Bench, name: bytes, index: int, found: list[str]) -> None:
    request = mavlink.MAVLink_param_ext_request_read_message(SYSTEM, CAMERA_ID, name, index)
    assert [each.param_id for each in bench.ask(request)] == found


@pytest.mark.parametrize(
    ("name", "value", "kind", "setting"),
    [
        ("CONFIDENCE", number(0.3), REAL32, {"detector.confidence": 0.3}),
        ("CONFIDENCE", number(0.0), REAL32, {"detector.confidence": 0.0}),
        ("MAX_SPEED", number(7.1), REAL32, {"guidance.max_horizontal_speed_mps": 7.1}),
        ("MAX_DIST", number(1234.5), REAL32, {"guidance.max_distance_m": 1234.5}),
        ("CLASSES", whole(2), UINT32, {"detector.classes": ["car"]}),
        ("CLASSES", whole(0), UINT32, {"detector.classes": []}),
    ],
)
def test_set_is_acknowledged_when_the_service_has_it(
    bench: Bench, name: str, value: bytes, kind: int, setting: dict[str, Any]
) -> None:
    assert bench.ask(set_message(name, value, kind)) == []
    assert bench.answer() == setting
    messages = bench.due()
    assert results(messages) == [ACCEPTED]
    assert messages[-1]._param_value_raw.ljust(4, b"\0") == value
    assert bench.queries == []
    assert bench.said == []
    assert bench.values()[name] == value_of(messages[-1])


@pytest.mark.parametrize(
    ("name", "value", "kind"),
    [
        ("CONFIDENCE", number(math.nan), REAL32),
        ("CONFIDENCE", number(math.inf), REAL32),
        ("CONFIDENCE", number(-0.1), REAL32),
        ("CONFIDENCE", number(1.1), REAL32),
        ("CONFIDENCE", whole(1), UINT32),
        ("MAX_SPEED", number(31.0), REAL32),
        ("CLASSES", whole(4), UINT32),
        ("CLASSES", whole(2**32 - 1), UINT32),
        ("CLASSES", number(1.0), REAL32),
        ("CLASSES", b"car", mavlink.MAV_PARAM_EXT_TYPE_CUSTOM),
        ("CONFIDENCE", number(0.3), 255),
    ],
)
def test_value_that_cannot_be_is_not_sent_to_the_service(
    bench: Bench, name: str, value: bytes, kind: int
) -> None:
    before = bench.values()
    messages = bench.ask(set_message(name, value, kind))
    assert results(messages) == [UNSUPPORTED]
    assert [value_of(each) for each in messages] == [before[name]] * 2
    assert bench.queries == []
    assert len(bench.said) == 1


@pytest.mark.parametrize(
    "body", [{"armed": True, "connected": True}, {"armed": False, "connected": False}, None]
)
def test_parameters_are_read_only_unless_disarmed(bench: Bench, body: Any) -> None:
    if body is None:
        bench.harness.now_ns += VEHICLE_MAX_AGE_NS + MS
        bench.harness.due()
    else:
        bench.vehicle(body)
    messages = bench.ask(set_message("CONFIDENCE", number(0.5)))
    assert types(messages) == ["PARAM_EXT_ACK", "PARAM_EXT_VALUE"]
    assert results(messages) == [FAILED]
    assert [value_of(each) for each in messages] == [0.25, 0.25]
    assert bench.queries == []
    assert len(bench.said) == 1
    assert list(bench.values()) == NAMES


def test_vehicle_that_was_never_received_is_read_only() -> None:
    bench = Bench()
    bench.parameters._armed = None
    assert results(bench.ask(set_message("MAX_ALT", number(20.0)))) == [FAILED]


def test_change_that_waits_is_refused_when_the_vehicle_arms(bench: Bench) -> None:
    bench.ask(set_message("CONFIDENCE", number(0.5)))
    bench.ask(set_message("MAX_ALT", number(60.0)))
    bench.vehicle({"armed": True, "connected": True})
    bench.answer()
    assert results(bench.due()) == [ACCEPTED, FAILED]
    assert bench.queries == []


@pytest.mark.parametrize("name", ["MAX_ALTITUDE", "", "\N{REPLACEMENT CHARACTER}", "0123456789abcdef"])
def test_set_of_an_unknown_parameter_fails(bench: Bench, name: str) -> None:
    message = mavlink.MAVLink_param_ext_set_message(SYSTEM, CAMERA_ID, name.encode(), number(1.0), REAL32)
    assert results(bench.ask(message)) == [FAILED]
    assert bench.ask(set_message(name, number(1.0), target=(SYSTEM, 0))) == []
    assert bench.queries == []


@pytest.mark.parametrize(("refused", "result"), [(True, UNSUPPORTED), (False, FAILED)])
def test_rejection_by_the_service_has_its_reason(bench: Bench, refused: bool, result: int) -> None:
    bench.ask(set_message("MAX_ALT", number(0.5)))
    bench.answer(("settings: it must be higher", refused))
    messages = bench.due()
    assert results(messages) == [result]
    assert [value_of(each) for each in messages] == [50.0, 50.0]
    assert "settings: it must be higher" in bench.said[0]


def test_late_answer_is_in_progress_and_repetitions_ask_once(bench: Bench) -> None:
    message = set_message("CONFIDENCE", number(0.5))
    assert bench.ask(message) == []
    assert results(bench.ask(message)) == [IN_PROGRESS]
    bench.harness.now_ns += 600 * MS
    assert results(bench.due()) == [IN_PROGRESS]
    assert bench.due() == []
    bench.answer()
    assert results(bench.due()) == [ACCEPTED]
    assert bench.queries == []


def test_newest_of_several_values_is_set_last(bench: Bench) -> None:
    for value in (0.3, 0.4, 0.5):
        bench.ask(set_message("CONFIDENCE", number(value)))
    assert bench.answer() == {"detector.confidence": 0.3}
    assert bench.answer() == {"detector.confidence": 0.5}
    assert bench.queries == []
    assert results(bench.due()) == [ACCEPTED, ACCEPTED]
    assert bench.values()["CONFIDENCE"] == 0.5


def test_change_by_others_is_sent(bench: Bench) -> None:
    bench.status()
    assert bench.queries == []
    bench.now |= {"guidance.max_altitude_m": 20.0, "detector.classes": ["car", 2]}
    bench.status()
    bench.answer()
    assert {each.param_id: value_of(each) for each in bench.due()} == {"MAX_ALT": 20.0, "CLASSES": 4}
    assert bench.parameters.now[-1].options[4] == ("car", "boat")
    bench.status()
    assert bench.queries == []
    assert bench.due() == []


@pytest.mark.parametrize("change", ["service", "class_names"])
def test_new_service_or_model_is_asked_again(bench: Bench, change: str) -> None:
    setattr(bench, change, "b" if change == "service" else ["cat"])
    bench.status()
    assert bench.answer() is None
    assert len(bench.parameters.now[-1].options) == (4 if change == "service" else 2)


def test_question_without_an_answer_is_repeated(bench: Bench) -> None:
    bench.service = "b"
    bench.status()
    bench.answer(("no answer", False))
    assert bench.queries == []
    assert bench.said == []
    bench.status()
    assert len(bench.queries) == 1


def test_definition_has_the_parameters_and_their_ranges(bench: Bench) -> None:
    content, version = definition("camera", bench.parameters.now)
    root = ElementTree.fromstring(content)
    about = root.find("definition")
    assert about is not None
    assert about.attrib == {"version": str(version)}
    assert [about.findtext("model"), about.findtext("vendor")] == ["camera", "companion"]
    elements = root.findall("parameters/parameter")
    assert [each.get("name") for each in elements] == NAMES
    for element, parameter in zip(elements, bench.parameters.now, strict=True):
        assert len(parameter.name) <= 16
        assert element.findtext("description")
        assert float(element.attrib["default"]) == parameter.value
        if parameter.options:
            assert element.get("type") == "uint32"
            listed = [(each.get("name"), each.get("value")) for each in element.iter("option")]
            assert listed == [("all", "0"), ("person", "1"), ("car", "2"), ("boat", "3")]
        else:
            bounds = describe_live(parameter.key)
            assert element.get("type") == "float"
            assert float(element.attrib["max"]) == bounds["maximum"]
            assert 0 <= float(element.attrib["min"]) - bounds["minimum"] <= float(element.attrib["step"])


def test_version_changes_with_the_content_alone(bench: Bench) -> None:
    first = definition("camera", bench.parameters.now)
    bench.ask(set_message("MAX_ALT", number(20.0)))
    bench.answer()
    assert definition("camera", bench.parameters.now) == first
    strange = Bench(classes=['a <b> & "c"', "bell\a"])
    content, version = definition("camera", strange.parameters.now)
    assert 0 < version < 2**16
    assert version != first[1]
    names = [each.get("name") for each in ElementTree.fromstring(content).iter("option")]
    assert names == ["all", 'a <b> & "c"', "bell?"]


def test_information_waits_for_the_definition() -> None:
    harness = CameraHarness(None)
    camera = harness.camera
    camera.needs_definition = True
    request = command_long(512, mavlink.MAVLINK_MSG_ID_CAMERA_INFORMATION)
    assert types(harness.ask(request)) == ["COMMAND_ACK"]
    camera.define("http://127.0.0.1/camera.xml", 7)
    (sent,) = [each for each in harness.due() if each.get_type() == "CAMERA_INFORMATION"]
    assert (sent.cam_definition_uri, sent.cam_definition_version) == ("http://127.0.0.1/camera.xml", 7)
    camera.needs_definition = True  # as of one that never comes
    harness.now_ns += DEFINITION_WAIT_NS + MS
    assert "CAMERA_INFORMATION" in types(harness.due())


# --- beside a real service


class ParameterStation:
    """A station that reads and sets parameters."""

    def __init__(self, station: OperatorStation) -> None:
        self.station = station
        station.until(lambda: station.of("HEARTBEAT"), 60.0, "a camera")

    def set(self, name: str, value: bytes, kind: int = REAL32) -> int:
        """Set a parameter, and return the final result."""
        station, begun = self.station, len(self.station.messages)
        station._send(mavlink.MAVLink_param_ext_set_message(1, CAMERA, name.encode(), value, kind))

        def final() -> list[int]:
            acks = [each for _, each in station.of("PARAM_EXT_ACK", begun) if each.param_id == name]
            return [each.param_result for each in acks if each.param_result != IN_PROGRESS]

        station.until(final, 20.0, f"an answer to {name}")
        return final()[0]

    def until_accepted(self, name: str, value: bytes) -> None:
        """Set it, again while the service is not there yet."""
        tries = 0
        while self.set(name, value) != ACCEPTED:
            tries += 1
            assert tries < 100, self.station.texts()
            begun = len(self.station.messages)
            self.station.until(lambda: self.station.of("HEARTBEAT", begun), 10.0, "a heartbeat")  # noqa: B023


@pytest.mark.realtime
def test_station_changes_a_running_service_until_it_arms(seeing: list[str], tmp_path: Path) -> None:
    port = free_port()
    video = ["--ground-station-video-listen", f"127.0.0.1:{port}"]
    with (
        operator_station() as (station, url),
        running_simulator(parameters=QUICK_FLIGHT) as simulator,
        running_service(
            simulator.onboard_port, [*seeing, *video, "--ground-station-url", url], cwd=tmp_path
        ) as service,
        service.client() as session,
    ):
        operator = ParameterStation(station)
        operator.until_accepted("CONFIDENCE", number(0.4))
        assert operator.set("MAX_ALT", number(60.0)) == ACCEPTED
        assert operator.set("MAX_ALT", number(0.5)) == UNSUPPORTED  # below min_altitude_m
        settings = set_settings(session, "vehicle1")
        assert settings["detector.confidence"]["value"] == 0.4
        assert settings["guidance.max_altitude_m"]["value"] == 60.0

        def informations() -> list[Any]:
            return [each for _, each in station.of("CAMERA_INFORMATION") if each.cam_definition_uri]

        station.until(informations, 60.0, "a definition")
        information = informations()[-1]
        assert information.cam_definition_uri == f"http://127.0.0.1:{port}/camera.xml"
        with urllib.request.urlopen(information.cam_definition_uri, timeout=10.0) as reply:
            root = ElementTree.fromstring(reply.read())
        assert [each.get("name") for each in root.iter("parameter")] == NAMES
        assert root.find(f"definition[@version='{information.cam_definition_version}']") is not None
        assert operator.set("CLASSES", whole(1), UINT32) == ACCEPTED
        chosen = set_settings(session, "vehicle1")["detector.classes"]["value"]
        assert chosen == [root.findall(".//option")[1].get("name")]

        begun = len(station.messages)
        set_settings(session, "vehicle1", {"detector.confidence": 0.1})
        station.until(
            lambda: [
                each
                for _, each in station.of("PARAM_EXT_VALUE", begun)
                if each.param_id == "CONFIDENCE" and value_of(each) == pytest.approx(0.1)
            ],
            20.0,
            "the value that another has set",
        )
        service.take_off(2.0)
        assert operator.set("MAX_ALT", number(20.0)) == FAILED
        assert set_settings(session, "vehicle1")["guidance.max_altitude_m"]["value"] == 60.0
        station.until(lambda: any("read-only" in text for text in station.texts()), 20.0, "a reason")
