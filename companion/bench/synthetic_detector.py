"""A detector made of the truth: boxes projected through the camera's model, with a detector's faults.

Many flights of a behaviour cannot each run a network. Here boxes are off by a share of their size, single
frames miss an object, what is half hidden is seen with less confidence, and now and then something is seen
that is not there. Objects are upright boxes on level ground, which hide each other: a box bounds what is left
to see of an object.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from companion.guidance.objects.from_detections import CONTACT_INSET_M
from companion.vehicle.state import Quaternion, Vector3
from vision.camera_model import CameraModel, CameraMount
from vision.detections import Detections
from vision.rotation import matrix_from_quaternion

# Of an object's outline inside the image and not hidden: with less it is not found.
LEAST_VISIBLE = 0.35
LEAST_PIXELS = 5.0
NEAR_M = 0.1
# Rays of a box, from its middle in halves of its sides.
GRID = np.array([[x, y] for x in np.linspace(-0.98, 0.98, 13) for y in np.linspace(-0.98, 0.98, 13)])
CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-1.0, 0.0)])
ON_GROUND = CORNERS[:, 2] == 0.0


@dataclass(frozen=True, slots=True)
class ScenePose:
    """Where something stands: north, east in metres, heading in radians."""

    north_m: float
    east_m: float
    yaw_rad: float = 0.0


@dataclass(frozen=True, slots=True)
class SceneObject:
    """An upright box on the ground.

    Attributes:
        class_name: as the detector calls it; empty: it only hides others.
        size_m: length, width, height.
        pose: at seconds of the flight.
        hidden: at seconds of the flight it is behind something that is not drawn.
    """

    class_name: str
    size_m: Vector3
    pose: Callable[[float], ScenePose]
    hidden: Callable[[float], bool] = lambda _: False

    def range_m(self, place: Sequence[float], seconds: float) -> float:
        """Horizontal metres from (north, east) to the nearest point of its footprint, 0 inside."""
        pose = self.pose(seconds)
        north, east = place[0] - pose.north_m, place[1] - pose.east_m
        c, s = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
        along = max(abs(c * north + s * east) - self.size_m[0] / 2, 0.0)
        across = max(abs(c * east - s * north) - self.size_m[1] / 2, 0.0)
        return math.hypot(along, across)


@dataclass(frozen=True, slots=True)
class Faults:
    """What is wrong with the detector. Shares 0..1; the jitter is one sigma of the box's own side."""

    jitter: float = 0.03
    missed: float = 0.10
    false_per_frame: float = 0.25
    range_sigma: float = 0.03


@dataclass(frozen=True, slots=True)
class _Outline:
    thing: int
    xyxy: NDArray[np.float64]
    nearest_m: float
    inside: float


