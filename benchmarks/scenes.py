"""Rendered sequences with known truth: people and cars, seen from a vehicle that sways and turns."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mavlink_sim.camera.renderer import Renderer
from mavlink_sim.world.world import Ground, World, WorldObject
from vision.attitude import Quaternion, quaternion_from_euler
from vision.camera_model import CameraModel, CameraMount
from vision.detections import Detections
from vision.rotation import matrix_from_quaternion

CAMERA = CameraModel.from_horizontal_fov(640, 480, math.radians(70.0))
MOUNT = CameraMount(forward_m=0.1, pitch_rad=math.radians(-20.0))
HEIGHT_M = 7.0
CLASS_NAMES = ("person", "car", "dog", "truck")

# What is less to be seen than this share of it, or smaller than so many pixels, nobody can ask for.
LEAST_VISIBLE = 0.25
LEAST_PIXELS = 60


@dataclass(frozen=True, slots=True)
class Motion:
    """How the vehicle moves. Angles in radians, at seconds from the start.

    Attributes:
        attitude: roll, pitch, yaw.
        position: north, east of the start, metres.
    """

    name: str
    attitude: Callable[[float], tuple[float, float, float]]
    position: Callable[[float], tuple[float, float]] = lambda _: (0.0, 0.0)

    def attitude_wxyz(self, time_s: float) -> Quaternion:
        return quaternion_from_euler(*self.attitude(time_s))


def _gusts(time_s: float) -> tuple[float, float, float]:
    """A small quadrotor held in place in gusty wind: up to 9° of roll and 7° of pitch."""
    return (
        math.radians(6.0 * math.sin(4.4 * time_s) + 3.0 * math.sin(7.9 * time_s + 1.0)),
        math.radians(4.5 * math.sin(5.3 * time_s + 0.5) + 2.5 * math.sin(9.1 * time_s)),
        math.radians(5.0 * math.sin(2.1 * time_s)),
    )


def _turning(time_s: float) -> tuple[float, float, float]:
    """Looking from side to side, 25° to the left and right, at 60° a second at most."""
    return (
        math.radians(1.5 * math.sin(3.0 * time_s)),
        math.radians(1.5 * math.sin(2.3 * time_s)),
        math.radians(25.0) * math.sin(2.4 * time_s),
    )


MOTIONS = (
    Motion("still", lambda _: (0.0, 0.0, 0.0)),
    Motion("gusts", _gusts, lambda time_s: (0.4 * math.sin(0.9 * time_s), 0.5 * math.sin(1.3 * time_s))),
    Motion("turning", _turning),
)


@dataclass(frozen=True, slots=True)
class Walker:
    """An object that goes to and fro on a straight way, from `start` to `end` (north, east) in metres."""

    class_name: str
    start: tuple[float, float]
    end: tuple[float, float]
    speed_mps: float
    appearance: int
    phase_s: float = 0.0

    def at(self, identifier: int, time_s: float) -> WorldObject:
        north, east = self.end[0] - self.start[0], self.end[1] - self.start[1]
        length = math.hypot(north, east)
        gone = self.speed_mps * (time_s + self.phase_s) % (2 * length)
        back = gone > length
        share = (2 * length - gone if back else gone) / length
        yaw = math.atan2(-east, -north) if back else math.atan2(east, north)
        place = (self.start[0] + share * north, self.start[1] + share * east, 0.0)
        return WorldObject(identifier, self.class_name, place, yaw, 1.0, self.appearance)


def walkers(seed: int = 0, people: int = 7) -> tuple[Walker, ...]:
    """People who cross each other's ways, a dog, and two cars behind them."""
    rng = np.random.default_rng((seed, 11))
    found = []
    for index in range(people):
        north = 11.0 + 13.0 * index / max(1, people - 1) + float(rng.uniform(-0.8, 0.8))
        slant = float(rng.uniform(-2.5, 2.5))
        reach = 0.42 * north
        ends = [(north - slant, -reach), (north + slant, reach)]
        if rng.random() < 0.5:
            ends.reverse()
        found.append(
            Walker(
                "person",
                ends[0],
                ends[1],
                float(rng.uniform(0.9, 2.2)),
                int(rng.integers(2**31)),
                float(rng.uniform(0, 12)),
            )
        )
    found.append(Walker("dog", (13.0, 4.5), (15.0, -4.5), 2.6, int(rng.integers(2**31))))
    for north, speed in ((27.0, 5.0), (32.0, 4.0)):
        found.append(
            Walker(
                "car",
                (north, -12.0),
                (north, 12.0),
                speed,
                int(rng.integers(2**31)),
                float(rng.uniform(0, 6)),
            )
        )
    return tuple(found)


# What hides those who pass behind it; the truck is there to be seen itself.
FURNITURE = (
    ("truck", (20.0, 5.0), 1.2),
    ("bush", (14.0, -2.0), 0.3),
    ("bush", (17.5, -5.0), 1.0),
    ("tree", (16.0, 2.5), 0.0),
    ("pole", (12.5, 1.0), 0.0),
)


