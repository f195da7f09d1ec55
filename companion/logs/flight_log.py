"""`companion log`: what happened in a recording, in words."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from companion.bus.topics import EVENTS, LARGE_TOPICS, VEHICLE
from companion.recording import RecordingError
from companion.recording.convert import (
    OUTPUT_CHANNEL,
    RECORDER_CHANNEL,
    RUN_CHANNEL,
)
from companion.recording.files import RecordingReader
from vision.file_kinds import is_hidden

_LARGE = {topic.name: topic.name.replace("_", " ") + "s" for topic in LARGE_TOPICS}
_READ = (RUN_CHANNEL, EVENTS.name, VEHICLE.name, OUTPUT_CHANNEL, RECORDER_CHANNEL)


@dataclass(frozen=True, slots=True)
class Flight:
    """One time from arming to disarming. Unix time; `ended_ns` is None if the recording ends armed."""

    armed_ns: int
    ended_ns: int | None


@dataclass
class RecordingSummary:
    """One recording.

    Attributes:
        began_ns, ended_ns: Unix time of its first and last message; 0 without one.
        lines: (Unix time, kind, text) of events, modes and refused commands, in order.
        large: topic of images, depth images and point clouds → how many are recorded.
        losses: the recorder's last note about losses.
        metadata: that another program added to the file.
        problems: damage of the file, and a line if it is not ended.
        ended: whether the file has its end: not while it is being recorded.
    """

    path: Path
    size: int
    vehicle: str = ""
    version: str = ""
    began_ns: int = 0
    ended_ns: int = 0
    flights: list[Flight] = field(default_factory=list)
    lines: list[tuple[int, str, str]] = field(default_factory=list)
    large: Counter[str] = field(default_factory=Counter)
    losses: dict[str, Any] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)
    ended: bool = True

    def as_dict(self) -> dict[str, Any]:
        """Return it as JSON-able data."""
        return {
            "path": str(self.path),
            "bytes": self.size,
            "vehicle": self.vehicle,
            "version": self.version,
            "began": _shown(self.began_ns),
            "duration_s": self.duration_s,
            "flights": [
                {"armed": _shown(flight.armed_ns), "duration_s": _seconds(flight, self.ended_ns)}
                for flight in self.flights
            ],
            "lines": [
                {"time": _shown(stamp_ns), "kind": kind, "text": text} for stamp_ns, kind, text in self.lines
            ],
            "large": dict(self.large),
            "losses": self.losses,
            "metadata": self.metadata,
            "problems": self.problems,
            "ended": self.ended,
        }

    @property
    def duration_s(self) -> float:
        """From the first to the last message."""
        return round((self.ended_ns - self.began_ns) / 1e9, 1)


def summarize(path: Path) -> RecordingSummary:
    """Read a recording. Raises RecordingError."""
    reader = RecordingReader(path)
    found = RecordingSummary(path, path.stat().st_size)
    mode: str | None = None
    armed: bool | None = None
    for channel, log_time_ns, data in reader.messages():
        found.began_ns = min(found.began_ns or log_time_ns, log_time_ns)
        found.ended_ns = max(found.ended_ns, log_time_ns)
        if channel.topic not in _READ:
            if channel.topic.startswith("/") and channel.topic.rpartition("/")[2] in _LARGE:
                found.large[channel.topic] += 1
            continue
        try:
            message = json.loads(data)
            match channel.topic:
                case topic if topic == RUN_CHANNEL:
                    found.vehicle, found.version = message["vehicle"], message["version"]
                case topic if topic == RECORDER_CHANNEL:
                    found.losses = message
                case topic if topic == EVENTS.name:
                    found.lines.append((log_time_ns, message["level"], message["text"]))
                case topic if topic == OUTPUT_CHANNEL:
                    found.lines += [
                        (log_time_ns, "refused", f"{event['behaviour']}: {event['message']}")
                        for event in message["events"]
                        if event["kind"] == "refused"
                    ]
                case _:
                    if message["mode"] != mode:
                        mode = message["mode"]
                        found.lines.append((log_time_ns, "mode", str(mode)))
                    if message["armed"] != armed:
                        armed = message["armed"]
                        _on_armed(found, bool(armed), log_time_ns)
        except (ValueError, KeyError, TypeError) as error:
            found.problems.append(f"{path}: a message on {channel.topic} cannot be read: {error}")
    found.lines.sort(key=lambda line: line[0])
    found.metadata = reader.metadata
    found.problems += reader.problems
    found.ended = reader.ended
    return found


def _on_armed(found: RecordingSummary, armed: bool, stamp_ns: int) -> None:
    if armed:
        found.flights.append(Flight(stamp_ns, None))
        found.lines.append((stamp_ns, "armed", ""))
    elif found.flights:
        found.flights[-1] = Flight(found.flights[-1].armed_ns, stamp_ns)
        found.lines.append((stamp_ns, "disarmed", ""))


def summaries(directory: Path) -> Iterator[RecordingSummary | RecordingError]:
    """Summarize every .mcap file of a folder, by name; the error where one cannot be read.

    Raises:
        RecordingError: the folder cannot be read.
    """
    try:
        paths = sorted(path for path in directory.iterdir() if path.suffix == ".mcap" and not is_hidden(path))
    except OSError as error:
        raise RecordingError(f"{directory}: cannot be read: {error.strerror}") from error
    for path in paths:
        try:
            yield summarize(path)
        except RecordingError as error:
            yield error


def listed(found: RecordingSummary) -> str:
    """Return a recording in one line."""
    durations = ", ".join(f"{_seconds(flight, found.ended_ns):.0f} s" for flight in found.flights)
    flights = f"armed {durations}" if found.flights else "not armed"
    words = [
        found.path.name,
        found.vehicle or "-",
        _shown(found.began_ns),
        f"{found.duration_s:.0f} s",
        f"{found.size / 1e6:.1f} MB",
        flights,
        *(["not ended"] if not found.ended else []),
        *(["damaged"] if len(found.problems) > (not found.ended) else []),
    ]
    return "  ".join(words)


def shown(found: RecordingSummary) -> Iterator[str]:
    """Return a recording as lines for people."""
    yield listed(found)
    for stamp_ns, kind, text in found.lines:
        yield f"{(stamp_ns - found.began_ns) / 1e9:9.2f} s  {kind:8}  {text}".rstrip()
    for topic, count in sorted(found.large.items()):
        yield f"{topic}: {count} {_LARGE[topic.rpartition('/')[2]]}"
    lost = {name: count for name, count in found.losses.items() if count and name != "first_step"}
    yield from (f"{name.replace('_', ' ')}: {count}" for name, count in lost.items())
    for name, entries in found.metadata.items():
        yield f"{name}: " + ", ".join(f"{key} {value}" for key, value in entries.items())
    yield from found.problems


def _seconds(flight: Flight, end_ns: int) -> float:
    return round(((flight.ended_ns or end_ns) - flight.armed_ns) / 1e9, 1)


def _shown(stamp_ns: int) -> str:
    return datetime.fromtimestamp(stamp_ns / 1e9, UTC).strftime("%Y-%m-%dT%H:%M:%SZ") if stamp_ns else "-"
