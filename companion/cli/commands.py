"""The command line: `companion run`, `play`, `demo`, `detect`, `send`, `echo` and the others in ORDER.

Heavy modules are imported when their command runs, so that `companion send` starts quickly.
Invalid input prints one line on standard error and exits with code 2; a failed operation exits with code 1.
"""

from __future__ import annotations

import asyncio
import functools
import gc
import json
import logging
import signal
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.ask import ASK_SETTINGS, ask
from companion.cli.bench import bench
from companion.cli.calibrate import calibrate
from companion.cli.cameras import cameras, depth, preview
from companion.cli.cloud import CLOUD_SETTINGS, cloud
from companion.cli.dashboard import dashboard
from companion.cli.evaluate import evaluate
from companion.cli.flags import (
    EXIT_BAD_INPUT,
    CompanionCommands,
    Processes,
    RayAddress,
    check_seed_options,
    plain_errors,
    settings_command,
)
from companion.cli.markers import MARKER_SETTINGS, markers
from companion.cli.mcp import MCP_SETTINGS, mcp
from companion.cli.mission import mission
from companion.cli.models import models
from companion.cli.play import play
from companion.cli.recordings import RECORD_SETTINGS, collect, log, record, replay, sightings
from companion.cli.topics import topics
from companion.cli.train import train
from companion.cli.train_policy import train_policy
from companion.settings import Settings
from vision.gc_pause import gc_paused
from vision.object_detector import YOLO

if TYPE_CHECKING:
    from companion.service import Service

# Settings of a client of a running service.
CLIENT_SETTINGS = ("zenoh", "vehicle.name")
# Order of the commands in the help: by use.
ORDER = (
    "play",
    "run",
    "demo",
    "detect",
    "send",
    "echo",
    "ask",
    "mcp",
    "cameras",
    "preview",
    "depth",
    "dashboard",
    "commands",
    "topics",
    "mission",
    "cloud",
    "record",
    "replay",
    "sightings",
    "config",
    "markers",
    "collect",
    "evaluate",
    "train",
    "train-policy",
)

app = typer.Typer(
    name="companion",
    cls=CompanionCommands,
    help="Companion-computer service for PX4 and ArduPilot: detection, offboard flight, zenoh.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

app.add_typer(models, name="models")
app.add_typer(calibrate, name="calibrate")
app.command()(evaluate)
app.command()(train)
app.command()(train_policy)
app.command()(topics)
app.command()(cameras)
settings_command(app, "source", "camera", "vehicle", "plugins")(preview)
settings_command(app, "source", "camera", "detector", "tracker", "vehicle.name", "plugins")(depth)
settings_command(app, *CLIENT_SETTINGS, "plugins", "detector")(mission)
settings_command(app, *CLOUD_SETTINGS)(cloud)
settings_command(app, *ASK_SETTINGS)(ask)
settings_command(app, *MCP_SETTINGS)(mcp)
settings_command(app)(play)
settings_command(app, *MARKER_SETTINGS)(markers)
settings_command(app, *CLIENT_SETTINGS, "dashboard", "language", "plugins")(dashboard)
app.add_typer(bench, name="bench")
settings_command(app, *CLIENT_SETTINGS, *RECORD_SETTINGS)(record)
settings_command(app, "plugins")(replay)
app.command()(sightings)
settings_command(app, *CLIENT_SETTINGS)(collect)
app.add_typer(log, name="log")

EXIT_FAILED = 1
_DEMO_S, _DEMO_AUTOPILOT_S = 150.0, 300.0


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"companion {version('mavlink-companion')}")
        raise typer.Exit


@app.callback()
def every_command(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version."),
    ] = False,
) -> None:
    """Options of every command."""


