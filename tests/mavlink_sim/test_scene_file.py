"""Scene files: their values, and the errors of invalid ones."""

from __future__ import annotations

import contextlib
import math
import pickle
from itertools import pairwise
from pathlib import Path as FilePath

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavlink_sim.camera.scene import Path, Scene
from mavlink_sim.camera.scene_file import SceneError, example_scenes, load_scene, parse_scene, scene_or_demo
from mavlink_sim.world.world import World, WorldObject, demo_world

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


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[ground", r"scene: Expected ']' at the end of a table"),
        ("[grund]", r"grund; .*ground\?"),
        ("[camera]\nheigth = 3", r"camera.heigth; .*height\?"),
        ("[camera.depth]\nnosie_px = 3", r"camera.depth.nosie_px; .*noise_px\?"),
        ("[camera]\nwidth = '640'", r"camera.width: .*'640'"),
        ("[camera]\nwidth = 3", r"camera.width: .*16, got 3"),
        ("[camera]\nloss = 1.0", r"camera.loss: .*1, got 1.0"),
        ("[camera]\nfocal_px = [1, 2]\nhorizontal_fov_deg = 60", r"camera: .*got both"),
        ("[camera]\ncentre_px = [1, 2]", r"camera.centre_px: needs camera.focal_px"),
        ("[camera]\ndistortion = [0.1]", r"camera.distortion: must be .*got 1 numbers"),
        ("[camera]\ndistortion = [-3, 0, 0, 0]", r"camera.distortion: .*weaker coefficients"),
        ("[camera.depth]\nminimum_m = 9\nmaximum_m = 3", r"camera.depth: minimum_m 9.0"),
        ("[ground]\nkinds = ['grass', 'lava']", r"ground.kinds\[1\]: .*grass, .*'lava'"),
        ("[[objects]]\nclass = 'cat'\nplace_m = [1, 2]", r"objects\[0\].class: .*'cat'"),
        ("[[objects]]\nclass = 'cra'\nplace_m = [1, 2]", r"crate"),
        ("[[objects]]\nplace_m = [1, 2]", r"objects\[0\].class: is missing"),
        ("[[objects]]\nclass = 'car'", r"objects\[0\]: .*place_m .*neither"),
        ("[[objects]]\nclass = 'car'\nplace_m = [1]", r"objects\[0\].place_m: .*at least 2 items"),
        ("[[objects]]\nclass = 'car'\nplace_m = [1, inf]", r"objects\[0\].place_m\[1\]: .*finite number"),
        ("[[objects]]\nclass = 'car'\nplace_m = [1, 2]\nsize_m = [1, 1, 1]", r"objects\[0\]: .*own size"),
        (
            "[[objects]]\nclass = 'car'\npath = { waypoints_m = [[0, 0], [0, 0]], speed_mps = 1 }",
            r"objects\[0\]: a path's waypoints",
        ),
        (
            "[[objects]]\nclass = 'car'\npath = { waypoints_m = [[0, 0], [0, 1]], speed_mps = 0 }",
            r"objects\[0\].path.speed_mps: .*0, got 0",
        ),
        ("[[plates]]\nid = 50\nsize_m = 1\nplace_m = [0, 0]", r"plates\[0\]: marker 50"),
        ("[[plates]]\ndictionary = '4x4_50'\nid = 1\nsize_m = 1\nplace_m = [0, 0]", r"4X4_50"),
    ],
)
def test_invalid_scenes_explained(text: str, message: str) -> None:
    with pytest.raises(SceneError, match=message):
        parse_scene(text)


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


def test_missing_file_error_lists_examples(tmp_path: FilePath) -> None:
    with pytest.raises(SceneError, match=r"cannot read .*field.toml: No such file.*village"):
        load_scene(tmp_path / "field.toml")
    (tmp_path / "field.toml").write_bytes(b"name = '\xff'")
    with pytest.raises(SceneError, match="not UTF-8"):
        load_scene(tmp_path / "field.toml")


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


def test_path_for_unknown_object_refused() -> None:
    world = World((WorldObject(0, "car", (1.0, 2.0, 0.0)),))
    with pytest.raises(ValueError, match=r"paths for objects .*\[4\]"):
        Scene(world, {4: Path(((0.0, 0.0, 0.0), (1.0, 0.0, 0.0)), 1.0)})
