"""PX4's own log beside a recording: its topics in a copy of the recording, in the recording's time.

ULog (https://docs.px4.io/main/en/dev_log/ulog_file_format) has stamps of the autopilot's boot clock.
"""

from __future__ import annotations

import contextlib
import heapq
import io
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pyulog import ULog

from companion.bus.schema import DIALECT
from companion.recording import RecordingError
from companion.recording.boot_clock import LOGGED, Alignment, align, read_boots
from companion.recording.convert import LOG_CHANNEL, ULOG_NAME, foxglove_message, log_body
from companion.recording.files import Channel, Recorded, RecordingReader, write_messages
from vision.file_kinds import open_file

_BLOCK = 1000  # messages converted at once
_LATEST_US = 10**15  # 31 years; a later stamp is damage
# foxglove.LogLevel of the digits EMERG to DEBUG.
_LEVELS = dict(zip(b"01234567", (5, 5, 5, 4, 3, 2, 2, 1), strict=True))
_PART = re.compile(r"\[(\d+)\]|([^.\[\]]+)")
_FLOATS = ("float", "double")


@dataclass(frozen=True, slots=True)
class Merged:
    """The result.

    Attributes:
        messages: in the new file. topics: of the ULog, in it.
        problems: damage of either file, a line each.
    """

    messages: int
    topics: int
    alignment: Alignment
    problems: list[str]


def merge_ulog(path: Path, ulog_path: Path, output: Path) -> Merged:
    """Write a copy of a recording with the topics and logged messages of a ULog of the same flight.

    Raises:
        RecordingError: a file cannot be read or written, the output exists, or the ULog is of another flight.
    """
    reader = RecordingReader(path)
    ulog = _read(ulog_path)
    topics = {_topic(data): data for data in ulog.data_list if "timestamp" in data.data}
    end_us = max((int(_valid_stamps(data).max(initial=0)) for data in topics.values()), default=0)
    if not ulog.start_timestamp <= end_us:
        raise RecordingError(f"{ulog_path}: has no messages")
    try:
        found = align(read_boots(reader), ulog.start_timestamp * 1000, end_us * 1000, _logged_samples(ulog))
    except RecordingError as error:
        raise RecordingError(f"{ulog_path}: {error}") from error
    messages = heapq.merge(
        reader.messages(),
        _log_messages(ulog, found),
        *(_messages(topic, data, found) for topic, data in topics.items()),
        key=lambda message: message.log_time_ns,
    )
    metadata = {**reader.metadata, f"{ULOG_NAME}/{ulog_path.name}": _metadata(found)}
    count = write_messages(output, messages, metadata)
    problems = list(reader.problems)
    if ulog.file_corruption:
        problems.append(f"{ulog_path}: damaged; what could be read was added")
    if ulog.dropouts:
        lost_ms = sum(dropout.duration for dropout in ulog.dropouts)
        problems.append(f"{ulog_path}: {len(ulog.dropouts)} gaps, {lost_ms} ms together")
    return Merged(count, len(topics), found, problems)


def _read(path: Path) -> ULog:
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # it prints what `file_corruption` says
            open_file(path).close()  # it would wait for the writer of a pipe
            return ULog(str(path))
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror}") from error
    except Exception as error:  # of pyulog, struct and numpy: no common base
        raise RecordingError(f"{path}: not a ULog: {error}") from error


def _topic(data: ULog.Data) -> str:
    return f"{ULOG_NAME}/{data.name}" + (f"_{data.multi_id}" if data.multi_id else "")


def _valid_stamps(data: ULog.Data) -> NDArray[np.uint64]:
    stamps: NDArray[np.uint64] = data.data["timestamp"]
    return stamps[stamps < _LATEST_US]


