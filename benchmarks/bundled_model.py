"""The bundled detector on held-out rendered frames: its score and its confusions.

    python benchmarks/bundled_model.py --image-size 320

renders frames of the default world (of seeds that training never uses), of every example scene and of the
training scenes' kind with `mavlink-sim dataset`, and evaluates the model as `companion learn evaluate` does.
Evaluated are objects of which a third is visible and whose box is at least MIN_SIDE_PX and MIN_AREA_PX
large at the input of the network. Smaller ones may be found or not; to call one by another class is always
wrong. Precision and recall are those at the confidence that a target needs to be confirmed.
"""

from __future__ import annotations

import argparse
import json
import logging
import math
import tempfile
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.learning.evaluate import JUDGED_CONFIDENCE, evaluate_dataset, map_classes
from companion.settings.perception import TrackerSection
from mavlink_sim.camera.scene import Scene
from mavlink_sim.camera.scene_file import example_scenes, load_scene, scene_or_demo
from mavlink_sim.datasets.dataset import DatasetOptions, make_dataset
from mavlink_sim.datasets.training_scenes import MIN_AREA_PX, MIN_SIDE_PX, MIN_VISIBLE_FRACTION
from mavlink_sim.world.shapes import CLASS_NAMES
from vision.detector import DEFAULT_MODEL, Detector
from vision.evaluation.datasets import Dataset, Sample, read_image
from vision.evaluation.metrics import WRONG, ImageResult, judge, operating_points, score_detections
from vision.tracking.association import overlaps
from vision.training.recipe import HELD_OUT_SEED

CONFIRMED = TrackerSection().confirm_score
"""A track is confirmed, and may be flown to, from this median confidence on."""
DEFAULT_WORLDS = 20
"""The default world is rendered with the seeds 1 to this; training has others."""
ALTITUDES_M = ((1.5, 40.0), (2.0, 8.0))
"""Half of a scene's frames are taken anywhere, half as low as flights search."""
RANGES_M = (0.0, 2.0, 3.0, 6.0, 15.0, 30.0, 70.0)
"""Recall is printed for each of these ranges."""
SAME_PLACE_IOU = 0.3
"""A wrong detection is ascribed to what it overlaps by so much, else to the background."""


@dataclass(frozen=True, slots=True)
class Seen:
    """Something visible in a frame, of a class or not."""

    class_name: str
    xyxy: tuple[float, float, float, float]
    range_m: float


