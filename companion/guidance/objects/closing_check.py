"""Own motion against what is seen: does the distance to an object fall as the vehicle flies towards it?

Where it does not, the camera shows an old image (a decoder that repeats it below a running clock, which is no
identical image), the object's size is wrong, or it moves away as fast as the vehicle follows. A single
frame does not distinguish these from an object that is still far away. And of two images of a moving camera a
detector's boxes are never the same, whatever the objects do, except those of the vehicle's own parts.
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from companion.guidance.objects.position_filter import UNSTATED_SIGMA
from companion.guidance.objects.target import Target
from companion.vehicle.state import Vector3

# Distances are compared by their medians over this long, because a single one has the noise of a box.
BLOCK_S, BLOCK_FRAMES = 0.4, 3
# Blocks of the last 10 s and more are compared.
BLOCKS = 25
# Without an object for so long it begins again.
GAP_S = 1.5
# The distance must fall by this share of what was flown towards the object. A person who walks away at
# 1.5 m/s from a vehicle at 2 m/s takes three quarters of it; a frozen image all.
LEAST_SHARE = 0.25
# Flown at least this far, and more than these sigma of the distance, before it counts. None of 60 flights to
# standing objects (benchmarks, approach with and without depth, seeds 300 to 329) was ended by it.
LEAST_FLOWN_M, SIGMAS = 1.5, 2.0
# Boxes within this are the same. It counts for so many frames in so long, once `LEAST_FLOWN_M` were flown.
SAME_BOX_PX, SAME_BOX_FRAMES, SAME_BOX_S = 0.1, 6, 0.5
# A box that was never this far from where it was first seen may be a part of the vehicle, as a landing gear.
MOVED_PX = 2.0
# A detector that never changed an edge by less than this rounds its boxes: they may well stay the same.
ROUNDED_PX = 0.5


@dataclass(frozen=True, slots=True)
class Approached:
    """The object that a behaviour flies to.

    Attributes:
        seen: its newest detection.
        moves: it is expected to move over ground; then only the vehicle's vertical motion is compared.
    """

    seen: Target
    moves: bool = False


@dataclass(frozen=True, slots=True)
class _Sample:
    captured_ns: int
    flown_m: float
    distance_m: float
    sigma_m: float


class _Box:
    """The box of one object, from frame to frame.

    Attributes:
        newest: its newest detection. began: the first frame with these pixels, and where the vehicle was.
        frames: with these pixels. moved: it has been elsewhere in the image.
    """

    def __init__(self, seen: Target, there: Vector3) -> None:
        self.newest, self._first_xyxy, self.began = seen, seen.box_xyxy, (seen, there)
        self.frames, self.moved = 1, False

    def shows(self, seen: Target) -> bool:
        """Whether a detection is of the same object."""
        if self.newest.track_id is not None and seen.track_id is not None:
            return self.newest.track_id == seen.track_id
        one, other = self.newest.box_xyxy, seen.box_xyxy
        overlap = all(max(one[i], other[i]) < min(one[i + 2], other[i + 2]) for i in (0, 1))
        return overlap and self.newest.class_name == seen.class_name

    def add(self, seen: Target, there: Vector3) -> None:
        """A newer detection of it."""
        self.newest = seen
        self.frames += 1
        if _apart_px(self.began[0].box_xyxy, seen.box_xyxy) > SAME_BOX_PX:
            self.began, self.frames = (seen, there), 1
            self.moved = self.moved or _apart_px(self._first_xyxy, seen.box_xyxy) > MOVED_PX

    def still_m(self, there: Vector3) -> float:
        """How far the vehicle was flown while it stayed at its pixels; 0: not for long enough to count."""
        seen, began = self.began
        lasts_s = (self.newest.captured_ns - seen.captured_ns) / 1e9
        return math.dist(began, there) if lasts_s >= SAME_BOX_S and self.frames >= SAME_BOX_FRAMES else 0.0


class ClosingCheck:
    """Compares the vehicle's way towards an object, by its own estimate, with the object's distance.

    What is known of the boxes stays for the next command: a camera may have frozen before it.

    Attributes:
        fault: what is inconsistent, in words; empty: nothing so far. It stays until `reset`.
    """

    def __init__(self) -> None:
        self.fault = ""
        self._boxes: list[_Box] = []
        self._frame_ns, self._finest_px = 0, math.inf
        self.reset()

    def reset(self) -> None:
        """Begin again: another command, or none."""
        self.fault = ""
        self._positions: deque[tuple[int, Vector3]] = deque(maxlen=100)
        self.begin_again()

    def begin_again(self) -> None:
        """Another object is approached: its distance is not compared with those before. The fault stays."""
        self._blocks: deque[_Sample] = deque(maxlen=BLOCKS)
        self._samples: list[_Sample] = []
        self._last: tuple[Target, Vector3] | None = None
        self._flown_m = 0.0

    def update(
        self,
        approached: Approached | None,
        targets: tuple[Target, ...],
        position_ns: int,
        position: Vector3,
        *,
        used: bool = True,
    ) -> str:
        """Add the newest detections and the vehicle's position; returns `fault`.

        Args:
            approached: a detection that is not newer than the one before changes nothing. None: none, and the
                next one may be another object.
            targets: of the newest frame; one that was added before changes nothing.
            position_ns, position: its stamp, and local NED metres.
            used: the behaviour uses `targets`; else boxes that stay the same are no fault.
        """
        self._positions.append((position_ns, position))
        # An object that fills the image stays at its edges.
        boxed = tuple(t for t in targets if t.box_xyxy[2] > t.box_xyxy[0] and not (t.cut and t.cut_above))
        if boxed and boxed[0].captured_ns > self._frame_ns:
            self._frame_ns = boxed[0].captured_ns
            still_m = self._compare_boxes(boxed)
            if used and not self.fault and still_m > LEAST_FLOWN_M:
                self.fault = f"camera frozen: flown {still_m:.1f} m, and every object stays at its pixels"
        if approached is None:
            self.begin_again()
        if approached is None or self.fault:
            return self.fault
        seen, last = approached.seen, self._last
        if last is not None and seen.captured_ns <= last[0].captured_ns:
            return ""
        there = self._position_at(seen.captured_ns)
        distance_m, line, sigma_m = _measured(seen, there, vertical=approached.moves)
        if last is None or not _continues(last[0], seen):
            self.begin_again()
        else:
            step = [now - before for now, before in zip(there, last[1], strict=True)]
            self._flown_m += sum(part * along for part, along in zip(step, line, strict=True))
        self._last = seen, there
        if not math.isfinite(distance_m):
            return ""
        self._samples.append(_Sample(seen.captured_ns, self._flown_m, distance_m, sigma_m))
        lasts_s = (seen.captured_ns - self._samples[0].captured_ns) / 1e9
        if lasts_s >= BLOCK_S and len(self._samples) >= BLOCK_FRAMES:
            self.fault = self._compare(_block(self._samples), seen.class_name)
            self._samples = []
        return self.fault

    def _compare_boxes(self, targets: tuple[Target, ...]) -> float:
        """How far the vehicle was flown while each box that has ever moved stayed the same; 0: not at all."""
        there = self._position_at(self._frame_ns)
        known = [box for box in self._boxes if self._frame_ns - box.newest.captured_ns <= GAP_S * 1e9]
        seen: list[_Box] = []
        for target in targets:
            fitting = [box for box in known if box.shows(target)]
            if not fitting:
                seen.append(_Box(target, there))
                continue
            box = min(fitting, key=lambda each: _apart_px(each.newest.box_xyxy, target.box_xyxy))
            edges = zip(box.newest.box_xyxy, target.box_xyxy, strict=True)
            self._finest_px = min([self._finest_px, *(abs(a - b) for a, b in edges if abs(a - b) > 1e-3)])
            box.add(target, there)
            known.remove(box)
            seen.append(box)
        self._boxes = known + seen
        rounded = self._finest_px >= ROUNDED_PX
        return 0.0 if rounded else min((box.still_m(there) for box in seen if box.moved), default=0.0)

    def _compare(self, newest: _Sample, name: str) -> str:
        for block in self._blocks:
            flown_m, fell_m = newest.flown_m - block.flown_m, block.distance_m - newest.distance_m
            least_m = max(LEAST_FLOWN_M, SIGMAS * max(block.sigma_m, newest.sigma_m))
            if flown_m > least_m and fell_m < LEAST_SHARE * flown_m and flown_m - fell_m > least_m:
                return (
                    f"flown {flown_m:.1f} m towards the {name}, its distance fell by {fell_m:.1f} m: camera "
                    f"frozen, wrong size of the object, or it moves away"
                )
        self._blocks.append(newest)
        return ""

    def _position_at(self, stamp_ns: int) -> Vector3:
        """The vehicle's position at a capture; the nearest known."""
        return min(self._positions, key=lambda sample: abs(sample[0] - stamp_ns))[1]


