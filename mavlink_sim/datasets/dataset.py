"""Data sets of rendered images with their truth, for training and testing.

A scene is rendered from random viewpoints around its objects; "random" scenes are those of the bundled
model's training (`training_scenes`). Frame i of a seed is the same whatever the number of frames.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, Literal

import cv2
import numpy as np
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress

from mavlink_sim.camera.lens import CameraMotion
from mavlink_sim.camera.renderer import VisibleObject
from mavlink_sim.camera.scene import Scene
from mavlink_sim.camera.scene_file import SceneError, load_scene
from mavlink_sim.camera.simulated_camera import Captured, SimulatedCamera, frame_truth
from mavlink_sim.datasets.training_scenes import training_frame
from mavlink_sim.world.shapes import CLASS_NAMES
from mavlink_sim.world.textures import Plane
from mavlink_sim.world.world import OBJECT_NAMES, WorldObject, range_to
from vision.frame import Frame
from vision.rotation import matrix_from_euler

DatasetFormat = Literal["yolo", "coco"]
DEPTH_UNIT_M = 0.001
"""Depth images are 16-bit PNG in millimetres, 0 for no depth and beyond 65.535 m."""
MAX_TRIES = 200
RANDOM_SIZE = (640, 480)
LONGEST_TIME_S = 600.0
_QUALITY = (cv2.IMWRITE_JPEG_QUALITY, 95)


class DatasetError(ValueError):
    """A data set cannot be generated; the text has the reason."""


@dataclass(frozen=True, slots=True)
class DatasetOptions:
    """The options of a data set.

    Attributes:
        frames: number of images.
        seed: of all random numbers.
        layout: "yolo" or "coco".
        classes: the labelled classes, numbered in this order.
        depth: write depth images too.
        validation: share of the images for validation, distributed evenly.
        min_visible: least visible share of a labelled object, 0..1.
        min_side_px: least side of a labelled box.
        altitude_m: least and greatest height of the camera above the ground, for scenes.
        size: width and height of random scenes' images; a scene's camera has its size.
    """

    frames: int
    seed: int = 0
    layout: DatasetFormat = "yolo"
    classes: tuple[str, ...] = CLASS_NAMES
    depth: bool = False
    validation: float = 0.1
    min_visible: float = 0.3
    min_side_px: float = 6.0
    altitude_m: tuple[float, float] = (1.5, 40.0)
    size: tuple[int, int] = RANDOM_SIZE

    def __post_init__(self) -> None:
        unknown = [name for name in self.classes if name not in OBJECT_NAMES]
        if unknown or not self.classes or len(set(self.classes)) != len(self.classes):
            raise DatasetError(
                f"classes must be different names out of {', '.join(OBJECT_NAMES)}; "
                f"got {', '.join(self.classes) or 'none'}"
            )
        if self.frames < 1:
            raise DatasetError(f"a data set needs 1 frame or more, got {self.frames}")
        if self.seed < 0:
            raise DatasetError(f"the seed must be 0 or more, got {self.seed}")
        if not 0.0 <= self.validation < 1.0 or not 0.0 <= self.min_visible <= 1.0:
            raise DatasetError(
                "the shares of validation and of visibility must be 0 to 1, "
                f"got {self.validation} and {self.min_visible}"
            )
        if not 0.0 < self.altitude_m[0] <= self.altitude_m[1] <= 500.0:
            raise DatasetError(f"altitudes must rise within 0 to 500 m, got {self.altitude_m}")
        if not all(32 <= side <= 4096 for side in self.size):
            raise DatasetError(f"an image's sides must be 32 to 4096 px, got {self.size[0]}x{self.size[1]}")


def make_dataset(
    folder: Path,
    scene: Scene | None,
    options: DatasetOptions,
    on_frame: Callable[[int], None] = lambda done: None,
) -> int:
    """Write a data set into a new or empty folder; returns the number of labels.

    `images/train`, `images/val`, and for YOLO `labels/…` with `data.yaml`, for COCO
    `annotations/instances_{train,val}.json`; `depth/…` if requested; `truth.jsonl` with all objects of each
    frame, and its file in `image`.

    Args:
        scene: None for random scenes.
        on_frame: called after each frame with the number of frames written.

    Raises:
        DatasetError: the folder is not empty, or the scene has no viewpoint.
        OSError: a file cannot be written.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise DatasetError(f"{folder} exists and is not an empty folder; choose another")
    splits = ("train", "val") if options.validation > 0.0 else ("train",)
    kinds = ["images"] + ["labels"] * (options.layout == "yolo") + ["depth"] * options.depth
    for kind in kinds:
        for split in splits:
            (folder / kind / split).mkdir(parents=True)
    frames = _random_frames(options) if scene is None else _scene_frames(scene, options)
    coco: dict[str, _Coco] = {split: _Coco(options.classes) for split in splits}
    labels = 0
    with (folder / "truth.jsonl").open("w", encoding="utf-8") as truth:
        for index, captured in enumerate(frames):
            split = "val" if _is_validation(index, options.validation) else "train"
            name = f"{index:06d}"
            _write_image(folder / "images" / split / f"{name}.jpg", captured.frame.image)
            if options.depth:
                assert captured.frame.depth_m is not None
                _write_image(folder / "depth" / split / f"{name}.png", _millimetres(captured.frame.depth_m))
            seen = [item for item in captured.rendered.objects if _counts(item, options)]
            labels += len(seen)
            size = (captured.frame.width, captured.frame.height)
            if options.layout == "yolo":
                lines = "".join(_yolo_line(item, options.classes, size) for item in seen)
                (folder / "labels" / split / f"{name}.txt").write_text(lines, "utf-8")
            else:
                coco[split].add(index, f"{name}.jpg", size, captured.rendered.objects, seen)
            entry = {"image": f"images/{split}/{name}.jpg", **frame_truth(captured)}
            truth.write(json.dumps(entry) + "\n")
            on_frame(index + 1)
    if options.layout == "yolo":
        (folder / "data.yaml").write_text(_data_yaml(options.classes, splits), "utf-8")
    else:
        (folder / "annotations").mkdir()
        for split in splits:
            path = folder / "annotations" / f"instances_{split}.json"
            path.write_text(json.dumps(coco[split].content()) + "\n", "utf-8")
    return labels


