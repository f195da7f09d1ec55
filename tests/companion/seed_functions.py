"""Functions of a seed for `test_campaign.py`, in a module that worker processes can import."""

from __future__ import annotations

import os
import signal
import threading
from pathlib import Path


def squared(seed: int) -> int:
    """The seed squared; 7 fails."""
    if seed == 7:
        raise ValueError("refused 7")
    return seed * seed


def killed_once(folder: Path, seed: int) -> int:
    """The seed squared; the first process that is given seed 3 is killed."""
    tried = folder / "tried"
    if seed == 3 and not tried.exists():
        tried.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return squared(seed)


def killed(seed: int) -> int:
    """Every process that is given seed 3 is killed."""
    if seed == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return squared(seed)


def endless(seed: int) -> int:
    """The seed squared; any but 1 never ends."""
    if seed != 1:
        threading.Event().wait()
    return squared(seed)
