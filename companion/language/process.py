"""`companion ask` as a child process: the sentences of a console in, what an operator reads out.

The service must not be delayed by a model or by loading one. The process ends with its standard input.
"""

from __future__ import annotations

import asyncio
import codecs
import os
import sys
from asyncio.subprocess import PIPE, STDOUT, Process
from collections.abc import Callable
from contextlib import suppress

from companion.host.scheduling import schedule_as_any_program
from companion.host.tasks import spawn
from companion.settings import Settings
from companion.settings.reading import flags

NICENESS = 5
_SECTIONS = ("zenoh", "language", "plugins")
_END_S = 2.0


class AskProcess:
    """The chat of a console, started with the first sentence and again after its end."""

    def __init__(self, settings: Settings) -> None:
        self._words = (sys.executable, "-P", "-m", "companion.cli", "ask", *_flags_of(settings))
        self._process: Process | None = None
        self._reading: asyncio.Task[None] | None = None

    @property
    def running(self) -> bool:
        """Whether the process is there."""
        return self._process is not None and self._process.returncode is None

    async def send(self, line: str, write: Callable[[str], None]) -> None:
        """Pass a line on. `write`: gets pieces of what the process prints.

        Raises:
            OSError: the process cannot be started, or has just ended.
        """
        if not self.running:
            self._process = await asyncio.create_subprocess_exec(
                *self._words,
                stdin=PIPE,
                stdout=PIPE,
                stderr=STDOUT,
                env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
                process_group=0,  # Ctrl-C in the terminal is for the service
            )
            with suppress(OSError):  # it has ended already
                os.setpriority(os.PRIO_PROCESS, self._process.pid, min(os.nice(0) + NICENESS, 19))
            schedule_as_any_program(self._process.pid)
            self._reading = spawn(_pass_on(self._process, write), "output of ask")
        assert self._process is not None
        assert self._process.stdin is not None
        self._process.stdin.write(f"{line}\n".encode())
        if self._process.stdin.is_closing():
            raise BrokenPipeError(f"the process has ended before {line!r} was passed on: ask again")

    async def close(self) -> None:
        """End the process."""
        if self._process is None or self._reading is None:
            return
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            async with asyncio.timeout(_END_S):
                await self._process.wait()
        except TimeoutError:
            with suppress(ProcessLookupError):
                self._process.kill()
        await self._process.wait()
        self._reading.cancel()
        await asyncio.gather(self._reading, return_exceptions=True)


async def _pass_on(process: Process, write: Callable[[str], None]) -> None:
    """Not by lines: a question to the operator has no line end."""
    assert process.stdout is not None
    decoder = codecs.getincrementaldecoder("utf-8")(errors="replace")
    while piece := await process.stdout.read(4096):
        write(decoder.decode(piece))


def _flags_of(settings: Settings) -> list[str]:
    """The settings of `ask` as flags, and no file that could add others."""
    zenoh = settings.zenoh
    zenoh = zenoh.model_copy(update={"config_file": zenoh.child_config_file or zenoh.config_file})
    settings = settings.model_copy(update={"zenoh": zenoh})
    words = ["--config", os.devnull]
    for flag in flags():
        section, _, name = flag.key.partition(".")
        if section not in _SECTIONS and flag.key != "vehicle.name":
            continue
        value = getattr(getattr(settings, section), name)
        text = "none" if value is None else ",".join(value) if isinstance(value, tuple) else str(value)
        words += [f"--{flag.key.replace('.', '-').replace('_', '-')}", text]
    return words
