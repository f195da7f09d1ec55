"""`companion models pull`: one official file, fetched by its address, kept only if it is the one that was
meant.

What has come stays in `FILE.partial` when the line breaks, and the next attempt asks for the rest (RFC 9110,
14.2).
"""

from __future__ import annotations

import http.client
import os
import re
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
_LARGEST_BYTES = 2 << 30
_LOOPBACK = ("localhost", "127.0.0.1", "::1")

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
    sha256: str | None = None,
    trust_first: bool = False,
    progress: Progress = lambda done, total: None,
) -> Pulled:
    """Have `model` in `folder`.

    Args:
        sha256: what the file must have, where the catalogue does not say.
        trust_first: take what comes where neither says, and note its SHA-256 for every later time.

    Raises:
        PullError: no digest to check by, no way to the server, another file than was meant.
    """
    target = folder / model.file
    expected = _expected(model, target, sha256, trust_first)
    if target.exists():
        return _already_there(target, expected, trust_first=trust_first)
    if urllib.parse.urlsplit(model.url).scheme not in ("http", "https"):
        raise PullError(f"{model.url}: only http and https addresses are fetched")
    if expected is None and not _is_private(model.url):
        raise PullError(f"{model.url}: without a known SHA-256 only https is fetched")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        partial = target.with_name(f"{target.name}.partial")
        _fetch_all(model, target, partial, expected, progress)
        found = file_sha256(partial)
        if expected is not None and found != expected:
            partial.unlink()
            raise PullError(
                f"{model.url} is not the file that was meant: it has the SHA-256 {found}, expected "
                f"{expected}. It was deleted. If an earlier attempt had been interrupted, pull once more; "
                "if this comes again, the file was changed, or somebody is between you and the server"
            )
        os.replace(partial, target)
        if expected is None:
            _note_path(target).write_text(f"{found}  {target.name}\n")
    except OSError as error:
        raise PullError(f"{error.filename or folder}: {error.strerror or error}") from error
    return Pulled(target, found, fetched=True)


def by_hand(model: KnownModel, target: Path, expected: str | None) -> str:
    """How to get the file without a network here."""
    size = "" if model.size_bytes is None else f" and {model.size_bytes} bytes"
    must = (
        f"It must have the SHA-256 {expected}{size}" if expected else "Compare its SHA-256 with one you trust"
    )
    return (
        f"Without a network: download {model.url} elsewhere and put it at {target}. {must} "
        f"(`sha256sum {target.name}`)"
    )


def _expected(model: KnownModel, target: Path, given: str | None, trust_first: bool) -> str | None:
    """The digest to check by, None for the first time of one that is to be trusted."""
    noted = _noted(_note_path(target))
    if given is not None:
        given = given.lower()
        if not re.fullmatch(r"[0-9a-f]{64}", given):
            raise PullError(f"a SHA-256 has 64 hexadecimal digits, got {given!r:.100}")
        for known, where in ((model.sha256, "this program"), (noted, f"{_note_path(target)}")):
            if known is not None and known != given:
                raise PullError(f"{model.name} has the SHA-256 {known} by {where}, you gave {given}")
    expected = model.sha256 or given or noted
    if expected is None and not trust_first:
        raise PullError(
            f"{model.name}: no published SHA-256 of this file is known here, so it cannot be checked. Give "
            "the one it must have with --sha256, or take what comes with --trust-first: its SHA-256 is "
            "then noted beside it, and a later pull must match"
        )
    return expected


def _already_there(target: Path, expected: str | None, *, trust_first: bool) -> Pulled:
    found = file_sha256(target)
    if expected is None and trust_first:
        _note_path(target).write_text(f"{found}  {target.name}\n")
    elif found != expected:
        raise PullError(
            f"{target} is there with the SHA-256 {found}, expected {expected}: it is another file, or "
            "damaged. Move it away and pull again"
        )
    return Pulled(target, found, fetched=False)


def _note_path(target: Path) -> Path:
    return target.with_name(f"{target.name}.sha256")


def _noted(path: Path) -> str | None:
    if not path.is_file():
        return None
    words = path.read_text(errors="replace").split()
    if not words or not re.fullmatch(r"[0-9a-f]{64}", words[0]):
        raise PullError(f"{path} has no SHA-256 in it; delete it")
    return words[0]


def _is_private(url: str) -> bool:
    parts = urllib.parse.urlsplit(url)
    return parts.scheme == "https" or parts.hostname in _LOOPBACK


def _fetch_all(
    model: KnownModel, target: Path, partial: Path, expected: str | None, progress: Progress
) -> None:
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
                f"{model.url}: the server says {error.code} {error.reason}. "
                f"{by_hand(model, target, expected)}"
            ) from None
        except (urllib.error.URLError, http.client.HTTPException, TimeoutError, ConnectionError) as error:
            reason = getattr(error, "reason", error)
            failure = f"{reason or type(error).__name__}"
            if isinstance(error, urllib.error.URLError) and not partial.exists():
                host = urllib.parse.urlsplit(model.url).hostname
                raise PullError(
                    f"cannot reach {host} ({failure}). {by_hand(model, target, expected)}"
                ) from None
        have = partial.stat().st_size if partial.exists() else 0
        if have <= had:
            break
    have = partial.stat().st_size if partial.exists() else 0
    whole = "" if model.size_bytes is None else f" of {model.size_bytes}"
    raise PullError(
        f"{model.url}: interrupted after {have}{whole} bytes ({failure}). They are kept: pull again to go "
        f"on. {by_hand(model, target, expected)}"
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
        if model.size_bytes is not None and total is not None and total != model.size_bytes:
            raise PullError(
                f"{model.url} has {total} bytes there, expected {model.size_bytes}: it is another file"
            )
        done = had
        with partial.open("r+b" if had else "wb") as file:
            file.seek(had)
            progress(done, total)
            while chunk := response.read(_CHUNK_BYTES):
                done += len(chunk)
                if done > (model.size_bytes or _LARGEST_BYTES):
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
