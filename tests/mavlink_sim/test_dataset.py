"""Data sets: correct labels in the layouts of training tools, repeatable scenes."""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from mavlink_sim.camera.depth_camera import DepthSensor
from mavlink_sim.camera.renderer import Rendered
from mavlink_sim.camera.scene import CameraSettings, Scene
from mavlink_sim.cli.main import main
from mavlink_sim.datasets import training_scenes
from mavlink_sim.datasets.dataset import DatasetError, DatasetOptions, make_dataset
from mavlink_sim.datasets.training_scenes import (
    LEARNED_SIDE_PX,
    MIN_AREA_PX,
    MIN_SIDE_PX,
    Boxes,
    ClassIds,
    flight_frame,
    random_scene,
    training_frame,
    training_scene,
    world_frame,
)
from mavlink_sim.world.shapes import CLASS_NAMES
from mavlink_sim.world.textures import Image
from mavlink_sim.world.world import Ground, World, WorldObject
from vision.camera_model import CameraModel

SCENE = Scene(
    World(
        (WorldObject(0, "car", (5.0, 0.0, 0.0)), WorldObject(1, "person", (0.0, 6.0, 0.0))),
        Ground(("concrete",), 0, 256, 0.05),
    ),
    camera=CameraSettings(CameraModel.from_horizontal_fov(160, 120, math.radians(75.0)), depth=DepthSensor()),
)


@pytest.fixture(scope="module", autouse=True)
def quick_worlds() -> Iterator[None]:
    """Worlds of training with a coarse ground, and few tiles: painting is most of the time of a frame."""

    def coarse(scene: Scene) -> Scene:
        ground = scene.world.ground
        texel_m = ground.texel_m * ground.tile_texels / 128
        return replace(
            scene, world=replace(scene.world, ground=replace(ground, tile_texels=128, texel_m=texel_m))
        )

    scenes = tuple(coarse(scene) for scene in training_scenes._scenes())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training_scenes, "_scenes", lambda: scenes)
        patch.setattr(training_scenes, "TILES", 4)
        patch.setattr(training_scenes, "PAINTED_TILES", 1)
        yield


def files(folder: Path) -> dict[str, str]:
    return {
        str(path.relative_to(folder)): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def truth_of(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "truth.jsonl").read_text("utf-8").splitlines()]


def test_yolo_labels_match_truth(tmp_path: Path) -> None:
    folder = tmp_path / "set"
    done: list[int] = []
    options = DatasetOptions(8, seed=3, validation=0.25, depth=True, altitude_m=(2.0, 8.0))
    labels = make_dataset(folder, SCENE, options, done.append)
    assert done == list(range(1, 9))
    described = yaml.safe_load((folder / "data.yaml").read_text("utf-8"))
    assert described["names"] == dict(enumerate(CLASS_NAMES))
    assert len(list((folder / described["train"]).glob("*.jpg"))) == 6
    assert len(list((folder / described["val"]).glob("*.jpg"))) == 2
    counted = 0
    for entry in truth_of(folder):
        raster = cv2.imread(str(folder / entry["image"]))
        assert raster is not None
        assert raster.shape == (120, 160, 3)
        depth = cv2.imread(
            str(folder / entry["image"].replace("images", "depth").replace("jpg", "png")),
            cv2.IMREAD_UNCHANGED,
        )
        assert depth is not None
        assert depth.dtype == np.uint16
        label = folder / entry["image"].replace("images", "labels").replace("jpg", "txt")
        lines = label.read_text("utf-8").splitlines()
        counted += len(lines)
        for line in lines:
            number, x, y, width, height = (float(word) for word in line.split())
            shares = np.array([x - width / 2, y - height / 2, x + width / 2, y + height / 2])
            box = shares * (160, 120, 160, 120)
            match = [
                item
                for item in entry["objects"]
                if item["class_name"] == CLASS_NAMES[int(number)]
                and np.allclose(item["xyxy"], box, atol=0.01)
            ]
            assert len(match) == 1
            assert match[0]["visible_fraction"] >= options.min_visible
    assert counted == labels
    assert labels >= 6


