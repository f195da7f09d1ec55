"""A few steps of `companion learn train`, on scenes and on labelled images: the model can be used."""

from __future__ import annotations

import os
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml
from typer.testing import CliRunner, Result

import companion.learning.train
from companion.cli import app
from companion.learning.train import FineTuning, score_lines, train_default, train_on_data
from vision.detector import Detector
from vision.evaluation.metrics import ClassScore, Score
from vision.training.recipe import DEFAULT_RECIPE, REFINEMENT
from vision.training.training import Stage
from vision.yolo.checkpoint import load_checkpoint, save_checkpoint
from vision.yolo.checkpoint_pair import weights_sha256

DATA = Path(os.environ.get("COMPANION_TEST_DATA", Path(__file__).parents[4] / "shared" / "data"))


def test_training_writes_model_with_licence_and_score(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Smaller images than the recipe's; everything else is unchanged.
    small = replace(
        DEFAULT_RECIPE, stages=(Stage(96, 96, 1, 2),), width_multiple=0.0625, workers=0, threads=1
    )
    monkeypatch.setattr(companion.learning.train, "DEFAULT_RECIPE", small)
    stages = (Stage(96, 96, 1, 2, drawn=(128, 96)),)
    monkeypatch.setattr(
        companion.learning.train,
        "REFINEMENT",
        replace(REFINEMENT, stages=stages, width_multiple=0.0625, workers=0),
    )
    monkeypatch.setattr(companion.learning.train, "HELD_OUT_SIZE", (96, 96))
    output = tmp_path / "out" / "model.safetensors"
    score = train_default(output, held_out=2)
    assert 0.0 <= score.map50 <= 1.0
    written = yaml.safe_load(output.with_suffix(".yaml").read_text())
    assert written["licence"] == "Apache-2.0"
    assert written["score"]["held_out_scenes"] == 2
    assert written["steps_done"] == 2
    detector = Detector(output, image_size=96)
    assert detector.metadata["licence"] == "Apache-2.0"
    assert detector.rendered_only
    detector.detect(np.zeros((96, 96, 3), np.uint8))
    # Resuming a finished training has nothing left to do.
    assert train_default(output, held_out=2, resume=True).map50 == pytest.approx(score.map50)
    refined = train_default(tmp_path / "refined.safetensors", start=output, held_out=2)
    assert 0.0 <= refined.map50 <= 1.0
    assert not (tmp_path / "refined.safetensors.training").exists()


def test_resume_without_state_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        train_default(tmp_path / "model.pt", resume=True)


def write_labelled(folder: Path) -> Path:
    """A YOLO set of six grey images with a bright square each, class `Drone`; two are for validation."""
    for index in range(6):
        split = "val" if index > 3 else "train"
        image = np.full((60, 80, 3), 90, np.uint8)
        image[20:40, 5 * index : 5 * index + 20] = 250
        for kind in ("images", "labels"):
            (folder / kind / split).mkdir(parents=True, exist_ok=True)
        assert cv2.imwrite(str(folder / "images" / split / f"{index}.png"), image)
        line = f"1 {(5 * index + 10) / 80} 0.5 0.25 0.3333\n"
        (folder / "labels" / split / f"{index}.txt").write_text(line)
    (folder / "data.yaml").write_text("train: images/train\nval: images/val\nnames: [Person, Drone]\n")
    return folder


@pytest.fixture
def labelled(tmp_path: Path) -> Path:
    return write_labelled(tmp_path / "set")


SHORT = ("--image-size", "64", "--batch-size", "2", "--workers", "0")


def train_command(data: Path, model: Path | str, output: Path, *options: str) -> Result:
    arguments = ["learn", "train", "--data", str(data), "--from", str(model), "--output", str(output)]
    return CliRunner().invoke(app, [*arguments, *SHORT, *options])


@pytest.fixture(scope="module")
def trained(small_model: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Result]:
    """A labelled set, the model of three steps on it, and the command's result."""
    folder = tmp_path_factory.mktemp("trained")
    data, output = write_labelled(folder / "set"), folder / "out" / "mine.safetensors"
    torch.manual_seed(0)
    return data, output, train_command(data, small_model, output, "--steps", "3")


def test_class_of_own_images_is_added_and_scored(trained: tuple[Path, Path, Result]) -> None:
    _, output, result = trained
    assert result.exit_code == 0, result.stderr
    header, row, last = result.stdout.splitlines()
    assert header.split()[2:] == ["mAP50:", "before", "after", "mAP50-95:", "before", "after"]
    assert row.split()[:3] == ["Drone", "2", "-"]
    assert "on 2 images, none " in last
    written = load_checkpoint(output)
    assert written.class_names == ("person", "car", "boat", "Drone")
    assert written.metadata["licence"] == "Apache-2.0"
    assert written.metadata["started_from"] == "small.pt"
    assert not Detector(output, image_size=64).rendered_only
    assert (written.metadata["steps_done"], written.metadata["score"]["images"]) == (3, 2)
    assert "width_multiple" not in written.metadata["settings"]


def test_interrupted_training_on_images_resumes_by_its_own_options_only(
    trained: tuple[Path, Path, Result], small_model: Path, tmp_path: Path
) -> None:
    labelled, whole, _ = trained
    cut, other = tmp_path / "cut.safetensors", tmp_path / "other.pt"
    torch.manual_seed(1)  # Nothing depends on the process's generator.
    train_on_data(
        *(labelled, cut),
        start=str(small_model),
        image_size=64,
        batch_size=2,
        workers=0,
        steps=3,
        time_limit_s=0.0,
    )
    assert load_checkpoint(cut).metadata["steps_done"] == 1
    before = cut.read_bytes()
    loaded = load_checkpoint(small_model)
    torch.nn.init.zeros_(next(loaded.model.parameters()))
    save_checkpoint(other, loaded.model, metadata={})

    def differing(start: Path, *options: str) -> set[str]:
        result = train_command(labelled, start, cut, "--steps", "3", "--resume", *options)
        assert result.exit_code == 2
        (error,) = [line for line in result.stderr.splitlines() if line.startswith("companion:")]
        return {key for key in ("data", "start", "seed", "batches") if f" {key}: " in error}

    assert differing(small_model, "--seed", "9", "--image-size", "96") == {"seed", "batches"}
    labels = labelled / "labels" / "train" / "0.txt"
    corrected = labels.read_text()
    labels.write_text("1 0.5 0.5 0.25 0.3333\n")
    assert differing(other) == {"data", "start"}
    labels.write_text(corrected)
    added = labelled / "images" / "train" / "5.png"
    shutil.copy(labelled / "images" / "val" / "5.png", added)
    assert differing(small_model) == {"data"}
    added.unlink()
    assert cut.read_bytes() == before
    assert train_command(labelled, small_model, cut, "--steps", "3", "--resume").exit_code == 0
    assert weights_sha256(cut) == weights_sha256(whole)
    assert load_checkpoint(cut).metadata == load_checkpoint(whole).metadata


@pytest.mark.parametrize("existing", ["mine.safetensors.training", "mine.safetensors", "mine.yaml"])
@pytest.mark.parametrize("own_data", [True, False])
def test_existing_state_or_output_is_kept(
    labelled: Path, small_model: Path, tmp_path: Path, existing: str, own_data: bool
) -> None:
    output = tmp_path / "mine.safetensors"
    (tmp_path / existing).write_text("kept")
    if own_data:
        result = train_command(labelled, small_model, output, "--steps", "1")
    else:
        result = CliRunner().invoke(app, ["learn", "train", "--output", str(output), "--steps", "1"])
    assert result.exit_code == 2
    assert len(result.stderr.splitlines()) == 1
    assert existing in result.stderr
    assert "another --output" in result.stderr
    assert ("--resume" in result.stderr) == existing.endswith(".training")
    assert (tmp_path / existing).read_text() == "kept"


@pytest.mark.parametrize("own_data", [True, False])
def test_output_that_is_the_start_is_refused(
    labelled: Path, small_model: Path, tmp_path: Path, own_data: bool
) -> None:
    start, link = tmp_path / "mine.safetensors", tmp_path / "link"
    save_checkpoint(start, load_checkpoint(small_model).model, metadata={})
    link.symlink_to(tmp_path, target_is_directory=True)
    before = start.read_bytes()
    if own_data:
        result = train_command(labelled, start, link / "mine", "--steps", "1", "--resume")
    else:
        arguments = ["learn", "train", "--from", str(start), "--output", str(link / "mine"), "--resume"]
        result = CliRunner().invoke(app, arguments)
    assert result.exit_code == 2
    assert len(result.stderr.splitlines()) == 1
    assert "mine.safetensors is " in result.stderr
    assert "start from " in result.stderr
    assert start.read_bytes() == before


def test_without_validation_images_training_images_are_judged(
    labelled: Path, trained: tuple[Path, Path, Result], tmp_path: Path
) -> None:
    """The start is itself the result of a training: it can be trained again."""
    _, start, _ = trained
    (labelled / "data.yaml").write_text("train: images/train\nnames: [Person, Drone]\n")
    result = train_command(labelled, start, tmp_path / "mine.safetensors", "--steps", "1")
    assert result.exit_code == 0, result.stderr
    last = result.stdout.splitlines()[-1]
    assert "on 4 images, " in last
    assert last.endswith("training images")
    again = load_checkpoint(tmp_path / "mine.safetensors")
    assert again.metadata["score"]["held_out"] is False
    assert again.class_names == load_checkpoint(start).class_names


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("labels/train/2.txt", "0 0.5 0.5 0.2 0.2\n2 0.5 0.5 0.2 0.2\n", "2.txt, line 2: "),
        ("labels/train/2.txt", "0 40 30 20 20\n", "2.txt, line 1: coordinates"),
        ("labels/train/9.txt", "0 0.5 0.5 0.2 0.2\n", "labels/train/9.txt: its image "),
        ("images/train/2.png", "", "train/2.png: is empty"),
        ("data.yaml", "val: images/val\nnames: [Person, Drone]\n", "split 'train'"),
        ("data.yaml", "train: images/gone\nval: images/val\n", "images/gone,"),
    ],
)
def test_labels_that_do_not_fit_are_one_line(
    labelled: Path, small_model: Path, tmp_path: Path, file: str, content: str, message: str
) -> None:
    (labelled / file).write_text(content)
    result = train_command(labelled, small_model, tmp_path / "mine.safetensors", "--steps", "1")
    assert (result.exit_code, result.stdout) == (2, "")
    error = [line for line in result.stderr.splitlines() if line.startswith("companion:")]
    assert len(error) == 1
    assert message in error[0]


