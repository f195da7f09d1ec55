"""`companion record`, `replay`, `sightings` and `log`: recordings of flights."""

from __future__ import annotations

import json
import signal
import threading
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.flags import EXIT_BAD_INPUT, plain_errors

if TYPE_CHECKING:
    from companion.settings import Settings

EXIT_DIFFERENT = 1
RECORD_SETTINGS = tuple(f"recording.{key}" for key in ("content", "max_file_mb", "max_total_mb"))

log = typer.Typer(
    help="List and show recordings.",
    no_args_is_help=True,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


def record(
    settings: Settings,
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="Folder for the recordings.")],
    connect: Annotated[str | None, typer.Option(help="Zenoh endpoint of the service or its router.")] = None,
) -> None:
    """Record a running service. Writes MCAP files until Ctrl-C or SIGTERM."""
    from companion.bus.client import NoAnswerError, client_settings
    from companion.bus.config import BusError
    from companion.recording import RecordingError
    from companion.recording.recorder import RecorderOptions
    from companion.recording.recorder import record as record_until

    ending = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ending.set())
    recording = settings.recording
    with plain_errors(RecordingError, NoAnswerError, BusError):
        options = RecorderOptions(
            zenoh=client_settings(settings.zenoh, (connect,) if connect else ()),
            vehicle=settings.vehicle.name,
            directory=str(directory),
            images=recording.images,
            depth="depth" in recording.content,
            clouds="clouds" in recording.content,
            max_file_mb=recording.max_file_mb,
            max_total_mb=recording.max_total_mb,
        )
        record_until(options, ending, lambda text: typer.echo(text, err=True))


