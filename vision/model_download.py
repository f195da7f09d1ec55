"""Downloads one official model and verifies its size and SHA-256.

An interrupted download stays in `FILE.partial`, and the next attempt requests the rest (RFC 9110, 14.2).
"""

from __future__ import annotations

import http.client
import os
import stat
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

from vision.catalog import KnownModel
from vision.yolo.checkpoint_pair import file_sha256

_CHUNK_BYTES = 1 << 16
_TIMEOUT_S = 30.0
# Number of attempts to resume an interrupted download, as long as each one receives data.
_ATTEMPTS = 5

Progress = Callable[[int, int | None], None]
"""Called with the received and the total bytes (None: unknown)."""


class PullError(Exception):
    """A model could not be downloaded; the text gives the reason and what to do."""


@dataclass(frozen=True, slots=True)
class Pulled:
    """A local model file, its SHA-256, and whether it was downloaded now."""

    path: Path
    sha256: str
    fetched: bool


def pull(
    model: KnownModel,
    folder: Path,
    *,
    progress: Progress = lambda done, total: None,
) -> Pulled:
    """Download `model` into `folder` unless it is there; verify it.

    Raises:
        PullError: the server cannot be reached, or the file differs.
    """
    target = folder / model.file
    if target.exists():
        return _verify_existing(target, model.sha256)
    if urllib.parse.urlsplit(model.url).scheme not in ("http", "https"):
        raise PullError(f"{model.url}: expected an http or https address")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        partial = target.with_name(f"{target.name}.partial")
        _remove_foreign(partial)
        _fetch_all(model, target, partial, progress)
        found = file_sha256(partial)
        if found != model.sha256:
            partial.unlink()
            raise PullError(
                f"{model.url}: SHA-256 {found}, expected {model.sha256}; the file was deleted. If an "
                "earlier attempt was interrupted, pull again; otherwise the file was changed on the server "
                "or in transit"
            )
        os.replace(partial, target)
    except OSError as error:
        raise PullError(f"{error.filename or folder}: {error.strerror or error}") from error
    return Pulled(target, found, fetched=True)


def _remove_foreign(partial: Path) -> None:
    """Remove what is not an interrupted download: a link would be followed to a file of somebody else."""
    with suppress(FileNotFoundError):
        status = partial.lstat()
        if not stat.S_ISREG(status.st_mode) or status.st_nlink != 1:
            partial.unlink()


def _open_partial(partial: Path, had: int) -> BinaryIO:
    """Open the file to write after `had` bytes; never through a link."""
    flags = os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC | (0 if had else os.O_TRUNC)
    return os.fdopen(os.open(partial, flags, 0o644), "r+b")


def manual_instructions(model: KnownModel, target: Path) -> str:
    """Return instructions for a manual download."""
    return (
        f"Manual download: copy {model.url} to {target}; expected SHA-256 {model.sha256} and "
        f"{model.size_bytes} bytes (`sha256sum {target.name}`)"
    )


def _verify_existing(target: Path, expected: str) -> Pulled:
    found = file_sha256(target)
    if found != expected:
        raise PullError(
            f"{target}: SHA-256 {found}, expected {expected}: another or a damaged file. Move it away and "
            "pull again"
        )
    return Pulled(target, found, fetched=False)


def _fetch_all(model: KnownModel, target: Path, partial: Path, progress: Progress) -> None:
    """Download the missing part into `partial`."""
    failure = ""
    for _ in range(_ATTEMPTS):
        had = partial.stat().st_size if partial.exists() else 0
        try:
            if _fetch(model, partial, progress):
                return
            failure = "the connection ended early"
        except urllib.error.HTTPError as error:
            if error.code == 416 and had:  # The partial file does not match the server's file.
                partial.unlink()
                continue
            raise PullError(
                f"{model.url}: HTTP {error.code} {error.reason}. {manual_instructions(model, target)}"
            ) from None
        except (urllib.error.URLError, http.client.HTTPException, TimeoutError, ConnectionError) as error:
            reason = getattr(error, "reason", error)
            failure = f"{reason or type(error).__name__}"
            if isinstance(error, urllib.error.URLError) and not partial.exists():
                host = urllib.parse.urlsplit(model.url).hostname
                raise PullError(
                    f"cannot reach {host} ({failure}). {manual_instructions(model, target)}"
                ) from None
        have = partial.stat().st_size if partial.exists() else 0
        if have <= had:
            break
    have = partial.stat().st_size if partial.exists() else 0
    raise PullError(
        f"{model.url}: interrupted after {have} of {model.size_bytes} bytes ({failure}). Pull again "
        f"to resume. {manual_instructions(model, target)}"
    )


def _fetch(model: KnownModel, partial: Path, progress: Progress) -> bool:
    """Send one request; return whether the file is complete."""
    had = partial.stat().st_size if partial.exists() else 0
    if had and had == model.size_bytes:
        return True
    headers = {"User-Agent": "mavlink-companion", "Accept-Encoding": "identity"}
    if had:
        headers["Range"] = f"bytes={had}-"
    request = urllib.request.Request(model.url, headers=headers)
    with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as response:
        if response.status != 206 or not _continues(response.headers.get("Content-Range"), had):
            had = 0  # The server sends the whole file, or a part that was not requested.
        length = response.headers.get("Content-Length")
        total = had + int(length) if length is not None and length.isdecimal() else None
        if total is not None and total != model.size_bytes:
            raise PullError(f"{model.url}: {total} bytes, expected {model.size_bytes}: another file")
        done = had
        with _open_partial(partial, had) as file:
            file.seek(had)
            progress(done, total)
            while chunk := response.read(_CHUNK_BYTES):
                done += len(chunk)
                if done > model.size_bytes:
                    raise PullError(
                        f"{model.url}: more than {done} bytes, expected {model.size_bytes}: another file"
                    )
                file.write(chunk)
                progress(done, total)
            file.flush()
            os.fsync(file.fileno())
    return done == total if total is not None else True


def _continues(content_range: str | None, start: int) -> bool:
    return bool(start) and content_range is not None and content_range.startswith(f"bytes {start}-")


def at_address(model: KnownModel, url: str) -> KnownModel:
    """Return the same model at another address: a mirror must have the same file."""
    return replace(model, url=url)
