"""The console: commands, their answers and what the service says, at a terminal.

The same at the terminal of the service and in `companion console`. What it does with a service goes through
a `Target`, in the service's process by calls, elsewhere over zenoh.
"""

from __future__ import annotations

import asyncio
import contextlib
import copy
import json
import logging
import os
import re
import signal
import sys
import termios
import textwrap
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, Protocol

from companion.host.tasks import spawn
from companion.operator.command_history import CommandHistory, history_file
from companion.operator.completion import completions, help_lines
from companion.operator.line_editor import Key, LineEditor, common_beginning
from companion.operator.line_output import LineOutput
from companion.operator.reply_text import printable, reply_text
from companion.operator.status_text import status_text
from companion.settings.fields import toml_value
from companion.settings.live import NARROWER, live_value_of_text

logger = logging.getLogger(__name__)

EXAMPLES = "takeoff 5, seek car, approach car distance=5, hold, land, rtl, stop"
_BANNER = f"type a command (help, quit): {EXAMPLES}"
_ASK_BANNER = "or ask in plain words: ask find a car and circle it"
_CONSOLE_ENDED = "console ended, the service goes on: Ctrl-C ends it, `companion console` opens another"
_PROMPT = "> "
_CANCEL = "cancel"
QUIT = ("quit", "exit")
_ANSWERS = ("y", "yes", "n", "no")
_FAILED, _WRONG = 1, 2  # exit codes of the command line
_SCHEMA_VALID_S, _SCHEMA_WAIT_S = 5.0, 1.0
_FOREGROUND_S = 0.5
_COLUMNS = 80


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


@dataclass(frozen=True, slots=True)
class Target:
    """One vehicle's service, as a console reaches it: the queries of docs/messages.md.

    Each raises OSError if nothing answers, ValueError or RuntimeError if it is refused, with one line.

    Attributes:
        command: executes a command; returns its reply.
        settings: sets all values of a JSON object, or none; returns those of now. Empty: only returns them.
        status: returns the body of `status`.
        commands: returns the JSON Schema of the commands.
    """

    command: Callable[[str], Awaitable[Mapping[str, Any]]]
    settings: Callable[[bytes], Awaitable[Mapping[str, Any]]]
    status: Callable[[], Awaitable[Mapping[str, Any]]]
    commands: Callable[[], Awaitable[Mapping[str, Any]]]


@dataclass(frozen=True, slots=True)
class Answer:
    """What a line did, in words. `code`: 0 done or accepted, 1 failed or refused, 2 wrong or no answer."""

    text: str
    code: int = 0


class End(Enum):
    """Why a console has ended."""

    QUIT = "the word quit"
    END_OF_INPUT = "Ctrl-D"
    CLOSED = "the terminal was closed"


class Console:
    """The lines of an operator, executed by one or several services.

    Args:
        targets: vehicle → its service. A line goes to the vehicle that it begins with, others to the first.
            One that is alone needs no name.
    """

    def __init__(self, targets: Mapping[str, Target]) -> None:
        self._targets = targets
        self._schemas: dict[str, tuple[float, Mapping[str, Any]]] = {}

    async def answer(self, line: str) -> Answer:
        """Execute a line: `help`, `status`, `set`, or a command. Never raises but for a cancellation."""
        answer = await self._answer(line)
        return Answer(printable(answer.text, "\n"), answer.code)

    async def _answer(self, line: str) -> Answer:
        name, text = self._addressed(line.strip())
        target = self._targets[name]
        word, _, rest = text.partition(" ")
        try:
            if word == "help":
                return Answer("\n".join(help_lines(await target.commands(), rest.strip())))
            if text == "status":
                return Answer(status_text(await target.status()))
            if word == "set":
                return Answer("\n".join(await _set(target, rest)))
            reply = await target.command(text)
            return Answer(f"{line}: {reply_text(reply)}", 0 if reply["success"] else _FAILED)
        except OSError as error:
            return Answer(str(error), _WRONG)
        except (ValueError, RuntimeError) as error:
            return Answer(f"{line}: {error}", _WRONG if isinstance(error, ValueError) else _FAILED)
        except Exception as error:
            logger.exception("line %r failed", line)
            return Answer(f"{line}: failed: {type(error).__name__}: {error}", _FAILED)

    async def completions(
        self, before: str, recent: Callable[[], Awaitable[list[str]]]
    ) -> tuple[int, list[str]]:
        """Return where the word before the cursor begins, and the words that it can become."""
        name, _ = self._addressed(before.lstrip())
        vehicles = tuple(self._targets) if len(self._targets) > 1 else ()
        schema, lines = await self._schema(name), await recent()
        try:
            return completions(before, schema, keys=tuple(NARROWER), recent=lines, vehicles=vehicles)
        except (KeyError, TypeError, AttributeError):  # the schema of another version
            return len(before), []

    def _addressed(self, line: str) -> tuple[str, str]:
        """Return the vehicle that a line is for, and the line without its name."""
        word, _, rest = line.partition(" ")
        if rest and word in self._targets:
            return word, rest.strip()
        return next(iter(self._targets)), line

    async def _schema(self, name: str) -> Mapping[str, Any]:
        """Return the commands of a service, not older than some seconds where it answers."""
        read_s, schema = self._schemas.get(name, (-_SCHEMA_VALID_S, {}))
        if time.monotonic() - read_s >= _SCHEMA_VALID_S:
            with contextlib.suppress(OSError, ValueError, RuntimeError):  # TimeoutError is an OSError
                async with asyncio.timeout(_SCHEMA_WAIT_S):
                    schema = await self._targets[name].commands()
                self._schemas[name] = time.monotonic(), schema
        return schema


