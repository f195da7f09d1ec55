"""The command line of `companion calibrate`: of a lens or a depth camera (SOURCE), and `mount`."""

from __future__ import annotations

import functools
import logging
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.flags import (
    CLIENT_SETTINGS,
    Command,
    check_belonging,
    check_finite,
    check_folder,
    plain_errors,
    settings_command,
    vehicle_of,
    with_default,
)
from companion.host.journal import log_to_standard_error

if TYPE_CHECKING:
    from companion.camera_tools.calibrate import Collected
    from companion.settings import Settings
    from vision.calibration.boards import Board
    from vision.sources import SourceSettings


_ROTATE = Annotated[
    int, typer.Option(help="Rotate the images clockwise by 0, 90, 180 or 270 degrees, as source.rotate_deg.")
]
_BOARD = Annotated[
    tuple[str, str],
    typer.Option(help="chessboard COLUMNSxROWS (inner corners), or charuco COLUMNSxROWS (squares)."),
]
_SQUARE = Annotated[float, typer.Option(help="Side of a square, metres.")]
_MARKER = Annotated[float | None, typer.Option(help="Side of a ChArUco board's markers, metres.")]
_DICTIONARY = Annotated[
    str | None, typer.Option(help="Dictionary of a ChArUco board's markers, such as 4X4_50.")
]
_of_depth = functools.partial(typer.Option, rich_help_panel="A depth camera's pose (--depth-source)")
_MIRROR = Annotated[bool, typer.Option("--mirror", help="Exchange left and right first, as source.mirror.")]

calibrate = typer.Typer(
    cls=with_default("lens"),
    help="Calibrate a lens, a mount or a depth camera's pose.\n\n"
    "`companion calibrate SOURCE` is `companion calibrate lens SOURCE`.",
    no_args_is_help=True,
)


def _note(text: str) -> None:
    typer.echo(f"companion: {text}", err=True)


def _note_pattern(collected: Collected) -> None:
    if collected.legacy:
        pattern = "OpenCV's before 4.6 and calib.io's, a marker in the upper-left square"
        _note(f"the pattern of the board is {pattern} ({collected.legacy} images)")


@contextmanager
def _naming(missing: list[str]) -> Iterator[None]:
    """Add to a CalibrationError what is missing for a complete set of views; else a line on it."""
    from vision.calibration.calibrate import CalibrationError

    wanted = f"missing for a complete set: {'; '.join(missing)}"
    try:
        yield
    except CalibrationError as error:
        raise CalibrationError(f"{error}; {wanted}" if missing else str(error)) from None
    if missing:
        _note(wanted)


