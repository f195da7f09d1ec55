"""YOLOX checkpoints: read safely, built from their own shapes, equal to the authors' export."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from tests.vision.runtimes.conftest import make_image
from vision.detector import Detector
from vision.foreign.class_names import COCO_NAMES
from vision.foreign.yolox import Shape, Yolox, load_yolox
from vision.runtimes.base import RuntimeUnusableError
from vision.yolo.checkpoint import CheckpointError, UnsafeCheckpointError

ROOT = Path(__file__).parent.parent.parent
NANO = (
    Path(os.environ.get("COMPANION_TEST_DATA", ROOT.parent / "shared" / "data"))
    / "models"
    / "yolox_nano.onnx"
)


def save_yolox(
    path: Path, *, classes: int = 80, width: int = 8, depth: int = 1, depthwise: bool = True
) -> Yolox:
    """A checkpoint as the authors' trainer writes it, of random weights with statistics."""
    torch.manual_seed(0)
    model = Yolox(Shape(depth, width, classes, depthwise))
    for module in model.modules():
        if isinstance(module, nn.BatchNorm2d):
            assert module.running_mean is not None
            assert module.running_var is not None
            module.running_mean.normal_(0, 0.1)
            module.running_var.uniform_(0.5, 1.5)
    optimizer = {"state": {0: {"momentum_buffer": torch.zeros(3)}}, "param_groups": [{"lr": 0.01}]}
    torch.save({"start_epoch": 300, "model": model.state_dict(), "optimizer": optimizer}, path)
    return model.eval()


@pytest.mark.parametrize(("width", "depth", "depthwise"), [(8, 1, True), (8, 2, False)])
def test_checkpoint_gives_its_network(tmp_path: Path, width: int, depth: int, depthwise: bool) -> None:
    path = tmp_path / "x.pth"
    model = save_yolox(path, width=width, depth=depth, depthwise=depthwise)
    loaded = load_yolox(path)
    assert loaded is not None
    image = torch.rand(1, 3, 64, 96) * 255
    with torch.inference_mode():
        expected = model(image)
        torch.testing.assert_close(loaded[0](image), expected)
        torch.testing.assert_close(loaded[0].fuse()(image), expected, rtol=1e-3, atol=1e-3)
    assert expected.shape == (1, 96 + 24 + 6, 85)
    assert loaded[1].class_names == COCO_NAMES


def test_detector_runs_a_yolox_checkpoint(tmp_path: Path) -> None:
    save_yolox(tmp_path / "x.pth", classes=2)
    with pytest.raises(CheckpointError, match=r"x\.pth: .* 2 classes.*x\.txt"):
        Detector(tmp_path / "x.pth")
    (tmp_path / "x.txt").write_text("car\ndog\n")
    with pytest.raises(RuntimeUnusableError, match=r"onnxruntime .*\.pth .*torch"):
        Detector(tmp_path / "x.pth", runtime="onnxruntime")
    detector = Detector(tmp_path / "x.pth", confidence=0.01, image_size=96)
    found = detector.detect(make_image(60, 96))
    assert detector.class_names == ("car", "dog")
    assert (detector.runtime, detector.precision) == ("torch", "float32")
    assert len(found) > 0
    assert detector.foreign is not None
    assert detector.foreign.layout == "yolox"


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("yolox") / "x.pth"
    save_yolox(path)
    return path


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        ({"head.obj_preds.0.bias": None}, "1 weights missing"),
        ({"head.other": torch.zeros(1)}, "1 unknown"),
        ({"head.obj_preds.0.bias": torch.zeros(2)}, "should be"),
        ({"head.obj_preds.0.bias": torch.tensor([float("nan")])}, "not finite"),
        ({"head.obj_preds.0.bias": 5}, "not a tensor of numbers"),
        ({"backbone.backbone.stem.conv.conv.weight": torch.zeros(9999, 1, 1, 1)}, "its stem"),
    ],
)
def test_weights_that_do_not_fit_are_refused(
    saved: Path, tmp_path: Path, change: dict[str, Any], expected: str
) -> None:
    path = tmp_path / "x.pth"
    content = torch.load(saved, weights_only=True)
    for name, value in change.items():
        content["model"].pop(name, None)
        if value is not None:
            content["model"][name] = value
    torch.save(content, path)
    with pytest.raises(CheckpointError, match=expected) as caught:
        load_yolox(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert str(caught.value).isprintable()


def test_code_in_a_yolox_checkpoint_is_not_run(tmp_path: Path) -> None:
    class Evil:
        def __reduce__(self) -> Any:
            return os.system, (f"touch {tmp_path / 'it-ran'}",)

    torch.save({"model": {}, "callback": Evil()}, tmp_path / "x.pth")
    refused = rf"pickle .*'{os.system.__module__}\.system'.*nothing was run"
    with pytest.raises(UnsafeCheckpointError, match=refused):
        load_yolox(tmp_path / "x.pth")
    assert not (tmp_path / "it-ran").exists()


def test_another_checkpoint_named_pth_is_read_as_such(tmp_path: Path) -> None:
    torch.save({"model": {"a": torch.zeros(1)}}, tmp_path / "x.pth")
    assert load_yolox(tmp_path / "x.pth") is None
    with pytest.raises(CheckpointError, match=r"x\.pth: .*'ema'"):
        Detector(tmp_path / "x.pth")


@pytest.mark.skipif(not NANO.is_file(), reason=f"{NANO} is not here; set COMPANION_TEST_DATA")
def test_network_equals_the_authors_export() -> None:
    """Their file's weights, in the order of their convolutions, in our network: the same outputs."""
    onnx = pytest.importorskip("onnx", reason="onnx is an optional extra")
    onnxruntime = pytest.importorskip("onnxruntime", reason="onnxruntime is an optional extra")
    graph = onnx.load(str(NANO)).graph
    values = {
        value.name: torch.from_numpy(onnx.numpy_helper.to_array(value).copy()) for value in graph.initializer
    }
    nodes = [[values[name] for name in node.input[1:]] for node in graph.node if node.op_type == "Conv"]
    named = {name: value for name, value in values.items() if name.startswith("head.")}
    model = Yolox(Shape(1, 16, 80, depthwise=True)).fuse()
    order: list[nn.Conv2d] = []
    names = {module: name for name, module in model.named_modules()}
    for module in model.modules():
        if isinstance(module, nn.Conv2d):
            module.register_forward_pre_hook(lambda module, _: order.append(module))
    with torch.inference_mode():
        model(torch.zeros(1, 3, 64, 64))
        others = iter([pair for pair in nodes if not any(pair[0] is value for value in named.values())])
        for module in order:
            name = names[module]
            weight, bias = (
                (named[f"{name}.weight"], named[f"{name}.bias"]) if "_preds" in name else next(others)
            )
            assert module.bias is not None
            module.weight.copy_(weight)
            module.bias.copy_(bias)
        image = make_image(416, 416).astype(np.float32).transpose(2, 0, 1)[None]
        session = onnxruntime.InferenceSession(str(NANO), providers=["CPUExecutionProvider"])
        (expected,) = session.run(None, {"images": image})
        found = model(torch.from_numpy(image)).numpy()
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-3)
