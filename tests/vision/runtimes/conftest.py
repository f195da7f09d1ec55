"""A small network with random weights, as a checkpoint, and images for it."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from tests.vision.small_network import small_description
from vision.yolo.architecture import YoloModel, build
from vision.yolo.checkpoint import save_checkpoint

NAMES = ("person", "bicycle", "car", "dog", "boat", "chair")


def lively_model(seed: int = 0) -> YoloModel:
    """Random weights that keep the signal's size through all layers, and class logits around zero."""
    torch.manual_seed(seed)
    model = build(small_description(NAMES)).eval()
    for module in model.modules():
        if isinstance(module, nn.Conv2d):
            # The gain of SiLU is about 1.7 for signals of this size; a little less keeps rounding small.
            nn.init.normal_(module.weight, 0, 1.5 / (module.weight[0].numel() ** 0.5))
        elif isinstance(module, nn.BatchNorm2d):
            assert module.running_mean is not None
            assert module.running_var is not None
            module.running_mean.normal_(0, 0.1)
            module.running_var.uniform_(0.8, 1.2)
    for branch in model.detect.class_branches:
        *_, last = branch.children()
        last.get_parameter("weight").data.mul_(4)
        last.get_parameter("bias").data.fill_(-1.0)
    return model


@pytest.fixture
def model() -> YoloModel:
    return lively_model()


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("model") / "lively.pt"
    save_checkpoint(path, lively_model(), metadata={"licence": "Apache-2.0"})
    return path


@pytest.fixture(autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> None:
    """Isolates the tests from the user's cache; the tests share one."""
    base = tmp_path_factory.getbasetemp()
    monkeypatch.setenv("XDG_CACHE_HOME", str(base / "cache"))


def needs(*packages: str) -> None:
    """Skip the test where one is not installed; none is imported: OpenVINO would report it to Intel."""
    for package in packages:
        if importlib.util.find_spec(package) is None:
            pytest.skip(f"{package} is an optional extra", allow_module_level=True)


def make_image(height: int, width: int, seed: int = 0) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Smooth blobs of colour, (height, width, 3) uint8."""
    generator = torch.Generator().manual_seed(seed)
    coarse = torch.rand((1, 3, 6, 8), generator=generator)
    fine = nn.functional.interpolate(coarse, (height, width), mode="bilinear")
    return np.ascontiguousarray((fine[0] * 255).to(torch.uint8).permute(1, 2, 0).numpy())
