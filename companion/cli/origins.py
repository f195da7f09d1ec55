"""Which settings differ from their defaults, and which layer gave them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

from companion.settings.fields import fields_of_sections, section_of, toml_value
from companion.settings.layers import Given, LayeredSettings


class Differing(NamedTuple):
    """A key of which a layer gave another value than the default.

    Attributes:
        key: dotted. given: what the layers gave, the last one in effect.
    """

    key: str
    given: tuple[Given, ...]
    default: Any


def differing(layered: LayeredSettings) -> Iterator[Differing]:
    """Yield keys in the order of the file: those that differ, and those that a later layer set back."""
    fields = fields_of_sections()
    order = {f"{section}.{name}": None for section, names in fields.items() for name in names}
    cameras = [key for key in layered.given if key not in order]
    for key in (*order, *sorted(cameras)):
        table, _, name = key.rpartition(".")
        section = section_of(table)
        assert section is not None
        given, default = layered.given.get(key, ()), fields[section][name].default
        if any(value != default for value, _ in given):
            yield Differing(key, given, default)


def origins_toml(layered: LayeredSettings) -> str:
    """Format them as a settings file with the origin of each value as a comment."""
    lines = [f"# {path}" for path in layered.files.files] or ["# no file"]
    before = ""
    for key, given, _ in differing(layered):
        table, _, name = key.rpartition(".")
        if table != before:
            lines += ["", f"[{table}]"]
            before = table
        value, origin = given[-1]
        over = "".join(f"; overrides {_shown(value)} {where}" for value, where in given[-2::-1])
        line = f"# {name} unset" if value is None else f"{name} = {toml_value(value)}"
        lines.append(f"{line}  # {origin}{over}")
    return "\n".join(lines) + "\n"


def _shown(value: Any) -> str:
    return "unset" if value is None else toml_value(value)
