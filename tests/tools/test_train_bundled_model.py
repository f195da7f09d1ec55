"""The training of the bundled model from a pool of scenes, on the processor."""

from __future__ import annotations

import argparse
import itertools
import logging
import multiprocessing
import sys
import threading
import time
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
import torch

from benchmarks.bundled_model import CONFIRMED, Found
from mavlink_sim.world.shapes import CLASS_NAMES
from tools import train_bundled_model
from tools.train_bundled_model import LACKING, SIZES, Pool, PoolCopy, batch, join, lower_confidence, train
from vision.evaluation.metrics import ImageResult
from vision.training.published import yolov8_description
from vision.weights import DEFAULT_WEIGHTS
from vision.yolo.architecture import YoloModel, build
from vision.yolo.checkpoint import load_checkpoint, save_checkpoint

RENDERERS = 2
TRUCK, IGNORED_BOAT = 3, ~4


def fill(pool: Pool, renderer: int, count: int) -> None:
    """Grey scenes with a red truck and a blue boat that is not to be learned; the numbers place them."""
    rng = np.random.default_rng([renderer, int(pool.drawn[renderer])])
    for number in range(int(pool.drawn[renderer]), int(pool.drawn[renderer]) + count):
        place = (renderer + RENDERERS * number) % len(pool.images)
        pool.images[place], pool.ids[place] = 128, LACKING
        for item, (class_id, colour) in enumerate(((TRUCK, (255, 0, 0)), (IGNORED_BOAT, (0, 0, 255)))):
            left, top = int(rng.integers(0, 200)) + 320 * item, int(rng.integers(0, 300))
            right, bottom = left + int(rng.integers(60, 120)), top + int(rng.integers(60, 120))
            pool.images[place, top:bottom, left:right] = colour
            pool.boxes[place, item], pool.ids[place, item] = (left, top, right, bottom), class_id
        pool.drawn[renderer] += 1


@pytest.fixture
def pool() -> Pool:
    pool = Pool.of_size(9, RENDERERS)
    for renderer in range(RENDERERS):
        fill(pool, renderer, 4)
    return pool


@pytest.mark.parametrize(("width", "height"), [size[:2] for size in SIZES[1:]])
def test_boxes_are_where_the_objects_are_shown(pool: Pool, width: int, height: int) -> None:
    copied = PoolCopy(pool, torch.device("cpu"))
    copied.update()
    images, truth = batch(copied, width, height, 24, torch.Generator().manual_seed(3))
    assert images.shape == (24, 3, height, width)
    assert 0 <= images.min()
    assert images.max() <= 1
    assert truth.ignored is not None
    assert truth.present.sum() >= 12
    trucks, boats = truth.classes == TRUCK, truth.classes == ~IGNORED_BOAT
    assert not (truth.present & boats).any()
    assert (truth.present & trucks).sum() >= 12
    exists = truth.present | truth.ignored
    for colour, other, of_class in ((0, 2, trucks), (2, 0, boats)):
        shown = images[:, colour] > images[:, other] + 0.3
        assert torch.equal(shown.any(2).any(1), (exists & of_class).any(1))
        for row, item in (exists & of_class).nonzero().tolist():
            down, across = shown[row].nonzero(as_tuple=True)
            found = [int(across.min()), int(down.min()), int(across.max()) + 1, int(down.max()) + 1]
            assert found == pytest.approx(truth.boxes[row, item].tolist(), abs=1.5)


def test_pool_copy_has_the_newest_scenes(pool: Pool) -> None:
    copied = PoolCopy(pool, torch.device("cpu"))
    assert copied.available == 0
    copied.update()
    assert (copied.available, copied.scenes) == (8, 8)
    fill(pool, 0, 3)  # three more: over the oldest of its places
    fill(pool, 1, 6)  # more than it has places
    copied.update()
    assert (copied.available, copied.scenes) == (8, 17)
    assert np.array_equal(copied.images.numpy(), pool.images)
    assert np.array_equal(copied.boxes.numpy(), pool.boxes)
    assert np.array_equal(copied.ids.numpy(), pool.ids)


def test_scene_that_is_drawn_over_is_not_copied(pool: Pool) -> None:
    copied = PoolCopy(pool, torch.device("cpu"))
    pool.begun[:] = pool.drawn
    pool.begun[1] += 1  # into its oldest place, 1
    copied.update()
    assert copied.available == 1
    assert (copied.ids[1] == LACKING).all()
    assert np.array_equal(copied.ids[2:].numpy(), pool.ids[2:])
    fill(pool, 1, 1)
    copied.update()
    assert copied.available == 8
    assert np.array_equal(copied.images.numpy(), pool.images)


