"""The command line: `companion`, one file for each command that is long; `flags.py` holds what they share."""

from vision.loading import uncollected

with uncollected():
    from companion.cli.commands import app, main

__all__ = ["app", "main"]
