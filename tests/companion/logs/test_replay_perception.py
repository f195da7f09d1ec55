"""Perception and guidance again over recorded images: what is equal, what differs and why."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
import pytest

from benchmarks.rendered import camera_settings, rendered_scene
from companion.bench.lockstep_flight import LockstepFlight
from companion.bench.rendered_camera import RenderedCamera
from companion.bench.synthetic_detector import SceneObject, ScenePose
from companion.bus.messages import ModelIdentity
from companion.bus.topics import STATUS
from companion.logs.replay import replay, report
from companion.logs.replay_perception import DEPTH_INEXACT, SAMPLES_INEXACT, _as_in_flight
from companion.recording import RecordingError
from companion.recording.convert import ANY_OBJECT, INPUT_CHANNEL, RUN_CHANNEL
from companion.recording.files import Channel, Recorded
from companion.settings.perception import DEFAULT_MODEL, DetectorSection
from mavlink_sim.lockstep import LockstepVehicle
from tests.companion.command_line import companion_here
from tests.companion.recording.lockstep_recording import recording, rewritten
from vision.attitude import euler_from_quaternion
from vision.camera_model import CameraModel, CameraMount
from vision.depth import depth_millimetres
from vision.detector import open_detector
from vision.frame import Frame
from vision.object_detector import DetectorSettings
from vision.pipeline import PerceptionResult
from vision.sources.depth_images import to_metres

CAMERA = CameraModel.from_horizontal_fov(480, 360, math.radians(80.0))
MOUNT = CameraMount(forward_m=0.1, pitch_rad=math.radians(-10.0))
SETTINGS = {"detector.image_size": "256", "detector.threads": "1", "preview.annotate": "false"}

open_once = cache(open_detector)


@pytest.fixture(scope="module", autouse=True)
def models_loaded_once() -> Iterator[None]:
    """Loading takes as long as a replay, and a network keeps nothing from one frame to the next."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("vision.detector.open_detector", open_once)
        yield