def _is_validation(index: int, share: float) -> bool:
    return math.floor((index + 1) * share + 1e-9) > math.floor(index * share + 1e-9)


def _counts(item: VisibleObject, options: DatasetOptions) -> bool:
    left, top, right, bottom = item.xyxy
    large = min(right - left, bottom - top) >= options.min_side_px
    known = item.world_object.class_name in options.classes
    return known and large and item.visible_fraction >= options.min_visible


def _random_frames(options: DatasetOptions) -> Iterator[Captured]:
    width, height = options.size
    more = tuple(name for name in options.classes if name not in CLASS_NAMES)
    for index in range(options.frames):
        rendered = training_frame(np.random.default_rng((options.seed, index)), width, height, more)
        frame = Frame(np.ascontiguousarray(rendered.image), index, index, rendered.depth_m)
        yield Captured(frame, rendered, 0.0, index)


def _scene_frames(scene: Scene, options: DatasetOptions) -> Iterator[Captured]:
    """Frames of the scene's camera from random viewpoints; frames are never lost here."""
    settings = replace(scene.camera, loss=0.0, latency_s=0.0, seed=options.seed)
    camera = SimulatedCamera(replace(scene, camera=settings))
    horizon_s = max([60.0, *(path.period_s for path in scene.paths.values())])
    for index in range(options.frames):
        rng = np.random.default_rng((options.seed, index, 7))
        time_s = float(rng.uniform(0.0, min(horizon_s, LONGEST_TIME_S)))
        position, attitude = _viewpoint(rng, scene, scene.objects_at(time_s), options)
        motion = CameraMotion()
        if settings.shutter is not None:
            velocity, turning = rng.normal(0.0, 2.5, 3), rng.normal(0.0, 0.3, 3)
            motion = CameraMotion(
                (float(velocity[0]), float(velocity[1]), float(velocity[2])),
                (float(turning[0]), float(turning[1]), float(turning[2])),
            )
        captured = camera.capture(position, attitude, round(time_s * 1e9), time_s, motion=motion)
        assert captured is not None
        yield captured


