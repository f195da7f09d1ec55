"""The command line of `companion play`."""

from __future__ import annotations

import logging
import os
import sys
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from companion.cli.flags import EXIT_BAD_INPUT, EXIT_FAILED, plain_errors
from companion.host.journal import log_to_standard_error
from vision.gc_pause import gc_paused

if TYPE_CHECKING:
    from companion.settings import Settings

# Sections that play sets itself.
_OWN = ("source.", "camera.")


def play(
    settings: Settings,
    given: Mapping[str, str],
    scene: Annotated[
        str | None, typer.Option(help="Scene file, or name of a bundled scene: village, obstacle_course…")
    ] = None,
    vehicles: Annotated[
        int,
        typer.Option(
            min=1, max=20, help="Number of simulated vehicles, one service each; up to 4 have a camera each."
        ),
    ] = 1,
    seed: Annotated[int, typer.Option(min=0, help="Random seed of the world and the wind.")] = 1,
    autopilot: Annotated[
        Literal["px4", "ardupilot"], typer.Option(help="Autopilot firmware to emulate.")
    ] = "px4",
) -> None:
    """Run vehicle, camera and service together.

    Takes commands on the terminal and by `companion send` until Ctrl-C. With --source none no vehicle has a
    camera.

    With --vehicle-url the vehicle is the autopilot that sends to that UDP port. A camera in the built-in
    world is rendered from its pose.
    """
    from companion.settings.perception import NO_SOURCE

    with_camera = given.get("source.uri") != NO_SOURCE
    own = [key for key in given if key.startswith(_OWN) and (with_camera or key != "source.uri")]
    if own:
        only = ""
        if own[0] == "source.uri":
            only = f"; to see {given[own[0]]}: companion view {given[own[0]]}; --source none: no camera"
        typer.echo(f"companion: {own[0]}: play uses its own camera; remove the option{only}", err=True)
        raise typer.Exit(EXIT_BAD_INPUT)
    url = given.get("vehicle.url")
    if url is not None and not with_camera:
        typer.echo(
            "companion: --source none with --vehicle-url: nothing is simulated; use companion run", err=True
        )
        raise typer.Exit(EXIT_BAD_INPUT)
    if url is not None and vehicles > 1:
        typer.echo(
            f"companion: --vehicles {vehicles}: expected one vehicle with --vehicle-url; remove the option",
            err=True,
        )
        raise typer.Exit(EXIT_BAD_INPUT)
    started_s = time.monotonic()
    with gc_paused():
        from companion.bus.session import BusError
        from companion.operator.line_output import LineOutput, use_for_standard_error
        from companion.operator.metrics import MetricsError
        from companion.perception.supervisor import PerceptionStartError
        from companion.settings.plugins import PluginError
        from companion.simulation.play import PlayOptions, SimulationLostError
        from companion.simulation.play import play as start
        from companion.simulation.session import SimSessionError
        from companion.vehicle.driver import LinkError

    standard_error = use_for_standard_error()
    level = settings.log.level.upper() if "log.level" in given else "WARNING"
    log_to_standard_error(level, "companion: %(message)s")
    # The service's events are printed here with their time; do not log them as well.
    service = logging.getLogger("companion.service")
    service.propagate = False
    service.addHandler(logging.NullHandler())
    options = PlayOptions(scene, seed, vehicles, url, autopilot, with_camera)
    errors = (SimSessionError, LinkError, PerceptionStartError, BusError, MetricsError, PluginError)
    # On one terminal all lines are written by one: above the line that is being typed.
    one = standard_error if os.path.sameopenfile(1, 2) else None
    output = one or LineOutput(sys.stdout.fileno())
    with plain_errors(*errors):
        try:
            start(
                settings, options, lambda text: output.print(f"{time.monotonic() - started_s:6.1f} s  {text}")
            )
        except SimulationLostError as error:
            typer.echo(f"companion: {error}", err=True)
            raise typer.Exit(EXIT_FAILED) from error
        finally:
            if output is not standard_error:
                output.end()
