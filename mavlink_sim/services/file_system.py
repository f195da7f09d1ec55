"""A file system in memory, for MAVLink FTP, without access to the host's disk.

Absolute and relative paths both begin at the root, as in PX4. `..` never leads above it. Errors are OSErrors
with the errno of POSIX.
"""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterator

CAPACITY_BYTES = 16 * 1024 * 1024
MAX_ENTRIES = 2000
MAX_NAME_BYTES = 220  # with its size it must fit into one answer to a list request
# A flight controller's card is mounted here; PX4's simulation has the same files at its root.
STORAGE = ("fs", "microsd")

Path = tuple[str, ...]


class FileSystem:
    """Files written by clients, and read-only files provided by the vehicle, which are generated when read.

    Args:
        capacity_bytes: limit of all written files together; more is ENOSPC.
    """

    def __init__(self, capacity_bytes: int = CAPACITY_BYTES) -> None:
        self._capacity_bytes = capacity_bytes
        self._files: dict[Path, bytearray] = {}
        self._provided: dict[Path, Callable[[], bytes]] = {}
        self._directories: set[Path] = {()}

    # ---- provided files

    def provide(self, path: str, content: Callable[[], bytes]) -> None:
        """Provide a read-only file, generated whenever it is opened; its folders are created."""
        parts = resolve(path)
        for depth in range(1, len(parts)):
            self._directories.add(parts[:depth])
        self._provided[parts] = content

    def is_protected(self, path: str) -> bool:
        """Whether this is a provided file, or a folder with one in it."""
        parts = resolve(path)
        return any(provided[: len(parts)] == parts for provided in self._provided)

    # ---- reading

    def list(self, path: str) -> Iterator[tuple[str, int | None]]:
        """(name, size) of a folder's entries by name; a folder's size is None. ENOENT, ENOTDIR."""
        parts = self._directory(path)
        entries = {
            directory[-1]: None for directory in self._directories if directory[:-1] == parts != directory
        }
        sizes: dict[str, int | None] = dict(entries)
        for found, content in self._files.items():
            if found[:-1] == parts:
                sizes[found[-1]] = len(content)
        for found, provider in self._provided.items():
            if found[:-1] == parts:
                sizes[found[-1]] = len(provider())
        return iter(sorted(sizes.items()))

    def read(self, path: str) -> bytes | bytearray:
        """A file's content: the live buffer of a written one. ENOENT, EISDIR."""
        parts = resolve(path)
        if parts in self._files:
            return self._files[parts]
        if parts in self._provided:
            return self._provided[parts]()
        raise _error(errno.EISDIR, path) if parts in self._directories else self._missing(parts, path)

    # ---- writing

    def create(self, path: str, truncate: bool) -> bytearray:
        """Open for writing, creating the file if there is none. ENOENT (folder), EISDIR, ENOSPC, EROFS."""
        parts = self._writable(path)
        if parts in self._directories:
            raise _error(errno.EISDIR, path)
        if parts not in self._files:
            self._check_new(parts, path)
            self._files[parts] = bytearray()
        elif truncate:
            self.resize(self._files[parts], 0)
        return self._files[parts]

    def resize(self, content: bytearray, size: int) -> None:
        """Truncate a written file or pad it with zeros. ENOSPC."""
        growth = size - len(content)
        # the sum does not include a file removed while open, so its buffer is limited separately
        if growth > 0 and max(size, growth + sum(map(len, self._files.values()))) > self._capacity_bytes:
            raise _error(errno.ENOSPC, f"{growth} more bytes")
        if growth > 0:
            content.extend(bytes(growth))
        else:
            del content[size:]

    def write(self, content: bytearray, offset: int, data: bytes) -> int:
        """Write into an open file, padded with zeros up to the offset. ENOSPC."""
        end = offset + len(data)
        if end > len(content):
            self.resize(content, end)
        content[offset:end] = data
        return len(data)

    def truncate(self, path: str, size: int) -> None:
        parts = self._writable(path)
        if parts not in self._files:
            raise _error(errno.EISDIR, path) if parts in self._directories else self._missing(parts, path)
        self.resize(self._files[parts], size)

    def remove(self, path: str) -> None:
        parts = self._writable(path)
        if parts not in self._files:
            raise _error(errno.EISDIR, path) if parts in self._directories else self._missing(parts, path)
        del self._files[parts]  # a session that has it open keeps it, as in POSIX

    def make_directory(self, path: str) -> None:
        parts = resolve(path)
        if parts in self._directories or parts in self._files or parts in self._provided:
            raise _error(errno.EEXIST, path)
        self._check_new(parts, path)
        self._directories.add(parts)

    def remove_directory(self, path: str) -> None:
        parts = self._writable(path)
        if parts in self._files:
            raise _error(errno.ENOTDIR, path)
        if parts not in self._directories:
            raise self._missing(parts, path)
        self._check_empty(parts, path)
        if not parts:
            raise _error(errno.EBUSY, path)  # the root
        self._directories.remove(parts)

    def rename(self, old: str, new: str) -> None:
        """Rename a file or a folder; it replaces another file or an empty folder."""
        source, target = self._writable(old), self._writable(new)
        for parts, path in ((source, old), (target, new)):
            self._check_parent(parts, path)
        is_folder = source in self._directories
        if not is_folder and source not in self._files:
            raise _error(errno.ENOENT, old)
        if target == source:
            return
        if target[: len(source)] == source:
            raise _error(errno.EINVAL, new)
        if source[: len(target)] == target:
            raise _error(errno.ENOTEMPTY, new)
        if target in self._files and is_folder:
            raise _error(errno.ENOTDIR, new)
        if target in self._directories:
            if not is_folder:
                raise _error(errno.EISDIR, new)
            self._check_empty(target, new)
        elif target not in self._files:
            self._check_new(target, new)
        depth = len(source)
        self._directories = {
            target + parts[depth:] if parts[:depth] == source else parts for parts in self._directories
        }
        self._files = {
            target + parts[depth:] if parts[:depth] == source else parts: content
            for parts, content in self._files.items()
            if parts != target
        }

    # ---- within

    def _entries(self) -> Iterator[Path]:
        yield from (parts for parts in self._directories if parts)
        yield from self._files
        yield from self._provided

    def _directory(self, path: str) -> Path:
        parts = resolve(path)
        if parts not in self._directories:
            known = parts in self._files or parts in self._provided
            raise _error(errno.ENOTDIR, path) if known else self._missing(parts, path)
        return parts

    def _writable(self, path: str) -> Path:
        if self.is_protected(path):
            raise _error(errno.EROFS, path)
        return resolve(path)

    def _missing(self, parts: Path, path: str) -> OSError:
        """The error of a missing path: ENOTDIR if it leads through a file, else ENOENT."""
        through = any(
            parts[:depth] in self._files or parts[:depth] in self._provided for depth in range(len(parts))
        )
        return _error(errno.ENOTDIR if through else errno.ENOENT, path)

    def _check_parent(self, parts: Path, path: str) -> None:
        if parts[:-1] not in self._directories:
            raise self._missing(parts, path)

    def _check_empty(self, parts: Path, path: str) -> None:
        if any(other[:-1] == parts for other in self._entries()):
            raise _error(errno.ENOTEMPTY, path)

    def _check_new(self, parts: Path, path: str) -> None:
        self._check_parent(parts, path)
        if len(parts[-1].encode(errors="surrogateescape")) > MAX_NAME_BYTES:
            raise _error(errno.ENAMETOOLONG, path)
        if len(self._files) + len(self._directories) >= MAX_ENTRIES:
            raise _error(errno.ENOSPC, path)


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
