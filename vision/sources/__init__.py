"""Where frames come from: files, folders, cameras, pipes, networks, shared memory — one `open_source`.

A source of one's own is a `Feed`, and a function with the decorator `vision.sources.registry.source`.
"""

from vision.sources.feed import Feed, FeedLost, Picture
from vision.sources.latest import LatestSource
from vision.sources.opening import open_source
from vision.sources.sequential import SequentialSource
from vision.sources.source import EndOfStream, Source, SourceError, SourceSettings, SourceStatistics

__all__ = [
    "EndOfStream",
    "Feed",
    "FeedLost",
    "LatestSource",
    "Picture",
    "SequentialSource",
    "Source",
    "SourceError",
    "SourceSettings",
    "SourceStatistics",
    "open_source",
]