def _viewpoint(
    rng: np.random.Generator, scene: Scene, objects: Sequence[WorldObject], options: DatasetOptions
) -> tuple[list[float], NDArray[np.float64]]:
    """A position and attitude of the body with an object anywhere in the camera's image."""
    wanted = [item for item in objects if item.class_name in options.classes] or list(objects)
    model, mount = scene.camera.model, scene.camera.mount
    low, high = options.altitude_m
    for _ in range(MAX_TRIES):
        aim = np.zeros(3)
        if wanted:
            target = wanted[int(rng.integers(len(wanted)))]
            aim = np.array(target.position_ned_m) - (0.0, 0.0, target.height_m / 2)
        altitude = float(math.exp(rng.uniform(math.log(low), math.log(high))))
        depression = math.radians(float(rng.uniform(8.0, 85.0)))
        above = max(altitude + float(aim[2]), 0.5)
        away = min(max(above / math.tan(depression), 1.5), 80.0)
        bearing = float(rng.uniform(-math.pi, math.pi))
        eye = np.array((aim[0] + away * math.cos(bearing), aim[1] + away * math.sin(bearing), -altitude))
        inside = any(
            range_to(item, (eye[0], eye[1])) < 0.5
            and -item.position_ned_m[2] - 0.5 < altitude < item.height_m - item.position_ned_m[2] + 0.5
            for item in objects
        )
        if inside:
            continue
        offset = aim - eye
        yaw = math.atan2(offset[1], offset[0])
        pitch = -math.atan2(offset[2], math.hypot(offset[0], offset[1]))
        across = math.atan(model.width / 2 / model.fx) * 0.7
        along = math.atan(model.height / 2 / model.fy) * 0.7
        turned = matrix_from_euler(
            float(rng.normal(0.0, math.radians(4.0))),
            pitch + float(rng.uniform(-along, along)),
            yaw + float(rng.uniform(-across, across)),
        )
        body_from_camera = matrix_from_euler(mount.roll_rad, mount.pitch_rad, mount.yaw_rad)
        attitude: NDArray[np.float64] = turned @ body_from_camera.T
        position = eye - attitude @ mount.position_frd_m
        return [float(value) for value in position], attitude
    raise DatasetError(
        f"scene {scene.name}: found no viewpoint between {low} and {high} m above the ground; "
        "its objects fill the space"
    )


def _write_image(path: Path, image: NDArray[Any]) -> None:
    done, data = cv2.imencode(path.suffix, image, _QUALITY if path.suffix == ".jpg" else [])
    if not done:
        raise DatasetError(f"cannot encode {path}")
    path.write_bytes(data.tobytes())


def _millimetres(depth_m: Plane) -> NDArray[np.uint16]:
    scaled = np.nan_to_num(depth_m, nan=0.0, posinf=0.0) / DEPTH_UNIT_M
    scaled[(scaled > 65535.0) | (scaled < 0.0)] = 0.0
    return np.asarray(np.rint(scaled), np.uint16)


def _yolo_line(item: VisibleObject, classes: Sequence[str], size: tuple[int, int]) -> str:
    """`class x y width height`: the box's centre and size relative to the image."""
    left, top, right, bottom = item.xyxy
    width, height = size
    numbers = (
        (left + right) / 2 / width,
        (top + bottom) / 2 / height,
        (right - left) / width,
        (bottom - top) / height,
    )
    return f"{classes.index(item.world_object.class_name)} " + " ".join(f"{n:.6f}" for n in numbers) + "\n"


def _data_yaml(classes: Sequence[str], splits: Sequence[str]) -> str:
    names = "".join(f"  {number}: {name}\n" for number, name in enumerate(classes))
    validation = "val" if "val" in splits else "train"
    return f"path: .\ntrain: images/train\nval: images/{validation}\nnames:\n{names}"


