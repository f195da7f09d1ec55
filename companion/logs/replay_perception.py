"""`companion log replay --model`: detector, tracker and ranging again over the recorded images.

The same functions as in the service make targets of the images; `Guidance.step` gets them in the step in
which it got those of the flight. JPEG images are those of the preview: at most `preview.rate_hz`, and scaled
down where they are wider than `preview.width`, so even the flight's own model finds slightly different boxes.
PNG images are the processed frames. Depth is that of the processed frames, in whole millimetres. Which
samples of the vehicle's pose the service had when it processed an image is not recorded: here it has all
until the step of guidance.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import statistics
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from companion.bus.topics import STATUS
from companion.guidance.objects.from_detections import HistoryError, StateHistory
from companion.guidance.objects.target import RangeSource, Target
from companion.logs.frames import DetectedFrame, recorded_frames
from companion.logs.replay_timeline import Timeline
from companion.perception.assembly import CameraTelemetry, build_pipeline, load_detector
from companion.perception.cameras import PerceptionCamera, threads_each
from companion.perception.process import RateLimiter
from companion.recording import RecordingError
from companion.recording.encoding import dumps
from companion.recording.files import RecordingReader
from companion.recording.guidance_record import RecordedStep
from companion.settings import Settings
from companion.settings.former import without_removed
from companion.settings.perception import CameraSection, DetectorSection
from vision.detections import TRACK_CONFIRMED, DetectionRecord
from vision.frame import Frame
from vision.model_files import find_model
from vision.pipeline import PerceptionResult, Pipeline
from vision.runtimes.base import PRECISIONS
from vision.runtimes.exported import kind_of
from vision.sources.source import OneFrame
from vision.tracking import TARGET_CLASS
from vision.tracking.association import match, overlaps

# The usual limit of evaluations.
LEAST_IOU = 0.5
MAX_LISTED = 10
DEPTH_INEXACT = "depth was rounded to 1 mm unless the camera delivers whole millimetres"
SAMPLES_INEXACT = (
    "tracks and ranges: the flight had fewer samples of the vehicle's pose when it processed an image"
)
_COMPARED = ("class_name", "confidence", "xyxy", "track_id", "track_score", "track_state")


@dataclass
class DetectionReplay:
    """How the replayed detections of the steering camera differ from the recorded ones.

    Attributes:
        same_model: whether the model's file is the flight's, by its SHA-256. recorded_model: its name.
        image_formats: `jpeg`, `png`. scaled: images are smaller than the frames.
        frames: whose detections guidance got in the flight. images: of those with a recorded image.
        depth_images: images with recorded depth.
        identical_images: all detections and tracks are equal, as published.
        recorded, replayed, matched: detections; a pair has one class and an IoU of at least `LEAST_IOU`.
        mean_iou: of the pairs; None without one.
        differing_images: images with a detection that has no pair.
        recorded_tracks, replayed_tracks: confirmed tracks in these images.
        range_difference_m: median and largest difference of the range of one trusted target; None: no pair.
        digest: SHA-256 of the replayed detections.
        listed: the first differing images, in words.
    """

    model: str
    recorded_model: str | None = None
    same_model: bool = False
    image_formats: list[str] = field(default_factory=list)
    scaled: bool = False
    frames: int = 0
    images: int = 0
    depth_images: int = 0
    identical_images: int = 0
    recorded: int = 0
    replayed: int = 0
    matched: int = 0
    mean_iou: float | None = None
    differing_images: int = 0
    recorded_tracks: int = 0
    replayed_tracks: int = 0
    range_difference_m: tuple[float, float] | None = None
    digest: str = ""
    listed: list[str] = field(default_factory=list)


class PerceptionReplay:
    """The perception of the steering camera, stepped by the recorded steps of guidance.

    Args:
        settings: of the flight. model: checkpoint, exported file, or name in the models folder.
        timeline: gets the differences of targets.

    Raises:
        RecordingError: the files have no usable images. ValueError: the model cannot be loaded.
    """

    def __init__(self, paths: Sequence[Path], settings: Settings, model: str, timeline: Timeline) -> None:
        name = settings.guidance.camera
        own = settings.of_camera(name)
        detectors = [settings.of_camera(each).detector for each in (None, *settings.cameras)]
        status, restarts = _status(paths, name)
        detector = _as_in_flight(own.detector, threads_each(detectors), status, model)
        self._settings = own.model_copy(update={"detector": detector})
        self._frames = recorded_frames(paths, name, depth=True)
        self._next = next(self._frames, None)
        if self._next is None:
            raise RecordingError(f"{paths[0]}: has no images with detections")
        self._detector = load_detector(self._settings)
        self._camera = PerceptionCamera(self._settings, name, self._detector.class_names)
        self._telemetry, self._history = CameraTelemetry(), StateHistory()
        self._limiters = RateLimiter(), RateLimiter()
        self._source, self._section = OneFrame(), ""
        self._pipeline: Pipeline | None = None
        self._timeline = timeline
        self._seen_ns: int | None = None
        self._clock_ns = self._tracks = 0
        self._found, self._overlap = DetectionReplay(model), list[float]()
        self._ids: tuple[set[int], set[int]] = (set(), set())
        self._ranges_m: list[float] = []
        self._depth_ns: int | None = None
        self._without_depth: set[int | None] = set()
        self._digest = hashlib.sha256()
        self._inexact: dict[str, None] = {}
        if restarts is not None:
            self._inexact[SAMPLES_INEXACT] = None
        if restarts:
            self._inexact[
                f"the perception process was restarted {restarts} times: its tracker began again, not here"
            ] = None

    def update(self, recorded: RecordedStep, seconds: float) -> dict[str, Any]:
        """Process the images that this step knew; returns the fields of its input that are replaced."""
        context, inputs = recorded.context, recorded.inputs
        self._add_samples(recorded)
        if context.camera != self._section:
            self._section = context.camera
            section = without_removed({"camera": json.loads(context.camera)}, [])["camera"]
            self._pipeline = self._new_pipeline(CameraSection.model_validate(section, strict=False))
        if inputs.seen_ns is not None and inputs.seen_ns != self._seen_ns:
            self._seen_ns = inputs.seen_ns
            self._found.frames += 1
            self._clock_ns = recorded.now_ns
            newest = self._camera.newest
            while self._next is not None and self._next.captured_ns <= inputs.seen_ns:
                self._process(self._next)
                self._next = next(self._frames, None)
            if self._camera.newest is not newest and self._newest_ns == inputs.seen_ns:
                self._compare_targets(inputs.targets, seconds)
        for target in inputs.targets:
            if (
                target.range_source is RangeSource.DEPTH
                and self._depth_ns != inputs.seen_ns == self._newest_ns
            ):
                self._without_depth.add(inputs.seen_ns)
            if target.class_name == TARGET_CLASS:
                self._inexact["an operator's selection in the images is not replayed"] = None
        return {
            "targets": self._camera.targets,
            "objects": self._camera.objects.objects,
            "seen_ns": self._newest_ns,
            "class_names": self._detector.class_names,
        }

    def result(self) -> tuple[DetectionReplay, list[str]]:
        """Return the comparison, and why the replay may differ although the model is the same."""
        found = self._found
        found.mean_iou = round(statistics.mean(self._overlap), 4) if self._overlap else None
        found.recorded_tracks, found.replayed_tracks = map(len, self._ids)
        found.digest = self._digest.hexdigest()
        if self._ranges_m:
            found.range_difference_m = (
                round(statistics.median(self._ranges_m), 3),
                round(max(self._ranges_m), 3),
            )
        missing = found.frames - found.images
        if missing > 0:
            self._inexact[f"{missing} of {found.frames} processed frames have no recorded image"] = None
        if found.depth_images:
            self._inexact[DEPTH_INEXACT] = None
        if count := len(self._without_depth):
            self._inexact[
                f"{count} images of frames with ranges from depth have no recorded depth image: these ranges "
                f"come from the ground or known heights"
            ] = None
        if "jpeg" in found.image_formats:
            scaled = " and scaled down" if found.scaled else ""
            self._inexact[f"the images are compressed with losses (JPEG){scaled}"] = None
        return found, list(self._inexact)

    @property
    def _newest_ns(self) -> int | None:
        return None if self._camera.newest is None else self._camera.newest.captured_ns

    def _add_samples(self, recorded: RecordedStep) -> None:
        """Let the tracker and ranging know the vehicle's attitudes, as `WorkerCamera.send_state` does."""
        samples = recorded.context.samples
        if recorded.inputs.standstill is not None:
            self._history.discard()
        self._history.extend(samples)
        for stamp_ns, attitude in samples.attitudes:
            if self._limiters[0].due(stamp_ns):
                self._telemetry.attitudes.add(stamp_ns, attitude)
        for stamp_ns, _ in samples.gimbal:
            if self._limiters[1].due(stamp_ns):
                with contextlib.suppress(HistoryError):
                    self._telemetry.gimbal.add(stamp_ns, self._history.gimbal_at(stamp_ns))

    def _new_pipeline(self, camera: CameraSection) -> Pipeline:
        settings = self._settings.model_copy(update={"camera": camera})
        self._camera.settings = settings
        return build_pipeline(
            settings,
            self._source,
            self._detector,
            self._telemetry,
            first_track_id=self._tracks + 1,
            clock_ns=lambda: self._clock_ns,
        )

    def _process(self, frame: DetectedFrame) -> None:
        message, image = frame.message, frame.image
        size = (message["width"], message["height"])
        if (image.shape[1], image.shape[0]) != size:
            self._found.scaled = True
            image = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR).astype(np.uint8, copy=False)
        if frame.image_format not in self._found.image_formats:
            self._found.image_formats.append(frame.image_format)
        self._found.recorded_model = message["model"]
        self._found.same_model = message["model_sha256"] == self._detector.model_sha256 is not None
        if frame.depth_m is not None:
            self._found.depth_images += 1
            self._depth_ns = frame.captured_ns
        self._source.frame = Frame(image, frame.captured_ns, message["sequence"], frame.depth_m)
        results: list[PerceptionResult] = []
        assert self._pipeline is not None
        self._pipeline.step(0.0, results.append)
        (result,) = results
        self._camera.update(result)
        self._camera.localize(result, self._history)
        self._compare_detections(message, result.detections.records())

    def _compare_detections(self, message: Any, new: list[DetectionRecord]) -> None:
        old, found = message["detections"], self._found
        compared = [{key: each[key] for key in _COMPARED} for each in new]  # type: ignore[literal-required]
        self._digest.update(dumps([message["captured_ns"], compared]))
        same_class = np.array([[a["class_name"] == b["class_name"] for b in new] for a in old], bool)
        iou = overlaps(_boxes([each["xyxy"] for each in old]), _boxes([each["xyxy"] for each in new]))
        pairs = match(np.where(same_class.reshape(iou.shape), iou, 0.0), LEAST_IOU)
        self._overlap += [float(iou[first, second]) for first, second in pairs]
        found.images += 1
        found.recorded += len(old)
        found.replayed += len(new)
        found.matched += len(pairs)
        found.identical_images += compared == [{key: each[key] for key in _COMPARED} for each in old]
        for ids, side in zip(self._ids, (old, new), strict=True):
            ids.update(each["track_id"] for each in side if each["track_state"] == TRACK_CONFIRMED)
        self._tracks = max([self._tracks, *(each["track_id"] or 0 for each in new)])
        if not len(pairs) == len(old) == len(new):
            found.differing_images += 1
            if len(found.listed) < MAX_LISTED:
                found.listed.append(
                    f"image {message['sequence']}: recorded {_words(old)}, replayed {_words(new)}"
                )

    def _compare_targets(self, recorded: tuple[Target, ...], seconds: float) -> None:
        """Note which trusted targets only one side has, and why the other does not."""
        replayed = self._camera.targets
        for target in recorded:
            if not target.trusted:
                continue
            pair, reason = _counterpart(target, replayed)
            if pair is None:
                key = ("recorded", target.class_name, target.track_id, reason.partition(" (")[0])
                self._timeline.add(key, seconds, f"{_name(target)}: in the replay {reason}")
            elif pair.position_ned_m is not None and target.position_ned_m is not None:
                self._ranges_m.append(abs(pair.ground_range_m - target.ground_range_m))
        for target in replayed:
            if target.trusted:
                pair, reason = _counterpart(target, recorded)
                if pair is None:
                    key = ("replayed", target.class_name, target.track_id, reason.partition(" (")[0])
                    text = f"{_name(target)} only in the replay: in the recording {reason}"
                    self._timeline.add(key, seconds, text)


