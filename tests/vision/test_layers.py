"""The building blocks of the network."""

from __future__ import annotations

import math
from typing import TypeVar

import pytest
import torch
from torch import nn

from vision.yolo.heads import DFL, Detect
from vision.yolo.layers import (
    C2PSA,
    SPPF,
    AreaAttention,
    Bottleneck,
    C2f,
    Concat,
    Conv,
    LargeKernelDWConv,
    SCDown,
)

Layer = TypeVar("Layer", bound=nn.Module)


def with_lively_statistics(module: Layer, seed: int = 0) -> Layer:
    """Batch normalisations with statistics, so that folding them is not folding an identity."""
    generator = torch.Generator().manual_seed(seed)
    for norm in module.modules():
        if isinstance(norm, nn.BatchNorm2d):
            assert norm.running_mean is not None
            assert norm.running_var is not None
            for tensor, low, high in (
                (norm.weight.data, 0.5, 2.0),
                (norm.bias.data, -1.0, 1.0),
                (norm.running_mean, -1.0, 1.0),
                (norm.running_var, 0.2, 3.0),
            ):
                tensor.copy_(torch.rand(tensor.shape, generator=generator) * (high - low) + low)
    return module.eval()


@pytest.mark.parametrize(
    ("layer", "expected"),
    [
        pytest.param(Conv(8, 12, 3, 2), (2, 12, 8, 10), id="a strided convolution halves the map"),
        pytest.param(Conv(8, 12), (2, 12, 16, 20), id="a 1x1 convolution keeps the size"),
        pytest.param(C2f(8, 24, 2, True), (2, 24, 16, 20), id="C2f keeps the size"),
        pytest.param(SPPF(8, 12, 5), (2, 12, 16, 20), id="SPPF keeps the size"),
        pytest.param(SCDown(8, 12), (2, 12, 8, 10), id="SCDown halves the map"),
        pytest.param(C2PSA(8, 2), (2, 8, 16, 20), id="attention keeps size and channels"),
        pytest.param(Bottleneck(8, 8, True), (2, 8, 16, 20), id="a bottleneck keeps the size"),
    ],
)
def test_layer_output_shapes(layer: nn.Module, expected: tuple[int, ...]) -> None:
    assert layer(torch.rand(2, 8, 16, 20)).shape == expected


def test_bottleneck_shortcut_is_optional() -> None:
    x = torch.rand(1, 8, 4, 4)
    for wanted, outputs in ((True, 8), (False, 8), (True, 12)):
        bottleneck = Bottleneck(8, outputs, wanted).eval()
        plain = bottleneck.cv2(bottleneck.cv1(x))
        expected = x + plain if wanted and outputs == 8 else plain
        torch.testing.assert_close(bottleneck(x), expected)


def test_folding_the_normalisation_does_not_change_the_result() -> None:
    torch.manual_seed(1)
    layer = with_lively_statistics(Conv(8, 12, 3))
    x = torch.randn(1, 8, 9, 9)
    before = layer(x)
    layer.fuse()
    assert isinstance(layer.bn, nn.Identity)
    torch.testing.assert_close(layer(x), before, rtol=1e-4, atol=1e-5)
    layer.fuse()
    torch.testing.assert_close(layer(x), before, rtol=1e-4, atol=1e-5)


def test_a_distribution_at_one_bin_is_that_distance() -> None:
    logits = torch.full((3, 4 * 16), -40.0)
    for row, bins in enumerate(((0, 1, 2, 3), (15, 15, 0, 0), (7, 8, 9, 10))):
        for side, bin_number in enumerate(bins):
            logits[row, side * 16 + bin_number] = 40.0
    distances = DFL(16)(logits)
    expected = torch.tensor([[0.0, 1, 2, 3], [15, 15, 0, 0], [7, 8, 9, 10]])
    torch.testing.assert_close(distances, expected)


def test_a_distribution_over_two_neighbours_lies_between_them() -> None:
    logits = torch.full((1, 64), -40.0)
    logits[0, [3, 4]] = torch.log(torch.tensor([0.25, 0.75]))
    assert DFL(16)(logits)[0, 0].item() == pytest.approx(3.75, abs=1e-5)


def test_the_bins_of_the_distribution_are_not_trained() -> None:
    assert not any(parameter.requires_grad for parameter in DFL(16).parameters())


def test_concat_joins_channels() -> None:
    assert Concat()([torch.rand(1, 2, 3, 3), torch.rand(1, 5, 3, 3)]).shape == (1, 7, 3, 3)


def test_the_head_starts_with_rare_objects() -> None:
    head = Detect(7, (16, 32, 64))
    head.initialise_biases((8, 16, 32))
    for level, stride in zip(head.cv3, (8, 16, 32), strict=True):
        *_, last = level.children()
        probability = last.get_parameter("bias").sigmoid()
        # 5 objects distributed over the cells of a 640-pixel image and over the classes.
        assert torch.all((probability - 5 / 7 / (640 / stride) ** 2).abs() < 1e-4)
    *_, last = head.cv2[0].children()
    assert all(math.isclose(value, 1.0) for value in last.get_parameter("bias").tolist())


def test_two_depthwise_convolutions_fold_into_one() -> None:
    layer = with_lively_statistics(LargeKernelDWConv(6))
    x = torch.rand(2, 6, 9, 11)
    before = layer(x)
    layer.fuse()
    torch.testing.assert_close(layer(x), before, rtol=1e-4, atol=1e-5)
    assert set(layer.state_dict()) == {"conv.weight", "conv.bias"}
    layer.fuse()
    torch.testing.assert_close(layer(x), before, rtol=1e-4, atol=1e-5)


def test_area_attention_stays_within_its_area() -> None:
    layer = with_lively_statistics(AreaAttention(64, 2, areas=4))
    x = torch.rand(1, 64, 32, 4)
    changed = x.clone()
    changed[:, :, 20, 1] += 5.0  # In the third area, rows 16 to 23.
    difference = (layer(changed) - layer(x)).abs().amax(dim=(0, 1, 3))
    assert bool((difference[16:24] > 1e-6).all())
    # Outside it only the 7×7 convolution of the values reaches, by at most 3 cells.
    assert bool((difference[:16] < 1e-6).all())
    assert bool((difference[24:] < 1e-6).all())


def test_sppf_without_activation_keeps_negatives() -> None:
    x = torch.rand(1, 8, 6, 6) - 0.5
    for activated in (True, False):
        layer = with_lively_statistics(SPPF(8, 8, 5, 3, True, activated))
        assert bool((layer.cv1(x) < -0.3).any()) != activated
