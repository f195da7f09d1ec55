"""The object that an operator has selected by a rectangle in an image.

If a confirmed track's detection covers the rectangle, that track is meant. Else correlation filters follow
the rectangle's content (`correlation_filter`), and it becomes a track of class `target` with its own id. It
follows the rules of the other tracks: lost after `coast_timeout_s` without a match, ended after `max_age_s`.
Between frames it is predicted as they are, the camera's rotation compensated where it is known.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.detections import NO_TRACK, Detections
from vision.frame import Frame
from vision.tracking import kalman
from vision.tracking.association import overlaps
from vision.tracking.byte_track import TrackedFrame
from vision.tracking.camera_motion import CameraView, rotate_boxes
from vision.tracking.correlation_filter import Box, CorrelationFilter, Gray
from vision.tracking.kalman import BoxStates
from vision.tracking.tracks import (
    ScoreHistory,
    Track,
    TrackerSettings,
    TrackEvent,
    TrackEventKind,
    TrackState,
)

TARGET_CLASS = "target"
"""The class name of a selected object that is no detection."""

# A detection covers a rectangle from this IoU on, the usual limit for one object (PASCAL VOC, CLEAR MOT). Of
# rectangles whose edges are off by 10 % of the sides (one sigma), 99 % reach it; by 15 %, 88 %.
SAME_OBJECT_IOU = 0.5
# The images of this time are kept, shrunk to this side: a person's rectangle belongs to an earlier image.
HISTORY_S, MAX_SIDE_PX, MAX_HISTORY = 1.0, 1280, 40
# The rectangle's image is the nearest one to its stamp, at most this far off.
STAMP_TOLERANCE_NS = 200_000_000
# Smallest rectangle, pixels of the shrunk image; smallest standard deviation of its gray values.
MIN_SIDE_PX, MIN_CONTRAST = 8.0, 3.0
# Peak-to-sidelobe ratios: below the first the object is not seen, or below this share of its usual ratio.
# Below the larger share it is not learned: something may be in front of it. Rendered objects have ratios of
# 20 to 50 (5 % below 12), places without the object 4 to 9. Of 50 objects on seeds other than the published
# ones, these shares follow something else in 0.1 % of the frames, 0.42 and 0.6 in 3 %, 0.35 and 0.5 in 13 %;
# all keep an object about as long (7 of 10 s, mean).
LEAST_RATIO, SEEN_SHARE, LEARNED_SHARE = 7.0, 0.5, 0.7
# The usual ratio rises faster than it falls, so that it stays high while the object is slowly hidden.
USUAL_RATIO, USUAL_RISE, USUAL_FALL = 20.0, 0.05, 0.01
FULL_CONFIDENCE_RATIO = 20.0


@dataclass(frozen=True, slots=True)
class SelectRequest:
    """A rectangle in an image: fractions of its width and height, from the upper left corner.

    Attributes:
        rectangle: left, top, width, height; None: end the selection.
        stamp_ns: capture stamp of the image; None: the newest.
    """

    rectangle: tuple[float, float, float, float] | None
    stamp_ns: int | None = None


@dataclass(frozen=True, slots=True)
class Selected:
    """The answer to a request.

    Attributes:
        success: as requested. reason: what was done, or why not; one line.
        track_id, class_name: of the track; None: there is none.
    """

    success: bool
    reason: str
    track_id: int | None = None
    class_name: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class _Image:
    """A processed frame: gray and shrunk by `scale`, with its detections."""

    captured_ns: int
    gray: Gray
    scale: float
    detections: Detections
    view: CameraView | None

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the frame, pixels."""
        return self.gray.shape[1] / self.scale, self.gray.shape[0] / self.scale


