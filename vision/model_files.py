"""The models folders, in which a model is found by its bare name: one of the system, one of each user."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from vision.catalog import KNOWN
from vision.file_kinds import is_hidden
from vision.home import expanded, home_folder

# Suffixes of model files, in the order in which a bare name is looked up.
MODEL_SUFFIXES = (".safetensors", ".pt", ".onnx", ".pth")


SYSTEM_FOLDER = Path("/var/lib/companion/models")
"""That of the service under systemd, which every user reads."""


def models_folders() -> tuple[Path, ...]:
    """The folders in which a name is looked up, in this order: the user's, then the system's.

    The user's is `mavlink-companion/models` in the data folder (XDG). `$COMPANION_MODELS_FOLDER` replaces
    both.
    """
    if chosen := os.environ.get("COMPANION_MODELS_FOLDER"):
        return (expanded(chosen),)
    data = os.environ.get("XDG_DATA_HOME")
    return (
        (expanded(data) if data else home_folder() / ".local/share") / "mavlink-companion" / "models",
        SYSTEM_FOLDER,
    )


def models_folder() -> Path:
    """The folder in which a new model is put: the system's if this user may write it, else the user's."""
    folders = models_folders()
    last = folders[-1]
    existing = next(folder for folder in (last, *last.parents) if folder.exists())
    return last if os.access(existing, os.W_OK | os.X_OK) else folders[0]


def kept_models(*folders: Path) -> list[Path]:
    """The model files in the folders (none: `models_folders()`), sorted by name; of one name the first."""
    found: dict[str, Path] = {}
    for folder in folders or models_folders():
        with suppress(OSError):  # no such folder, or not for us
            for path in folder.iterdir():
                if path.suffix in MODEL_SUFFIXES and not is_hidden(path) and path.is_file():
                    found.setdefault(path.name, path)
    return [found[name] for name in sorted(found)]


def find_model(name: str | Path) -> Path:
    """Resolve `name`: an existing path, else `NAME` or `NAME.pt`, `NAME.onnx` … in a models folder.

    A name found nowhere is returned as it is, so that the reader names it in its error.
    """
    path = expanded(name)
    if path.exists() or path.name != str(name):
        return path
    for folder in models_folders():
        for suffix in ("", *MODEL_SUFFIXES):
            candidate = folder / f"{path.name}{suffix}"
            with suppress(OSError):  # an unreadable folder holds no model for us
                if candidate.is_file():
                    return candidate
    return path


def missing_model_advice(path: Path) -> str:
    """What to do about a model that `find_model` did not find."""
    absent = f"nor is it in {' or '.join(map(str, models_folders()))}; `companion models"
    if any(str(path) in (known.name, known.file) for known in KNOWN.values()):
        return f"{absent} pull {path.stem}` downloads it"
    if path.suffix or path.name != str(path):
        return "give the path of a .pt checkpoint, of NAME.safetensors beside its NAME.yaml, or of an export"
    return f"{absent} show` shows the models"
