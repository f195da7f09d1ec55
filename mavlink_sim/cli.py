"""`mavlink-sim`: a PX4-like multirotor on UDP, one readable line an event."""

from __future__ import annotations

import json
import logging
import math
import os
import signal
import sys
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, NoReturn

import typer

from mavlink_sim.endpoint import PortInUseError
from mavlink_sim.parameters import UnknownParameterError
from mavlink_sim.simulation import Simulation, SimulationOptions

# Tilted by 45 degrees, the airframe (SIH's, with its large drag) holds against little more than this.
MAX_WIND_MPS = 8.0

# click's UsageError, by way of its public subclass: some versions of typer carry a click of their own
_USAGE_ERROR: Any = typer.BadParameter.__base__

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)


def _fail(text: str) -> NoReturn:
    print(f"mavlink-sim: {text}", file=sys.stderr)
    raise typer.Exit(2)


def _say(text: str) -> None:
    print(text, flush=True)


def _parameters(assignments: list[str]) -> dict[str, float]:
    values = {}
    for assignment in assignments:
        name, equals, text = assignment.partition("=")
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not equals or not math.isfinite(value):
            _fail(f"--param {assignment!r}: expected NAME=NUMBER, for example COM_OF_LOSS_T=0.5")
        values[name.strip()] = value
    return values


def _check(name: str, value: float, low: float, high: float) -> None:
    if not low <= value <= high:
        _fail(f"--{name} {value:g}: expected {low:g} to {high:g}")


@app.command()
def simulate(
    onboard_port: Annotated[int, typer.Option(help="UDP port the onboard link sends to.")] = 14540,
    onboard_bind: Annotated[
        int, typer.Option(help="UDP port the onboard link binds; 0: a free one.")
    ] = 14580,
    gcs_port: Annotated[int, typer.Option(help="UDP port the ground-station link sends to.")] = 14550,
    gcs_bind: Annotated[
        int, typer.Option(help="UDP port the ground-station link binds; 0: a free one.")
    ] = 18570,
    host: Annotated[str, typer.Option(help="Address to bind and to send to.")] = "127.0.0.1",
    system_id: Annotated[int, typer.Option(help="MAVLink system id, 1 to 255.")] = 1,
    seed: Annotated[int, typer.Option(help="Of the wind, the gusts and the world.")] = 0,
    wind: Annotated[float, typer.Option(help="Steady wind in m/s; the seed chooses its direction.")] = 0.0,
    camera: Annotated[
        str | None, typer.Option(help="Render a camera into this shared memory; read it as shm://NAME.")
    ] = None,
    camera_rate: Annotated[float, typer.Option(help="Frames per second of the camera.")] = 30.0,
    truth: Annotated[
        Path | None, typer.Option(help="Write the true state to this file, one JSON object a line, 20 Hz.")
    ] = None,
    speed: Annotated[float, typer.Option(help="Simulated seconds per real second.")] = 1.0,
    param: Annotated[
        list[str] | None, typer.Option(help="Set a PX4 parameter, NAME=VALUE; may be repeated.")
    ] = None,
    gimbal: Annotated[bool, typer.Option("--gimbal", help="With a two-axis gimbal.")] = False,
    ready_file: Annotated[
        Path | None, typer.Option(help="Write pid and ports here as JSON once the vehicle runs.")
    ] = None,
    verbose: Annotated[bool, typer.Option("--verbose", help="Log the links too.")] = False,
) -> None:
    """Fly a PX4-like multirotor on UDP until interrupted (Ctrl-C)."""
    logging.basicConfig(
        level=logging.INFO if verbose else logging.WARNING, format="%(levelname)s %(name)s: %(message)s"
    )
    for name, port in (
        ("onboard-port", onboard_port),
        ("onboard-bind", onboard_bind),
        ("gcs-port", gcs_port),
        ("gcs-bind", gcs_bind),
    ):
        _check(name, port, 0 if name.endswith("bind") else 1, 65535)
    _check("system-id", system_id, 1, 255)
    _check("wind", wind, 0.0, MAX_WIND_MPS)
    _check("camera-rate", camera_rate, 1.0, 120.0)
    _check("speed", speed, 0.05, 20.0)
    options = SimulationOptions(
        host=host,
        onboard_port=onboard_port,
        onboard_bind=onboard_bind,
        gcs_port=gcs_port,
        gcs_bind=gcs_bind,
        system_id=system_id,
        seed=seed,
        wind_mps=wind,
        camera=camera,
        camera_rate_hz=camera_rate,
        truth=truth,
        speed=speed,
        parameters=_parameters(param or []),
        gimbal=gimbal,
    )
    try:
        simulation = Simulation(options, on_event=_say)
    except PortInUseError as error:
        _fail(str(error))
    except UnknownParameterError as error:
        _fail(str(error.args[0]))
    except (OSError, ValueError) as error:
        _fail(str(error))
    with simulation:
        _run(simulation, ready_file)


def _run(simulation: Simulation, ready_file: Path | None) -> None:
    def stop(number: int, frame: FrameType | None) -> None:
        simulation.stop()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, stop)
    ports = {name: endpoint.port for name, endpoint in simulation.endpoints.items()}
    options = simulation.options
    if ready_file is not None:
        report = {"pid": os.getpid(), "onboard_bind": ports["onboard"], "gcs_bind": ports["gcs"]}
        partial = ready_file.with_name(ready_file.name + ".partial")
        try:
            partial.write_text(json.dumps(report) + "\n", encoding="utf-8")
            partial.replace(ready_file)  # whoever waits for the file finds it whole
        except OSError as error:
            _fail(f"--ready-file: {error}")
    _say(
        f"ready: system {options.system_id}, "
        f"onboard {options.host}:{ports['onboard']} -> {options.onboard_port}, "
        f"ground station {options.host}:{ports['gcs']} -> {options.gcs_port}"
    )
    simulation.run()
    _say("stopped")


def main() -> None:
    """The console script's entry: what cannot be is said in one line, with exit code 2."""
    try:
        code = app(standalone_mode=False)
    except _USAGE_ERROR as error:
        print(f"mavlink-sim: {error.format_message()}", file=sys.stderr)
        code = 2
    sys.exit(code or 0)
