"""Reads and prints settings: TOML files, then the environment, then flags; the later takes precedence.

All problems are reported at once, one line each: the key, what was expected, what was found, and where.
"""

from __future__ import annotations

import difflib
import os
import re
import tomllib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from pydantic import ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from companion.settings.fields import (
    SECTIONS_OF_CAMERA,
    expectation,
    expectation_of_key,
    fields_of_sections,
    help_line,
    plain_type,
    section_of,
    sections_of_file,
    shown,
    toml_value,
    value_from_text,
)
from companion.settings.former import CHANGED, LENS, REMOVED, RENAMED, VERSION, lens_line
from companion.settings.layers import FLAG, SYSTEM_VARIABLE, Given, LayeredSettings, Origin, SettingsFiles
from companion.settings.section import Section
from companion.settings.settings import Settings
from companion.settings.toml_text import key_lines, parse_toml
from vision.file_kinds import explained
from vision.redaction import redacted
from vision.text_file import read_text

__all__ = [
    "ConfigurationError",
    "Flag",
    "Settings",
    "flags",
    "load_layers",
    "load_settings",
    "to_toml",
    "unknown_variables",
]

# COMPANION_DETECTOR_IMAGE_SIZE is detector.image_size. No section's name begins with another's and `_`.
ENVIRONMENT_PREFIX = "COMPANION_"
# Other variables of this project: of its tests, and places of files.
_NO_SETTINGS = ("COMPANION_TEST_", "COMPANION_SITL_", "COMPANION_MODELS_FOLDER", SYSTEM_VARIABLE)
_WORDS = re.compile(r"[\w.-]*\w")


class ConfigurationError(ValueError):
    """Invalid settings. `problems` has one line each; the message is those lines."""

    def __init__(self, *problems: str) -> None:
        problems = tuple(map(redacted, problems))
        super().__init__("\n".join(problems))
        self.problems = problems


class Flag(NamedTuple):
    """One setting as a flag.

    Attributes:
        key: dotted: `detector.image_size` is `image_size` in the section `[detector]`.
        type: bool, int, float, str, or tuple (its items separated by commas).
        default: None if unset by default.
        help: one line, with the range.
    """

    key: str
    type: type
    default: Any
    help: str


def flags() -> list[Flag]:
    """Return all settings as flags, in the order of the file."""
    return [
        Flag(f"{table}.{name}", plain_type(field), field.default, help_line(section, name))
        for table, section in sections_of_file().items()
        for name, field in section.fields_by_key().items()
    ]


def load_settings(
    path: str | Path | None = None,
    overrides: Mapping[str, str] | None = None,
    environment: Mapping[str, str] | None = None,
    read_uri: str | None = None,
) -> Settings:
    """Load settings of one file, or of none. No other file of this computer is read.

    Args:
        path: the TOML file; None: only the defaults.
        overrides, environment, read_uri: as `load_layers`.

    Raises:
        ConfigurationError: with every problem found.
    """
    files = SettingsFiles(() if path is None else (Path(path),))
    return load_layers(files, overrides, environment, read_uri).settings


def load_layers(
    files: SettingsFiles,
    overrides: Mapping[str, str] | None = None,
    environment: Mapping[str, str] | None = None,
    read_uri: str | None = None,
) -> LayeredSettings:
    """Load the settings in effect: each file over those before it, then the environment, then flags.

    Args:
        files: of `settings_files`.
        overrides: dotted key → text, from flags. An empty text or `none` unsets an optional value; commas
            separate the items of a list.
        environment: `COMPANION_SECTION_KEY` → text; None: the process's own.
        read_uri: the source that is read with `camera`'s lens, if it is not `source.uri`.

    Raises:
        ConfigurationError: with every problem found, each with the file, variable or flag that has it.
    """
    reading = _Reading()
    for path in files.files:
        reading.take_file(path)
    reading.take_environment(os.environ if environment is None else environment)
    for key, text in (overrides or {}).items():
        reading.take_text(key, text, FLAG)
    return LayeredSettings(reading.settings(read_uri), reading.given(), files)


