"""Path planning in the perception worker: the occupancy grid from depth and pose, and a path on request."""

from __future__ import annotations

import bisect
from collections import deque
from collections.abc import Callable

from companion.host.clock import StandstillWatch
from companion.vehicle.state import Vector3
from vision.camera_model import CameraModel, CameraMount
from vision.frame import Frame
from vision.obstacle_sectors import nearest_ranges
from vision.occupancy_grid import DIRECTIONS, OccupancyGrid
from vision.path_planner import PathRequest, PlannedPath, plan_path
from vision.tracking.camera_motion import Array

# Ten times a second, less the jitter of a camera at that rate.
PERIOD_NS = 90_000_000
# A request that is not repeated for so long has ended.
REQUEST_MAX_AGE_NS = 500_000_000
HISTORY_NS = 3_000_000_000
# Positions arrive 30 times a second; the newest is used for an image that is later by at most this.
MAX_AHEAD_NS = 200_000_000


class PositionHistory:
    """The vehicle's positions of the last few seconds, local NED. One writer and one reader."""

    def __init__(self) -> None:
        self._samples: deque[tuple[int, Vector3]] = deque()

    def add(self, stamp_ns: int, position_ned_m: Vector3) -> None:
        """Add a sample; one that is not newer than the newest is ignored."""
        if self._samples and stamp_ns <= self._samples[-1][0]:
            return
        self._samples.append((stamp_ns, position_ned_m))
        while stamp_ns - self._samples[0][0] > HISTORY_NS:
            self._samples.popleft()

    def discard(self) -> None:
        """Forget every sample."""
        self._samples.clear()

    @property
    def newest(self) -> Vector3 | None:
        """The newest position; None before the first."""
        return self._samples[-1][1] if self._samples else None

    def at(self, stamp_ns: int) -> Vector3 | None:
        """The position at a time, interpolated; None outside the history."""
        samples = list(self._samples)
        index = bisect.bisect_left(samples, stamp_ns, key=lambda sample: sample[0])
        if index == len(samples):
            late_ns = stamp_ns - samples[-1][0] if samples else HISTORY_NS
            return samples[-1][1] if late_ns <= MAX_AHEAD_NS else None
        if index == 0:
            return samples[0][1] if samples[0][0] == stamp_ns else None
        (before_ns, before), (after_ns, after) = samples[index - 1], samples[index]
        share = (stamp_ns - before_ns) / (after_ns - before_ns)
        north, east, down = (b + share * (a - b) for b, a in zip(before, after, strict=True))
        return (north, east, down)


class PathPlanning:
    """Adds every depth image to the grid; plans while a path is requested.

    Args:
        positions: of the vehicle.
        pose_at: from a capture stamp to the camera's mount and (3, 3) `ned_from_body`; None: unknown.
        camera_of: the camera's model for an image size.
        height_m: the vehicle's height above home; None: unknown.
        in_flight: whether the vehicle flies.
        watch: for a suspend of the computer; None: a new one.

    Attributes:
        grid: around the vehicle.
    """

    def __init__(
        self,
        positions: PositionHistory,
        pose_at: Callable[[int], tuple[CameraMount, Array] | None],
        camera_of: Callable[[int, int], CameraModel],
        height_m: Callable[[], float | None],
        in_flight: Callable[[], bool] = lambda: False,
        watch: StandstillWatch | None = None,
    ) -> None:
        self.grid = OccupancyGrid()
        self._positions, self._pose_at = positions, pose_at
        self._camera_of, self._height_m, self._in_flight = camera_of, height_m, in_flight
        self._request: tuple[PathRequest, int] | None = None
        self._newest: PlannedPath | None = None
        self._due_ns = 0
        self._watch = watch or StandstillWatch()

    def request(self, request: PathRequest, now_ns: int) -> None:
        """Set what to plan from now on; it must be repeated."""
        self._request = (request, now_ns)

    def update(self, frame: Frame, now_ns: int) -> PlannedPath | None:
        """Add a frame's depth and plan; None: nothing is requested or due, or depth or pose is missing.

        In flight, depth that repeats that of the frame before is none: by this frame's pose it is misplaced.
        After a suspend of the computer the map begins again: its ages do not count the suspend.
        """
        seen = self._watch.observe()
        self._watch.acknowledge(seen)
        self._watch.end_of_loop()  # a camera may pause
        if seen.standstill is not None:
            self.grid, self._request, self._newest = OccupancyGrid(), None, None
            self._positions.discard()
        if frame.depth_m is None:
            return None
        if frame.depth_since_ns not in (None, frame.captured_ns) and self._in_flight():
            return None
        pose, position = self._pose_at(frame.captured_ns), self._positions.at(frame.captured_ns)
        if pose is None or position is None:
            return None
        camera = self._camera_of(frame.width, frame.height)
        ranges_m = nearest_ranges(frame.depth_m, camera, *pose, self._height_m(), DIRECTIONS)
        self.grid.update(ranges_m, position, frame.captured_ns)
        request, newest = self._request, self._positions.newest
        if request is None or newest is None or now_ns < self._due_ns:
            return None
        if now_ns - request[1] > REQUEST_MAX_AGE_NS:
            return None
        self._due_ns = now_ns + PERIOD_NS
        path = self._newest if self._newest and self._newest.number == request[0].number else None
        self._newest = plan_path(self.grid, request[0], newest[:2], path)
        return self._newest
