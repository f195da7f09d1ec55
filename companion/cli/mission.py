"""The command line of `companion mission`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.flags import EXIT_FAILED, YOLO, plain_errors, say_silent

if TYPE_CHECKING:
    from companion.settings import Settings


def mission(
    settings: Settings,
    file: Annotated[str, typer.Argument(help="Mission file, or the name of a bundled one: demo.")],
    check: Annotated[
        bool,
        typer.Option(
            "--check", help="Only check the file, including the detector's classes, and print the plan."
        ),
    ] = False,
    connect: Annotated[str | None, typer.Option(help="Zenoh endpoint of the service or its router.")] = None,
    timeout: Annotated[float, typer.Option(min=0.1, help="Seconds to wait for the outcome.")] = 3600.0,
) -> None:
    """Check and fly a mission file. Sends it to a running service and waits for its outcome."""
    from companion.bus.client import NoAnswerError, client_settings, open_client, send_command
    from companion.bus.session import BusError
    from companion.guidance.missions.mission_file import (
        Mission,
        MissionError,
        describe,
        find_mission,
        plan_from,
        read_mission,
    )
    from companion.settings.plugins import PluginError, load_plugins

    with plain_errors(MissionError, NoAnswerError, BusError, PluginError, ValueError):
        load_plugins(settings.plugins.modules)
        text = read_mission(find_mission(file))
        plan = plan_from(text, file, _class_names(settings) if check else None)
        for line in describe(plan):
            typer.echo(line)
        if check:
            return
        client = client_settings(settings.zenoh, (connect,) if connect else ())
        with open_client(client) as session:
            # The text is sent along: the service may run on another computer.
            command = f"{Mission(file)}\n{text}"
            reply = send_command(
                session, settings.vehicle.name, command, timeout_s=timeout, on_silent=say_silent
            )
    typer.echo(f"{'done' if reply['success'] else 'failed'}: {reply['reason']}")
    if not reply["success"]:
        raise typer.Exit(EXIT_FAILED)


def _class_names(settings: Settings) -> tuple[str, ...] | None:
    """Return the class names of the configured detector; None if it is disabled."""
    if not settings.detector.enabled:
        return None
    if settings.detector.kind != YOLO:
        from companion.perception.assembly import load_detector

        return load_detector(settings).class_names
    from vision.detector import class_names_of

    return class_names_of(settings.detector.model, settings.detector.runtime)
