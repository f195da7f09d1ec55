"""Images are joined with the detection messages of their frames."""

from __future__ import annotations

import base64
import itertools
import json
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np
import pytest

from companion.bench.lockstep_flight import plain_settings
from companion.bus.topics import DEPTH_IMAGE, DETECTIONS, IMAGE
from companion.guidance.core import GuidanceOptions
from companion.logs.frames import MAX_WAITING_FOR_DEPTH, recorded_frames
from companion.recording import RecordingError
from companion.recording.convert import ANY_OBJECT, RUN_CHANNEL, large_channel
from companion.recording.files import Channel
from companion.recording.tap import run_record
from companion.settings.perception import DEFAULT_MODEL
from tests.companion.command_line import companion_here
from tests.companion.recording.lockstep_recording import new_writer

SECOND_NS = 10**9


def part(folder: Path, *messages: tuple[str, int], depth: Mapping[str, object] | None = None) -> Path:
    """A file of one run with an `image`, the `depth` or the `detections` of these seconds.

    `depth`: fields of the depth images that are replaced, or removed if None.
    """
    folder.mkdir()
    writer = new_writer(folder)
    about = run_record(plain_settings(), GuidanceOptions(), "service1") | {"unix_offset_ns": 0}
    writer.write(Channel(RUN_CHANNEL, "companion.run", ANY_OBJECT), 1, json.dumps(about).encode())
    body: dict[str, object]
    for kind, second in messages:
        if kind == "image":
            _, png = cv2.imencode(".png", np.full((8, 8, 3), second, np.uint8))
            data = base64.b64encode(png.tobytes()).decode()
            body = {"timestamp": {"sec": second, "nsec": 0}, "data": data, "format": "png"}
            channel = large_channel(IMAGE)
        elif kind == "depth":
            data = base64.b64encode(np.full(64, 1000 * second, "<u2").tobytes()).decode()
            body = {"timestamp": {"sec": second, "nsec": 0}, "data": data, "encoding": "16UC1"}
            body |= {"width": 8, "height": 8, **(depth or {})}
            body = {key: value for key, value in body.items() if value is not None}
            channel = large_channel(DEPTH_IMAGE)
        else:
            body = {"captured_ns": second * SECOND_NS, "detections": [], "width": 8, "height": 8}
            channel = Channel(DETECTIONS.name, "companion.detections", ANY_OBJECT)
        writer.write(channel, second * SECOND_NS, json.dumps(body).encode())
    writer.close()
    return writer.path


def test_image_after_its_detections_in_the_next_part_is_kept(tmp_path: Path) -> None:
    first = part(tmp_path / "0", ("detections", 1), ("image", 1), ("detections", 2))
    second = part(tmp_path / "1", ("image", 2), ("detections", 3), ("image", 3))
    frames = list(recorded_frames([first, second]))
    assert [(frame.captured_ns // SECOND_NS, int(frame.image[0, 0, 0])) for frame in frames] == [
        (1, 1),
        (2, 2),
        (3, 3),
    ]


ALL = [("detections", 1), ("image", 1), ("depth", 1)]


@pytest.mark.parametrize("order", list(itertools.permutations(range(3))))
def test_depth_is_joined_in_any_order_and_may_be_missing(tmp_path: Path, order: tuple[int, ...]) -> None:
    """The second frame has no depth, and neither has the last one."""
    messages = [(ALL[index][0], second) for second in range(1, 5) for index in order]
    path = part(tmp_path / "0", *(each for each in messages if each not in {("depth", 2), ("depth", 4)}))
    frames = list(recorded_frames([path], depth=True))
    assert [frame.captured_ns // SECOND_NS for frame in frames] == [1, 2, 3, 4]
    depths = [None if frame.depth_m is None else round(float(frame.depth_m[7, 7]), 3) for frame in frames]
    assert depths == [1.0, None, 3.0, None]
    assert [frame.depth_m for frame in recorded_frames([path])] == [None] * 4


def test_frames_of_a_recording_without_depth_are_all_read(tmp_path: Path) -> None:
    seconds = range(1, MAX_WAITING_FOR_DEPTH + 5)
    path = part(tmp_path / "0", *((kind, second) for second in seconds for kind in ("detections", "image")))
    frames = [frame.captured_ns // SECOND_NS for frame in recorded_frames([path], depth=True)]
    assert frames == list(seconds)


def test_depth_waits_for_late_detections_as_images_do(tmp_path: Path) -> None:
    late, last = MAX_WAITING_FOR_DEPTH + 2, 40
    messages = []
    for second in range(1, last + late + 1):
        messages += [("image", second), ("depth", second)] if second <= last else []
        messages += [("detections", second - late)] if second > late else []
    frames = list(recorded_frames([part(tmp_path / "0", *messages)], depth=True))
    depths = [None if frame.depth_m is None else round(float(frame.depth_m[0, 0]), 3) for frame in frames]
    assert depths == list(range(1, last + 1))


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        ({"height": 7}, "(8, 7, '16UC1'), expected (8, 8, '16UC1')"),
        ({"encoding": None}, "(8, 8, None), expected (8, 8, '16UC1')"),
        ({"data": "AAA"}, "base64"),
        ({"data": None}, "base64"),
        ({"data": base64.b64encode(bytes(126)).decode()}, "126 bytes, expected 128"),
    ],
)
def test_damaged_depth_is_refused_with_its_file_and_topic(
    tmp_path: Path, fields: Mapping[str, object], reason: str
) -> None:
    damaged = part(tmp_path / "0", ("depth", 1), depth=fields)
    files = [damaged, part(tmp_path / "1", ("detections", 1), ("image", 1))]
    with pytest.raises(RecordingError) as refused:
        list(recorded_frames(files, depth=True))
    assert str(refused.value).startswith(f"{damaged}: /depth_image: ")
    assert reason in str(refused.value)
    done = companion_here("log", "replay", *files, "--model", DEFAULT_MODEL, cwd=tmp_path)
    assert (done.returncode, done.stderr) == (2, f"companion: {refused.value}\n")
