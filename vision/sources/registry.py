"""The registry of address schemes: a decorator adds one, for built-in sources and plug-ins."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from vision.registry import Registry
from vision.sources.source import Source, SourceSettings

OpenSource = Callable[[str, SourceSettings], Source]
"""Opens an address. Raises SourceError, in one line, if it cannot."""

SOURCES: Registry[OpenSource] = Registry(
    "source scheme", r"[a-z][a-z0-9+.-]*", "lower-case letters, digits, `+`, `.` and `-` (RFC 3986)"
)
"""Scheme → opener."""

_Opener = TypeVar("_Opener", bound=OpenSource)


def source(scheme: str, help_text: str) -> Callable[[_Opener], _Opener]:
    """Decorator: let `open_source` open `scheme://…` with a function or class.

    It is called with the whole address and the `SourceSettings`, and returns an open `Source` whose first
    frame has arrived. Most pass a `Capture` to `LatestSource` (a camera: the newest frame wins, a lost
    capture is reopened) or to `SequentialSource` (a recording: every frame), which implement the timeouts and
    `on_frame` of `SourceSettings`. A `Source` of another class must do that itself.

        @source("squares", "a square that moves")
        def open_squares(uri: str, settings: SourceSettings) -> Source:
            return LatestSource(uri, SquareCapture, settings, paced=True)

    Args:
        scheme: the part before `://`, lower case.
        help_text: what it delivers, one line without a full stop.

    Raises:
        ValueError: not a scheme by RFC 3986, or already registered.
    """

    def register(opener: _Opener) -> _Opener:
        SOURCES.add(scheme, help_text, opener)
        return opener

    return register
