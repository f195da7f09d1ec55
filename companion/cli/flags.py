"""Shared parts of the commands: settings as flags (`--detector-image-size 320`), shared options.

Also one-line errors, checks of values and options, and the warning for a model of rendered scenes.
"""

from __future__ import annotations

import functools
import inspect
import logging
import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer
import typer.core
import typer.main

from companion.host.journal import marked_for_journal
from companion.host.load import with_load
from companion.host.passing import EXIT_PASSING, PassingError
from vision.extras import missing_module
from vision.gc_pause import gc_paused
from vision.redaction import redacted

if TYPE_CHECKING:
    from companion.settings.reading import Flag

# The settings load pydantic, numpy and OpenCV: they are imported when a command runs or shows its own help.

EXIT_FAILED = 1
EXIT_BAD_INPUT = 2
YOLO = "yolo"  # vision.object_detector.YOLO, without numpy
_GIVEN = "companion.settings given as flags"  # in a context's `meta`

# How the help shows the type of a setting; all of them are text to typer.
_METAVARS = {bool: "<true|false>", int: "<int>", float: "<float>", str: "<str>", tuple: "<list>"}
# Short names of frequent settings; the full names work too.
SHORT_NAMES = {
    "source.uri": "--source",
    "detector.model": "--model",
    "detector.classes": "--classes",
    "detector.confidence": "--confidence",
    "vehicle.driver": "--driver",
    "recording.video": "--video",
    "log.level": "--log-level",
}

# The service alone does this; a command that takes the section `source` to read it must not accept it.
_OF_THE_SERVICE = {"source.share"}

# click's UsageError, through its public subclass: some versions of typer include their own click
_UsageError: Any = typer.BadParameter.__base__

Processes = Annotated[int, typer.Option(min=1, help="With --seeds: number of seeds at once.")]
RayAddress = Annotated[
    str | None,
    typer.Option(
        "--ray", metavar="HOST:PORT", help="With --seeds: run them on this Ray cluster (extra learn)."
    ),
]


class CompanionCommands(typer.core.TyperGroup):
    """The commands. One without a setting names the new flag too if it is given the setting's former one.

    What needs a module of an extra that is not installed says so in one line, and exits with code 2.
    """

    def invoke(self, ctx: Any) -> Any:
        """Run the command that was given."""
        try:
            return super().invoke(ctx)
        except ModuleNotFoundError as error:
            if (line := missing_module(error)) is None:
                raise
            typer.echo(f"companion: {ctx.invoked_subcommand}: {line}", err=True)
            raise typer.Exit(EXIT_BAD_INPUT) from error
        except _UsageError as error:
            if text := _renamed_flag(getattr(error, "option_name", "")):
                raise _UsageError(text, error.ctx) from error
            error.message = redacted(error.message)
            raise


def with_default(name: str) -> type[typer.core.TyperGroup]:
    """A group of commands with a default one: `GROUP SOURCE` is `GROUP NAME SOURCE`."""

    class WithDefault(typer.core.TyperGroup):
        def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
            if args and args[0] not in (*self.commands, "--help"):
                args = [name, *args]
            return super().parse_args(ctx, args)

    return WithDefault


def _renamed_flag(flag: str) -> str | None:
    from companion.settings.former import REMOVED, RENAMED, VERSION

    if flag.startswith("--views-"):
        return (
            f"{flag}: the sections [views.NAME] were renamed to [cameras.NAME] in version 0.2.0; "
            "they stand in the settings file"
        )
    now = {_flag_of(old): _flag_of(new) for old, new in RENAMED.items()}.get(flag)
    if now is not None:
        return f"{flag} was renamed to {now} in version {VERSION}; this command has no such option"
    instead = {_flag_of(old): removed.instead for old, removed in REMOVED.items()}.get(flag)
    return None if instead is None else f"{flag} was removed in version {VERSION}: {instead}"


def _flag_of(key: str) -> str:
    return f"--{key.replace('.', '-').replace('_', '-')}"


