"""The training of the bundled model from a pool of scenes, on the processor."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from tools.train_bundled_model import LACKING, SIZES, Pool, PoolCopy, batch, train
from vision.yolo.checkpoint import load_checkpoint

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


def test_network_is_trained_and_written(pool: Pool, tmp_path: Path) -> None:
    output = tmp_path / "new.safetensors"
    given = argparse.Namespace(
        device="cpu", seed=1, width=0.0625, start=None, batch_share=0.02, end=time.monotonic(), minutes=0.0
    )
    train(pool, 1e-3, output, given)
    written = load_checkpoint(output)
    assert written.model.description.width_multiple == 0.0625
    assert (written.metadata["steps_done"], written.metadata["scenes"]) == (1, 8)
    assert written.metadata["learning_rate"] == 1e-3
