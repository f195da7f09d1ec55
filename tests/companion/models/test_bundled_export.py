"""The bundled export is that of the bundled checkpoint."""

from __future__ import annotations

from companion.models.verify import sample_images, verify
from vision.runtimes.source import read_source
from vision.weights import DEFAULT_EXPORT, DEFAULT_WEIGHTS
from vision.yolo.checkpoint_pair import weights_sha256


def test_bundled_export_states_the_checkpoint() -> None:
    checkpoint, export = read_source(DEFAULT_WEIGHTS), read_source(DEFAULT_EXPORT)
    assert export.facts is not None
    assert export.facts.source_sha256 == weights_sha256(DEFAULT_WEIGHTS)
    assert export.facts.model_family == "YOLOv8"
    assert (export.class_names, export.strides) == (checkpoint.class_names, checkpoint.strides)
    assert export.metadata == checkpoint.metadata


def test_bundled_export_computes_what_the_checkpoint_does() -> None:
    parity = verify(DEFAULT_WEIGHTS, DEFAULT_EXPORT, sample_images(None, 4), 320, threads=1)
    assert parity.boxes > 10
    assert parity.holds(map_tolerance=1e-3, box_tolerance_px=0.01)