@dataclass(frozen=True, slots=True, eq=False)
class SceneFrame:
    """One frame of a sequence and the truth of it.

    Attributes:
        time_s: since the start. captured_ns: the same as a stamp, never 0.
        image: (480, 640, 3) uint8 BGR.
        identity: of every object with a name in `CLASS_NAMES` of which anything is seen.
        class_id: of each.
        xyxy: (N, 4) float32 pixels, around its visible pixels.
        visible: (N,) share of it that is seen.
        counts: (N,) enough is seen that it can be asked for.
    """

    time_s: float
    captured_ns: int
    image: NDArray[np.uint8]
    identity: NDArray[np.int64]
    class_id: NDArray[np.int64]
    xyxy: NDArray[np.float32]
    visible: NDArray[np.float64]
    counts: NDArray[np.bool_]


def scene_frames(
    motion: Motion, *, seconds: float, rate_hz: float, seed: int = 0, drop: float = 0.0, people: int = 7
) -> Iterator[SceneFrame]:
    """Draw a sequence.

    Args:
        drop: share of frames that are missing, as a busy small computer leaves them out.
    """
    rng = np.random.default_rng((seed, 12))
    moving = walkers(seed, people)
    fixed = tuple(
        WorldObject(len(moving) + index, name, (*place, 0.0), yaw, 1.0, seed * 100 + index)
        for index, (name, place, yaw) in enumerate(FURNITURE)
    )
    ground = Ground(("meadow", "grass"), seed, 512, 0.08)
    renderer = Renderer(World((), ground), CAMERA, MOUNT)
    for index in range(round(seconds * rate_hz)):
        if index and rng.random() < drop:
            continue
        time_s = index / rate_hz
        objects = tuple(walker.at(number, time_s) for number, walker in enumerate(moving)) + fixed
        renderer.place(objects)
        north, east = motion.position(time_s)
        rendered = renderer.render(
            (north, east, -HEIGHT_M), matrix_from_quaternion(motion.attitude_wxyz(time_s))
        )
        seen = [item for item in rendered.objects if item.world_object.class_name in CLASS_NAMES]
        visible = np.array([item.visible_fraction for item in seen])
        pixels = np.array([item.pixel_count for item in seen])
        yield SceneFrame(
            time_s=time_s,
            captured_ns=1_000_000_000 + round(time_s * 1e9),
            image=rendered.image,
            identity=np.array([item.world_object.identifier for item in seen], np.int64),
            class_id=np.array([CLASS_NAMES.index(item.world_object.class_name) for item in seen], np.int64),
            xyxy=np.array([item.xyxy for item in seen], np.float32).reshape(-1, 4),
            visible=visible,
            counts=(visible >= LEAST_VISIBLE) & (pixels >= LEAST_PIXELS),
        )


class SyntheticDetector:
    """Detections made of the truth, with a detector's faults, so that only the tracker is on trial.

    Boxes are off by 4 % of their size; what is half hidden is seen with less confidence and missed more
    often; now and then there is something that is not there.
    """

    def __init__(self, seed: int = 0) -> None:
        self._rng = np.random.default_rng((seed, 13))

    def detect(self, frame: SceneFrame) -> Detections:
        rng = self._rng
        count = len(frame.identity)
        sides = frame.xyxy[:, 2:] - frame.xyxy[:, :2]
        noise = rng.normal(0.0, 0.04, (count, 4)) * np.tile(sides, 2)
        confidence = 0.12 + 0.66 * np.minimum(1.0, frame.visible / 0.8) + rng.normal(0.0, 0.07, count)
        found = rng.random(count) < np.where(frame.visible > 0.6, 0.95, 0.8)
        found &= (sides.min(axis=1) >= 4.0) & (frame.visible > 0.1)
        boxes = [(frame.xyxy + noise)[found]]
        confidences, classes = [confidence[found]], [frame.class_id[found]]
        for _ in range(int(rng.poisson(0.4))):
            width, height = rng.uniform(12, 60, 2)
            left, top = rng.uniform(0, CAMERA.width - width), rng.uniform(120, CAMERA.height - height)
            boxes.append(np.array([[left, top, left + width, top + height]]))
            confidences.append(rng.uniform(0.1, 0.5, 1))
            classes.append(rng.integers(0, len(CLASS_NAMES), 1))
        return Detections(
            np.concatenate(boxes).astype(np.float32),
            np.concatenate(confidences).clip(0.02, 0.98).astype(np.float32),
            np.concatenate(classes).astype(np.int64),
            CLASS_NAMES,
        )


def without_image(frame: SceneFrame) -> SceneFrame:
    """The frame's truth alone: a long sequence's images are large."""
    return replace(frame, image=np.zeros((1, 1, 3), np.uint8))