def _counterpart(target: Target, others: Sequence[Target]) -> tuple[Target | None, str]:
    """The same object among the trusted ones of the other side; None: and why there is none."""
    boxes = _boxes([list(other.box_xyxy) for other in others])
    iou = overlaps(_boxes([list(target.box_xyxy)]), boxes)[0]
    covering = [others[index] for index in np.argsort(-iou, kind="stable") if iou[index] >= LEAST_IOU]
    same = [other for other in covering if other.class_name == target.class_name]
    for other in same:
        if other.trusted:
            return other, ""
    if same:
        return None, f"not confirmed, or its class is ambiguous (score {same[0].score:.2f})"
    if covering:
        return None, f"detected as {covering[0].class_name} (score {covering[0].score:.2f})"
    return None, "not detected"


def report(found: DetectionReplay) -> Iterator[str]:
    """Return the result as lines for people."""
    overlap = "" if found.mean_iou is None else f", mean IoU {found.mean_iou:.3f}"
    yield (
        f"{found.model}: {found.images} images: recorded {found.recorded} detections, replayed "
        f"{found.replayed}, matched {found.matched}{overlap}; differing images: {found.differing_images}; "
        f"identical: {found.identical_images}; with depth: {found.depth_images} "
        f"(SHA-256 of the detections {found.digest})"
    )
    yield f"confirmed tracks: recorded {found.recorded_tracks}, replayed {found.replayed_tracks}"
    if found.range_difference_m is not None:
        median_m, largest_m = found.range_difference_m
        yield f"ranges to targets of both differ by {median_m:g} m (median), {largest_m:g} m at most"
    if found.same_model:
        yield (
            "the model is that of the flight: what differs comes from the images, from what is not exact, or "
            "from another runtime or processor"
        )
    else:
        yield (
            "the model is not that of the flight. How much differs without a change of the model, a replay "
            f"with the flight's model shows: {found.recorded_model}"
        )
    yield from found.listed


