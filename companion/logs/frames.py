"""The recorded images with the detection messages of their frames, and with their depth."""

from __future__ import annotations

import base64
import json
from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from companion.bus.topics import DEPTH_IMAGE, DETECTIONS, IMAGE
from companion.recording import RecordingError
from companion.recording.convert import DEPTH_ENCODING, RUN_CHANNEL
from companion.recording.files import RecordingReader
from vision.image_file import decode_image
from vision.sources.depth_images import to_metres

# Some seconds of frames.
MAX_WAITING = 100
# Images that wait for their depth, which may come after them, or not at all.
MAX_WAITING_FOR_DEPTH = 10


class DetectedFrame(NamedTuple):
    """An image (height, width, 3) uint8 BGR with its detection message.

    `image_format`: `png`: the frame as it was processed; `jpeg`: at most `preview.width` wide.
    `depth_m`: (height, width) float32 of the whole frame, metres along the optical axis, NaN where unknown;
    None: not recorded.
    """

    captured_ns: int
    image: NDArray[np.uint8]
    message: dict[str, Any]
    image_format: str = "jpeg"
    depth_m: NDArray[np.float32] | None = None


def recorded_frames(
    paths: Sequence[Path], camera: str | None = None, *, depth: bool = False
) -> Iterator[DetectedFrame]:
    """Read each recorded image that has a detection message, in order.

    Args:
        paths: files of one run, in order. camera: None: the first. depth: with the depth of the frames.

    Raises:
        RecordingError: a file cannot be read, is not a recording of the service, its images are drawn on, or
            a depth image has another size or encoding, or cannot be decoded.
    """
    prefix = "" if camera is None else f"cameras/{camera}/"
    images, detections, depths = (
        f"/{prefix}{IMAGE.name}",
        f"{prefix}{DETECTIONS.name}",
        f"/{prefix}{DEPTH_IMAGE.name}",
    )
    # Either comes first, an image up to a second after the message, also in the next file; all have the
    # capture's time.
    topics = [images, detections, *([depths] if depth else [])]
    waiting: dict[str, dict[int, Any]] = {images: {}, detections: {}, depths: {}}
    pairs: deque[tuple[int, Any, Any]] = deque()
    for path in paths:
        reader = RecordingReader(path)
        run = next(iter(reader.messages(RUN_CHANNEL)), None)
        if run is None:
            raise RecordingError(f"{path}: not a recording of the service: it has no message on 'run'")
        about = json.loads(run.data)
        for message in reader.messages(*topics):
            body, topic = json.loads(message.data), message.channel.topic
            if topic == detections:
                captured_ns = body["captured_ns"]
            else:
                stamp = body["timestamp"]
                captured_ns = stamp["sec"] * 10**9 + stamp["nsec"] - about["unix_offset_ns"]
            if topic == images and about["settings"]["preview"]["annotate"] and body["format"] == "jpeg":
                raise RecordingError(
                    f"{path}: detections are drawn into its images: record with preview.annotate = false"
                )
            waiting[topic][captured_ns] = (path, body) if topic == depths else body
            if captured_ns in waiting[images] and captured_ns in waiting[detections]:
                pairs.append((captured_ns, waiting[images][captured_ns], waiting[detections][captured_ns]))
                for each in (images, detections):
                    waiting[each] = _newer(waiting[each], captured_ns)
            elif len(waiting[topic]) > MAX_WAITING:
                del waiting[topic][next(iter(waiting[topic]))]
            # Depth images come in order: after a newer one, an older one does not come any more.
            newest_ns = max(waiting[depths], default=-1) if depth else captured_ns
            while pairs and (len(pairs) > MAX_WAITING_FOR_DEPTH or pairs[0][0] <= newest_ns):
                pair = pairs.popleft()
                yield from _decoded(*pair, depths, waiting[depths].get(pair[0]))
                waiting[depths] = _newer(waiting[depths], pair[0])
    for pair in pairs:
        yield from _decoded(*pair, depths, waiting[depths].get(pair[0]))


def _decoded(
    captured_ns: int, image: Any, message: Any, topic: str, depth: tuple[Path, Any] | None
) -> Iterator[DetectedFrame]:
    """Decode one frame; a damaged image is left out. `topic`, `depth`: of its depth image, with its file."""
    pixels = decode_image(base64.b64decode(image["data"]))
    if pixels is None:
        return
    depth_m = None if depth is None else _depth_m(*depth, topic, message["width"], message["height"])
    yield DetectedFrame(captured_ns, pixels, message, image["format"], depth_m)


def _depth_m(path: Path, body: Any, topic: str, width: int, height: int) -> NDArray[np.float32]:
    """Decode a depth image of a frame of this size. Raises RecordingError."""
    expected = (width, height, DEPTH_ENCODING)
    if (found := tuple(body.get(key) for key in ("width", "height", "encoding"))) != expected:
        raise RecordingError(f"{path}: {topic}: a depth image is {found}, expected {expected}")
    try:
        data = base64.b64decode(body["data"])
    except (KeyError, TypeError, ValueError) as error:
        raise RecordingError(f"{path}: {topic}: data of a depth image is not base64: {error}") from error
    if len(data) != 2 * width * height:
        raise RecordingError(
            f"{path}: {topic}: a depth image of {width}x{height} has {len(data)} bytes, "
            f"expected {2 * width * height}"
        )
    return to_metres(np.frombuffer(data, "<u2").reshape(height, width), None)


def _newer(bodies: dict[int, Any], captured_ns: int) -> dict[int, Any]:
    return {stamp_ns: each for stamp_ns, each in bodies.items() if stamp_ns > captured_ns}
