"""Tracking quality against ground truth: CLEAR MOT and IDF1.

K. Bernardin, R. Stiefelhagen, "Evaluating Multiple Object Tracking Performance: The CLEAR MOT Metrics",
EURASIP J. Image and Video Processing, 2008; fragmentations as in Y. Li et al., CVPR 2009; IDF1 as in E.
Ristani et al., arXiv 1609.01775.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass

import numpy as np
from numpy.typing import NDArray

from vision.tracking.association import assign, match, overlaps


@dataclass(frozen=True, slots=True, eq=False)
class Labelled:
    """Boxes of one frame with identities: ground truth or tracker output.

    Attributes:
        identity: N distinct numbers.
        xyxy: (N, 4) pixels.
    """

    identity: Sequence[int]
    xyxy: NDArray[np.floating]

    def __post_init__(self) -> None:
        if np.shape(self.xyxy) != (len(self.identity), 4):
            raise ValueError(f"xyxy must be ({len(self.identity)}, 4), got {np.shape(self.xyxy)}")
        if len(set(self.identity)) != len(self.identity):
            raise ValueError(f"identities of one frame must differ, got {list(self.identity)}")


@dataclass(frozen=True, slots=True)
class MotScore:
    """Totals over a sequence.

    Attributes:
        frames: number of frames.
        objects: ground truth boxes over all frames.
        misses: ground truth boxes without a tracked box.
        false_positives: tracked boxes without a ground truth box.
        switches: matches where the object's track id differs from its previous match.
        fragmentations: times an object is matched again after frames in which it was present and unmatched.
        iou: mean overlap of the pairs; NaN without pairs.
        idf1: share of boxes with the right identity under the best one-to-one assignment over the sequence.
    """

    frames: int
    objects: int
    misses: int
    false_positives: int
    switches: int
    fragmentations: int
    iou: float
    idf1: float

    @property
    def mota(self) -> float:
        """1 - (misses + false positives + switches) / objects; may be negative. NaN without objects."""
        if not self.objects:
            return float("nan")
        return 1.0 - (self.misses + self.false_positives + self.switches) / self.objects

    def as_dict(self) -> dict[str, float]:
        """All fields and `mota` as plain values."""
        return {"mota": self.mota, **asdict(self)}


def clear_mot(frames: Iterable[tuple[Labelled, Labelled]], *, least_iou: float = 0.5) -> MotScore:
    """Compare tracks with ground truth, frame by frame.

    A pair from the previous frame is kept while it overlaps by `least_iou`; the rest are paired to maximise
    first the number of pairs, then the overlap.

    Args:
        frames: (ground truth, tracked) of each frame.
        least_iou: smallest overlap of a pair.
    """
    count = objects = misses = false_positives = switches = fragmentations = 0
    overlap_sum, pairs_sum = 0.0, 0
    last_identity: dict[int, int] = {}
    missed_since: set[int] = set()
    seen_together: Counter[tuple[int, int]] = Counter()
    truth_seen: Counter[int] = Counter()
    tracked_seen: Counter[int] = Counter()
    for truth, tracked in frames:
        iou = overlaps(truth.xyxy, tracked.xyxy)
        pairs = _pairs(truth, tracked, iou, last_identity, least_iou)
        covered: set[int] = set()
        for row, column in pairs:
            true_id, tracked_id = truth.identity[row], tracked.identity[column]
            if last_identity.get(true_id, tracked_id) != tracked_id:
                switches += 1
            if true_id in missed_since and true_id in last_identity:
                fragmentations += 1
            last_identity[true_id] = tracked_id
            covered.add(true_id)
            overlap_sum += float(iou[row, column])
        missed_since = (missed_since | set(truth.identity)) - covered
        for row, column in np.argwhere(iou >= least_iou):
            seen_together[truth.identity[row], tracked.identity[column]] += 1
        truth_seen.update(truth.identity)
        tracked_seen.update(tracked.identity)
        count += 1
        objects += len(truth.identity)
        pairs_sum += len(pairs)
        misses += len(truth.identity) - len(pairs)
        false_positives += len(tracked.identity) - len(pairs)
    return MotScore(
        frames=count,
        objects=objects,
        misses=misses,
        false_positives=false_positives,
        switches=switches,
        fragmentations=fragmentations,
        iou=overlap_sum / pairs_sum if pairs_sum else float("nan"),
        idf1=_idf1(seen_together, truth_seen, tracked_seen),
    )


def _pairs(
    truth: Labelled,
    tracked: Labelled,
    iou: NDArray[np.float64],
    last_identity: dict[int, int],
    least_iou: float,
) -> list[tuple[int, int]]:
    column_of = {identity: column for column, identity in enumerate(tracked.identity)}
    kept = []
    for row, true_id in enumerate(truth.identity):
        column = column_of.get(last_identity.get(true_id, -1))
        if column is not None and iou[row, column] >= least_iou:
            kept.append((row, column))
            del column_of[tracked.identity[column]]
    free = iou.copy()
    free[[row for row, _ in kept], :] = 0.0
    free[:, [column for _, column in kept]] = 0.0
    # One more pair outweighs any overlap: each pair counts at least the number of objects.
    free[free < least_iou] = 0.0
    weight = np.where(free > 0.0, free + len(iou), 0.0)
    return kept + match(weight, 0.0)


def _idf1(together: Counter[tuple[int, int]], truth_seen: Counter[int], tracked_seen: Counter[int]) -> float:
    """Twice the correctly identified boxes over all ground truth and tracked boxes."""
    true_ids, tracked_ids = list(truth_seen), list(tracked_seen)
    boxes = sum(truth_seen.values()) + sum(tracked_seen.values())
    if not true_ids or not tracked_ids:
        return float("nan") if not boxes else 0.0
    gain = np.zeros((len(true_ids), len(tracked_ids)))
    row_of = {identity: row for row, identity in enumerate(true_ids)}
    column_of = {identity: column for column, identity in enumerate(tracked_ids)}
    for (true_id, tracked_id), frames in together.items():
        gain[row_of[true_id], column_of[tracked_id]] = frames
    correct = sum(gain[pair] for pair in assign(-gain))
    return float(2 * correct / boxes)
