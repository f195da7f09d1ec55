"""A few training steps as by `companion train`: the written model can be used."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml

import companion.train
from companion.train import train_default
from vision.detector import Detector
from vision.yolo.recipe import DEFAULT_RECIPE, REFINEMENT
from vision.yolo.training import Stage


def test_training_writes_model_with_licence_and_score(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Smaller images than the recipe's; everything else is unchanged.
    small = replace(
        DEFAULT_RECIPE, stages=(Stage(96, 96, 2, 2),), width_multiple=0.0625, workers=0, threads=1
    )
    monkeypatch.setattr(companion.train, "DEFAULT_RECIPE", small)
    stages = (Stage(96, 96, 2, 2, drawn=(128, 96)),)
    monkeypatch.setattr(
        companion.train, "REFINEMENT", replace(REFINEMENT, stages=stages, width_multiple=0.0625, workers=0)
    )
    monkeypatch.setattr(companion.train, "HELD_OUT_SIZE", (96, 96))
    output = tmp_path / "out" / "model.safetensors"
    score = train_default(output, held_out=2)
    assert 0.0 <= score.map50 <= 1.0
    written = yaml.safe_load(output.with_suffix(".yaml").read_text())
    assert written["licence"] == "Apache-2.0"
    assert written["score"]["held_out_scenes"] == 2
    assert written["steps_done"] == 2
    detector = Detector(output, image_size=96)
    assert detector.metadata["licence"] == "Apache-2.0"
    detector.detect(np.zeros((96, 96, 3), np.uint8))
    # Resuming a finished training has nothing left to do.
    assert train_default(output, held_out=2, resume=True).map50 == pytest.approx(score.map50)
    refined = train_default(tmp_path / "refined.safetensors", start=output, held_out=2)
    assert 0.0 <= refined.map50 <= 1.0
    assert not (tmp_path / "refined.safetensors.training").exists()


def test_resume_without_state_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError):
        train_default(tmp_path / "model.pt", resume=True)
