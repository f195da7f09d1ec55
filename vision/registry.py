"""Name → factory: the table of what can be chosen by name, built-in or from plug-ins."""

from __future__ import annotations

import re
from typing import Any, Generic, TypeVar

_Factory = TypeVar("_Factory")


class RegistrationError(ValueError):
    """A plug-in registers something invalid. The message is one line that names it."""


class Registry(Generic[_Factory]):
    """Factories by name, in the order of registration.

    Args:
        noun: what a name identifies, for messages: "source scheme".
        pattern: regular expression that a whole name must match.
        form: the pattern in words.
    """

    def __init__(self, noun: str, pattern: str, form: str) -> None:
        self._noun, self._pattern, self._form = noun, re.compile(pattern), form
        self._entries: dict[str, tuple[str, _Factory]] = {}

    def add(self, name: str, help_text: str, factory: _Factory) -> None:
        """Register a factory. Registering the same factory again (a module imported twice) replaces it.

        Args:
            help_text: description, one line without a full stop.

        Raises:
            RegistrationError: the name does not match the pattern, or is registered by another factory; the
                message names both modules.
        """
        if self._pattern.fullmatch(name) is None:
            raise RegistrationError(f"{_name_of(factory)}: a {self._noun} must be {self._form}, got {name!r}")
        other = self.get(name)
        if other is not None and _name_of(other) != _name_of(factory):
            raise RegistrationError(
                f"{_name_of(factory)}: {self._noun} {name!r} is already registered by {_name_of(other)}; "
                "choose another name"
            )
        self._entries[name] = (help_text, factory)

    def get(self, name: str) -> _Factory | None:
        """The factory registered under `name`, or None."""
        return self._entries[name][1] if name in self._entries else None

    def remove(self, name: str) -> None:
        """Remove a name. Raises KeyError if it is not registered."""
        del self._entries[name]

    def known(self) -> str:
        """Every name with its help text, for messages."""
        return ", ".join(f"{name} ({help_text})" for name, (help_text, _) in self._entries.items())


def shown(value: object) -> str:
    """What a plug-in returned instead of what it should, in one line."""
    return f"{type(value).__name__} {' '.join(repr(value).split()):.60}"


def _name_of(factory: Any) -> str:
    return f"{factory.__module__}.{factory.__qualname__}"