def unknown_variables(environment: Mapping[str, str]) -> dict[str, str]:
    """Return variable with our prefix that is no setting, and is ignored → one line with the nearest one.

    One of a known section and an unknown key is an error of `load_settings`.
    """
    fields = fields_of_sections()
    known = {_variable_of(section, name): None for section, names in fields.items() for name in names}
    found = {}
    for variable in sorted(environment):
        word = variable.removeprefix(ENVIRONMENT_PREFIX)
        if word == variable or variable.startswith(_NO_SETTINGS) or word.lower().partition("_")[0] in fields:
            continue
        close = difflib.get_close_matches(word.upper(), known, n=1, cutoff=0.6)
        nearest = f"did you mean {ENVIRONMENT_PREFIX}{close[0]}?" if close else "it may be another program's"
        found[variable] = f"{variable} is no setting and is ignored; {nearest}"
    return found


def _variable_of(section: str, name: str) -> str:
    return f"{section}_{name}".upper()


def changed(settings: Settings, changes: Mapping[str, str]) -> Settings:
    """Return the settings with changes, dotted key → text. Raises ConfigurationError."""
    reading = _Reading()
    reading.take_values(settings)
    for key, text in changes.items():
        reading.take_text(key, text, FLAG)
    return reading.settings()


def with_values(settings: Settings, values: Mapping[str, Any], origin: str) -> Settings:
    """Return the settings with known keys changed, dotted key → value as in the file.

    Raises ConfigurationError; its lines end with the origin.
    """
    reading = _Reading()
    reading.take_values(settings)
    for key, value in values.items():
        reading.take_value(key, value, Origin("other", origin))
    return reading.settings()


def to_toml(settings: Settings) -> str:
    """Format the settings as a TOML file with a comment on every key; `load_settings` reads it back."""
    paragraphs = [_table(section, getattr(settings, section)) for section in sections_of_file()]
    for camera, sections in settings.cameras.items():
        paragraphs += [
            _table(f"cameras.{camera}.{section}", getattr(sections, section))
            for section in SECTIONS_OF_CAMERA
        ]
    return "\n".join(paragraphs)


def _table(name: str, section: Section) -> str:
    lines = [f"# {(type(section).__doc__ or '').strip()}", f"[{name}]"]
    for key in type(section).fields_by_key():
        value = getattr(section, key)
        lines.append(f"# {help_line(type(section), key)}")
        # TOML has no null: an unset key is a comment; so is a field of view that a calibration replaces.
        unset = value is None or (key == "horizontal_fov_deg" and getattr(section, "lens", None) is not None)
        lines.append(f"# {key} =" if unset else f"{key} = {toml_value(value)}")
    return "\n".join(lines) + "\n"


