"""The command line `companion`. Long commands have their own file; `flags.py` holds shared parts."""

from vision.gc_pause import gc_paused

with gc_paused():
    from companion.cli.commands import app, main

__all__ = ["app", "main"]
