"""The models folder, in which a model is found by its bare name."""

from __future__ import annotations

import os
from pathlib import Path

from vision.catalog import KNOWN

# Suffixes of model files, in the order in which a bare name is looked up.
MODEL_SUFFIXES = (".safetensors", ".pt", ".onnx", ".pth")


def models_folder() -> Path:
    """`$COMPANION_MODELS_FOLDER`, else `mavlink-companion/models` in the user's data folder (XDG)."""
    if chosen := os.environ.get("COMPANION_MODELS_FOLDER"):
        return Path(chosen).expanduser()
    data = os.environ.get("XDG_DATA_HOME") or "~/.local/share"
    return Path(data).expanduser() / "mavlink-companion" / "models"


def kept_models(folder: Path | None = None) -> list[Path]:
    """The model files in the folder, sorted by name; empty if there is no folder."""
    folder = models_folder() if folder is None else folder
    if not folder.is_dir():
        return []
    return sorted(path for path in folder.iterdir() if path.suffix in MODEL_SUFFIXES and path.is_file())


def find_model(name: str | Path) -> Path:
    """Resolve `name`: an existing path, else `NAME` or `NAME.pt`, `NAME.onnx` … in the models folder.

    A name found nowhere is returned as it is, so that the reader names it in its error.
    """
    path = Path(name).expanduser()
    if path.exists() or path.name != str(name):
        return path
    kept = models_folder() / path.name
    for candidate in (kept, *(kept.with_name(kept.name + suffix) for suffix in MODEL_SUFFIXES)):
        try:
            if candidate.is_file():
                return candidate
        except OSError:  # an unreadable folder holds no model for us
            return path
    return path


def missing_model_advice(path: Path) -> str:
    """What to do about a model that `find_model` did not find."""
    absent = f"nor is it in the models folder {models_folder()}; `companion models"
    if any(str(path) in (known.name, known.file) for known in KNOWN.values()):
        return f"{absent} pull {path.stem}` downloads it"
    if path.suffix or path.name != str(path):
        return "give the path of a .pt checkpoint, of NAME.safetensors beside its NAME.yaml, or of an export"
    return f"{absent} list` shows the models"
