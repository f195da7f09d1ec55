"""Track identities by ByteTrack's association: every box counts, the weak ones too.

Y. Zhang et al., "ByteTrack: Multi-Object Tracking by Associating Every Detection Box", arXiv 2110.06864: the
strong detections are associated with the predicted tracks first; what is left of the tracks then with the
weak ones, which are mostly objects half hidden. A weak one that fits no track is background.

Beyond the paper: time is in seconds and not in frames; the camera's rotation is removed where it is known;
what is left over is tried again with larger boxes, as small objects seen a few times a second hardly overlap
(F. Yang et al., "Hard to Track Objects with Irregular Motions and Similar Appearances", arXiv 2211.14317);
a track counts as true only past a second threshold, on the median of its confidences; and it remembers what
else its object was called: a detector that changes its mind is not sure of either class.
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
from vision.tracking.association import grown, match, overlaps
from vision.tracking.camera_motion import CameraView, turned
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

# How far boxes are grown for the second try, in their own sizes. On rendered sequences anything from 0.3 to
# 1.0 serves with the vehicle's attitude; without it, 0.6 has the fewest switches.
REACH = 0.6
# Boxes of two classes that overlap by so much are of one object; those of a rider and the bicycle do not.
SAME_OBJECT_IOU = 0.7
# A track's class is in doubt while the confidences of another class on its object sum up to this share of its
# own. Of rendered tracks that counted as true, 0.25, 0.5, 0.75 and 1.0 leave 142, 160, 169 and 172 of 174 of
# the right class, 77, 85, 90 and 94 of 114 of a wrong one. Sums fade as if only `SCORES_KEPT` frames counted.
RIVAL_SHARE = 0.5
_KEPT = 1.0 - 1.0 / SCORES_KEPT


@dataclass(frozen=True, slots=True, eq=False)
class TrackedFrame:
    """One frame's detections with their tracks, and what happened to tracks at this frame."""

    detections: Detections
    events: tuple[TrackEvent, ...]


@dataclass(slots=True, eq=False)
class _Life:
    """What is known of one track besides its box's state."""

    track_id: int
    class_id: int
    first_ns: int
    last_ns: int
    seen: int = 0
    confidence: float = 0.0
    confirmed: bool = False
    lost: bool = False
    scores: ScoreHistory = field(default_factory=ScoreHistory)
    # Class id → confidences of this class on the object, summed up.
    evidence: dict[int, float] = field(default_factory=dict)

    @property
    def class_in_doubt(self) -> bool:
        """Another class was given to the object about as surely, in this frame or before."""
        if len(self.evidence) < 2:
            return False
        rival = max(value for key, value in self.evidence.items() if key != self.class_id)
        return rival >= RIVAL_SHARE * self.evidence.get(self.class_id, 0.0)

    def see(self, confidence: float, captured_ns: int) -> None:
        self.last_ns = captured_ns
        self.confidence = confidence
        self.seen += 1
        self.scores.add(confidence)
        self.lost = False


