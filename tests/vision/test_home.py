"""A user without a home: HOME is unset, and passwd has no entry of the user id."""

from __future__ import annotations

import pwd
from pathlib import Path

import pytest

from vision.home import NO_HOME, expanded, home_folder
from vision.model_files import models_folders
from vision.runtimes.stored_choice import StoredChoice, cache_folder

ROOT = Path(__file__).parents[2]


@pytest.fixture
def no_home(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(_uid: object) -> None:
        raise KeyError

    for name in ("HOME", "XDG_CACHE_HOME", "XDG_DATA_HOME", "COMPANION_MODELS_FOLDER"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(pwd, "getpwuid", unknown)
    monkeypatch.setattr(pwd, "getpwnam", unknown)


@pytest.mark.usefixtures("no_home")
def test_folders_without_a_home_are_below_nowhere() -> None:
    assert home_folder() == NO_HOME
    assert NO_HOME in cache_folder().parents
    assert NO_HOME in models_folders()[0].parents
    assert StoredChoice("0" * 64, {}).read({"torch"}) is None


@pytest.mark.usefixtures("no_home")
def test_path_of_an_unknown_home_stays() -> None:
    assert expanded("~/a.pt") == Path("~/a.pt")
    assert expanded("/a.pt") == Path("/a.pt")


def test_only_one_module_asks_for_the_home() -> None:
    files = [path for package in ("companion", "vision") for path in (ROOT / package).rglob("*.py")]
    asking = [
        path for path in files if ".expanduser()" in (text := path.read_text()) or "Path.home()" in text
    ]
    assert asking == [ROOT / "vision" / "home.py"]