def test_class_beyond_the_names_of_the_model_is_named(
    labelled: Path, small_model: Path, tmp_path: Path
) -> None:
    (labelled / "data.yaml").unlink()
    (labelled / "labels" / "train" / "2.txt").write_text("3 0.5 0.5 0.2 0.2\n")
    result = train_command(labelled, small_model, tmp_path / "mine.safetensors")
    assert result.exit_code == 2
    assert "2.txt, line 1: " in result.stderr
    assert " 0..2, got 3" in result.stderr


def test_set_without_objects_is_refused(labelled: Path, small_model: Path, tmp_path: Path) -> None:
    for path in (labelled / "labels" / "train").iterdir():
        path.write_text("")
    result = train_command(labelled, small_model, tmp_path / "mine.safetensors")
    assert result.exit_code == 2
    assert "no object " in result.stderr
    assert "its 4 images" in result.stderr


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_sixteen_photographs_are_learned(tmp_path: Path) -> None:
    checkpoint, photographs = DATA / "models" / "yolov8n_coco.pt", tmp_path / "set"
    if not checkpoint.is_file():
        pytest.skip(f"{checkpoint}: test data not found; see COMPANION_TEST_DATA")
    for labels in sorted((DATA / "coco" / "labels").iterdir())[:16]:
        for path in (labels, DATA / "coco" / "images" / f"{labels.stem}.jpg"):
            (photographs / path.parent.name).mkdir(parents=True, exist_ok=True)
            shutil.copy(path, photographs / path.parent.name)
    result = train_on_data(
        photographs, tmp_path / "mine.safetensors", start=str(checkpoint), steps=60, seed=7
    )
    assert result.before is not None
    assert result.before.map50 < 0.9
    assert result.after.map50 >= 0.95
    assert not result.held_out


def scored(**ap: float) -> Score:
    mean = sum(ap.values()) / len(ap)
    return Score(mean, mean, {name: ClassScore(one, one, 10) for name, one in ap.items()}, 20)


@pytest.mark.parametrize(
    ("before", "after", "worse"),
    [
        (scored(car=0.6, boat=0.5), scored(car=0.4, boat=0.6), ("car",)),
        (scored(car=0.6), scored(car=0.598, kite=0.1), ()),
        (None, scored(kite=0.1), ()),
    ],
)
def test_training_that_ends_worse_says_so(before: Score | None, after: Score, worse: tuple[str, ...]) -> None:
    result = FineTuning(before, after, held_out=True)
    assert result.worse == worse
    named = [line for line in score_lines(result) if line.startswith("worse")]
    assert len(named) == bool(worse)
    assert all(name in named[0] for name in worse)
