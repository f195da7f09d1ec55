"""Progress on standard error of `companion learn train`."""

from __future__ import annotations

import sys
import time

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn


class TrainingDisplay:
    """A bar on a terminal; else, and with a prefix, a line every 10 s and when all steps are done.

    Args:
        prefix: begins every line.
    """

    EVERY_S = 10.0

    def __init__(self, prefix: str = "") -> None:
        self._prefix = prefix
        self._shown_s = time.monotonic()
        self._bar: Progress | None = None
        if sys.stderr.isatty() and not prefix:
            columns = (BarColumn(), TextColumn("{task.description}"), TimeRemainingColumn())
            self._bar = Progress(TextColumn("training"), *columns, console=Console(stderr=True))
            self._task = self._bar.add_task("", total=None)

    def show(self, step: int, steps: int, figures: str, remaining_s: float | None) -> None:
        """Show a step of the training. `remaining_s`: None if unknown."""
        text, now_s = f"step {step}/{steps} {figures}", time.monotonic()
        if self._bar is not None:
            self._bar.update(self._task, total=steps, completed=step, description=text)
        elif step >= steps or now_s - self._shown_s >= self.EVERY_S:
            self._shown_s = now_s
            left = "" if remaining_s is None else f", {remaining_s / 60:.1f} min left"
            print(f"{self._prefix}{text}{left}", file=sys.stderr, flush=True)

    def __enter__(self) -> TrainingDisplay:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()