@dataclass(slots=True, eq=False)
class _Target:
    """The followed rectangle; boxes in the frame's pixels."""

    track_id: int
    follower: CorrelationFilter
    states: BoxStates
    image: _Image
    first_ns: int
    last_ns: int
    seen: int = 1
    confidence: float = 1.0
    lost: bool = False
    usual_ratio: float = USUAL_RATIO
    scores: ScoreHistory = field(default_factory=ScoreHistory)

    def follow(self, image: _Image) -> bool:
        """Find it in the next image; whether it is seen."""
        before, self.image = self.image, image
        if self.last_ns != before.captured_ns:
            self.states.mean[:, 6:] = 0.0  # an unseen box keeps its size
        self.states = kalman.predict(self.states, (image.captured_ns - before.captured_ns) / 1e9)
        if image.view is not None and before.view is not None and image.view.camera == before.view.camera:
            turn = image.view.turn_from(before.view)
            self.states, _ = rotate_boxes(self.states, image.view.camera, turn)
        expected = self.states.xyxy[0] * image.scale
        if not _usable(expected, image):
            return False
        match = self.follower.search(image.gray, _edges(expected))
        found = np.array(match.box)
        if match.ratio < max(LEAST_RATIO, SEEN_SHARE * self.usual_ratio) or not _usable(found, image):
            return False
        if match.ratio >= LEARNED_SHARE * self.usual_ratio:
            self.follower.learn()
            more = match.ratio - self.usual_ratio
            self.usual_ratio += (USUAL_RISE if more > 0.0 else USUAL_FALL) * more
        self.states = kalman.correct(self.states, found[None] / image.scale)
        self.last_ns, self.seen, self.lost = image.captured_ns, self.seen + 1, False
        self.confidence = min(1.0, match.ratio / FULL_CONFIDENCE_RATIO)
        self.scores.add(self.confidence)
        return True

    @property
    def xyxy(self) -> NDArray[np.float32]:
        """(4,) inside the frame."""
        width, height = self.image.size
        edges: NDArray[np.float64] = np.clip(self.states.xyxy[0], 0.0, [width, height, width, height])
        return edges.astype(np.float32)

    def event(self, kind: TrackEventKind, class_id: int) -> TrackEvent:
        track = Track(
            self.track_id,
            class_id,
            TARGET_CLASS,
            TrackState.CONFIRMED,
            _edges(self.xyxy),
            self.confidence,
            self.scores.median,
            self.seen,
            self.first_ns,
            self.last_ns,
        )
        return TrackEvent(kind, self.image.captured_ns, track)


class ObjectSelection:
    """The selected object of one camera; there is at most one.

    Args:
        settings: of the tracker.
        take_id: reserves the id of a new track.
    """

    def __init__(self, settings: TrackerSettings, take_id: Callable[[], int]) -> None:
        self._settings, self._take_id = settings, take_id
        self._images: deque[_Image] = deque(maxlen=MAX_HISTORY)
        self._target: _Target | None = None
        self._requests: list[SelectRequest] = []
        self._answers: list[Selected] = []

    def request(self, request: SelectRequest) -> None:
        """Select, with the next frame; that ends the selection before."""
        self._requests.append(request)

    def take_answers(self) -> list[Selected]:
        """The answers since the last call, in the order of the requests."""
        answers, self._answers = self._answers, []
        return answers

    def update(self, frame: Frame, tracked: TrackedFrame, view: CameraView | None) -> TrackedFrame:
        """Process one frame, after the tracker; returns its result with the selected object's."""
        self._images.append(_shrunk(frame, tracked.detections, view))
        while frame.captured_ns - self._images[0].captured_ns > HISTORY_S * 1e9:
            self._images.popleft()
        class_id = len(tracked.detections.class_names)
        events = list(tracked.events)
        seen = self._target is not None and self._follow(self._target, class_id, events)
        requests, self._requests = self._requests, []
        for request in requests:
            ended = self._target
            if ended is not None:
                events.append(ended.event(TrackEventKind.END, class_id))
            self._target, seen = None, False
            answer = self._select(request, ended)
            self._answers.append(answer)
            if self._target is not None:
                seen = self._target.last_ns == frame.captured_ns
                events.append(self._target.event(TrackEventKind.NEW, class_id))
        detections = tracked.detections
        if self._target is not None and seen:
            detections = _with_target(detections, self._target)
        return TrackedFrame(detections, tuple(events))

    def _follow(self, target: _Target, class_id: int, events: list[TrackEvent]) -> bool:
        """One frame of the selected object; whether it is seen."""
        if target.follow(self._images[-1]):
            events.append(target.event(TrackEventKind.UPDATE, class_id))
            return True
        unseen_s = (target.image.captured_ns - target.last_ns) / 1e9
        if unseen_s >= self._settings.max_age_s:
            events.append(target.event(TrackEventKind.END, class_id))
            self._target = None
        elif unseen_s >= self._settings.coast_timeout_s and not target.lost:
            target.lost = True
            events.append(target.event(TrackEventKind.LOST, class_id))
        return False

    def _select(self, request: SelectRequest, ended: _Target | None) -> Selected:
        """Begin what a request says; sets the target where it is no detection."""
        if request.rectangle is None:
            done = "nothing was selected" if ended is None else f"track {ended.track_id} ended"
            return Selected(True, done)
        image = self._images[-1]
        if request.stamp_ns is not None:
            stamp_ns = request.stamp_ns
            image = min(self._images, key=lambda one: abs(one.captured_ns - stamp_ns))
            if abs(image.captured_ns - stamp_ns) > STAMP_TOLERANCE_NS:
                off_s = (self._images[-1].captured_ns - stamp_ns) / 1e9
                return Selected(
                    False,
                    f"no image of stamp_ns {stamp_ns}: it is {off_s:.1f} s before the newest, "
                    f"the last {HISTORY_S:g} s are kept; select in a newer image",
                )
        width, height = image.size
        left, top, across, down = request.rectangle
        box = np.array([left * width, top * height, (left + across) * width, (top + down) * height])
        covered = _covering(image.detections, box)
        if covered is not None:
            track_id, class_name = covered
            return Selected(True, f"track {track_id}, a {class_name}, is there", track_id, class_name)
        scaled = box * image.scale
        if min(scaled[2] - scaled[0], scaled[3] - scaled[1]) < MIN_SIDE_PX:
            least = MIN_SIDE_PX / image.scale
            found = f"{across * width:.0f} by {down * height:.0f} pixels"
            return Selected(False, f"the rectangle has {found}, expected {least:.0f} by {least:.0f} or more")
        inside = image.gray[round(scaled[1]) : round(scaled[3]), round(scaled[0]) : round(scaled[2])]
        if float(inside.std()) < MIN_CONTRAST:
            return Selected(False, "the rectangle shows an even surface; include an edge or a pattern")
        follower = CorrelationFilter(image.gray, _edges(scaled))
        stamp_ns = image.captured_ns
        target = _Target(self._take_id(), follower, kalman.initiate(box[None]), image, stamp_ns, stamp_ns)
        target.scores.add(target.confidence)
        for later in self._images:
            if later.captured_ns > stamp_ns:
                target.follow(later)
        unseen_s = (target.image.captured_ns - target.last_ns) / 1e9
        if unseen_s >= self._settings.coast_timeout_s:
            return Selected(False, f"the selected object is not seen any more, for {unseen_s:.1f} s")
        self._target = target
        return Selected(True, f"track {target.track_id}, a {TARGET_CLASS}", target.track_id, TARGET_CLASS)


