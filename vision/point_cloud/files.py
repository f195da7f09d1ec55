"""Point clouds as PLY (Turk 1994, format 1.0) and PCD (PCL, version 0.7), as text and binary little-endian.

Frame and stamp are comments, which other programs ignore. Without them a cloud is of the frame `camera`.
"""

from __future__ import annotations

import io
import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from vision.point_cloud.cloud import FRAMES, PointCloud

SUFFIXES = (".ply", ".pcd")
_HEADER_BYTES = 1 << 16
_MAX_POINTS = 1 << 28
_PLY_TYPES = {
    **dict.fromkeys(("char", "int8"), "<i1"),
    **dict.fromkeys(("uchar", "uint8"), "<u1"),
    **dict.fromkeys(("short", "int16"), "<i2"),
    **dict.fromkeys(("ushort", "uint16"), "<u2"),
    **dict.fromkeys(("int", "int32"), "<i4"),
    **dict.fromkeys(("uint", "uint32"), "<u4"),
    **dict.fromkeys(("float", "float32"), "<f4"),
    **dict.fromkeys(("double", "float64"), "<f8"),
}
_PCD_TYPES = {"<i1", "<i2", "<i4", "<i8", "<u1", "<u2", "<u4", "<u8", "<f4", "<f8"}
_COLOURS = ("red", "green", "blue")
_XYZ = ("x", "y", "z")


class CloudFileError(ValueError):
    """A file that is not a point cloud this module reads; the message is one line with the path."""


def write_cloud(path: Path, cloud: PointCloud, *, binary: bool = True) -> None:
    """Write a cloud as `.ply` or `.pcd`.

    Raises:
        CloudFileError: another suffix. OSError: the file cannot be written.
    """
    _check_suffix(path)
    header, values = _ply(cloud, binary) if path.suffix == ".ply" else _pcd(cloud, binary)
    if binary:
        body = values.tobytes()
    else:
        text = io.StringIO()
        # Nine digits give the same float32 when read.
        formats = ["%.9g" if values.dtype[name].kind == "f" else "%d" for name in values.dtype.names or ()]
        np.savetxt(text, values, fmt=" ".join(formats))
        body = text.getvalue().encode()
    path.write_bytes(header.encode() + body)


def read_cloud(path: Path) -> PointCloud:
    """Read a `.ply` or `.pcd` file: x, y, z and, if there, its colours; points with NaN are left out.

    Raises:
        CloudFileError: another suffix, not such a file, truncated, or big-endian or compressed data.
        OSError: the file cannot be read.
    """
    _check_suffix(path)
    data = path.read_bytes()
    try:
        return _read_ply(data) if path.suffix == ".ply" else _read_pcd(data)
    except (ValueError, KeyError, IndexError, UnicodeDecodeError) as error:
        raise CloudFileError(f"{path}: {' '.join(str(error).split())}") from error


def _check_suffix(path: Path) -> None:
    if path.suffix not in SUFFIXES:
        raise CloudFileError(f"{path}: expected a name that ends in {' or '.join(SUFFIXES)}")


def _comments(cloud: PointCloud) -> list[str]:
    return [f"frame {cloud.frame}", f"stamp_ns {cloud.stamp_ns}"]


def _ply(cloud: PointCloud, binary: bool) -> tuple[str, NDArray[Any]]:
    fields = [(name, "<f4") for name in _XYZ]
    if cloud.colours is not None:
        fields += [(name, "u1") for name in _COLOURS]
    values = np.empty(len(cloud), fields)
    for axis, name in enumerate(_XYZ):
        values[name] = cloud.points[:, axis]
    if cloud.colours is not None:
        for channel, name in enumerate(_COLOURS):
            values[name] = cloud.colours[:, channel]
    lines = [
        "ply",
        f"format {'binary_little_endian' if binary else 'ascii'} 1.0",
        *(f"comment {text}" for text in _comments(cloud)),
        f"element vertex {len(cloud)}",
        *(f"property {'float' if kind == '<f4' else 'uchar'} {name}" for name, kind in fields),
        "end_header\n",
    ]
    return "\n".join(lines), values


def _pcd(cloud: PointCloud, binary: bool) -> tuple[str, NDArray[Any]]:
    fields = [(name, "<f4") for name in _XYZ]
    types = ["F", "F", "F"]
    if cloud.colours is not None:
        # 0x00RRGGBB. PCL calls its bits a float in binary files and writes the whole number in text.
        fields.append(("rgb", "<u4"))
        types.append("F" if binary else "U")
    values = np.empty(len(cloud), fields)
    for axis, name in enumerate(_XYZ):
        values[name] = cloud.points[:, axis]
    if cloud.colours is not None:
        red, green, blue = cloud.colours.astype(np.uint32).T
        values["rgb"] = red << 16 | green << 8 | blue
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format",
        *(f"# {text}" for text in _comments(cloud)),
        "VERSION 0.7",
        f"FIELDS {' '.join(name for name, _ in fields)}",
        f"SIZE {' '.join('4' for _ in fields)}",
        f"TYPE {' '.join(types)}",
        f"COUNT {' '.join('1' for _ in fields)}",
        f"WIDTH {len(cloud)}",
        "HEIGHT 1",
        "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(cloud)}",
        f"DATA {'binary' if binary else 'ascii'}\n",
    ]
    return "\n".join(lines), values


