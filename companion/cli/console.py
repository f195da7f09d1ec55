"""The command line of `companion console`: commands to a running service, at a terminal or from a pipe."""

from __future__ import annotations

import asyncio
import signal
import sys
from contextlib import ExitStack
from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.flags import is_terminal, plain_errors, refuse, say_silent, vehicle_of

if TYPE_CHECKING:
    import zenoh

    from companion.settings import Settings


Python = Annotated[
    bool,
    typer.Option(
        "--python",
        help="A Python prompt, with the vehicle as `drone`: await drone.takeoff(5). Extra `service`.",
    ),
]


def console(settings: Settings, python: Python = False) -> None:
    """Fly a running service from a terminal.

    Commands as in `companion send`, with completion by TAB and a history, while events are shown. Several can
    be open at once. The service goes on after Ctrl-C or Ctrl-D.

    Standard input that is no terminal is read line by line. Exit code: 0, or that of the last line that
    failed, 1 if the service refused it, 2 if it is wrong or nobody answered.
    """
    from companion.bus.client import check_alive, client_settings, open_client
    from companion.bus.session import BusError

    with ExitStack() as stack:
        with plain_errors(OSError, BusError, ValueError):
            session = stack.enter_context(open_client(client_settings(settings.zenoh)))
            vehicle = vehicle_of(session, settings)
            check_alive(session, vehicle)
        if python:
            asyncio.run(_prompt_python(session, vehicle))
            return
        if sys.stdin is None:
            refuse("standard input is closed, and gives no commands: companion send has one as its argument")
        if not is_terminal(sys.stdin):
            raise typer.Exit(_answer_lines(session, vehicle))
        with plain_errors(OSError):
            asyncio.run(_attend(session, vehicle, settings))


def _answer_lines(session: zenoh.Session, vehicle: str) -> int:
    """Execute the lines of standard input in order; returns the exit code of the last one that failed."""
    from companion.client.attached import attached_target
    from companion.operator.console import QUIT, Console

    code = 0
    console = Console({vehicle: attached_target(session, vehicle, say_silent)})
    with asyncio.Runner() as runner:
        for data in sys.stdin.buffer:
            if (line := data.decode(errors="replace").strip()) in QUIT:
                break
            if line:
                answer = runner.run(console.answer(line))
                typer.echo(answer.text)
                code = answer.code or code
    return code


async def _prompt_python(session: zenoh.Session, vehicle: str) -> None:
    """Read Python until Ctrl-D, with `await`. Ctrl-C cancels what is awaited: a command is then stopped."""
    from aioconsole import interact

    from companion.client.drone import Drone

    banner = (
        f"vehicle {vehicle!r} is `drone`: await drone.takeoff(5); Ctrl-D ends the prompt, the service goes on"
    )
    await interact(banner, locals={"drone": Drone(session, vehicle)}, stop=False)


async def _attend(session: zenoh.Session, vehicle: str, settings: Settings) -> None:
    """The console at a terminal, until `quit`, Ctrl-D, Ctrl-C, or the terminal is closed."""
    from companion.client.attached import attached_target, watched
    from companion.language.process import AskProcess
    from companion.operator.console import EXAMPLES, Console, attend
    from companion.operator.line_output import LineOutput, use_for_standard_error

    # What is logged stands above the typed line too.
    standard_error = use_for_standard_error() if is_terminal(sys.stderr) else None
    output = standard_error or LineOutput(sys.stdout.fileno())
    own = settings.vehicle.model_copy(update={"name": vehicle})
    ask = AskProcess(settings.model_copy(update={"vehicle": own}))
    banner = [
        f"vehicle {vehicle!r}: type a command (help): {EXAMPLES}",
        "or ask in plain words: ask find a car and circle it; Ctrl-D ends the console, the service goes on",
    ]
    loop = asyncio.get_running_loop()
    ended = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        loop.add_signal_handler(number, ended.set)
    console = Console({vehicle: attached_target(session, vehicle, output.print)})
    attending = asyncio.ensure_future(attend(console, output, banner, ask))
    ending = asyncio.ensure_future(ended.wait())
    try:
        async with watched(session, vehicle, output.print):
            await asyncio.wait({attending, ending}, return_when=asyncio.FIRST_COMPLETED)
            if attending.done():
                attending.result()
        output.print("console ended, the service goes on")
    finally:
        attending.cancel()
        ending.cancel()
        await asyncio.gather(attending, ending, return_exceptions=True)
        if output is not standard_error:  # which ends with the program
            output.end()
