"""The command lines of `companion send` and `companion echo`: clients of a running service."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.flags import EXIT_FAILED, plain_errors, say_silent

if TYPE_CHECKING:
    from companion.settings import Settings


def known_commands() -> str:
    """The flight commands, one line each."""
    from companion.guidance.grammar import summary

    return summary()


def send(
    settings: Settings,
    command: Annotated[
        str, typer.Argument(help='Command, for example "seek car" or "approach person distance=3".')
    ],
    connect: Annotated[str | None, typer.Option(help="Zenoh endpoint of the service or its router.")] = None,
    timeout: Annotated[float, typer.Option(min=0.1, help="Seconds to wait for the outcome.")] = 300.0,
) -> None:
    """Send a command to a running service. Waits for its outcome."""
    from companion.bus.client import NoAnswerError, client_settings, open_client, send_command
    from companion.bus.session import BusError
    from companion.operator.reply_text import reply_text

    with plain_errors(NoAnswerError, BusError):
        client = client_settings(settings.zenoh, (connect,) if connect else ())
        with open_client(client) as session:
            reply = send_command(
                session, settings.vehicle.name, command, timeout_s=timeout, on_silent=say_silent
            )
    typer.echo(reply_text(reply))
    if not reply["success"]:
        raise typer.Exit(EXIT_FAILED)


def echo(
    settings: Settings,
    key: Annotated[str, typer.Argument(help="Topic (labels), or zenoh key with wildcards.")] = "**",
    connect: Annotated[str | None, typer.Option(help="Zenoh endpoint of the service or its router.")] = None,
    limit: Annotated[int | None, typer.Option(min=1, help="Maximum number of messages.")] = None,
    history: Annotated[
        bool, typer.Option("--history", help="Begin with kept messages: events, tracks, status, camera_info.")
    ] = False,
) -> None:
    """Print the messages of a running service. One line each: key and message."""
    import queue

    from companion.bus.client import NoAnswerError, check_topic, client_settings, listen, open_client
    from companion.bus.session import BusError

    messages: queue.SimpleQueue[tuple[str, str]] = queue.SimpleQueue()
    with plain_errors(ValueError):
        check_topic(key)
    with plain_errors(NoAnswerError, BusError):
        client = client_settings(settings.zenoh, (connect,) if connect else ())
        with open_client(client) as session:
            subscriber = listen(session, key, lambda name, text: messages.put((name, text)), history=history)
            try:
                printed = 0
                while limit is None or printed < limit:
                    name, text = messages.get()
                    print(f"{name} {text}", flush=True)
                    printed += 1
            except KeyboardInterrupt:
                return
            finally:
                subscriber.undeclare()  # type: ignore[no-untyped-call]