@contextmanager
def plain_errors(*expected: type[Exception], code: int = EXIT_BAD_INPUT) -> Iterator[None]:
    """Print errors of these types as one-line messages and exit with `code`.

    An error that may pass is always printed so, and the code is then EXIT_PASSING.
    """
    printed: tuple[type[Exception], ...] = (*expected, PassingError)
    try:
        yield
    except printed as error:
        for line in str(error).splitlines():
            typer.echo(with_load(redacted(f"companion: {line}")), err=True)
        raise typer.Exit(EXIT_PASSING if isinstance(error, PassingError) else code) from error


def say_silent(text: str) -> None:
    """Print what is known of a service that is silent in the middle of a command; the command waits on."""
    typer.echo(f"companion: {text}", err=True)


def warn_rendered_only(models: Iterable[tuple[str, str | None]]) -> None:
    """Warn once if a model of rendered scenes may process camera images.

    Args:
        models: (source URI, name) of each model that was trained on rendered scenes only. The simulated
            camera is read from shared memory. Any other source, the simulator's streams included, looks like
            a camera.
    """
    for uri, model in models:
        if not uri.startswith("shm://"):
            text = (
                f"companion: the model '{model}' is trained on rendered scenes only and does not work on "
                "camera images; if these are camera images, add --pull: it downloads yolox_s (Apache-2.0) "
                "and uses it; or give your own --model"
            )
            typer.echo(marked_for_journal(text, logging.WARNING), err=True)
            return


def check_finite(flag: str, *values: float) -> None:
    """Raise ValueError, which names the flag, if a value is no finite number."""
    if not all(map(math.isfinite, values)):
        raise ValueError(f"{flag} must be finite, got {' '.join(f'{value:g}' for value in values)}")


def check_seed_options(context: typer.Context) -> None:
    """Exit with code 2 if a command's options do not fit together: --seed, --seeds and those for --seeds."""
    for_seeds = {"as_json", "processes", "ray", "synthetic"}
    given = {
        name
        for name in ("seed", "seeds", *for_seeds)
        if (source := context.get_parameter_source(name)) is not None and source.name == "COMMANDLINE"
    }
    refused = None
    if "seeds" not in given and (alone := given & for_seeds):
        refused = f"--{min(alone).removeprefix('as_')} is for many seeds: add --seeds, such as --seeds 1..8"
    elif {"seed", "seeds"} <= given:
        refused = "--seed and --seeds were given: give one of them"
    elif {"processes", "ray"} <= given:
        refused = "--processes and --ray were given: a cluster decides how many seeds run at once"
    if refused is not None:
        typer.echo(f"companion: {refused}", err=True)
        raise typer.Exit(EXIT_BAD_INPUT)


def check_folder(path: Path) -> None:
    """Raise OSError if the folder of a file to be written does not exist."""
    if not path.parent.is_dir():
        raise OSError(f"cannot write {path}: no such folder")


