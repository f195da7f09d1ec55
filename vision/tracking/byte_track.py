"""Track identities by ByteTrack's association, which uses every box, including low-confidence ones.

Y. Zhang et al., "ByteTrack: Multi-Object Tracking by Associating Every Detection Box", arXiv 2110.06864:
strong detections are associated with the predicted tracks first, the remaining tracks then with the weak
ones, which are mostly partly occluded objects. A weak detection that fits no track is background.

Differences from the paper: time is in seconds, not frames; camera rotation is compensated where it is known;
unmatched boxes are tried again enlarged, because small objects seen a few times a second hardly overlap
(F. Yang et al., "Hard to Track Objects with Irregular Motions and Similar Appearances", arXiv 2211.14317);
a track is confirmed only past a second threshold, on the median of its confidences; and a track keeps the
evidence for other classes on its object: a detector that alternates between classes is sure of neither.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from vision.detections import NO_TRACK, Detections
from vision.tracking import kalman
from vision.tracking.appearance import appearances
from vision.tracking.association import SAME_OBJECT_IOU, enlarge, match, overlaps
from vision.tracking.camera_motion import CameraView, rotate_boxes
from vision.tracking.kalman import BoxStates
from vision.tracking.tracks import (
    SCORES_KEPT,
    XYXY,
    ScoreHistory,
    Track,
    TrackerSettings,
    TrackEvent,
    TrackEventKind,
    TrackState,
)

logger = logging.getLogger(__name__)

Indices = NDArray[np.int64]
Looks = dict[int, NDArray[np.float32]]
"""Index of a detection → its appearance, see `appearances`."""

# How far boxes are enlarged for the second pass, in their own sizes. On rendered sequences 0.3 to 1.0 work
# equally well with the vehicle's attitude; without it, 0.6 has the fewest switches.
REACH = 0.6
# A track's class is in doubt while the summed confidences of another class on its object reach this share of
# its own. Of confirmed rendered tracks, 0.25, 0.5, 0.75 and 1.0 leave 142, 160, 169 and 172 of 174 of the
# right class, 77, 85, 90 and 94 of 114 of a wrong one. Sums decay as if only `SCORES_KEPT` frames counted.
RIVAL_SHARE = 0.5
# Least similarity of appearance of a box that continues a track after `GAP_S` without a detection, or whose
# box it overlaps only enlarged. In a street video, 99 % of the same object's had 0.935 or more, and four of
# five other objects at the predicted place less. Boxes with a side below `MIN_LOOK_PX` are too few pixels for
# that; rendered ones of 32 pixels lost tracks by it.
SAME_LOOK, MIN_LOOK_PX, GAP_S = 0.935, 48.0, 0.1
# Only so many of a frame's boxes, to limit the time: the largest, whose order changes least between frames.
MOST_LOOKS = 24
# Share of the newest detection in a track's appearance.
LOOK_SHARE = 0.3
_DECAY = 1.0 - 1.0 / SCORES_KEPT


@dataclass(frozen=True, slots=True, eq=False)
class TrackedFrame:
    """One frame's detections with their tracks, and the track events of this frame."""

    detections: Detections
    events: tuple[TrackEvent, ...]


@dataclass(slots=True, eq=False)
class _TrackRecord:
    """Data of one track besides its filter state."""

    track_id: int
    class_id: int
    first_ns: int
    last_ns: int
    seen: int = 0
    confidence: float = 0.0
    confirmed: bool = False
    lost: bool = False
    scores: ScoreHistory = field(default_factory=ScoreHistory)
    # Class id → sum of this class's confidences on the object.
    evidence: dict[int, float] = field(default_factory=dict)
    # See `appearances`; None without images.
    look: NDArray[np.float32] | None = None

    @property
    def class_in_doubt(self) -> bool:
        """Whether another class has about as much evidence, in this frame or earlier."""
        if len(self.evidence) < 2:
            return False
        rival = max(value for key, value in self.evidence.items() if key != self.class_id)
        return rival >= RIVAL_SHARE * self.evidence.get(self.class_id, 0.0)

    def add_detection(self, confidence: float, captured_ns: int) -> None:
        self.last_ns = captured_ns
        self.confidence = confidence
        self.seen += 1
        self.scores.add(confidence)
        self.lost = False

    def add_look(self, look: NDArray[np.float32] | None) -> None:
        """Add the appearance of a detection; None: it is too small."""
        if look is None:
            return
        mixed = look if self.look is None else (1 - LOOK_SHARE) * self.look + LOOK_SHARE * look
        self.look = mixed / np.linalg.norm(mixed)


