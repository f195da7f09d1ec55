"""What the commands share: errors for a person, and every setting as a flag, `--detector-image-size 320`."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import typer

from companion.settings.reading import ConfigurationError, Flag, flags, load_settings

EXIT_BAD_INPUT = 2

# The ones typed every day; each is also there under its full name.
SHORT_NAMES = {
    "source.uri": "--source",
    "detector.model": "--model",
    "detector.classes": "--classes",
    "detector.confidence": "--confidence",
    "detector.every": "--every",
    "vehicle.driver": "--driver",
    "recording.video": "--video",
    "log.level": "--log-level",
}


@contextmanager
def plain_errors(*expected: type[Exception]) -> Iterator[None]:
    """Errors of these kinds are for the person at the keyboard: the message, and exit code 2."""
    try:
        yield
    except expected as error:
        for line in str(error).splitlines():
            typer.echo(f"companion: {line}", err=True)
        raise typer.Exit(EXIT_BAD_INPUT) from error


def with_settings(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command `--config` and a flag for every setting; it gets the checked `settings` as its first."""
    own = inspect.signature(command)
    hints = get_type_hints(command, include_extras=True)
    table = {_parameter_name(flag): flag for flag in flags()}

    @functools.wraps(command)
    def wrapper(**values: Any) -> None:
        path: Path | None = values.pop("config_file")
        given = {flag.key: values.pop(name) for name, flag in table.items()}
        overrides = {key: text for key, text in given.items() if text is not None}
        try:
            settings = load_settings(path, overrides)
        except ConfigurationError as error:
            for problem in error.problems:
                typer.echo(f"companion: {problem}", err=True)
            raise typer.Exit(2) from error
        command(settings, **values)

    parameters = [
        parameter.replace(annotation=hints[name], kind=inspect.Parameter.KEYWORD_ONLY)
        for name, parameter in own.parameters.items()
        if name != "settings"
    ]
    parameters.append(
        _option("config_file", Path | None, "--config", help="settings file; else ./companion.toml")
    )
    for name, flag in table.items():
        names = [f"--{flag.key.replace('.', '-').replace('_', '-')}"]
        if short := SHORT_NAMES.get(flag.key):
            names.insert(0, short)
        parameters.append(_option(name, str | None, *names, help=flag.help, panel=flag.key.partition(".")[0]))
    wrapper.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    wrapper.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return wrapper


def _parameter_name(flag: Flag) -> str:
    return flag.key.replace(".", "__")


def _option(name: str, kind: Any, *names: str, help: str, panel: str | None = None) -> inspect.Parameter:
    option = typer.Option(*names, help=help, rich_help_panel=panel, show_default=False)
    return inspect.Parameter(
        name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=Annotated[kind, option]
    )
