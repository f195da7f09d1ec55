"""Checkpoints as two plain files: a pair as a whole, and its safetensors file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from vision.training.published import yolov8_description
from vision.weights import DEFAULT_WEIGHTS
from vision.yolo.architecture import YoloModel, build
from vision.yolo.checkpoint import load_checkpoint, save_checkpoint
from vision.yolo.checkpoint_error import CheckpointError
from vision.yolo.checkpoint_pair import read_safetensors, write_safetensors

NAMES = ("no", "1:30", "Schaf")
METADATA = {"licence": "Apache-2.0", "score": {"map50": 0.5, "per_class": [1, 2]}, "note": None}


@pytest.fixture(scope="module")
def model() -> YoloModel:
    torch.manual_seed(0)
    return build(yolov8_description((0.1, 0.01, 64), NAMES)).eval()


@pytest.fixture
def pair(tmp_path: Path, model: YoloModel) -> Path:
    save_checkpoint(tmp_path / "model.safetensors", model, metadata=METADATA)
    return tmp_path / "model.safetensors"


def edit(pair: Path, **changes: Any) -> None:
    path = pair.with_suffix(".yaml")
    path.write_text(yaml.safe_dump(yaml.safe_load(path.read_text()) | changes))


def test_either_file_of_a_pair_loads_the_model_that_was_saved(pair: Path, model: YoloModel) -> None:
    for path in (pair, pair.with_suffix(".yaml")):
        loaded = load_checkpoint(path)
        assert loaded.class_names == NAMES
        assert loaded.description == model.description
        assert loaded.metadata == METADATA
        weights = loaded.model.state_dict()
        for name, tensor in model.state_dict().items():
            torch.testing.assert_close(weights[name], tensor, rtol=1e-3, atol=1e-3)
    assert sorted(path.name for path in pair.parent.iterdir()) == ["model.safetensors", "model.yaml"]


def test_a_saved_pair_saved_again_is_the_same_bytes(pair: Path, tmp_path: Path) -> None:
    again = tmp_path / "again" / pair.name
    again.parent.mkdir()
    loaded = load_checkpoint(pair)
    save_checkpoint(again, loaded.model, metadata=loaded.metadata)
    assert again.read_bytes() == pair.read_bytes()
    assert again.with_suffix(".yaml").read_bytes() == pair.with_suffix(".yaml").read_bytes()


def test_minimal_pair_has_format_and_architecture(pair: Path) -> None:
    table = yaml.safe_load(pair.with_suffix(".yaml").read_text())
    architecture = table["architecture"] | {"names": dict(enumerate(NAMES))}
    pair.with_suffix(".yaml").unlink()
    pair.with_suffix(".yml").write_text(
        yaml.safe_dump({"format": table["format"], "architecture": architecture})
    )
    assert load_checkpoint(pair).class_names == NAMES


def test_files_of_different_pairs_are_rejected(pair: Path, model: YoloModel) -> None:
    kept = pair.with_suffix(".yaml").read_text()
    save_checkpoint(pair, build(model.description), metadata={})
    pair.with_suffix(".yaml").write_text(kept)
    with pytest.raises(CheckpointError, match=r"SHA-256 [0-9a-f]{64}, model\.yaml .* [0-9a-f]{64}; "):
        load_checkpoint(pair)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        pytest.param({"format": "other"}, "format other", id="format"),
        pytest.param({"architecture": None}, "has no `architecture`", id="no architecture"),
        pytest.param({"weights": 3}, "`weights` in model.yaml", id="weights"),
        pytest.param({"architecture": {"names": {0: "a", 2: "b"}}}, "not numbered from 0", id="names"),
        pytest.param({"architecture": {"names": ["a"]}}, "a network needs 1", id="no rows"),
    ],
)
def test_a_description_that_cannot_be_used_is_one_line(
    pair: Path, changes: dict[str, Any], expected: str
) -> None:
    edit(pair, **changes)
    with pytest.raises(CheckpointError, match=expected) as error:
        load_checkpoint(pair)
    assert "model." in str(error.value)
    assert "\n" not in str(error.value)


def test_half_a_pair_names_the_other_half(pair: Path) -> None:
    description = pair.with_suffix(".yaml")
    kept = description.read_text()
    description.unlink()
    with pytest.raises(CheckpointError, match=r"yaml: .*; model\.safe"):
        load_checkpoint(pair)
    description.write_text(kept)
    pair.unlink()
    with pytest.raises(CheckpointError, match=r"model\.safetensors: .*NAME\."):
        load_checkpoint(description)


def test_metadata_cannot_replace_the_description(tmp_path: Path, model: YoloModel) -> None:
    with pytest.raises(ValueError, match="architecture"):
        save_checkpoint(tmp_path / "a.safetensors", model, metadata={"architecture": 1})


def test_the_bundled_model_is_a_pair_that_states_its_licence() -> None:
    loaded = load_checkpoint(DEFAULT_WEIGHTS)
    assert DEFAULT_WEIGHTS.suffix == ".safetensors"
    assert loaded.metadata["licence"] == "Apache-2.0"
    assert loaded.metadata["score"]["map50"] > 0


def raw(header: Any, data: bytes = b"") -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + data


def entry(dtype: Any = "F32", shape: Any = (2,), offsets: Any = (0, 8)) -> dict[str, Any]:
    return {"dtype": dtype, "shape": shape, "data_offsets": offsets}


def test_round_trip(tmp_path: Path) -> None:
    dtypes = (torch.float32, torch.float16, torch.bfloat16, torch.int64, torch.uint8, torch.bool)
    tensors = {f"a.{dtype}": (torch.randn(2, 3) * 9).to(dtype) for dtype in dtypes}
    tensors |= {"scalar": torch.tensor(3.5), "none": torch.zeros(0, 4), "turned": torch.randn(4, 5).T}
    path = tmp_path / "a.safetensors"
    write_safetensors(path, tensors, {"licence": "Apache-2.0"})
    found, metadata = read_safetensors(path)
    assert metadata == {"licence": "Apache-2.0"}
    assert found.keys() == tensors.keys()
    for name, tensor in tensors.items():
        assert found[name].dtype == tensor.dtype
        assert torch.equal(found[name], tensor)


def test_tensors_do_not_change_when_the_file_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "a.safetensors"
    write_safetensors(path, {"a": torch.ones(1000)}, {})
    tensor = read_safetensors(path)[0]["a"]
    write_safetensors(path, {"a": torch.zeros(1000)}, {})
    assert torch.equal(tensor, torch.ones(1000))


@pytest.mark.parametrize(
    "content",
    [
        pytest.param(b"", id="empty"),
        pytest.param(b"\xff" * 8, id="a header longer than the file"),
        pytest.param((1 << 40).to_bytes(8, "little") + b"{}", id="a huge header"),
        pytest.param(raw(b" " * (5 << 20)), id="a header of 5 MB"),
        pytest.param(raw(b"[]"), id="a list"),
        pytest.param(raw(b"{"), id="half a header"),
        pytest.param(raw(b'{"\xff": 1}'), id="not UTF-8"),
        pytest.param(raw(b'{"a": ' + b"[" * 50_000), id="deep"),
        pytest.param(raw({"a": 1}), id="not a tensor"),
        pytest.param(raw({"a": entry(dtype="F99")}, bytes(8)), id="an unknown type"),
        pytest.param(raw({"a": entry(shape=[-2])}, bytes(8)), id="a negative shape"),
        pytest.param(raw({"a": entry(shape=[3])}, bytes(8)), id="another size"),
        pytest.param(raw({"a": entry(shape=[1 << 39, 1 << 39], offsets=[0, 1 << 80])}), id="huge"),
        pytest.param(raw({"a": entry(), "b": entry()}, bytes(8)), id="overlap"),
        pytest.param(raw({"a": entry(offsets=[8, 16])}, bytes(16)), id="a gap"),
        pytest.param(raw({"a": entry()}, bytes(12)), id="left over"),
        pytest.param(raw({"a": entry()}, bytes(4)), id="truncated"),
        pytest.param(raw({"__metadata__": {"a": 1}}), id="metadata that are not texts"),
    ],
)
def test_a_damaged_file_is_a_checkpoint_error(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "a.safetensors"
    path.write_bytes(content)
    with pytest.raises(CheckpointError):
        read_safetensors(path)


def test_a_missing_file_and_a_folder_are_checkpoint_errors(tmp_path: Path) -> None:
    for path in (tmp_path / "missing.safetensors", tmp_path):
        with pytest.raises(CheckpointError, match="safetensors"):
            read_safetensors(path)


def test_complex_numbers_are_not_written(tmp_path: Path) -> None:
    with pytest.raises(TypeError, match="complex64"):
        write_safetensors(tmp_path / "a.safetensors", {"a": torch.zeros(2, dtype=torch.complex64)}, {})
