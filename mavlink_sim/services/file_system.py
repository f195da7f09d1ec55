"""The files of a vehicle, in memory: read-only, without access to the host's disk.

Absolute and relative paths both begin at the root, as in PX4, and `..` never leads above it.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator

# A flight controller's card is mounted here; PX4's simulation has the same files at its root.
STORAGE = ("fs", "microsd")

Path = tuple[str, ...]


class FileSystem:
    """Files that are generated when read.

    Args:
        joins_root: a path without a leading "/" is below the root; else there is no such file, as in PX4's
            SITL before v1.16, which appends it to its root "." (".etc").
    """

    def __init__(self, *, joins_root: bool = True) -> None:
        self._joins_root = joins_root
        self._files: dict[Path, Callable[[], bytes]] = {}
        self._directories: set[Path] = {()}

    def provide(self, path: str, content: Callable[[], bytes]) -> None:
        """Add a file, generated whenever it is opened, and its folders."""
        parts = resolve(path)
        self._files[parts] = content
        self._add_directory(parts[:-1])

    def provide_directory(self, path: str) -> None:
        """Add a folder and those above it."""
        self._add_directory(resolve(path))

    def list(self, path: str) -> Iterator[tuple[str, int | None]]:
        """(name, size) of a folder's entries by name; a folder's size is None. ENOENT, ENOTDIR."""
        parts = self._parts(path)
        if parts not in self._directories:
            raise _error(errno.ENOTDIR, path) if parts in self._files else self._missing(parts, path)
        sizes: dict[str, int | None] = {
            directory[-1]: None for directory in self._directories if directory and directory[:-1] == parts
        }
        for file, content in self._files.items():
            if file[:-1] == parts:
                sizes[file[-1]] = len(content())
        return iter(sorted(sizes.items()))

    def read(self, path: str) -> bytes:
        """A file's content. ENOENT, ENOTDIR, EISDIR."""
        parts = self._parts(path)
        if parts in self._files:
            return self._files[parts]()
        raise _error(errno.EISDIR, path) if parts in self._directories else self._missing(parts, path)

    def _add_directory(self, parts: Path) -> None:
        self._directories.update(parts[:depth] for depth in range(1, len(parts) + 1))

    def _parts(self, path: str) -> Path:
        """The components of a path in a request. ENOENT if it is not below the root."""
        if path and not path.startswith("/") and not self._joins_root:
            raise _error(errno.ENOENT, path)
        return resolve(path)

    def _missing(self, parts: Path, path: str) -> OSError:
        """The error of a missing path: ENOTDIR if it leads through a file, else ENOENT."""
        through = any(parts[:depth] in self._files for depth in range(len(parts)))
        return _error(errno.ENOTDIR if through else errno.ENOENT, path)


def resolve(path: str) -> Path:
    """The components of a path from the root; the two mount points of the storage card are the same."""
    names: list[str] = []
    for name in path.split("/"):
        if name == "..":
            del names[-1:]
        elif name not in ("", "."):
            names.append(name)
    if tuple(names[:2]) == STORAGE:
        del names[:2]
    return tuple(names)


def _error(number: int, path: str) -> OSError:
    return OSError(number, os.strerror(number), path)
