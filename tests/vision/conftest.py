"""Classes that bear the names of Ultralytics' layers, so that a pickle can name them."""

from __future__ import annotations

import pytest
from foreign_checkpoints import FOREIGN, foreign_classes
from torch import nn


@pytest.fixture
def foreign(monkeypatch: pytest.MonkeyPatch) -> dict[str, type[nn.Module]]:
    """Classes of the foreign library's names, importable only while a test runs."""
    return foreign_classes(monkeypatch, FOREIGN)


@pytest.fixture
def early_foreign(monkeypatch: pytest.MonkeyPatch) -> dict[str, type[nn.Module]]:
    """As the first releases had them: all layers in one file."""
    places = {
        name: "ultralytics.nn.modules" if place.startswith("ultralytics.nn.modules") else place
        for name, place in FOREIGN.items()
    }
    return foreign_classes(monkeypatch, places)
