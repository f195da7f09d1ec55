"""Training on rendered scenes: it learns, is reproducible, and resumes."""

from __future__ import annotations

import copy
import itertools
import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from vision.training.recipe import evaluate
from vision.training.scene_batches import (
    NO_AUGMENTATION,
    Augmentation,
    LabelledImage,
    SceneKey,
    SceneSource,
    augment,
    collate,
    draw_scene,
    scene_batches,
)
from vision.training.training import Progress, Stage, TrainedModel, TrainingSettings, train

COLOURS = ((40, 40, 220), (60, 200, 60))


def rectangles(rng: np.random.Generator, width: int, height: int) -> LabelledImage:
    """Two rectangles of two classes on noise, in separate halves so that neither hides the other."""
    image = rng.integers(90, 130, (height, width, 3), dtype=np.uint8)
    boxes, ids = [], []
    for half in range(2):
        class_id = int(rng.integers(2))
        size = rng.integers(width // 6, width // 3, 2)
        left = int(rng.integers(0, width // 2 - size[0])) + half * width // 2
        top = int(rng.integers(0, height - size[1]))
        right, bottom = left + int(size[0]), top + int(size[1])
        cv2.rectangle(image, (left, top), (right - 1, bottom - 1), COLOURS[class_id], -1)
        boxes.append([left, top, right, bottom])
        ids.append(class_id)
    return image, np.array(boxes, np.float32), np.array(ids, np.int64)


def one_of_eight(rng: np.random.Generator, width: int, height: int) -> LabelledImage:
    """One of eight fixed images."""
    return rectangles(np.random.default_rng(int(rng.integers(8))), width, height)


def nothing(_rng: np.random.Generator | None, width: int, height: int) -> LabelledImage:
    return np.zeros((height, width, 3), np.uint8), np.zeros((0, 4), np.float32), np.zeros(0, np.int64)


def nothing_or_rectangles(rng: np.random.Generator, width: int, height: int) -> LabelledImage:
    """Objects only in the wide images."""
    return rectangles(rng, width, height) if width == 96 else nothing(rng, width, height)


SMALL = TrainingSettings(
    class_names=("red", "green"),
    stages=(Stage(64, 64, 4, 4),),
    width_multiple=0.0625,
    max_channels=256,
    augmentation=NO_AUGMENTATION,
    warmup_steps=2,
    workers=0,
)


def weights(trained: TrainedModel) -> torch.Tensor:
    return torch.cat([value.flatten().float() for value in trained.model.state_dict().values()])


def silent(_progress: Progress) -> None:
    pass


@pytest.fixture(scope="module")
def trained() -> TrainedModel:
    return train(SMALL, rectangles, silent)


def test_tiny_model_overfits_eight_images() -> None:
    settings = replace(
        SMALL, stages=(Stage(64, 64, 6, 50),), warmup_steps=10, learning_rate=1e-2, average_decay=0.9
    )
    seen: list[Progress] = []
    trained = train(settings, one_of_eight, seen.append)
    score = evaluate(trained.model, one_of_eight, seed=0, count=24, width=64, height=64)
    assert score.map50 > 0.9
    assert set(score.per_class) == {"red", "green"}
    assert [progress.step for progress in seen] == list(range(1, 51))
    assert seen[-1].remaining_s == 0


@pytest.mark.parametrize("workers", [2, pytest.param(1, marks=pytest.mark.slow)])
def test_same_seed_gives_same_weights_for_any_workers(trained: TrainedModel, workers: int) -> None:
    again = train(replace(SMALL, workers=workers), rectangles, silent)
    assert torch.equal(weights(trained), weights(again))


def test_another_seed_gives_other_weights(trained: TrainedModel) -> None:
    other = train(replace(SMALL, seed=1), rectangles, silent)
    assert not torch.equal(weights(trained), weights(other))


def test_weights_of_new_classes_learn_faster_by_the_rate() -> None:
    one = replace(SMALL, stages=(Stage(64, 64, 4, 1),), average_decay=0.0)
    start = train(one, rectangles, silent).model

    def change(**settings: Any) -> dict[str, torch.Tensor]:
        trained = train(replace(one, seed=1, **settings), rectangles, silent, start=start)
        before, after = start.state_dict(), trained.model.state_dict()
        return {name: (after[name] - before[name]).float() for name in before}

    usual, faster = change(), change(new_classes=1, new_class_rate=10.0)
    last = [name for name in usual if re.search(r"\.cv3\.\d\.2\.(weight|bias)$", name)]
    assert len(last) == 6
    for name in last:
        assert usual[name][1].any()
        usual[name][1] *= 10.0
    for name, value in faster.items():
        torch.testing.assert_close(value, usual[name], rtol=1e-3, atol=1e-6)


def test_resumed_training_gives_uninterrupted_weights(trained: TrainedModel, tmp_path: Path) -> None:
    kept = tmp_path / "state.pt"
    cut = train(replace(SMALL, time_limit_s=0.0), rectangles, silent, checkpoint=kept)
    assert cut.steps_done == 1
    # Without new classes their rate has no effect.
    resumed = train(replace(SMALL, new_class_rate=10.0), rectangles, silent, checkpoint=kept, resume=True)
    assert resumed.steps_done == 4
    assert torch.equal(weights(trained), weights(resumed))


def test_resuming_another_training_is_rejected(tmp_path: Path) -> None:
    kept = tmp_path / "state.pt"
    one_new = replace(SMALL, new_classes=1, new_class_rate=10.0)
    train(replace(one_new, time_limit_s=0.0), rectangles, silent, checkpoint=kept)
    rate = r"another training, .*classes: 1, .* 10 times .*\(now "
    changes: list[tuple[dict[str, Any], str]] = [
        ({"width_multiple": 0.125}, r"network .*0\.0625, .*settings .*0\.125, "),
        ({"new_class_rate": 30.0}, rate),
        ({"new_classes": 2}, rate),
        ({"new_classes": 0}, rate),
    ]
    for changed, expected in changes:
        with pytest.raises(ValueError, match=expected):
            train(replace(one_new, **changed), rectangles, silent, checkpoint=kept, resume=True)


def test_resuming_without_a_checkpoint_names_the_file(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"missing\.pt"):
        train(SMALL, rectangles, silent, checkpoint=tmp_path / "missing.pt", resume=True)


def test_loss_of_zero_is_an_error(trained: TrainedModel) -> None:
    start = copy.deepcopy(trained.model)
    with torch.no_grad():
        for branch in start.detect.cv3:
            branch[-1].weight.zero_()  # type: ignore[index]
            branch[-1].bias.fill_(-1e4)  # type: ignore[index]
    with pytest.raises(FloatingPointError, match=r"step 0 .*rate"):
        train(SMALL, rectangles, silent, start=start)


def test_stages_of_other_sizes_and_images_without_objects_train() -> None:
    seen: list[Progress] = []
    stages = Stage(64, 64, 2, 2), Stage(96, 64, 1, 1)
    trained = train(replace(SMALL, stages=stages), nothing_or_rectangles, seen.append)
    assert [(p.step, p.steps) for p in seen] == [(1, 3), (2, 3), (3, 3)]
    assert [p.box_loss > 0 for p in seen] == [False, False, True]
    assert torch.isfinite(weights(trained)).all()


def test_the_rate_warms_up_stays_and_falls() -> None:
    settings = replace(
        SMALL, stages=(Stage(64, 64, 1, 100, decay_steps=20),), warmup_steps=10, final_rate=0.1
    )
    rates = [settings.rate_at(step) / settings.learning_rate for step in range(101)]
    assert rates[0] == pytest.approx(0.1)
    assert rates[9:81] == pytest.approx([1.0] * 72)
    assert all(later < earlier for earlier, later in itertools.pairwise(rates[80:]))
    assert rates[100] == pytest.approx(0.1)


def test_longer_constant_part_keeps_earlier_rates() -> None:
    settings = replace(SMALL, stages=(Stage(64, 64, 1, 100, decay_steps=20),), warmup_steps=10)
    longer = replace(settings, stages=(Stage(64, 64, 1, 300, decay_steps=20),))
    assert [settings.rate_at(step) for step in range(80)] == [longer.rate_at(step) for step in range(80)]


def test_compressed_schedule_keeps_its_stages() -> None:
    settings = replace(SMALL, stages=(Stage(64, 64, 1, 90, decay_steps=20), Stage(96, 96, 1, 10)))
    short = settings.with_steps(10)
    assert [(stage.steps, stage.decay_steps) for stage in short.stages] == [(9, 2), (1, 0)]
    one = settings.with_steps(1)
    assert [(stage.steps, stage.decay_steps) for stage in one.stages] == [(1, 1), (1, 0)]


def test_each_stage_has_its_own_decay() -> None:
    stages = (
        Stage(64, 64, 1, 50, decay_steps=10),
        Stage(96, 96, 1, 30),
        Stage(64, 64, 1, 20, decay_steps=20, rate=0.5),
    )
    settings = replace(SMALL, stages=stages, warmup_steps=5, final_rate=0.1)
    rates = [settings.rate_at(step) / settings.learning_rate for step in range(101)]
    assert rates[5:41] == pytest.approx([1.0] * 36)
    assert rates[49] == pytest.approx(0.19)
    assert rates[50:80] == pytest.approx([1.0] * 30)
    assert rates[80] == pytest.approx(0.5)
    assert rates[90] == pytest.approx(0.3)
    assert rates[100] == pytest.approx(0.1)


def wrong_size(rng: np.random.Generator, width: int, height: int) -> LabelledImage:
    return rectangles(rng, width + 1, height)


def unknown_class(rng: np.random.Generator, width: int, height: int) -> LabelledImage:
    image, boxes, ids = rectangles(rng, width, height)
    return image, boxes, ids + 5


def label_short(rng: np.random.Generator, width: int, height: int) -> LabelledImage:
    image, boxes, ids = rectangles(rng, width, height)
    return image, boxes, ids[:1]


@pytest.mark.parametrize(
    ("source", "message"),
    [
        pytest.param(wrong_size, "the source returned", id="size"),
        pytest.param(unknown_class, r"class ids .*0\.\.1", id="class"),
        pytest.param(label_short, "2 boxes .* 1", id="labels"),
    ],
)
def test_invalid_scene_is_rejected(source: SceneSource, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        train(SMALL, source, silent)


@given(seed=st.integers(0, 2**32 - 1))
def test_augmented_boxes_still_contain_their_objects(seed: int) -> None:
    limits = Augmentation(mirror=0.5, zoom_probability=1.0, hue=0, saturation=0, brightness=0)
    image = np.full((96, 128, 3), 114, np.uint8)
    image[30:60, 40:90] = (0, 0, 255)
    boxes, ids = np.array([[40, 30, 90, 60]], np.float32), np.zeros(1, np.int64)
    changed, moved, kept = augment(np.random.default_rng(seed), (image, boxes, ids), limits)
    assert changed.shape == image.shape
    rows, columns = np.nonzero(changed[:, :, 2].astype(int) - changed[:, :, 0] > 120)
    if len(kept):
        assert moved[0] == pytest.approx(
            [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1], abs=1.6
        )


@given(seed=st.integers(0, 2**32 - 1))
def test_smaller_image_shows_the_scene_or_a_part(seed: int) -> None:
    image = np.full((96, 128, 3), 114, np.uint8)
    image[30:60, 40:90] = (0, 0, 255)
    scene = image, np.array([[40, 30, 90, 60]], np.float32), np.zeros(1, np.int64)
    limits = Augmentation(mirror=0, zoom_probability=0.5, hue=0, saturation=0, brightness=0)
    changed, boxes, ids = augment(np.random.default_rng(seed), scene, limits, (64, 64))
    assert changed.shape == (64, 64, 3)
    assert (boxes >= 0).all()
    assert (boxes <= 64).all()
    rows, columns = np.nonzero(changed[:, :, 2].astype(int) - changed[:, :, 0] > 120)
    if len(ids):
        assert boxes[0] == pytest.approx(
            [columns.min(), rows.min(), columns.max() + 1, rows.max() + 1], abs=1.6
        )


def test_an_object_that_became_too_small_is_ignored() -> None:
    scene = (
        np.zeros((96, 128, 3), np.uint8),
        np.array([[40, 30, 48, 60], [60, 30, 100, 60]], np.float32),
        np.array([1, 0]),
    )
    limits = replace(NO_AUGMENTATION, min_side_px=5.0)
    _, boxes, ids = augment(np.random.default_rng(0), scene, limits, (64, 48))
    assert ids.tolist() == [~1, 0]
    _, truth = collate([(np.zeros((48, 64, 3), np.uint8), boxes, ids)])
    assert truth.present.tolist() == [[False, True]]
    assert truth.ignored is not None
    assert truth.ignored.tolist() == [[True, False]]
    assert truth.classes.tolist() == [[1, 0]]


def test_training_can_start_from_another_model(trained: TrainedModel) -> None:
    gentle = replace(SMALL, learning_rate=1e-9, average_decay=0.0)
    again = train(gentle, rectangles, silent, start=trained.model)
    assert torch.allclose(weights(again)[:100], weights(trained)[:100], atol=1e-5)
    with pytest.raises(ValueError, match="another scale"):
        train(replace(SMALL, width_multiple=0.125), rectangles, silent, start=trained.model)


def test_same_key_draws_the_same_image() -> None:
    key = SceneKey(3, 4, 96, 64)
    first, second = (draw_scene(rectangles, key, 2) for _ in range(2))
    both: Iterable[tuple[NDArray[Any], NDArray[Any]]] = zip(first, second, strict=True)
    assert all(np.array_equal(a, b) for a, b in both)
    assert not np.array_equal(first[0], draw_scene(rectangles, replace(key, scene=5), 2)[0])


def test_repeated_scenes_are_drawn_once_and_augmented_again(tmp_path: Path) -> None:
    plan = [[SceneKey(0, scene, 64, 64, view) for scene in range(2)] for view in range(3)]
    calls = []

    def counted(rng: np.random.Generator, width: int, height: int) -> LabelledImage:
        calls.append(1)
        return rectangles(rng, width, height)

    batches = list(scene_batches(counted, plan, class_count=2, augmentation=Augmentation(), workers=0))
    assert len(calls) == 2
    assert not torch.equal(batches[0][0], batches[1][0])
    alone = list(scene_batches(counted, plan[2:], class_count=2, augmentation=Augmentation(), workers=0))
    assert torch.equal(batches[2][0], alone[0][0])


def test_a_longer_stage_begins_like_a_shorter_one() -> None:
    settings = replace(SMALL, stages=(Stage(64, 64, 2, 3, scenes=4),))
    seen: list[float] = []
    train(settings, rectangles, lambda progress: seen.append(progress.box_loss))
    longer: list[float] = []
    train(
        replace(settings, stages=(Stage(64, 64, 2, 5, scenes=4, decay_steps=1),)),
        rectangles,
        lambda progress: longer.append(progress.box_loss),
    )
    assert longer[:2] == seen[:2]


def test_batch_pads_labels_and_converts_to_rgb() -> None:
    full = draw_scene(rectangles, SceneKey(0, 0, 64, 64), 2)
    empty = nothing(None, 64, 64)
    images, truth = collate([full, empty])
    assert images.shape == (2, 64, 64, 3)
    assert np.array_equal(images[0].numpy(), full[0][:, :, ::-1])
    assert truth.present.tolist() == [[True, True], [False, False]]