async def _set(target: Target, text: str) -> list[str]:
    """Change settings, and return a line for each of them; for all, if the text is empty."""
    values = {}
    for word in re.findall(r'(?:[^\s"]|"[^"]*")+', text):
        key, is_value, value = word.replace('"', "").partition("=")
        if not is_value:
            raise ValueError(f"expected KEY=VALUE, such as guidance.max_altitude_m=20, got {word!r}")
        values[key] = live_value_of_text(key, value)
    now = await target.settings(json.dumps(values).encode() if values else b"")
    return [
        f"{key} = {toml_value(now[key]['value'])} (file: {toml_value(now[key]['file'])})"
        for key in values or now
    ]


async def run_console(
    targets: Mapping[str, Target],
    quit_service: Callable[[], None],
    on_event: Callable[[str, str], None],
    ask: Ask | None = None,
) -> None:
    """The console at the service's terminal. `quit` and a closed terminal end the service, Ctrl-D does not.

    A command runs while the next is typed. Answers go to standard error, which must not wait for its reader
    (`line_output.py`). Never raises: an error of the console must not affect the flight.
    """
    try:
        banner = [_BANNER] if ask is None else [_BANNER, _ASK_BANNER]
        ended = await attend(Console(targets), sys.stderr, banner, ask)
    except Exception as error:
        logger.exception("the console failed")
        on_event("warning", f"console ended: {type(error).__name__}: {error}")
        return
    if ended is End.END_OF_INPUT:
        print(_CONSOLE_ENDED, file=sys.stderr)
    else:
        quit_service()


async def attend(console: Console, output: Any, banner: list[str], ask: Ask | None = None) -> End:
    """Read lines at the terminal of standard input, and print their answers, until the end of one of both.

    Args:
        output: a text stream. A `LineOutput` on a terminal has the line that is typed below all others.
        banner: the first lines.

    Raises:
        OSError: standard input is no terminal that can be opened.
    """
    attended = _Attended(console, output, ask)
    with _opened_terminal() as terminal:
        for line in banner:
            attended.print(line)
        try:
            if isinstance(output, LineOutput) and output.isatty() and os.environ.get("TERM") != "dumb":
                with _edited(terminal):
                    return await attended.edit(terminal, output)
            return await attended.read(terminal)
        finally:
            if ask is not None:
                await ask.close()


class _Attended:
    """A console at a terminal."""

    def __init__(self, console: Console, output: Any, ask: Ask | None) -> None:
        self._console, self._output, self._ask = console, output, ask
        self._history = CommandHistory(history_file())
        self._history_failed = False

    def print(self, text: str) -> None:
        self._write(f"{text}\n")

    def _write(self, text: str) -> None:
        print(text, end="", file=self._output, flush=True)

    async def read(self, terminal: int) -> End:
        """Lines that the terminal itself edits."""
        rest = b""
        async for data in _pieces(terminal):
            if not data:
                return End.END_OF_INPUT if os.isatty(terminal) else End.CLOSED
            *lines, rest = (rest + data).split(b"\n")
            for line in lines:
                if (end := await self._begin(line.decode(errors="replace"))) is not None:
                    return end
        return End.CLOSED

    async def edit(self, terminal: int, output: LineOutput) -> End:
        """Lines that are edited here, with completion and history."""
        editor = LineEditor(_PROMPT)

        def show() -> None:
            output.show(editor.view(_columns(terminal)))

        def resume() -> None:  # after Ctrl-Z and `fg`
            if _in_foreground(terminal):
                _set_edited(terminal)
            output.redraw()

        with _on_signals({signal.SIGWINCH: show, signal.SIGCONT: resume}):
            try:
                show()
                async for data in _pieces(terminal):
                    if not data:
                        return End.CLOSED
                    for key in editor.feed(data):
                        if isinstance(key, str):
                            output.print(f"{_PROMPT}{key}")
                            show()
                            if (end := await self._begin(key)) is not None:
                                return end
                            await self._remember(key.strip())
                        elif key is Key.COMPLETE:
                            await self._complete(editor, _columns(terminal))
                        elif key is Key.OLDER:
                            editor.history = await self._recent()
                            editor.older()
                        else:
                            return End.END_OF_INPUT
                    show()
                return End.CLOSED
            finally:
                output.show("")

    async def _begin(self, line: str) -> End | None:
        """Begin with a line, whose answer may come later; returns the end of the console, if it is one."""
        text, ask = line.strip(), self._ask
        if text in QUIT:
            return End.QUIT
        word, _, sentence = text.partition(" ")
        if ask is not None and word == "ask" and sentence:
            await self._pass_on(ask, sentence.strip())
        elif ask is not None and ask.running and text.lower() in _ANSWERS:
            await self._pass_on(ask, text)
        elif text:
            if ask is not None and ask.running and text.split()[-1].lower() == "stop":
                await self._pass_on(ask, _CANCEL)  # it sends nothing after the stop
            spawn(self._answer(text), "answer on the console")
        return None

    async def _answer(self, text: str) -> None:
        self.print((await self._console.answer(text)).text)

    async def _pass_on(self, ask: Ask, line: str) -> None:
        try:
            await ask.send(line, self._write)
        except OSError as error:
            self.print(f"ask: {error}")

    async def _complete(self, editor: LineEditor, columns: int) -> None:
        before = editor.text[: editor.cursor]
        begin, found = await self._console.completions(before, self._recent)
        if not found:
            return
        common = common_beginning(found)
        if len(found) == 1:
            editor.replace(begin, common if common.endswith("=") else f"{common} ")
        elif len(common) > len(before) - begin:
            editor.replace(begin, common)
        else:
            listed = textwrap.wrap(
                "  ".join(found), max(columns - 1, 1), break_long_words=False, break_on_hyphens=False
            )
            self.print("\n".join(listed))

    async def _recent(self) -> list[str]:
        return list(await asyncio.to_thread(self._history.lines))

    async def _remember(self, line: str) -> None:
        if not line:
            return
        try:
            await asyncio.to_thread(self._history.add, line)
        except OSError as error:
            if not self._history_failed:
                self.print(f"the history is not kept: {error}")
            self._history_failed = True


