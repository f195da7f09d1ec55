"""The three packages as libraries: their public names, and the examples in their docstrings."""

from __future__ import annotations

import doctest
import importlib
import subprocess
import sys

import pytest

PACKAGES = ["companion", "mavlink_sim", "vision"]


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_is_there_and_no_other(package: str) -> None:
    module = importlib.import_module(package)
    names = [name for name in module.__all__ if name != "__version__"]
    assert 8 <= len(names) <= 18
    for name in names:
        assert getattr(module, name).__doc__, name
    assert module.__version__.count(".") == 2
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        _ = module.nothing


@pytest.mark.parametrize("package", PACKAGES)
def test_import_of_a_package_loads_nothing_heavy(package: str) -> None:
    text = (
        f"import sys, {package}; print(sorted({{'cv2', 'torch', 'zenoh', 'pymavlink'}} & set(sys.modules)))"
    )
    run = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


@pytest.mark.parametrize(
    "name",
    [
        "mavlink_sim",
        "mavlink_sim.lockstep",
        pytest.param("mavlink_sim.testing", marks=pytest.mark.realtime),
        "mavlink_sim.wire.setpoints",
        "vision",
    ],
)
def test_the_example_in_the_docstring_runs(name: str) -> None:
    failed, tried = doctest.testmod(importlib.import_module(name))
    assert tried
    assert not failed
