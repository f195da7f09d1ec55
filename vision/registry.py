"""Name → factory: one table of what can be chosen by name, for what is built in and for plug-ins alike."""

from __future__ import annotations

import re
from typing import Any, Generic, TypeVar

_Factory = TypeVar("_Factory")


class Registry(Generic[_Factory]):
    """Factories by name, in the order of registration.

    Args:
        noun: what a name stands for, for messages: "source scheme".
        pattern: regular expression that a whole name must match.
        form: the same in words.
    """

    def __init__(self, noun: str, pattern: str, form: str) -> None:
        self._noun, self._pattern, self._form = noun, re.compile(pattern), form
        self._entries: dict[str, tuple[str, _Factory]] = {}

    def add(self, name: str, help_text: str, factory: _Factory) -> None:
        """Register a factory. The same one again, of a module that is read twice, replaces itself.

        Args:
            help_text: what it is, one line without a full stop.

        Raises:
            ValueError: the name has another form, or another factory has it; the message names both modules.
        """
        if self._pattern.fullmatch(name) is None:
            raise ValueError(f"{_name_of(factory)}: a {self._noun} is {self._form}, got {name!r}")
        other = self.get(name)
        if other is not None and _name_of(other) != _name_of(factory):
            raise ValueError(
                f"{_name_of(factory)}: there is a {self._noun} {name!r} already, {_name_of(other)}; "
                "choose another name"
            )
        self._entries[name] = (help_text, factory)

    def get(self, name: str) -> _Factory | None:
        """The factory of a name; None where there is none."""
        return self._entries[name][1] if name in self._entries else None

    def remove(self, name: str) -> None:
        """Forget a name. Raises KeyError where there is none."""
        del self._entries[name]

    def known(self) -> str:
        """Every name with its help, for a message."""
        return ", ".join(f"{name} ({help_text})" for name, (help_text, _) in self._entries.items())


def _name_of(factory: Any) -> str:
    return f"{factory.__module__}.{factory.__qualname__}"