@settings_command(app)
def run(settings: Settings) -> None:
    """Run the service. Ends on Ctrl-C or SIGTERM."""
    with gc_paused():
        from companion.bus.session import BusError
        from companion.language.process import AskProcess
        from companion.operator.line_output import use_for_standard_error
        from companion.operator.metrics import MetricsError
        from companion.perception.supervisor import PerceptionStartError
        from companion.plugins import PluginError
        from companion.service import Service
        from companion.vehicle.driver import LinkError

    # A stalled reader of standard error must not block the service. Before any handler uses the stream.
    output = use_for_standard_error()
    logging.basicConfig(
        level=settings.log.level.upper(), format="%(levelname)s %(name)s: %(message)s", stream=sys.stderr
    )
    with plain_errors(LinkError, PerceptionStartError, BusError, MetricsError, PluginError):
        service = Service(
            settings,
            console=True,
            ask=AskProcess(settings),
            dropped_lines=lambda: 0 if output is None else output.dropped,
        )
        asyncio.run(_run_until_signal(settings, service))


def _freeze_loaded_objects() -> None:
    """Exclude all loaded objects from garbage collection.

    A full collection of everything imported takes 15 ms, which would delay a setpoint.
    """
    gc.collect()
    gc.freeze()


def _warn_rendered_only(models: Iterable[tuple[str, str | None]]) -> None:
    """Warn once if a model of rendered scenes may process camera images.

    Args:
        models: (source URI, name) of each model that was trained on rendered scenes only. The simulated
            camera is read from shared memory. Any other source, the simulator's streams included, looks like
            a camera.
    """
    for uri, model in models:
        if not uri.startswith("shm://"):
            typer.echo(
                f"companion: the model '{model}' is trained on rendered scenes only and does not work on "
                "camera images; if these are camera images, run `companion models pull yolo11n`, "
                "then use --model yolo11n",
                err=True,
            )
            return


async def _run_until_signal(settings: Settings, service: Service) -> None:
    loop = asyncio.get_running_loop()
    ready = asyncio.Event()

    def on_ready() -> None:
        ready.set()
        _freeze_loaded_objects()
        # Shared frames of one of our cameras are those of its source.
        sources = [camera.settings.source for camera in service.cameras]
        shared = {f"shm://{source.share}": source.uri for source in sources}
        _warn_rendered_only(
            (shared.get(source.uri, source.uri), loaded.model)
            for camera, source in zip(service.cameras, sources, strict=True)
            if (loaded := camera.supervisor.ready) is not None and loaded.rendered_only
        )

    running = asyncio.ensure_future(service.run(on_ready))
    for number in (signal.SIGINT, signal.SIGTERM):
        # Before the service is ready there is nothing to shut down.
        loop.add_signal_handler(number, lambda: service.stop() if service.ready else running.cancel())
    page = asyncio.create_task(_run_dashboard(settings, ready))
    try:
        await running
    except asyncio.CancelledError:
        raise typer.Exit(EXIT_FAILED) from None
    finally:
        page.cancel()
        await asyncio.gather(page, return_exceptions=True)


async def _run_dashboard(settings: Settings, ready: asyncio.Event) -> None:
    """Run the page once the service is ready, until cancelled."""
    from companion.dashboard.process import dashboard_process

    def say(line: str) -> None:
        logger = logging.getLogger("companion")
        logger.log(logging.INFO if "http://" in line else logging.WARNING, "%s", line)

    await ready.wait()
    async with dashboard_process(settings, say):
        await asyncio.Event().wait()


@app.command()
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
    from companion.demo import run_demo
    from companion.operator.line_output import LineOutput, use_for_standard_error
    from companion.perception.supervisor import PerceptionStartError
    from companion.sim_session import SimSessionError
    from companion.vehicle.driver import LinkError

    use_for_standard_error()
    logging.basicConfig(level=logging.WARNING, format="companion: %(message)s", stream=sys.stderr)
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
    from companion.campaign import ClusterError, SeedError, seeds_of

    logging.basicConfig(level=logging.ERROR, format="companion: %(message)s", stream=sys.stderr)
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
        Console(width=None if sys.stdout.isatty() else 160).print(demos_table(flights))
    if not all(flight.success for flight in flights):
        raise typer.Exit(EXIT_FAILED)


