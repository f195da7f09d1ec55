"""What holds for all tests."""

import gc
import os
import subprocess
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import typer
from hypothesis import settings

from companion.settings.layers import SYSTEM_VARIABLE
from tests.programs import MAKE, NEEDS, REQUIRED

# How long an example takes says more of the machine than of the code. The same examples every time, so that a
# failure is of the change; `make test-slow` tries new ones, and more where a test sets no number.
settings.register_profile("steady", deadline=None, derandomize=True, max_examples=40)
settings.register_profile("explore", deadline=None, max_examples=300)
settings.load_profile("steady")

# Tests run side by side: a thread pool of torch or OpenCV in each of them would only wait for the others'.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENCV_FOR_THREADS_NUM", "1")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    """Leave out a test that needs what is not here; fail it where all that can be installed is required."""
    for name in (name for mark in item.iter_markers("needs") for name in mark.args):
        need = NEEDS[name]
        if not need.here:
            refuse = pytest.fail if REQUIRED and need.get == MAKE else pytest.skip
            refuse(f"no {name}: {need.get}")


@pytest.fixture(scope="session", autouse=True)
def own_folders(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Tests leave nothing in the user's cache, state and models folders, and find nothing there.

    They read no settings of this computer and of its user.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(tmp_path_factory.mktemp("cache")))
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.mktemp("state")))
        patch.delenv("STATE_DIRECTORY", raising=False)
        patch.setenv("COMPANION_MODELS_FOLDER", str(tmp_path_factory.mktemp("models")))
        settings = tmp_path_factory.mktemp("settings")
        patch.setenv("XDG_CONFIG_HOME", str(settings))
        patch.setenv(SYSTEM_VARIABLE, str(settings / "system.toml"))
        yield


@pytest.fixture(scope="session", autouse=True)
def command_line_built_once() -> Iterator[None]:
    """`CliRunner` builds all commands each time: 50 ms."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("typer.testing._get_command", cache(typer.main.get_command))
        yield


@pytest.fixture(scope="session", autouse=True)
def trials_in_this_process() -> Iterator[Callable[..., Any]]:
    """A model file is tried here and without limits: a process that imports torch takes two seconds.

    Yields what runs the process, for the tests of the trial itself.
    """
    from vision.runtimes import load_trial

    def run(runtime: str, path: Path) -> subprocess.CompletedProcess[bytes]:
        return subprocess.CompletedProcess([runtime, path], load_trial.main(runtime, str(path)), b"", b"")

    with pytest.MonkeyPatch.context() as patch:
        run_apart = load_trial._run
        patch.setattr(load_trial, "_run", run)
        patch.setattr(load_trial, "_limit", lambda more_bytes, more_s: None)
        yield run_apart


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Keep imported modules out of the garbage collector's sight: a tenth of the run time."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()
