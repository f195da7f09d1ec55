"""The settings file that `companion init` writes, and what is in effect with it and without."""

from __future__ import annotations

import os
import stat
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from companion.settings import Settings
from companion.settings.layers import SettingsFiles, settings_files, system_file, user_file
from companion.settings.reading import ConfigurationError, load_layers, load_settings
from companion.settings.toml_text import parse_toml
from companion.setup.settings_file import Change, value_in
from vision.text_file import read_text


@dataclass(frozen=True, slots=True)
class Target:
    """A settings file, there or not.

    Attributes:
        text: its content; empty: there is no file. tables: the same, parsed.
        settings: in effect with it. below: in effect without it.
    """

    path: Path
    text: str
    tables: Mapping[str, Any]
    settings: Settings
    below: Settings

    def has(self, key: str) -> bool:
        """Whether the file sets a dotted key."""
        return value_in(self.tables, key) is not None

    def changes(self, key: str, value: Any, reason: str) -> list[Change]:
        """Return the change that puts a value into effect, none where it is in effect already.

        A value that is not the package's default is written even if another file has it: the file may be
        copied to where that one is not.
        """
        if self.has(key):
            needed = bool(value_in(self.tables, key) != value)
        else:
            needed = value != _value(Settings(), key) or value != _value(self.below, key)
        return [Change(key, value, reason)] if needed else []


def default_target() -> Path:
    """Return the file of the user; of the system for root."""
    return system_file() if os.geteuid() == 0 else user_file()


def read_target(path: Path) -> Target:
    """Read a settings file that may be missing.

    Raises:
        ConfigurationError: it has mistakes, or cannot be read.
    """
    is_there = _is_file(path)
    files: tuple[Path, ...] = ()
    if path.resolve() == user_file().resolve():
        files = tuple(each for each in settings_files().files if each.resolve() != path.resolve())
    below = load_layers(SettingsFiles(files), environment={}).settings
    if not is_there:
        return Target(path, "", {}, below, below)
    settings = load_layers(SettingsFiles((*files, path)), environment={}).settings
    text = read_text(path)
    return Target(path, text, parse_toml(text), settings, below)


def _is_file(path: Path) -> bool:
    """Whether there is a file. Raises ConfigurationError: something else, which must not be replaced."""
    try:
        kind = stat.S_IFMT(path.stat().st_mode)
    except FileNotFoundError:
        return False
    except OSError as error:
        raise ConfigurationError(f"cannot read the settings file {path}: {error.strerror}") from error
    if kind != stat.S_IFREG:
        raise ConfigurationError(f"{path} is no file that can hold settings; give another --output")
    return True


def check_text(path: Path, text: str) -> None:
    """Check that a file with this text would be read. Raises ConfigurationError.

    It is written to a folder of its own beside no other file: relative names in it are of the working folder.
    """
    with TemporaryDirectory() as folder:
        trial = Path(folder) / path.name
        trial.write_text(text, encoding="utf-8")
        load_settings(trial, environment={})


def _value(settings: Settings, key: str) -> Any:
    section, _, name = key.partition(".")
    return getattr(getattr(settings, section), name)
