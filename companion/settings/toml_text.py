"""Reads TOML texts of others: bounded in time, and each error is a TOMLDecodeError."""

from __future__ import annotations

import re
import tomllib
from typing import Any

MAX_KEY_PARTS = 32
"""Of a dotted key. The time that `tomllib` takes grows with the square of their number and worse: a key of
50,000 parts, 100 kB, took 200 s."""
# Each alternative also matches a string without an end, so that no text is scanned twice.
_STRING_OR_COMMENT = re.compile(
    r'"""(?:[^"\\]|\\.|"(?!""))*+(?:""")?'
    r"|'''(?:[^']|'(?!''))*+(?:''')?"
    r'|"(?:[^"\\\n]|\\.)*+"?'
    r"|'[^'\n]*+'?"
    r"|#[^\n]*+",
    re.DOTALL,
)
_PART = re.compile(r"[\w-]+")
_TABLE = re.compile(r"\[\s*([\w.-]+)\s*\]\s*")
_KEY = re.compile(r"([\w.-]+)\s*=")


def parse_toml(text: str) -> dict[str, Any]:
    """Return the tables of a TOML text.

    Raises:
        tomllib.TOMLDecodeError: not TOML, nested too deeply, or with a number or a key that is too long.
    """
    parts = 0
    for piece in _STRING_OR_COMMENT.sub(lambda found: "" if found[0][0] == "#" else "_", text).split("."):
        parts = parts + 1 if _PART.fullmatch(piece.strip(" \t")) else 0
        if parts > MAX_KEY_PARTS:
            raise tomllib.TOMLDecodeError(f"a key has more than {MAX_KEY_PARTS} parts (at end of document)")
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise tomllib.TOMLDecodeError("nested too deeply (at end of document)") from None
    except tomllib.TOMLDecodeError:
        raise
    except ValueError as error:  # an integer of too many digits, a date out of range
        raise tomllib.TOMLDecodeError(f"{str(error).partition(';')[0]} (at end of document)") from error


def key_lines(text: str) -> dict[str, int]:
    """Return dotted key → line of a valid TOML text; without quoted keys and those of inline tables."""
    lines = {}
    table: str | None = ""
    depth = 0  # of an array over several lines
    plain = _STRING_OR_COMMENT.sub(lambda found: "_" + "\n" * found[0].count("\n"), text)
    for number, line in enumerate(plain.split("\n"), 1):
        line = line.strip().removesuffix("_") if line.lstrip().startswith("[") else line.strip()
        if depth == 0 and line.startswith("["):
            found = _TABLE.fullmatch(line)
            table = None if found is None else f"{found[1]}."
            continue
        if depth == 0 and table is not None and (key := _KEY.match(line)):
            lines[f"{table}{key[1]}"] = number
        depth += line.count("[") - line.count("]")
    return lines
