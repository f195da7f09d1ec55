"""The command line of `companion log show|record|replay|convert`: recordings of flights."""

from __future__ import annotations

import json
import signal
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from companion.cli.flags import (
    CLIENT_SETTINGS,
    AsJson,
    Command,
    plain_errors,
    refuse,
    settings_command,
    vehicle_of,
)

if TYPE_CHECKING:
    from companion.settings import Settings

EXIT_DIFFERENT = 1
RECORD_SETTINGS = tuple(f"recording.{key}" for key in ("content", "max_file_mb", "max_total_mb"))

log = typer.Typer(help="Record flights; list, show, replay and convert recordings.", no_args_is_help=True)
_Files = Annotated[list[Path], typer.Argument(metavar="FILE…", help="Files of one run, in order.")]


@log.command("show", cls=Command)
def show_recordings(
    paths: Annotated[
        list[Path], typer.Argument(metavar="FILE|FOLDER…", help="Recordings, or a folder of them.")
    ],
    objects: Annotated[
        Literal["geojson", "kml"] | None,
        typer.Option(
            help="Instead print the objects in the files, as GeoJSON (RFC 7946) or KML 2.2: each confirmed "
            "track with its fused position and 95 % error ellipse."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Show recordings.

    Of a folder a line per file: vehicle, start, duration, size, flights. Of a file its contents: events,
    modes, arming, refused commands, images, depth, losses and damage.
    """
    from companion.logs.flight_log import listed, shown, summaries, summarize
    from companion.recording import RecordingError

    if objects is not None:
        _show_objects(paths, objects)
        return
    with plain_errors(RecordingError):
        for path in paths:
            if not path.is_dir():
                found = summarize(path)
                lines = [json.dumps(found.as_dict())] if as_json else shown(found)
                for line in lines:
                    typer.echo(line)
                continue
            for each in summaries(path):
                if isinstance(each, RecordingError):
                    typer.echo(f"companion: {each}", err=True)
                else:
                    typer.echo(json.dumps(each.as_dict()) if as_json else listed(each))


def _show_objects(paths: list[Path], kind: Literal["geojson", "kml"]) -> None:
    from companion.logs import sightings as found_in
    from companion.recording import RecordingError

    with plain_errors(RecordingError):
        found = found_in.sightings(paths)
    typer.echo(found_in.geojson(found) if kind == "geojson" else found_in.kml(found))
    if unplaced := sum(sighting.position is None for sighting in found):
        typer.echo(f"companion: {unplaced} of {len(found)} tracks have no position", err=True)


@log.command("convert", cls=Command)
def convert_recording(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="A recording, damaged or not.")],
    output: Annotated[
        Path,
        typer.Argument(
            metavar="OUTPUT", help="The new file: NAME.mcap, or NAME.tlog for the recorded MAVLink."
        ),
    ],
    ros2: Annotated[bool, typer.Option("--ros2", help="Write an .mcap that is a bag of ROS 2.")] = False,
) -> None:
    """Copy a recording to a new, complete file.

    An .mcap has all that can be read of a damaged one. A .tlog has the MAVLink of both directions, for ground
    stations. With --ros2 an .mcap has the topics of the ROS 2 node, for `ros2 bag` and rosbags.
    """
    from companion.logs.tlog import write_tlog
    from companion.recording import RecordingError
    from companion.recording.files import recover
    from companion.ros2.bag import write_bag

    suffixes = (".mcap",) if ros2 else (".mcap", ".tlog")
    if output.suffix not in suffixes:
        refuse(f"{output}: expected a name that ends in {' or '.join(suffixes)}")
    convert = write_bag if ros2 else recover if output.suffix == ".mcap" else write_tlog
    with plain_errors(RecordingError):
        problems, count = convert(file, output)
    for line in problems:
        typer.echo(f"companion: {line}", err=True)
    typer.echo(f"{output}: {count} {'messages' if output.suffix == '.mcap' else 'MAVLink messages'}")


@settings_command(log, *CLIENT_SETTINGS, *RECORD_SETTINGS)
def record(
    settings: Settings,
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="Folder for the recordings.")],
) -> None:
    """Record a running service. Writes MCAP files until Ctrl-C or SIGTERM."""
    from companion.bus.client import NoAnswerError, client_settings, open_client
    from companion.bus.config import BusError
    from companion.recording import RecordingError
    from companion.recording.recorder import RecorderOptions
    from companion.recording.recorder import record as record_until

    ending = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: ending.set())
    recording = settings.recording
    with plain_errors(RecordingError, NoAnswerError, BusError, ValueError):
        zenoh = client_settings(settings.zenoh)
        with open_client(zenoh, timeout_s=10.0) as session:
            vehicle = vehicle_of(session, settings)
        options = RecorderOptions(
            zenoh=zenoh,
            vehicle=vehicle,
            directory=str(directory),
            images=recording.images,
            depth="depth" in recording.content,
            clouds="clouds" in recording.content,
            max_file_mb=recording.max_file_mb,
            max_total_mb=recording.max_total_mb,
        )
        record_until(options, ending, lambda text: typer.echo(text, err=True))


@settings_command(log, "plugins")
def replay(
    settings: Settings,
    files: _Files,
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change a setting, such as guidance.brake_s=1."),
    ] = None,
    model: Annotated[
        str | None, typer.Option(help="Detect and track again in the recorded images, with this model.")
    ] = None,
    as_json: AsJson = False,
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
        found = replay_files(files, dict(map(key_and_value, changes or ())), model)
    if as_json:
        typer.echo(json.dumps(found.as_dict()))
    else:
        for line in report(found):
            typer.echo(line)
    if found.first is not None or (found.detections is not None and found.detections.differing_images):
        raise typer.Exit(EXIT_DIFFERENT)


def key_and_value(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals:
        raise typer.BadParameter(f"expected KEY=VALUE, got {text!r}", param_hint="--set")
    return key.strip(), value.strip()
