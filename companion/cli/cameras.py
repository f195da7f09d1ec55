"""The command line of `companion cameras`."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
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
        yield f"  {device.kind} node: delivers no pictures"
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
