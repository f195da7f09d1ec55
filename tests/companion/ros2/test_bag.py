"""A recording as a bag: rosbags reads every message, by the definitions inside the file."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from companion.bus.topics import CLOUD, DETECTIONS, IMAGE, LABELS, TOPICS, Topic
from companion.recording.convert import RUN_CHANNEL, Converter
from companion.recording.files import Channel, Recorded
from companion.ros2.cdr import decode
from companion.ros2.messages import OUTPUT_TOPICS, topic_name
from tests.companion.command_line import companion_here
from tests.companion.recording.lockstep_recording import new_writer, rewritten
from tests.companion.ros2.bus_samples import CAPTURED_NS, JPEG, POINTS, payload_of
from tests.companion.ros2.message_readers import equal, plain

OFFSET_NS = 1_700_000_000_000_000_123
RUN = {
    "service": "a",
    "vehicle": "drone-1",
    "unix_offset_ns": OFFSET_NS,
    "settings": {"preview": {"width": 0}},
}
IN_BAG = [topic for topic in OUTPUT_TOPICS if topic.name != "image"]


def recorded(folder: Path, *, run: bool = True) -> Path:
    """Each topic of the bus once, of the first camera and of `front-left`; the run comes after the first."""
    converter, writer = Converter("drone-1"), new_writer(folder)
    written: list[Recorded] = []

    def record(path: str, topic: Topic) -> None:
        written.extend(converter.convert(path, *payload_of(topic)))

    def record_run() -> None:
        written.extend(converter.convert("@record/run", json.dumps(RUN).encode()))

    record_run()
    for topic in TOPICS:
        record(topic.path(), topic)
        if topic.of_camera:
            record(topic.path("front-left"), topic)
    first = written.pop(0)
    assert first.channel.topic == RUN_CHANNEL
    if run:
        written.insert(1, first)
    for message in written:
        writer.write(*message)
    writer.close()
    return writer.path


def convert(path: Path, output: Path) -> subprocess.CompletedProcess[str]:
    return companion_here("log", "convert", path, output, "--ros2", cwd=path.parent)


def read(path: Path) -> dict[str, tuple[str, int, Any]]:
    """Name → type, time and message, read with the definitions of the file alone."""
    found = {}
    with Reader(path) as reader:
        for connection, time_ns, data in reader.messages():
            store = get_typestore(Stores.EMPTY)
            store.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
            message = plain(store.deserialize_cdr(data, connection.msgtype))
            assert equal(message, decode(connection.msgtype, bytes(data)))
            again = connection.topic == "/tf" or connection.topic.endswith("camera_info")
            assert connection.topic not in found or again  # of both cameras; beside an image
            found[connection.topic] = connection.msgtype, time_ns, message
    return found


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[str, int, Any]]:
    folder = tmp_path_factory.mktemp("bag")
    done = convert(recorded(folder / "recording"), folder / "bag.mcap")
    assert (done.returncode, done.stderr) == (0, "")
    assert (folder / "bag.mcap").read_bytes().startswith(b"\x89MCAP0\r\n")
    return read(folder / "bag.mcap")


def test_bag_has_every_topic_of_every_camera(bag: dict[str, tuple[str, int, Any]]) -> None:
    names = {}
    for topic in IN_BAG:
        for camera in (None, "front-left") if topic.source.of_camera else (None,):
            name = topic_name(topic, camera)
            names[name if name.startswith("/") else f"/drone_1/{name}"] = topic.type_name
    assert {name: kind for name, (kind, _, _) in bag.items()} == names


def test_stamps_and_times_are_unix_time(bag: dict[str, tuple[str, int, Any]]) -> None:
    _, time_ns, image = bag["/drone_1/cameras/front_left/image/compressed"]
    stamp = image["header"]["stamp"]
    assert stamp["sec"] * 10**9 + stamp["nanosec"] == time_ns == CAPTURED_NS + OFFSET_NS
    body = json.loads(payload_of(DETECTIONS)[0])
    _, time_ns, message = bag["/drone_1/detections"]
    stamp = message["header"]["stamp"]
    assert stamp["sec"] * 10**9 + stamp["nanosec"] == body["captured_ns"] + OFFSET_NS
    assert time_ns == body["published_ns"] + OFFSET_NS


def test_contents_are_those_of_the_recording(bag: dict[str, tuple[str, int, Any]]) -> None:
    image = bag["/drone_1/image/compressed"][2]
    assert (bytes(image["data"]), image["format"]) == (JPEG, "jpeg")
    assert image["header"]["frame_id"] == "drone_1/camera_optical"
    cloud = bag["/drone_1/points"][2]
    points = np.array(cloud["data"], np.uint8).reshape(-1, cloud["point_step"])
    np.testing.assert_array_equal(points[:, :12].copy().view("<f4"), POINTS.points)
    assert bag["/drone_1/labels"][2] == {"data": "car, person"}
    assert bag["/drone_1/cameras/front_left/detections"][2]["header"]["frame_id"] == (
        "drone_1/cameras/front-left_optical"
    )


def test_file_that_exists_and_another_suffix_are_refused(tmp_path: Path) -> None:
    path = recorded(tmp_path / "recording")
    (tmp_path / "bag.mcap").write_text("mine")
    done = convert(path, tmp_path / "bag.mcap")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert (tmp_path / "bag.mcap").read_text() == "mine"
    done = convert(path, tmp_path / "flight.tlog")
    assert done.returncode == 2
    assert ".mcap" in done.stderr


def test_recording_without_its_run_is_refused(tmp_path: Path) -> None:
    done = convert(recorded(tmp_path / "recording", run=False), tmp_path / "bag.mcap")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
    assert not (tmp_path / "bag.mcap").exists()


@pytest.mark.parametrize(
    ("topic", "change"),
    [
        ("detections", lambda data: b'{"captured_ns": 1}'),
        (f"/{IMAGE.name}", lambda data: b"{}"),
        (f"/{CLOUD.name}", lambda data: data.replace(b'"data":"', b'"data":"AAAA')),
        (LABELS.name, lambda data: b"[]"),
    ],
)
def test_message_that_cannot_be_converted_is_named(
    tmp_path: Path, topic: str, change: Callable[[bytes], bytes]
) -> None:
    def changed(message: Recorded) -> Recorded:
        return message._replace(data=change(message.data)) if message.channel.topic == topic else message

    path = rewritten(recorded(tmp_path / "recording"), tmp_path / "changed", changed)
    done = convert(path, tmp_path / "bag.mcap")
    assert done.returncode == 0
    (line,) = done.stderr.splitlines()
    assert f": {topic}: " in line
    names_lost = 2 if topic == DETECTIONS.name else 1
    lost = 2 if topic in (DETECTIONS.name, f"/{IMAGE.name}") else 1  # with its camera_info
    whole = len(IN_BAG) + sum(each.source.of_camera for each in IN_BAG)
    assert len(read(tmp_path / "bag.mcap")) == whole - names_lost - 1
    assert done.stdout.split(": ")[-1] == f"{whole + 2 - lost} messages\n"


def test_foxglove_channels_of_the_same_name_are_not_taken(tmp_path: Path) -> None:
    writer = new_writer(tmp_path)
    writer.write(Channel(RUN_CHANNEL), 1, json.dumps(RUN).encode())
    writer.write(Channel("/camera_info", "foxglove.CameraCalibration", b"{}"), 1, b"{}")
    writer.close()
    done = convert(writer.path, tmp_path / "bag.mcap")
    assert (done.returncode, done.stderr.count("\n")) == (2, 1)
