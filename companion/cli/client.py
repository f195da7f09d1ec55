"""The command lines of `companion send` and `companion echo`: clients of a running service."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.flags import (
    EXIT_FAILED,
    YOLO,
    Limit,
    check_belonging,
    named_vehicle,
    plain_errors,
    refuse,
    say_silent,
    vehicle_of,
)

if TYPE_CHECKING:
    from companion.settings import Settings

_COMMAND_TIMEOUT_S, _MISSION_TIMEOUT_S, _SET_TIMEOUT_S = 300.0, 3600.0, 5.0


def known_commands() -> str:
    """The flight commands, one line each."""
    from companion.guidance.grammar import summary

    return summary()


def send(
    settings: Settings,
    context: typer.Context,
    command: Annotated[
        str | None, typer.Argument(help='Command, for example "seek car" or "approach person distance=3".')
    ] = None,
    file: Annotated[
        str | None,
        typer.Option(help="Instead of a command: mission file, or the name of a bundled one: demo."),
    ] = None,
    check: Annotated[
        bool,
        typer.Option(
            "--check",
            help="With --file: only check it, including the detector's classes, and print the plan.",
        ),
    ] = False,
    changes: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Instead of a command: change a limit of guidance, or what a detector reports, until the "
            "next start, for example guidance.max_altitude_m=20. Several: all or none.",
        ),
    ] = None,
    timeout: Annotated[
        float | None,
        typer.Option(min=0.1, help="Seconds to wait for the outcome. Default: 300, of a mission 3600."),
    ] = None,
) -> None:
    """Send a command or a mission to a running service. Waits for its outcome."""
    from companion.bus.client import NoAnswerError, client_settings, open_client, send_command
    from companion.bus.session import BusError
    from companion.guidance.missions.mission_file import MissionError
    from companion.operator.reply_text import reply_text
    from companion.settings.plugins import PluginError

    check_belonging(context, "--file", ("check",), chosen=file is not None)
    if (command is not None) + (file is not None) + bool(changes) != 1:
        refuse("expected a command, such as companion send hold, or --file FILE, or --set, one of them")
    if changes:
        _set(settings, changes, timeout)
        return
    limit_s = timeout or (_COMMAND_TIMEOUT_S if file is None else _MISSION_TIMEOUT_S)
    with plain_errors(MissionError, NoAnswerError, BusError, PluginError, ValueError):
        text = command if file is None else _mission_text(settings, file, check=check)
        if text is None or check:
            return
        with open_client(client_settings(settings.zenoh)) as session:
            vehicle = vehicle_of(session, settings)
            reply = send_command(session, vehicle, text, timeout_s=limit_s, on_silent=say_silent)
    typer.echo(reply_text(reply))
    if not reply["success"]:
        raise typer.Exit(EXIT_FAILED)


def _set(settings: Settings, changes: list[str], timeout: float | None) -> None:
    """Change settings of a running service, and print those that were given, as they are now."""
    from companion.bus.client import (
        NoAnswerError,
        SettingsRefusedError,
        client_settings,
        open_client,
        set_settings,
    )
    from companion.bus.session import BusError
    from companion.cli.log import key_and_value
    from companion.settings.fields import toml_value
    from companion.settings.live import live_value_of_text

    refused = plain_errors(SettingsRefusedError, code=EXIT_FAILED)
    with refused, plain_errors(NoAnswerError, BusError, ValueError):
        pairs = dict(key_and_value(text) for text in changes)
        values = {key: live_value_of_text(key, text) for key, text in pairs.items()}
        with open_client(client_settings(settings.zenoh)) as session:
            vehicle = vehicle_of(session, settings)
            now = set_settings(session, vehicle, values, timeout_s=timeout or _SET_TIMEOUT_S)
    for key in values:
        typer.echo(f"{key} = {toml_value(now[key]['value'])} (file: {toml_value(now[key]['file'])})")


def _mission_text(settings: Settings, file: str, *, check: bool) -> str:
    """Check a mission file and print its plan; returns the command that flies it.

    Raises:
        MissionError, PluginError, ValueError: what is wrong.
    """
    from companion.guidance.missions.mission_file import (
        Mission,
        describe,
        find_mission,
        plan_from,
        read_mission,
    )
    from companion.settings.plugins import load_plugins

    load_plugins(settings.plugins.modules)
    text = read_mission(find_mission(file))
    for line in describe(plan_from(text, file, _class_names(settings) if check else None)):
        typer.echo(line)
    # The text is sent along: the service may run on another computer.
    return f"{Mission(file)}\n{text}"


def _class_names(settings: Settings) -> tuple[str, ...] | None:
    """Return the class names of the configured detector; None if it is disabled."""
    if not settings.detector.enabled:
        return None
    if settings.detector.kind != YOLO:
        from companion.perception.assembly import load_detector

        return load_detector(settings).class_names
    from vision.detector import class_names_of

    return class_names_of(settings.detector.model, settings.detector.runtime)


def echo(
    settings: Settings,
    key: Annotated[str, typer.Argument(help="Topic (labels), or zenoh key with wildcards.")] = "**",
    limit: Limit = None,
    history: Annotated[
        bool, typer.Option("--history", help="Begin with kept messages: events, tracks, status, camera_info.")
    ] = False,
) -> None:
    """Print the messages of running services.

    Of all, or of that of vehicle.name if it is given. One line each: key and message. A key that begins
    with companion/ names the vehicle itself.
    """
    import queue

    from companion.bus.client import NoAnswerError, check_topic, client_settings, listen, open_client
    from companion.bus.session import BusError

    messages: queue.SimpleQueue[tuple[str, str]] = queue.SimpleQueue()
    with plain_errors(ValueError):
        check_topic(key)
    with plain_errors(NoAnswerError, BusError), open_client(client_settings(settings.zenoh)) as session:
        subscriber = listen(
            session,
            key,
            lambda name, text: messages.put((name, text)),
            vehicle=named_vehicle(settings),
            history=history,
        )
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