def test_coco_files_read_by_pycocotools(tmp_path: Path) -> None:
    coco = pytest.importorskip("pycocotools.coco", reason="COCO's own reader is not installed")
    folder = tmp_path / "set"
    labels = make_dataset(folder, None, DatasetOptions(4, layout="coco", size=(160, 128), validation=0.5))
    found = ignored = 0
    for split in ("train", "val"):
        book = coco.COCO(str(folder / "annotations" / f"instances_{split}.json"))
        assert len(book.getImgIds()) == 2
        for image in book.loadImgs(book.getImgIds()):
            raster = cv2.imread(str(folder / "images" / split / image["file_name"]))
            assert raster is not None
            assert raster.shape[:2] == (image["height"], image["width"]) == (128, 160)
        for item in book.loadAnns(book.getAnnIds()):
            left, top, width, height = item["bbox"]
            assert left >= 0 <= top
            assert left + width <= 160
            assert top + height <= 128
            assert 0 < item["area"] <= width * height
            found += item["iscrowd"] == 0
            if item["iscrowd"]:  # too small or too much hidden to be labelled, and no background
                ignored += 1
                assert min(width, height) < 6 or item["visible_fraction"] < 0.3
        assert [item["name"] for item in book.loadCats(book.getCatIds())] == list(CLASS_NAMES)
    assert found == labels > 0
    assert ignored > 0


@pytest.mark.parametrize("scene", [SCENE, None])
def test_a_seed_gives_the_same_files_again_whatever_the_count(tmp_path: Path, scene: Scene | None) -> None:
    def made(name: str, count: int, seed: int) -> dict[str, str]:
        make_dataset(tmp_path / name, scene, DatasetOptions(count, seed=seed, size=(96, 96), validation=0.0))
        return files(tmp_path / name)

    one, two = made("one", 1, 2), made("two", 2, 2)
    assert one == made("again", 1, 2)
    rasters = {name: digest for name, digest in one.items() if name.endswith(".jpg")}
    assert rasters.items() <= two.items()
    assert not rasters.items() & made("other", 1, 3).items()


