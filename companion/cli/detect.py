"""The command line of `companion detect`: one loop over a source's frames, with parts that each measure."""

from __future__ import annotations

import functools
import logging
import math
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from companion.cli.download import Pull, model_after_pull
from companion.cli.flags import (
    EXIT_BAD_INPUT,
    YOLO,
    AsJson,
    Limit,
    TileOverlap,
    Tiles,
    TileSize,
    check_belonging,
    check_finite,
    check_folder,
    plain_errors,
    warn_rendered_only,
)
from companion.host.journal import log_to_standard_error
from vision.gc_pause import gc_paused

if TYPE_CHECKING:
    from companion.settings import Settings

logger = logging.getLogger(__name__)

DETECT_SETTINGS = (
    *("source", "camera", "detector", "tracker", "vehicle", "plugins"),
    *("markers.size_m", "markers.others", "markers.boards_file", "markers.print"),
)
# As `--model`: no network.
NO_MODEL = "none"
_STATUS_PERIOD_S = 1.0
# A recording is read whole and once, as fast as possible, unless a flag says otherwise.
_OF_RECORDINGS: dict[str, dict[str, Any]] = {
    "source": {"loop": False, "every_frame": True},
    "detector": {"rate_hz": None},
}
_part = functools.partial(typer.Option, rich_help_panel="Parts beside the boxes")
_of_images = functools.partial(typer.Option, rich_help_panel="Images")
_of_cloud = functools.partial(typer.Option, rich_help_panel="Point cloud (--cloud)")