@app.command()
def detect(
    source: Annotated[
        str, typer.Argument(help="File, folder, /dev/video0, FIFO, - (standard input) or URL.")
    ],
    detector_kind: Annotated[str, typer.Option(help="Detector kind: yolo, or that of a plug-in.")] = YOLO,
    model: Annotated[
        str, typer.Option(help="Checkpoint, exported file, or name in the models folder.")
    ] = "default",
    classes: Annotated[
        str | None, typer.Option(help="Classes to detect: names or ids, comma separated. Default: all.")
    ] = None,
    confidence: Annotated[float, typer.Option(min=0, max=1, help="Confidence threshold.")] = 0.25,
    iou: Annotated[
        float | None,
        typer.Option(min=0, max=1, help="NMS IoU threshold. Default: that of the model, else 0.7."),
    ] = None,
    image_size: Annotated[
        int, typer.Option(min=32, help="Longer side of the network's input, pixels.")
    ] = 640,
    runtime: Annotated[
        str, typer.Option(help="Runtime: torch, onnxruntime, openvino, tensorrt or auto.")
    ] = "torch",
    precision: Annotated[str, typer.Option(help="Precision: auto, float32, bfloat16 or float16.")] = "auto",
    device: Annotated[str, typer.Option(help="Device of torch: cpu or cuda.")] = "cpu",
    threads: Annotated[int | None, typer.Option(min=1, help="CPU threads of the network.")] = None,
    retune: Annotated[
        bool, typer.Option("--retune", help="Measure this model's runtimes and precisions again.")
    ] = False,
    every: Annotated[int, typer.Option(min=1, help="Process every Nth frame.")] = 1,
    limit: Annotated[int | None, typer.Option(min=1, help="Maximum number of frames.")] = None,
    tiles: Annotated[
        bool, typer.Option("--tiles", help="Process large frames in tiles too: small objects, much slower.")
    ] = False,
    tile_size: Annotated[int, typer.Option(min=64, help="Side of a tile, pixels of the frame.")] = 640,
    tile_overlap: Annotated[
        float, typer.Option(min=0, max=0.8, help="Overlap of tiles, fraction of a tile.")
    ] = 0.2,
    track: Annotated[bool, typer.Option("--track", help="Enable multi-object tracking.")] = False,
    save: Annotated[Path | None, typer.Option(help="Folder for input and annotated images.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object per frame.")] = False,
    width: Annotated[int | None, typer.Option(min=1, help="Width of raw frames or a camera, pixels.")] = None,
    height: Annotated[
        int | None, typer.Option(min=1, help="Height of raw frames or a camera, pixels.")
    ] = None,
    rate: Annotated[
        float | None, typer.Option(min=0.1, help="Frame rate of a camera or raw file, Hz.")
    ] = None,
    pixel_format: Annotated[
        str | None, typer.Option(help="Pixel format: bgr24, rgb24, gray8, yuv420, y4m, mjpeg, YUYV…")
    ] = None,
    plugins_modules: Annotated[
        str | None, typer.Option(help="Plug-ins to load: modules or names, comma separated.")
    ] = None,
) -> None:
    """Detect objects in the frames of a source. Prints a line per frame, and a summary on standard error."""
    with gc_paused():
        from companion.detect import detect_source, make_save_folder
        from companion.plugins import PluginError, load_plugins
        from vision.detector import forget_measurements, open_detector
        from vision.object_detector import DetectionsError, DetectorSettings
        from vision.pipeline import FrameDetector
        from vision.runtimes.base import RuntimeUnusableError
        from vision.sources import SourceError, SourceSettings, open_source
        from vision.tiling import TiledDetector
        from vision.tracking import Tracker, TrackerSettings

    logging.basicConfig(level=logging.WARNING, format="companion: %(message)s", stream=sys.stderr)
    tracking = TrackerSettings(keep_confidence=confidence)
    with plain_errors(PluginError, OSError, ValueError):  # CheckpointError is a ValueError
        if save is not None:
            make_save_folder(save, source)
        load_plugins(parse_words(plugins_modules))
        wanted = DetectorSettings(
            model,
            classes=parse_classes(classes),
            # A tracker also uses weak detections, and drops those without a track.
            confidence=min(confidence, tracking.low_confidence) if track else confidence,
            iou=iou,
            image_size=image_size,
            precision=precision,  # type: ignore[arg-type]
            device=device,  # type: ignore[arg-type]
            threads=threads,
            runtime=runtime,  # type: ignore[arg-type]
        )
        if retune and detector_kind == YOLO:
            forget_measurements(model)
        detector = open_detector(detector_kind, wanted)
        if runtime == "auto" and detector.runtime is not None:
            typer.echo(f"companion: on {detector.runtime} ({detector.reason})", err=True)
        frame_detector: FrameDetector = detector
        if tiles:
            frame_detector = TiledDetector(detector, tile_size=tile_size, overlap=tile_overlap)
        settings = SourceSettings(
            width=width, height=height, rate_hz=rate, pixel_format=pixel_format, every_frame=True
        )
    write = functools.partial(print, flush=True)
    unusable = (SourceError, OSError, RuntimeUnusableError, DetectionsError)
    with plain_errors(*unusable), open_source(source, settings) as frames:
        if detector.rendered_only:
            _warn_rendered_only([(source, detector.model_name)])
        summary = detect_source(
            frames,
            frame_detector,
            every=every,
            limit=limit,
            save=save,
            as_json=as_json,
            tracker=Tracker(tracking) if track else None,
            write=write,
        )
    if not summary.frames:
        typer.echo(f"companion: {source}: contains no frames", err=True)
        raise typer.Exit(EXIT_BAD_INPUT)
    typer.echo(f"companion: {summary}", err=True)


