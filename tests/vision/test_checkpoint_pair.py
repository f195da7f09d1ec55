"""Checkpoints as two plain files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
import yaml

from vision.weights import DEFAULT_WEIGHTS
from vision.yolo.architecture import YoloModel, build, yolov8_description
from vision.yolo.checkpoint import CheckpointError, load_checkpoint, save_checkpoint

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
    with pytest.raises(CheckpointError, match="do not match"):
        load_checkpoint(pair)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        pytest.param({"format": "other"}, "format other", id="format"),
        pytest.param({"architecture": None}, "has no `architecture`", id="no architecture"),
        pytest.param({"weights": 3}, "`weights` in model.yaml must be a table", id="weights"),
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
    with pytest.raises(CheckpointError, match=r"model\.yaml: no such file; model\.safetensors needs it"):
        load_checkpoint(pair)
    description.write_text(kept)
    pair.unlink()
    with pytest.raises(CheckpointError, match=r"model\.safetensors: no such file"):
        load_checkpoint(description)


def test_metadata_cannot_replace_the_description(tmp_path: Path, model: YoloModel) -> None:
    with pytest.raises(ValueError, match="architecture"):
        save_checkpoint(tmp_path / "a.safetensors", model, metadata={"architecture": 1})


def test_the_bundled_model_is_a_pair_that_states_its_licence() -> None:
    loaded = load_checkpoint(DEFAULT_WEIGHTS)
    assert DEFAULT_WEIGHTS.suffix == ".safetensors"
    assert loaded.metadata["licence"] == "Apache-2.0"
    assert loaded.metadata["score"]["map50"] > 0
