"""The command line of `companion describe`: flight commands, topics, settings and cameras."""

from __future__ import annotations

import json
import logging
import os
import sys
from collections.abc import Callable, Iterator
from dataclasses import asdict
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from companion.cli.flags import AsJson, check_belonging, is_terminal, plain_errors, refuse
from companion.host.journal import marked_for_journal
from vision.redaction import HIDDEN, redacted

if TYPE_CHECKING:
    from companion.settings import Settings
    from companion.settings.layers import LayeredSettings
    from vision.sources.csi import CsiCamera
    from vision.sources.v4l2 import FrameSize, VideoDevice


class What(StrEnum):
    """What is described."""

    COMMANDS = "commands"
    TOPICS = "topics"
    SETTINGS = "settings"
    CAMERAS = "cameras"


def describe(
    read_settings: Callable[[], LayeredSettings],
    context: typer.Context,
    what: Annotated[What, typer.Argument(metavar="WHAT", help="commands, topics, settings or cameras.")],
    as_json: AsJson = False,
    as_markdown: Annotated[
        bool, typer.Option("--markdown", help="Print commands or topics as Markdown tables.")
    ] = False,
    schema: Annotated[
        Path | None, typer.Option(help="Folder: write the JSON Schema of each topic as NAME.schema.json.")
    ] = None,
    check: Annotated[
        bool,
        typer.Option(
            "--check",
            help="Of the settings print only what is wrong: also key files, model, sources, folders.",
        ),
    ] = False,
    origin: Annotated[
        bool,
        typer.Option(
            "--origin",
            help="Of the settings print what is not the default, and which file, variable or flag gave it.",
        ),
    ] = False,
) -> None:
    """Describe flight commands, topics, settings or cameras.

    Flight commands with arguments, units and ranges, including those of plug-ins. Topics: what they hold,
    rate and maximum age. Settings: those in effect, as a TOML file with a comment on every key. Cameras of
    this computer: formats, sizes and rates.

    Settings are read from /etc/companion/companion.toml, then ~/.config/companion/companion.toml, --config,
    the environment (COMPANION_SECTION_KEY) and flags; the later takes precedence.
    """
    in_tables, of_settings = (What.COMMANDS, What.TOPICS), what is What.SETTINGS
    no_table = not of_settings or origin
    check_belonging(context, "commands, topics, cameras and --origin", ("as_json",), chosen=no_table)
    check_belonging(context, "commands and topics", ("as_markdown",), chosen=what in in_tables)
    check_belonging(context, "topics", ("schema",), chosen=what is What.TOPICS)
    check_belonging(context, "settings", ("check", "origin"), chosen=of_settings)
    if check and origin:
        refuse("--check and --origin were given: give one of them")
    if what is What.COMMANDS:
        _describe_commands(read_settings().settings, as_json=as_json, as_markdown=as_markdown)
    elif what is What.TOPICS:
        _describe_topics(schema, as_json=as_json, as_markdown=as_markdown)
    elif origin:
        _describe_origins(read_settings(), as_json=as_json)
    elif of_settings:
        _describe_settings(read_settings(), check=check)
    else:
        _describe_cameras(as_json=as_json)


def _describe_commands(settings: Settings, *, as_json: bool, as_markdown: bool) -> None:
    from companion.guidance.grammar import describe, json_schema, markdown
    from companion.settings.plugins import PluginError, load_plugins

    with plain_errors(PluginError):
        load_plugins(settings.plugins.modules)
    text = json.dumps(json_schema(), indent=2) if as_json else markdown() if as_markdown else describe()
    typer.echo(text, nl=not as_markdown)


def _describe_topics(schema: Path | None, *, as_json: bool, as_markdown: bool) -> None:
    from companion.bus.schema import COLUMNS, topic_rows, topic_table, topics_markdown, write_schemas

    if schema is not None:
        with plain_errors(OSError):
            for path in write_schemas(schema):
                typer.echo(path)
        return
    if as_markdown:
        typer.echo(topics_markdown(), nl=False)
        return
    if as_json:
        for row in topic_table():
            typer.echo(json.dumps(row))
        return
    from rich.console import Console
    from rich.table import Table

    table = Table(*COLUMNS)
    for cells in topic_rows():
        table.add_row(*cells)
    Console(width=None if is_terminal(sys.stdout) else 160).print(table)


def _describe_settings(layered: LayeredSettings, *, check: bool) -> None:
    from companion.settings.reading import ConfigurationError, to_toml, unknown_variables

    if check:
        from companion.cli.config_check import check_settings

        with plain_errors(ConfigurationError):
            try:
                missing = [_with_file(line, layered) for line in check_settings(layered.settings)]
            except ConfigurationError as error:
                raise ConfigurationError(*(_with_file(line, layered) for line in error.problems)) from None
            for line in (*unknown_variables(os.environ).values(), *missing):
                typer.echo(marked_for_journal(f"companion: {line}", logging.WARNING), err=True)
        return
    _print_redacted(to_toml(layered.settings))


def _with_file(line: str, layered: LayeredSettings) -> str:
    """Add where a file has the key that a line begins with."""
    given = layered.given.get(line.partition(":")[0].partition(" ")[0])
    return f"{line} ({given[-1].origin})" if given and given[-1].origin.kind == "file" else line


def _describe_origins(layered: LayeredSettings, *, as_json: bool) -> None:
    from companion.cli.origins import differing, origins_toml

    if not as_json:
        _print_redacted(origins_toml(layered))
        return
    rows = [
        {
            "key": key,
            "value": own[-1].value,
            "default": default,
            **own[-1].origin._asdict(),
            "overrides": [{"value": value, **origin._asdict()} for value, origin in own[-2::-1]],
        }
        for key, own, default in differing(layered)
    ]
    found = {"files": list(map(str, layered.files.files)), "settings": rows}
    _print_redacted(json.dumps(found, indent=2, ensure_ascii=False) + "\n")


def _print_redacted(text: str) -> None:
    shown = redacted(text)
    if shown != text:
        typer.echo(f"companion: secrets in addresses are printed as {HIDDEN}", err=True)
    typer.echo(shown, nl=False)


def _describe_cameras(*, as_json: bool) -> None:
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