class _Coco:
    """One annotation file under construction."""

    def __init__(self, classes: Sequence[str]) -> None:
        self._classes = tuple(classes)
        self._images: list[dict[str, Any]] = []
        self._annotations: list[dict[str, Any]] = []

    def add(
        self,
        index: int,
        file_name: str,
        size: tuple[int, int],
        objects: Sequence[VisibleObject],
        seen: Sequence[VisibleObject],
    ) -> None:
        """Add an image. Objects of the classes that are not in `seen` are neither these nor background:
        `iscrowd`, which YOLO's format cannot say.
        """
        self._images.append({"id": index, "file_name": file_name, "width": size[0], "height": size[1]})
        for item in objects:
            if item.world_object.class_name not in self._classes:
                continue
            left, top, right, bottom = item.xyxy
            self._annotations.append(
                {
                    "id": len(self._annotations) + 1,
                    "image_id": index,
                    "category_id": self._classes.index(item.world_object.class_name) + 1,
                    "bbox": [left, top, right - left, bottom - top],
                    "area": item.pixel_count,
                    "iscrowd": int(not any(item is one for one in seen)),
                    "object": item.world_object.identifier,
                    "visible_fraction": round(item.visible_fraction, 4),
                    "range_m": round(item.range_m, 3),
                }
            )

    def content(self) -> dict[str, Any]:
        categories = [{"id": number, "name": name} for number, name in enumerate(self._classes, 1)]
        return {"images": self._images, "annotations": self._annotations, "categories": categories}


app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, rich_markup_mode=None)


class Layout(StrEnum):
    """The format of the labels."""

    YOLO = "yolo"
    COCO = "coco"


@app.command()
def dataset(
    out: Annotated[Path, typer.Argument(help="Folder to write to: new or empty.")],
    frames: Annotated[int, typer.Option(help="Number of images.")] = 100,
    scene: Annotated[
        str, typer.Option(help="A scene file, the name of a bundled scene, or random: the training scenes.")
    ] = "random",
    layout: Annotated[Layout, typer.Option("--format", help="Format of the labels.")] = Layout.YOLO,
    seed: Annotated[int, typer.Option(help="The same seed gives the same images.")] = 0,
    depth: Annotated[
        bool, typer.Option("--depth", help="Also write depth: 16-bit PNG in millimetres.")
    ] = False,
    classes: Annotated[str, typer.Option(help="Classes to label, separated by commas.")] = ",".join(
        CLASS_NAMES
    ),
    validation: Annotated[float, typer.Option(help="Share of the images for validation.")] = 0.1,
    min_visible: Annotated[
        float, typer.Option(help="Minimum visible fraction of a labelled object, 0 to 1.")
    ] = 0.3,
    min_side: Annotated[float, typer.Option(help="Minimum side of a labelled box, pixels.")] = 6.0,
    lowest: Annotated[float, typer.Option(help="Minimum camera height, m; with --scene FILE.")] = 1.5,
    highest: Annotated[float, typer.Option(help="Maximum camera height, m; with --scene FILE.")] = 40.0,
    width: Annotated[int, typer.Option(help="Image width, pixels; with --scene random.")] = RANDOM_SIZE[0],
    height: Annotated[int, typer.Option(help="Image height, pixels; with --scene random.")] = RANDOM_SIZE[1],
) -> None:
    """Write labelled images of a scene, or of random ones, for training and testing detectors."""
    cv2.setNumThreads(1)
    try:
        options = DatasetOptions(
            frames=frames,
            seed=seed,
            layout=layout.value,
            classes=tuple(name.strip() for name in classes.split(",") if name.strip()),
            depth=depth,
            validation=validation,
            min_visible=min_visible,
            min_side_px=min_side,
            altitude_m=(lowest, highest),
            size=(width, height),
        )
        chosen = None if scene == "random" else load_scene(scene)
        with Progress(console=Console(stderr=True), transient=True) as progress:
            task = progress.add_task("images", total=frames)
            labels = make_dataset(out, chosen, options, lambda done: progress.update(task, completed=done))
    except (DatasetError, SceneError, OSError) as error:
        print(f"mavlink-sim: {error}", file=sys.stderr)
        raise typer.Exit(2) from None
    print(f"{out}: {frames} images, {labels} labels")