@pytest.fixture(scope="module")
def lossless(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recorded approach to a car, with PNG images and the depth of a camera that delivers millimetres."""
    return _approach(tmp_path_factory.mktemp("lossless"), _depth_camera, 6.0)


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The beginning of the same without depth."""
    return _approach(tmp_path_factory.mktemp("short"), _camera, 3.0)


def _approach(folder: Path, camera: Callable[[LockstepVehicle], RenderedCamera], seconds: float) -> Path:
    flight = LockstepFlight.airborne(seed=11, height_m=3.0, wind_mps=1.0, camera=camera)
    detector = open_once("yolo", DetectorSettings(DEFAULT_MODEL, image_size=256, threads=1))
    with recording(flight, folder, images=".png", model=ModelIdentity("own", detector.model_sha256)) as path:
        approach = "approach car distance=8"
        assert flight.fly(approach, seconds).moments
    return path


def _camera(vehicle: LockstepVehicle, *, depth: bool = False) -> RenderedCamera:
    """It sees a car 14 m ahead."""
    yaw_rad = euler_from_quaternion(vehicle.truth.quaternion)[2]
    pose = ScenePose(14.0 * math.cos(yaw_rad), 14.0 * math.sin(yaw_rad), 1.2)
    car = SceneObject("car", (4.2, 1.8, 1.5), lambda _: pose)
    scene, _ = rendered_scene([car], CAMERA, MOUNT, 11, depth=depth)
    settings = camera_settings(CAMERA, MOUNT, SETTINGS)
    return RenderedCamera(settings, scene, vehicle, depth=depth, rate_hz=5.0)


def _depth_camera(vehicle: LockstepVehicle) -> RenderedCamera:
    """The same with depth in whole millimetres."""
    camera = _camera(vehicle, depth=True)
    process = camera.perception.process

    def process_millimetres(frame: Frame, now_ns: int) -> PerceptionResult | None:
        assert frame.depth_m is not None
        return process(replace(frame, depth_m=to_metres(depth_millimetres(frame.depth_m), None)), now_ns)

    camera.perception.process = process_millimetres  # type: ignore[method-assign]
    return camera


def test_lossless_images_and_the_same_model_give_the_flight(lossless: Path) -> None:
    found = replay([lossless], {}, DEFAULT_MODEL)
    detections = found.detections
    assert detections is not None
    assert (detections.same_model, detections.image_formats) == (True, ["png"])
    assert detections.images == detections.frames == detections.identical_images > 25
    assert detections.recorded == detections.replayed > 25
    assert detections.depth_images == detections.images
    assert (found.first, found.differing_steps, found.timeline) == (None, 0, [])
    assert found.inexact == [DEPTH_INEXACT]


def test_lossless_replay_without_depth_has_no_reservations(short: Path) -> None:
    found = replay([short], {}, DEFAULT_MODEL)
    detections = found.detections
    assert detections is not None
    assert detections.images == detections.frames == detections.identical_images > 10
    assert detections.recorded == detections.replayed > 10
    assert detections.depth_images == 0
    assert (found.first, found.differing_steps, found.timeline, found.inexact) == (None, 0, [], [])


def test_flight_with_depth_ranges_replays_without_it_as_inexact(lossless: Path, tmp_path: Path) -> None:
    without = rewritten(
        lossless, tmp_path, lambda message: None if message.channel.topic == "/depth_image" else message
    )
    found = replay([without], {}, DEFAULT_MODEL)
    detections = found.detections
    assert detections is not None
    assert (detections.depth_images, detections.identical_images) == (0, detections.images)
    assert detections.range_difference_m is not None
    assert detections.range_difference_m[1] > 0.02
    (reason,) = found.inexact
    assert "no recorded " in reason
    assert "depth image: " in reason
    assert found.differing_steps > 20


@pytest.fixture(scope="module")
def jpeg(short: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same short flight with JPEG images."""

    def change(message: Recorded) -> Recorded:
        if message.channel.topic != "/image":
            return message
        body = json.loads(message.data)
        png = cv2.imdecode(np.frombuffer(base64.b64decode(body["data"]), np.uint8), cv2.IMREAD_COLOR)
        assert png is not None
        _, encoded = cv2.imencode(".jpg", png, [cv2.IMWRITE_JPEG_QUALITY, 80])
        body |= {"data": base64.b64encode(encoded.tobytes()).decode(), "format": "jpeg"}
        return message._replace(data=json.dumps(body).encode())

    return rewritten(short, tmp_path_factory.mktemp("jpeg"), change)


def test_jpeg_replays_are_equal_and_say_what_images_change(jpeg: Path) -> None:
    found, again = replay([jpeg], {}, DEFAULT_MODEL), replay([jpeg], {}, DEFAULT_MODEL)
    assert found == again
    detections = found.detections
    assert detections is not None
    assert (detections.same_model, detections.image_formats) == (True, ["jpeg"])
    assert detections.matched == detections.recorded
    assert detections.identical_images < detections.images
    assert detections.range_difference_m is not None
    assert 0.0 < detections.range_difference_m[1] < 0.5
    assert found.first is not None
    assert any("JPEG" in reason for reason in found.inexact)
    assert "setpoint" in found.differing_fields


def test_model_without_detections_explains_other_setpoints(
    lossless: Path, short: Path, small_model: Path, tmp_path: Path
) -> None:
    done = companion_here("log", "replay", lossless, "--model", small_model, "--json", cwd=tmp_path)
    assert done.returncode == 1, done.stderr
    found = json.loads(done.stdout)
    assert found["detections"]["same_model"] is False
    assert (found["detections"]["replayed"], found["detections"]["matched"]) == (0, 0)
    first, *later = found["timeline"]
    assert "car (track 1)" in first["text"]
    assert "not detected" in first["text"]
    setpoint = next(change for change in later if change["text"].startswith("setpoint"))
    assert first["seconds"] <= found["first"]["seconds"] <= setpoint["seconds"] < setpoint["until_s"]
    reached = [change["text"] for change in later if ": reached car" in change["text"]]
    assert any(text.startswith("event only ") and "the recording: " in text for text in reached)
    shown = replay([short], {}, str(small_model))
    lines = list(report(shown))
    assert any("open loop" in line for line in lines)
    changed = next(change for change in shown.timeline if change.text.startswith("setpoint"))
    assert any(line.startswith(f"{changed.seconds:g} to {changed.until_s:g} s: ") for line in lines)


def test_exported_file_of_the_model_is_another_model(short: Path, exported_model: Path) -> None:
    found = replay([short], {}, str(exported_model)).detections
    assert found is not None
    assert found.same_model is False
    assert found.images == found.frames


@pytest.mark.parametrize(
    ("flown", "runtime", "model", "expected"),
    [
        ("a.pt", None, "b.pt", (None, "bfloat16")),
        ("a.pt", "auto", "b.pt", ("openvino", "bfloat16")),
        ("a.pt", None, "b.onnx", (None, "auto")),
        ("a.pt", "auto", "b.onnx", (None, "auto")),
        ("a.pt", "torch", "b.onnx", (None, "auto")),
        ("a.onnx", None, "b.pt", (None, "auto")),
        ("a.onnx", "openvino", "b.pt", ("openvino", "bfloat16")),
        ("a.pt", "torch", ".", (None, "auto")),  # a folder is OpenVINO's
    ],
)
def test_a_model_of_another_kind_of_file_gets_its_own_runtime(
    flown: str,
    runtime: Literal["auto", "torch", "openvino"] | None,
    model: str,
    expected: tuple[str | None, str],
) -> None:
    section = DetectorSection(model=flown, runtime=runtime)
    found = _as_in_flight(section, 2, {"runtime": "openvino", "precision": "bfloat16"}, model)
    assert (found.model, found.threads) == (model, 2)
    assert (found.runtime, found.precision) == expected


def test_precision_of_a_file_is_not_asked_for() -> None:
    status = {"precision": "int8"}
    assert _as_in_flight(DetectorSection(model="a.onnx"), 2, status, "a.onnx").precision == "auto"
    assert _as_in_flight(DetectorSection(model="a.onnx", runtime="auto"), 2, {}, "a.onnx").runtime is None


def test_frames_without_an_image_are_counted(short: Path, tmp_path: Path) -> None:
    seen = 0

    def change(message: Recorded) -> Recorded | None:
        nonlocal seen
        seen += message.channel.topic == "/image"
        return None if message.channel.topic == "/image" and seen % 3 == 0 else message

    found = replay([rewritten(short, tmp_path, change)], {}, DEFAULT_MODEL)
    assert found.detections is not None
    missing = found.detections.frames - found.detections.images
    assert missing == seen // 3
    (without_image,) = found.inexact
    assert without_image.startswith(f"{missing} of {found.detections.frames} processed frames ")
    assert "no recorded " in without_image


@pytest.mark.parametrize("restarts", [0, 2])
def test_what_a_flight_of_the_service_does_not_record_is_said(
    short: Path, tmp_path: Path, restarts: int
) -> None:
    """Only the service has a process for perception, and publishes its status."""
    statuses = iter([{"runtime": runtime, "restarts": 1} for runtime in (None, "torch")])
    last = {"runtime": "torch", "restarts": 1 + restarts}

    def change(message: Recorded) -> Recorded:
        if message.channel.topic != "/annotations":
            return message
        body = json.dumps({"perception": next(statuses, last)}).encode()
        return Recorded(Channel(STATUS.name, "companion.status", ANY_OBJECT), message.log_time_ns, body)

    found = replay([rewritten(short, tmp_path, change)], {}, DEFAULT_MODEL)
    again = f"the perception process was restarted {restarts} times: its tracker began again, not here"
    assert found.inexact == [SAMPLES_INEXACT, *[again] * bool(restarts)]
    assert f"not exact: {SAMPLES_INEXACT}" in list(report(found))


@pytest.mark.parametrize("what", ["annotated", "no images"])
def test_unusable_images_are_refused(jpeg: Path, tmp_path: Path, what: str) -> None:
    def change(message: Recorded) -> Recorded | None:
        if what == "no images":
            return None if message.channel.topic == "/image" else message
        if message.channel.topic != RUN_CHANNEL:
            return message
        return message._replace(data=message.data.replace(b'"annotate":false', b'"annotate":true'))

    with pytest.raises(RecordingError, match="annotate" if what == "annotated" else "images"):
        replay([rewritten(jpeg, tmp_path, change)], {}, DEFAULT_MODEL)


def test_unknown_model_is_one_line(short: Path, tmp_path: Path) -> None:
    done = companion_here("log", "replay", short, "--model", "none.pt", cwd=tmp_path)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert "none.pt" in done.stderr


def former_keys(section: dict[str, Any]) -> dict[str, Any]:
    """A section `camera` as it was recorded while its lens was eight keys."""
    lens = section.pop("lens")
    section |= {f"{name}_px": lens[name] for name in ("fx", "fy", "cx", "cy")}
    section |= {f"calibrated_{name}": lens[name] for name in ("width", "height")}
    return section | {name: lens[name] for name in ("distortion", "distortion_model")}


@pytest.mark.parametrize(("camera_motion", "reasons"), [(True, 0), (False, 1)])
def test_recording_with_removed_keys_replays(
    short: Path, tmp_path: Path, camera_motion: bool, reasons: int
) -> None:
    def change(message: Recorded) -> Recorded:
        if message.channel.topic not in (RUN_CHANNEL, INPUT_CHANNEL):
            return message
        content = json.loads(message.data)
        if message.channel.topic == RUN_CHANNEL:
            settings = content["settings"]
            settings["camera"] = former_keys(settings["camera"])
            settings["detector"] |= {"every": 1, "max_age_s": None, "tile_size": 640, "tile_overlap": 0.2}
            settings["tracker"] |= {"high_confidence": 0.35, "low_confidence": 0.1}
            settings["tracker"] |= {"camera_motion": camera_motion}
            settings["preview"] |= {"quality": 80, "cloud_voxel_m": 0.1}
        else:
            context = content["context"]
            context["camera"] = json.dumps(former_keys(json.loads(context["camera"])))
        return message._replace(data=json.dumps(content).encode())

    old = rewritten(short, tmp_path, change)
    assert replay([old], {}).differing_steps == 0
    found = replay([old], {}, DEFAULT_MODEL)
    assert found.detections is not None
    assert found.detections.identical_images == found.detections.frames > 10
    assert (found.differing_steps, len(found.inexact)) == (0, reasons)
    assert all("tracker.camera_motion" in reason for reason in found.inexact)
