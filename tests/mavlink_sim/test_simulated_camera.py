"""A scene's camera in-process: frames with their truth, moving objects, lost frames."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from mavlink_sim.camera.depth_camera import DepthSensor
from mavlink_sim.camera.lens import Shutter
from mavlink_sim.camera.scene import CameraSettings, Path, Scene
from mavlink_sim.camera.simulated_camera import SimulatedCamera, _motion_between, frame_truth, truth_line
from mavlink_sim.world.fiducials import Print
from mavlink_sim.world.world import Ground, World, WorldObject
from vision.camera_model import CameraModel, CameraMount
from vision.rotation import matrix_from_euler

CAMERA = CameraModel.from_horizontal_fov(160, 120, math.radians(70.0))
WORLD = World(
    (
        WorldObject(0, "car", (12.0, 0.0, 0.0)),
        WorldObject(1, "person", (8.0, -1.0, 0.0)),
        WorldObject(2, "plate", (7.0, 1.5, 0.0), math.pi, printed=Print("4X4_50", 8, 0.8, True)),
    ),
    Ground(("concrete",), 0, 256, 0.05),
)
SETTINGS = CameraSettings(CAMERA, CameraMount())
PATH = Path(((8.0, -2.0, 0.0), (8.0, 2.0, 0.0)), 1.0, "back_and_forth")
SCENE = Scene(WORLD, {1: PATH}, SETTINGS)
LEVEL = np.eye(3)


def test_frame_truth_has_stamp_and_visible_objects() -> None:
    captured = SimulatedCamera(SCENE).capture((0.0, 0.0, -1.5), LEVEL, 5_000_000_000, time_s=2.0)
    assert captured is not None
    truth = frame_truth(captured)
    assert json.loads(truth_line(captured)) == truth
    assert (truth["stamp_ns"], truth["sequence"], truth["time_s"]) == (5_000_000_000, 0, 2.0)
    assert captured.frame.captured_ns == 5_000_000_000
    seen = {item["identifier"]: item for item in truth["objects"]}
    assert set(seen) == {0, 1, 2}
    assert seen[1]["class_name"] == "person"
    assert seen[1]["position_ned_m"] == [8.0, 0.0, 0.0]
    assert seen[1]["distance_m"] == pytest.approx(math.hypot(8.0, 1.5), abs=1e-3)
    assert 7.0 < seen[1]["range_m"] < 8.0
    assert seen[2]["marker"] == {"dictionary": "4X4_50", "id": 8, "size_m": 0.8}
    # The person stands before the car.
    assert seen[0]["visible_fraction"] < 0.97 < seen[1]["visible_fraction"]
    left, top, right, bottom = seen[1]["xyxy"]
    assert left < 79.5 < right
    assert captured.frame.depth_m is not None
    assert np.nanmin(captured.frame.depth_m[int(top) : int(bottom), int(left) : int(right)]) == pytest.approx(
        8.0, abs=0.5
    )


def test_moving_objects_drawn_on_their_path() -> None:
    camera = SimulatedCamera(SCENE)
    middles = []
    for time_s in (0.0, 2.0, 4.0, 8.0):
        captured = camera.capture((0.0, 0.0, -1.5), LEVEL, 1, time_s)
        assert captured is not None
        box = next(item for item in frame_truth(captured)["objects"] if item["identifier"] == 1)["xyxy"]
        middles.append((box[0] + box[2]) / 2)
    expected = [79.5 + east / 8.0 * CAMERA.fx for east in (-2.0, 0.0, 2.0, -2.0)]
    assert middles == pytest.approx(expected, abs=6.0)
    fresh = SimulatedCamera(SCENE).capture((0.0, 0.0, -1.5), LEVEL, 1, 4.0)
    assert fresh is not None
    assert fresh.rendered.objects[1].xyxy[0] == pytest.approx(middles[2], abs=8.0)


def test_a_gimbal_turns_the_camera() -> None:
    camera = SimulatedCamera(SCENE)
    ahead = camera.capture((0.0, 0.0, -1.5), LEVEL, 1)
    behind = camera.capture((0.0, 0.0, -1.5), LEVEL, 2, mount=CameraMount(yaw_rad=math.pi))
    assert ahead is not None
    assert behind is not None
    assert len(ahead.rendered.objects) == 3
    assert not behind.rendered.objects


def test_lost_share_leaves_sequence_gaps() -> None:
    small = CameraModel.from_horizontal_fov(32, 24, 1.2)
    scene = Scene(WORLD, camera=CameraSettings(small, loss=0.3, seed=4))
    camera = SimulatedCamera(scene)
    frames = [camera.capture((0.0, 0.0, -1.5), LEVEL, number) for number in range(200)]
    kept = [captured.frame.sequence for captured in frames if captured is not None]
    assert 0.2 < 1 - len(kept) / 200 < 0.4
    assert kept == [index for index, captured in enumerate(frames) if captured is not None]
    again = SimulatedCamera(scene)
    assert [again.capture((0.0, 0.0, -1.5), LEVEL, n) is None for n in range(200)] == [
        f is None for f in frames
    ]


def test_the_latency_says_when_a_frame_arrives() -> None:
    scene = replace(SCENE, camera=replace(SETTINGS, latency_s=0.08))
    captured = SimulatedCamera(scene).capture((0.0, 0.0, -1.5), LEVEL, 1_000)
    assert captured is not None
    assert captured.arrives_ns == 80_001_000
    assert captured.frame.captured_ns == 1_000


def test_the_depth_camera_is_that_of_the_scene() -> None:
    scene = replace(SCENE, camera=replace(SETTINGS, depth=DepthSensor(maximum_m=9.0)))
    captured = SimulatedCamera(scene).capture((0.0, 0.0, -1.5), LEVEL, 1)
    assert captured is not None
    assert captured.frame.depth_m is not None
    assert np.nanmax(captured.frame.depth_m) <= 9.0
    assert np.nanmax(captured.rendered.depth_m) > 50.0


def test_the_same_calls_give_the_same_frames() -> None:
    settings = replace(SETTINGS, depth=DepthSensor(), shutter=Shutter(0.005, 0.01), seed=9)
    cameras = [SimulatedCamera(replace(SCENE, camera=settings)) for _ in range(2)]
    for number in range(3):
        position, attitude = (0.1 * number, 0.0, -1.5), matrix_from_euler(0.0, 0.0, 0.02 * number)
        first, again = (camera.capture(position, attitude, number * 33_000_000) for camera in cameras)
        assert first is not None
        assert again is not None
        assert np.array_equal(first.frame.image, again.frame.image)
        assert first.frame.depth_m is not None
        assert again.frame.depth_m is not None
        assert np.array_equal(first.frame.depth_m, again.frame.depth_m, equal_nan=True)


def test_motion_is_difference_of_poses() -> None:
    before = (0, np.zeros(3), matrix_from_euler(0.0, 0.0, 0.3))
    turned = before[2] @ matrix_from_euler(0.02, -0.01, 0.03)
    motion = _motion_between(before, (100_000_000, turned @ np.array([0.5, 0.0, 0.1]), turned))
    assert motion.velocity_mps == pytest.approx((5.0, 0.0, 1.0))
    assert motion.angular_velocity_radps == pytest.approx((0.2, -0.1, 0.3), abs=0.01)
    assert _motion_between(before, (2_000_000_000, np.ones(3), turned)).still
    assert _motion_between(before, (0, np.ones(3), turned)).still


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"loss": 1.0}, "frames lost"),
        ({"latency_s": -1.0}, "0 to 5 s"),
        ({"rate_hz": 0.0}, "rate must be positive"),
    ],
)
def test_invalid_camera_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CameraSettings(**changes)