class _Reading:
    """Collects values by key, each with its origin, and the problems found.

    A table is the name in brackets in the file: `detector`, or `cameras.down.detector`.
    """

    def __init__(self) -> None:
        self._fields = fields_of_sections()
        self._keys = [f"{section}.{name}" for section, names in self._fields.items() for name in names]
        self._values: dict[str, dict[str, Any]] = {}
        # Dotted key → what the layers gave, the last in effect.
        self._given: dict[str, list[Given]] = {}
        self._problems: list[str] = []
        # Table → former key of a lens → value and origin.
        self._lenses: dict[str, dict[str, Given]] = {}
        # Of the file that is being read: dotted key → line, and whether it has a former key.
        self._lines: dict[str, int] = {}
        self._is_former = False

    def take_file(self, path: Path) -> None:
        origin = Origin("file", str(path))
        try:
            content, self._lines = _read_toml(path)
        except ConfigurationError as error:
            self._problems += error.problems
            return
        self._is_former = "views" in content
        if self._is_former:
            self._problems.append(f"[views] ({origin}) was renamed to [cameras] in version {VERSION}")
            # Read as such, so that former keys in it are named at once too.
            self._lines |= {
                "cameras" + key.removeprefix("views"): line
                for key, line in self._lines.items()
                if key.startswith("views.")
            }
        for name, table in content.items():
            if name in ("cameras", "views") and isinstance(table, dict):
                for camera, sections in table.items():
                    self._take_camera(camera, sections, origin)
            elif name != "views":
                self._take_table(name, table, origin)
        if self._is_former:
            self._say_changed(origin)
        self._lines = {}

    def given(self) -> dict[str, tuple[Given, ...]]:
        return {key: tuple(values) for key, values in self._given.items()}

    def _say_changed(self, file: Origin) -> None:
        for key, given in self._given.items():
            value, origin = given[-1]
            table, _, name = key.rpartition(".")
            changed = CHANGED.get(f"{section_of(table)}.{name}")
            if changed is not None and origin[:2] == file[:2] and not changed.as_before(value):
                self._problems.append(
                    f"{key} = {shown(value)} ({origin}): since version {VERSION} {changed.now}; check it: "
                    "it is accepted once the former keys of the file are gone"
                )

    def take_values(self, settings: Settings) -> None:
        sections = {name: getattr(settings, name) for name in self._fields}
        for camera, own in settings.cameras.items():
            self._values[f"cameras.{camera}"] = {}
            sections |= {f"cameras.{camera}.{name}": getattr(own, name) for name in SECTIONS_OF_CAMERA}
        for table, section in sections.items():
            # What is not a key too: `camera.lens`.
            self._values[table] = {name: getattr(section, name) for name in section.model_fields_set}
            for name, value in self._values[table].items():
                self._given[f"{table}.{name}"] = [Given(value, Origin("other", "in effect"))]

    def take_environment(self, environment: Mapping[str, str]) -> None:
        for variable in sorted(environment):
            if not variable.startswith(ENVIRONMENT_PREFIX):
                continue
            words = variable.removeprefix(ENVIRONMENT_PREFIX).lower()
            # Other variables may have the prefix too; only those with a section name are settings.
            for section in self._fields:
                if words.startswith(f"{section}_"):
                    name = words.removeprefix(f"{section}_")
                    self.take_text(f"{section}.{name}", environment[variable], Origin("variable", variable))

    def take_value(self, key: str, value: Any, origin: Origin) -> None:
        table, _, name = key.rpartition(".")
        self._take(table, name, value, origin)

    def take_text(self, key: str, text: str, origin: Origin) -> None:
        table, _, name = key.rpartition(".")
        field = self._field(table, name)
        if field is None:
            self._take_unknown(table, name, text, origin)
            return
        try:
            value = value_from_text(field, text)
        except ValueError:
            self._problems.append(f"{key}: must be {expectation(field)}, got {text!r} ({origin})")
            return
        self._take(table, name, value, origin)

    def settings(self, read_uri: str | None = None) -> Settings:
        for table, lens in self._lenses.items():
            keys = ", ".join(f"{table}.{name}" for name in lens)
            origins = ", ".join(dict.fromkeys(str(origin) for _, origin in lens.values()))
            line = lens_line({name: value for name, (value, _) in lens.items()})
            removed = f"{'was' if len(lens) == 1 else 'were'} removed in version {VERSION}"
            self._problems.append(
                f"{keys} ({origins}) {removed}: write the line {line} to a file such as camera.yaml, and set "
                f'{table}.calibration_file = "camera.yaml"'
            )
        values: dict[str, Any] = {}
        for table, items in self._values.items():
            section = values
            for word in table.split("."):
                section = section.setdefault(word, {})
            section.update(items)
        try:
            settings = Settings.model_validate(values, context={"read_uri": read_uri})
        except ValidationError as error:
            problems = [*self._problems, *(self._explain(details) for details in error.errors())]
            # A list with several bad items is one problem.
            raise ConfigurationError(*dict.fromkeys(problems)) from None
        if self._problems:
            raise ConfigurationError(*self._problems)
        return settings

    def _field(self, table: str, name: str) -> FieldInfo | None:
        section = section_of(table)
        return None if section is None else self._fields[section].get(name)

    def _take_camera(self, name: str, sections: Any, origin: Origin) -> None:
        if not isinstance(sections, dict):
            self._problems.append(
                f"cameras.{name}: must hold sections such as [cameras.{name}.source], got {shown(sections)} "
                f"({origin})"
            )
            return
        # An empty table is a camera too: all defaults.
        self._values.setdefault(f"cameras.{name}", {})
        for section, content in sections.items():
            self._take_table(f"cameras.{name}.{section}", content, origin)

    def _take_table(self, table: str, content: Any, origin: Origin) -> None:
        if section_of(table) is None:
            known = SECTIONS_OF_CAMERA if table.startswith("cameras.") else self._fields
            self._problems.append(
                f"unknown section [{table}] ({origin}); {_nearest(table.rpartition('.')[2], known)}"
            )
        elif not isinstance(content, dict):
            self._problems.append(f"{table}: must be a section [{table}], got {shown(content)} ({origin})")
        else:
            for name, value in content.items():
                self._take(table, name, value, origin)

    def _take(self, table: str, name: str, value: Any, origin: Origin) -> None:
        key = f"{table}.{name}"
        if self._field(table, name) is None:
            self._take_unknown(table, name, value, origin)
            return
        # TOML has arrays; the settings are frozen and hold tuples.
        value = tuple(value) if isinstance(value, list) else value
        self._values.setdefault(table, {})[name] = value
        self._given.setdefault(key, []).append(Given(value, self._with_line(key, origin)))

    def _with_line(self, key: str, origin: Origin) -> Origin:
        return origin._replace(line=self._lines.get(key)) if origin.kind == "file" else origin

    def _take_unknown(self, table: str, name: str, value: Any, origin: Origin) -> None:
        section = section_of(table) or table
        own = f"{section}.{name}" if section else name
        self._is_former = self._is_former or own in RENAMED or own in REMOVED
        if section == "camera" and name in LENS:
            self._lenses.setdefault(table, {})[name] = Given(value, origin)
            return
        key = f"{table}.{name}" if table else name
        origin = self._with_line(key, origin)
        if now := RENAMED.get(own):
            now = f"{table}.{now.partition('.')[2]}"
            self._problems.append(f"{key} ({origin}) was renamed to {now} in version {VERSION}")
        elif removed := REMOVED.get(own):
            self._problems.append(f"{key} ({origin}) was removed in version {VERSION}: {removed.instead}")
        else:
            self._problems.append(f"unknown key {key} ({origin}); {_nearest(own, self._keys)}")

    def _explain(self, details: ErrorDetails) -> str:
        parts = [str(part) for part in details["loc"]]
        if parts[-1:] == ["[key]"]:  # a camera's name
            return f"cameras.{parts[1]}: a camera's name must be {expectation_of_key()}, got {parts[1]!r}"
        depth = 3 if parts[:1] == ["cameras"] else 1
        table, rest = ".".join(parts[:depth]), parts[depth:]
        if not rest:  # a rule about several keys of the section, or of several sections
            text = str(details["ctx"]["error"])
            return f"{table}: {text}{self._origins(text, table)}" if table else f"{text}{self._origins(text)}"
        key = f"{table}.{rest[0]}"
        if details["type"] == "value_error":  # a rule of the value's own
            return f"{key}: {details['ctx']['error']} ({self._origin(key)})"
        value = shown(self._values[table][rest[0]])
        section = section_of(table)
        assert section is not None
        expected = expectation(self._fields[section][rest[0]])
        return f"{key}: must be {expected}, got {value} ({self._origin(key)})"

    def _origin(self, key: str) -> Origin:
        return self._given[key][-1].origin

    def _origins(self, text: str, table: str = "") -> str:
        """Return in brackets where the keys were given that a message names; else all those of the table."""
        words = _WORDS.findall(text)
        keys = [*words, *(f"{table}.{word}" for word in words)]
        keys = [key for key in keys if key in self._given]
        keys = keys or [key for key in self._given if table and key.startswith(f"{table}.")]
        origins = sorted({str(self._origin(key)) for key in keys})
        return f" ({', '.join(origins)})" if origins else ""


