"""Which of the two poses of a square marker is the true one, from several frames.

Both poses of a frame fit the corners. Over time they differ: the true one keeps its attitude in a world frame
while the camera moves around the marker, the other one turns by about twice the change of the line of sight;
and the corners' noise, which decides within one frame, averages out. Each marker has up to two hypotheses,
which collect the negative log-likelihood of the poses that continue them. A frame that is clear by itself
restarts them: the marker may have been turned, and it is cheap.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from vision.marker_edges import CORNER_SIGMA_PX
from vision.markers import Marker, MarkerPose

# Costs and attitudes are averaged over this time; a marker unseen for longer begins again.
MEMORY_S = 3.0
# One sigma of the camera's attitude, in addition to the pose's own; limit of one frame's cost.
ATTITUDE_SIGMA_RAD, MAX_COST = math.radians(2.0), 8.0
# Resolved when the costs differ by this much: odds of exp(8).
RESOLVED_COST = 8.0
# Below this ambiguity (see `Marker.ambiguity`) one frame is enough, until several say otherwise.
CLEAR_AMBIGUITY = 0.25


@dataclass(slots=True)
class _Hypothesis:
    """One attitude `world_from_marker` of a marker, and its cost so far."""

    attitude: NDArray[np.float64]
    cost: float

    def mismatch(self, attitude: NDArray[np.float64]) -> float:
        """Angle to another attitude, radians."""
        # The trace of the rotation between them.
        return math.acos(max(-1.0, min(1.0, (float(np.vdot(self.attitude, attitude)) - 1.0) / 2.0)))


@dataclass(slots=True)
class _Seen:
    stamp_ns: int
    since_ns: int
    hypotheses: list[_Hypothesis]


class AmbiguityResolver:
    """Resolves the poses of the markers of one camera."""

    def __init__(self) -> None:
        self._seen: dict[int, _Seen] = {}

    def resolve(
        self, marker: Marker, stamp_ns: int, world_from_optical: NDArray[np.float64]
    ) -> MarkerPose | None:
        """The true pose of a marker in a new frame; None: both are about equally likely.

        Args:
            stamp_ns: of the frame's capture. world_from_optical: (3, 3) the camera's attitude then.
        """
        poses = marker.poses
        attitudes = [world_from_optical @ pose.rotation for pose in poses]
        if len(poses) > 1 and _clear(marker):
            # Further frames that are not clear change it only after several.
            hypotheses = [_Hypothesis(attitudes[0], 0.0), _Hypothesis(attitudes[1], 2.0 * RESOLVED_COST)]
            self._seen[marker.identifier] = _Seen(stamp_ns, stamp_ns, hypotheses)
            return poses[0]
        seen = self._seen.get(marker.identifier)
        if seen is None or not 0 <= stamp_ns - seen.stamp_ns <= MEMORY_S * 1e9:
            best_px = marker.reprojection_px
            fits = [_Hypothesis(at, _cost(pose, best_px)) for pose, at in zip(poses, attitudes, strict=True)]
            seen = self._seen[marker.identifier] = _Seen(stamp_ns, stamp_ns, fits)
            order: tuple[int, ...] = tuple(range(len(poses)))
        else:
            order = self._continue(seen, poses, attitudes, stamp_ns)
        costs = [hypothesis.cost for hypothesis in seen.hypotheses]
        best = int(np.argmin(costs))
        if len(poses) == 1:
            return poses[0]
        if max(costs) - costs[best] > RESOLVED_COST:
            return poses[order[best]]
        return poses[0] if marker.ambiguity <= CLEAR_AMBIGUITY else None

    def _continue(
        self,
        seen: _Seen,
        poses: tuple[MarkerPose, ...],
        attitudes: list[NDArray[np.float64]],
        stamp_ns: int,
    ) -> tuple[int, ...]:
        """Continue the hypotheses with the poses that are nearest to them; returns the pose of each."""
        if len(seen.hypotheses) < len(poses):
            # Until now both poses were one.
            (known,) = seen.hypotheses
            seen.hypotheses.append(_Hypothesis(known.attitude, known.cost))
        hypotheses = seen.hypotheses
        if len(poses) == 1:
            order: tuple[int, ...] = (0,) * len(hypotheses)
        else:
            order = min(
                permutations(range(len(poses))),
                key=lambda order: sum(
                    hypothesis.mismatch(attitudes[index]) ** 2
                    for hypothesis, index in zip(hypotheses, order, strict=True)
                ),
            )
        kept = math.exp(-(stamp_ns - seen.stamp_ns) / 1e9 / MEMORY_S)
        # An average over the memory, or over the time since the first frame while that is shorter.
        age_s = (stamp_ns - seen.since_ns) / 1e9
        gain = max(1.0 - kept, min(1.0, (stamp_ns - seen.stamp_ns) / 1e9 / max(age_s, 1e-9)) / 2)
        for hypothesis, index in zip(hypotheses, order, strict=True):
            attitude = attitudes[index]
            cost = _cost(poses[index], poses[0].reprojection_px, hypothesis.mismatch(attitude))
            hypothesis.cost = kept * hypothesis.cost + cost
            left, _, right = np.linalg.svd((1.0 - gain) * hypothesis.attitude + gain * attitude)
            hypothesis.attitude = left @ right
        seen.stamp_ns = stamp_ns
        return order


def _clear(marker: Marker) -> bool:
    """Whether the corners of one frame decide, by more than their noise explains."""
    best_px, other_px = (pose.reprojection_px for pose in marker.poses)
    return marker.ambiguity <= CLEAR_AMBIGUITY and _fit_cost(other_px, best_px) >= RESOLVED_COST


def _fit_cost(fit_px: float, best_px: float) -> float:
    # Four corners have two degrees of freedom more than a pose: the best fit shows their noise.
    return 2.0 * (fit_px**2 - best_px**2) / max(CORNER_SIGMA_PX**2, 2.0 * best_px**2)


def _cost(pose: MarkerPose, best_px: float, mismatch_rad: float = 0.0) -> float:
    """Negative log-likelihood of a pose in a frame, less that of the best fit there; limited."""
    variance = ATTITUDE_SIGMA_RAD**2 + float(np.linalg.eigvalsh(pose.covariance[3:, 3:])[-1])
    return min(MAX_COST, _fit_cost(pose.reprojection_px, best_px) + mismatch_rad**2 / (2.0 * variance))
