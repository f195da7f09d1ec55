"""The command line of `companion calibrate`: of a lens (SOURCE), `mount` and `extrinsics`."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.flags import check_finite, check_folder, plain_errors, settings_command, with_default
from companion.host.journal import log_to_standard_error

if TYPE_CHECKING:
    from companion.camera_tools.calibrate import Collected
    from companion.settings import Settings


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


@calibrate.command()
def lens(
    source: Annotated[str, typer.Argument(help="Folder of images, video, /dev/video0, shm://NAME or URL.")],
    board: _BOARD,
    square: _SQUARE,
    marker: _MARKER = None,
    dictionary: _DICTIONARY = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Calibration file to write: ROS camera_info YAML.")
    ] = Path("camera.yaml"),
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
) -> None:
    """Calibrate a lens from images of a board.

    Writes camera.yaml for camera.calibration_file. A live camera is read until the views are complete, or
    until Ctrl-C.
    """
    from companion.camera_tools.calibrate import collect_views, result_lines, write_report
    from vision.calibration.boards import Board
    from vision.calibration.calibrate import calibrate as calibrate_views
    from vision.calibration_files.camera_info import camera_identity, write_camera_info
    from vision.sources import SourceError, SourceSettings, open_source

    log_to_standard_error(logging.WARNING, "companion: %(message)s")

    with plain_errors(SourceError, ValueError, OSError):  # CalibrationError is a ValueError
        check_folder(output)
        printed = Board.parse(*board, square, marker, dictionary)
        settings = SourceSettings(
            width=width, height=height, every_frame=True, rotate_deg=rotate, mirror=mirror
        )
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


@calibrate.command()
def extrinsics(
    colour: Annotated[str, typer.Argument(help="Colour camera: folder of images, video, /dev/video0, …")],
    infrared: Annotated[
        str, typer.Argument(help="Infrared images of the depth camera, taken at the same times.")
    ],
    board: _BOARD,
    square: _SQUARE,
    colour_calibration: Annotated[Path, typer.Option(help="Calibration file of the colour camera.")],
    infrared_calibration: Annotated[Path, typer.Option(help="Calibration file of the infrared camera.")],
    marker: _MARKER = None,
    dictionary: _DICTIONARY = None,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Calibration file of the depth camera to write.")
    ] = Path("depth.yaml"),
    every: Annotated[int, typer.Option(min=1, help="Process every Nth frame of a video.")] = 1,
    rotate: _ROTATE = 0,
    mirror: _MIRROR = False,
) -> None:
    """Measure the pose of a depth camera on a colour camera.

    Writes depth.yaml for source.depth_calibration_file. Both see one board at the same time. Two folders
    are paired by file name.
    """
    from companion.camera_tools.calibrate import collect_views, extrinsics_lines
    from vision.calibration.boards import Board
    from vision.calibration.extrinsics import extrinsics_from_views
    from vision.calibration_files.camera_info import read_camera_info, write_camera_info
    from vision.sources import SourceError, SourceSettings
    from vision.sources.opening import open_two

    log_to_standard_error(logging.WARNING, "companion: %(message)s")
    with plain_errors(SourceError, ValueError, OSError):
        check_folder(output)
        printed = Board.parse(*board, square, marker, dictionary)
        settings = SourceSettings(every_frame=True, rotate_deg=rotate, mirror=mirror)
        lenses = []
        for file, uri in ((colour_calibration, colour), (infrared_calibration, infrared)):
            (info := read_camera_info(file)).check_source(settings.orientation, uri=uri)
            lenses.append(info.model)
        first, second = open_two(colour, infrared, settings, settings)
        with first, second:
            collected = collect_views(first, printed, _note, every, second)
        with _naming(collected.collector.missing()):
            result = extrinsics_from_views(collected.pairs, *lenses)
        views = len(collected.collector.views)
        _note(
            f"{collected.frames} pairs of images, {collected.found} with the board, {views} different views"
        )
        _note_pattern(collected)
        for name, error in result.rejected:
            _note(f"rejected {name}: its error is {error:.2f} px")
        lines = extrinsics_lines(result)
        notes = tuple(f"companion calibrate extrinsics: {line}" for line in lines)
        calibration = result.calibration
        write_camera_info(output, calibration.depth, "depth", notes, settings.orientation, calibration)
    for line in lines:
        typer.echo(line)
    typer.echo(f"written: {output}")


@settings_command(calibrate, "zenoh", "vehicle.name")
def mount(
    settings: Settings,
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
    connect: Annotated[str | None, typer.Option(help="Zenoh endpoint of the service, with --live.")] = None,
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
        if connect and not live:
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
        given = math.radians(roll), math.radians(pitch)
        with ExitStack() as opened:
            images = opened.enter_context(open_source(source, reading))
            if live and not images.live:
                raise ValueError(f"--live needs a live source, got {source}: give --roll and --pitch")
            tilt = LiveTilt()
            if live:
                client = client_settings(settings.zenoh, (connect,) if connect else ())
                session = opened.enter_context(open_client(client))
                subscriber = listen(session, VEHICLE.key(settings.vehicle.name), tilt.on_message)
                opened.callback(subscriber.undeclare)
            found, tilts = markers_of(
                images, kind, marker, model, frames, _note, tilt if live else lambda: given
            )
        angles = mount_from_markers(found, math.radians(heading), *zip(*tilts, strict=True))
    typer.echo(f"# {angles.views} images, spread {math.degrees(angles.spread_rad):.2f} degrees")
    for key in ("roll", "pitch", "yaw"):
        typer.echo(f"mount_{key}_deg = {math.degrees(getattr(angles, f'{key}_rad')):.2f}")
