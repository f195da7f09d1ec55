"""Programs beside the service, each in its own process: modules of ours, and ROS's node.

Nothing in such a program can delay the service. It ends when its standard input is closed, which the parent
holds: at the end of the context, and when the parent is killed. A module's options are the first line of that
input: other users of the computer can read a command line.
"""

from __future__ import annotations

import asyncio
import os
import sys
import threading
import time
from asyncio.subprocess import PIPE, STDOUT, Process
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager, suppress
from functools import partial

from companion.host.passing import EXIT_PASSING
from companion.host.restarts import LATER_S, Restarts
from companion.host.scheduling import schedule_as_any_program
from companion.host.tasks import error_text, spawn

# Exit code of a program that has printed in one line why it cannot work: it is not started again. With
# EXIT_PASSING it is, later.
EXIT_REFUSED = 2
_END_S = 5.0
_UNSAID_S = 2.0  # a longer end is announced

Say = Callable[[str], None]
OnEnd = Callable[[str, bool], None]
Start = Callable[[], Awaitable[tuple[Process, Callable[[], None]]]]
"""Starts a process that prints to a pipe; returns it, and what closes its standard input."""


def child_process(
    name: str,
    module: str,
    options: str,
    say: Say,
    *,
    on_end: OnEnd = lambda _why, _again: None,
    end_s: float = _END_S,
) -> AbstractAsyncContextManager[None]:
    """Run `python -m MODULE` meanwhile, as `supervised`. `options`: one line, for `read_options`."""
    return supervised(name, partial(_start_module, name, module, options), say, on_end=on_end, end_s=end_s)


@asynccontextmanager
async def supervised(
    name: str,
    start: Start,
    say: Say,
    *,
    on_end: OnEnd = lambda _why, _again: None,
    end_s: float = _END_S,
) -> AsyncIterator[None]:
    """Run a program meanwhile; started again after a crash (`Restarts`).

    Args:
        name: for people. start: starts it. say: called in the loop with each new line that it prints, and
            with its end.
        on_end: called with why it has ended by itself, and whether it is started again.
        end_s: it is killed if it takes longer to end, seconds.
    """
    running = spawn(_supervise(name, start, say, on_end, end_s), name)
    try:
        yield
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


async def _supervise(name: str, start: Start, say: Say, on_end: OnEnd, end_s: float) -> None:
    restarts = Restarts()
    last = ""

    def say_new(text: str) -> None:
        nonlocal last
        if text != last:  # why it cannot work now is the same at every try
            say(f"{name}: {text}")
        last = text

    while True:
        started_s = time.monotonic()
        try:
            code = await _run_once(start, say_new, end_s)
        except Exception as error:  # no process, a line above 64 KiB, or a fault of ours
            why = error_text(error)
        else:
            if code in (EXIT_REFUSED, EXIT_PASSING):
                on_end(last, code == EXIT_PASSING)
                if code == EXIT_REFUSED:
                    return
                await asyncio.sleep(LATER_S)
                continue
            why = f"its process ended with code {code}"
        on_end(why, True)
        restart = restarts.after(time.monotonic() - started_s, why)
        if restart.reported:
            say_new(f"{why}; {restart}")
        await asyncio.sleep(restart.pause_s)


async def _start_module(name: str, module: str, options: str) -> tuple[Process, Callable[[], None]]:
    process = await asyncio.create_subprocess_exec(
        sys.executable,
        "-P",  # import from the search path below, not from the working directory
        "-m",
        module,
        name,  # for `ps`
        stdin=PIPE,
        stdout=PIPE,
        stderr=STDOUT,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        # Ctrl-C in the terminal is for the parent, which then closes the pipe.
        process_group=0,
    )
    assert process.stdin is not None
    process.stdin.write(options.encode() + b"\n")
    return process, process.stdin.close


async def _run_once(start: Start, say: Say, end_s: float) -> int:
    process, close_input = await start()
    schedule_as_any_program(process.pid)
    try:
        assert process.stdout is not None
        while line := await process.stdout.readline():
            say(line.decode(errors="replace").rstrip())
        return await process.wait()
    finally:
        close_input()  # which ends it
        await _end(process, end_s, say)


async def _end(process: Process, end_s: float, say: Say) -> None:
    """Wait for the end of the process; kill it if it does not end."""
    unsaid_s = min(_UNSAID_S, end_s)
    if await _ended(process, unsaid_s):
        return
    if end_s > unsaid_s:
        say(f"has not ended yet; it will be killed in {end_s - unsaid_s:g} s")
    if not await _ended(process, end_s - unsaid_s):
        with suppress(ProcessLookupError):
            process.kill()
        await process.wait()
        say(f"did not end within {end_s:g} s; killed")


async def _ended(process: Process, within_s: float) -> bool:
    with suppress(TimeoutError):
        async with asyncio.timeout(within_s):
            await process.wait()
    return process.returncode is not None


def read_options() -> str:
    """In the program: read the options, before `on_parent_end`. It ends here if the parent has gone."""
    options = b""
    while not options.endswith(b"\n"):
        part = os.read(sys.stdin.fileno(), 1)
        if not part:
            sys.exit(0)
        options += part
    return options.decode()


def on_parent_end(call: Callable[[], None]) -> None:
    """In the program: call a function, in a thread, when the parent has closed the pipe or was killed."""

    def wait() -> None:
        while os.read(sys.stdin.fileno(), 64):
            pass
        call()

    threading.Thread(target=wait, name="parent", daemon=True).start()
