"""A console for commands on the service's own terminal."""

from __future__ import annotations

import asyncio
import logging
import os
import sys
from collections.abc import Awaitable, Callable
from typing import Any, Protocol

from companion.host.tasks import spawn
from companion.operator.reply_text import reply_text
from vision.extras import missing_module

logger = logging.getLogger(__name__)

_BANNER = "type a command (help, quit): takeoff 5, seek car, approach car distance=5, hold, land, rtl, stop"
_ASK_BANNER = "or ask in plain words: ask find a car and circle it"
_CANCEL = "cancel"
_ANSWERS = ("y", "yes", "n", "no")


class Ask(Protocol):
    """Answers plain sentences, in a process of its own."""

    @property
    def running(self) -> bool:
        """Whether a sentence was passed on, and the process goes on."""

    async def send(self, line: str, write: Callable[[str], None]) -> None:
        """Pass on a sentence, the answer to a question, or `cancel`. `write`: gets what is printed.

        Raises:
            OSError: the process cannot be started, or has just ended.
        """

    async def close(self) -> None:
        """End the process."""


async def run_console(
    command: Callable[[str], Awaitable[dict[str, Any]]],
    quit_service: Callable[[], None],
    help_text: str,
    on_event: Callable[[str, str], None],
    ask: Ask | None = None,
) -> None:
    """Read commands until `quit` or the end of file, which end the service: a closed terminal, Ctrl-D.

    A command runs while the next is typed.

    Answers go to standard error, which must not wait for its reader (`line_output.py`).
    Without aioconsole there is no console, and the service goes on.
    Never raises: an error of the console must not affect the flight.
    """
    try:
        await _read_commands(command, quit_service, help_text, ask)
    except ModuleNotFoundError as error:
        _print(f"no commands on this terminal: {missing_module(error) or error}; or use `companion send`")
    except Exception as error:
        logger.exception("the console failed")
        on_event("warning", f"console ended: {type(error).__name__}: {error}")


async def _read_commands(
    command: Callable[[str], Awaitable[dict[str, Any]]],
    quit_service: Callable[[], None],
    help_text: str,
    ask: Ask | None,
) -> None:
    # Of the extra `service`.
    from aioconsole.stream import StandardStreamReader, StandardStreamReaderProtocol

    _print(_BANNER)
    if ask is not None:
        _print(_ASK_BANNER)
    running: set[asyncio.Task[None]] = set()

    async def answer(text: str) -> None:
        try:
            reply = await command(text)
        except Exception as error:
            logger.exception("command %r failed", text)
            reply = {"success": False, "reason": f"{type(error).__name__}: {error}"}
        _print(f"{text}: {reply_text(reply)}")

    async def pass_on(line: str) -> None:
        assert ask is not None
        try:
            await ask.send(line, _write)
        except OSError as error:
            _print(f"ask: {error}")

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
            word, _, sentence = text.partition(" ")
            if text == "help":
                _print(help_text)
            elif ask is not None and word == "ask" and sentence:
                await pass_on(sentence.strip())
            elif ask is not None and ask.running and text.lower() in _ANSWERS:
                await pass_on(text)
            elif text:
                if ask is not None and ask.running and text.split()[-1].lower() == "stop":
                    await pass_on(_CANCEL)  # it sends nothing after the stop
                task = spawn(answer(text), "answer on the console")
                running.add(task)
                task.add_done_callback(running.discard)
        quit_service()
    finally:
        transport.close()
        if ask is not None:
            await ask.close()


async def _line_of(reader: asyncio.StreamReader) -> bytes:
    """Return the next line; empty at end of file, or if the terminal was closed (EIO)."""
    try:
        return await reader.readline()
    except OSError:
        return b""


def _print(text: str) -> None:
    _write(f"{text}\n")


def _write(text: str) -> None:
    print(text, end="", file=sys.stderr, flush=True)


def terminal_is_free(source_uri: str) -> bool:
    """Whether standard input is a terminal and not the source of frames."""
    return source_uri != "-" and sys.stdin is not None and sys.stdin.isatty()
