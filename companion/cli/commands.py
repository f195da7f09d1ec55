"""The command line: `companion run`, `play`, `demo`, `detect`, `send`, `echo` and the others in ORDER.

Heavy parts are imported when their command runs, so that `companion send` starts at once.
What a person did wrong is one line on standard error and exit code 2; what did not work out is exit code 1.
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
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.bench import bench
from companion.cli.evaluate import evaluate
from companion.cli.flags import EXIT_BAD_INPUT, plain_errors, settings_command
from companion.cli.mission import mission
from companion.cli.models import models
from companion.cli.play import play
from companion.settings import Settings
from companion.settings.perception import DEFAULT_MODEL, NO_SOURCE
from vision.gc_pause import gc_paused
from vision.object_detector import YOLO

if TYPE_CHECKING:
    from companion.service import Service

# What concerns a client of a running service.
CLIENT_SETTINGS = ("zenoh", "vehicle.name")
# Of the help: in the order of use.
ORDER = (
    "play",
    "run",
    "demo",
    "detect",
    "send",
    "echo",
    "commands",
    "mission",
    "config",
    "evaluate",
    "train",
)

app = typer.Typer(
    name="companion",
    help="See, steer and share: the companion-computer service for PX4 vehicles.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

app.add_typer(models, name="models")
app.command()(evaluate)
settings_command(app, *CLIENT_SETTINGS, "plugins", "detector")(mission)
settings_command(app)(play)
app.add_typer(bench, name="bench")

EXIT_FAILED = 1
_DEMO_S, _DEMO_ELSEWHERE_S = 150.0, 300.0


def _print_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        typer.echo(f"companion {version('mavlink-companion')}")
        raise typer.Exit


@app.callback()
def every_command(
    version: Annotated[
        bool,
        typer.Option("--version", callback=_print_version, is_eager=True, help="show the version"),
    ] = False,
) -> None:
    """What holds for every command."""


@settings_command(app)
def run(settings: Settings) -> None:
    """Run the service: frames, detections, flight, zenoh. Ends on Ctrl-C or SIGTERM."""
    with gc_paused():
        from companion.bus.session import BusError
        from companion.operator.line_output import use_for_standard_error
        from companion.operator.metrics import MetricsError
        from companion.perception.supervisor import PerceptionStartError
        from companion.plugins import PluginError
        from companion.service import Service
        from companion.vehicle.driver import LinkError

    # From here on a reader of standard error that stalls stops nothing; before handlers take the stream.
    output = use_for_standard_error()
    logging.basicConfig(
        level=settings.log.level.upper(), format="%(levelname)s %(name)s: %(message)s", stream=sys.stderr
    )
    with plain_errors(LinkError, PerceptionStartError, BusError, MetricsError, PluginError):
        service = Service(
            settings, console=True, dropped_lines=lambda: 0 if output is None else output.dropped
        )
        asyncio.run(_run_until_signal(settings, service))


def _keep_what_is_loaded() -> None:
    """From now on the garbage collector passes over what was loaded: looking through it holds a setpoint up.

    All that this process imported takes it 15 ms.
    """
    gc.collect()
    gc.freeze()


def _warn_synthetic_model(looked_at: Iterable[tuple[str, str]]) -> None:
    """Say once that the bundled model is not for real pictures, if it is to look at any.

    Args:
        looked_at: (address of a source, model) of each detector. The simulator's camera is read from shared
            memory; what comes from anywhere else may be a photograph.
    """
    real = [model for uri, model in looked_at if uri != NO_SOURCE and not uri.startswith("shm://")]
    if DEFAULT_MODEL in real:
        typer.echo(
            f"companion: the bundled model '{DEFAULT_MODEL}' knows only scenes drawn by mavlink-sim and is "
            "wrong about real pictures; for those run `companion models pull yolo11n`, then use "
            "--model yolo11n",
            err=True,
        )


async def _run_until_signal(settings: Settings, service: Service) -> None:
    loop = asyncio.get_running_loop()

    def on_ready() -> None:
        _keep_what_is_loaded()
        views = [settings.of_view(name) for name in (None, *settings.cameras)]
        _warn_synthetic_model(
            (view.source.uri, view.detector.model)
            for view in views
            if view.detector.enabled and view.detector.kind == YOLO
        )

    running = asyncio.ensure_future(service.run(on_ready))
    for number in (signal.SIGINT, signal.SIGTERM):
        # Before the service is up there is nothing to leave in order: end at once.
        loop.add_signal_handler(number, lambda: service.stop() if service.ready else running.cancel())
    try:
        await running
    except asyncio.CancelledError:
        raise typer.Exit(EXIT_FAILED) from None


@app.command()
def demo(
    duration: Annotated[
        float | None,
        typer.Option(min=20, help="give up after so many seconds; default: 150, with --vehicle-url 300"),
    ] = None,
    output: Annotated[Path, typer.Option(help="where the video and summary.json go")] = Path("demo-output"),
    seed: Annotated[int, typer.Option(min=0, help="of the world: where the car stands, the wind")] = 1,
    vehicle_url: Annotated[
        str | None,
        typer.Option(help="fly the autopilot that sends to this UDP port instead: udpin://127.0.0.1:14540"),
    ] = None,
    seeds: Annotated[
        str | None, typer.Option(help="fly many in lockstep instead, without a video: 1..50, or 3,7,9..12")
    ] = None,
    processes: Annotated[int, typer.Option(min=1, help="flights at once, with --seeds")] = 1,
    synthetic: Annotated[
        bool, typer.Option("--synthetic", help="with --seeds: detections made of the truth, no network")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="with --seeds: one JSON object")] = False,
) -> None:
    """Fly a vehicle to a car it has to find: the whole way, from frames to landing.

    The vehicle is the built-in one. With --vehicle-url it is another autopilot, disarmed on the ground, and
    the camera is drawn from the position it reports; its parameters are not changed.
    """
    if seeds is not None and vehicle_url is not None:
        typer.echo("companion: --seeds flies the built-in vehicle; leave out --vehicle-url", err=True)
        raise typer.Exit(EXIT_BAD_INPUT)
    if seeds is not None:
        _fly_seeds(seeds, processes, synthetic=synthetic, as_json=as_json)
        return
    from companion.bus.session import BusError
    from companion.demo import run_demo
    from companion.perception.supervisor import PerceptionStartError
    from companion.sim_session import SimSessionError
    from companion.vehicle.driver import LinkError

    logging.basicConfig(level=logging.WARNING, format="companion: %(message)s", stream=sys.stderr)
    # What the service logs is said here with its time: once is enough.
    service = logging.getLogger("companion.service")
    service.propagate = False
    service.addHandler(logging.NullHandler())
    with plain_errors(SimSessionError, LinkError, PerceptionStartError, BusError, OSError):
        # PX4 comes home at 30 m (RTL_RETURN_ALT), and nobody's parameters are set unasked.
        limit_s = duration or (_DEMO_S if vehicle_url is None else _DEMO_ELSEWHERE_S)
        summary = run_demo(
            output, seed=seed, limit_s=limit_s, say=_print_with_time(), vehicle_url=vehicle_url
        )
    if not summary.success:
        typer.echo(f"the demonstration failed: {summary.failure}; see {output}", err=True)
        raise typer.Exit(EXIT_FAILED)
    source = "simulator's truth" if summary.truth == "simulator" else "autopilot's own position"
    typer.echo(
        f"found, reached (stopped {summary.final_range_m} m from the car, by the {source}), landed; "
        f"{summary.detections_published} detection messages. Video: {output / summary.video}"
    )


def _fly_seeds(text: str, processes: int, *, synthetic: bool, as_json: bool) -> None:
    from rich.console import Console

    from companion.bench.demo_flight import demos_summary, demos_table, fly_demos, seeds_of

    logging.basicConfig(level=logging.ERROR, format="companion: %(message)s", stream=sys.stderr)
    with plain_errors(ValueError):
        seeds = seeds_of(text)
    flights = []
    for flight in fly_demos(seeds, processes=processes, synthetic=synthetic):
        flights.append(flight)
        words = "success" if flight.success else f"failed: {flight.failure}"
        typer.echo(f"seed {flight.seed}: {words}", err=True)
    if as_json:
        typer.echo(json.dumps(demos_summary(flights)))
    else:
        Console(width=None if sys.stdout.isatty() else 160).print(demos_table(flights))
    if not all(flight.success for flight in flights):
        raise typer.Exit(EXIT_FAILED)


def _print_with_time() -> Callable[[str], None]:
    started = time.monotonic()
    return lambda text: typer.echo(f"{time.monotonic() - started:6.1f} s  {text}")


@app.command()
def detect(
    source: Annotated[str, typer.Argument(help="file, folder, /dev/video0, FIFO, - or network address")],
    detector_kind: Annotated[str, typer.Option(help="yolo, or that of a plug-in")] = YOLO,
    model: Annotated[
        str, typer.Option(help="a checkpoint, an exported file, or a name in the models folder")
    ] = "default",
    classes: Annotated[str | None, typer.Option(help="only these: names or ids, comma separated")] = None,
    confidence: Annotated[float, typer.Option(min=0, max=1)] = 0.25,
    iou: Annotated[float, typer.Option(min=0, max=1, help="overlap above which boxes are one")] = 0.7,
    image_size: Annotated[int, typer.Option(min=32, help="longer side the network sees, pixels")] = 640,
    runtime: Annotated[str, typer.Option(help="torch, onnxruntime, openvino, tensorrt or auto")] = "torch",
    precision: Annotated[str, typer.Option(help="auto, float32, bfloat16 or float16")] = "auto",
    threads: Annotated[int | None, typer.Option(min=1, help="processor threads of the network")] = None,
    every: Annotated[int, typer.Option(min=1, help="look at every N-th frame")] = 1,
    limit: Annotated[int | None, typer.Option(min=1, help="end after so many frames")] = None,
    tiles: Annotated[
        bool, typer.Option("--tiles", help="look at large frames in tiles too: small objects, much slower")
    ] = False,
    tile_size: Annotated[int, typer.Option(min=64, help="side of a tile, pixels of the frame")] = 640,
    tile_overlap: Annotated[float, typer.Option(min=0, max=0.8, help="of tiles, share of a tile")] = 0.2,
    track: Annotated[
        bool, typer.Option("--track", help="tell which object is which from frame to frame")
    ] = False,
    save: Annotated[Path | None, typer.Option(help="folder for inputs and annotated images")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="one JSON object a frame")] = False,
    width: Annotated[int | None, typer.Option(min=1, help="of raw frames or a camera, pixels")] = None,
    height: Annotated[int | None, typer.Option(min=1, help="of raw frames or a camera, pixels")] = None,
    rate: Annotated[float | None, typer.Option(min=0.1, help="of a camera or raw file, Hz")] = None,
    pixel_format: Annotated[str | None, typer.Option(help="bgr24, rgb24, gray8, y4m, mjpeg, YUYV…")] = None,
    plugins_modules: Annotated[
        str | None, typer.Option(help="modules or names of plug-ins to load, comma separated")
    ] = None,
) -> None:
    """Detect objects in every frame of a source; one line a frame on standard output."""
    with gc_paused():
        from companion.detect import detect_source
        from companion.plugins import PluginError, load_plugins
        from vision.object_detector import DetectorSettings, open_detector
        from vision.pipeline import FrameDetector
        from vision.sources import SourceError, SourceSettings, open_source
        from vision.tiling import TiledDetector
        from vision.tracking import Tracker, TrackerSettings

    logging.basicConfig(level=logging.WARNING, format="companion: %(message)s", stream=sys.stderr)
    following = TrackerSettings(keep_confidence=confidence)
    with plain_errors(PluginError, ValueError):  # CheckpointError is a ValueError
        load_plugins(parse_words(plugins_modules))
        wanted = DetectorSettings(
            model,
            classes=parse_classes(classes),
            # A tracker wants to see the weak ones too, and leaves them out again.
            confidence=min(confidence, following.low_confidence) if track else confidence,
            iou=iou,
            image_size=image_size,
            precision=precision,  # type: ignore[arg-type]
            threads=threads,
            runtime=runtime,  # type: ignore[arg-type]
        )
        detector = open_detector(detector_kind, wanted)
        if runtime == "auto" and detector.runtime is not None:
            typer.echo(f"companion: on {detector.runtime} ({detector.reason})", err=True)
        looking: FrameDetector = detector
        if tiles:
            looking = TiledDetector(detector, tile_size=tile_size, overlap=tile_overlap)
        settings = SourceSettings(
            width=width, height=height, rate_hz=rate, pixel_format=pixel_format, every_frame=True
        )
    write = functools.partial(print, flush=True)
    with plain_errors(SourceError, OSError), open_source(source, settings) as frames:
        if detector_kind == YOLO:
            _warn_synthetic_model([(source, model)])
        looked_at = detect_source(
            frames,
            looking,
            every=every,
            limit=limit,
            save=save,
            as_json=as_json,
            tracker=Tracker(following) if track else None,
            write=write,
        )
    if not looked_at:
        typer.echo(f"companion: {source} had no frames", err=True)
        raise typer.Exit(EXIT_BAD_INPUT)


def parse_words(text: str | None) -> list[str]:
    """`a, b` as a list; empty for None."""
    return [word.strip() for word in (text or "").split(",") if word.strip()]


def parse_classes(text: str | None) -> tuple[str | int, ...] | None:
    """`person,car` or `0,2` as a detector takes them; None for all."""
    if text is None or not text.strip():
        return None
    return tuple(int(word) if word.isdigit() else word for word in parse_words(text))


@app.command()
def train(
    output: Annotated[Path, typer.Option(help="what to write: NAME.safetensors and NAME.yaml")] = Path(
        "runs/model.safetensors"
    ),
    seed: Annotated[int | None, typer.Option(min=0, help="of weights and scenes; else the recipe's")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="a shorter or longer course")] = None,
    hours: Annotated[float | None, typer.Option(min=0.001, help="stop after so long")] = None,
    workers: Annotated[int | None, typer.Option(min=0, help="processes that draw scenes")] = None,
    threads: Annotated[int | None, typer.Option(min=1, help="processor threads of torch")] = None,
    resume: Annotated[bool, typer.Option(help="go on from OUTPUT's training state")] = False,
    start: Annotated[Path | None, typer.Option(help="weights to refine, instead of the first course")] = None,
    held_out: Annotated[int, typer.Option(min=1, help="scenes to judge the result on")] = 400,
) -> None:
    """Train the default detector on drawn scenes, judge it on held-out ones, write it with its score."""
    from companion.train import train_default
    from vision.yolo.safe_pickle import CheckpointError

    logging.basicConfig(level=logging.INFO, format="%(message)s", stream=sys.stderr)
    with plain_errors(CheckpointError, FileNotFoundError, ValueError, OSError):
        score = train_default(
            output,
            seed=seed,
            steps=steps,
            time_limit_s=None if hours is None else hours * 3600,
            workers=workers,
            threads=threads,
            resume=resume,
            start=start,
            held_out=held_out,
        )
    typer.echo(
        f"{output.with_suffix('.safetensors')}: mAP50 {score.map50:.3f}, mAP50-95 {score.map50_95:.3f} "
        f"on {held_out} held-out scenes"
    )


@settings_command(app)
def config(settings: Settings) -> None:
    """Print the effective settings as a TOML file with a comment on every key."""
    from companion.settings.reading import to_toml

    typer.echo(to_toml(settings), nl=False)


@settings_command(app, "plugins")
def commands(
    settings: Settings,
    as_json: Annotated[bool, typer.Option("--json", help="as JSON Schema")] = False,
    as_markdown: Annotated[bool, typer.Option("--markdown", help="as tables for documentation")] = False,
) -> None:
    """List what `companion send` takes, plug-ins included: words, arguments, units and ranges."""
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
    command: Annotated[str, typer.Argument(help='such as "seek car" or "approach person distance=3"')],
    connect: Annotated[str | None, typer.Option(help="zenoh endpoint of the service or its router")] = None,
    timeout: Annotated[float, typer.Option(min=0.1, help="seconds to wait for the outcome")] = 300.0,
) -> None:
    """Send one command to a running service and wait for its outcome."""
    from companion.bus.client import NoAnswerError, client_settings, open_client, send_command

    with plain_errors(NoAnswerError):
        where = client_settings(settings.zenoh, (connect,) if connect else ())
        with open_client(where) as session:
            reply = send_command(session, settings.vehicle.name, command, timeout_s=timeout)
    typer.echo(f"{'done' if reply['success'] else 'failed'}: {reply['reason']}")
    if not reply["success"]:
        raise typer.Exit(EXIT_FAILED)


@settings_command(app, *CLIENT_SETTINGS)
def echo(
    settings: Settings,
    key: Annotated[str, typer.Argument(help="a topic (labels), or a zenoh key with wildcards")] = "**",
    connect: Annotated[str | None, typer.Option(help="zenoh endpoint of the service or its router")] = None,
    limit: Annotated[int | None, typer.Option(min=1, help="end after so many messages")] = None,
) -> None:
    """Print what a running service publishes: key and message, one line each."""
    import queue

    from companion.bus.client import NoAnswerError, check_topic, client_settings, listen, open_client

    messages: queue.SimpleQueue[tuple[str, str]] = queue.SimpleQueue()
    with plain_errors(ValueError):
        check_topic(key)
    with plain_errors(NoAnswerError):
        where = client_settings(settings.zenoh, (connect,) if connect else ())
        with open_client(where) as session:
            subscriber = listen(session, key, lambda name, text: messages.put((name, text)))
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


def _place(command: typer.models.CommandInfo) -> int:
    name = command.name or getattr(command.callback, "__name__", "")
    return ORDER.index(name) if name in ORDER else len(ORDER)


app.registered_commands.sort(key=_place)


def main() -> None:
    """The console script."""
    # The reader of our output may go (`| head`): end quietly, as other programs of a pipeline do.
    if sys.argv[1:2] in (["detect"], ["echo"]):
        signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    app()
