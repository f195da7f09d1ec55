"""The command lines of `companion cameras`, `companion preview` and `companion depth`."""

from __future__ import annotations

import functools
import json
import logging
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.flags import plain_errors
from companion.host.journal import log_to_standard_error

if TYPE_CHECKING:
    from companion.settings import Settings
    from vision.sources import Source
    from vision.sources.csi import CsiCamera
    from vision.sources.v4l2 import FrameSize, VideoDevice


def cameras(
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """List the cameras of this computer. Prints their formats, sizes and rates."""
    from vision.sources.csi import csi_cameras
    from vision.sources.v4l2 import video_devices

    devices = video_devices()
    csi = csi_cameras(devices)
    if as_json:
        rows = {"devices": [asdict(device) for device in devices], "csi": [asdict(camera) for camera in csi]}
        typer.echo(json.dumps(rows, default=str))
        return
    for line in (*_csi_lines(csi), *(line for device in devices for line in _device_lines(device))):
        typer.echo(line)
    if not devices and not csi:
        typer.echo("no cameras: nothing at /dev/video*, and rpicam-hello lists none")


def _csi_lines(cameras: tuple[CsiCamera, ...]) -> Iterator[str]:
    for camera in cameras:
        yield f"csi://{camera.number}  {camera.sensor}"
        for width, height, rate_hz in camera.modes:
            yield f"  {width}x{height}" + ("" if rate_hz is None else f"  {rate_hz:g} Hz")


def _device_lines(device: VideoDevice) -> Iterator[str]:
    what = device.error or f"{device.card} ({device.driver}, {device.bus})"
    yield f"{device.stable_path or device.path}  {what}"
    if device.stable_path is not None:
        yield f"  = {device.path}"
    if device.kind != "camera" and not device.error:
        yield f"  {device.kind} node: delivers no images"
    if device.holders:
        yield f"  open in {', '.join(device.holders)}"
    for pixel_format in device.formats:
        yield f"  {pixel_format.fourcc}  {pixel_format.description}"
        for size in pixel_format.sizes:
            yield f"    {_size_text(size)}"


def _size_text(size: FrameSize) -> str:
    text = f"{size.width}x{size.height}"
    if size.smallest is not None:
        text = f"{size.smallest[0]}x{size.smallest[1]} to {text}"
    rates = ", ".join(f"{rate_hz:g}" for rate_hz in size.rates_hz)
    return f"{text}  {rates} Hz" if rates else text


SOURCE_HELP = "/dev/video0, csi://0, file, folder, FIFO, - (standard input) or URL. Default: source.uri."


def preview(
    settings: Settings,
    source: Annotated[str | None, typer.Argument(help=SOURCE_HELP)] = None,
    save: Annotated[Path | None, typer.Option(help="Folder for an image with each line.")] = None,
    grey: Annotated[bool, typer.Option("--grey", help="Images in grey, a third as wide and high.")] = False,
    period: Annotated[
        float, typer.Option(min=0, help="Seconds between lines and images; 0: every frame.")
    ] = 1.0,
    limit: Annotated[int | None, typer.Option(min=1, help="Maximum number of lines.")] = None,
    level: Annotated[
        bool,
        typer.Option("--level", help="Level the images by the attitude of the vehicle (--vehicle-url)."),
    ] = False,
) -> None:
    """Show what a source delivers. Prints size, measured rate and stamp once a second. Ends on Ctrl-C."""
    from companion.bus import topics
    from companion.camera_tools.preview import PreviewOptions, attitudes_of, preview_source
    from companion.perception.assembly import build_levelling
    from companion.vehicle.driver import LinkError

    topic = topics.IMAGE.key(settings.vehicle.name)
    with ExitStack() as stack:
        stack.enter_context(plain_errors(LinkError, ValueError))
        if level and save is None:
            raise ValueError("--level is for the images of --save DIR, which is not given")
        telemetry = stack.enter_context(attitudes_of(settings)) if level else None
        frames = stack.enter_context(opened(settings, source))
        levelling = None
        if telemetry is not None:
            levelling = build_levelling(_with_calibration(settings, frames), telemetry)
        options = PreviewOptions(topic, save, grey, period, limit, levelling)
        preview_source(frames, options, functools.partial(print, flush=True))


def depth(
    settings: Settings,
    source: Annotated[str | None, typer.Argument(help=SOURCE_HELP)] = None,
    detect: Annotated[bool, typer.Option("--detect", help="Detect objects, and print their depth.")] = False,
    save: Annotated[Path | None, typer.Option(help="Folder for an image of each frame.")] = None,
    limit: Annotated[int | None, typer.Option(min=1, help="Maximum number of frames.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print the messages of the topic `depth`.")] = False,
) -> None:
    """Measure the depth of a source.

    Prints the depth at the centre, and with --detect that of each object, one line per frame.
    """
    from companion.camera_tools.preview import DepthRecorder, depth_source
    from companion.perception.assembly import CameraTelemetry, build_pipeline, load_detector

    played = settings.source.model_copy(update={"every_frame": True})  # every frame of a recording
    settings = settings.model_copy(update={"source": played})
    with opened(settings, source) as frames, plain_errors(ValueError):
        settings = _with_calibration(settings, frames)
        detector = load_detector(settings) if detect else None
        pipeline = build_pipeline(settings, frames, detector, CameraTelemetry(), recorder=DepthRecorder(save))
        write = functools.partial(print, flush=True)
        depth_source(pipeline, vehicle=settings.vehicle.name, limit=limit, as_json=as_json, write=write)


def _with_calibration(settings: Settings, source: Source) -> Settings:
    """The settings with the lens and mount that a source brings, if any."""
    from companion.settings.calibration import adopt_calibration

    if source.calibration is None:
        return settings
    camera = adopt_calibration(settings.camera, source.calibration).camera
    return settings.model_copy(update={"camera": camera})


@contextmanager
def opened(settings: Settings, uri: str | None) -> Iterator[Source]:
    """Open a source with the settings of section `source`; errors are one line, Ctrl-C ends."""
    from companion.settings.plugins import PluginError, load_plugins
    from vision.sources import SourceError, open_source

    log_to_standard_error(logging.WARNING, "companion: %(message)s")
    with plain_errors(PluginError, SourceError, OSError):
        load_plugins(settings.plugins.modules)
        try:
            with open_source(uri or settings.source.uri, settings.source.opening()) as source:
                yield source
        except KeyboardInterrupt:
            raise typer.Exit from None
