"""What the recorder refuses, and how much waits for its writer."""

from __future__ import annotations

import json
import queue
import threading
from pathlib import Path

import pytest
import zenoh

from companion.bus.session import zenoh_config
from companion.bus.topics import EVENTS, POSE, STATUS
from companion.recording import recorder
from companion.recording.convert import RECORDER_CHANNEL
from companion.recording.files import RecordingReader
from companion.recording.recorder import Recorder, RecorderOptions
from companion.settings import ZenohSection
from mavlink_sim.testing import free_port


def options(folder: Path, endpoint: str = "tcp/127.0.0.1:7447") -> RecorderOptions:
    return RecorderOptions(
        zenoh=ZenohSection(mode="client", connect=(endpoint,), listen=()),
        vehicle="alpha",
        directory=str(folder),
        images=False,
        depth=False,
        clouds=False,
        max_file_mb=100,
        max_total_mb=1000,
    )


def losses(path: Path) -> dict[str, int]:
    *_, last = RecordingReader(path).messages(RECORDER_CHANNEL)
    found: dict[str, int] = json.loads(last.data)
    return found


def event(number: int) -> bytes:
    return json.dumps({"stamp_ns": number, "level": "info", "text": "x" * 80}).encode()


def test_bytes_that_wait_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recorder, "MAX_WAITING_BYTES", 10 * len(event(10)))
    written = Recorder(options(tmp_path))
    for number in range(10, 40):
        written.add(EVENTS.name, event(number), None)
    written.close()
    stamps = [json.loads(one.data)["stamp_ns"] for one in RecordingReader(written.path).messages(EVENTS.name)]
    assert stamps == list(range(30, 40))  # the newest
    assert losses(written.path)["dropped_messages"] == 20


def test_too_large_message_is_counted_and_not_recorded(tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    peer = zenoh.open(zenoh_config(ZenohSection(mode="peer", listen=(endpoint,))))
    ending, said = threading.Event(), queue.Queue[str]()
    recording = threading.Thread(
        target=recorder.record, args=(options(tmp_path, endpoint), ending, said.put), daemon=True
    )
    try:
        publishers = {topic.name: peer.declare_publisher(topic.key("alpha")) for topic in (POSE, STATUS)}
        recording.start()
        said.get(timeout=20)
        pose = publishers[POSE.name]
        while not pose.matching_status.matching:  # type: ignore[attr-defined]
            assert not ending.wait(0.01)
        for size in (POSE.largest_bytes + 1, 10):
            pose.put(json.dumps({"published_ns": 5, "fill": " " * size}))
    finally:
        ending.set()
        recording.join(20)
        peer.close()  # type: ignore[no-untyped-call]
    path = Path(said.get(timeout=20).removeprefix("recorded "))
    assert len(list(RecordingReader(path).messages(POSE.name))) == 1
    assert losses(path)["unread_messages"] == 1
