"""Images are joined with the detection messages of their frames."""

from __future__ import annotations

import base64
import json
from pathlib import Path

import cv2
import numpy as np

from companion.bus.topics import DETECTIONS
from companion.recording.convert import ANY_OBJECT, RUN_CHANNEL, large_channels
from companion.recording.files import Channel
from companion.recording.frames import recorded_frames
from tests.companion.recording.lockstep_recording import new_writer

SECOND_NS = 10**9


def part(folder: Path, *messages: tuple[str, int]) -> Path:
    """A file of one run with an `image` or the `detections` of these seconds."""
    folder.mkdir()
    writer = new_writer(folder)
    about = {"unix_offset_ns": 0, "settings": {"preview": {"annotate": False}}}
    writer.write(Channel(RUN_CHANNEL, "companion.run", ANY_OBJECT), 1, json.dumps(about).encode())
    body: dict[str, object]
    for kind, second in messages:
        if kind == "image":
            _, png = cv2.imencode(".png", np.full((8, 8, 3), second, np.uint8))
            data = base64.b64encode(png.tobytes()).decode()
            body = {"timestamp": {"sec": second, "nsec": 0}, "data": data, "format": "png"}
            channel = large_channels("")[0]
        else:
            body = {"captured_ns": second * SECOND_NS, "detections": []}
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