def _shrunk(frame: Frame, detections: Detections, view: CameraView | None) -> _Image:
    image, scale = frame.image, min(1.0, MAX_SIDE_PX / max(frame.width, frame.height))
    if scale < 1.0:
        size = (round(frame.width * scale), round(frame.height * scale))
        image = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)  # type: ignore[assignment]
    gray: Gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)  # type: ignore[assignment]
    return _Image(frame.captured_ns, gray, scale, detections, view)


def _covering(detections: Detections, box: NDArray[np.float64]) -> tuple[int, str] | None:
    """Id and class of the confirmed track whose detection covers a box."""
    if detections.track_id is None or detections.track_confirmed is None or not len(detections):
        return None
    iou = overlaps(box[None], detections.xyxy)[0]
    iou[(detections.track_id == NO_TRACK) | ~detections.track_confirmed] = 0.0
    best = int(iou.argmax())
    if iou[best] < SAME_OBJECT_IOU:
        return None
    return int(detections.track_id[best]), detections.names[best]


def _with_target(detections: Detections, target: _Target) -> Detections:
    """The detections and the selected object; its class is behind those of the model."""
    assert detections.track_id is not None
    assert detections.track_score is not None
    assert detections.track_confirmed is not None
    assert detections.track_first_ns is not None
    return replace(
        detections,
        xyxy=np.concatenate([detections.xyxy, target.xyxy[None]]),
        confidence=np.append(detections.confidence, np.float32(target.confidence)),
        class_id=np.append(detections.class_id, len(detections.class_names)),
        class_names=(*detections.class_names, TARGET_CLASS),
        nearest_camera_m=np.concatenate([detections.nearest_camera_m, np.full((1, 3), math.nan, np.float32)]),
        middle_px=np.append(detections.middle_px, np.float32(math.nan)),
        track_id=np.append(detections.track_id, target.track_id),
        track_score=np.append(detections.track_score, np.float32(target.scores.median)),
        track_confirmed=np.append(detections.track_confirmed, True),
        track_first_ns=np.append(detections.track_first_ns, np.int64(target.first_ns)),
    )


def _usable(box: NDArray[np.floating], image: _Image) -> bool:
    """Whether a box (pixels of the gray image) is large enough and its centre inside."""
    height, width = image.gray.shape
    x, y = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
    large = min(box[2] - box[0], box[3] - box[1]) >= MIN_SIDE_PX / 2
    return bool(large and 0 <= x < width and 0 <= y < height)


def _edges(box: NDArray[np.floating]) -> Box:
    left, top, right, bottom = (float(edge) for edge in box)
    return left, top, right, bottom