def replay(
    settings: Settings,
    files: Annotated[list[Path], typer.Argument(metavar="FILE…", help="Files of one run, in order.")],
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change a setting, such as guidance.brake_s=1."),
    ] = None,
    model: Annotated[
        str | None, typer.Option(help="Detect and track again in the recorded images, with this model.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Run guidance again over a recording.

    Compares each output with the recorded one. The exit code is 1 if any differs. With --model guidance gets
    the targets that this model finds in the recorded images, with ranges from the recorded depth where it is
    there, without an operator's selection.
    """
    from companion.logs.replay import replay as replay_files
    from companion.logs.replay import report
    from companion.recording import RecordingError
    from companion.settings.plugins import PluginError, load_plugins
    from companion.settings.reading import ConfigurationError

    with plain_errors(RecordingError, ConfigurationError, PluginError, ValueError):  # of a model
        load_plugins(settings.plugins.modules)
        found = replay_files(files, dict(map(_key_and_value, changes or ())), model)
    if as_json:
        typer.echo(json.dumps(found.as_dict()))
    else:
        for line in report(found):
            typer.echo(line)
    if found.first is not None or (found.detections is not None and found.detections.differing_images):
        raise typer.Exit(EXIT_DIFFERENT)


def collect(
    settings: Settings,
    folder: Annotated[
        Path, typer.Argument(metavar="FOLDER", help="Folder of the data set, new or to be continued.")
    ],
    files: Annotated[
        list[Path] | None,
        typer.Argument(metavar="[FILE…]", help="Recordings of one run, in order. None: a running service."),
    ] = None,
    connect: Annotated[str | None, typer.Option(help="Zenoh endpoint of the service or its router.")] = None,
    camera: Annotated[str | None, typer.Option(help="Name of the camera. Default: the first.")] = None,
    interval: Annotated[float, typer.Option(min=0, help="Least time between two images, seconds.")] = 1.0,
    most: Annotated[int, typer.Option(min=1, help="Number of images.")] = 200,
) -> None:
    """Collect frames to label.

    Writes those with tracks that were doubted, lost, or changed class, from recordings, or from a running
    service until Ctrl-C. The labels are the model's own boxes; correct them, then train with `companion
    train --data FOLDER`.
    """
    from companion.bus.client import NoAnswerError, client_settings
    from companion.bus.config import BusError
    from companion.learning import collect as collecting
    from companion.logs.frames import recorded_frames
    from companion.recording import RecordingError

    ending = threading.Event()
    kept = 0
    with plain_errors(RecordingError, NoAnswerError, BusError, ValueError, OSError):
        if files:
            frames, source = recorded_frames(files, camera), files[0].stem
        else:
            for number in (signal.SIGINT, signal.SIGTERM):
                signal.signal(number, lambda *_: ending.set())
            zenoh = client_settings(settings.zenoh, (connect,) if connect else ())
            source = f"{settings.vehicle.name}_{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}"
            frames = collecting.live_frames(zenoh, settings.vehicle.name, camera, ending)
        for path, reasons in collecting.collect(frames, folder, source, interval_s=interval, most=most):
            kept += 1
            typer.echo(f"{path}: {', '.join(reasons)}")
    typer.echo(f"{folder}: {kept} images", err=True)


def _key_and_value(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals:
        raise typer.BadParameter(f"expected KEY=VALUE, got {text!r}", param_hint="--set")
    return key.strip(), value.strip()


def sightings(
    files: Annotated[list[Path], typer.Argument(metavar="FILE…", help="Recordings.")],
    as_geojson: Annotated[bool, typer.Option("--geojson", help="Print GeoJSON (RFC 7946).")] = False,
    as_kml: Annotated[bool, typer.Option("--kml", help="Print KML 2.2.")] = False,
) -> None:
    """Print the objects in recordings.

    Prints each confirmed track with its fused position and 95 % error ellipse.
    """
    if as_geojson == as_kml:
        typer.echo("companion: expected --geojson or --kml, one of them", err=True)
        raise typer.Exit(EXIT_BAD_INPUT)
    from companion.logs import sightings as found_in
    from companion.recording import RecordingError

    with plain_errors(RecordingError):
        found = found_in.sightings(files)
    typer.echo(found_in.geojson(found) if as_geojson else found_in.kml(found))
    if unplaced := sum(sighting.position is None for sighting in found):
        typer.echo(f"companion: {unplaced} of {len(found)} tracks have no position", err=True)


@log.command("list")
def list_recordings(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="Folder of recordings.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object per file.")] = False,
) -> None:
    """List the recordings of a folder. Prints for each: vehicle, start, duration, size, flights."""
    from companion.logs.flight_log import listed, summaries
    from companion.recording import RecordingError

    with plain_errors(RecordingError):
        for found in summaries(directory):
            if isinstance(found, RecordingError):
                typer.echo(f"companion: {found}", err=True)
            else:
                typer.echo(json.dumps(found.as_dict()) if as_json else listed(found))


@log.command("show")
def show_recording(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A recording.")],
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Show the contents of a recording.

    Prints events, modes, arming, refused commands, images, depth, losses and damage.
    """
    from companion.logs.flight_log import shown, summarize
    from companion.recording import RecordingError

    with plain_errors(RecordingError):
        found = summarize(file)
    if as_json:
        typer.echo(json.dumps(found.as_dict()))
    else:
        for line in shown(found):
            typer.echo(line)


@log.command("recover")
def recover_recording(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A damaged recording.")],
    output: Annotated[Path, typer.Argument(metavar="OUTPUT", help="The new file.")],
) -> None:
    """Copy what can be read of a recording to a new, complete file."""
    from companion.recording import RecordingError
    from companion.recording.files import recover

    with plain_errors(RecordingError):
        problems, messages = recover(file, output)
    for line in problems:
        typer.echo(f"companion: {line}", err=True)
    typer.echo(f"{output}: {messages} messages")


@log.command("tlog")
def write_tlog(
    file: Annotated[Path, typer.Argument(metavar="RECORDING", help="A recording.")],
    output: Annotated[
        Path | None, typer.Argument(metavar="OUTPUT", help="The new file; by default RECORDING with .tlog.")
    ] = None,
) -> None:
    """Write the recorded MAVLink as a .tlog.

    The file has both directions, for ground stations.
    """
    from companion.recording import RecordingError
    from companion.recording.tlog import write_tlog as write

    output = output or file.with_suffix(".tlog")
    with plain_errors(RecordingError):
        problems, frames = write(file, output)
    for line in problems:
        typer.echo(f"companion: {line}", err=True)
    typer.echo(f"{output}: {frames} MAVLink messages")
