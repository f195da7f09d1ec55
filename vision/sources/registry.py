"""The schemes of addresses: a decorator that adds one, for the built-in sources and those of plug-ins."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from vision.registry import Registry
from vision.sources.source import Source, SourceSettings

OpenSource = Callable[[str, SourceSettings], Source]
"""Opens an address. Raises SourceError, in one line, where it cannot."""

SOURCES: Registry[OpenSource] = Registry(
    "source scheme", r"[a-z][a-z0-9+.-]*", "lower-case letters, digits, `+`, `.` and `-` (RFC 3986)"
)
"""Scheme → what opens its addresses."""

_Opener = TypeVar("_Opener", bound=OpenSource)


def source(scheme: str, help_text: str) -> Callable[[_Opener], _Opener]:
    """Let `open_source` open `scheme://…` by the decorated function or class.

    It is called with the whole address and the `SourceSettings`, and returns an open `Source` whose first
    frame is there. Most hand a `Capture` of theirs to `LatestSource` (a camera: the newest frame wins, a lost
    feed is opened again) or to `SequentialSource` (a recording: every frame), which do what `SourceSettings`
    says of time-outs and `on_frame`. A `Source` of another class must do that itself.

        @source("squares", "a square that moves")
        def open_squares(uri: str, settings: SourceSettings) -> Source:
            return LatestSource(uri, SquareCapture, settings, paced=True)

    Args:
        scheme: what stands before `://`, lower case.
        help_text: what it gives, one line without a full stop.

    Raises:
        ValueError: no scheme by RFC 3986, or another source has it.
    """

    def register(opener: _Opener) -> _Opener:
        SOURCES.add(scheme, help_text, opener)
        return opener

    return register
