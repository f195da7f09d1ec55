"""Changes of a settings file that keep everything else in it: comments, order, keys of others."""

from __future__ import annotations

import copy
import difflib
import os
import re
import secrets
import shutil
import stat
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from companion.settings.fields import toml_value
from companion.settings.toml_text import parse_toml

MARK = "# companion init"
"""Begins the comments of `companion init`; one above a key that it changes is replaced."""
_HEADER = f"{MARK}: only what differs from the defaults, which `companion describe settings` prints.\n"
_TABLE = re.compile(r"\s*\[\s*([\w.\-]+)\s*\]\s*(?:#.*)?$")


class MergeError(ValueError):
    """A file is written in a way in which a value cannot be changed safely. The text has what to write."""


@dataclass(frozen=True, slots=True)
class Change:
    """A key that is written.

    Attributes:
        key: dotted, `vehicle.url`. value: as in the file. reason: why, one line for a comment.
    """

    key: str
    value: Any
    reason: str


def merged(text: str, changes: Sequence[Change]) -> str:
    """Return a TOML text with changes, each below a comment with its reason. What is equal already stays.

    Raises:
        MergeError: the text cannot be changed so that it then has exactly these values.
        tomllib.TOMLDecodeError: it is not TOML.
    """
    before = parse_toml(text)
    wanted = copy.deepcopy(before)
    lines = text.splitlines(keepends=True)
    if not text:
        lines = [_HEADER]
    elif not lines[-1].endswith("\n"):
        lines[-1] += "\n"
    for change in changes:
        table, _, name = change.key.rpartition(".")
        if value_in(before, change.key) == change.value:
            continue
        section = wanted
        for word in table.split("."):
            section = section.setdefault(word, {})
        section[name] = change.value
        _set(lines, table, name, change)
    after = "".join(lines)
    try:
        agrees = parse_toml(after) == wanted
    except ValueError:
        agrees = False
    if not agrees:
        listed = "; ".join(f"{each.key} = {toml_value(each.value)}" for each in changes)
        raise MergeError(f"its form is not one that can be changed line by line; change it by hand: {listed}")
    return after if after.strip() != _HEADER.strip() else text


def value_in(tables: Mapping[str, Any], key: str) -> Any:
    """Return a value of parsed TOML by its dotted key; None: it is not there."""
    found: Any = tables
    for word in key.split("."):
        if not isinstance(found, Mapping) or word not in found:
            return None
        found = found[word]
    return found


def _set(lines: list[str], table: str, name: str, change: Change) -> None:
    """Set a key of a table in the lines of a file, which has it at most once."""
    own = [f"{MARK}: {' '.join(change.reason.split())}\n", f"{name} = {toml_value(change.value)}\n"]
    start = next((at for at, line in enumerate(lines) if _is_table(line, table)), None)
    if start is None:
        if lines and lines[-1].strip():
            lines.append("\n")
        lines += [f"[{table}]\n", *own]
        return
    end = next((at for at in range(start + 1, len(lines)) if lines[at].lstrip().startswith("[")), len(lines))
    for at in range(start + 1, end):
        if re.match(rf"\s*{re.escape(name)}\s*=", lines[at]):
            first = at - 1 if lines[at - 1].startswith(MARK) and at - 1 > start else at
            lines[first : at + 1] = own
            return
    lines[start + 1 : start + 1] = own


def _is_table(line: str, table: str) -> bool:
    match = _TABLE.match(line)
    return match is not None and match[1] == table


def difference(before: str, after: str, path: Path) -> Iterator[str]:
    """Yield the changed lines as `diff -u` prints them."""
    yield from difflib.unified_diff(
        before.splitlines(), after.splitlines(), str(path), str(path), "before", "after", lineterm="", n=2
    )


def write(path: Path, text: str, now_s: float | None = None) -> Path | None:
    """Write a settings file at once, and keep the former one beside it under a name with the time.

    Both have its owner and mode; a link is followed. A new file of root can be read by the service's user.

    Returns:
        The copy of the former file; None: there was none.

    Raises:
        OSError: the folder or the file cannot be written. The former file is then unchanged.
    """
    path = path.resolve()
    path.parent.mkdir(parents=True, exist_ok=True)
    kept = None
    former = path.read_bytes() if path.exists() else None
    partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}.partial")
    _create(partial, text.encode(), like=path)
    try:
        if former is not None:
            copied = _free_name(path, time.time() if now_s is None else now_s)
            _create(copied, former, like=path)
            kept = copied
            shutil.copystat(path, kept)
        os.replace(partial, path)
    except BaseException:
        if (
            kept is not None and partial.exists()
        ):  # else it is at its place, and the copy the only former file
            kept.unlink(missing_ok=True)
        raise
    finally:
        partial.unlink(missing_ok=True)
    return kept


def _create(path: Path, data: bytes, *, like: Path) -> None:
    """Write a new file with owner and mode of another, which may be missing. Never through a link.

    Raises:
        OSError: it is there, or cannot be written; then nothing is left of it.
    """
    former = like.stat() if like.exists() else None
    # The file may have an address with a password: nobody else reads it before it has its mode.
    mode = 0o666 if former is None else 0o600
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
    try:
        with open(descriptor, "wb") as opened:
            opened.write(data)
            if former is not None:
                with suppress(PermissionError):  # another user's file, in a folder of ours
                    os.fchown(descriptor, former.st_uid, former.st_gid)
                os.fchmod(descriptor, stat.S_IMODE(former.st_mode))
            elif os.geteuid() == 0:
                os.fchmod(descriptor, 0o644)  # whatever root's umask is
            opened.flush()
            os.fsync(descriptor)
    except BaseException:
        path.unlink(missing_ok=True)
        raise


def _free_name(path: Path, now_s: float) -> Path:
    stamp = time.strftime("%Y%m%d-%H%M%S", time.localtime(now_s))
    names = (f"{path.name}.{stamp}{suffix}" for suffix in ("", *(f"-{number}" for number in range(2, 100))))
    return next(each for each in map(path.with_name, names) if not os.path.lexists(each))