def _apart_px(one: Sequence[float], other: Sequence[float]) -> float:
    """The largest difference of two boxes' edges."""
    return max(abs(a - b) for a, b in zip(one, other, strict=True))


def _continues(last: Target, seen: Target) -> bool:
    """Whether two distances can be compared: to the same point, by the same means, without a long gap."""
    gap_s = (seen.captured_ns - last.captured_ns) / 1e9
    means, before = ((t.class_name, t.track_id, t.range_source, t.cut) for t in (seen, last))
    return gap_s <= GAP_S and means == before


def _measured(seen: Target, there: Vector3, *, vertical: bool) -> tuple[float, Vector3, float]:
    """Distance, direction (unit vector, NED) and one sigma of the distance; vertical: of the height above."""
    sigma_m = seen.range_sigma_m if math.isnan(seen.distance_sigma_m) else seen.distance_sigma_m
    if math.isnan(sigma_m):
        sigma_m = math.hypot(UNSTATED_SIGMA[0], UNSTATED_SIGMA[1] * seen.distance_m)
    if vertical:
        below_m = math.nan if seen.position_ned_m is None else seen.position_ned_m[2] - there[2]
        return below_m, (0.0, 0.0, 1.0), sigma_m
    level = math.cos(seen.elevation_rad)
    north, east = level * math.cos(seen.bearing_rad), level * math.sin(seen.bearing_rad)
    return seen.distance_m, (north, east, -math.sin(seen.elevation_rad)), sigma_m


def _block(samples: Sequence[_Sample]) -> _Sample:
    """The medians of some samples, with the stamp of the newest."""
    return _Sample(
        samples[-1].captured_ns,
        statistics.median(sample.flown_m for sample in samples),
        statistics.median(sample.distance_m for sample in samples),
        max(sample.sigma_m for sample in samples),
    )
