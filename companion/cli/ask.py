"""The command line of `companion ask`: one sentence, or a chat."""

from __future__ import annotations

import asyncio
import math
import sys
import threading
import time
from typing import TYPE_CHECKING, Annotated, Any

import typer

from companion.cli.flags import (
    CLIENT_SETTINGS,
    EXIT_FAILED,
    is_terminal,
    named_vehicle,
    plain_errors,
    say_vehicle,
)
from companion.operator.reply_text import printable

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from companion.language.conversation import Conversation, Operator
    from companion.language.endpoints import Endpoint
    from companion.settings import Settings

ASK_SETTINGS = (*CLIENT_SETTINGS, "language", "plugins")
_BANNER = "ask, or say what to fly; `stop` stops at once, `cancel` ends an answer, `quit` the chat"


def ask(
    settings: Settings,
    sentence: Annotated[
        str | None, typer.Argument(help='For example "find the red car and circle it". Without: a chat.')
    ] = None,
    serve: Annotated[
        bool, typer.Option("--serve", help="Answer what is asked on zenoh's key `ask`. Ends on Ctrl-C.")
    ] = False,
) -> None:
    """Fly and answer plain sentences.

    They are read by patterns or by a language model. Commands that move the vehicle are shown first, and
    sent if you answer y. `stop` is sent at once.
    """
    from companion.bus.client import NoAnswerError
    from companion.bus.session import BusError
    from companion.language.endpoints import LanguageError, endpoint_from
    from companion.language.tools import check_words
    from companion.settings.plugins import PluginError, load_plugins

    with plain_errors(NoAnswerError, BusError, PluginError, LanguageError, ValueError):
        load_plugins(settings.plugins.modules)
        check_words("language.may", settings.language.may)
        endpoint = endpoint_from(settings.language)
        try:
            done = asyncio.run(_converse(settings, endpoint, sentence, serve=serve))
        except KeyboardInterrupt:
            done = serve
    if not done:
        raise typer.Exit(EXIT_FAILED)


async def _converse(
    settings: Settings,
    endpoint: Endpoint | None,
    sentence: str | None,
    *,
    serve: bool = False,
) -> bool:
    from companion.bus import topics
    from companion.bus.client import client_settings
    from companion.client import connect as connect_to
    from companion.language.conversation import Operator, send_stop
    from companion.language.live import LiveVehicle, conversations
    from companion.language.sentences import is_stop
    from companion.language.serve import ASK
    from companion.language.serve import serve as serve_queries

    where = client_settings(settings.zenoh).connect[0]
    terminal = Terminal()
    name, file = named_vehicle(settings), settings.zenoh.config_file
    async with connect_to(where, name, config_file=file) as drone:
        say_vehicle(settings, drone.name)

        async def stop() -> bool:
            return await send_stop(LiveVehicle(drone, (), None), terminal.show)

        if sentence is not None and not serve and is_stop(sentence):
            return await stop()

        async def prepare() -> Callable[[Operator], Conversation]:
            return await conversations(drone, endpoint, settings.language.may)

        if serve:
            converse = await prepare()
            terminal.show(f"answering {topics.ROOT}/{drone.name}/{ASK}")
            await serve_queries(drone.session, drone.name, converse)

        async def begin() -> Conversation:
            return (await prepare())(Operator(terminal.write, terminal.show, terminal.confirm))

        return await terminal.attend(begin, stop, sentence)