class Tracker:
    """Follows objects from frame to frame. Give it every frame's detections, the weak ones too.

    Args:
        settings: thresholds and times.
        first_track_id: the first track's; they count up from there.
    """

    def __init__(self, settings: TrackerSettings | None = None, *, first_track_id: int = 1) -> None:
        if first_track_id < 1:
            raise ValueError(f"first_track_id must be at least 1, got {first_track_id}")
        self.settings = settings or TrackerSettings()
        self._next_id = first_track_id
        self._states = BoxStates.none()
        self._lives: list[_Life] = []
        self._newest_ns: int | None = None
        self._warned_of_pace = False
        self._view: CameraView | None = None
        self._class_names: tuple[str, ...] = ()

    @property
    def tracks(self) -> tuple[Track, ...]:
        """All that are followed, the lost ones too, with their boxes as believed at the newest frame."""
        boxes = self._states.xyxy.tolist()
        return tuple(
            self._track(life, (left, top, right, bottom))
            for life, (left, top, right, bottom) in zip(self._lives, boxes, strict=True)
        )

    def update(
        self, detections: Detections, captured_ns: int, view: CameraView | None = None
    ) -> TrackedFrame:
        """Take one frame.

        Args:
            detections: of this frame, down to the settings' `low_confidence`; all of one model.
            captured_ns: when the frame was captured, nanoseconds; any clock that only goes forward.
            view: where the camera looked then, in NED. Its rotation is removed between two frames of which
                both are known.

        Returns:
            The detections in their order, each with its track. Those weaker than `keep_confidence` that
            belong to no track are left out.
        """
        self._class_names = detections.class_names
        events: list[TrackEvent] = []
        self._predict(captured_ns, view, events)
        confidence, class_id = detections.confidence, detections.class_id
        boxes: list[list[float]] = detections.xyxy.tolist()
        track_of = np.full(len(detections), -1)
        self._associate(detections, captured_ns, track_of)
        lives: dict[int, _Life] = {}
        chosen = np.flatnonzero(track_of >= 0)
        tracks = track_of[chosen]
        if len(chosen):
            seen = kalman.corrected(self._states[tracks], detections.xyxy[chosen])
            self._states.mean[tracks], self._states.covariance[tracks] = seen.mean, seen.covariance
        believed = self._states.xyxy
        believed[tracks] = detections.xyxy[chosen]
        self._weigh_classes(self._lives, believed, detections)
        for index, track in zip(chosen.tolist(), tracks.tolist(), strict=True):
            lives[index] = life = self._lives[track]
            life.see(float(confidence[index]), captured_ns)
            self._update_seen(life, boxes[index], captured_ns, events)
        begun = np.flatnonzero((track_of < 0) & (confidence >= self.settings.high_confidence))
        on_object = overlaps(detections.xyxy[begun], believed)
        known = [life.evidence for life in self._lives]
        self._forget_unseen(captured_ns, events)
        for row, index in enumerate(begun.tolist()):
            life = _Life(self._next_id, int(class_id[index]), captured_ns, captured_ns)
            self._next_id += 1
            life.see(float(confidence[index]), captured_ns)
            if known and on_object[row].max() >= SAME_OBJECT_IOU:
                # The same object under another name: what it was called before is known of this track too.
                life.evidence = dict(known[int(on_object[row].argmax())])
            else:
                self._weigh_classes([life], detections.xyxy[[index]], detections)
            self._update_seen(life, boxes[index], captured_ns, events)
            self._lives.append(life)
            lives[index] = life
        if len(begun):
            self._states = self._states.joined(kalman.begun(detections.xyxy[begun]))
        return TrackedFrame(self._labelled(detections, lives), tuple(events))

    def _predict(self, captured_ns: int, view: CameraView | None, events: list[TrackEvent]) -> None:
        """Move every box to where it should be by now; end those that cannot be there any more."""
        before_ns, before = self._newest_ns, self._view
        self._newest_ns, self._view = captured_ns, view
        if before_ns is None or not self._lives:
            return
        # What was not seen keeps its size: a box half hidden shrinks, and would go on shrinking.
        unseen = np.array([life.last_ns != before_ns for life in self._lives])
        self._states.mean[unseen, 6:] = 0.0
        states = kalman.predicted(self._states, (captured_ns - before_ns) / 1e9)
        ended = np.array(
            [captured_ns - life.last_ns >= self.settings.max_age_s * 1e9 for life in self._lives]
        )
        self._warn_of_rate(bool((ended & ~unseen).any()), (captured_ns - before_ns) / 1e9)
        if view is not None and before is not None and view.camera == before.camera:
            states, visible = turned(states, view.camera, view.turn_from(before))
            ended |= ~visible
        self._states = states
        self._drop(ended, captured_ns, events)

    def _warn_of_rate(self, ended_though_seen: bool, interval_s: float) -> None:
        """Say once that frames are too far apart for anything to be followed from one to the next."""
        if ended_though_seen and not self._warned_of_pace:
            self._warned_of_pace = True
            logger.warning(
                "tracks end between two frames: %.1f s passed, and max_age_s is %g s; look at more frames "
                "(every, rate_hz, a faster model), or raise max_age_s",
                interval_s,
                self.settings.max_age_s,
            )

    def _associate(self, detections: Detections, captured_ns: int, track_of: Indices) -> None:
        """Fill in `track_of` (N,): the place of each detection's track."""
        if not len(detections) or not self._lives:
            return
        settings = self.settings
        strong = detections.confidence >= settings.high_confidence
        weak = ~strong & (detections.confidence >= settings.low_confidence)
        # A box seen once may be a mistake: it gets only what the others leave.
        known = np.array([life.seen > 1 or life.confirmed for life in self._lives])
        recent = np.array(
            [captured_ns - life.last_ns < settings.coast_timeout_s * 1e9 for life in self._lives]
        )
        class_ids = np.array([life.class_id for life in self._lives])
        predicted, same_class = self._states.xyxy, class_ids[:, None] == detections.class_id
        free = np.ones(len(self._lives), np.bool_)
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
            likeness = overlaps(grown(predicted[rows], reach), grown(detections.xyxy[columns], reach))
            likeness *= same_class[rows[:, None], columns]
            for row, column in match(likeness, least):
                track_of[columns[column]] = rows[row]
                free[rows[row]] = False

    def _weigh_classes(
        self, lives: Sequence[_Life], boxes: NDArray[np.floating], detections: Detections
    ) -> None:
        """Remember what the object of each track is called in this frame, and how surely.

        Args:
            boxes: (N, 4) of the tracks: as detected where one was, else as predicted.
        """
        on_object = overlaps(boxes, detections.xyxy) >= SAME_OBJECT_IOU
        on_object &= detections.confidence >= self.settings.low_confidence
        class_ids, confidences = detections.class_id.tolist(), detections.confidence.tolist()
        surest: dict[int, dict[int, float]] = {}  # place of the track → class id → confidence
        for place, index in np.argwhere(on_object).tolist():
            called = surest.setdefault(place, {})
            called[class_ids[index]] = max(confidences[index], called.get(class_ids[index], 0.0))
        for place, called in surest.items():
            evidence = lives[place].evidence
            for key in evidence:
                evidence[key] *= _KEPT
            for key, value in called.items():
                evidence[key] = evidence.get(key, 0.0) + value

    def _update_seen(
        self, life: _Life, xyxy: list[float], captured_ns: int, events: list[TrackEvent]
    ) -> None:
        kind = TrackEventKind.UPDATE
        if not life.confirmed:
            settings = self.settings
            if life.seen < settings.min_hits or life.scores.median < settings.confirm_score:
                return
            if life.class_in_doubt:
                return
            life.confirmed = True
            kind = TrackEventKind.NEW
        left, top, right, bottom = xyxy
        events.append(TrackEvent(kind, captured_ns, self._track(life, (left, top, right, bottom))))

    def _forget_unseen(self, captured_ns: int, events: list[TrackEvent]) -> None:
        unfounded = np.zeros(len(self._lives), np.bool_)
        for place, life in enumerate(self._lives):
            if life.last_ns == captured_ns:
                continue
            unseen_s = (captured_ns - life.last_ns) / 1e9
            if not life.confirmed:
                # A rumour: the next frame confirms it, or soon after; else it was none.
                unfounded[place] = life.seen == 1 or unseen_s >= self.settings.coast_timeout_s
            elif unseen_s >= self.settings.coast_timeout_s and not life.lost:
                life.lost = True
                events.append(self._event(TrackEventKind.LOST, place, captured_ns))
        self._drop(unfounded, captured_ns, events)

    def _drop(self, ended: NDArray[np.bool_], captured_ns: int, events: list[TrackEvent]) -> None:
        if not ended.any():
            return
        for place in np.flatnonzero(ended).tolist():
            if self._lives[place].confirmed:
                events.append(self._event(TrackEventKind.END, place, captured_ns))
        self._lives = [life for life, gone in zip(self._lives, ended, strict=True) if not gone]
        self._states = self._states[~ended]

    def _event(self, kind: TrackEventKind, place: int, captured_ns: int) -> TrackEvent:
        left, top, right, bottom = self._states.xyxy[place].tolist()
        return TrackEvent(kind, captured_ns, self._track(self._lives[place], (left, top, right, bottom)))

    def _track(self, life: _Life, xyxy: XYXY) -> Track:
        return Track(
            track_id=life.track_id,
            class_id=life.class_id,
            class_name=self._class_names[life.class_id],
            state=TrackState.CONFIRMED if life.confirmed else TrackState.TENTATIVE,
            xyxy=xyxy,
            confidence=life.confidence,
            score=life.scores.median,
            seen=life.seen,
            first_ns=life.first_ns,
            last_ns=life.last_ns,
        )

    def _labelled(self, detections: Detections, lives: dict[int, _Life]) -> Detections:
        of_each = [lives.get(index) for index in range(len(detections))]
        track_id = np.array([NO_TRACK if life is None else life.track_id for life in of_each], np.int64)
        score = np.array([math.nan if life is None else life.scores.median for life in of_each], np.float32)
        confirmed = np.array(
            [life is not None and life.confirmed and not life.class_in_doubt for life in of_each], np.bool_
        )
        labelled = replace(detections, track_id=track_id, track_score=score, track_confirmed=confirmed)
        kept = (track_id != NO_TRACK) | (detections.confidence >= self.settings.keep_confidence)
        return labelled if kept.all() else labelled[kept]