def detect(
    settings: Settings,
    given: Mapping[str, str],
    context: typer.Context,
    source: Annotated[
        str | None,
        typer.Argument(
            help="File, folder, /dev/video0, csi://0, FIFO, - (standard input), shm:// or URL. "
            "Default: source.uri."
        ),
    ] = None,
    track: Annotated[bool, typer.Option("--track", help="Enable multi-object tracking.")] = False,
    tiles: Tiles = False,
    tile_size: TileSize = None,
    tile_overlap: TileOverlap = 0.2,
    every: Annotated[int, typer.Option(min=1, help="Process every Nth frame.")] = 1,
    retune: Annotated[
        bool, typer.Option("--retune", help="Measure this model's runtimes and precisions again.")
    ] = False,
    pull: Pull = False,
    limit: Limit = None,
    period: Annotated[
        float | None,
        typer.Option(min=0, help="Seconds between shown frames; 0: each. Default: 0, or 1 without a part."),
    ] = None,
    as_json: AsJson = False,
    depth: Annotated[
        bool,
        _part(
            "--depth", help="Distances: depth at the centre and of each object, obstacles around the vehicle."
        ),
    ] = False,
    markers: Annotated[
        str | None,
        _part(
            metavar="[DICTIONARY]",
            help="Printed markers, with range, bearing, pose and their one-sigma errors: 4X4_50, tag36h11. "
            "Default: markers.dictionary.",
        ),
    ] = None,
    save: Annotated[
        Path | None, _of_images(help="Folder for input images; annotated in its `detections`.")
    ] = None,
    grey: Annotated[
        bool, _of_images("--grey", help="Annotated images in grey, a third as wide and high.")
    ] = False,
    level: Annotated[
        bool, _of_images("--level", help="Level them by the attitude of the vehicle (--vehicle-url).")
    ] = False,
    cloud: Annotated[
        Path | None,
        _of_cloud(
            metavar="FILE",
            help="Write the first frame's depth as a point cloud, .ply or .pcd, with the colours of its "
            "image, and end.",
        ),
    ] = None,
    cloud_frame: Annotated[
        Literal["camera", "body", "ned"], _of_cloud(help="Frame of the points; NED is from the vehicle.")
    ] = "body",
    attitude: Annotated[
        tuple[float, float, float],
        _of_cloud(
            help="The vehicle's roll, pitch and yaw, degrees; for --depth too.", metavar="ROLL PITCH YAW"
        ),
    ] = (0.0, 0.0, 0.0),
    max_range: Annotated[float, _of_cloud(min=0.1, help="Maximum depth, metres.")] = 20.0,
    voxel: Annotated[
        float | None, _of_cloud(min=0.005, max=10, help="Voxel grid: one point per cube, metres.")
    ] = None,
    average: Annotated[
        int | None,
        _of_cloud(min=1, max=32, help="Make one point of N x N pixels, against a stereo camera's noise."),
    ] = None,
    clusters: Annotated[
        bool,
        _of_cloud(
            "--clusters", help="List the objects above the ground. Unless set: --voxel 0.1 --average 4."
        ),
    ] = False,
    cloud_view: Annotated[
        Path | None, _of_cloud(help="View of the cloud from behind and above: .png or .jpg.")
    ] = None,
    cloud_text: Annotated[
        bool, _of_cloud("--cloud-text", help="Write numbers as text instead of binary.")
    ] = False,
) -> None:
    """Detect objects, depth and markers in a source.

    Prints a line per frame and part, and a summary on standard error. Parts: the boxes of the model, --depth,
    --markers, --cloud. With --model none there is no network; without any part it shows once a second what
    the source delivers: topic, size, measured rate, stamp, losses. Directions and poses are in the body frame
    (forward, right, down), as the camera is mounted. Ctrl-C ends it. A live image in the browser: companion
    view SOURCE.
    """
    of_cloud = ("cloud_frame", "max_range", "voxel", "average", "clusters", "cloud_view", "cloud_text")
    check_belonging(context, "--cloud FILE", of_cloud, chosen=cloud is not None)
    check_belonging(context, "--depth or --cloud", ("attitude",), chosen=depth or cloud is not None)
    check_belonging(context, "the images of --save FOLDER", ("grey", "level"), chosen=save is not None)
    of_model = ("track", "tiles", "retune", "pull")
    with_model = settings.detector.enabled and settings.detector.model != NO_MODEL
    check_belonging(context, "a model, which is none here", of_model, chosen=with_model)
    of_tiles = ("tile_size", "tile_overlap")
    check_belonging(context, "--tiles", of_tiles, chosen=tiles or settings.detector.tiles)
    with gc_paused():
        from companion.bus import topics
        from companion.camera_tools.attitudes import attitudes_of, held_attitude
        from companion.camera_tools.cloud import VIEW_SUFFIXES, Cloud, CloudOptions
        from companion.camera_tools.detect import (
            Boxes,
            Distances,
            Output,
            Part,
            SourceStatus,
            detect_source,
            make_save_folder,
        )
        from companion.camera_tools.markers import Markers
        from companion.perception.assembly import CameraTelemetry, build_levelling, load_detector
        from companion.settings.calibration import adopt_calibration
        from companion.settings.plugins import PluginError, load_plugins
        from companion.vehicle.driver import LinkError
        from vision.detector import forget_measurements
        from vision.object_detector import DetectionsError
        from vision.pipeline import FrameDetector
        from vision.point_cloud import CloudFileError
        from vision.rotation import matrix_from_euler
        from vision.runtimes.base import RuntimeUnusableError
        from vision.sources import SourceError, open_source
        from vision.tiling import TiledDetector

    log_to_standard_error(logging.WARNING, "companion: %(message)s")
    wrong = (LinkError, PluginError, SourceError, OSError, RuntimeUnusableError, DetectionsError)
    # ValueError: settings that do not fit the images or the model. CheckpointError is one.
    with ExitStack() as stack, plain_errors(*wrong, CloudFileError, ValueError):
        uri = source or settings.source.uri
        if save is not None:
            make_save_folder(save, uri)
        check_finite("--attitude", *attitude)
        if cloud_view is not None and cloud_view.suffix not in VIEW_SUFFIXES:
            raise ValueError(f"{cloud_view}: expected a name that ends in {' or '.join(VIEW_SUFFIXES)}")
        for path in (cloud, cloud_view):
            if path is not None:
                check_folder(path)
        with_lens = depth or level or cloud is not None or markers is not None
        is_status = not (with_model or depth or cloud or markers is not None)
        changes: dict[str, dict[str, Any]] = {
            "detector": {"enabled": with_model, "tiles": False},
            "tracker": {"enabled": track},
            "guidance": {"obstacles": "auto" if depth else "off"},
            "markers": {"dictionary": None if markers is None else _dictionary(settings, markers)},
        }
        settings = _changed(settings, changes)
        if not is_status:
            settings = _changed(settings, _not_given(_OF_RECORDINGS, given))
        tiles = tiles or settings.detector.tiles
        load_plugins(settings.plugins.modules)
        if pull:
            model = model_after_pull(settings.detector.model, [uri])
            settings = _changed(settings, {"detector": {"model": model}})
        telemetry = CameraTelemetry()
        ned_from_body = matrix_from_euler(*(math.radians(angle) for angle in attitude))
        if level:
            telemetry = stack.enter_context(attitudes_of(settings))
        elif depth:
            telemetry = held_attitude(ned_from_body)
        detector = None
        if with_model:
            if retune and settings.detector.kind == YOLO:
                forget_measurements(settings.detector.model)
            detector = load_detector(settings)
            if settings.detector.runtime == "auto" and detector.runtime is not None:
                typer.echo(f"companion: on {detector.runtime} ({detector.reason})", err=True)
        frame_detector: FrameDetector | None = detector
        if tiles and detector is not None:
            size = tile_size or settings.detector.image_size
            frame_detector = TiledDetector(detector, tile_size=size, overlap=tile_overlap)
        frames = stack.enter_context(open_source(uri, settings.source.opening()))
        if with_lens and frames.calibration is not None:
            adopted = adopt_calibration(settings.camera, frames.calibration)
            settings = settings.model_copy(update={"camera": adopted.camera})
            if adopted.conflict:
                logger.warning("camera: settings override the camera's calibration: %s", adopted.conflict)
        if detector is not None and detector.rendered_only:
            warn_rendered_only([(uri, detector.model_name)])
        parts: list[Part] = []
        if detector is not None:
            parts.append(Boxes(tracked=track, ranged=depth))
        if depth:
            parts.append(Distances(settings.vehicle.name))
        if markers is not None:
            parts.append(Markers(settings))
        if cloud is not None:
            voxel, average = (voxel or 0.1, average or 4) if clusters else (voxel, average or 1)
            options = CloudOptions(
                cloud, cloud_frame, ned_from_body, max_range, voxel, average, clusters, cloud_view, cloud_text
            )
            parts.append(Cloud(uri, settings.camera, options))
        if is_status:
            parts.append(SourceStatus(frames, topics.IMAGE.key(settings.vehicle.name)))
        if period is None:
            period = _STATUS_PERIOD_S if is_status else 0.0
        levelling = build_levelling(settings, telemetry) if level else None
        write = functools.partial(print, flush=True)
        output = Output(write, as_json, save, grey, levelling, period, limit)
        summary = detect_source(frames, settings, frame_detector, parts, output, telemetry, every=every)
    if not summary.frames:
        typer.echo(f"companion: {uri}: contains no frames", err=True)
        raise typer.Exit(EXIT_BAD_INPUT)
    if with_model:
        typer.echo(f"companion: {summary}", err=True)


def _changed(settings: Settings, changes: Mapping[str, Mapping[str, Any]]) -> Settings:
    """The settings with other values: section → key → value."""
    return settings.model_copy(
        update={
            section: getattr(settings, section).model_copy(update=values)
            for section, values in changes.items()
        }
    )


def _not_given(
    changes: Mapping[str, Mapping[str, Any]], given: Mapping[str, str]
) -> dict[str, dict[str, Any]]:
    """The changes without those of flags that were set."""
    return {
        section: {key: value for key, value in values.items() if f"{section}.{key}" not in given}
        for section, values in changes.items()
    }


def _dictionary(settings: Settings, name: str) -> str:
    """The dictionary of `--markers`. Raises ValueError."""
    from vision.marker_dictionaries import dictionary_named

    if settings.camera.on_gimbal:
        raise ValueError("camera.on_gimbal: without a vehicle the gimbal's attitude is unknown; unset it")
    dictionary = dictionary_named(name) if name else settings.markers.dictionary
    if dictionary is None:
        raise ValueError(
            "no dictionary: give --markers DICTIONARY, for example APRILTAG_36h11, or markers.dictionary"
        )
    return dictionary