class Terminal:
    """Standard input and output. Lines are read while the model answers and while the vehicle flies."""

    def __init__(self) -> None:
        self._lines: asyncio.Queue[str | None] = asyncio.Queue()
        self._asked: asyncio.Future[bool] | None = None
        self._ended = self._in_line = False
        self._busy_shown_s = -math.inf

    def write(self, text: str) -> None:
        """A piece of an answer. A model or a label could send control characters to the terminal."""
        self._in_line = not text.endswith("\n")
        print(printable(text, "\n"), end="", flush=True)

    def show(self, line: str) -> None:
        """A whole line; an empty one only ends the line before."""
        if self._in_line:
            print(flush=True)
        self._in_line = False
        if line:
            print(printable(line, "\n"), flush=True)

    async def confirm(self) -> bool:
        """Ask whether to fly what was shown."""
        if self._ended:
            self.show("not executed: nobody confirms it; language.may lists what needs no confirmation")
            return False
        # A console of the service prints whole lines only.
        (self.write if is_terminal(sys.stdin) else self.show)("fly this? [y/N] ")
        self._asked = asyncio.get_running_loop().create_future()
        try:
            return await self._asked
        finally:
            self._asked = None

    async def attend(
        self,
        begin: Callable[[], Awaitable[Conversation]],
        stop: Callable[[], Awaitable[bool]],
        sentence: str | None,
    ) -> bool:
        """Run a sentence, or a chat until `quit` or the end of the input. Returns whether all was done.

        Args:
            begin: makes the conversation; it may wait for the service. stop: waits for nothing.
        """
        from companion.language.endpoints import LanguageError
        from companion.language.sentences import is_stop

        self._read_in_thread()
        chat = sentence is None
        if chat and is_terminal(sys.stdin):
            self.show(_BANNER)
        beginning = asyncio.ensure_future(begin())

        async def ask_it(text: str) -> bool:
            return await (await asyncio.shield(beginning)).ask(text)

        running = None if sentence is None else asyncio.create_task(ask_it(sentence))
        next_line = asyncio.create_task(self._lines.get())
        success = True
        try:
            while not self._ended or running is not None or not beginning.done():
                waited: list[asyncio.Future[Any] | None] = [
                    running,
                    None if self._ended else next_line,
                    None if beginning.done() else beginning,
                ]
                await asyncio.wait(filter(None, waited), return_when=asyncio.FIRST_COMPLETED)
                if beginning.done():
                    beginning.result()  # its error ends the chat
                if running is not None and running.done():
                    try:
                        success = running.result() and success
                    except LanguageError as error:
                        if not chat:
                            raise
                        self.show(str(error))
                    running = None
                    if not chat:
                        return success
                if self._ended or not next_line.done():
                    continue
                line = next_line.result()
                next_line = asyncio.create_task(self._lines.get())
                if line is not None and is_stop(line):
                    if running is not None:
                        running.cancel()  # first: it sends nothing after the stop
                    success = await stop() and success
                    await _cancelled(running)
                    running = None
                    if not chat:
                        return False
                elif line is not None and chat and line.strip() == "cancel":
                    await _cancelled(running)
                    running = None
                elif line is None or (chat and self._asked is None and line.strip() in ("quit", "exit")):
                    self._ended = True
                    if self._asked is not None:
                        self._asked.set_result(False)
                    if line is not None:
                        return success
                elif self._asked is not None:
                    self._asked.set_result(line.strip().lower() in ("y", "yes"))
                elif running is not None:
                    self._show_busy()
                elif line.strip():
                    running = asyncio.create_task(ask_it(line))
            return success
        finally:
            next_line.cancel()
            await _cancelled(running)
            await _cancelled(beginning)

    def _show_busy(self) -> None:
        """At most once a second: a pipe may deliver lines without end."""
        now_s = time.monotonic()
        if now_s - self._busy_shown_s >= 1.0:
            self._busy_shown_s = now_s
            self.show("busy; `stop` ends it")

    def _read_in_thread(self) -> None:
        """Standard input may be a terminal, a pipe or a file; asyncio reads only the first two."""
        loop = asyncio.get_running_loop()

        def read() -> None:
            try:
                for line in sys.stdin or ():
                    loop.call_soon_threadsafe(self._lines.put_nowait, line.rstrip("\n"))
                loop.call_soon_threadsafe(self._lines.put_nowait, None)
            except (RuntimeError, ValueError):  # the loop or the file is closed
                return

        threading.Thread(target=read, name="standard input", daemon=True).start()


async def _cancelled(task: asyncio.Future[Any] | None) -> None:
    if task is not None:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
