"""An object is one value: flown to, published, recorded and replayed, to the last bit."""

from __future__ import annotations

import json
import math
from dataclasses import fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from benchmarks import flights_land
from benchmarks.rendered import camera_settings
from companion.bench.lockstep_flight import LockstepFlight
from companion.bench.synthetic_camera import SyntheticCamera
from companion.bench.synthetic_detector import SceneObject, ScenePose, SyntheticDetector
from companion.bus.session import encode as encode_message
from companion.bus.topics import DETECTIONS, MARKERS, RUN, TRACKS, Topic
from companion.guidance.interface import GuidanceInput, GuidanceOutput
from companion.guidance.objects.in_view import ObjectsInView
from companion.guidance.objects.tracked_object import Subject, TrackedObject
from companion.logs.replay import replay
from companion.perception.cameras import PerceptionCamera
from companion.recording.convert import INPUT_CHANNEL, Converter
from companion.recording.encoding import dumps, encode
from companion.recording.files import RecordingReader
from companion.recording.guidance_record import read_step
from companion.recording.tap import run_record
from companion.service.publisher import Publisher, localization_of
from companion.vehicle.landing_target import LandingTarget
from tests.companion.bus.message_check import check_message
from tests.companion.guidance.guidance_harness import in_the_air
from tests.companion.recording.lockstep_recording import new_writer, recording
from vision.camera_model import CameraModel, CameraMount
from vision.pipeline import PerceptionResult

CAMERA = CameraModel.from_horizontal_fov(640, 480, math.radians(80.0))
MOUNT = CameraMount(pitch_rad=math.radians(-15.0))
CAR = (4.2, 1.8, 1.5)


def chosen(seconds: float) -> ScenePose:
    return ScenePose(14.0 + 0.2 * seconds, 0.3 * seconds, 0.3)


def crossing(seconds: float) -> ScenePose:
    """Passes before the other one."""
    return ScenePose(9.0, -5.0 + 2.5 * seconds, math.pi / 2)


class Published:
    """What the service's publisher gives to its bus: (topic's name, bytes)."""

    def __init__(self, flight: LockstepFlight) -> None:
        self.messages: list[tuple[str, bytes]] = []
        publisher = Publisher("vehicle1", self, flight.driver, flight.inputs, None)  # type: ignore[arg-type]
        on_result = flight.inputs.on_result

        def publishing(camera: PerceptionCamera, result: PerceptionResult) -> Any:
            markers = on_result(camera, result)
            publisher.publish_result(camera, result, markers, localization_of(camera))  # type: ignore[arg-type]
            return markers

        flight.inputs.on_result = publishing  # type: ignore[method-assign]
        nothing = SimpleNamespace(ready=None, published=lambda result: None)
        flight.inputs.steering.supervisor = nothing  # type: ignore[attr-defined]

    def publish(self, topic: Topic, body: Any, view: str | None = None) -> None:
        message = body() if callable(body) else body
        if topic in (DETECTIONS, TRACKS, MARKERS):
            check_message(topic.name, message)
            self.messages.append((topic.name, encode_message(message)))


def recorded_messages(
    published: Published, flight: LockstepFlight, folder: Path, *topics: Topic
) -> list[tuple[str, Any]]:
    """Those of some topics, as they are read from a recording."""
    writer, converter = new_writer(folder), Converter("vehicle1")
    run = run_record(flight.settings, flight.guidance.options, "service1")
    for name, payload in [(RUN.name, dumps(run)), *published.messages]:
        for message in converter.convert(name, payload, None):
            writer.write(*message)
    writer.close()
    read = RecordingReader(writer.path).messages(*(topic.name for topic in topics))
    return [(message.channel.topic, json.loads(message.data)) for message in read]


def as_published(each: TrackedObject) -> dict[str, Any]:
    """Its fields by their names."""
    values = {field.name: getattr(each, field.name) for field in fields(each) if field.name != "detection"}
    values["covariance"] = [value for row in each.covariance for value in row]
    return {key: list(value) if isinstance(value, tuple) else value for key, value in values.items()}