def test_batch_waits_for_a_running_copy(pool: Pool, monkeypatch: pytest.MonkeyPatch) -> None:
    copied, asked = PoolCopy(pool, torch.device("cpu")), threading.Event()
    copied.update()
    taken: list[tuple[torch.Tensor, ...]] = []
    take = copied.take

    def notes(places: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        asked.set()
        taken.append(take(places))
        return taken[-1][0], taken[-1][1], taken[-1][2]

    monkeypatch.setattr(copied, "take", notes)
    reader = threading.Thread(target=batch, args=(copied, 64, 64, 4, torch.Generator().manual_seed(0)))
    with copied._lock:
        reader.start()
        assert asked.wait(5)
        reader.join(0.1)
        assert not taken
        copied.images.fill_(7)
        copied.ids.fill_(2)
    reader.join(5)
    ((images, _, ids),) = taken
    assert (images == 7).all()
    assert (ids == 2).all()


def test_renderer_fills_its_places_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    pool, draws = Pool.of_size(6, RENDERERS), 5
    firsts: list[float] = []

    def scene(rng: np.random.Generator, width: int, height: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        number = len(firsts)
        assert (pool.drawn[1], pool.begun[1]) == (number, number)
        if number == draws:
            raise KeyboardInterrupt
        firsts.append(rng.random())
        image = np.full((height, width, 3), (1, 2, 3 + number), np.uint8)
        return image, np.full((number % 3, 4), number, np.float32), np.full(number % 3, number)

    monkeypatch.setattr(train_bundled_model, "training_scene", scene)
    monkeypatch.setattr("os.nice", lambda _: 0)
    monkeypatch.setattr("cv2.setNumThreads", lambda _: None)
    with pytest.raises(KeyboardInterrupt):
        train_bundled_model.render(pool, 1, 9)
    assert pool.drawn.tolist() == [0, draws]
    # The places 1, 3 and 5: the scenes 3 and 4 came last into 1 and 3. Red is BGR's third channel.
    assert pool.images[:, 0, 0].tolist() == [[0] * 3, [6, 2, 1], [0] * 3, [7, 2, 1], [0] * 3, [5, 2, 1]]
    assert (pool.ids != LACKING)[1::2].sum(1).tolist() == [0, 1, 2]
    assert pool.ids[3, 0] == 4
    assert pool.boxes[3, 0].tolist() == [4, 4, 4, 4]
    assert firsts == [np.random.default_rng([9, 1, number]).random() for number in range(draws)]


def arguments(end: float) -> argparse.Namespace:
    return argparse.Namespace(
        device="cpu",
        seed=1,
        width=0.0625,
        start=None,
        batch_share=0.02,
        end=end,
        minutes=0.0,
        renderers=RENDERERS,
        scenes=9,
    )


def test_time_that_ends_before_the_first_scenes_is_an_error(tmp_path: Path) -> None:
    pool = Pool.of_size(9, RENDERERS)
    fill(pool, 0, 4)
    with pytest.raises(TimeoutError, match=r" 1 of .* 8 places"):
        train(pool, 1e-3, tmp_path / "new.safetensors", arguments(time.monotonic()))


def test_failed_copy_ends_the_training(pool: Pool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    update, full = PoolCopy.update, "no memory left"

    def fails_later(copied: PoolCopy) -> None:
        if copied.available:
            raise MemoryError(full)
        update(copied)

    monkeypatch.setattr(PoolCopy, "update", fails_later)
    monkeypatch.setattr(train_bundled_model, "SIZES", ((64, 64, 50),))
    with pytest.raises(RuntimeError, match=full):
        train(pool, 1e-3, tmp_path / "new.safetensors", arguments(time.monotonic() + 600))
    assert not list(tmp_path.iterdir())


def test_ended_renderer_ends_the_trainers() -> None:
    processes = multiprocessing.get_context("spawn")
    trainer = processes.Process(target=time.sleep, args=(60,))
    renderers = [
        processes.Process(target=time.sleep, args=(60,)),
        processes.Process(target=sys.exit, args=(3,)),
    ]
    for process in (trainer, *renderers):
        process.start()
    with pytest.raises(SystemExit, match=r"renderer 1 .*code 3;"):
        join([trainer], renderers)
    assert [process.is_alive() for process in (trainer, *renderers)] == [False] * 3


@pytest.mark.parametrize("status", [0, 1])
def test_renderers_end_after_the_trainers(status: int) -> None:
    processes = multiprocessing.get_context("spawn")
    trainer = processes.Process(target=sys.exit, args=(status,))
    renderer = processes.Process(target=time.sleep, args=(60,))
    trainer.start()
    renderer.start()
    if status:
        with pytest.raises(SystemExit, match="1"):
            join([trainer], [renderer])
    else:
        join([trainer], [renderer])
    assert (trainer.exitcode, renderer.is_alive()) == (status, False)


def test_trainer_that_ends_before_the_wait_is_still_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    trainer, renderer = Mock(sentinel=5, exitcode=0), Mock(sentinel=6)
    trainer.is_alive.side_effect = itertools.chain([True], itertools.repeat(False))
    waits: list[list[int]] = []
    monkeypatch.setattr("multiprocessing.connection.wait", waits.append)
    join([trainer], [renderer])
    assert waits == [[5, 6]]
    renderer.terminate.assert_called_once_with()


def test_network_is_trained_and_written(pool: Pool, tmp_path: Path) -> None:
    output, given = tmp_path / "new.safetensors", arguments(time.monotonic())
    train(pool, 1e-3, output, given)
    written = load_checkpoint(output)
    assert written.model.description.width_multiple == 0.0625
    assert (written.metadata["steps_done"], written.metadata["scenes"]) == (1, 8)
    assert written.metadata["learning_rate"] == 1e-3
    assert written.metadata["steps_of_width_height_batch"] == [[320, 256, 5], [320, 256, 5], [640, 480, 1]]
    # What `companion models show` shows of the bundled weights is what this tool writes.
    bundled = load_checkpoint(DEFAULT_WEIGHTS).metadata
    assert written.metadata.keys() <= bundled.keys()
    same = (
        "warmup_steps",
        "average_decay",
        "optimiser",
        "betas",
        "weight_decay",
        "gradient_limit",
        "augmentation",
    )
    assert {key: written.metadata[key] for key in same} == {key: bundled[key] for key in same}


def class_biases(model: YoloModel) -> torch.Tensor:
    """(3, classes), of each level."""
    return torch.stack([branch[-1].bias.detach() for branch in model.detect.cv3])  # type: ignore[index]


def judged(class_id: int, confidences: list[float], right: list[bool]) -> ImageResult:
    """One image with an object for each right detection; a wrong one is elsewhere."""
    corners = np.arange(len(right), dtype=np.float32)[:, None] * 20 + np.array([0, 0, 10, 10], np.float32)
    true = corners[np.array(right)]
    return ImageResult(
        corners,
        np.array(confidences, np.float32),
        np.full(len(right), class_id),
        true,
        np.full(len(true), class_id),
    )


def test_biases_of_imprecise_classes_are_lowered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    output = tmp_path / "new.safetensors"
    scale = (1 / 3, 0.0625, 1024)
    save_checkpoint(output, build(yolov8_description(scale, CLASS_NAMES)), metadata={})
    # In another order than the network's, as of a data set.
    names = ("truck", "person", "boat")
    results = [
        judged(0, [0.45] * 20, [True] * 20),
        # Of 0.4 two of three are right; above 0.57 all.
        judged(1, [0.45, 0.57, 0.7], [True, False, True]),
        judged(2, [0.5, 0.995], [True, False]),
    ]
    monkeypatch.setattr(train_bundled_model, "draw", lambda folder, frames, seed, world: {})
    monkeypatch.setattr(
        train_bundled_model, "detect", lambda drawn, model, size: Found({"a": results}, {}, names)
    )
    before = class_biases(load_checkpoint(output).model)
    with caplog.at_level(logging.WARNING):
        model, lowered = lower_confidence(output)
    assert CONFIRMED == 0.4
    person, boat = (
        round(float(np.log(0.58 / 0.42 / (0.4 / 0.6))), 3),
        round(float(np.log(99 / (0.4 / 0.6))), 3),
    )
    assert lowered == {"truck": 0.0, "person": person, "boat": boat}
    moved = before - class_biases(model)
    assert moved.shape == (3, len(CLASS_NAMES))
    expected = [lowered.get(name, 0.0) for name in CLASS_NAMES]
    for level in moved.tolist():
        assert level == pytest.approx(expected, abs=1e-5)
    (record,) = caplog.records
    assert "boat" in record.getMessage()
