"""`companion replay --model`: detect again in the recorded images, and compare with the recorded detections.

The images are those of the preview: JPEG, at most `preview.rate_hz`, scaled down where they are wider than
`preview.width`. So small differences are expected even with the same model. The new detections do not go to
guidance.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from companion.recording import RecordingError
from companion.recording.convert import RUN_CHANNEL
from companion.recording.files import RecordingReader
from companion.recording.frames import recorded_frames
from companion.settings import Settings
from vision.detections import TRACK_CONFIRMED
from vision.detector import open_detector
from vision.tracking import Tracker
from vision.tracking.association import match, overlaps

# The usual limit of evaluations.
LEAST_IOU = 0.5
MAX_LISTED = 10


@dataclass
class DetectionReplay:
    """The result, for one camera.

    Attributes:
        images: recorded images with a recorded detection message.
        recorded, replayed, matched: detections; a pair has one class and an IoU of at least `LEAST_IOU`.
        mean_iou: of the pairs; NaN without one.
        differing_images: images with a detection that has no pair.
        recorded_tracks, replayed_tracks: confirmed tracks in these images.
        listed: the first differing images, in words.
    """

    model: str
    images: int = 0
    recorded: int = 0
    replayed: int = 0
    matched: int = 0
    mean_iou: float | None = None
    differing_images: int = 0
    recorded_tracks: int = 0
    replayed_tracks: int = 0
    listed: list[str] = field(default_factory=list)

    def as_dict(self) -> dict[str, Any]:
        """Return it as JSON-able data."""
        return asdict(self)


def replay_detections(paths: Sequence[Path], model: str) -> DetectionReplay:
    """Detect again in the images of the steering camera.

    Args:
        model: checkpoint, exported file, or name in the models folder.

    Raises:
        RecordingError: the files have no usable images. ValueError: the model cannot be loaded.
    """
    settings = _settings_of(paths)
    steering = settings.guidance.camera
    steering_settings = settings.of_camera(steering)
    confidence = steering_settings.detector.confidence
    following = steering_settings.tracker.following(confidence) if steering_settings.tracker.enabled else None
    wanted = steering_settings.detector.model_copy(update={"model": model})
    detector = open_detector(
        wanted.kind,
        wanted.loading(confidence if following is None else min(confidence, following.low_confidence)),
    )
    tracker = None if following is None else Tracker(following)
    found = DetectionReplay(model)
    overlap: list[float] = []
    tracks: tuple[set[int], set[int]] = (set(), set())
    for captured_ns, image, message in recorded_frames(paths, steering):
        replayed = detector.detect(image)
        if tracker is not None:
            replayed = tracker.update(replayed, captured_ns, image=image).detections
        scale = image.shape[1] / message["width"]
        old = message["detections"]
        new = replayed.records()
        old_boxes = _boxes([each["xyxy"] for each in old]) * scale
        same_class = np.array([[a["class_name"] == b["class_name"] for b in new] for a in old], bool)
        iou = overlaps(old_boxes, _boxes([each["xyxy"] for each in new]))
        pairs = match(np.where(same_class.reshape(iou.shape), iou, 0.0), LEAST_IOU)
        overlap += [float(iou[first, second]) for first, second in pairs]
        found.images += 1
        found.recorded += len(old)
        found.replayed += len(new)
        found.matched += len(pairs)
        for ids, side in zip(tracks, (old, new), strict=True):
            ids.update(each["track_id"] for each in side if each["track_state"] == TRACK_CONFIRMED)
        if not len(pairs) == len(old) == len(new):
            found.differing_images += 1
            if len(found.listed) < MAX_LISTED:
                found.listed.append(
                    f"image {message['sequence']}: recorded {_words(old)}, replayed {_words(new)}"
                )
    if not found.images:
        raise RecordingError(f"{paths[0]}: has no images with detections")
    found.mean_iou = round(float(np.mean(overlap)), 4) if overlap else None
    found.recorded_tracks, found.replayed_tracks = map(len, tracks)
    return found


def report(found: DetectionReplay) -> Iterator[str]:
    """Return the result as lines for people."""
    overlap = "" if found.mean_iou is None else f", mean IoU {found.mean_iou:.3f}"
    yield (
        f"{found.model}: {found.images} images: recorded {found.recorded} detections, replayed "
        f"{found.replayed}, matched {found.matched}{overlap}; differing images: {found.differing_images}"
    )
    yield f"confirmed tracks: recorded {found.recorded_tracks}, replayed {found.replayed_tracks}"
    yield from found.listed


def _settings_of(paths: Sequence[Path]) -> Settings:
    for message in RecordingReader(paths[0]).messages(RUN_CHANNEL):
        try:
            return Settings.from_json(json.loads(message.data)["settings"])
        except (ValueError, KeyError) as error:
            raise RecordingError(f"{paths[0]}: its settings cannot be read: {error}") from error
    raise RecordingError(f"{paths[0]}: not a recording of the service: it has no message on 'run'")


def _boxes(boxes: list[list[float]]) -> NDArray[np.float64]:
    return np.array(boxes, np.float64).reshape(-1, 4)


def _words(detections: Sequence[Any]) -> str:
    return ", ".join(f"{each['class_name']} {each['confidence']:.2f}" for each in detections) or "nothing"
