"""`companion models pull`: one official file, fetched by its address, kept only if it is the one that was
meant.

What has come stays in `FILE.partial` when the line breaks, and the next attempt asks for the rest (RFC 9110,
14.2).
"""

from __future__ import annotations

import http.client
import os
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from companion.models.catalog import KnownModel
from vision.yolo.checkpoint_pair import file_sha256

_CHUNK_BYTES = 1 << 16
_TIMEOUT_S = 30.0
# A line that breaks is picked up again this often, as long as each attempt brings something.
_ATTEMPTS = 5

Progress = Callable[[int, int | None], None]
"""Called with the bytes that are there and the bytes there will be (None: not known)."""


class PullError(Exception):
    """A model that could not be fetched; the text says why and what to do."""


@dataclass(frozen=True, slots=True)
class Pulled:
    """A model that is there: its file, its SHA-256, and whether it had to be fetched."""

    path: Path
    sha256: str
    fetched: bool


def pull(
    model: KnownModel,
    folder: Path,
    *,
    progress: Progress = lambda done, total: None,
) -> Pulled:
    """Have `model` in `folder`.

    Raises:
        PullError: no way to the server, or another file than was meant.
    """
    target = folder / model.file
    if target.exists():
        return _already_there(target, model.sha256)
    if urllib.parse.urlsplit(model.url).scheme not in ("http", "https"):
        raise PullError(f"{model.url}: only http and https addresses are fetched")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        partial = target.with_name(f"{target.name}.partial")
        _fetch_all(model, target, partial, progress)
        found = file_sha256(partial)
        if found != model.sha256:
            partial.unlink()
            raise PullError(
                f"{model.url} is not the file that was meant: it has the SHA-256 {found}, expected "
                f"{model.sha256}. It was deleted. If an earlier attempt had been interrupted, pull once "
                "more; if this comes again, the file was changed, or somebody is between you and the server"
            )
        os.replace(partial, target)
    except OSError as error:
        raise PullError(f"{error.filename or folder}: {error.strerror or error}") from error
    return Pulled(target, found, fetched=True)


def manual_instructions(model: KnownModel, target: Path) -> str:
    """How to get the file without a network here."""
    return (
        f"Without a network: download {model.url} elsewhere and put it at {target}. It must have the SHA-256 "
        f"{model.sha256} and {model.size_bytes} bytes (`sha256sum {target.name}`)"
    )


def _already_there(target: Path, expected: str) -> Pulled:
    found = file_sha256(target)
    if found != expected:
        raise PullError(
            f"{target} is there with the SHA-256 {found}, expected {expected}: it is another file, or "
            "damaged. Move it away and pull again"
        )
    return Pulled(target, found, fetched=False)


def _fetch_all(model: KnownModel, target: Path, partial: Path, progress: Progress) -> None:
    """Fetch into `partial` what is missing of it."""
    failure = ""
    for _ in range(_ATTEMPTS):
        had = partial.stat().st_size if partial.exists() else 0
        try:
            if _fetch(model, partial, progress):
                return
            failure = "the connection ended early"
        except urllib.error.HTTPError as error:
            if error.code == 416 and had:  # What is there is not a beginning of what the server has.
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
        f"{model.url}: interrupted after {have} of {model.size_bytes} bytes ({failure}). They are kept: pull "
        f"again to go on. {manual_instructions(model, target)}"
    )


def _fetch(model: KnownModel, partial: Path, progress: Progress) -> bool:
    """One request; whether the file is whole then."""
    had = partial.stat().st_size if partial.exists() else 0
    if had and had == model.size_bytes:
        return True
    headers = {"User-Agent": "mavlink-companion", "Accept-Encoding": "identity"}
    if had:
        headers["Range"] = f"bytes={had}-"
    request = urllib.request.Request(model.url, headers=headers)
    with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as response:
        if response.status != 206 or not _continues(response.headers.get("Content-Range"), had):
            had = 0  # The server sends the whole file, or another part than was asked for.
        length = response.headers.get("Content-Length")
        total = had + int(length) if length is not None and length.isdecimal() else None
        if total is not None and total != model.size_bytes:
            raise PullError(
                f"{model.url} has {total} bytes there, expected {model.size_bytes}: it is another file"
            )
        done = had
        with partial.open("r+b" if had else "wb") as file:
            file.seek(had)
            progress(done, total)
            while chunk := response.read(_CHUNK_BYTES):
                done += len(chunk)
                if done > model.size_bytes:
                    raise PullError(f"{model.url} does not end after {done} bytes: it is another file")
                file.write(chunk)
                progress(done, total)
            file.flush()
            os.fsync(file.fileno())
    return done == total if total is not None else True


def _continues(content_range: str | None, start: int) -> bool:
    return bool(start) and content_range is not None and content_range.startswith(f"bytes {start}-")


def at_address(model: KnownModel, url: str) -> KnownModel:
    """The same model from another server: a mirror must have the same file."""
    return replace(model, url=url)
