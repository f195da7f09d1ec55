"""Choices measured on this board (the fastest runtime, torch's precision), stored in the cache folder.

Measured at every start, they would vary with the load of the machine.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import platform
from pathlib import Path
from typing import Any

from vision.home import home_folder

logger = logging.getLogger(__name__)

_PATTERN = "trial-*.json"


def cache_folder() -> Path:
    """Folder of converted networks and stored choices: below `$XDG_CACHE_HOME` or `~/.cache`."""
    base = os.environ.get("XDG_CACHE_HOME", "")
    root = Path(base) if os.path.isabs(base) else home_folder() / ".cache"
    return root / "mavlink-companion" / "runtimes"


class StoredChoice:
    """The measured times that answer one question, valid on this board for one model.

    Args:
        model_sha256: of the weights.
        question: everything else that the times depend on, as plain values.
    """

    def __init__(self, model_sha256: str, question: dict[str, Any]) -> None:
        self._question = {"model": model_sha256, "board": board(), **question}
        text = json.dumps(self._question, sort_keys=True)
        key = hashlib.sha256(text.encode()).hexdigest()[:24]
        self._path = cache_folder() / _PATTERN.replace("*", key)

    def read(self, names: set[str]) -> dict[str, Any] | None:
        """The stored times, by name; None if there are none of exactly these names."""
        content = _read(self._path)
        if content is None or content.get("question") != self._question:
            return None
        answer = content.get("answer")
        return answer if isinstance(answer, dict) and set(answer) == names else None

    def write(self, answer: dict[str, Any]) -> None:
        """Store the times; a folder that is not writable is logged."""
        partial = self._path.with_name(f"{self._path.name}.{os.getpid()}.partial")
        try:
            self._path.parent.mkdir(parents=True, exist_ok=True)
            partial.write_text(json.dumps({"question": self._question, "answer": answer}))
            os.replace(partial, self._path)
        except OSError as error:
            logger.warning(
                "the choice of runtime or precision cannot be stored and is measured again next time: %s",
                error,
            )


def forget_choices(model_sha256: str) -> int:
    """Delete the stored choices of a model, so that its next start measures again; return their number.

    Raises:
        OSError: one cannot be deleted.
    """
    stored = [path for path in cache_folder().glob(_PATTERN) if _model_of(_read(path)) == model_sha256]
    for path in stored:
        path.unlink(missing_ok=True)
    return len(stored)


def board() -> list[str]:
    """Identification of this computer, as far as it affects speed."""
    device_tree = Path("/proc/device-tree/model")
    try:
        model = device_tree.read_bytes().rstrip(b"\0").decode(errors="replace")
    except OSError:
        model = ""
    names = {"model name", "Hardware", "CPU part"}
    try:
        lines = Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
    except OSError:
        lines = []
    parts = sorted({line for line in lines if line.partition(":")[0].strip() in names})
    return [platform.machine(), model, str(len(os.sched_getaffinity(0))), *parts]


def _model_of(content: dict[str, Any] | None) -> str | None:
    question = content.get("question") if content is not None else None
    return question.get("model") if isinstance(question, dict) else None


def _read(path: Path) -> dict[str, Any] | None:
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError):
        return None
    return content if isinstance(content, dict) else None