@contextlib.contextmanager
def _opened_terminal() -> Iterator[int]:
    """Open the terminal of standard input again: it is made non-blocking, and nothing else of it must be."""
    flags = os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK | os.O_CLOEXEC
    try:
        terminal = os.open(os.ttyname(sys.stdin.fileno()), flags)
    except OSError:  # a terminal of another mount namespace has no name here
        terminal = os.open("/dev/tty", flags)
    try:
        yield terminal
    finally:
        os.close(terminal)


@contextlib.contextmanager
def _edited(terminal: int) -> Iterator[None]:
    """Let the terminal pass on each key, without an echo; Ctrl-C, Ctrl-Z and Ctrl-S are still its own."""
    before = termios.tcgetattr(terminal)
    _set_edited(terminal)
    try:
        yield
    finally:
        if _in_foreground(terminal):
            with contextlib.suppress(termios.error):  # it was closed
                termios.tcsetattr(terminal, termios.TCSANOW, before)  # does not wait for the terminal


def _set_edited(terminal: int) -> None:
    attributes = copy.deepcopy(termios.tcgetattr(terminal))
    attributes[3] &= ~(termios.ICANON | termios.ECHO | termios.IEXTEN)
    attributes[6][termios.VMIN], attributes[6][termios.VTIME] = 1, 0
    termios.tcsetattr(terminal, termios.TCSANOW, attributes)


def _in_foreground(terminal: int) -> bool:
    """Whether a shell has not put this program into the background, where reading would stop it (SIGTTIN)."""
    try:
        return os.tcgetpgrp(terminal) == os.getpgrp()
    except OSError:  # not the terminal of this session: there is no job control
        return True


def _columns(terminal: int) -> int:
    with contextlib.suppress(OSError):
        return os.get_terminal_size(terminal).columns or _COLUMNS
    return _COLUMNS


@contextlib.contextmanager
def _on_signals(handlers: Mapping[signal.Signals, Callable[[], None]]) -> Iterator[None]:
    loop = asyncio.get_running_loop()
    for number, handler in handlers.items():
        loop.add_signal_handler(number, handler)
    try:
        yield
    finally:
        for number in handlers:
            loop.remove_signal_handler(number)


async def _pieces(terminal: int) -> AsyncIterator[bytes]:
    """Yield what is typed; empty: Ctrl-D where the terminal edits, or it was closed. Ends when closed."""
    while True:
        await _readable(terminal)
        if not _in_foreground(terminal):
            await asyncio.sleep(_FOREGROUND_S)
            continue
        try:
            yield os.read(terminal, 4096)
        except BlockingIOError:
            continue
        except OSError:
            return


async def _readable(descriptor: int) -> None:
    loop, readable = asyncio.get_running_loop(), asyncio.Event()
    loop.add_reader(descriptor, readable.set)
    try:
        await readable.wait()
    finally:
        loop.remove_reader(descriptor)


def terminal_is_free(source_uri: str) -> bool:
    """Whether standard input is a terminal, of this program and not of the shell, and no source of frames."""
    if source_uri == "-" or sys.stdin is None or not sys.stdin.isatty():
        return False
    return _in_foreground(sys.stdin.fileno())
