"""The recorded images with the detection messages of their frames."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.bus.topics import DETECTIONS, IMAGE
from companion.recording import RecordingError
from companion.recording.convert import RUN_CHANNEL
from companion.recording.files import RecordingReader


class DetectedFrame(NamedTuple):
    """An image (height, width, 3) uint8 BGR, at most `preview.width` wide, with its detection message."""

    captured_ns: int
    image: NDArray[np.uint8]
    message: dict[str, Any]


def recorded_frames(paths: Sequence[Path], camera: str | None = None) -> Iterator[DetectedFrame]:
    """Read each recorded image that has a detection message, in order.

    Args:
        paths: files of one run, in order. camera: None: the first.

    Raises:
        RecordingError: a file cannot be read, is not a recording of the service, or its images are drawn on.
    """
    prefix = "" if camera is None else f"cameras/{camera}/"
    images, detections = f"/{prefix}{IMAGE.name}", f"{prefix}{DETECTIONS.name}"
    for path in paths:
        reader = RecordingReader(path)
        # An image arrives up to a second after the message about its frame; both have the capture's time.
        waiting: dict[int, Any] = {}
        run = next(iter(reader.messages(RUN_CHANNEL)), None)
        if run is None:
            raise RecordingError(f"{path}: not a recording of the service: it has no message on 'run'")
        about = json.loads(run.data)
        if about["settings"]["preview"]["annotate"]:
            raise RecordingError(
                f"{path}: detections are drawn into its images: record with preview.annotate = false"
            )
        for message in reader.messages(images, detections):
            body = json.loads(message.data)
            if message.channel.topic == detections:
                waiting[body["captured_ns"]] = body
                continue
            stamp = body["timestamp"]
            captured_ns = stamp["sec"] * 10**9 + stamp["nsec"] - about["unix_offset_ns"]
            found = waiting.get(captured_ns)
            waiting = {stamp_ns: each for stamp_ns, each in waiting.items() if stamp_ns > captured_ns}
            image = cv2.imdecode(np.frombuffer(base64.b64decode(body["data"]), np.uint8), cv2.IMREAD_COLOR)
            if found is not None and image is not None:
                yield DetectedFrame(captured_ns, image.astype(np.uint8, copy=False), found)
