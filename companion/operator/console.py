"""A console for commands on the service's own terminal."""

from __future__ import annotations

import asyncio
import logging
import os
import sys
from collections.abc import Awaitable, Callable
from typing import Any

from aioconsole.stream import StandardStreamReader, StandardStreamReaderProtocol

logger = logging.getLogger(__name__)

_BANNER = "type a command (help, quit): takeoff 5, seek car, approach car distance=5, hold, land, rtl, stop"


async def run_console(
    command: Callable[[str], Awaitable[dict[str, Any]]],
    quit_service: Callable[[], None],
    help_text: str,
    on_event: Callable[[str, str], None],
) -> None:
    """Read commands until end of file or `quit`. A command runs while the next is typed.

    Answers go to standard error, which must not wait for its reader (`line_output.py`).
    Never raises: an error of the console must not affect the flight.
    """
    try:
        await _read_commands(command, quit_service, help_text)
    except Exception as error:
        logger.exception("the console failed")
        on_event("warning", f"console ended: {type(error).__name__}: {error}")


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
        result = "done" if reply["success"] else "failed"
        _print(f"{text}: {result}: {reply['reason']}")

    reader = StandardStreamReader()
    loop = asyncio.get_running_loop()
    # The terminal is opened again: the reader makes it non-blocking, which must not affect standard error and
    # the shell.
    terminal = open(os.ttyname(sys.stdin.fileno()), "rb", buffering=0)  # noqa: ASYNC230, SIM115
    transport, _ = await loop.connect_read_pipe(lambda: StandardStreamReaderProtocol(reader), terminal)
    try:
        while line := (await _line_of(reader)):
            text = line.decode(errors="replace").strip()
            if text in ("quit", "exit"):
                quit_service()
                return
            if text == "help":
                _print(help_text)
            elif text:
                task = asyncio.create_task(answer(text))
                running.add(task)
                task.add_done_callback(running.discard)
    finally:
        transport.close()


async def _line_of(reader: asyncio.StreamReader) -> bytes:
    """Return the next line; empty at end of file, or if the terminal was closed (EIO)."""
    try:
        return await reader.readline()
    except OSError:
        return b""


def _print(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def terminal_is_free(source_uri: str) -> bool:
    """Whether standard input is a terminal and not the source of frames."""
    return source_uri != "-" and sys.stdin is not None and sys.stdin.isatty()
