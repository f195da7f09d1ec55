"""Scene files: their values and errors; a scene's camera with moving objects and lost frames."""

from __future__ import annotations

import contextlib
import json
import math
import pickle
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavlink_sim.camera.depth_camera import DepthSensor
from mavlink_sim.camera.freeze import CameraFreeze
from mavlink_sim.camera.lens import Shutter
from mavlink_sim.camera.scene import CameraSettings, Path, Scene
from mavlink_sim.camera.scene_file import SceneError, example_scenes, load_scene, parse_scene, scene_or_demo
from mavlink_sim.camera.simulated_camera import SimulatedCamera, _motion_between, frame_truth, truth_line
from mavlink_sim.world.fiducials import Print
from mavlink_sim.world.world import Ground, World, WorldObject, demo_world
from vision.camera_model import CameraModel, CameraMount
from vision.rotation import matrix_from_euler

FULL = """
name = "everything"
[ground]
kinds = ["sand", "grass"]
patches = [{ kind = "water", place_m = [10, -5], radius_m = 3 }]
road_east_m = 12
[light]
sun_azimuth_deg = 90
sun_elevation_deg = 30
[sky]
visibility_m = 500
clouds = 0.1
[[objects]]
class = "car"
place_m = [10, 2]
yaw_deg = 90
appearance = 4
[[objects]]
class = "wall"
place_m = [12, 0, -0.5]
size_m = [6, 0.3, 2.5]
[[objects]]
class = "person"
path = { waypoints_m = [[0, 0], [10, 0]], speed_mps = 2, repeat = "back_and_forth" }
[[plates]]
id = 3
size_m = 0.5
place_m = [4, 4]
standing = true
[camera]
width = 320
height = 240
focal_px = [300, 301]
centre_px = [160, 119]
distortion = [-0.1, 0.02, 0, 0]
rate_hz = 50
exposure_ms = 5
rolling_shutter_ms = 15
loss = 0.1
latency_ms = 40
[camera.mount]
pitch_deg = -90
[camera.effects]
noise = 4
[camera.depth]
maximum_m = 12
"""


def test_every_key_is_applied() -> None:
    scene = parse_scene(FULL)
    world, camera = scene.world, scene.camera
    assert scene.name == "everything"
    assert world.ground.kinds == ("sand", "grass")
    assert world.ground.patches[0].radius_m == 3
    assert world.light.towards_sun_ned == pytest.approx((0.0, math.cos(math.pi / 6), -0.5))
    assert world.sky.visibility_m == 500
    car, wall, person, plate = world.objects
    assert (car.class_name, car.position_ned_m, car.appearance) == ("car", (10.0, 2.0, 0.0), 4)
    assert car.yaw_rad == pytest.approx(math.pi / 2)
    assert wall.size_m == (6.0, 0.3, 2.5)
    assert wall.position_ned_m == (12.0, 0.0, -0.5)
    assert plate.printed is not None
    assert (plate.printed.identifier, plate.printed.standing) == (3, True)
    assert scene.paths[person.identifier].period_s == pytest.approx(10.0)
    assert (camera.model.width, camera.model.fy, camera.model.cx) == (320, 301.0, 160.0)
    assert camera.model.distortion == (-0.1, 0.02, 0.0, 0.0)
    assert camera.mount.pitch_rad == pytest.approx(-math.pi / 2)
    assert camera.shutter is not None
    assert (camera.shutter.exposure_s, camera.shutter.readout_s) == (0.005, 0.015)
    assert (camera.loss, camera.latency_s, camera.rate_hz) == (0.1, 0.04, 50.0)
    assert camera.depth is not None
    assert camera.depth.maximum_m == 12
    assert camera.effects is not None
    assert camera.effects.noise_sigma == 4


def test_an_empty_file_is_an_empty_field_with_the_usual_camera() -> None:
    scene = parse_scene("")
    assert scene.world == World()
    assert scene.camera == Scene(World()).camera


def test_every_problem_is_named_at_once() -> None:
    with pytest.raises(SceneError) as caught:
        parse_scene("[camera]\nwidth = 1\nheight = 2\n[fog]\n", "field.toml")
    assert len(str(caught.value).splitlines()) == 3
    assert all(line.startswith("field.toml: ") for line in str(caught.value).splitlines())


@settings(max_examples=60, deadline=None)
@given(st.text(max_size=200))
def test_any_text_is_a_scene_or_scene_error(text: str) -> None:
    with contextlib.suppress(SceneError):
        assert isinstance(parse_scene(text), Scene)


@pytest.mark.parametrize("name", example_scenes())
def test_example_is_complete_and_picklable(name: str) -> None:
    scene = load_scene(name)
    assert scene.world.objects
    again = pickle.loads(pickle.dumps(scene))
    assert again.objects_at(12.5) == scene.objects_at(12.5)


