"""The rule for files that hold a secret: a MAVLink signing key, a token, a private key of TLS."""

from __future__ import annotations

import ipaddress
import os
import stat
from codecs import BOM_UTF8
from pathlib import Path

from vision.file_kinds import kind_of_bytes, open_file

SHORTEST_TOKEN = 16
_LONGEST_FILE_BYTES = 4 * 1024


class KeyFileError(ValueError):
    """A secret cannot be used. The message is one line; it never contains the secret."""


def check_private(path: Path, status: os.stat_result) -> None:
    """Check that only the owner can read a file. Raises KeyFileError."""
    if status.st_mode & 0o077:
        mode = stat.S_IMODE(status.st_mode)
        raise KeyFileError(f"{path}: others can read it (mode {mode:o}): chmod 600 {path}")


def read_secret(path: Path, name: str, *, shortest: int = 1) -> str:
    """Read a secret of one line: printable ASCII, in a file that only its owner can read.

    Args:
        name: of the setting, for errors. shortest: characters.

    Raises:
        KeyFileError: the file or its content is not acceptable.
    """
    try:
        with open_file(path) as file:
            status = os.fstat(file.fileno())
            content = file.read(_LONGEST_FILE_BYTES + 1) if stat.S_ISREG(status.st_mode) else b""
    except OSError as error:
        raise KeyFileError(f"{name} {path}: cannot be read: {error.strerror}") from error
    try:
        check_private(path, status)
    except KeyFileError as error:
        raise KeyFileError(f"{name} {error}") from None
    secret = content.removeprefix(BOM_UTF8).decode("ascii", "replace").strip()
    if content and (kind := kind_of_bytes(content)) is not None:
        raise KeyFileError(f"{name} {path}: {kind}")
    if len(content) > _LONGEST_FILE_BYTES or not secret.isprintable() or "\ufffd" in secret:
        raise KeyFileError(f"{name} {path}: expected one line of ASCII")
    if not secret and shortest == 1:
        raise KeyFileError(f"{name} {path}: is empty")
    if len(secret) < shortest:
        raise KeyFileError(
            f"{name} {path}: expected at least {shortest} characters, got {len(secret)}; "
            f"for example: openssl rand -hex 16 > {path}"
        )
    return secret


def read_token(path: str | Path, name: str) -> str:
    """Read the token of a server: a secret of at least 16 characters without spaces.

    Args:
        name: of the setting or option, for errors.

    Raises:
        KeyFileError: the file or its content is not acceptable.
    """
    token = read_secret(Path(path), name, shortest=SHORTEST_TOKEN)
    if " " in token:
        raise KeyFileError(f"{name} {path}: expected one line of ASCII without spaces")
    return token


def is_loopback(host: str) -> bool:
    """Whether only this computer can reach a server on this host; any other needs a token."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