def _as_in_flight(
    section: DetectorSection, threads: int, status: dict[str, Any], model: str
) -> DetectorSection:
    """Every image is processed, with the runtime and precision that `auto` selected in the flight.

    Selecting again may come out otherwise, and two replays would differ. A file of another kind than the
    flight's may need another runtime.
    """
    changes: dict[str, Any] = {"model": model, "rate_hz": None}
    changes["threads"] = section.threads or threads
    other_kind = kind_of(find_model(model)) != kind_of(find_model(section.model))
    if other_kind and section.runtime in (None, "auto", "torch"):
        return section.model_copy(update=changes | {"runtime": None})
    changes["runtime"] = section.runtime if section.runtime != "auto" else status.get("runtime")
    if section.precision == "auto" and (precision := status.get("precision", "float32")) in PRECISIONS:
        changes["precision"] = precision  # another one, such as int8, is the file's
    return section.model_copy(update=changes)


def _status(paths: Sequence[Path], camera: str | None) -> tuple[dict[str, Any], int | None]:
    """Return a camera's first recorded status with a loaded model, and how often its process was restarted.

    The status is empty without one; the number is None if no service published a status.
    """
    loaded: dict[str, Any] = {}
    restarts: list[int] = []
    for path in paths:
        for message in RecordingReader(path).messages(STATUS.name):
            body = json.loads(message.data)
            found: dict[str, Any] = body["perception"] if camera is None else body["cameras"].get(camera, {})
            if not loaded and found.get("runtime") is not None:
                loaded = found
            restarts.append(found.get("restarts", 0))
    return loaded, restarts[-1] - restarts[0] if restarts else None


def _boxes(boxes: list[list[float]]) -> NDArray[np.float64]:
    return np.array(boxes, np.float64).reshape(-1, 4)


def _name(target: Target) -> str:
    return target.class_name if target.track_id is None else f"{target.class_name} (track {target.track_id})"


def _words(detections: Sequence[Any]) -> str:
    return ", ".join(f"{each['class_name']} {each['confidence']:.2f}" for each in detections) or "nothing"