def test_non_empty_folder_refused(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    with pytest.raises(DatasetError, match="empty folder"):
        make_dataset(tmp_path, SCENE, DatasetOptions(1))
    assert files(tmp_path).keys() == {"mine.txt"}


SCENE_FILE = """
[ground]
tile_texels = 256
[[objects]]
class = "car"
place_m = [3, 4]
[camera]
width = 96
height = 96
"""


def test_command_writes_data_set_and_reports_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    scene = tmp_path / "field.toml"
    scene.write_text(SCENE_FILE, "utf-8")
    command = ["mavlink-sim", "dataset", str(tmp_path / "set"), "--scene", str(scene), "--frames", "3"]
    monkeypatch.setattr("sys.argv", command)
    with pytest.raises(SystemExit) as made:
        main()
    assert made.value.code == 0
    assert "3 images" in capsys.readouterr().out
    assert len(truth_of(tmp_path / "set")) == 3
    with pytest.raises(SystemExit) as again:
        main()
    assert again.value.code == 2
    assert "empty folder" in capsys.readouterr().err


Scenes = list[tuple[Image, Boxes, ClassIds]]


@pytest.fixture(scope="module")
def scenes() -> Scenes:
    return [random_scene(np.random.default_rng((7, index)), 256, 256) for index in range(16)]


def test_a_scene_follows_from_its_generator_alone() -> None:
    first = random_scene(np.random.default_rng(5), 192, 160)
    random_scene(np.random.default_rng(6), 256, 192)
    again = random_scene(np.random.default_rng(5), 192, 160)
    both: Iterable[tuple[NDArray[Any], NDArray[Any]]] = zip(first, again, strict=True)
    for one, other in both:
        assert np.array_equal(one, other)


def test_scenes_have_the_size_and_types_they_promise(scenes: Scenes) -> None:
    for image, boxes, ids in scenes:
        assert image.shape == (256, 256, 3)
        assert image.dtype == np.uint8
        assert image.flags.c_contiguous
        assert boxes.dtype == np.float32
        assert boxes.shape == (len(ids), 4)
        assert ids.dtype == np.int64


def test_labels_are_inside_image_and_large_enough(scenes: Scenes) -> None:
    for _, boxes, ids in scenes:
        sides = boxes[:, 2:] - boxes[:, :2]
        assert (boxes >= 0).all()
        assert (boxes <= 256).all()
        assert (sides >= MIN_SIDE_PX).all()
        assert (sides.prod(axis=1) >= MIN_AREA_PX).all()
        assert ((ids >= 0) & (ids < len(CLASS_NAMES))).all()


def test_most_images_show_several_objects(scenes: Scenes) -> None:
    counts = np.array([len(ids) for _, _, ids in scenes])
    assert 3.0 < counts.mean() < 10.0
    assert counts.max() <= 14
    assert {int(name) for _, _, ids in scenes for name in ids} == set(range(len(CLASS_NAMES)))
    assert any(len(random_scene(np.random.default_rng((1, n)), 64, 64)[2]) == 0 for n in range(40))


def test_the_focal_length_is_within_what_was_asked() -> None:
    """A longer lens makes objects larger: with only long lenses the boxes grow."""

    def mean_side(focal_px: tuple[float, float]) -> float:
        sides: list[float] = []
        for n in range(6):
            _, boxes, _ = random_scene(np.random.default_rng((2, n)), 256, 256, focal_px)
            sides += np.sqrt((boxes[:, 2:] - boxes[:, :2]).prod(axis=1)).tolist()
        return float(np.median(sides))

    assert mean_side((500.0, 600.0)) > mean_side((120.0, 150.0))


@pytest.mark.parametrize("draw", [flight_frame, world_frame, training_frame])
def test_other_frames_follow_from_their_generator_too(draw: Callable[..., Rendered]) -> None:
    first, again = (draw(np.random.default_rng(5), 160, 128) for _ in range(2))
    assert np.array_equal(first.image, again.image)
    assert first.image.shape == (128, 160, 3)
    assert not np.array_equal(first.image, draw(np.random.default_rng(8), 160, 128).image)


def test_too_small_objects_have_negative_id() -> None:
    small = 0
    for n in range(8):
        _, boxes, ids = training_scene(np.random.default_rng((3, n)), 160, 128)
        sides = boxes[:, 2:] - boxes[:, :2]
        assert (sides[ids >= 0] >= LEARNED_SIDE_PX).all()
        assert ((ids >= -len(CLASS_NAMES)) & (ids < len(CLASS_NAMES))).all()
        small += int((ids < 0).sum())
    assert small > 0


def test_flights_have_every_kind_of_distractor_and_far_objects() -> None:
    ranges, names = [], set()
    for n in range(15):
        for item in flight_frame(np.random.default_rng((4, n)), 160, 128).objects:
            names.add(item.world_object.class_name)
            if item.world_object.class_name in CLASS_NAMES:
                ranges.append(item.range_m)
    assert {"autumn_tree", "building", "plate"} < names
    assert max(ranges) > 40.0
    assert min(ranges) < 6.0


def test_more_kinds_of_objects_placed_as_often_as_classes() -> None:
    def drones(more: tuple[str, ...]) -> int:
        frames = (flight_frame(np.random.default_rng((5, n)), 160, 128, more) for n in range(24))
        return sum(item.world_object.class_name == "drone" for frame in frames for item in frame.objects)

    assert drones(("drone",)) >= drones(()) + 5
