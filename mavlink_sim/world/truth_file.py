"""Lines of truth on a file; a disk that takes no more ends the file, not the flight."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import IO


class TruthFile:
    """Each line is on its way to the disk when `write` returns.

    Raises:
        OSError: it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: IO[str] | None = path.open("w", encoding="utf-8")

    def write(self, line: str) -> str | None:
        """Write one line. Returns why nothing more is written, once, if this was the last attempt."""
        if self._file is None:
            return None
        try:
            self._file.write(line + "\n")
            self._file.flush()
        except OSError as error:
            self.close()
            return f"the truth is no longer written to {self._path}: {error.strerror or error}"
        return None

    def close(self) -> None:
        """May be called more than once."""
        file, self._file = self._file, None
        if file is not None:
            with suppress(OSError):  # what is left in its buffer has nowhere to go
                file.close()