def _read_ply(data: bytes) -> PointCloud:
    end = re.search(rb"(?m)^end_header\r?\n", data[:_HEADER_BYTES])
    if not data.startswith(b"ply") or end is None:
        raise ValueError("not a PLY file: expected `ply` and `end_header`")
    lines = [line.split() for line in data[: end.start()].decode().splitlines() if line.strip()]
    format_name = next((line[1] for line in lines if line[0] == "format"), "(none)")
    if format_name not in ("ascii", "binary_little_endian"):
        raise ValueError(f"format {format_name}, expected ascii or binary_little_endian")
    elements = [index for index, line in enumerate(lines) if line[0] == "element"]
    if not elements or lines[elements[0]][1] != "vertex":
        raise ValueError("the first element must be `vertex`")
    count = int(lines[elements[0]][2])
    last = elements[1] if len(elements) > 1 else len(lines)
    fields = []
    for line in lines[elements[0] + 1 : last]:
        if line[0] == "property":
            if line[1] == "list":
                raise ValueError("a vertex with a list is not supported")
            fields.append((line[2], _PLY_TYPES[line[1]]))
    values = _values(data[end.end() :], np.dtype(fields), count, format_name == "ascii")
    colours = None
    if set(_COLOURS) <= set(values.dtype.names or ()):
        colours = np.column_stack([values[name] for name in _COLOURS]).astype(np.uint8)
    return _cloud(values, colours, [line[1:] for line in lines if line[0] == "comment"])


def _read_pcd(data: bytes) -> PointCloud:
    end = re.search(rb"(?m)^DATA (\w+)\r?\n", data[:_HEADER_BYTES])
    if end is None:
        raise ValueError("not a PCD file: expected a line `DATA`")
    lines = [line.split() for line in data[: end.start()].decode().splitlines() if line.strip()]
    header = {line[0]: line[1:] for line in lines if line[0] != "#"}
    kind = end[1].decode()
    if kind not in ("ascii", "binary"):
        raise ValueError(f"DATA {kind}, expected ascii or binary")
    fields: list[tuple[str, str] | tuple[str, str, tuple[int, ...]]] = []
    counts = header.get("COUNT", ["1"] * len(header["FIELDS"]))
    for index, (name, letter, size, many) in enumerate(
        zip(header["FIELDS"], header["TYPE"], header["SIZE"], counts, strict=True)
    ):
        code = f"<{letter.lower()}{size}"
        if code not in _PCD_TYPES:
            raise ValueError(
                f"field {name!r} has TYPE {letter!r} and SIZE {size!r}, expected I, U or F and its bytes"
            )
        if name in ("rgb", "rgba") and (size, kind) == ("4", "binary"):
            code = "<u4"  # a float's bits
        unique = name if name != "_" else f"_{index}"  # padding
        fields.append((unique, code) if many == "1" else (unique, code, (int(many),)))
    values = _values(data[end.end() :], np.dtype(fields), int(header["POINTS"][0]), kind == "ascii")
    colours = None
    packed = next((values[name] for name in ("rgb", "rgba") if name in (values.dtype.names or ())), None)
    if packed is not None:
        bits = packed.view("<u4") if packed.dtype == "<f4" else packed.astype(np.uint32)
        colours = np.column_stack([bits >> 16 & 255, bits >> 8 & 255, bits & 255]).astype(np.uint8)
    return _cloud(values, colours, [line[1:] for line in lines if line[0] == "#"])


def _values(body: bytes, kind: np.dtype[Any], count: int, text: bool) -> NDArray[Any]:
    """(count,) values of a file's body."""
    if not 0 <= count <= _MAX_POINTS:
        raise ValueError(f"has {count} points, the limit is {_MAX_POINTS}")
    if text:
        if not count:
            return np.empty(0, kind)
        values = np.loadtxt(io.StringIO(body.decode()), kind, max_rows=count, ndmin=1)
    else:
        values = np.frombuffer(body, kind, min(count, len(body) // kind.itemsize))
    if len(values) < count:
        raise ValueError(f"ends after {len(values)} of {count} points")
    return values


def _cloud(values: NDArray[Any], colours: NDArray[np.uint8] | None, comments: list[list[str]]) -> PointCloud:
    points = np.column_stack([values[name] for name in _XYZ]).astype(np.float32)
    notes = {words[0]: words[1] for words in comments if len(words) == 2}
    frame = next((name for name in FRAMES if name == notes.get("frame")), FRAMES[0])
    stamp_ns = int(notes["stamp_ns"]) if notes.get("stamp_ns", "").isdigit() else 0
    finite = np.isfinite(points).all(axis=1)
    if not finite.all():
        points = points[finite]
        colours = None if colours is None else colours[finite]
    return PointCloud(points, colours, frame, stamp_ns)
