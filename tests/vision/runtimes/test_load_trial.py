"""Model files that ask for too much: small, and valid by their form."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.vision.checkpoint_bombs import BOMBS
from vision.runtimes import load_trial
from vision.runtimes.base import RuntimeUnusableError
from vision.runtimes.onnx_runtime import onnx_facts, open_session
from vision.runtimes.openvino_runtime import OpenVinoNetwork, openvino_facts
from vision.runtimes.source import read_source
from vision.yolo.checkpoint import CheckpointError, load_checkpoint

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")


@pytest.fixture(autouse=True)
def _in_a_process_with_a_new_cache(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, trials_in_this_process: Callable[..., Any]
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(load_trial, "_run", trials_in_this_process)


def save(path: Path, nodes: list[object], functions: list[object], initializers: list[object]) -> Path:
    """Write a network from `x` to `o`, one float each."""
    helper = onnx.helper
    ports = [helper.make_tensor_value_info(name, onnx.TensorProto.FLOAT, [1]) for name in ("x", "o")]
    graph = helper.make_graph(nodes, "g", ports[:1], ports[1:], initializers)
    imports = [helper.make_opsetid("", 17), helper.make_opsetid("d", 1)]
    onnx.save(helper.make_model(graph, functions=functions, opset_imports=imports, ir_version=8), path)
    return path


def constants(path: Path, number: int) -> Path:
    """A file whose constants take 0.9 GB each when they are computed."""
    helper = onnx.helper
    size = helper.make_tensor("s", onnx.TensorProto.INT64, [1], [225_000_000])
    one = helper.make_tensor("v", onnx.TensorProto.FLOAT, [1], [1.0])
    nodes, last = [], "x"
    for index in range(number):
        nodes.append(helper.make_node("ConstantOfShape", ["s"], [f"y{index}"], value=one))
        nodes.append(helper.make_node("Gather", [f"y{index}", "i"], [f"z{index}"]))
        nodes.append(helper.make_node("Add", [last, f"z{index}"], [f"a{index}"]))
        last = f"a{index}"
    nodes.append(helper.make_node("Gather", [f"y{number - 1}", "k"], ["q"]))
    nodes.append(helper.make_node("Add", [last, "q"], ["o"]))
    index_of = helper.make_tensor("i", onnx.TensorProto.INT64, [1], [0])
    return save(path, nodes, [], [size, index_of, helper.make_tensor("k", onnx.TensorProto.INT64, [1], [1])])


def nested(path: Path, depth: int) -> Path:
    """Functions that each contain the one before twice."""
    helper = onnx.helper
    imports = [helper.make_opsetid("", 17), helper.make_opsetid("d", 1)]
    functions = []
    for level in range(depth):
        inner = f"f{level - 1}"
        nodes = [helper.make_node("Relu", ["x"], ["y"])]
        if level:
            pairs = (("x", "a"), ("a", "y"))
            nodes = [helper.make_node(inner, [one], [other], domain="d") for one, other in pairs]
        functions.append(helper.make_function("d", f"f{level}", ["x"], ["y"], nodes, imports))
    return save(path, [helper.make_node(f"f{depth - 1}", ["x"], ["o"], domain="d")], functions, [])


def test_network_that_takes_gigabytes_is_refused(tmp_path: Path) -> None:
    path = constants(tmp_path / "large.onnx", 4)
    assert path.stat().st_size < 2000
    for load in (lambda: onnx_facts(path), lambda: open_session(path, 1)):
        with pytest.raises(RuntimeUnusableError) as caught:
            load()
        assert str(path) in str(caught.value)
        assert "MiB" in str(caught.value)
        assert "\n" not in str(caught.value)


def test_network_that_never_ends_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(load_trial, "LOAD_S", 2.0)
    path = nested(tmp_path / "nested.onnx", 40)
    with pytest.raises(RuntimeUnusableError, match=r" 2 s"):
        open_session(path, 1)


def test_usable_network_is_tried_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = nested(tmp_path / "small.onnx", 3)
    session, _ = open_session(path, 1)
    assert session.run(None, {"x": np.ones(1, np.float32)})[0].tolist() == [1.0]

    def run(*_: object, **__: object) -> None:
        raise AssertionError("it is not tried again")

    monkeypatch.setattr("vision.runtimes.load_trial.subprocess.run", run)
    open_session(path, 1)
    path.write_bytes(path.read_bytes() + b"\x00")
    with pytest.raises(AssertionError):
        open_session(path, 1)


@pytest.mark.parametrize("content", [b"", b"not a network"])
def test_a_file_that_is_no_network_is_named(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "other.onnx"
    path.write_bytes(content)
    with pytest.raises(RuntimeUnusableError, match=r"onnx: .*ONNX model"):
        open_session(path, 1)


# --- Checkpoints --------------------------------------------------------------------------------------------


# `test_checkpoint_fuzz` reads all of them, with the same limits.
@pytest.mark.parametrize("name", ["lists", "a tensor of a large size"])
def test_checkpoint_that_takes_much_memory_is_refused(tmp_path: Path, name: str) -> None:
    path = BOMBS[name][0](tmp_path / "bomb.pt")
    with pytest.raises(CheckpointError, match=r"3\d MiB") as caught:
        load_checkpoint(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert list((tmp_path / "cache").rglob("*.loads")) == []


def test_checkpoint_that_takes_long_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = BOMBS["colliding keys"][0](tmp_path / "bomb.pt")
    monkeypatch.setattr(load_trial, "LOAD_S", 3.0)
    with pytest.raises(CheckpointError, match=r" 3 s"):
        load_checkpoint(path)


def test_readable_checkpoint_is_tried_once(
    tmp_path: Path, checkpoint: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tries = []

    def run(*arguments: Any, **options: Any) -> Any:
        tries.append(arguments)
        return real_run(*arguments, **options)

    real_run = subprocess.run
    monkeypatch.setattr("vision.runtimes.load_trial.subprocess.run", run)
    for _ in range(2):
        load_checkpoint(checkpoint)
        read_source(checkpoint)
    assert len(tries) == 1


def test_torch_reads_checkpoints_in_one_place() -> None:
    """So that no way to a checkpoint is without its trial; the others read the state of a training."""
    root = Path(load_trial.__file__).parent.parent.parent
    sources = [path for package in ("companion", "vision") for path in (root / package).rglob("*.py")]
    readers = [
        path.name for path in sources if re.search(r"= torch\.load\(|return torch\.load\(", path.read_text())
    ]
    assert sorted(readers) == ["torch_archive.py", "train_policy.py", "training.py"]


# --- OpenVINO -----------------------------------------------------------------------------------------------


def broadcast(path: Path, number: int) -> Path:
    """An OpenVINO file with constants of 0.9 GB each, which are computed when it is compiled."""
    openvino = pytest.importorskip("openvino")
    ops = openvino.opset13
    x = ops.parameter([1], np.float32, name="x")
    total = x
    for index in range(number):
        length = ops.constant(np.array([225_000_000], np.int64))
        large = ops.broadcast(ops.constant(np.array([index + 1.0], np.float32)), length)
        first = ops.gather(large, ops.constant(np.array([0])), ops.constant(0))
        total = ops.add(total, first)
    openvino.save_model(openvino.Model([total], [x]), path)
    return path


def test_openvino_file_that_takes_gigabytes_is_refused(tmp_path: Path) -> None:
    path = broadcast(tmp_path / "large.xml", 4)
    for load in (lambda: openvino_facts(path), lambda: OpenVinoNetwork(path)):
        with pytest.raises(RuntimeUnusableError, match="MiB") as caught:
            load()
        assert str(path) in str(caught.value)


def test_openvino_tries_an_onnx_file_itself(tmp_path: Path) -> None:
    pytest.importorskip("openvino")
    with pytest.raises(RuntimeUnusableError, match=r"openvino .* MiB"):
        OpenVinoNetwork(constants(tmp_path / "large.onnx", 4))


def test_usable_openvino_file_is_tried_again_with_other_numbers(tmp_path: Path) -> None:
    path = broadcast(tmp_path / "small.xml", 0)
    OpenVinoNetwork(path)
    marks = list((tmp_path / "cache").rglob("*.loads"))
    assert len(marks) == 1
    path.with_suffix(".bin").write_bytes(b"other")
    OpenVinoNetwork(path)
    assert len(list((tmp_path / "cache").rglob("*.loads"))) == 2
