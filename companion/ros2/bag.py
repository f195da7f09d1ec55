"""A recording as a bag of ROS 2: MCAP of the profile `ros2`, CDR, with the definitions inside."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from functools import partial
from itertools import chain
from operator import add
from pathlib import Path

from mcap.writer import CompressionType, Writer

from companion.bus.topics import LABELS, LARGE_TOPICS
from companion.recording import RecordingError
from companion.recording.convert import RUN_CHANNEL
from companion.recording.files import CHUNK_BYTES, Recorded, RecordingReader, new_file
from companion.ros2.definitions import full_definition
from companion.ros2.messages import OUTPUT_TOPICS, Messages, RosTopic, frame_prefix, ros_name, topic_name

# Images are kept as they were encoded.
_MADE_OF = tuple(
    (topic, source)
    for topic in OUTPUT_TOPICS
    if topic.type_name != "sensor_msgs/msg/Image"
    for source in topic.sources(None)
)
_LARGE = frozenset(topic.name for topic in LARGE_TOPICS)


def write_bag(path: Path, output: Path) -> tuple[list[str], int]:
    """Write what a recording has for ROS to a new bag. ROS time is Unix time; the namespace is the vehicle.

    Returns:
        what could not be read or converted, a line each, and the number of messages.

    Raises:
        RecordingError: the recording cannot be read or has nothing for ROS; the bag cannot be written or
            exists.
    """
    reader = RecordingReader(path)
    problems: list[str] = []
    schemas: dict[str, int] = {}
    channels: dict[str, int] = {}
    count = 0
    with new_file(output) as file:
        writer = Writer(file, CHUNK_BYTES, CompressionType.ZSTD)
        writer.start("ros2", "mavlink-companion")
        for topic, name, log_time_ns, data in _converted(reader, problems):
            kind = topic.type_name
            if kind not in schemas:
                schemas[kind] = writer.register_schema(kind, "ros2msg", full_definition(kind).encode())
            if name not in channels:
                channels[name] = writer.register_channel(name, "cdr", schemas[kind])
            writer.add_message(channels[name], log_time_ns, data, log_time_ns)
            count += 1
        if count == 0:
            raise RecordingError(f"{path}: has nothing for ROS: expected a recording of the service")
        writer.finish()  # type: ignore[no-untyped-call]
    return reader.problems + problems, count


def _converted(reader: RecordingReader, problems: list[str]) -> Iterator[tuple[RosTopic, str, int, bytes]]:
    """Topic, whole name, Unix time and CDR of each message for ROS."""
    begin = next(reader.messages(RUN_CHANNEL), None)
    failed: dict[str, tuple[str, int]] = {}
    for recorded in () if begin is None else chain((begin,), reader.messages()):
        channel = recorded.channel.topic
        if channel == RUN_CHANNEL:
            run = json.loads(recorded.data)
            offset_ns, namespace = run["unix_offset_ns"], ros_name(run["vehicle"])
            messages = Messages(frame_prefix(namespace), partial(add, offset_ns))
        folder, _, source = channel.removeprefix("/").rpartition("/")
        # Foxglove's types begin with a slash; of those only the large ones are the bus's own.
        if channel.startswith("/") != (source in _LARGE):
            continue
        camera = folder.removeprefix("cameras/") or None
        for topic, made_of in _MADE_OF:
            if made_of.name != source:
                continue
            try:
                on_bus = _on_the_bus(recorded, source, offset_ns)
                data = messages.convert(topic, camera, *on_bus, made_of)
            except (LookupError, TypeError, ValueError) as error:
                first, times = failed.get(channel, (str(error), 0))
                failed[channel] = first, times + 1
                continue
            if data is not None:
                name = topic_name(topic, camera)
                whole = name if name.startswith("/") else f"/{namespace}/{name}"
                yield topic, whole, recorded.log_time_ns, data
    problems += [
        f"{reader.path}: {channel}: {times} messages left out: {first}"
        for channel, (first, times) in failed.items()
    ]


def _on_the_bus(recorded: Recorded, source: str, offset_ns: int) -> tuple[bytes, bytes | None]:
    """Return the payload and attachment that a recorded message was on the bus."""
    if source == LABELS.name:
        return json.loads(recorded.data)["labels"].encode(), None
    if source not in _LARGE:
        return recorded.data, None
    body = json.loads(recorded.data)
    payload = base64.b64decode(body["data"])
    points = len(payload) // body.get("point_stride", len(payload))
    about = {"captured_ns": recorded.log_time_ns - offset_ns, "points": points}
    return payload, json.dumps(about).encode()
