"""The markers of all cameras: which are confirmed, and the position that a map of them gives."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import chain, combinations

import numpy as np

from companion.guidance.objects.from_detections import HistoryError, Pose, StateHistory, mount_at
from companion.guidance.objects.from_markers import (
    CONFIRM_FRAMES,
    CONFIRM_GAP_S,
    NO_MARKERS,
    BoardTarget,
    LocalizedMarkers,
    MarkerSight,
    MarkerTarget,
    board_targets,
    looks_down,
    marker_targets,
    object_detections,
)
from companion.guidance.objects.table import ObjectTable
from companion.guidance.objects.tracked_object import TrackedObject
from companion.perception.cameras import PerceptionCamera
from companion.perception.map_position import (
    TURNED_RAD,
    VisionGate,
    map_origin_ned_m,
    position_from_map,
    tilt_error_rad,
)
from companion.vehicle.state import VehicleState
from companion.vehicle.vision_position import VisionPosition
from vision.marker_ambiguity import AmbiguityResolver
from vision.marker_boards import MAP
from vision.markers import is_apriltag
from vision.pipeline import PerceptionResult

# The fastest that positions from a map are sent; slower cameras send one for each frame with a map.
MAX_VISION_HZ = 50.0
# A marker whose position changes by more between two frames begins again: metres, or three sigma of both.
CONFIRM_DISTANCE_M = 1.0
# Shortest time between two events about contradictions.
EVENT_INTERVAL_S = 1.0


@dataclass(frozen=True, slots=True)
class _SeenMarkers:
    captured_ns: int
    targets: tuple[MarkerTarget, ...]
    looks_down: bool


class MarkerTracker:
    """The markers of all cameras with marker detection; not only the steering camera may look down."""

    def __init__(self, cameras: Sequence[PerceptionCamera], on_event: Callable[[str, str], None]) -> None:
        self._detecting = tuple(
            camera for camera in cameras if camera.settings.markers.dictionary is not None
        )
        self._on_pads = {
            camera.name: {marker.identifier: marker for marker in camera.settings.markers.pad_markers()}
            for camera in self._detecting
        }
        self._resolvers = {camera.name: AmbiguityResolver() for camera in self._detecting}
        self._seen: dict[str | None, _SeenMarkers] = {}
        self._objects = {camera.name: ObjectTable() for camera in self._detecting}
        # Camera → id → frames in a row with the marker, and the newest.
        self._runs: dict[str | None, dict[int, tuple[int, MarkerTarget]]] = {}
        self._maps = {
            camera.name: board
            for camera in self._detecting
            if camera.settings.markers.localise
            for board in camera.settings.markers.boards()
            if board.name == MAP
        }
        self._gate, self._vision_ns, self._event_ns = VisionGate(), 0, 0
        self._on_event = on_event

    @property
    def vision_dropped(self) -> int:
        """Number of positions from a map that were not sent, since the start."""
        return self._gate.dropped

    def localize(
        self,
        camera: PerceptionCamera,
        result: PerceptionResult,
        history: StateHistory,
        state: VehicleState | None = None,
    ) -> LocalizedMarkers:
        """Localize the markers of one frame. `state`: the newest, for a map with an origin on the earth."""
        markers, section = result.markers or (), camera.settings.camera
        error_text, down = "", False
        targets: tuple[MarkerTarget, ...] = ()
        boards: tuple[BoardTarget, ...] = ()
        vision = None
        try:
            # The mount first: whether the camera looks down does not depend on the vehicle's position.
            mount = mount_at(section.mount(), history, result.captured_ns)
            down = looks_down(section.model(result.width, result.height), mount)
            targets = marker_targets(
                markers,
                result.captured_ns,
                mount,
                history,
                self._on_pads[camera.name],
                self._resolvers[camera.name],
            )
            targets = self._confirmed(camera.name, targets)
            self._check_pads(camera, targets)
            boards = board_targets(result.boards, result.captured_ns, mount, history)
            if camera.name in self._maps and state is not None:
                confirmed = {target.identifier for target in targets if target.confirmed}
                vision = self._vision(camera, result, history, state, confirmed)
        except HistoryError as error:
            # As with detections: without an attitude at the capture they are published, but not targets.
            error_text, targets = str(error), ()
            self._runs.pop(camera.name, None)
        # Of an id that is seen twice at most one is true.
        times = Counter(target.identifier for target in targets)
        once = tuple(target for target in targets if times[target.identifier] == 1)
        if not error_text:
            once = self._associate(camera.name, once, history.at(result.captured_ns), result.captured_ns)
        self._seen[camera.name] = _SeenMarkers(result.captured_ns, once, down)
        return LocalizedMarkers(targets, boards, error_text, vision, self.objects(camera))

    def _associate(
        self, camera: str | None, targets: tuple[MarkerTarget, ...], pose: Pose, captured_ns: int
    ) -> tuple[MarkerTarget, ...]:
        """Update the objects of a camera; returns the markers with the offset of their pad's object."""
        table = self._objects[camera]
        detections = []
        for seen in object_detections(targets, pose.position_ned_m):
            known = None if seen.track_id is None else table.of_track(seen.track_id)
            # A frame without a marker that was confirmed is no reason to doubt it: the gate decides.
            goes_on = known is not None and known.confirmed and known.unseen_s(captured_ns) <= CONFIRM_GAP_S
            detections.append(replace(seen, trusted=seen.trusted or goes_on))
        updated = table.update(detections, pose.position_ned_m, captured_ns)
        places = {each.track_id: each.position_ned_m for each in updated if not each.occluded}
        placed = []
        for target in targets:
            if (place := places.get(target.pad)) is not None:
                north, east, down = pose.ned_from_body.T @ np.subtract(place, pose.position_ned_m)
                target = replace(target, pad_offset_frd_m=(float(north), float(east), float(down)))
            placed.append(target)
        return tuple(placed)

    def _vision(
        self,
        camera: PerceptionCamera,
        result: PerceptionResult,
        history: StateHistory,
        state: VehicleState,
        confirmed: set[int],
    ) -> VisionPosition | None:
        """The vehicle's position from the map, at most `MAX_VISION_HZ` times a second.

        One marker in one frame may be a false detection; two that agree with the map hardly are.
        """
        the_map = self._maps[camera.name]
        origin_ned_m = map_origin_ned_m(the_map.origin, state)
        board = next((board for board in result.boards if board.name == MAP), None)
        early = result.captured_ns - self._vision_ns < 0.9e9 / MAX_VISION_HZ
        if origin_ned_m is None or early:
            return None
        if board is None:
            if len(seen := confirmed & the_map.corners_m.keys()) > 1:
                self._gate.dropped += 1
                self._report(camera, result.captured_ns, seen, "these markers contradict each other", True)
            return None
        used = set(board.identifiers)
        if len(used) < 2 and not used <= confirmed:
            return None
        mount = camera.settings.camera.mount()
        vision = position_from_map(board, result.captured_ns, mount, history, origin_ned_m)
        if vision is None:
            tilt_rad = tilt_error_rad(board, result.captured_ns, mount, history)
            self._gate.dropped += 1
            words = f"its tilt differs from the autopilot's by {math.degrees(tilt_rad):.0f} degrees"
            self._report(camera, result.captured_ns, used, words, tilt_rad > TURNED_RAD)
            return None
        if state.position_valid is not False:
            pose = history.at(result.captured_ns)
            if off := self._gate.contradiction(vision, pose, state.reset_offset_ned_m):
                words = (
                    f"{off.distance_m:.1f} m ({off.allowed_m:.1f} m allowed) and "
                    f"{math.degrees(off.heading_rad):.0f} degrees of heading from the autopilot's estimate"
                )
                self._report(camera, result.captured_ns, used, words, abs(off.heading_rad) > TURNED_RAD)
                return None
        jump_m = self._gate.check(vision)
        if jump_m is None:
            self._vision_ns = result.captured_ns
            return vision
        self._report(camera, result.captured_ns, used, f"{jump_m:.1f} m from the last one sent", False)
        return None

    def _report(
        self, camera: PerceptionCamera, captured_ns: int, used: set[int], words: str, turned: bool
    ) -> None:
        """Publish why a position was dropped. `turned`: as if the prints were turned by 180 degrees."""
        text = (
            f"position from the map dropped, {words} "
            f"(markers {', '.join(map(str, sorted(used)))}; {self.vision_dropped} dropped so far)"
        )
        printed = self._maps[camera.name].print or camera.settings.markers.print
        checked = "markers.map_file and the markers' sizes"
        self._warn(captured_ns, text, _cause(camera, printed, checked, turned))

    def _check_pads(self, camera: PerceptionCamera, targets: Sequence[MarkerTarget]) -> None:
        """Publish that two markers of a pad disagree about its centre, as they do with turned prints."""
        for one, other in combinations([target for target in targets if target.confirmed], 2):
            apart_m = math.dist(one.pad_ned_m, other.pad_ned_m)
            # With turned prints, twice the distance between the two.
            between_m = math.dist(one.position_ned_m, other.position_ned_m)
            allowed_m = max(between_m, 3.0 * math.hypot(one.range_sigma_m, other.range_sigma_m))
            if one.pad == other.pad and apart_m > allowed_m:
                text = (
                    f"{one.identifier} and {other.identifier} disagree by {apart_m:.1f} m "
                    f"about the centre of pad {one.pad}"
                )
                cause = _cause(camera, camera.settings.markers.print, "markers.others", True)
                self._warn(one.captured_ns, text, cause)

    def _warn(self, captured_ns: int, text: str, cause: str) -> None:
        if captured_ns - self._event_ns >= EVENT_INTERVAL_S * 1e9:
            self._event_ns = captured_ns
            self._on_event("warning", f"markers: {text}: {cause}")

    def _confirmed(self, camera: str | None, targets: tuple[MarkerTarget, ...]) -> tuple[MarkerTarget, ...]:
        """The markers of one processed frame, `confirmed` where the frames before show them at that position.

        A frame without a marker, or with its id twice, begins again.
        """
        times = Counter(target.identifier for target in targets)
        before, runs = self._runs.get(camera, {}), {}
        for target in targets:
            if times[target.identifier] == 1:
                count, last = before.get(target.identifier, (0, target))
                runs[target.identifier] = (count + 1 if _continues(last, target) else 1, target)
        self._runs[camera] = runs
        return tuple(
            replace(target, confirmed=runs.get(target.identifier, (0, target))[0] >= CONFIRM_FRAMES)
            for target in targets
        )

    def discard_received(self) -> None:
        """What was received is outdated."""
        self._seen.clear()
        for table in self._objects.values():
            table.clear()
        self._runs.clear()

    def objects(self, camera: PerceptionCamera) -> tuple[TrackedObject, ...]:
        """A camera's markers as objects, as of its newest frame, one each."""
        table = self._objects.get(camera.name)
        return () if table is None else _one_each(table.objects)

    def objects_below(self) -> tuple[TrackedObject, ...]:
        """The markers of the cameras that look down, one each."""
        below = [self._objects[name].objects for name, seen in self._seen.items() if seen.looks_down]
        return _one_each(chain.from_iterable(below))

    def steering_sight(self, camera: PerceptionCamera, now_ns: int, max_age_s: float) -> MarkerSight:
        """Return the markers of the steering camera, for behaviours that fly to one."""
        if camera not in self._detecting:
            return NO_MARKERS
        seen = self._seen.get(camera.name)
        if seen is None:
            return MarkerSight(missing="")
        age_s = (now_ns - seen.captured_ns) / 1e9
        fresh = age_s <= max_age_s
        targets = seen.targets if fresh else ()
        return MarkerSight(targets, seen.captured_ns, age_s, fresh, "", camera.frozen(now_ns))

    def sight(self, now_ns: int, max_age_s: float) -> MarkerSight:
        """Return the markers of the cameras that look down, for behaviours."""
        if not self._detecting:
            return MarkerSight()
        down_of = {name: seen for name, seen in self._seen.items() if seen.looks_down}
        down = list(down_of.values())
        if self._seen and not down:
            return MarkerSight(missing=self._no_camera_below())
        if not down:
            return MarkerSight(missing="")
        newest_ns = max(seen.captured_ns for seen in down)
        age_s = (now_ns - newest_ns) / 1e9
        fresh = [seen for seen in down if now_ns - seen.captured_ns <= max_age_s * 1e9]
        targets = tuple(target for seen in fresh for target in seen.targets)
        looking = [camera for camera in self._detecting if camera.name in down_of]
        frozen = [why for camera in looking if (why := camera.frozen(now_ns))]
        return MarkerSight(targets, newest_ns, age_s, bool(fresh), "", "; ".join(frozen))

    def _no_camera_below(self) -> str:
        cameras = ", ".join(
            ("camera" if camera.name is None else f"cameras.{camera.name}.camera")
            + (
                "'s gimbal does not look down, or its attitude is unknown: use gimbal pitch=-90"
                if camera.settings.camera.on_gimbal
                else f".mount_pitch_deg is {camera.settings.camera.mount_pitch_deg:g}"
            )
            for camera in self._detecting
        )
        return f"a camera that sees straight down ({cameras})"