@calibrate.command(cls=Command)
def lens(
    context: typer.Context,
    source: Annotated[str, typer.Argument(help="Folder of images, video, /dev/video0, shm://NAME or URL.")],
    board: _BOARD,
    square: _SQUARE,
    marker: _MARKER = None,
    dictionary: _DICTIONARY = None,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output",
            "-o",
            help="Calibration file to write: ROS camera_info YAML. Default: camera.yaml, of a depth camera "
            "depth.yaml.",
        ),
    ] = None,
    report: Annotated[Path | None, typer.Option(help="Folder for a report: index.html and images.")] = None,
    name: Annotated[
        str | None,
        typer.Option(
            help="Name of the camera in the file. Default: the source's address if it is of one camera "
            "(/dev/v4l/by-id/…, realsense://SERIAL, oak://ID), else camera."
        ),
    ] = None,
    every: Annotated[int, typer.Option(min=1, help="Process every Nth frame of a video.")] = 1,
    width: Annotated[int | None, typer.Option(min=16, help="Width requested from a camera, pixels.")] = None,
    height: Annotated[
        int | None, typer.Option(min=16, help="Height requested from a camera, pixels.")
    ] = None,
    rotate: _ROTATE = 0,
    mirror: _MIRROR = False,
    depth_source: Annotated[
        str | None,
        _of_depth(
            metavar="SOURCE",
            help="Infrared images of the depth camera, taken at the same times; two folders are paired by "
            "file name.",
        ),
    ] = None,
    calibration: Annotated[Path | None, _of_depth(help="Calibration file of the colour camera.")] = None,
    depth_calibration: Annotated[
        Path | None, _of_depth(help="Calibration file of the infrared camera.")
    ] = None,
) -> None:
    """Calibrate a lens, or a depth camera's pose, from images of a board.

    Writes camera.yaml for camera.calibration_file. A live camera is read until the views are complete, or
    until Ctrl-C. With --depth-source it measures the pose of a depth camera on the colour camera SOURCE, and
    writes depth.yaml for source.depth_calibration_file: both see one board at the same time.
    """
    from vision.calibration.boards import Board
    from vision.sources import SourceError, SourceSettings

    of_depth, of_lens = ("calibration", "depth_calibration"), ("report", "name", "width", "height")
    check_belonging(context, "--depth-source SOURCE", of_depth, chosen=depth_source is not None)
    check_belonging(context, "a lens, without --depth-source", of_lens, chosen=depth_source is None)
    log_to_standard_error(logging.WARNING, "companion: %(message)s")
    with plain_errors(SourceError, ValueError, OSError):  # CalibrationError is a ValueError
        printed = Board.parse(*board, square, marker, dictionary)
        settings = SourceSettings(
            width=width, height=height, every_frame=True, rotate_deg=rotate, mirror=mirror
        )
        if depth_source is None:
            _lens(source, printed, settings, output or Path("camera.yaml"), report, name, every)
            return
        if calibration is None or depth_calibration is None:
            raise ValueError("--depth-source needs --calibration FILE and --depth-calibration FILE")
        lenses = ((calibration, source), (depth_calibration, depth_source))
        _depth_camera(lenses, printed, settings, output or Path("depth.yaml"), every)


def _lens(
    source: str,
    printed: Board,
    settings: SourceSettings,
    output: Path,
    report: Path | None,
    name: str | None,
    every: int,
) -> None:
    from companion.camera_tools.calibrate import collect_views, result_lines, write_report
    from vision.calibration.calibrate import calibrate as calibrate_views
    from vision.calibration_files.camera_info import camera_identity, write_camera_info
    from vision.sources import open_source

    check_folder(output)
    with open_source(source, settings) as frames:
        collected = collect_views(frames, printed, _note, every)
    with _naming(collected.collector.missing()):
        result = calibrate_views(collected.collector.chosen())
    _note(
        f"{collected.frames} images, {collected.found} with the board, "
        f"{len(collected.collector.views)} different views"
    )
    _note_pattern(collected)
    for view, error in result.rejected:
        _note(f"rejected {view.name}: its error is {error:.2f} px")
    lines = result_lines(result)
    notes = (f"companion calibrate: {lines[0]}", lines[3])
    camera = name or camera_identity(source) or "camera"
    write_camera_info(output, result.model, camera, notes, settings.orientation)
    page = None if report is None else write_report(report, result, collected)
    for line in lines:
        typer.echo(line)
    typer.echo(f"written: {output}" + ("" if page is None else f", {page}"))


def _depth_camera(
    lenses: tuple[tuple[Path, str], tuple[Path, str]],
    printed: Board,
    settings: SourceSettings,
    output: Path,
    every: int,
) -> None:
    """Measure the pose of a depth camera. `lenses`: calibration file and address of colour and infrared."""
    from companion.camera_tools.calibrate import collect_views, extrinsics_lines
    from vision.calibration.extrinsics import extrinsics_from_views
    from vision.calibration_files.camera_info import read_camera_info, write_camera_info
    from vision.sources.opening import open_two

    check_folder(output)
    models = []
    for file, uri in lenses:
        (info := read_camera_info(file)).check_source(settings.orientation, uri=uri)
        models.append(info.model)
    (_, colour), (_, infrared) = lenses
    first, second = open_two(colour, infrared, settings, settings)
    with first, second:
        collected = collect_views(first, printed, _note, every, second)
    with _naming(collected.collector.missing()):
        result = extrinsics_from_views(collected.pairs, *models)
    views = len(collected.collector.views)
    _note(f"{collected.frames} pairs of images, {collected.found} with the board, {views} different views")
    _note_pattern(collected)
    for name, error in result.rejected:
        _note(f"rejected {name}: its error is {error:.2f} px")
    lines = extrinsics_lines(result)
    notes = tuple(f"companion calibrate lens: {line}" for line in lines)
    calibration = result.calibration
    write_camera_info(output, calibration.depth, "depth", notes, settings.orientation, calibration)
    for line in lines:
        typer.echo(line)
    typer.echo(f"written: {output}")


