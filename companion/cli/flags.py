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
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, TextIO, get_type_hints

import typer
import typer.core
import typer.main

from companion.cli.former import former_line
from companion.host.journal import marked_for_journal
from companion.host.load import with_load
from companion.host.passing import EXIT_PASSING, PassingError
from companion.operator.reply_text import printable
from vision.extras import missing_module
from vision.gc_pause import gc_paused
from vision.redaction import redacted

if TYPE_CHECKING:
    import zenoh

    from companion.settings import Settings
    from companion.settings.layers import LayeredSettings
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
    "detector.iou": "--iou",
    "detector.image_size": "--image-size",
    "detector.runtime": "--runtime",
    "detector.precision": "--precision",
    "detector.device": "--device",
    "detector.threads": "--threads",
    "zenoh.connect": "--connect",
    "vehicle.driver": "--driver",
    "recording.video": "--video",
    "log.level": "--log-level",
}

# Annotations of parameters that are no options; they are imported for type checkers only.
_SETTINGS_TYPES = ("LayeredSettings", "Settings", "SettingsFiles")
# Parts of `detect` for which the lens of the camera is read.
_WITH_LENS = ("level", "depth", "markers", "cloud")
# A command that takes a whole section has other options for these: only the service shares frames; --tiles.
_NOT_OF_SECTIONS = {"source.share", "detector.tiles"}
# Settings of a client of a running service.
CLIENT_SETTINGS = ("zenoh", "vehicle.name")

# click's UsageError, through its public subclass: some versions of typer include their own click
_UsageError: Any = typer.BadParameter.__base__

# Options that several commands have.
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON: one object, or one per line.")]
Model = Annotated[str, typer.Option(help="Checkpoint, exported file, or name in the models folder.")]
ImageSize = Annotated[int, typer.Option(min=32, help="Longer side of the network's input, pixels.")]
Iou = Annotated[
    float | None,
    typer.Option(min=0, max=1, help="NMS IoU threshold. Default: that of the model, else 0.7."),
]
Runtime = Annotated[
    str | None,
    typer.Option(
        help="Runtime: torch, onnxruntime, openvino, tensorrt or auto. Default: that of the file, torch for "
        "a checkpoint."
    ),
]
Device = Annotated[str, typer.Option(help="Device of torch: cpu or cuda.")]
Threads = Annotated[int | None, typer.Option(min=1, help="CPU threads. Default: the runtime's.")]
Tiles = Annotated[
    bool, typer.Option("--tiles", help="Process large images in tiles too: small objects, much slower.")
]
TileSize = Annotated[
    int | None, typer.Option(min=64, help="Side of a tile, pixels of the image. Default: --image-size.")
]
TileOverlap = Annotated[float, typer.Option(min=0, max=0.8, help="Overlap of tiles, fraction of a tile.")]
Limit = Annotated[int | None, typer.Option(min=1, help="Maximum number of images or messages.")]
Processes = Annotated[int, typer.Option(min=1, help="With --seeds: number of seeds at once.")]
RayAddress = Annotated[
    str | None,
    typer.Option(
        "--ray", metavar="HOST:PORT", help="With --seeds: run them on this Ray cluster (extra learn)."
    ),
]


class Command(typer.core.TyperCommand):
    """A command whose options are grouped in its help, each group under its name, without rich.

    An option of `optional_values` may be the last word, or stand before another option, without its value.
    """

    optional_values: tuple[str, ...] = ()

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Give the empty value to options whose value was left out."""
        followed_by = (*args[1:], "--")
        return super().parse_args(
            ctx,
            [
                f"{word}=" if word in self.optional_values and after.startswith("-") else word
                for word, after in zip(args, followed_by, strict=False)
            ],
        )

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write arguments, then options by panel."""
        panels: dict[str, list[Any]] = {"Arguments": [], "Options": []}
        for parameter in self.get_params(ctx):
            if record := parameter.get_help_record(ctx):
                own = "Arguments" if parameter.param_type_name == "argument" else "Options"
                panel = getattr(parameter, "rich_help_panel", None) or own
                panels.setdefault(panel, []).append(record)
        for name, records in panels.items():
            if records:
                with formatter.section(name):
                    formatter.write_dl(records)


class CompanionCommands(typer.core.TyperGroup):
    """The commands. A former spelling is one line with the new one, and exit code 2.

    One without a setting names the new flag too if it is given the setting's former one.

    What needs a module of an extra that is not installed says so in one line, and exits with code 2.
    """

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the command that was given."""
        if not ctx.resilient_parsing and (line := former_line(args)) is not None:
            refuse(line)
        return super().resolve_command(ctx, args)

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
            typer.echo(with_load(redacted(f"companion: {printable(line)}")), err=True)
        raise typer.Exit(EXIT_PASSING if isinstance(error, PassingError) else code) from error


def is_terminal(stream: TextIO | None) -> bool:
    """Whether a standard stream is a terminal. None: it is closed, as after `<&-` of a shell."""
    return stream is not None and stream.isatty()


def refuse(text: str) -> NoReturn:
    """Print one line on standard error, and exit with the code of bad input."""
    typer.echo(f"companion: {text}", err=True)
    raise typer.Exit(EXIT_BAD_INPUT)


def given_options(context: typer.Context) -> set[str]:
    """The names of the command's own parameters on the command line."""
    sources = ((name, context.get_parameter_source(name)) for name in context.params)
    return {name for name, source in sources if source is not None and source.name == "COMMANDLINE"}