def draw(folder: Path, frames: int, seed: int = HELD_OUT_SEED, first_world: int = 1) -> dict[str, list[Path]]:
    """Draw frames, by default the held-out ones; scene name → the data sets' folders.

    `first_world` is the first seed of the default world.
    """
    groups: dict[str, list[tuple[Scene | None, int]]] = {"random": [(None, frames * 2 // 5)]}
    examples = {name: load_scene(name) for name in example_scenes()}
    worlds = min(DEFAULT_WORLDS, max(1, frames // 10))
    shares = _shares(frames * 3 // 10, worlds)
    groups["default world"] = [
        (scene_or_demo(None, world), share) for world, share in enumerate(shares, first_world) if share
    ]
    rest = _shares(frames - frames * 2 // 5 - frames * 3 // 10, len(examples))
    for (name, scene), share in zip(examples.items(), rest, strict=True):
        groups[name] = [(scene, share)]
    drawn: dict[str, list[Path]] = {}
    for number, (name, parts) in enumerate(groups.items()):
        for index, (chosen, count) in enumerate(parts):
            for half, heights in enumerate(ALTITUDES_M):
                share = _shares(count, len(ALTITUDES_M))[half]
                if not share:
                    continue
                of_part = seed + 1000 * number + len(ALTITUDES_M) * index + half
                target = folder / f"{number}_{index}_{half}"
                options = DatasetOptions(share, of_part, validation=0.0, altitude_m=heights)
                make_dataset(target, chosen, options)
                drawn.setdefault(name, []).append(target)
                logging.info("%s: %d frames", name, share)
    return drawn


def _shares(total: int, parts: int) -> list[int]:
    return [total * (index + 1) // parts - total * index // parts for index in range(parts)]


def read(folder: Path, image_size: int) -> tuple[Dataset, list[list[Seen]]]:
    """A rendered folder as a data set, and everything seen in each of its frames."""
    samples, seen = [], []
    for line in (folder / "truth.jsonl").read_text("utf-8").splitlines():
        entry = json.loads(line)
        path = folder / entry["image"]
        height, width = read_image(path).shape[:2]
        scale = image_size / max(width, height)
        objects = [item for item in entry["objects"] if item["class_name"] in CLASS_NAMES]
        boxes = np.array([item["xyxy"] for item in objects], np.float32).reshape(-1, 4)
        sides = (boxes[:, 2:] - boxes[:, :2]) * scale
        visible = np.array([item["visible_fraction"] for item in objects])
        small = (sides.min(axis=1, initial=np.inf) < MIN_SIDE_PX) | (sides.prod(axis=1) < MIN_AREA_PX)
        ids = np.array([CLASS_NAMES.index(item["class_name"]) for item in objects], np.int64)
        samples.append(Sample(path, boxes, ids, ignored=small | (visible < MIN_VISIBLE_FRACTION)))
        seen.append(
            [Seen(item["class_name"], tuple(item["xyxy"]), item["range_m"]) for item in entry["objects"]]
        )
    return Dataset(folder, "drawn", CLASS_NAMES, tuple(samples)), seen


def mistakes(
    results: Sequence[ImageResult], seen: Sequence[Sequence[Seen]], names: Sequence[str], confidence: float
) -> list[tuple[str, str, float]]:
    """(what a wrong detection says, what is there, at what range) for each, "background" with range NaN."""
    found = []
    for result, things in zip(results, seen, strict=True):
        boxes: NDArray[np.float32] = np.array([thing.xyxy for thing in things], np.float32).reshape(-1, 4)
        wrong = np.flatnonzero(judge(result, confidence) == WRONG)
        overlap = overlaps(result.boxes[wrong], boxes)
        for row, index in enumerate(wrong.tolist()):
            said = names[int(result.class_ids[index])]
            best = int(overlap[row].argmax()) if len(boxes) else -1
            if best < 0 or overlap[row, best] < SAME_PLACE_IOU:
                found.append((said, "background", math.nan))
            else:
                found.append((said, things[best].class_name, things[best].range_m))
    return found


def recall_by_range(
    results: Sequence[ImageResult], seen: Sequence[Sequence[Seen]], confidence: float
) -> dict[str, dict[str, float | None]]:
    """Range → number of evaluated objects and the share that a detection of their class covers (IoU 0.5)."""
    ranges_m, detected = [], []
    for result, things in zip(results, seen, strict=True):
        ranges_m += [thing.range_m for thing in things if thing.class_name in CLASS_NAMES]
        same = result.true_class_ids[:, None] == result.class_ids
        good = same & (overlaps(result.true_boxes, result.boxes) >= 0.5) & (result.confidences >= confidence)
        detected += np.where(result.ignored, np.nan, good.any(axis=1)).tolist()
    of_place, found = np.digitize(ranges_m, RANGES_M) - 1, np.array(detected)
    table: dict[str, dict[str, float | None]] = {}
    for place, (least, greatest) in enumerate(pairwise(RANGES_M)):
        judged = found[(of_place == place) & ~np.isnan(found)]
        recall = float(judged.mean()) if len(judged) else math.nan
        table[f"{least:.0f} to {greatest:.0f} m"] = {"objects": len(judged), "recall": _rounded(recall)}
    return table


def summary(
    results: Sequence[ImageResult], seen: Sequence[Sequence[Seen]], names: Sequence[str], confidence: float
) -> dict[str, Any]:
    """Scores, precision and recall of each class, and the mistakes, as plain values."""
    score, points = score_detections(results, names), operating_points(results, names, confidence)
    wrong = mistakes(results, seen, names, confidence)
    boats = [said for said, there, range_m in wrong if there == "boat" and 10 <= range_m <= 60]
    return {
        "frames": len(results),
        "map50": _rounded(score.map50),
        "map50_95": _rounded(score.map50_95),
        "classes": {
            name: {
                "objects": points[name].objects,
                "precision": _rounded(points[name].precision),
                "recall": _rounded(points[name].recall),
                "ap50": _rounded(score.per_class[name].ap50),
                "ap50_95": _rounded(score.per_class[name].ap50_95),
            }
            for name in names
        },
        "ranges": recall_by_range(results, seen, confidence),
        "wrong": {f"{there} called {said}": n for (said, there), n in _counted(wrong)},
        "boats_at_10_to_60_m": sum(
            thing.class_name == "boat" and 10 <= thing.range_m <= 60 for things in seen for thing in things
        ),
        "of_these_called_car_or_truck": sum(said in ("car", "truck") for said in boats),
    }


def _counted(wrong: Iterable[tuple[str, str, float]]) -> list[tuple[tuple[str, str], int]]:
    return Counter((said, there) for said, there, _ in wrong).most_common()


def _rounded(value: float) -> float | None:
    return None if math.isnan(value) else round(value, 4)


@dataclass(frozen=True, slots=True)
class Found:
    """The detections of one model and everything seen, by scene and frame; the names of the classes."""

    results: dict[str, list[ImageResult]]
    seen: dict[str, list[list[Seen]]]
    names: tuple[str, ...]


def detect(drawn: Mapping[str, Sequence[Path]], model: str, image_size: int) -> Found:
    """Run one model on drawn frames."""
    detector = Detector(
        model, confidence=JUDGED_CONFIDENCE, image_size=image_size, precision="float32", threads=1
    )
    results: dict[str, list[ImageResult]] = {}
    seen: dict[str, list[list[Seen]]] = {}
    names: tuple[str, ...] = ()
    for scene, folders in drawn.items():
        for folder in folders:
            dataset, things = read(folder, image_size)
            mapping = map_classes(detector.class_names, dataset)
            names = mapping.names
            results.setdefault(scene, []).extend(evaluate_dataset(dataset, detector, mapping).results)
            seen.setdefault(scene, []).extend(things)
    return Found(results, seen, names)


def evaluate(
    drawn: Mapping[str, Sequence[Path]], model: str, image_size: int, confidence: float
) -> dict[str, Any]:
    """Evaluate one model on drawn frames: all of them, and each scene's."""
    found = detect(drawn, model, image_size)
    results, seen, names = found.results, found.seen, found.names
    everything = [result for of_scene in results.values() for result in of_scene]
    all_seen = [things for of_scene in seen.values() for things in of_scene]
    return {
        "model": model,
        "image_size": image_size,
        "confidence": confidence,
        "all": summary(everything, all_seen, names, confidence),
        "scenes": {scene: summary(results[scene], seen[scene], names, confidence) for scene in results},
    }


def lines(report: Mapping[str, Any]) -> list[str]:
    """The report for a person."""
    text = [
        f"{report['model']}: longer side {report['image_size']} px, precision and recall at confidence "
        f"{report['confidence']}"
    ]
    for scene, part in {"all": report["all"], **report["scenes"]}.items():
        text.append(f"{scene}: {part['frames']} frames, mAP50 {part['map50']}, mAP50-95 {part['map50_95']}")
        for name, one in part["classes"].items():
            if one["objects"] or one["precision"] is not None:
                text.append(
                    f"  {name:<8} {one['objects']:5d} objects  precision {one['precision']}  "
                    f"recall {one['recall']}  AP50 {one['ap50']}  AP50-95 {one['ap50_95']}"
                )
        recalls = ", ".join(
            f"{place} {one['recall']} of {one['objects']}"
            for place, one in part["ranges"].items()
            if one["objects"]
        )
        text.append(f"  recall at {recalls or 'no range'}")
        wrong = ", ".join(f"{what} {count}" for what, count in list(part["wrong"].items())[:12])
        text.append(f"  wrong: {wrong or 'none'}")
        text.append(
            f"  boats at 10 to 60 m: {part['boats_at_10_to_60_m']}, of these called car or truck: "
            f"{part['of_these_called_car_or_truck']}"
        )
    return text


def main(arguments: Sequence[str] | None = None) -> None:
    """Read the command line, render, evaluate, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--frames", type=int, default=2000, help="how many to draw, at least 10")
    parser.add_argument("--model", default=DEFAULT_MODEL, help="model to evaluate")
    parser.add_argument("--image-size", type=int, default=640, help="longer side the network sees, pixels")
    parser.add_argument("--confidence", type=float, default=CONFIRMED, help="of precision and recall")
    parser.add_argument(
        "--folder", type=Path, help="keep the rendered frames here; existing ones are used again"
    )
    parser.add_argument("--json", action="store_true", help="one JSON object")
    given = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    cv2.setNumThreads(1)
    with tempfile.TemporaryDirectory() as temporary:
        folder = given.folder or Path(temporary) / "frames"
        index = folder / "drawn.json"
        if index.is_file():
            drawn = {
                name: [folder / part for part in parts]
                for name, parts in json.loads(index.read_text()).items()
            }
        else:
            drawn = draw(folder, max(given.frames, 10))
            index.write_text(
                json.dumps({name: [part.name for part in parts] for name, parts in drawn.items()})
            )
        report = evaluate(drawn, given.model, given.image_size, given.confidence)
    print(json.dumps(report) if given.json else "\n".join(lines(report)))


if __name__ == "__main__":
    main()