@settings_command(calibrate, *CLIENT_SETTINGS)
def mount(
    settings: Settings,
    given: Mapping[str, str],
    source: Annotated[str, typer.Argument(help="Folder of images, video, /dev/video0, shm://NAME or URL.")],
    marker: Annotated[int, typer.Option(min=0, help="Id of the marker, which lies level, face up.")],
    size: Annotated[float, typer.Option(help="Side of the marker's black square, metres.")],
    calibration: Annotated[
        Path | None, typer.Option(help="Calibration file. Default: the source's own calibration.")
    ] = None,
    dictionary: Annotated[str, typer.Option(help="Dictionary of the marker.")] = "4X4_50",
    printed: Annotated[
        str, typer.Option("--print", help="Whose print: opencv, or apriltag (AprilRobotics' images).")
    ] = "opencv",
    heading: Annotated[
        float, typer.Option(help="Direction of the marker's upper edge, degrees clockwise from the nose.")
    ] = 0.0,
    roll: Annotated[float, typer.Option(help="Roll of the vehicle, degrees.")] = 0.0,
    pitch: Annotated[float, typer.Option(help="Pitch of the vehicle, degrees, nose up.")] = 0.0,
    live: Annotated[
        bool, typer.Option("--live", help="Take roll and pitch from the running service of vehicle.name.")
    ] = False,
    frames: Annotated[int, typer.Option(min=1, help="Number of images with the marker.")] = 30,
    rotate: _ROTATE = 0,
    mirror: _MIRROR = False,
) -> None:
    """Measure the camera's angles on the vehicle.

    Prints them as settings.
    """
    import math

    from companion.bus.client import NoAnswerError, client_settings, listen, open_client
    from companion.bus.session import BusError
    from companion.bus.topics import VEHICLE
    from companion.camera_tools.calibrate import LiveTilt, markers_of
    from vision.calibration.mount import mount_from_markers
    from vision.calibration_files.camera_info import read_camera_info
    from vision.markers import MarkerKind
    from vision.sources import SourceError, SourceSettings, open_source

    log_to_standard_error(logging.WARNING, "companion: %(message)s")
    with plain_errors(SourceError, ValueError, OSError, NoAnswerError, BusError):
        if live and (roll or pitch):
            raise ValueError("--live replaces --roll and --pitch: leave them out")
        if "zenoh.connect" in given and not live:
            raise ValueError("--connect is for --live")
        for flag, angle in (("--heading", heading), ("--roll", roll), ("--pitch", pitch)):
            check_finite(flag, angle)
        kind = MarkerKind(dictionary, size, {marker: size}, printed)
        reading = SourceSettings(every_frame=True, rotate_deg=rotate, mirror=mirror)
        model = None
        if calibration is not None:
            info = read_camera_info(calibration)
            info.check_source(reading.orientation, uri=source)
            model = info.model
        held = math.radians(roll), math.radians(pitch)
        with ExitStack() as opened:
            images = opened.enter_context(open_source(source, reading))
            if live and not images.live:
                raise ValueError(f"--live needs a live source, got {source}: give --roll and --pitch")
            tilt = LiveTilt()
            if live:
                session = opened.enter_context(open_client(client_settings(settings.zenoh)))
                subscriber = listen(session, VEHICLE.key(vehicle_of(session, settings)), tilt.on_message)
                opened.callback(subscriber.undeclare)
            found, tilts = markers_of(
                images, kind, marker, model, frames, _note, tilt if live else lambda: held
            )
        angles = mount_from_markers(found, math.radians(heading), *zip(*tilts, strict=True))
    typer.echo(f"# {angles.views} images, spread {math.degrees(angles.spread_rad):.2f} degrees")
    for key in ("roll", "pitch", "yaw"):
        typer.echo(f"mount_{key}_deg = {math.degrees(getattr(angles, f'{key}_rad')):.2f}")
