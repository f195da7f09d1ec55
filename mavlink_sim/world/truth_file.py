"""The truth file; a write error ends the file, not the simulation."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mavlink_sim.world.world import WorldObject


class TruthFile:
    """A file of lines; each is flushed when `write` returns.

    Raises:
        OSError: it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._file: IO[str] | None = path.open("w", encoding="utf-8")

    def write(self, line: str) -> str | None:
        """Write one line. Returns the error message, once, if writing has ended."""
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
            with suppress(OSError):  # the rest of its buffer is lost
                file.close()


def object_truth(scene_object: WorldObject, position_ned_m: Sequence[float]) -> dict[str, Any]:
    """The truth entry of an object, with its horizontal range from a vehicle at (3,) NED metres."""
    from mavlink_sim.world.world import range_to

    entry: dict[str, Any] = {
        "identifier": scene_object.identifier,
        "class_name": scene_object.class_name,
        "position_ned_m": [round(float(value), 3) for value in scene_object.position_ned_m],
        "range_m": round(float(range_to(scene_object, position_ned_m)), 3),
    }
    if scene_object.system_id is not None:
        entry["system_id"] = scene_object.system_id
    return entry
