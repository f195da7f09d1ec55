"""The command line of `companion bench detector|latency|setpoints|deadman|chaos`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from companion.cli.flags import EXIT_FAILED, AsJson, Command, Device, ImageSize, Model, Threads, plain_errors

bench = typer.Typer(help="Measure performance on this machine.", no_args_is_help=True)


@bench.command("detector", cls=Command)
def bench_detector(
    model: Model = "default",
    runtime: Annotated[
        str | None,
        typer.Option(
            help="Runtime: torch, onnxruntime, openvino, tensorrt or auto. Default: all that run it."
        ),
    ] = None,
    image_size: ImageSize = 640,
    frame: Annotated[str, typer.Option(help="Image size, WIDTHxHEIGHT.")] = "640x480",
    frames: Annotated[int, typer.Option(min=5, help="Number of frames after a warm-up.")] = 100,
    threads: Threads = None,
    precision: Annotated[str, typer.Option(help="Precision: auto, float32, bfloat16 or float16.")] = "auto",
    device: Device = "cpu",
    classes: Annotated[
        str | None, typer.Option(help="Classes to detect: names or ids, comma separated. Default: all.")
    ] = None,
    against: Annotated[Path | None, typer.Option(help="Earlier --json result to compare with.")] = None,
    as_json: AsJson = False,
) -> None:
    """Measure the time per frame of each runtime. Prints milliseconds from pixels to boxes."""
    from companion.bench.detector import BenchError, measure_detectors, read_result, table
    from vision.detector import DEFAULT_MODEL
    from vision.model_files import find_model
    from vision.runtimes.base import RUNTIMES, installed
    from vision.runtimes.source import read_source

    try:
        width, height = (int(number) for number in frame.split("x"))
    except ValueError:
        raise typer.BadParameter(f"{frame!r} is not WIDTHxHEIGHT", param_hint="--frame") from None
    named = None if classes is None else [name.strip() for name in classes.split(",") if name.strip()]
    with plain_errors(BenchError, ValueError):
        earlier = None if against is None else read_result(against)
        if runtime is not None:
            wanted = [runtime]
        else:
            known = RUNTIMES if model == DEFAULT_MODEL else read_source(find_model(model)).runners()
            wanted = [name for name in known if installed(name)] or [known[0]]
        result = measure_detectors(
            model,
            runtimes=wanted,
            image_size=image_size,
            frames=frames,
            threads=threads,
            precision=precision,
            device=device,
            classes=named,
            width=width,
            height=height,
        )
    if as_json:
        typer.echo(json.dumps(result))
        return
    for line in table(result, earlier):
        typer.echo(line)


@bench.command("latency", cls=Command)
def bench_latency(
    seconds: Annotated[
        float, typer.Option(min=1, help="Duration of the measurement in flight, seconds.")
    ] = 10.0,
    driver: Annotated[Literal["pymavlink", "mavsdk"], typer.Option(help="Driver.")] = "pymavlink",
    as_json: AsJson = False,
) -> None:
    """Measure the latency from frame to setpoint. Flies the simulated vehicle."""
    from companion.bench.latency import measure_latency
    from companion.bus.session import BusError
    from companion.perception.supervisor import PerceptionStartError
    from companion.settings.reading import ConfigurationError
    from companion.simulation.session import SimSessionError
    from companion.vehicle.driver import LinkError

    with plain_errors(SimSessionError, ConfigurationError, LinkError, PerceptionStartError, BusError):
        _print_figures(measure_latency(seconds, driver=driver), as_json)


@bench.command("setpoints", cls=Command)
def bench_setpoints(
    seconds: Annotated[float, typer.Option(min=1, help="Duration of the measurement.")] = 10.0,
    rate_hz: Annotated[float, typer.Option(min=5, max=250, help="Setpoint rate, Hz.")] = 50.0,
    load: Annotated[int, typer.Option(min=0, help="Number of CPU-bound processes beside the loop.")] = 2,
    as_json: AsJson = False,
) -> None:
    """Measure setpoint spacing under CPU load."""
    from companion.bench.setpoints import measure_setpoints

    with plain_errors(RuntimeError):
        figures = measure_setpoints(seconds, rate_hz=rate_hz, load=load)
    _print_figures(figures, as_json)


@bench.command("deadman", cls=Command)
def bench_deadman(
    runs: Annotated[int, typer.Option(min=1, help="Number of flights per fault, half a minute each.")] = 3,
    as_json: AsJson = False,
) -> None:
    """Measure the reaction to process faults. Prints seconds until braking, stop and leaving OFFBOARD."""
    from rich.console import Console

    from companion.bench.deadman import deadman_table, measure_deadman
    from companion.bus.client import NoAnswerError
    from companion.bus.session import BusError
    from companion.simulation.session import SimSessionError

    with plain_errors(SimSessionError, BusError, NoAnswerError):
        figures = measure_deadman(runs)
    if as_json:
        typer.echo(json.dumps(figures))
    else:
        Console().print(deadman_table(figures))


@bench.command("chaos", cls=Command)
def bench_chaos(
    minutes: Annotated[float, typer.Option(min=0.1, help="Duration after the warm-up, minutes.")] = 30.0,
    seed: Annotated[int, typer.Option(help="Of the order of the faults and of the world.")] = 1,
    period_s: Annotated[float, typer.Option(min=5.0, help="Time between two faults, seconds.")] = 60.0,
    log: Annotated[Path | None, typer.Option(help="File for what the service prints.")] = None,
    as_json: AsJson = False,
) -> None:
    """Fly the demonstration with a fault every minute. Prints flights and growth.

    Every flight must land, and the service's processes may not grow: by 5 MB at most, descriptors and threads
    not at all. Exit code 1 otherwise.
    """
    from companion.bench.chaos import lines_of, run_chaos
    from companion.bus.client import NoAnswerError
    from companion.bus.session import BusError
    from companion.simulation.session import SimSessionError

    def say(line: str) -> None:
        if not as_json:
            typer.echo(line)

    with plain_errors(SimSessionError, BusError, NoAnswerError, OSError, code=EXIT_FAILED):
        result = run_chaos(minutes, seed=seed, period_s=period_s, say=say, log_path=log)
    for line in [json.dumps(result.as_dict())] if as_json else lines_of(result):
        typer.echo(line)
    if not result.success:
        raise typer.Exit(EXIT_FAILED)


def _print_figures(figures: dict[str, Any], as_json: bool) -> None:
    if as_json:
        typer.echo(json.dumps(figures))
        return
    width = max(len(name) for name in figures)
    for name, value in figures.items():
        typer.echo(f"{name:<{width}}  {value}")
