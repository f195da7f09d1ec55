"""The default runtime: precision, sizes, memory."""

from __future__ import annotations

import itertools
import re
import warnings
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.vision.runtimes.conftest import lively_model, make_image
from vision.detector import Detector
from vision.runtimes import base, selection
from vision.runtimes import torch_runtime as torch_runtime_module
from vision.runtimes.base import RuntimeUnusableError
from vision.runtimes.network import Network
from vision.runtimes.source import read_source
from vision.runtimes.stored_choice import forget_choices
from vision.runtimes.torch_runtime import TorchRuntime, gpu_errors, torch_product
from vision.yolo.architecture import YoloModel


@pytest.fixture
def no_bfloat16(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(base, "bfloat16_instructions", lambda: "")


@pytest.fixture
def with_bfloat16(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(base, "bfloat16_instructions", lambda: "amx_bf16")


@pytest.fixture
def untraced(monkeypatch: pytest.MonkeyPatch) -> None:
    """No graph when it starts."""
    monkeypatch.setattr(TorchRuntime, "_any_size", lambda self: None)


@cache
def network() -> Network:
    return Network(lively_model())


def expected(image: np.ndarray) -> list[np.ndarray]:
    with torch.inference_mode():
        return [level[0].numpy() for level in network()(torch.from_numpy(image)[None])]


@pytest.mark.usefixtures("no_bfloat16")
def test_one_graph_runs_every_size() -> None:
    runtime = TorchRuntime(lively_model())
    for size in ((64, 96), (96, 64), (32, 32), (64, 96), (256, 320)):
        image = make_image(*size)
        found = [maps for level in runtime.infer(image) for maps in (level.sides, level.classes)]
        for a, b in zip(found, expected(image), strict=True):
            assert a is not None
            np.testing.assert_allclose(a, b, atol=1e-3)
    assert not runtime._graphs


@pytest.mark.usefixtures("no_bfloat16", "untraced")
def test_static_network_keeps_a_few_graphs_by_size(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch_runtime_module, "_MOST_GRAPHS", 2)
    runtime = TorchRuntime(lively_model())
    for size in ((64, 96), (96, 64), (64, 96), (32, 32)):
        image = make_image(*size)
        classes = runtime.infer(image)[0].classes
        np.testing.assert_allclose(classes, expected(image)[1], atol=1e-3)
    assert set(runtime._graphs) == {(64, 96), (32, 32)}


def test_bfloat16_is_close_and_returns_float32() -> None:
    image = make_image(64, 96)
    full = TorchRuntime(lively_model(), precision="float32")
    half = TorchRuntime(lively_model(), precision="bfloat16", sparse_boxes=True)
    assert (full.precision, half.precision) == ("float32", "bfloat16")
    for a, b in zip(full.infer(image), half.infer(image), strict=True):
        assert b.classes.dtype == np.float32
        assert b.neck is not None
        assert b.neck.dtype == np.float32
        assert np.corrcoef(a.classes.ravel(), b.classes.ravel())[0, 1] > 0.99


@pytest.mark.usefixtures("no_bfloat16", "untraced")
def test_without_native_bfloat16_auto_is_float32() -> None:
    runtime = TorchRuntime(lively_model())
    assert runtime.precision == "float32"
    assert "not support" in runtime.precision_reason


@pytest.mark.usefixtures("with_bfloat16", "untraced")
@pytest.mark.parametrize(("half_ms", "chosen"), [(3.9, "bfloat16"), (4.1, "float32")])
def test_auto_uses_native_bfloat16_if_much_faster(
    monkeypatch: pytest.MonkeyPatch, half_ms: float, chosen: str
) -> None:
    times = {torch.float32: 5.0, torch.bfloat16: half_ms}
    monkeypatch.setattr(TorchRuntime, "_measured_ms", lambda self, *dtypes: [tuple(times[d] for d in dtypes)])
    runtime = TorchRuntime(lively_model())
    assert runtime.precision == chosen
    assert re.search(rf"5\.0 ms .*float32, {half_ms} ms", runtime.precision_reason)


@pytest.mark.usefixtures("with_bfloat16", "untraced")
def test_measured_precision_is_stored_for_later_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    measured = iter([[(5.0, 2.0)], [(5.0, 9.0)], [(5.0, 9.0)]])
    monkeypatch.setattr(TorchRuntime, "_measured_ms", lambda self, *dtypes: next(measured))

    def chosen(model_sha256: str) -> tuple[str, str]:
        runtime = TorchRuntime(lively_model(), model_sha256=model_sha256)
        return runtime.precision, runtime.precision_reason.partition(":")[0]

    assert chosen("a") == ("bfloat16", "measured now")
    assert chosen("a") == ("bfloat16", "measured before")
    assert chosen("b") == ("float32", "measured now")
    forget_choices("a")
    assert chosen("a") == ("float32", "measured now")


@pytest.mark.usefixtures("with_bfloat16", "untraced")
@pytest.mark.parametrize("slow_pairs", [1, 2, 3])
def test_measurement_whose_pairs_disagree_is_not_stored(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, slow_pairs: int
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    pairs = [(5.0, 9.0)] * slow_pairs + [(8.0, 4.5)] * (4 - slow_pairs)
    monkeypatch.setattr(TorchRuntime, "_measured_ms", lambda self, *dtypes: pairs)
    runtime = TorchRuntime(lively_model(), model_sha256="a")
    # By the minima float32 is as good; 3 of 4 pairs must agree with that.
    assert runtime.precision == ("float32" if slow_pairs == 3 else "bfloat16")
    assert (f"{slow_pairs} of 4 pairs" in runtime.precision_reason) == (slow_pairs < 3)
    assert bool(list(tmp_path.rglob("*.json"))) == (slow_pairs == 3)


@pytest.mark.usefixtures("with_bfloat16", "untraced")
def test_precision_is_measured_on_one_thread_for_a_limited_time(monkeypatch: pytest.MonkeyPatch) -> None:
    before = torch.get_num_threads()
    runtime = TorchRuntime(lively_model(), precision="float32", threads=2)
    used: list[int] = []

    def spent_ms(graph: object, pixels: object) -> float:
        used.append(torch.get_num_threads())
        return 1.0

    monkeypatch.setattr(torch_runtime_module, "traced", lambda network, pixels: lambda pixels: ())
    monkeypatch.setattr(torch_runtime_module, "_spent_ms", spent_ms)
    try:
        for name, pairs in (("thread_time", 5), ("perf_counter", 5), (None, 40)):
            used.clear()
            with monkeypatch.context() as patch:
                clock = itertools.count(0.0, 10.0)
                patch.setattr(torch_runtime_module, "_TRIAL_S", 1.0 if name == "thread_time" else 1e6)
                patch.setattr(torch_runtime_module, "_TRIAL_WALL_S", 1.0 if name == "perf_counter" else 1e6)
                if name is not None:
                    patch.setattr(f"vision.runtimes.torch_runtime.time.{name}", clock.__next__)
                found = runtime._measured_ms(torch.float32, torch.bfloat16)
            assert found == [(1.0, 1.0)] * pairs
            assert used == [1] * 2 * pairs
            assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)


@pytest.mark.usefixtures("with_bfloat16")
def test_auto_measures_both_where_it_must(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch_runtime_module, "_TRIAL_S", 0.05)
    runtime = TorchRuntime(lively_model())
    assert runtime.precision in ("float32", "bfloat16")
    assert runtime.precision_reason.startswith("measured")


def test_a_precision_it_does_not_have_is_rejected() -> None:
    with pytest.raises(RuntimeUnusableError, match="float32 or bfloat16"):
        TorchRuntime(lively_model(), precision="float16")


@pytest.mark.usefixtures("untraced")
def test_threads_are_set_and_reported() -> None:
    before = torch.get_num_threads()
    try:
        assert TorchRuntime(lively_model(), precision="float32", threads=1).threads == 1
    finally:
        torch.set_num_threads(before)


def test_torch_product_matches_numpy() -> None:
    a, b = np.random.default_rng(0).random((2, 5, 5), np.float32)
    np.testing.assert_allclose(torch_product(a, b), a @ b, rtol=1e-5)


@pytest.mark.skipif(torch.cuda.is_available(), reason="a CUDA device is here")
def test_cuda_without_a_device_is_refused(checkpoint: Path) -> None:
    with pytest.raises(RuntimeUnusableError, match=rf"torch {re.escape(torch.__version__)} .*finds no "):
        Detector(checkpoint, device="cuda")


def test_cuda_names_the_driver_problem_that_torch_warns_of(
    checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def no_driver() -> bool:
        warnings.warn("the driver is too old\n(found version 1)", stacklevel=1)
        return False

    monkeypatch.setattr(torch.version, "cuda", "13.0")
    monkeypatch.setattr(torch.cuda, "is_available", no_driver)
    with pytest.raises(RuntimeUnusableError, match=r"\(.*\(found version 1\)\); [^\n]*$"):
        Detector(checkpoint, device="cuda")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("The following failed:\nRuntimeError: CUDA out of memory. Tried 2 GiB", "out of memory; [^\n]*$"),
        ("CUDA error: no kernel image\nFor debugging pass …", "CUDA error: no kernel image$"),
    ],
)
def test_errors_of_the_gpu_are_one_line(text: str, expected: str) -> None:
    with pytest.raises(RuntimeUnusableError, match=f"^device cuda: {expected}"), gpu_errors():
        raise RuntimeError(text)


def test_other_errors_keep_their_type() -> None:
    with pytest.raises(RuntimeError, match="shapes") as caught, gpu_errors():
        raise RuntimeError("shapes differ")
    assert not isinstance(caught.value, ValueError)


def test_cuda_is_refused_for_other_runtimes_and_unknown_devices(checkpoint: Path) -> None:
    source = read_source(checkpoint)
    for runtime in ("openvino", "auto"):
        with pytest.raises(RuntimeUnusableError, match=rf"device cuda .*torch, .*{runtime};"):
            selection.start_runtime(source, runtime, device="cuda")
    for device in ("tpu", "cuda:7"):
        with pytest.raises(ValueError, match=rf"^device .*cpu .*cuda, .*'{device}'[^\n]*$"):
            Detector(checkpoint, device=device)  # type: ignore[arg-type]


def test_network_and_pixels_are_moved_to_the_device(
    model: YoloModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch_runtime_module, "check_device", lambda device: None)
    # The meta device computes shapes only: whatever stays on the processor fails there.
    monkeypatch.setattr(torch.Tensor, "cpu", lambda tensor: torch.zeros(tensor.shape, dtype=tensor.dtype))
    monkeypatch.setattr(TorchRuntime, "_any_size", lambda runtime: runtime._network)
    runtime = TorchRuntime(model, device="meta", sparse_boxes=True)  # type: ignore[arg-type]
    assert (runtime.precision, runtime.head.boxes) == ("float32", None)
    levels = runtime.infer(make_image(64, 96))
    assert [level.classes.shape[1:] for level in levels] == [(8, 12), (4, 6), (2, 3)]
