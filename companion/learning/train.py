"""`companion learn train`: train the bundled detector from this repository, or any one on labelled images.

For the bundled one the recipe (`vision.training.recipe`) and the scenes
(`mavlink_sim.datasets.training_scenes`) determine the weights; nothing is downloaded. On labelled images a
trained model is refined (`vision.training.fine_tuning`).
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from companion.learning.evaluate import JUDGED_CONFIDENCE, evaluate_dataset, map_classes
from companion.learning.training_display import TrainingDisplay
from mavlink_sim.datasets.training_scenes import random_scene, training_scene
from mavlink_sim.world.shapes import CLASS_NAMES
from vision.class_names import fold_name
from vision.detector import DEFAULT_MODEL, RENDERED_SCENES, Detector
from vision.evaluation.datasets import Dataset, DatasetError, MissingSplitError, open_dataset
from vision.evaluation.metrics import Score
from vision.model_files import find_model
from vision.runtimes.base import bfloat16_instructions
from vision.training.fine_tuning import DOUBTED_SCORE, LabelledScenes, extend_classes, training_images
from vision.training.recipe import DEFAULT_RECIPE, HELD_OUT_SEED, HELD_OUT_SIZE, NMS_IOU, REFINEMENT, evaluate
from vision.training.training import Progress, Stage, TrainedModel, TrainingSettings, train
from vision.weights import DEFAULT_WEIGHTS
from vision.yolo.checkpoint import load_checkpoint, save_checkpoint
from vision.yolo.checkpoint_pair import WEIGHTS_SUFFIX, pair_paths, weights_sha256

logger = logging.getLogger(__name__)

# A smaller difference of mAP is not called worse.
_WORSE = 0.005
LICENCE = "Apache-2.0"
USUAL_EPOCHS = 40


def train_default(
    output: Path,
    *,
    seed: int | None = None,
    steps: int | None = None,
    time_limit_s: float | None = None,
    workers: int | None = None,
    threads: int | None = None,
    resume: bool = False,
    start: Path | None = None,
    held_out: int = 400,
) -> Score:
    """Train by the recipe with the given changes, evaluate, and write the result (`evaluate_and_save`).

    The first stage starts with random weights, the second refines them. The state of each is stored beside
    the output as `<output>.training` and `<output>.refining`, for `resume`. `steps` and `time_limit_s` are
    distributed over the stages in proportion.

    Args:
        start: a model of the recipe's network to refine; replaces the first stage.

    Raises:
        FileNotFoundError: `resume` without a state. CheckpointError: `start` cannot be read.
        FileExistsError: a state or the output exists, without `resume`.
        ValueError: the state or `start` belongs to another recipe, or the output is `start`.
    """
    states = [output.with_suffix(f"{output.suffix}.{name}") for name in ("training", "refining")]
    _check_output(output, states, start, resume=resume)
    output.parent.mkdir(parents=True, exist_ok=True)
    changes: dict[str, Any] = {
        key: value for key, value in (("workers", workers), ("threads", threads)) if value is not None
    }
    first, second = replace(DEFAULT_RECIPE, **changes), replace(REFINEMENT, **changes)
    if tuple(first.class_names) != tuple(CLASS_NAMES):
        raise ValueError(f"recipe classes {first.class_names}, expected those of the scenes {CLASS_NAMES}")
    if seed is not None:
        first, second = replace(first, seed=seed), replace(second, seed=seed + 1)
    share = 0.0 if start is not None else first.steps / (first.steps + second.steps)
    if steps is not None:
        second = second.with_steps(max(1, round(steps * (1 - share))))
        first = first.with_steps(max(1, round(steps * share)))
    if time_limit_s is not None:
        first = replace(first, time_limit_s=time_limit_s * share)
        second = replace(second, time_limit_s=time_limit_s * (1 - share))
    with TrainingDisplay() as display:
        show = _shown_on(display)
        if start is not None:
            initial = load_checkpoint(start).model
        else:
            initial = train(first, random_scene, show, checkpoint=states[0], resume=resume).model
        refined = train(
            second,
            training_scene,
            show,
            checkpoint=states[1],
            resume=resume and (start is not None or states[1].is_file()),
            start=initial,
            origin={"start": "the first stage" if start is None else _digest_of(start)},
        )
    return evaluate_and_save(output, refined, second, held_out)


def evaluate_and_save(
    output: Path, trained: TrainedModel, settings: TrainingSettings, held_out: int
) -> Score:
    """Score a model on held-out scenes and write it, fp16, with licence, score and settings.

    Writes the pair `NAME.safetensors` and `NAME.yaml`, whatever the suffix of `output`.
    """
    width, height = HELD_OUT_SIZE
    score = evaluate(trained.model, training_scene, HELD_OUT_SEED, held_out, width, height)
    metadata = {
        "licence": LICENCE,
        "nms_iou": NMS_IOU,
        "trained_on": f"{RENDERED_SCENES}mavlink_sim.datasets.training_scenes",
        "steps_done": trained.steps_done,
        "score": {
            "map50": round(score.map50, 4),
            "map50_95": round(score.map50_95, 4),
            "per_class": json.loads(json.dumps(score.per_class, default=asdict)),
            "held_out_scenes": held_out,
            "held_out_seed": HELD_OUT_SEED,
            "held_out_size": [width, height],
        },
        "settings": json.loads(json.dumps(asdict(settings))),
    }
    save_checkpoint(output.with_suffix(WEIGHTS_SUFFIX), trained.model, metadata=metadata)
    return score


@dataclass(frozen=True, slots=True)
class FineTuning:
    """Result of `train_on_data`.

    Attributes:
        before: score of the starting model on the validation images; None if it knows none of the classes.
        after: that of the result.
        held_out: whether none of these images was trained on.
    """

    before: Score | None
    after: Score
    held_out: bool

    @property
    def worse(self) -> tuple[str, ...]:
        """The classes of the validation images that the starting model found better, by mAP50-95."""
        before = {} if self.before is None else self.before.per_class
        return tuple(
            name
            for name, one in self.after.per_class.items()
            if one.objects and name in before and before[name].ap50_95 - one.ap50_95 > _WORSE
        )


def train_on_data(
    data: Path,
    output: Path,
    *,
    start: str = DEFAULT_MODEL,
    validation: Path | None = None,
    steps: int | None = None,
    time_limit_s: float | None = None,
    image_size: int = 640,
    batch_size: int = 8,
    learning_rate: float = 1e-3,
    seed: int = 0,
    workers: int = 1,
    threads: int = 1,
    resume: bool = False,
) -> FineTuning:
    """Train a model on a labelled data set, score it before and after, and write it as a pair.

    The model keeps its classes; those of the data set that it does not know are added. The state is stored
    beside the output as `<output>.training`, for `resume`.

    Args:
        data: as for `companion learn evaluate`; the split `train` if it has splits.
        start: the model to train: `default`, a file, or a name in the models folder.
        validation: a data set to score on; None: the split `val` of `data`, or without one the training
            images.
        steps: None for about 40 passes over the images, at least 200 steps.
        image_size: side of the training images, and longer side in the evaluation; pixels, a multiple of 32.

    Raises:
        DatasetError: the data set cannot be used. CheckpointError: `start` cannot be read.
        FileNotFoundError: `resume` without a state. FileExistsError: a state or the output exists, without
            `resume`. ValueError: the state belongs to another training, the network cannot be trained, or the
            output is `start`.
    """
    path = DEFAULT_WEIGHTS if start == DEFAULT_MODEL else find_model(start)
    state = output.with_suffix(f"{output.suffix}.training")
    _check_output(output, [state], path, resume=resume)
    loaded = load_checkpoint(path)
    train_set = open_dataset(data, split="train", class_names=loaded.class_names)
    try:
        judged_set = open_dataset(
            validation or data, split=None if validation else "val", class_names=loaded.class_names
        )
    except MissingSplitError:
        judged_set = train_set
    if not any(len(sample.class_ids) for sample in train_set.samples):
        raise DatasetError(f"{data}: no object is labelled in its {len(train_set.samples)} images")
    model = extend_classes(loaded.model, train_set.class_names or (), seed=seed)
    map_classes(model.class_names, judged_set)  # Raises now, not after the training.
    steps = steps or max(200, math.ceil(USUAL_EPOCHS * len(train_set.samples) / batch_size))
    settings = TrainingSettings(
        class_names=model.class_names,
        stages=(Stage(image_size, image_size, batch_size, steps, decay_steps=steps),),
        learning_rate=learning_rate,
        warmup_steps=max(1, min(100, steps // 10)),
        fixed_normalisation=True,
        average_decay=min(0.998, max(0.9, 1 - 10 / steps)),
        new_classes=len(model.class_names) - len(loaded.class_names),
        seed=seed,
        threads=threads,
        workers=workers,
        bfloat16=bool(bfloat16_instructions()),
        time_limit_s=time_limit_s,
    )
    output.parent.mkdir(parents=True, exist_ok=True)
    finder = Detector(
        path, confidence=DOUBTED_SCORE, image_size=image_size, precision="float32", threads=threads
    )
    images = list(training_images(train_set, model.class_names, finder.detect))
    labels = sum(len(sample.class_ids) for sample in train_set.samples)
    logger.info(
        "%d images, %d labels, and %d objects that %s finds of its classes without labels",
        len(images),
        labels,
        sum(len(image.class_ids) for image in images) - labels,
        path.name,
    )
    with TrainingDisplay() as display:
        trained = train(
            settings,
            LabelledScenes(images, len(loaded.class_names)),
            _shown_on(display),
            checkpoint=state,
            resume=resume,
            start=model,
            network=model.description,
            origin={"data": _data_digest(train_set), "start": _digest_of(path)},
        )
    weights = output.with_suffix(WEIGHTS_SUFFIX)
    metadata: dict[str, Any] = {
        **{key: value for key, value in loaded.metadata.items() if key in ("licence", "nms_iou")},
        "trained_on": f"{len(images)} images of {data.resolve().name}",
        "started_from": path.name,
        "steps_done": trained.steps_done,
        "settings": {
            key: value
            for key, value in json.loads(json.dumps(asdict(settings))).items()
            if key not in ("depth_multiple", "width_multiple", "max_channels")  # not of this network
        },
    }
    save_checkpoint(weights, trained.model, metadata=metadata)
    judged = {fold_name(name) for name in judged_set.class_names or ()}
    knows_any = not judged.isdisjoint(fold_name(name) for name in loaded.class_names)
    after = _score(weights, judged_set, image_size, threads)
    result = FineTuning(
        _score(path, judged_set, image_size, threads) if knows_any else None,
        after,
        {s.image for s in judged_set.samples}.isdisjoint(s.image for s in train_set.samples),
    )
    metadata["score"] = {
        "map50": round(after.map50, 4),
        "map50_95": round(after.map50_95, 4),
        "images": after.images,
        "held_out": result.held_out,
    }
    save_checkpoint(weights, trained.model, metadata=metadata)
    return result


def score_lines(result: FineTuning) -> list[str]:
    """A table of the classes that occur in the validation images, before and after the training."""
    names = [name for name, one in result.after.per_class.items() if one.objects]
    width = max([len("class"), *map(len, names)])
    lines = [f"{'class':<{width}}  objects  mAP50: before  after  mAP50-95: before  after"]
    for name in names:
        new = result.after.per_class[name]
        old = None if result.before is None else result.before.per_class.get(name)
        old50, old95 = ("-", "-") if old is None else (f"{old.ap50:.3f}", f"{old.ap50_95:.3f}")
        lines.append(
            f"{name:<{width}}  {new.objects:7d}  {old50:>13}  {new.ap50:.3f}  {old95:>16}  {new.ap50_95:.3f}"
        )
    if result.worse:
        lines.append(
            f"worse than the model it started from: {', '.join(result.worse)}; more images or a lower "
            "--learning-rate may help, else keep that model"
        )
    return lines


def _check_output(output: Path, states: Sequence[Path], start: Path | None, *, resume: bool) -> None:
    """Raise before the training if its files would replace the model to start from, or others."""
    pair = pair_paths(output.with_suffix(WEIGHTS_SUFFIX))
    if start is not None and os.path.realpath(start) in map(os.path.realpath, pair):
        raise ValueError(f"{start} is the model to start from and the output; give another --output")
    if resume:
        return
    if state := next((path for path in states if path.exists()), None):
        raise FileExistsError(f"{state} exists: continue it with --resume, or give another --output")
    if existing := next((path for path in pair if path.exists()), None):
        raise FileExistsError(f"{existing} exists: give another --output")


def _data_digest(dataset: Dataset) -> str:
    """Identifies the images (path below the root, bytes) and labels, wherever the data set is."""
    root = dataset.root if dataset.root.is_dir() else dataset.root.parent
    digest = hashlib.sha256(json.dumps(dataset.class_names).encode())
    for sample in dataset.samples:
        digest.update(f"{os.path.relpath(sample.image, root)} {sample.image.stat().st_size}\n".encode())
        for array in (sample.boxes, sample.class_ids, sample.ignored):
            digest.update(array.tobytes())
    return f"{len(dataset.samples)} images, SHA-256 {digest.hexdigest()[:16]}"


def _digest_of(model: Path) -> str:
    return f"SHA-256 {weights_sha256(model)[:16]}"


def _score(model: Path, dataset: Dataset, image_size: int, threads: int) -> Score:
    detector = Detector(
        model, confidence=JUDGED_CONFIDENCE, image_size=image_size, precision="float32", threads=threads
    )
    return evaluate_dataset(dataset, detector, map_classes(detector.class_names, dataset)).score


def _shown_on(display: TrainingDisplay) -> Callable[[Progress], None]:
    def show(progress: Progress) -> None:
        figures = (
            f"box {progress.box_loss:.3f} class {progress.class_loss:.3f} "
            f"distribution {progress.distribution_loss:.3f} {progress.images_per_s:.1f} images/s"
        )
        display.show(progress.step, progress.steps, figures, progress.remaining_s)

    return show