def _read_toml(path: Path) -> tuple[dict[str, Any], dict[str, int]]:
    """Return the tables of a file, and the lines of its keys."""
    try:
        text = read_text(path)
        return parse_toml(text), key_lines(text)
    except OSError as error:
        may = f"; make it readable, or leave all files out: --config {os.devnull}"
        advice = may if isinstance(error, PermissionError) else ""
        raise ConfigurationError(f"cannot read the settings file {path}: {error.strerror}{advice}") from error
    except UnicodeDecodeError as error:
        raise ConfigurationError(explained(path, f"{path}: {error}")) from error
    except tomllib.TOMLDecodeError as error:
        reason, _, position = str(error).rpartition(" (at ")
        problem = f"{path}, {position.removesuffix(')')}: {reason}"
        raise ConfigurationError(explained(path, problem)) from error


def _nearest(word: str, known: Iterable[str]) -> str:
    """Return the known words nearest to an unknown one, as the end of a message."""
    known = list(known)
    section, _, name = word.partition(".")
    # A right name in the wrong section has priority over a wrong name.
    close = [key for key in known if name and key.partition(".")[2] == name]
    close = close or difflib.get_close_matches(word, known, n=1, cutoff=0.85)
    close = close or difflib.get_close_matches(word, known, n=3, cutoff=0.6)
    if close:
        return f"did you mean {' or '.join(close)}?"
    same_section = [key for key in known if key.startswith(f"{section}.")]
    return f"known: {', '.join(same_section or dict.fromkeys(key.partition('.')[0] for key in known))}"
