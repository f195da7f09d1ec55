"""TOML files of marker boards and of a map of markers."""

from __future__ import annotations

import math
import tomllib
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from companion.settings.toml_text import parse_toml
from vision.file_kinds import explained
from vision.marker_boards import MAP, Board, ned_from_marker
from vision.markers import square
from vision.rotation import matrix_from_euler
from vision.text_file import read_text

_Number = Annotated[float, Field(strict=False, ge=-10_000, le=10_000)]
_Vector = Annotated[list[_Number], Field(min_length=3, max_length=3)]
_Size = Annotated[float, Field(strict=False, ge=0.01, le=50)]
_Identifier = Annotated[int, Field(ge=0, le=2319)]  # the largest dictionary's, APRILTAG_36h10
Print = Literal["opencv", "apriltag"]
"""Whose print a marker is: `vision.markers.PRINTS`."""


class BoardError(ValueError):
    """A file of boards or a map cannot be used. The message is one line that names the file and the key."""


class _Table(BaseModel):
    model_config = ConfigDict(extra="forbid", strict=True, allow_inf_nan=False)


_Kind = TypeVar("_Kind", bound=_Table)


class _BoardMarker(_Table):
    id: _Identifier
    size_m: _Size
    position_m: _Vector
    rotation_deg: _Vector = [0.0, 0.0, 0.0]


class _Board(_Table):
    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$", max_length=64)]
    print: Print | None = None
    markers: Annotated[list[_BoardMarker], Field(min_length=1, max_length=1024)]


class _Boards(_Table):
    boards: Annotated[list[_Board], Field(min_length=1, max_length=64)]


class _Origin(_Table):
    latitude_deg: Annotated[float, Field(strict=False, ge=-90, le=90)]
    longitude_deg: Annotated[float, Field(strict=False, ge=-180, le=180)]
    altitude_m: _Number


class _MapMarker(_Table):
    id: _Identifier
    size_m: _Size
    position_m: _Vector
    yaw_deg: _Number
    standing: bool = False


class _Map(_Table):
    origin: _Origin | None = None
    print: Print | None = None
    markers: Annotated[list[_MapMarker], Field(min_length=1, max_length=1024)]


def read_boards(path: str | Path) -> tuple[Board, ...]:
    """Read boards from a TOML file. Raises BoardError."""
    file = _read(path, _Boards)
    boards = tuple(
        _board(
            str(path),
            board.name,
            [
                (
                    marker.id,
                    marker.size_m,
                    marker.position_m,
                    matrix_from_euler(*map(math.radians, marker.rotation_deg)),
                )
                for marker in board.markers
            ],
            printed=board.print,
        )
        for board in file.boards
    )
    names = [board.name for board in boards]
    for index, name in enumerate(names):
        if name == MAP or name in names[:index]:
            raise BoardError(f"{path}: boards[{index}].name: {name!r} is already the name of another board")
    return boards


def read_map(path: str | Path) -> Board:
    """Read a map from a TOML file. Raises BoardError."""
    file = _read(path, _Map)
    rows = [
        (
            marker.id,
            marker.size_m,
            marker.position_m,
            ned_from_marker(math.radians(marker.yaw_deg), marker.standing),
        )
        for marker in file.markers
    ]
    origin = file.origin
    place = None if origin is None else (origin.latitude_deg, origin.longitude_deg, origin.altitude_m)
    return _board(str(path), MAP, rows, place, file.print)


def _board(
    path: str,
    name: str,
    markers: Sequence[tuple[int, float, Sequence[float], NDArray[np.float64]]],
    origin: tuple[float, float, float] | None = None,
    printed: str | None = None,
) -> Board:
    corners: dict[int, NDArray[np.float64]] = {}
    for identifier, size_m, position_m, rotation in markers:
        if identifier in corners:
            raise BoardError(f"{path}: marker {identifier} is given twice in {name!r}")
        corners[identifier] = square(size_m) @ rotation.T + np.array(position_m)
    return Board(name, corners, {identifier: size_m for identifier, size_m, _, _ in markers}, origin, printed)


def _read(path: str | Path, kind: type[_Kind]) -> _Kind:
    try:
        content: dict[str, Any] = parse_toml(read_text(Path(path)))
    except OSError as error:
        raise BoardError(f"{path}: {error.strerror or error}") from error
    except UnicodeDecodeError as error:
        raise BoardError(explained(Path(path), f"{path}: {error}")) from error
    except tomllib.TOMLDecodeError as error:
        raise BoardError(explained(Path(path), f"{path}: not TOML: {error}")) from error
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        first = error.errors()[0]
        key = "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in first["loc"])
        got = "" if first["type"] == "missing" else f", got {first['input']!r}"
        raise BoardError(
            f"{path}: {key.lstrip('.')}: {first['msg'][0].lower()}{first['msg'][1:]}{got}"
        ) from error