def parse_words(text: str | None) -> list[str]:
    """Split `a, b` into a list; empty for None."""
    return [word.strip() for word in (text or "").split(",") if word.strip()]


def parse_classes(text: str | None) -> tuple[str | int, ...] | None:
    """Parse `person,car` or `0,2` into class names and ids; None for all."""
    if text is None or not text.strip():
        return None
    return tuple(int(word) if word.isdigit() else word for word in parse_words(text))


@settings_command(app)
def config(settings: Settings) -> None:
    """Print the effective settings. The output is a TOML file with a comment on every key."""
    from companion.settings.reading import to_toml

    typer.echo(to_toml(settings), nl=False)


@settings_command(app, "plugins")
def commands(
    settings: Settings,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON Schema.")] = False,
    as_markdown: Annotated[bool, typer.Option("--markdown", help="Print Markdown tables.")] = False,
) -> None:
    """List the flight commands. Prints arguments, units and ranges, including those of plug-ins."""
    from companion.guidance.grammar import describe, json_schema, markdown
    from companion.plugins import PluginError, load_plugins

    with plain_errors(PluginError):
        load_plugins(settings.plugins.modules)
    text = json.dumps(json_schema(), indent=2) if as_json else markdown() if as_markdown else describe()
    typer.echo(text, nl=not as_markdown)


def _known_commands() -> str:
    from companion.guidance.grammar import summary

    return summary()


@settings_command(app, *CLIENT_SETTINGS, epilog=_known_commands)
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
            reply = send_command(session, settings.vehicle.name, command, timeout_s=timeout)
    typer.echo(reply_text(reply))
    if not reply["success"]:
        raise typer.Exit(EXIT_FAILED)


@settings_command(app, *CLIENT_SETTINGS)
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


def _help_position(command: typer.models.CommandInfo) -> int:
    name = command.name or getattr(command.callback, "__name__", "")
    return ORDER.index(name) if name in ORDER else len(ORDER)


app.registered_commands.sort(key=_help_position)


def main() -> None:
    """Run the console script."""
    # End quietly when the reader of a pipe has gone (`| head`).
    if sys.argv[1:2] in (["detect"], ["echo"], ["preview"], ["depth"]):
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    app()