def test_there_are_examples_and_without_a_scene_the_demo_world() -> None:
    assert {"village", "marker_landing", "obstacle_course"} <= set(example_scenes())
    assert scene_or_demo(None, 3).world == demo_world(3)
    assert scene_or_demo("village", 3).world == load_scene("village").world


positions = st.tuples(st.floats(-50, 50), st.floats(-50, 50), st.floats(-20, 0))
paths = st.builds(
    Path,
    st.lists(positions, min_size=2, max_size=5, unique=True).map(tuple).filter(
        lambda direction: sum(math.dist(a, b) for a, b in pairwise(direction)) > 1.0
    ),
    st.floats(0.2, 20.0),
    st.sampled_from(("loop", "back_and_forth", "once")),
    st.floats(0.0, 50.0),
)  # fmt: skip


@given(paths, st.floats(0.0, 300.0), st.floats(0.0, 0.5))
def test_path_never_exceeds_its_speed(path: Path, time_s: float, step_s: float) -> None:
    (before, _), (after, _) = path.pose_at(time_s), path.pose_at(time_s + step_s)
    assert math.dist(before, after) <= path.speed_mps * step_s + 1e-6


@given(paths, st.floats(0.0, 300.0))
def test_a_path_repeats_after_its_period_unless_it_ends(path: Path, time_s: float) -> None:
    now, later = path.pose_at(time_s)[0], path.pose_at(time_s + path.period_s)[0]
    if path.repeat == "once":
        assert path.pose_at(1e5)[0] == pytest.approx(path.waypoints_ned_m[-1])
    else:
        assert math.dist(now, later) < 1e-5


def test_path_heading_reverses_on_return() -> None:
    path = Path(((0.0, 0.0, 0.0), (0.0, 10.0, 0.0)), 1.0, "back_and_forth")
    position, yaw_rad = path.pose_at(2.0)
    assert position == (0.0, 2.0, 0.0)
    assert yaw_rad == pytest.approx(math.pi / 2)
    position, yaw_rad = path.pose_at(12.0)
    assert position == (0.0, 8.0, 0.0)
    assert yaw_rad == pytest.approx(-math.pi / 2)
    rising = Path(((0.0, 0.0, 0.0), (0.0, 5.0, 0.0), (0.0, 5.0, -5.0)), 1.0, "once")
    position, yaw_rad = rising.pose_at(8.0)
    assert position == (0.0, 5.0, -3.0)
    assert yaw_rad == pytest.approx(math.pi / 2)
    assert Path(rising.waypoints_ned_m, 1.0, fixed_yaw_rad=0.3).pose_at(3.0)[1] == 0.3


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
    assert [again.capture((0.0, 0.0, -1.5), LEVEL, n) is None for n in range(50)] == [
        f is None for f in frames[:50]
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


# ---- a camera that repeats its last image


@pytest.mark.parametrize(
    ("freeze", "image", "depth"),
    [
        (CameraFreeze.NOTHING, False, False),
        (CameraFreeze.IMAGE, True, False),
        (CameraFreeze.DEPTH, False, True),
        (CameraFreeze.IMAGE | CameraFreeze.DEPTH, True, True),
    ],
)
def test_frozen_parts_repeat_with_new_stamps(freeze: CameraFreeze, image: bool, depth: bool) -> None:
    camera = SimulatedCamera(SCENE)
    before = camera.capture((0.0, 0.0, -1.5), LEVEL, 1)
    after = camera.capture((2.0, 0.0, -1.5), LEVEL, 2, freeze=freeze)
    thawed = camera.capture((2.0, 0.0, -1.5), LEVEL, 3)
    assert before is not None
    assert after is not None
    assert thawed is not None
    assert after.frame.captured_ns == 2
    assert np.array_equal(before.frame.image, after.frame.image) is image
    assert before.frame.depth_m is not None
    assert after.frame.depth_m is not None
    assert np.array_equal(before.frame.depth_m, after.frame.depth_m, equal_nan=True) is depth
    assert not np.array_equal(before.frame.image, thawed.frame.image)


def test_a_clock_goes_on_in_a_frozen_image() -> None:
    camera, freeze = SimulatedCamera(SCENE), CameraFreeze.IMAGE | CameraFreeze.CLOCK
    camera.capture((0.0, 0.0, -1.5), LEVEL, 0)
    frames = [camera.capture((2.0, 0.0, -1.5), LEVEL, n * 10**8, freeze=freeze) for n in (1, 2)]
    first, second = (captured.frame.image for captured in frames if captured is not None)
    changed = (first != second).any(axis=2)
    assert changed.any()
    assert not changed[20:].any()
