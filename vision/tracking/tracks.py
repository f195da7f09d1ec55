"""Data types of tracking: tracks, track events and settings."""

from __future__ import annotations

from bisect import bisect_left, insort
from collections import deque
from dataclasses import dataclass
from enum import StrEnum

from vision.detections import TRACK_CONFIRMED, TRACK_TENTATIVE

XYXY = tuple[float, float, float, float]


class TrackState(StrEnum):
    """Whether a track is confirmed."""

    TENTATIVE = TRACK_TENTATIVE
    """too short, or its median confidence is too low: possibly a false detection"""
    CONFIRMED = TRACK_CONFIRMED
    """confirmed, and stays so; its detections are reported as tentative while their class is in doubt"""


class TrackEventKind(StrEnum):
    """What happened to a track. Only confirmed tracks have events."""

    NEW = "new"
    """it was confirmed in this frame"""
    UPDATE = "update"
    """it was detected in this frame"""
    LOST = "lost"
    """not detected for `coast_timeout_s`; the next `update` ends this state"""
    END = "end"
    """it ended; a later detection there starts another track"""


@dataclass(frozen=True, slots=True)
class Track:
    """The state of one track at one frame.

    Attributes:
        track_id: 1 or more; never reused.
        class_id, class_name: from the detector; a track never changes its class.
        state: whether it is confirmed.
        xyxy: pixels of the frame: the detected box, or the predicted one where it was not detected.
        confidence: of its newest detection, 0..1.
        score: median of the confidences of its newest `SCORES_KEPT` detections, 0..1.
        seen: number of frames in which it was detected.
        first_ns, last_ns: capture stamps of the first and the newest of these frames.
    """

    track_id: int
    class_id: int
    class_name: str
    state: TrackState
    xyxy: XYXY
    confidence: float
    score: float
    seen: int
    first_ns: int
    last_ns: int


@dataclass(frozen=True, slots=True)
class TrackEvent:
    """An event of a track at the frame captured at `stamp_ns`."""

    kind: TrackEventKind
    stamp_ns: int
    track: Track


SCORES_KEPT = 100


class ScoreHistory:
    """The newest `SCORES_KEPT` confidences of a track, and their median in constant time."""

    __slots__ = ("_newest", "_sorted")

    def __init__(self) -> None:
        self._newest: deque[float] = deque()
        self._sorted: list[float] = []

    def add(self, confidence: float) -> None:
        """Add one; above `SCORES_KEPT` the oldest is dropped."""
        self._newest.append(confidence)
        insort(self._sorted, confidence)
        if len(self._newest) > SCORES_KEPT:
            del self._sorted[bisect_left(self._sorted, self._newest.popleft())]

    @property
    def median(self) -> float:
        """The median; the mean of the middle two for an even count. 0 if empty."""
        count = len(self._sorted)
        if not count:
            return 0.0
        return (self._sorted[(count - 1) // 2] + self._sorted[count // 2]) / 2


@dataclass(frozen=True, slots=True)
class TrackerSettings:
    """Thresholds of the tracker. Confidences and overlaps (intersection over union) are in 0..1.

    Attributes:
        high_confidence: from here on a detection can start a track, and is associated first.
        low_confidence: weaker detections are ignored; between the two a detection can only continue a track
            detected less than `coast_timeout_s` ago.
        keep_confidence: a weaker detection without a track is left out of the result.
        confirm_score: a track is confirmed when its median confidence reaches this,
        min_hits: and it was detected in this many frames.
        min_iou: a strong detection matches a track if it overlaps the prediction by more than this,
        min_iou_weak: and a weak one by more than this.
        coast_timeout_s: undetected for this long, a track is lost.
        max_age_s: undetected for this long, it ends.
    """

    high_confidence: float = 0.35
    low_confidence: float = 0.1
    keep_confidence: float = 0.25
    confirm_score: float = 0.4
    min_hits: int = 3
    min_iou: float = 0.2
    min_iou_weak: float = 0.5
    coast_timeout_s: float = 0.5
    max_age_s: float = 2.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.low_confidence <= self.high_confidence <= 1.0:
            raise ValueError(
                "low_confidence and high_confidence must be 0 to 1, low not above high, "
                f"got {self.low_confidence:g} and {self.high_confidence:g}"
            )
        for name in ("keep_confidence", "confirm_score", "min_iou", "min_iou_weak"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must be 0 to 1, got {getattr(self, name):g}")
        if self.min_hits < 1:
            raise ValueError(f"min_hits must be at least 1, got {self.min_hits}")
        if not 0.0 < self.coast_timeout_s <= self.max_age_s:
            raise ValueError(
                "coast_timeout_s must be above 0 and not above max_age_s, "
                f"got {self.coast_timeout_s:g} and {self.max_age_s:g}"
            )