def check_belonging(context: typer.Context, what: str, names: Iterable[str], *, chosen: bool) -> None:
    """Exit with code 2, naming it, if an option was given without what it is for."""
    if chosen or not (misplaced := given_options(context) & set(names)):
        return
    flags = {each.name: max(each.opts, key=len) for each in context.command.params}
    refuse(f"{flags[min(misplaced)]} is for {what}: give that too, or remove the option")


def say_silent(text: str) -> None:
    """Print what is known of a service that is silent in the middle of a command; the command waits on."""
    typer.echo(f"companion: {printable(text)}", err=True)


def named_vehicle(settings: Settings) -> str | None:
    """Return `vehicle.name` if a file, a variable or a flag has it; None: the only vehicle alive is meant."""
    return settings.vehicle.name if "name" in settings.vehicle.model_fields_set else None


def vehicle_of(session: zenoh.Session, settings: Settings) -> str:
    """Return the vehicle that a client command is for, and print its name if it was not given.

    With no vehicle alive it is the one of the default name, which the command will miss.

    Raises:
        ValueError: no name was given, and several vehicles are alive.
    """
    from companion.bus.client import only_vehicle

    name = named_vehicle(settings) or only_vehicle(session) or settings.vehicle.name
    say_vehicle(settings, name)
    return name


def say_vehicle(settings: Settings, name: str) -> None:
    """Print the name of a vehicle that was found, unless it is the expected one."""
    if name != settings.vehicle.name:
        typer.echo(f"companion: vehicle {name!r}, the only one alive", err=True)


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
    given = given_options(context)
    for_seeds = {"as_json", "processes", "ray", "synthetic"}
    check_belonging(context, "many seeds, such as --seeds 1..8", for_seeds, chosen="seeds" in given)
    if {"seed", "seeds"} <= given:
        refuse("--seed and --seeds were given: give one of them")
    if {"processes", "ray"} <= given:
        refuse("--processes and --ray were given: a cluster decides how many seeds run at once")


def check_folder(path: Path) -> None:
    """Raise OSError if the folder of a file to be written does not exist."""
    if not path.parent.is_dir():
        raise OSError(f"cannot write {path}: no such folder")


def settings_command(
    app: typer.Typer,
    *keys: str,
    epilog: Callable[[], str] = lambda: "",
    optional_values: tuple[str, ...] = (),
    only_config: bool = False,
) -> Callable[[Callable[..., None]], Callable[..., None]]:
    """Register a function as a command of `app` that takes `--config` and settings as flags.

    The function's first parameter, `settings`, receives the validated settings; `read_settings` instead of it
    a function that reads their layers, and may raise ConfigurationError. Optional parameters are
    `layer_files`, where they are read: the command then says itself which are not; `given`, the flags that
    were set, key → text; and `context`. All others are the command's own.

    Args:
        keys: the settings that are flags, by key (`vehicle.name`) or by section (`zenoh`); none: all.
        epilog: returns the text after the help, with its line breaks. optional_values: see `Command`.
        only_config: of a command whose results must not depend on the files of system and user.
    """

    def register(command: Callable[..., None]) -> Callable[..., None]:
        own = {"keys": keys, "make_epilog": staticmethod(epilog), "optional_values": optional_values}
        kind = type("_WithSettings", (_WithSettings,), own)
        return app.command(cls=kind)(_given_settings(command, only_config))

    return register


class _WithSettings(Command):
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


def _given_settings(command: Callable[..., None], only_config: bool) -> Callable[..., None]:
    """Return the command with the signature for typer: without `settings`, with `--config`."""
    own = inspect.signature(command)
    hints = get_type_hints(command, include_extras=True, localns=dict.fromkeys(_SETTINGS_TYPES, Any))

    @functools.wraps(command)
    def wrapper(context: typer.Context, config_file: Path | None, **values: Any) -> None:
        from companion.settings.layers import settings_files
        from companion.settings.reading import ConfigurationError, load_layers

        given: dict[str, str | None] = context.meta[_GIVEN]
        overrides = {key: text for key, text in given.items() if text is not None}
        # The command's own SOURCE, if it is read with the camera's lens.
        with_lens = any(values.get(part) not in (None, False) for part in _WITH_LENS)
        read_uri = values.get("source") if with_lens else None
        files = settings_files(config_file, only_config=only_config)

        def read_settings() -> LayeredSettings:
            return load_layers(files, overrides, read_uri=read_uri)

        offered = {"given": overrides, "layer_files": files, "context": context}
        values |= {name: value for name, value in offered.items() if name in own.parameters}
        if "layer_files" not in own.parameters:
            for found, advice in files.not_read:
                text = f"companion: {found}; {advice}"
                typer.echo(marked_for_journal(text, logging.WARNING), err=True)
        if "read_settings" in own.parameters:
            with plain_errors(ConfigurationError):
                command(read_settings, **values)
            return
        with plain_errors(ConfigurationError):
            settings = read_settings().settings
        command(settings, **values)

    parameters = [
        parameter.replace(annotation=hints[name], kind=inspect.Parameter.KEYWORD_ONLY)
        for name, parameter in own.parameters.items()
        if name not in ("settings", "read_settings", "layer_files", "given", "context")
    ]
    layer = "Settings file." if only_config else "Settings file, over those of user and system."
    parameters.append(_option("config_file", Path | None, "--config", help=layer))
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
        or (flag.key.partition(".")[0] in wanted and flag.key not in _NOT_OF_SECTIONS)
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
        panel = f"Settings of [{flag.key.partition('.')[0]}]"
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
