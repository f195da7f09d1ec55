"""The three packages as libraries: their public names, and the examples in their docstrings."""

from __future__ import annotations

import doctest
import importlib
import re
import subprocess
import sys
from collections.abc import Iterator

import pytest

from companion.guidance.command import COMMANDS

PACKAGES = ["companion", "mavlink_sim", "vision"]
# Their examples start a process.
STARTS_A_PROCESS = {"RunningSimulator", "running_simulator"}
NAMES = [
    pytest.param(package, name, marks=[pytest.mark.realtime] if name in STARTS_A_PROCESS else [])
    for package in PACKAGES
    for name in importlib.import_module(package).__all__
    if name != "__version__" and not name.endswith("Error")
]


@pytest.fixture
def _table() -> Iterator[None]:
    """Restores the command table."""
    before = dict(COMMANDS)
    yield
    COMMANDS.clear()
    COMMANDS.update(before)


@pytest.mark.parametrize("package", PACKAGES)
def test_every_public_name_is_there_and_no_other(package: str) -> None:
    module = importlib.import_module(package)
    names = [name for name in module.__all__ if name != "__version__"]
    assert 10 <= len(names) <= 18
    for name in names:
        assert getattr(module, name).__doc__, name
    assert module.__version__.count(".") == 2
    with pytest.raises(AttributeError, match=rf"module '{package}' .*'nothing'"):
        _ = module.nothing


@pytest.mark.parametrize("package", PACKAGES)
def test_import_of_a_package_loads_nothing_heavy(package: str) -> None:
    text = (
        f"import sys, {package}; print(sorted({{'cv2', 'torch', 'zenoh', 'pymavlink'}} & set(sys.modules)))"
    )
    run = subprocess.run([sys.executable, "-c", text], capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


@pytest.mark.usefixtures("_table")
@pytest.mark.parametrize(("package", "name"), NAMES)
def test_every_public_name_has_an_example_that_is_checked(package: str, name: str) -> None:
    module = importlib.import_module(package)
    described = getattr(module, name)
    finder = doctest.DocTestFinder(recurse=False)
    cases = finder.find(described, name, globs={"__name__": "__main__"})
    if not any(case.examples for case in cases):  # then its package's has it, which the next test runs
        [case] = finder.find(module, package)
        assert any(re.search(rf"\b{name}\b", example.source) for example in case.examples)
    runner = doctest.DocTestRunner()
    for case in cases:
        assert runner.run(case).failed == 0


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