class Tracker:
    """Tracks objects from frame to frame. `update` expects every frame's detections, weak ones included.

    Args:
        settings: thresholds and times.
        first_track_id: id of the first track; later ones count up.

    >>> import numpy as np
    >>> from vision import Detections, Tracker
    >>> found = Detections(
    ...     np.array([[10, 20, 50, 60], [70, 20, 90, 40]], np.float32),
    ...     np.array([0.9, 0.4], np.float32),
    ...     np.array([1, 0]),
    ...     ("person", "car"),
    ... )
    >>> tracker = Tracker()
    >>> frames = [tracker.update(found, captured_ns=index * 100_000_000) for index in range(5)]
    >>> frames[-1].detections.track_id.tolist(), frames[-1].detections.track_confirmed.tolist()
    ([1, 2], [True, True])
    """

    def __init__(self, settings: TrackerSettings | None = None, *, first_track_id: int = 1) -> None:
        if first_track_id < 1:
            raise ValueError(f"first_track_id must be at least 1, got {first_track_id}")
        self.settings = settings or TrackerSettings()
        self._next_id = first_track_id
        self._states = BoxStates.none()
        self._records: list[_TrackRecord] = []
        self._newest_ns: int | None = None
        self._before_ns = 0
        self._warned_frame_rate = False
        self._view: CameraView | None = None
        self._class_names: tuple[str, ...] = ()

    @property
    def tracks(self) -> tuple[Track, ...]:
        """All tracks, lost ones included, with their estimated boxes at the newest frame."""
        boxes = self._states.xyxy.tolist()
        return tuple(
            self._track(record, (left, top, right, bottom))
            for record, (left, top, right, bottom) in zip(self._records, boxes, strict=True)
        )

    def take_id(self) -> int:
        """Reserve an id for a track that is made elsewhere."""
        self._next_id += 1
        return self._next_id - 1

    def update(
        self,
        detections: Detections,
        captured_ns: int,
        view: CameraView | None = None,
        image: NDArray[np.uint8] | None = None,
    ) -> TrackedFrame:
        """Process one frame.

        Args:
            detections: of this frame, down to the settings' `low_confidence`; always from one model.
            captured_ns: capture stamp, nanoseconds; any monotonic clock.
            view: camera orientation at the capture, in NED. The rotation between two frames is compensated
                when both are known.
            image: (height, width, 3) uint8, BGR; with it, a large box that looks different does not continue
                a track that was not detected in the previous frame, or whose box it does not overlap.

        Returns:
            The detections in their order, each with its track. Those below `keep_confidence` without a track
            are dropped.
        """
        self._class_names = detections.class_names
        events: list[TrackEvent] = []
        self._predict(captured_ns, view, events)
        confidence, class_id = detections.confidence, detections.class_id
        boxes: list[list[float]] = detections.xyxy.tolist()
        track_of = np.full(len(detections), -1)
        looks = None if image is None else _looks(image, detections)
        self._associate(detections, captured_ns, track_of, looks)
        records: dict[int, _TrackRecord] = {}
        matched = np.flatnonzero(track_of >= 0)
        tracks = track_of[matched]
        if len(matched):
            updated = kalman.correct(self._states[tracks], detections.xyxy[matched])
            self._states.mean[tracks], self._states.covariance[tracks] = updated.mean, updated.covariance
        estimated = self._states.xyxy
        estimated[tracks] = detections.xyxy[matched]
        self._update_class_evidence(self._records, estimated, detections)
        for index, track in zip(matched.tolist(), tracks.tolist(), strict=True):
            records[index] = record = self._records[track]
            record.add_detection(float(confidence[index]), captured_ns)
            if looks is not None and confidence[index] >= self.settings.high_confidence:
                record.add_look(looks.get(index))
            self._on_detected(record, boxes[index], captured_ns, events)
        new = np.flatnonzero((track_of < 0) & (confidence >= self.settings.high_confidence))
        on_object = overlaps(detections.xyxy[new], estimated)
        known = [record.evidence for record in self._records]
        self._update_undetected(captured_ns, events)
        for row, index in enumerate(new.tolist()):
            record = _TrackRecord(self._next_id, int(class_id[index]), captured_ns, captured_ns)
            self._next_id += 1
            record.add_detection(float(confidence[index]), captured_ns)
            if looks is not None:
                record.add_look(looks.get(index))
            if known and on_object[row].max() >= SAME_OBJECT_IOU:
                # The same object under another class: its earlier evidence applies to this track too.
                record.evidence = dict(known[int(on_object[row].argmax())])
            else:
                self._update_class_evidence([record], detections.xyxy[[index]], detections)
            self._on_detected(record, boxes[index], captured_ns, events)
            self._records.append(record)
            records[index] = record
        if len(new):
            self._states = self._states.joined(kalman.initiate(detections.xyxy[new]))
        return TrackedFrame(self._with_tracks(detections, records), tuple(events))

    def _predict(self, captured_ns: int, view: CameraView | None, events: list[TrackEvent]) -> None:
        """Predict every box to this frame; end tracks that are too old or out of view."""
        before_ns, before = self._newest_ns, self._view
        self._before_ns = before_ns or 0
        self._newest_ns, self._view = captured_ns, view
        if before_ns is None or not self._records:
            return
        # An undetected box keeps its size: a partly occluded box shrinks, and the rate would continue.
        unseen = np.array([record.last_ns != before_ns for record in self._records])
        self._states.mean[unseen, 6:] = 0.0
        states = kalman.predict(self._states, (captured_ns - before_ns) / 1e9)
        ended = np.array(
            [captured_ns - record.last_ns >= self.settings.max_age_s * 1e9 for record in self._records]
        )
        self._warn_frame_rate(bool((ended & ~unseen).any()), (captured_ns - before_ns) / 1e9)
        if view is not None and before is not None and view.camera == before.camera:
            states, visible = rotate_boxes(states, view.camera, view.turn_from(before))
            ended |= ~visible
        self._states = states
        self._drop(ended, captured_ns, events)

    def _warn_frame_rate(self, ended_though_seen: bool, interval_s: float) -> None:
        """Warn once that the frame interval is longer than `max_age_s`."""
        if ended_though_seen and not self._warned_frame_rate:
            self._warned_frame_rate = True
            logger.warning(
                "tracks end between two frames: interval %.1f s, max_age_s %g s; process more frames "
                "(every, rate_hz, a faster model) or raise max_age_s",
                interval_s,
                self.settings.max_age_s,
            )

    def _associate(
        self, detections: Detections, captured_ns: int, track_of: Indices, looks: Looks | None
    ) -> None:
        """Fill in `track_of` (N,): the index of each detection's track."""
        if not len(detections) or not self._records:
            return
        settings = self.settings
        strong = detections.confidence >= settings.high_confidence
        weak = ~strong & (detections.confidence >= settings.low_confidence)
        # A box seen once may be a false detection: it is matched after the others.
        known = np.array([record.seen > 1 or record.confirmed for record in self._records])
        recent = np.array(
            [captured_ns - record.last_ns < settings.coast_timeout_s * 1e9 for record in self._records]
        )
        class_ids = np.array([record.class_id for record in self._records])
        predicted, same_class = self._states.xyxy, class_ids[:, None] == detections.class_id
        alike = np.ones_like(same_class) if looks is None else self._look_alike(detections, looks)
        # After a gap the predicted box fits many objects.
        gap = np.array(
            [
                record.last_ns < self._before_ns and captured_ns - record.last_ns > GAP_S * 1e9
                for record in self._records
            ]
        )
        free = np.ones(len(self._records), np.bool_)
        for of_tracks, of_detections, least, reach in (
            (known, strong, settings.min_iou, 0.0),
            (known & recent, weak, settings.min_iou_weak, 0.0),
            (known, strong, settings.min_iou, REACH),
            (~known, strong, settings.min_iou, 0.0),
            (~known, strong, settings.min_iou, REACH),
        ):
            rows = (of_tracks & free).nonzero()[0]
            columns = (of_detections & (track_of < 0)).nonzero()[0]
            if not len(rows) or not len(columns):
                continue
            similarity = overlaps(enlarge(predicted[rows], reach), enlarge(detections.xyxy[columns], reach))
            similarity *= same_class[rows[:, None], columns]
            similarity *= alike[rows[:, None], columns] | ((reach == 0.0) & ~gap[rows, None])
            for row, column in match(similarity, least):
                track_of[columns[column]] = rows[row]
                free[rows[row]] = False

    def _look_alike(self, detections: Detections, looks: Looks) -> NDArray[np.bool_]:
        """(tracks, detections): whether it may be the same object by its appearance."""
        alike = np.ones((len(self._records), len(detections)), np.bool_)
        for row, record in enumerate(self._records):
            if record.look is not None:
                for column, look in looks.items():
                    alike[row, column] = look @ record.look >= SAME_LOOK
        return alike

    def _update_class_evidence(
        self, records: Sequence[_TrackRecord], boxes: NDArray[np.floating], detections: Detections
    ) -> None:
        """Add this frame's class confidences on each track's object to its evidence.

        Args:
            boxes: (N, 4) of the tracks: the detected box where there is one, else the predicted one.
        """
        on_object = overlaps(boxes, detections.xyxy) >= SAME_OBJECT_IOU
        on_object &= detections.confidence >= self.settings.low_confidence
        class_ids, confidences = detections.class_id.tolist(), detections.confidence.tolist()
        best_by_track: dict[int, dict[int, float]] = {}  # track index → class id → confidence
        for track, index in np.argwhere(on_object).tolist():
            best = best_by_track.setdefault(track, {})
            best[class_ids[index]] = max(confidences[index], best.get(class_ids[index], 0.0))
        for track, best in best_by_track.items():
            evidence = records[track].evidence
            for key in evidence:
                evidence[key] *= _DECAY
            for key, value in best.items():
                evidence[key] = evidence.get(key, 0.0) + value

    def _on_detected(
        self, record: _TrackRecord, xyxy: list[float], captured_ns: int, events: list[TrackEvent]
    ) -> None:
        kind = TrackEventKind.UPDATE
        if not record.confirmed:
            settings = self.settings
            if record.seen < settings.min_hits or record.scores.median < settings.confirm_score:
                return
            if record.class_in_doubt:
                return
            record.confirmed = True
            kind = TrackEventKind.NEW
        left, top, right, bottom = xyxy
        events.append(TrackEvent(kind, captured_ns, self._track(record, (left, top, right, bottom))))

    def _update_undetected(self, captured_ns: int, events: list[TrackEvent]) -> None:
        rejected = np.zeros(len(self._records), np.bool_)
        for index, record in enumerate(self._records):
            if record.last_ns == captured_ns:
                continue
            unseen_s = (captured_ns - record.last_ns) / 1e9
            if not record.confirmed:
                # A tentative track ends unless one of the next frames confirms it.
                rejected[index] = record.seen == 1 or unseen_s >= self.settings.coast_timeout_s
            elif unseen_s >= self.settings.coast_timeout_s and not record.lost:
                record.lost = True
                events.append(self._event(TrackEventKind.LOST, index, captured_ns))
        self._drop(rejected, captured_ns, events)

    def _drop(self, ended: NDArray[np.bool_], captured_ns: int, events: list[TrackEvent]) -> None:
        if not ended.any():
            return
        for index in np.flatnonzero(ended).tolist():
            if self._records[index].confirmed:
                events.append(self._event(TrackEventKind.END, index, captured_ns))
        self._records = [record for record, gone in zip(self._records, ended, strict=True) if not gone]
        self._states = self._states[~ended]

    def _event(self, kind: TrackEventKind, index: int, captured_ns: int) -> TrackEvent:
        left, top, right, bottom = self._states.xyxy[index].tolist()
        return TrackEvent(kind, captured_ns, self._track(self._records[index], (left, top, right, bottom)))

    def _track(self, record: _TrackRecord, xyxy: XYXY) -> Track:
        return Track(
            track_id=record.track_id,
            class_id=record.class_id,
            class_name=self._class_names[record.class_id],
            state=TrackState.CONFIRMED if record.confirmed else TrackState.TENTATIVE,
            xyxy=xyxy,
            confidence=record.confidence,
            score=record.scores.median,
            seen=record.seen,
            first_ns=record.first_ns,
            last_ns=record.last_ns,
        )

    def _with_tracks(self, detections: Detections, records: dict[int, _TrackRecord]) -> Detections:
        of_each = [records.get(index) for index in range(len(detections))]
        track_id = np.array([NO_TRACK if record is None else record.track_id for record in of_each], np.int64)
        score = np.array(
            [math.nan if record is None else record.scores.median for record in of_each], np.float32
        )
        confirmed = np.array(
            [record is not None and record.confirmed and not record.class_in_doubt for record in of_each],
            np.bool_,
        )
        first_ns = np.array([0 if record is None else record.first_ns for record in of_each], np.int64)
        labelled = replace(
            detections,
            track_id=track_id,
            track_score=score,
            track_confirmed=confirmed,
            track_first_ns=first_ns,
        )
        kept = (track_id != NO_TRACK) | (detections.confidence >= self.settings.keep_confidence)
        return labelled if kept.all() else labelled[kept]


def _looks(image: NDArray[np.uint8], detections: Detections) -> Looks:
    """The appearances of those that are large enough, at most `MOST_LOOKS`."""
    sides = (detections.xyxy[:, 2:] - detections.xyxy[:, :2]).min(axis=1)
    largest = np.argsort(-sides, kind="stable")[:MOST_LOOKS]
    large = largest[sides[largest] >= MIN_LOOK_PX]
    return dict(zip(large.tolist(), appearances(image, detections.xyxy[large]), strict=True))
