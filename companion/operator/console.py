"""Commands typed at the service's own terminal, answered there."""

from __future__ import annotations

import asyncio
import logging
import sys
from collections.abc import Awaitable, Callable
from typing import Any

import aioconsole

logger = logging.getLogger(__name__)

_BANNER = "type a command (help, quit): takeoff 5, seek car, approach car distance=5, hold, land, rtl, stop"


async def run_console(
    command: Callable[[str], Awaitable[dict[str, Any]]],
    quit_service: Callable[[], None],
    help_text: str,
    on_event: Callable[[str, str], None],
) -> None:
    """Read commands until end of file or `quit`. A command runs while the next is typed.

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
    await aioconsole.aprint(_BANNER, use_stderr=True)
    running: set[asyncio.Task[None]] = set()

    async def answer(text: str) -> None:
        try:
            reply = await command(text)
        except Exception as error:
            logger.exception("command %r failed", text)
            reply = {"success": False, "reason": f"{type(error).__name__}: {error}"}
        sign = "done" if reply["success"] else "no"
        await aioconsole.aprint(f"{text}: {sign}: {reply['reason']}", use_stderr=True)

    while True:
        try:
            line = (await aioconsole.ainput("", use_stderr=True)).strip()
        except EOFError:
            return
        if line in ("quit", "exit"):
            quit_service()
            return
        if line == "help":
            await aioconsole.aprint(help_text, use_stderr=True)
        elif line:
            task = asyncio.create_task(answer(line))
            running.add(task)
            task.add_done_callback(running.discard)


def terminal_is_free(source_uri: str) -> bool:
    """Standard input is a terminal and is not where the frames come from."""
    return source_uri != "-" and sys.stdin is not None and sys.stdin.isatty()
