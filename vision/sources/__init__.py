"""Frame sources: files, folders, cameras, pipes, network streams, shared memory, opened by `open_source`.

A custom source is a `Capture`, and a function with the decorator `vision.sources.registry.source`.
"""

from vision.sources.capture import Capture, CaptureError, RawFrame
from vision.sources.latest import LatestSource
from vision.sources.opening import check_there, open_source
from vision.sources.sequential import SequentialSource
from vision.sources.source import (
    EndOfStream,
    Source,
    SourceError,
    SourceSettings,
    SourceStatistics,
    SourceUnavailableError,
)

__all__ = [
    "Capture",
    "CaptureError",
    "EndOfStream",
    "LatestSource",
    "RawFrame",
    "SequentialSource",
    "Source",
    "SourceError",
    "SourceSettings",
    "SourceStatistics",
    "SourceUnavailableError",
    "check_there",
    "open_source",
]
