"""The service's tap: bounded queues, and nothing is encoded while no recorder listens."""

from __future__ import annotations

import json
from typing import Any

import pytest

from companion.bench.lockstep_flight import plain_settings
from companion.bus.topics import GUIDANCE_INPUT, GUIDANCE_OUTPUT, MAVLINK, RUN, Topic
from companion.guidance.behaviour import Outcome
from companion.guidance.core import GuidanceOptions
from companion.guidance.gimbal.controller import GimbalMounting
from companion.guidance.interface import CommandResult, GuidanceInput, GuidanceOutput
from companion.guidance.objects.from_detections import HistorySamples
from companion.recording.guidance_record import StepContext
from companion.recording.link_bytes import unpack_link_bytes
from companion.recording.tap import MAX_PIECES, MAX_STEPS, FlightTap, run_record
from companion.settings import Settings
from companion.settings.reading import changed
from companion.vehicle.state import VehicleState

INPUT, NOTHING = GuidanceInput(VehicleState()), GuidanceOutput(None)


class BusOfTest:
    """Keeps what is published; `listening` says whether a recorder listens."""

    def __init__(self, listening: bool) -> None:
        self.listening = listening
        self.published: list[tuple[Topic, Any]] = []

    def watched(self, topic: Topic) -> bool:
        return self.listening

    def publish(self, topic: Topic, value: Any) -> None:
        self.published.append((topic, value))

    def of(self, topic: Topic) -> list[Any]:
        return [value for published, value in self.published if published is topic]


def tap_on(bus: BusOfTest, *, expected: bool = False) -> FlightTap:
    return FlightTap(bus, {"service": "service1"}, expected=expected)  # type: ignore[arg-type]


def step(tap: FlightTap, output: GuidanceOutput = NOTHING) -> None:
    tap.on_step(1, StepContext(GimbalMounting(), "{}", HistorySamples()), INPUT, output)


def test_steps_and_bytes_are_published_in_order() -> None:
    bus = BusOfTest(listening=True)
    tap = tap_on(bus)
    for number in range(3):
        step(tap)
        tap.on_bytes(number == 1, bytes([number]))
    tap._publish()
    assert bus.published[0] == (RUN, b'{"service":"service1"}')
    assert [json.loads(value)["step"] for value in bus.of(GUIDANCE_INPUT)] == [0, 1, 2]
    assert [json.loads(value)["step"] for value in bus.of(GUIDANCE_OUTPUT)] == [0, 1, 2]
    (packed,) = bus.of(MAVLINK)
    assert [(number, piece.sent, piece.data) for number, piece in unpack_link_bytes(packed)] == [
        (0, False, b"\0"),
        (1, True, b"\1"),
        (2, False, b"\2"),
    ]


def test_oldest_is_dropped_and_the_numbers_show_it() -> None:
    bus = BusOfTest(listening=True)
    tap = tap_on(bus)
    for _ in range(MAX_STEPS + 5):
        step(tap)
    for _ in range(MAX_PIECES + 7):
        tap.on_bytes(True, b"")
    tap._publish()
    assert json.loads(bus.of(GUIDANCE_INPUT)[0])["step"] == 5
    assert len(bus.of(GUIDANCE_OUTPUT)) == MAX_STEPS
    numbers = [number for packed in bus.of(MAVLINK) for number, _ in unpack_link_bytes(packed)]
    assert numbers == list(range(7, MAX_PIECES + 7))


def test_first_steps_wait_only_for_an_expected_recorder() -> None:
    for expected, first in ((False, 2), (True, 0)):
        bus = BusOfTest(listening=False)
        tap = tap_on(bus, expected=expected)
        step(tap)
        step(tap)
        tap._publish()
        assert bus.published == []
        bus.listening = True
        step(tap)
        tap._publish()
        assert json.loads(bus.of(GUIDANCE_INPUT)[0])["step"] == first


@pytest.mark.parametrize("expected", [False, True])
def test_steps_wait_for_an_expected_recorder_that_ended(expected: bool) -> None:
    bus = BusOfTest(listening=True)
    tap = tap_on(bus, expected=expected)
    for bus.listening in (True, False, False, True):
        step(tap)
        tap.on_bytes(True, b"a")
        tap._publish()
    steps = [json.loads(value)["step"] for value in bus.of(GUIDANCE_INPUT)]
    assert steps == ([0, 1, 2, 3] if expected else [0, 3])
    pieces = [number for packed in bus.of(MAVLINK) for number, _ in unpack_link_bytes(packed)]
    assert pieces == steps


def test_step_that_cannot_be_encoded_is_left_out(caplog: Any) -> None:
    bus = BusOfTest(listening=True)
    tap = tap_on(bus)
    of_a_plug_in = CommandResult(1, Outcome(True, object()))  # type: ignore[arg-type]
    for _ in range(2):
        step(tap, GuidanceOutput(None, results=(of_a_plug_in,)))
    step(tap)
    tap._publish()
    assert [json.loads(value)["step"] for value in bus.of(GUIDANCE_INPUT)] == [2]
    assert len(caplog.records) == 1


def test_recorded_settings_are_valid_and_have_no_source() -> None:
    keys = {"source.uri": "rtsp://user:secret@host/a", "cameras.down.source.uri": "/dev/video2"}
    run = run_record(plain_settings(keys), GuidanceOptions(), "service1")
    assert "secret" not in json.dumps(run)
    settings = Settings.from_json(json.loads(json.dumps(run["settings"])))
    assert list(settings.cameras) == ["down"]
    assert changed(settings, {"guidance.brake_s": "1"}).guidance.brake_s == 1.0