def _logged_samples(ulog: ULog) -> dict[int, set[bytes]]:
    """Return the samples that are sent as MAVLink too, as their first bytes there."""
    found: dict[int, set[bytes]] = {}
    for message, (name, fields) in LOGGED.items():
        found[message] = set()
        for data in ulog.data_list:
            if data.name != name or not {"timestamp", *fields} <= data.data.keys():
                continue
            rows = np.empty(len(data.data["timestamp"]), [("ms", "<u4"), ("values", "<f4", len(fields))])
            rows["ms"] = (data.data["timestamp"] // 1000).astype(np.uint32)
            rows["values"] = np.column_stack([data.data[field] for field in fields])
            text = rows.tobytes()
            size = rows.dtype.itemsize
            found[message] |= {text[at : at + size] for at in range(0, len(text), size)}
    return found


def _metadata(found: Alignment) -> dict[str, str]:
    return {
        "boot_begin_ns": str(found.begin_ns),
        "boot_end_ns": str(found.end_ns),
        "offset_ns": str(found.offset_ns),
        "drift_ppm": f"{found.drift * 1e6:.3f}",
        "error_ns": str(found.error_ns),
        "equal_samples": str(found.equal),
        "least_delay_ns": str(found.least_delay_ns),
        "median_delay_ns": str(found.median_delay_ns),
    }


def _unix_ns(stamps_us: NDArray[Any], found: Alignment) -> list[int]:
    """Return log times. What PX4 wrote when the log began, such as parameters, has older stamps."""
    boot_ns = np.maximum(stamps_us.astype(np.int64) * 1000, found.begin_ns)
    return list(found.clock.to_unix(boot_ns).tolist())


def _log_messages(ulog: ULog, found: Alignment) -> Iterator[Recorded]:
    tagged = [message for group in ulog.logged_messages_tagged.values() for message in group]
    logged = sorted((*ulog.logged_messages, *tagged), key=lambda message: message.timestamp)
    logged = [message for message in logged if message.timestamp < _LATEST_US]
    stamps_us = np.array([message.timestamp for message in logged], np.uint64)
    for message, unix_ns in zip(logged, _unix_ns(stamps_us, found), strict=True):
        level = _LEVELS.get(message.log_level, 0)
        yield foxglove_message(
            LOG_CHANNEL, "Log", unix_ns, log_body(unix_ns, level, message.message, ULOG_NAME)
        )


def _messages(topic: str, data: ULog.Data, found: Alignment) -> Iterator[Recorded]:
    """Return the messages of one topic as JSON."""
    tree: dict[Any, Any] = {}
    for field in data.field_data:
        parts = [int(index) if index else name for index, name in _PART.findall(field.field_name)]
        if not any(str(part).startswith("_padding") for part in parts):
            node = tree
            for part in parts[:-1]:
                node = node.setdefault(part, {})
            node[parts[-1]] = (field.field_name, field.type_str)
    columns: list[list[tuple[str, str]]] = []
    template, schema = _json_of(tree, columns)
    text = json.dumps({"$schema": DIALECT, "type": "object", "allOf": [schema]}).encode()
    channel = Channel(topic, topic.replace("/", "."), text)
    valid = np.flatnonzero(data.data["timestamp"] < _LATEST_US)
    for begin in range(0, len(valid), _BLOCK):
        rows = valid[begin : begin + _BLOCK]
        unix_ns = _unix_ns(data.data["timestamp"][rows], found)
        values = [_texts([data.data[name][rows] for name, _ in fields], fields[0][1]) for fields in columns]
        for log_time_ns, *row in zip(unix_ns, *values, strict=True):
            yield Recorded(channel, log_time_ns, (template % tuple(row)).encode())


def _json_of(node: Any, columns: list[list[tuple[str, str]]]) -> tuple[str, dict[str, Any]]:
    """Return a template with %s for each value, and the JSON Schema, as in `convert.stored_schema`.

    Args:
        columns: gets the fields (name, type) of each %s; several are the characters of one text.
    """
    if isinstance(node, tuple):
        columns.append([node])
        return "%s", _schema_of(node[1])
    if 0 in node:
        items = list(node.values())
        if all(isinstance(item, tuple) and item[1] == "char" for item in items):
            columns.append(items)
            return "%s", {"type": "string"}
        texts, schemas = zip(*(_json_of(item, columns) for item in items), strict=True)
        schema = {"type": "array", "items": schemas[0], "minItems": len(items), "maxItems": len(items)}
        return f"[{','.join(texts)}]", schema
    parts = {key: _json_of(item, columns) for key, item in node.items()}
    text = ",".join(f"{json.dumps(key)}:".replace("%", "%%") + part for key, (part, _) in parts.items())
    properties = {key: schema for key, (_, schema) in parts.items()}
    return f"{{{text}}}", {"type": "object", "properties": properties, "required": list(properties)}


def _schema_of(kind: str) -> dict[str, Any]:
    if kind in _FLOATS:
        return {"type": ["number", "null"]}  # null: not finite
    return {"type": {"bool": "boolean", "char": "string"}.get(kind, "integer")}


def _texts(columns: list[NDArray[Any]], kind: str) -> list[str]:
    """Return the values as JSON."""
    if kind == "char":
        characters = np.column_stack(columns).astype(np.uint8)
        return [json.dumps(row.tobytes().partition(b"\0")[0].decode(errors="replace")) for row in characters]
    (column,) = columns
    if kind == "bool":
        return list(np.where(column != 0, "true", "false").tolist())
    if kind in _FLOATS:
        return list(np.where(np.isfinite(column), column.astype(str), "null").tolist())
    return list(map(str, column.tolist()))
