"""Commands typed at the service's own terminal, answered there."""

from __future__ import annotations

import asyncio
import logging
import os
import sys
from collections.abc import Awaitable, Callable
from typing import Any

logger = logging.getLogger(__name__)

_BANNER = "type a command (help, quit): takeoff 5, seek car, approach car distance=5, hold, land, rtl, stop"
_READ_BYTES = 4096


async def run_console(
    command: Callable[[str], Awaitable[dict[str, Any]]],
    quit_service: Callable[[], None],
    help_text: str,
    on_event: Callable[[str, str], None],
) -> None:
    """Read commands until end of file or `quit`. A command runs while the next is typed.

    Answers go to standard error, which must not wait for its reader (`line_output.py`).
    Never raises: the terminal is a convenience, and whatever goes wrong there, the flight goes on.
    """
    try:
        await _read_commands(command, quit_service, help_text)
    except Exception as error:
        logger.exception("the console failed")
        on_event("warning", f"the console has ended: {type(error).__name__}: {error}")


async def _read_commands(
    command: Callable[[str], Awaitable[dict[str, Any]]], quit_service: Callable[[], None], help_text: str
) -> None:
    _print(_BANNER)
    running: set[asyncio.Task[None]] = set()

    async def answer(text: str) -> None:
        try:
            reply = await command(text)
        except Exception as error:
            logger.exception("command %r failed", text)
            reply = {"success": False, "reason": f"{type(error).__name__}: {error}"}
        sign = "done" if reply["success"] else "no"
        _print(f"{text}: {sign}: {reply['reason']}")

    typed: asyncio.Queue[str | None] = asyncio.Queue()
    loop, descriptor = asyncio.get_running_loop(), sys.stdin.fileno()
    partial = b""

    def on_readable() -> None:
        nonlocal partial
        try:
            data = os.read(descriptor, _READ_BYTES)
        except OSError:  # the terminal was closed
            data = b""
        *lines, partial = (partial + data).split(b"\n")
        for line in lines:
            typed.put_nowait(line.decode(errors="replace").strip())
        if not data:
            typed.put_nowait(None)
            loop.remove_reader(descriptor)

    # A terminal is readable when a whole line is there, so this does not wait. To make it non-blocking would
    # make it so for the shell as well.
    loop.add_reader(descriptor, on_readable)
    try:
        while (line := await typed.get()) is not None:
            if line in ("quit", "exit"):
                quit_service()
                return
            if line == "help":
                _print(help_text)
            elif line:
                task = asyncio.create_task(answer(line))
                running.add(task)
                task.add_done_callback(running.discard)
    finally:
        loop.remove_reader(descriptor)


def _print(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def terminal_is_free(source_uri: str) -> bool:
    """Standard input is a terminal and is not where the frames come from."""
    return source_uri != "-" and sys.stdin is not None and sys.stdin.isatty()
