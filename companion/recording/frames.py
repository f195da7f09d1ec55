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

# Some seconds of frames.
MAX_WAITING = 100


class DetectedFrame(NamedTuple):
    """An image (height, width, 3) uint8 BGR with its detection message.

    `image_format`: `png`: the frame as it was processed; `jpeg`: at most `preview.width` wide.
    """

    captured_ns: int
    image: NDArray[np.uint8]
    message: dict[str, Any]
    image_format: str = "jpeg"


def recorded_frames(paths: Sequence[Path], camera: str | None = None) -> Iterator[DetectedFrame]:
    """Read each recorded image that has a detection message, in order.

    Args:
        paths: files of one run, in order. camera: None: the first.

    Raises:
        RecordingError: a file cannot be read, is not a recording of the service, or its images are drawn on.
    """
    prefix = "" if camera is None else f"cameras/{camera}/"
    images, detections = f"/{prefix}{IMAGE.name}", f"{prefix}{DETECTIONS.name}"
    # Either comes first, an image up to a second after the message, also in the next file; both have the
    # capture's time.
    waiting: dict[str, dict[int, Any]] = {images: {}, detections: {}}
    for path in paths:
        reader = RecordingReader(path)
        run = next(iter(reader.messages(RUN_CHANNEL)), None)
        if run is None:
            raise RecordingError(f"{path}: not a recording of the service: it has no message on 'run'")
        about = json.loads(run.data)
        for message in reader.messages(images, detections):
            body, topic = json.loads(message.data), message.channel.topic
            if topic == detections:
                captured_ns = body["captured_ns"]
            else:
                stamp = body["timestamp"]
                captured_ns = stamp["sec"] * 10**9 + stamp["nsec"] - about["unix_offset_ns"]
                if about["settings"]["preview"]["annotate"] and body["format"] == "jpeg":
                    raise RecordingError(
                        f"{path}: detections are drawn into its images: record with preview.annotate = false"
                    )
            waiting[topic][captured_ns] = body
            if all(captured_ns in bodies for bodies in waiting.values()):
                image, found = waiting[images][captured_ns], waiting[detections][captured_ns]
                waiting = {
                    topic: {stamp_ns: each for stamp_ns, each in bodies.items() if stamp_ns > captured_ns}
                    for topic, bodies in waiting.items()
                }
                decoded = cv2.imdecode(
                    np.frombuffer(base64.b64decode(image["data"]), np.uint8), cv2.IMREAD_COLOR
                )
                if decoded is not None:
                    yield DetectedFrame(
                        captured_ns, decoded.astype(np.uint8, copy=False), found, image["format"]
                    )
            elif len(waiting[topic]) > MAX_WAITING:
                del waiting[topic][next(iter(waiting[topic]))]