@pytest.mark.parametrize(
    "command",
    [
        "approach car",
        *(pytest.param(each, marks=pytest.mark.slow) for each in ("follow car", "orbit car radius=8")),
    ],
)
def test_object_is_the_same_value_everywhere(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = [SceneObject("car", CAR, chosen), SceneObject("car", CAR, crossing)]
    detector = SyntheticDetector(scene, CAMERA, MOUNT, seed=5)
    camera = SyntheticCamera(camera_settings(CAMERA, MOUNT, {}), detect=detector)
    flight = LockstepFlight.of_vehicle(in_the_air(seed=3, noise=0.0), camera=camera)
    published, step = Published(flight), flight.guidance.step
    flown: dict[int, tuple[TrackedObject, ...]] = {}  # by capture, as behaviours get them
    steered: list[TrackedObject] = []

    def watching(now_ns: int, inputs: GuidanceInput) -> GuidanceOutput:
        output = step(now_ns, inputs)
        context = flight.guidance.context
        assert context is not None
        if inputs.seen_ns is not None:
            flown[inputs.seen_ns] = context.objects.objects
        return output

    def choosing(view: ObjectsInView, subject: Subject, confidence: float = 0.0) -> TrackedObject | None:
        found = of(view, subject, confidence)
        if found is not None:
            assert any(found is each for each in view.objects)
            steered.append(found)
        return found

    of = ObjectsInView.of
    monkeypatch.setattr(ObjectsInView, "of", choosing)
    flight.guidance.step = watching  # type: ignore[method-assign]
    with recording(flight, tmp_path / "steps") as path:
        flight.run(1.0)
        flight.command(command)
        flight.run(8.0)

    # Published and recorded.
    read = recorded_messages(published, flight, tmp_path / "messages", DETECTIONS, TRACKS)
    assert {topic for topic, _ in read} == {DETECTIONS.name, TRACKS.name}
    for topic, message in read:
        expected = {each.object_id: each for each in flown[message["captured_ns"]]}
        published_ids = [body["object_id"] for body in message["objects"]]
        if topic == DETECTIONS.name:
            assert published_ids == list(expected)
            for detection in message["detections"]:
                seen = expected.get(detection["object_id"])
                assert seen is None or detection["xyxy"] == list(seen.detection.box_xyxy)
        else:
            named = {event["object_id"] for event in message["events"]} - {None}
            assert named == set(published_ids)
        for body in message["objects"]:
            values = as_published(expected[body["object_id"]])
            assert {key: body[key] for key in values} == values
    seen_ids = {detection["object_id"] for _, message in read for detection in message.get("detections", ())}
    assert seen_ids >= {1, 2}
    everything = [each for objects in flown.values() for each in objects]
    assert {each.occluded for each in everything} == {each.moving for each in everything} == {True, False}
    assert len(steered) > 50

    # Recorded as guidance's input, and replayed.
    steps = [read_step(json.loads(message.data)) for message in RecordingReader(path).messages(INPUT_CHANNEL)]
    for recorded in steps:
        if recorded.inputs.seen_ns is not None:
            objects = flown[recorded.inputs.seen_ns]
            kind = tuple[TrackedObject, ...]
            assert encode(kind, recorded.inputs.objects) == encode(kind, objects)  # NaN included
    assert len(steps) > 100
    assert replay([path], {}).first is None


def test_pad_is_the_same_value_everywhere(tmp_path: Path) -> None:
    """In a message, in the recording, as it is flown to, and as the autopilot gets it."""
    pad = flights_land.Pad((1.0, 0.5), 0.7)
    finder = flights_land.ProjectedCamera(pad, flights_land.MOUNT, np.random.default_rng(3))
    settings = camera_settings(flights_land.CAMERA, flights_land.MOUNT, flights_land.MARKER_SETTINGS)
    camera = SyntheticCamera(settings, find_markers=finder.look, rate_hz=20.0)
    flight = LockstepFlight.of_vehicle(in_the_air(seed=3, height_m=6.0), camera=camera)
    published, step = Published(flight), flight.guidance.step
    flown: dict[int, TrackedObject] = {}
    targets: list[LandingTarget] = []

    def watching(now_ns: int, inputs: GuidanceInput) -> GuidanceOutput:
        output = step(now_ns, inputs)
        context = flight.guidance.context
        assert context is not None
        chosen = context.below.of(Subject(marker_id=flights_land.MIDDLE))
        if chosen is not None:
            assert any(chosen is each for each in context.below.markers)
            flown.setdefault(chosen.last_ns, chosen)
        if (target := output.landing_target) is not None:
            targets.append(target)
            # ArduPilot gets it in the body's frame at the capture.
            pose = flight.inputs.history.at(target.captured_ns)
            place = pose.ned_from_body @ target.offset_frd_m + pose.position_ned_m
            assert tuple(place) == pytest.approx(target.position_ned_m, abs=1e-9)
        return output

    flight.guidance.step = watching  # type: ignore[method-assign]
    sent: list[Any] = []
    send = flight.vehicle.send

    def sending(message: Any) -> None:
        sent.append(message)
        send(message)

    flight.vehicle.send = sending  # type: ignore[method-assign, assignment]
    with recording(flight, tmp_path / "steps") as path:
        flight.run(1.0)
        flight.command(f"land-on-marker {flights_land.MIDDLE} method=autopilot")
        flight.run(5.0)

    read = [message for _, message in recorded_messages(published, flight, tmp_path / "messages", MARKERS)]
    messages = {message["captured_ns"]: message for message in read}
    on_wire = {each.time_usec: each for each in sent if each.get_type() == "LANDING_TARGET"}
    assert len(targets) > 50
    assert len(on_wire) == len(targets)
    for target in targets:
        chosen = flown[target.captured_ns]
        [body] = [
            each
            for each in messages[target.captured_ns]["objects"]
            if each["class_name"] == f"marker {flights_land.MIDDLE}"
        ]
        values = as_published(chosen)
        assert {key: body[key] for key in values} == values
        assert target.position_ned_m == chosen.position_ned_m
        assert target.identifier == chosen.track_id
        message = on_wire[target.captured_ns // 1000]
        assert (message.x, message.y, message.z) == chosen.position_ned_m
        assert message.target_num == chosen.track_id
    assert replay([path], {}).first is None