class SyntheticDetector:
    """Callable as `synthetic_camera`. The same seed and calls give the same detections.

    Args:
        with_depth: detections have a range, as with a depth camera.
        gimbal: gives the true attitude of the camera's gimbal, (w, x, y, z), its FRD to NED; for a mount on
            one.
    """

    def __init__(
        self,
        things: Sequence[SceneObject],
        camera: CameraModel,
        mount: CameraMount,
        *,
        seed: int = 0,
        with_depth: bool = False,
        faults: Faults | None = None,
        gimbal: Callable[[], Quaternion] | None = None,
    ) -> None:
        self._gimbal = gimbal
        self._things, self._camera, self._mount = tuple(things), camera, mount
        self._corners = [_corners(thing) for thing in things]
        self._with_depth, self._faults = with_depth, faults or Faults()
        self._rng = np.random.default_rng((seed, 71))
        self.class_names = tuple(dict.fromkeys(thing.class_name for thing in things if thing.class_name))

    def __call__(self, position_ned_m: Vector3, attitude: Quaternion, seconds: float) -> Detections:
        """What is seen from a true pose (attitude: body FRD to NED)."""
        ned_from_body = matrix_from_quaternion(attitude)
        eye = np.asarray(position_ned_m) + ned_from_body @ self._mount.position_frd_m
        mount = self._mount
        if self._gimbal is not None:
            mount = mount.held(matrix_from_quaternion(self._gimbal()))
        optical_from_ned = mount.ned_from_optical(ned_from_body).T
        rng, faults = self._rng, self._faults
        boxes: list[NDArray[np.float64]] = []
        confidences, classes, nearest = [], [], []
        outlines = self._outlines(eye, optical_from_ned, seconds)
        for outline in outlines:
            thing = self._things[outline.thing]
            missed, shake = rng.random() < faults.missed, rng.normal(0.0, faults.jitter, 4)
            unsure, far = rng.normal(0.0, 0.06), rng.normal(0.0, faults.range_sigma)
            shown, share = _not_hidden(outline, outlines)
            sides, visible = np.tile(shown[2:] - shown[:2], 2), outline.inside * share
            if (
                not thing.class_name
                or thing.hidden(seconds)
                or missed
                or visible < LEAST_VISIBLE
                or sides.min() < LEAST_PIXELS
            ):
                continue
            box = shown + shake * sides
            boxes.append(box)
            confidences.append(0.15 + 0.65 * min(1.0, visible / 0.8) + unsure)
            classes.append(self.class_names.index(thing.class_name))
            point = np.full(3, math.nan)
            if self._with_depth:
                point = self._nearest(thing, box, eye, optical_from_ned, seconds)
            nearest.append(point * (1.0 + far))
        for _ in range(int(rng.poisson(faults.false_per_frame))):
            width, height = rng.uniform(10, 80, 2)
            left = rng.uniform(0, self._camera.width - width)
            top = rng.uniform(0, self._camera.height - height)
            boxes.append(np.array([left, top, left + width, top + height]))
            confidences.append(rng.uniform(0.1, 0.5))
            classes.append(int(rng.integers(len(self.class_names))))
            depth_m = rng.uniform(2.0, 30.0) if self._with_depth else math.nan
            ray = self._camera.rays(np.array([[left + width / 2, top + height / 2]]))[0]
            nearest.append(ray / ray[2] * depth_m)
        if not boxes:
            return Detections.empty(self.class_names)
        limits = (float(self._camera.width), float(self._camera.height)) * 2
        return Detections(
            np.clip(np.array(boxes), 0.0, limits).astype(np.float32),
            np.clip(confidences, 0.02, 0.98).astype(np.float32),
            np.array(classes, np.int64),
            self.class_names,
            np.array(nearest, np.float32),
        )

    def _outlines(
        self, eye: NDArray[np.float64], optical_from_ned: NDArray[np.float64], seconds: float
    ) -> list[_Outline]:
        """Of each object that is wholly ahead of the camera and partly in its image."""
        corners = np.empty((len(self._things), len(CORNERS), 3))
        for index, thing in enumerate(self._things):
            pose = thing.pose(seconds)
            c, s = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
            turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
            corners[index] = self._corners[index] @ turn.T + (pose.north_m, pose.east_m, 0.0)
        points = (corners - eye) @ optical_from_ned.T
        pixels = self._camera.project(points).reshape(-1, len(CORNERS), 2)
        wholes = np.concatenate([pixels.min(axis=1), pixels.max(axis=1)], axis=1) + 0.5  # edges, not pixels
        shown = np.clip(wholes, 0.0, (float(self._camera.width), float(self._camera.height)) * 2)
        areas, kept = (np.prod(boxes[:, 2:] - boxes[:, :2], axis=1) for boxes in (wholes, shown))
        nearest_m = np.linalg.norm(points, axis=2).min(axis=1)
        # The box of an object with a corner that the lens cannot see is NaN, and so is its part in the image:
        # NaN > 0 is False.
        return [
            _Outline(int(index), shown[index], float(nearest_m[index]), float(kept[index] / areas[index]))
            for index in np.flatnonzero((points[:, :, 2].min(axis=1) >= NEAR_M) & (kept > 0.0))
        ]

    def _nearest(
        self,
        thing: SceneObject,
        box: NDArray[np.float64],
        eye: NDArray[np.float64],
        optical_from_ned: NDArray[np.float64],
        seconds: float,
    ) -> NDArray[np.float64]:
        """(3,) the horizontally nearest point of the object in its box, optical frame, as in `vision.depth`.

        Rays through the box meet the object's sides (slab method).
        """
        pose = thing.pose(seconds)
        c, s = math.cos(pose.yaw_rad), math.sin(pose.yaw_rad)
        to_object = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        middle, half = (box[:2] + box[2:]) / 2 - 0.5, (box[2:] - box[:2]) / 2
        pixels = middle + GRID * half
        rays = self._camera.rays(pixels)
        rays /= rays[:, 2:]
        directions = rays @ (to_object @ optical_from_ned.T).T
        origin = to_object @ (eye - (pose.north_m, pose.east_m, 0.0))
        length, width, height = thing.size_m
        low, high = np.array([-length / 2, -width / 2, -height]), np.array([length / 2, width / 2, 0.0])
        with np.errstate(divide="ignore"):
            first, second = (low - origin) / directions, (high - origin) / directions
        enters, leaves = np.minimum(first, second).max(axis=1), np.maximum(first, second).min(axis=1)
        met = (leaves >= enters) & (enters > 0.0)
        ranges_m = np.where(met, enters * np.hypot(directions[:, 0], directions[:, 1]), np.inf)
        index = int(ranges_m.argmin())
        point: NDArray[np.float64] = rays[index] * (enters[index] if met[index] else math.nan)
        return point


def _corners(thing: SceneObject) -> NDArray[np.float64]:
    """(8, 3) corners of the object's box, in the order of `CORNERS`.

    In metres forward, right and down of the middle of its base.
    """
    corners = CORNERS * thing.size_m
    # As of real things, wheels and feet stand behind the surface; small things stand on nearly all of it.
    inset_m = np.minimum(np.array(thing.size_m[:2]) / 8, CONTACT_INSET_M)
    corners[ON_GROUND, :2] -= CORNERS[ON_GROUND, :2] * 2 * inset_m
    return np.asarray(corners, np.float64)


def _not_hidden(outline: _Outline, outlines: Sequence[_Outline]) -> tuple[NDArray[np.float64], float]:
    """The box around what is left of an outline behind what is nearer, and its share of the outline.

    A nearer outline that spans the box moves the edge that it covers; one that covers a corner moves none.
    """
    box, least = outline.xyxy.copy(), 1.0
    area = float(np.prod(box[2:] - box[:2]))
    for other in outlines:
        if other.thing == outline.thing or other.nearest_m >= outline.nearest_m:
            continue
        low, high = np.maximum(outline.xyxy[:2], other.xyxy[:2]), np.minimum(outline.xyxy[2:], other.xyxy[2:])
        least = min(least, 1.0 - float(np.prod(np.maximum(high - low, 0.0))) / area)
        for along in (0, 1):
            across = 1 - along
            if other.xyxy[across] > box[across] or other.xyxy[across + 2] < box[across + 2]:
                continue
            begin, end = other.xyxy[along], other.xyxy[along + 2]
            if begin <= box[along]:
                box[along] = max(box[along], min(end, box[along + 2]))
            elif end >= box[along + 2]:
                box[along + 2] = min(box[along + 2], begin)
    return box, min(least, float(np.prod(box[2:] - box[:2])) / area)
