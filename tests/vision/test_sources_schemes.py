"""Schemes of sources, including those of plug-ins."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, cast

import numpy as np
import pytest

from vision.sources import (
    Capture,
    RawFrame,
    SequentialSource,
    Source,
    SourceError,
    SourceSettings,
    open_source,
)
from vision.sources.registry import SOURCES, source


class OneGrey(Capture):
    """One grey image."""

    def read(self, timeout_s: float) -> RawFrame | None:
        return RawFrame(np.full((48, 64, 3), 128, np.uint8))

    def close(self) -> None:
        """Nothing stays open."""


@pytest.fixture
def grey() -> Iterator[str]:
    """The scheme of a source of grey images."""

    @source("grey", "grey images")
    def open_grey(uri: str, settings: SourceSettings) -> Source:
        return SequentialSource(uri, OneGrey, settings)

    yield "grey"
    SOURCES.remove("grey")


def test_registered_scheme_is_opened_with_address_and_settings(grey: str) -> None:
    seen: list[int] = []
    settings = SourceSettings(on_frame=lambda frame: seen.append(frame.sequence))
    with open_source(f"{grey}://any/where?x=1", settings) as frames:
        frame = frames.read()
    assert frames.uri == "grey://any/where?x=1"
    assert frame is not None
    assert (frame.width, frame.height, int(frame.image.mean())) == (64, 48, 128)
    assert seen == [0]


def test_unknown_scheme_lists_the_known_ones(grey: str) -> None:
    with pytest.raises(SourceError) as caught:
        open_source("gray://x")
    for scheme in ("file", "rtsp", "rtsps", "http", "https", "udp", "shm", "ros", grey):
        assert f" {scheme} (" in str(caught.value)
    assert "plugins.modules" in str(caught.value)


def test_wrong_result_of_a_plugin_is_one_line_and_is_closed() -> None:
    class Opened(np.ndarray[tuple[int, ...], np.dtype[np.uint8]]):
        closed = False

        def close(self) -> None:
            self.closed = True

    opened: list[Any] = [np.zeros((3, 4), np.uint8).view(Opened), Opened, None]

    def open_wrong(uri: str, settings: SourceSettings) -> Source:
        return cast(Source, opened[int(uri[-1])])

    source("wrong", "no source")(open_wrong)
    try:
        for number, kind in enumerate(("Opened", "type", "NoneType")):
            with pytest.raises(SourceError, match=rf"wrong:// .*Source, .*{kind} .+") as caught:
                open_source(f"wrong://{number}")
            assert "\n" not in str(caught.value)
    finally:
        SOURCES.remove("wrong")
    assert opened[0].closed


@pytest.mark.parametrize("scheme", ["shm", "ros", "Grey", "1grey", "grey://", ""])
def test_duplicate_or_malformed_scheme_is_rejected(scheme: str) -> None:
    before = SOURCES.known()

    def open_other(uri: str, settings: SourceSettings) -> Source:
        raise SourceError(uri)

    with pytest.raises(ValueError, match=r"test_sources_schemes\..*open_other"):
        source(scheme, "another")(open_other)
    assert SOURCES.known() == before
