"""`companion learn evaluate` on small data sets and on real photographs."""

from __future__ import annotations

import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from companion.cli import app
from companion.learning.evaluate import evaluate_dataset, map_classes
from vision.detections import Detections
from vision.evaluation.datasets import Dataset, DatasetError, Sample, open_dataset

DATA = Path(os.environ.get("COMPANION_TEST_DATA", Path(__file__).parents[4] / "shared" / "data"))


class FixedDetector:
    """A detector with the same detections in every frame."""

    last_timing = None

    def __init__(self, names: tuple[str, ...], *boxes: tuple[float, float, float, float, float, int]) -> None:
        table = np.array(boxes, np.float32).reshape(-1, 6)
        self.class_names = names
        self.detections = Detections(table[:, :4], table[:, 4], table[:, 5].astype(np.int64), names)

    def detect(self, image_bgr: np.ndarray) -> Detections:
        return self.detections


def dataset(tmp_path: Path, names: tuple[str, ...] | None, *boxes: tuple[float, ...]) -> Dataset:
    """Two images: one with these boxes (xyxy pixels and class), and an empty one."""
    samples = []
    for name, shown in (("a.png", boxes), ("b.png", ())):
        assert cv2.imwrite(str(tmp_path / name), np.zeros((100, 100, 3), np.uint8))
        table = np.array(shown, np.float32).reshape(-1, 5)
        samples.append(Sample(tmp_path / name, table[:, :4], table[:, 4].astype(np.int64)))
    return Dataset(tmp_path, "COCO", names, tuple(samples))


def test_classes_match_by_name_and_unknown_are_listed(tmp_path: Path) -> None:
    data = dataset(tmp_path, ("Traffic_Light", "car", "lorry"), (0, 0, 9, 9, 0), (20, 20, 40, 40, 2))
    mapping = map_classes(("car", "traffic light", "dog"), data)
    assert mapping.names == ("Traffic_Light", "car")
    assert mapping.unknown == ("lorry",)
    detector = FixedDetector(("car", "traffic light", "dog"), (0, 0, 9, 9, 0.9, 1), (60, 60, 70, 70, 0.95, 2))
    evaluation = evaluate_dataset(data, detector, mapping)
    # The dog is not evaluated, nor is the lorry; the second image has one false positive.
    assert evaluation.score.per_class["Traffic_Light"].ap50 == pytest.approx(1.0)
    assert evaluation.score.per_class["car"].objects == 0
    assert evaluation.unjudged_objects == 1
    assert evaluation.misses.counts == {"missed": 0, "imagined": 1}


def test_without_names_classes_match_by_id(tmp_path: Path) -> None:
    data = dataset(tmp_path, None, (0, 0, 9, 9, 1))
    assert map_classes(("car", "dog"), data).names == ("car", "dog")
    with pytest.raises(DatasetError, match=r"class id 1, expected 0\.\.0"):
        map_classes(("car",), data)


def test_no_common_class_is_an_error_with_both_lists(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"lorry.*car, dog"):
        map_classes(("car", "dog"), dataset(tmp_path, ("lorry",)))


def test_command_writes_json_and_image(tmp_path: Path, small_model: Path) -> None:
    data = dataset(tmp_path, None)
    for sample, line in zip(data.samples, ("0 0.5 0.5 0.5 0.5\n", ""), strict=True):
        sample.image.with_suffix(".txt").write_text(line)
    arguments = ["learn", "evaluate", str(tmp_path), "--model", str(small_model), "--image-size", "64"]
    sheet = tmp_path / "out" / "misses.png"
    result = CliRunner().invoke(app, [*arguments, "--misses", str(sheet), "--json"])
    assert result.exit_code == 0, result.stderr
    figures = json.loads(result.stdout)
    assert figures["images"] == 2
    assert figures["per_class"]["person"]["objects"] == 1
    assert figures["per_class"]["car"]["ap50"] is None
    assert figures["missed_at_0.25"] == 1
    assert figures["misses_image"] == str(sheet)
    assert cv2.imread(str(sheet)) is not None
    result = CliRunner().invoke(app, [*arguments, "--misses", str(sheet)])
    assert "mAP50-95" in result.stdout
    result = CliRunner().invoke(
        app, ["learn", "evaluate", str(tmp_path / "none"), "--model", str(small_model)]
    )
    assert result.exit_code == 2
    assert f"{tmp_path / 'none'}: " in result.stderr
    assert "such file " in result.stderr


@pytest.mark.skipif(
    not (DATA / "coco").is_dir(), reason=f"{DATA / 'coco'} is not here; set COMPANION_TEST_DATA"
)
def test_real_model_detects_objects_in_photographs(tmp_path: Path) -> None:
    from dataclasses import replace

    from vision.detector import Detector

    data = open_dataset(DATA / "coco")
    detector = Detector(
        DATA / "models" / "yolov8n_coco.pt", confidence=0.001, image_size=320, precision="float32"
    )
    data = replace(data, samples=data.samples[:8])
    score = evaluate_dataset(data, detector, map_classes(detector.class_names, data)).score
    assert score.map50 > 0.5


def test_detect_and_evaluate_with_tiles(tmp_path: Path, small_model: Path, image_folder: Path) -> None:
    options = ["--model", str(small_model), "--image-size", "64", "--tiles", "--tile-size", "80"]
    result = CliRunner().invoke(app, ["detect", str(image_folder), *options, "--limit", "2", "--json"])
    assert result.exit_code == 0, result.stderr
    assert [json.loads(line)["width"] for line in result.stdout.splitlines()] == [160, 160]
    image = tmp_path / "a.png"
    assert cv2.imwrite(str(image), np.zeros((120, 160, 3), np.uint8))
    image.with_suffix(".txt").write_text("0 0.5 0.5 0.5 0.5\n")
    misses = ["--misses", str(tmp_path / "m.png"), "--json"]
    result = CliRunner().invoke(app, ["learn", "evaluate", str(tmp_path), *options, *misses])
    assert result.exit_code == 0, result.stderr
    assert json.loads(result.stdout)["tiles"] is True
