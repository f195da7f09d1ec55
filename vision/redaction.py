"""Removes secrets from what leaves the program: addresses in names, log lines, events, messages, errors."""

from __future__ import annotations

import re
import sys
import traceback

HIDDEN = "***"

_SECRET_KEY = (
    r"(?:pass(?:word|wd|phrase|code)?|passw|pas|pwd|pw|psk|secret|token|key|auth|authorization|signature|sig"
    r"|credentials?|jwt)"
)
_PARAMETER = (
    r"([\w.%\[\]-]*?" + _SECRET_KEY + r"\]?)=(?:\\\"|[^&\s\"<>])+?"
    # A list of `_key=value` is how some cameras write it; punctuation at the end is the sentence's.
    r"(?=[:;,.')\]}]*(?:[&\s\"<>]|$)|_\w+=)"
)
_URL = re.compile(r"\b(?!(?:file|serial|shm)://)[A-Za-z][A-Za-z0-9+.-]*://[^\s]*")
# zenoh writes tcp/HOST:PORT.
_USER_INFO = re.compile(
    r"((?:\b(?!(?:file|serial|shm):)[A-Za-z][A-Za-z0-9+.-]*://|\b(?:tcp|tls|udp|quic|wss?)/)[^\s/?#@:\"]*)"
    r":(?!PASSWORD@)(?:\\\"|[^\s\"])*@"
)
_IN_QUERY = re.compile(r"(?<=[?&;])" + _PARAMETER, re.IGNORECASE)
_IN_URL = re.compile(r"(?<=[?&;#/_])" + _PARAMETER, re.IGNORECASE)
_HEADER = re.compile(r"(authorization: *\w+ +)[^\s\"']+", re.IGNORECASE)
_WHOLE = re.compile(r"([A-Za-z][A-Za-z0-9+.-]*://[^/?#@:]*):(?!PASSWORD@).*@", re.DOTALL)


def redacted(text: str) -> str:
    """The text with the passwords, tokens and keys of every address in it replaced by stars.

    An address ends at a space or a quotation mark. Paths of files and serial lines are not changed.

    >>> redacted("rtsp://me:pw@camera/1: lost; http://camera/v?user=me&pwd=pw: lost")
    'rtsp://me:***@camera/1: lost; http://camera/v?user=me&pwd=***: lost'
    """
    if not any(mark in text for mark in ("://", "=", "@", "uthorization")):
        return text
    text = _USER_INFO.sub(rf"\1:{HIDDEN}@", text)
    text = _URL.sub(lambda url: _IN_URL.sub(rf"\1={HIDDEN}", url[0]), text)
    return _HEADER.sub(rf"\1{HIDDEN}", _IN_QUERY.sub(rf"\1={HIDDEN}", text))


def without_password(uri: str) -> str:
    """One address for display, as `redacted`, also if its password has spaces or quotation marks."""
    return redacted(_WHOLE.sub(rf"\1:{HIDDEN}@", uri) if not uri.startswith("file://") else uri)


def print_traceback() -> None:
    """Print the exception that is being handled to standard error, redacted."""
    print(redacted(traceback.format_exc()), end="", file=sys.stderr, flush=True)
