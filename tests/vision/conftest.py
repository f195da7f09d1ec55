"""Classes with the names of Ultralytics' layers, so that a pickle can refer to them; and no proxy."""

from __future__ import annotations

from typing import TYPE_CHECKING
from urllib.request import getproxies

import pytest

if TYPE_CHECKING:  # it imports torch, which tests of sources and tracking do without
    from tests.vision.foreign_checkpoints import Classes


@pytest.fixture
def foreign(monkeypatch: pytest.MonkeyPatch) -> Classes:
    """Classes with the foreign library's names, importable only during a test."""
    from tests.vision.foreign_checkpoints import FOREIGN, foreign_classes

    return foreign_classes(monkeypatch, FOREIGN)


@pytest.fixture
def early_foreign(monkeypatch: pytest.MonkeyPatch) -> Classes:
    """As in the first releases: all layers in one module."""
    from tests.vision.foreign_checkpoints import FOREIGN, foreign_classes

    modules = {
        name: "ultralytics.nn.modules" if module.startswith("ultralytics.nn.modules") else module
        for name, module in FOREIGN.items()
    }
    return foreign_classes(monkeypatch, modules)


@pytest.fixture
def no_proxy(monkeypatch: pytest.MonkeyPatch) -> None:
    """Loopback is accessed directly, whatever proxy the environment sets."""
    for name in getproxies():
        monkeypatch.delenv(f"{name}_proxy", raising=False)
        monkeypatch.delenv(f"{name.upper()}_PROXY", raising=False)


@pytest.fixture
def untried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Checkpoints are read at once, without the trial in another process that takes seconds."""
    monkeypatch.setattr("vision.yolo.checkpoint_file.check_load", lambda path, runtime: None)