def _cause(camera: PerceptionCamera, printed: str, checked: str, turned: bool) -> str:
    """The likely cause of a contradiction. `turned`: as if the prints were turned by 180 degrees."""
    dictionary = camera.settings.markers.dictionary
    if not turned or dictionary is None or not is_apriltag(dictionary):
        return f"check {checked}"
    other = "apriltag" if printed == "opencv" else "opencv"
    return (
        "AprilRobotics' prints are turned by 180 degrees against OpenCV's: if these are "
        f'{other}\'s, set markers.print = "{other}"; else check {checked}'
    )


def _one_each(objects: Iterable[TrackedObject]) -> tuple[TrackedObject, ...]:
    """The newest confirmed object of each marker: after a gap, or of another camera, it is another one."""
    best: dict[str, TrackedObject] = {}
    for each in sorted(objects, key=lambda each: (each.confirmed, each.last_ns)):
        best[each.class_name] = each
    return tuple(best.values())


def _continues(last: MarkerTarget, target: MarkerTarget) -> bool:
    """Whether two detections of an id in successive frames are one marker."""
    allowed_m = max(CONFIRM_DISTANCE_M, 3.0 * math.hypot(last.range_sigma_m, target.range_sigma_m))
    return (
        target.captured_ns - last.captured_ns <= CONFIRM_GAP_S * 1e9
        and math.dist(last.position_ned_m, target.position_ned_m) <= allowed_m
    )
