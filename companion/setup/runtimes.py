"""Finds the fastest runtime of the bundled model on this computer."""

from __future__ import annotations

from pathlib import Path

from companion.perception.cameras import threads_each
from companion.settings.perception import DEFAULT_MODEL, DetectorSection
from vision.detector import model_path
from vision.runtimes.autotune import fastest_runtime
from vision.runtimes.base import RuntimeName, installed
from vision.runtimes.source import read_source

DEFAULT_RUNTIME = "onnxruntime"
"""Of the bundled model, a file of ONNX, where `detector.runtime` is not set."""


def installed_runtimes() -> list[RuntimeName]:
    """Return the installed runtimes of the bundled model. Raises CheckpointError: it is not there."""
    return [name for name in read_source(_path()).runners() if installed(name)]


def fastest(detector: DetectorSection) -> tuple[RuntimeName, str]:
    """Return the fastest runtime of the bundled model, and what was measured.

    Measured once per board and versions; the service's own choice of `auto` has the same times. With TensorRT
    it takes minutes.

    Raises:
        RuntimeUnusableError, CheckpointError: there is none.
    """
    section = detector.loading(detector.confidence)
    return fastest_runtime(
        read_source(_path()),
        installed_runtimes(),
        class_ids=None,
        precision=section.precision,
        threads=section.threads or threads_each([detector]),
        image_size=section.image_size,
    )


def _path() -> Path:
    # The file that `detector.runtime = "auto"` starts with.
    return model_path(DEFAULT_MODEL, "auto")