def settings_command(
    app: typer.Typer, *keys: str, epilog: Callable[[], str] = lambda: ""
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Register a function as a command of `app` that takes `--config` and settings as flags.

    The function's first parameter, `settings`, receives the validated settings. An optional parameter `given`
    receives the flags that were set, key → text. All other parameters are the command's own.

    Args:
        keys: the settings that are flags, by key (`vehicle.name`) or by section (`zenoh`); none: all.
        epilog: returns the text after the help, with its line breaks.
    """

    def register(command: Callable[..., None]) -> Callable[..., None]:
        kind = type("_WithSettings", (_WithSettings,), {"keys": keys, "make_epilog": staticmethod(epilog)})
        return app.command(cls=kind)(_given_settings(command, keys))

    return register


class _WithSettings(typer.core.TyperCommand):
    """A command whose settings flags are created on use: for all commands together they are hundreds."""

    keys: tuple[str, ...] = ()
    make_epilog: Callable[[], str]

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the command's parameters, the settings, and click's."""
        parameters = super().get_params(ctx)
        own = len(self.params)
        return [*parameters[:own], *_setting_parameters(self.keys), *parameters[own:]]

    def invoke(self, ctx: Any) -> Any:
        """Run the command; the values of the settings flags are passed in the context."""
        given = {flag.key: ctx.params.pop(name) for name, flag in _flags_by_parameter(self.keys).items()}
        ctx.meta[_GIVEN] = given
        return super().invoke(ctx)

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write the epilog without wrapping."""
        if text := type(self).make_epilog():
            formatter.write(f"\n{text}\n")


def _given_settings(command: Callable[..., None], keys: tuple[str, ...]) -> Callable[..., None]:
    """Return the command with the signature for typer: without `settings`, with `--config`."""
    own = inspect.signature(command)
    hints = get_type_hints(command, include_extras=True, localns={"Settings": Any})

    @functools.wraps(command)
    def wrapper(context: typer.Context, config_file: Path | None, **values: Any) -> None:
        from companion.settings.reading import ConfigurationError, load_settings

        given: dict[str, str | None] = context.meta[_GIVEN]
        overrides = {key: text for key, text in given.items() if text is not None}
        # The command's own SOURCE, if it is read with camera's lens; `preview` needs that for --level alone.
        with_lens = "camera" in keys and values.get("level", True)
        with plain_errors(ConfigurationError):
            settings = load_settings(
                config_file, overrides, read_uri=values.get("source") if with_lens else None
            )
        if "given" in own.parameters:
            values["given"] = overrides
        command(settings, **values)

    parameters = [
        parameter.replace(annotation=hints[name], kind=inspect.Parameter.KEYWORD_ONLY)
        for name, parameter in own.parameters.items()
        if name not in ("settings", "given")
    ]
    parameters.append(
        _option("config_file", Path | None, "--config", help="Settings file. Default: ./companion.toml.")
    )
    parameters.append(inspect.Parameter("context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context))
    _declare(wrapper, parameters)
    return wrapper


def _declare(function: Any, parameters: list[inspect.Parameter]) -> None:
    """Set the signature that typer reads."""
    function.__signature__ = inspect.Signature(parameters)
    function.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}


@functools.cache
def _flags_by_parameter(keys: tuple[str, ...]) -> dict[str, Flag]:
    with gc_paused():
        from companion.settings.former import REMOVED, RENAMED
        from companion.settings.reading import Flag, flags
    known = {name for flag in flags() for name in (flag.key, flag.key.partition(".")[0])}
    if unknown := set(keys) - known:
        raise ValueError(f"no such settings or sections: {', '.join(sorted(unknown))}")
    wanted = set(keys)
    chosen = [
        flag
        for flag in flags()
        if not keys
        or flag.key in wanted
        or (flag.key.partition(".")[0] in wanted and flag.key not in _OF_THE_SERVICE)
    ]
    # Former names are hidden flags: using one is reported with all other errors of the settings.
    taken = {flag.key for flag in chosen}
    sections = {key.partition(".")[0] for key in taken}
    former = [old for old, new in RENAMED.items() if new in taken]
    former += [old for old in REMOVED if old.partition(".")[0] in sections]
    hidden = [Flag(old, str, None, "") for old in former]
    return {flag.key.replace(".", "__"): flag for flag in (*chosen, *hidden)}


@functools.cache
def _setting_parameters(keys: tuple[str, ...]) -> list[Any]:
    """Return an option for each setting, created by typer."""

    def settings(**_values: Any) -> None:
        """Never run: typer creates parameters only for commands."""

    from companion.settings.former import REMOVED, RENAMED

    parameters = []
    for name, flag in _flags_by_parameter(keys).items():
        names = [_flag_of(flag.key)]
        if short := SHORT_NAMES.get(flag.key):
            names.insert(0, short)
        panel = flag.key.partition(".")[0]
        parameters.append(
            _option(
                name,
                str | None,  # parsed with the other origins of settings, which names the flag in errors
                *names,
                help=flag.help,
                metavar=_METAVARS[flag.type],
                panel=panel,
                hidden=flag.key in RENAMED or flag.key in REMOVED,
            )
        )
    _declare(settings, parameters)
    app = typer.Typer(add_completion=False)
    app.command()(settings)
    return list(typer.main.get_command(app).params)


def _option(
    name: str,
    kind: Any,
    *names: str,
    help: str,
    metavar: str | None = None,
    panel: str | None = None,
    hidden: bool = False,
) -> inspect.Parameter:
    option = typer.Option(
        *names, help=help, metavar=metavar, rich_help_panel=panel, show_default=False, hidden=hidden
    )
    return inspect.Parameter(
        name, inspect.Parameter.KEYWORD_ONLY, default=None, annotation=Annotated[kind, option]
    )
