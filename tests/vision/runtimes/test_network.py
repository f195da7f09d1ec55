"""The inference network gives the results of the model it is converted from."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.vision.runtimes.conftest import NAMES, lively_model, make_image
from vision.runtimes.base import RuntimeUnusableError
from vision.runtimes.network import Network
from vision.training.published import yolov8_description
from vision.yolo.architecture import build
from vision.yolo.level_outputs import LevelOutput


def whole_maps(image: np.ndarray) -> list[Tensor]:
    """Outputs of the unmodified model for a BGR image."""
    rgb = torch.from_numpy(image[..., ::-1].copy()).permute(2, 0, 1)[None].float() / 255
    with torch.inference_mode():
        maps: list[Tensor] = lively_model()(rgb)
    return maps


def run(network: Network, image: np.ndarray) -> list[LevelOutput]:
    with torch.inference_mode():
        maps = network(torch.from_numpy(image)[None])
    return network.head.levels([level[0].numpy() for level in maps])


def test_bgr_bytes_equal_scaled_rgb() -> None:
    image = make_image(64, 96)
    levels = run(Network(lively_model()), image)
    for expected, level in zip(whole_maps(image), levels, strict=True):
        assert level.sides is not None
        np.testing.assert_allclose(level.sides, expected[0, :64], atol=1e-3)
        np.testing.assert_allclose(level.classes, expected[0, 64:], atol=1e-3)


def test_image_read_twice_is_not_folded_and_correct() -> None:
    image = make_image(64, 64)
    network = Network(lively_model())
    unfolded = Network(lively_model())
    first = unfolded.body.model[0].get_parameter("conv.weight")
    first.data = first.data.flip(1) * 255
    unfolded._folded = False
    for a, b in zip(run(network, image), run(unfolded, image), strict=True):
        np.testing.assert_allclose(a.classes, b.classes, atol=1e-3)


def test_only_the_rows_of_the_wanted_classes_are_computed() -> None:
    image = make_image(64, 96)
    network = Network(lively_model(), [1, 4])
    assert network.head.class_ids == (1, 4)
    assert not network.head.complete
    for whole, level in zip(run(Network(lively_model()), image), run(network, image), strict=True):
        np.testing.assert_allclose(level.classes, whole.classes[[1, 4]], atol=1e-4)
        assert level.features is not None


def test_unselected_classes_still_decide_the_winner() -> None:
    image = make_image(64, 96)
    network = Network(lively_model(), [1, 4])
    assert network.head.rows is not None
    whole = run(Network(lively_model()), image)
    for rows, level, expected in zip(network.head.rows, run(network, image), whole, strict=True):
        assert level.features is not None
        found = rows.best_class(level.features.reshape(len(level.features), -1))
        np.testing.assert_array_equal(found, expected.classes.reshape(len(NAMES), -1).argmax(axis=0))


def test_selecting_all_classes_changes_nothing() -> None:
    network = Network(lively_model(), range(len(NAMES)))
    assert network.head.complete
    assert network.head.kinds == ("sides", "classes")


@pytest.mark.parametrize("size", [(64, 96), (32, 32), (160, 32)])
def test_sparse_boxes_equal_dense_ones_up_to_the_edges(size: tuple[int, int]) -> None:
    image = make_image(*size)
    whole = run(Network(lively_model()), image)
    network = Network(lively_model(), sparse_boxes=True)
    assert network.head.boxes is not None
    for branch, level, expected in zip(network.head.boxes, run(network, image), whole, strict=True):
        assert level.sides is None
        assert level.neck is not None
        assert expected.sides is not None
        every = np.arange(level.classes[0].size)
        found = branch.sides(level.neck, every)
        np.testing.assert_allclose(found, expected.sides.reshape(64, -1), atol=1e-3)
        some = every[::3][::-1]
        np.testing.assert_allclose(branch.sides(level.neck, some), found[:, some], atol=1e-4)
        assert branch.sides(level.neck, every[:0]).shape == (64, 0)


def test_thousands_of_cells_are_processed_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    network = Network(lively_model(), sparse_boxes=True)
    level = run(network, make_image(64, 96))[0]
    assert network.head.boxes is not None
    assert level.neck is not None
    every = np.arange(level.classes[0].size)
    at_once = network.head.boxes[0].sides(level.neck, every)
    monkeypatch.setattr("vision.yolo.level_outputs._MOST_CELLS", 7)
    np.testing.assert_allclose(network.head.boxes[0].sides(level.neck, every), at_once, atol=1e-5)


def test_outputs_have_names() -> None:
    network = Network(lively_model(), [0], sparse_boxes=True)
    assert network.names[:4] == ["neck_8", "classes_8", "features_8", "neck_16"]


def test_model_of_grey_images_is_rejected() -> None:
    description = yolov8_description((0.1, 0.01, 64), NAMES)
    grey = type(description)(
        **{name: getattr(description, name) for name in description.__slots__} | {"channels": 1}
    )
    with pytest.raises(RuntimeUnusableError, match="1 channels"):
        Network(build(grey))
