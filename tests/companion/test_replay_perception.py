"""Perception and guidance again over recorded images: what is equal, what differs and why."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from companion.bench.lockstep_flight import LockstepFlight, camera_settings
from companion.bench.rendered_camera import RenderedCamera, rendered_scene
from companion.bench.synthetic_detector import SceneObject, ScenePose
from companion.bus.messages import ModelIdentity
from companion.replay import replay
from companion.settings.perception import DEFAULT_MODEL
from mavlink_sim.lockstep import LockstepVehicle
from tests.companion.recording.lockstep_recording import recording
from vision.attitude import euler_from_quaternion
from vision.camera_model import CameraModel, CameraMount
from vision.detector import open_detector
from vision.object_detector import DetectorSettings

CAMERA = CameraModel.from_horizontal_fov(480, 360, math.radians(80.0))
MOUNT = CameraMount(forward_m=0.1, pitch_rad=math.radians(-10.0))
SETTINGS = {"detector.image_size": "256", "detector.threads": "1", "preview.annotate": "false"}


def flown(folder: Path, images: str) -> Path:
    """A recorded approach to a car, with images."""
    flight = LockstepFlight.airborne(seed=11, height_m=3.0, wind_mps=1.0, camera=_camera)
    detector = open_detector("yolo", DetectorSettings(DEFAULT_MODEL, image_size=256, threads=1))
    with recording(flight, folder, images=images, model=ModelIdentity("own", detector.model_sha256)) as path:
        assert flight.fly("approach car distance=8", 7.0).moments
    return path


def _camera(vehicle: LockstepVehicle) -> RenderedCamera:
    """It sees a car 14 m ahead."""
    yaw_rad = euler_from_quaternion(vehicle.truth.quaternion)[2]
    pose = ScenePose(14.0 * math.cos(yaw_rad), 14.0 * math.sin(yaw_rad), 1.2)
    car = SceneObject("car", (4.2, 1.8, 1.5), lambda _: pose)
    scene, _ = rendered_scene([car], CAMERA, MOUNT, 11)
    return RenderedCamera(camera_settings(CAMERA, MOUNT, SETTINGS), scene, vehicle, depth=False)


@pytest.fixture(scope="module")
def lossless(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return flown(tmp_path_factory.mktemp("lossless"), ".png")


def test_lossless_images_and_the_same_model_give_the_flight(lossless: Path) -> None:
    found = replay([lossless], {}, DEFAULT_MODEL)
    detections = found.detections
    assert detections is not None
    assert (detections.same_model, detections.image_formats) == (True, ["png"])
    assert detections.images == detections.frames == detections.identical_images > 50
    assert detections.recorded == detections.replayed > 50
    assert (found.first, found.differing_steps, found.timeline, found.inexact) == (None, 0, [], [])
