"""Write the client's commands from the command table: `python -m tools.client_commands`."""

from __future__ import annotations

import subprocess
import sys
import textwrap
from pathlib import Path

import companion.guidance  # noqa: F401 - registers the commands
from companion.guidance.behaviours.select import Select
from companion.guidance.command import (
    COMMANDS,
    Argument,
    Command,
    EnumArgument,
    MarkerId,
    Number,
    TrackId,
    arguments_of,
    default_of,
)
from companion.guidance.grammar import allowed_values

FILE = Path(__file__).parent.parent / "companion" / "client" / "commands.py"
HEAD = '''"""The flight commands as methods. Written by `python -m tools.client_commands`; do not edit."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Literal

Reply = dict[str, Any]
"""`id`, `command`, `state`, `success`, `reason`; of a mission also `steps`, of select `track` and `class`."""

NON_FLIGHT = frozenset({NON_FLIGHT})
"""Commands that leave the vehicle's flight as it is, or that end it."""


class Commands(ABC):
    """The commands of docs/flight.md. An argument that is None has the service's default."""

    @abstractmethod
    async def command(self, text: str) -> Reply:
        """Send a command as text."""

    async def _run(self, word: str, **arguments: float | str | None) -> Reply:
        given = {key: value for key, value in arguments.items() if value is not None}
        written = (f"{key.removesuffix('_')}={_written(value)}" for key, value in given.items())
        return await self.command(" ".join([word, *written]))
'''
TAIL = """

def _written(value: float | str) -> str:
    if not isinstance(value, str):
        return repr(value)
    return '"' + value.replace("\\\\", "\\\\\\\\").replace('"', '\\\\"') + '"'
"""


def source() -> str:
    """Return the file's text."""
    no_flight = [kind.word for kind in COMMANDS.values() if kind is Select or kind.aim is not Command.aim]
    words = ", ".join(f'"{word}"' for word in [*no_flight, "stop"])
    head = HEAD.replace("{NON_FLIGHT}", f"{{{words}}}")
    text = head + "".join(map(_method, COMMANDS.values())) + TAIL
    command = [sys.executable, "-m", "ruff", "format", "--stdin-filename", str(FILE), "-"]
    done = subprocess.run(command, input=text, capture_output=True, text=True, check=True)
    return done.stdout


def _method(kind: type[Command]) -> str:
    parameters, passed, described = ["self"], [f'"{kind.word}"'], []
    for field, argument in arguments_of(kind):
        name = f"{argument.key}_" if argument.key == "class" else argument.key
        default = default_of(field)
        required = default is None and field.default is not None
        parameters.append(f"{name}: {_type(argument)}" + ("" if required else " | None = None"))
        passed.append(f"{name}={name}")
        facts = [allowed_values(argument)] if isinstance(argument, Number) else []
        if default not in (None, ""):
            facts.append(f"default {default:g}" if isinstance(default, float) else f"default {default}")
        text = f"{name}: {argument.meaning}" + (f" ({'; '.join(facts)})" if facts else "")
        described += textwrap.wrap(text, 110, initial_indent=" " * 12, subsequent_indent=" " * 16)
    lines = [f"    async def {kind.word.replace('-', '_')}({', '.join(parameters)}) -> Reply:"]
    summary = f'"""{kind.help[0].upper()}{kind.help[1:]}.'
    summary = textwrap.fill(summary, 110, initial_indent=" " * 8, subsequent_indent=" " * 8)
    if described:
        lines += [summary, "", "        Args:", *described]
        lines += ['        """']
    else:
        lines += [f'{summary}"""']
    return "\n" + "\n".join([*lines, f"        return await self._run({', '.join(passed)})"]) + "\n"


def _type(argument: Argument) -> str:
    match argument:
        case Number():
            return "float"
        case TrackId() | MarkerId():
            return "int"
        case EnumArgument(_, words):
            return f"Literal[{', '.join(repr(word) for word in words)}]".replace("'", '"')
    return "str"


if __name__ == "__main__":
    FILE.write_text(source())
