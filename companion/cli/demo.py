"""The command line of `companion demo`: one flight with a video, or many seeds in lockstep."""

from __future__ import annotations

import json
import logging
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from companion.cli.flags import (
    EXIT_BAD_INPUT,
    EXIT_FAILED,
    Processes,
    RayAddress,
    check_seed_options,
    is_terminal,
    plain_errors,
)
from companion.host.journal import log_to_standard_error

_DEMO_S, _DEMO_AUTOPILOT_S = 150.0, 300.0


def demo(
    context: typer.Context,
    duration: Annotated[
        float | None,
        typer.Option(min=20, help="Time limit, seconds. Default: 150, with --vehicle-url 300."),
    ] = None,
    output: Annotated[Path, typer.Option(help="Folder for the video and summary.json.")] = Path(
        "demo-output"
    ),
    seed: Annotated[int, typer.Option(min=0, help="Random seed of the world and the wind.")] = 1,
    vehicle_url: Annotated[
        str | None,
        typer.Option(help="Fly the autopilot that sends to this UDP port: udpin://127.0.0.1:14540."),
    ] = None,
    seeds: Annotated[
        str | None, typer.Option(help="Fly these seeds in lockstep, without a video: 1..50, or 3,7,9..12.")
    ] = None,
    processes: Processes = 1,
    ray: RayAddress = None,
    synthetic: Annotated[
        bool, typer.Option("--synthetic", help="With --seeds: detections from ground truth, no network.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="With --seeds: print one JSON object.")] = False,
) -> None:
    """Fly the demonstration.

    Takes off, finds a car, approaches it, returns and lands.

    The vehicle is the simulated one. With --vehicle-url it is another autopilot, disarmed on the ground, and
    the camera is rendered from the position it reports; its parameters are not changed.
    """
    check_seed_options(context)
    if seeds is not None and vehicle_url is not None:
        typer.echo("companion: --seeds flies the simulated vehicle; remove --vehicle-url", err=True)
        raise typer.Exit(EXIT_BAD_INPUT)
    if seeds is not None:
        _fly_seeds(seeds, processes, ray, synthetic=synthetic, as_json=as_json)
        return
    from companion.bus.session import BusError
    from companion.operator.line_output import LineOutput, use_for_standard_error
    from companion.perception.supervisor import PerceptionStartError
    from companion.simulation.demo import run_demo
    from companion.simulation.session import SimSessionError
    from companion.vehicle.driver import LinkError

    use_for_standard_error()
    log_to_standard_error(logging.WARNING, "companion: %(message)s")
    # The service's events are printed here with their time; do not log them as well.
    service = logging.getLogger("companion.service")
    service.propagate = False
    service.addHandler(logging.NullHandler())
    with plain_errors(SimSessionError, LinkError, PerceptionStartError, BusError, OSError):
        # PX4 returns at 30 m (RTL_RETURN_ALT), and no parameter of the autopilot is changed.
        limit_s = duration or (_DEMO_S if vehicle_url is None else _DEMO_AUTOPILOT_S)
        started_s = time.monotonic()
        lines = LineOutput(sys.stdout.fileno())  # a stalled reader must not delay the flight
        try:
            summary = run_demo(
                output,
                seed=seed,
                limit_s=limit_s,
                say=lambda text: lines.print(f"{time.monotonic() - started_s:6.1f} s  {text}"),
                vehicle_url=vehicle_url,
            )
        finally:
            lines.end()
    if not summary.success:
        typer.echo(f"the demonstration failed: {summary.failure}; see {output}", err=True)
        raise typer.Exit(EXIT_FAILED)
    source = "ground truth" if summary.truth == "simulator" else "autopilot's own position"
    typer.echo(
        f"found, reached (stopped {summary.final_range_m} m from the car, {source}), landed; "
        f"{summary.detections_published} detection messages. Video: {output / summary.video}"
    )


def _fly_seeds(text: str, processes: int, ray: str | None, *, synthetic: bool, as_json: bool) -> None:
    from rich.console import Console

    from companion.bench.demo_flight import demos_summary, demos_table, fly_demos
    from companion.simulation.campaign import ClusterError, SeedError, seeds_of

    log_to_standard_error(logging.ERROR, "companion: %(message)s")
    with plain_errors(ValueError):
        seeds = seeds_of(text)
    flights = []
    with plain_errors(ClusterError, SeedError):
        for flight in fly_demos(seeds, processes=processes, ray=ray, synthetic=synthetic):
            flights.append(flight)
            outcome = "success" if flight.success else f"failed: {flight.failure}"
            typer.echo(f"seed {flight.seed}: {outcome}", err=True)
    if as_json:
        typer.echo(json.dumps(demos_summary(flights)))
    else:
        Console(width=None if is_terminal(sys.stdout) else 160).print(demos_table(flights))
    if not all(flight.success for flight in flights):
        raise typer.Exit(EXIT_FAILED)
