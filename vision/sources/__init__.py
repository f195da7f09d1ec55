"""Where frames come from: files, folders, cameras, pipes, networks, shared memory — one `open_source`."""

from vision.sources.opening import open_source
from vision.sources.source import EndOfStream, Source, SourceError, SourceSettings, SourceStatistics

__all__ = ["EndOfStream", "Source", "SourceError", "SourceSettings", "SourceStatistics", "open_source"]
