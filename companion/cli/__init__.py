"""The command line: `companion`, one file for each command that is long; `flags.py` holds what they share."""

from vision.gc_pause import gc_paused

with gc_paused():
    from companion.cli.commands import app, main

__all__ = ["app", "main"]
