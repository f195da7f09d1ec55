"""What nearer objects leave to see of a farther one."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from companion.bench.synthetic_detector import Faults, SceneObject, ScenePose, SyntheticDetector
from companion.vehicle.state import Vector3
from vision.camera_model import CameraModel, CameraMount

CAMERA = CameraModel.from_horizontal_fov(640, 480, math.radians(80.0))
MOUNT = CameraMount(pitch_rad=math.radians(-10.0), stabilized=True)
EXACT = Faults(jitter=0.0, missed=0.0, false_per_frame=0.0)
CAR_M = (4.0, 2.0, 1.5)


def thing(name: str, size_m: Vector3, north_m: float, east_m: float = 0.0) -> SceneObject:
    return SceneObject(name, size_m, lambda _: ScenePose(north_m, east_m, math.pi / 2))


def cars_behind(*nearer: SceneObject) -> NDArray[np.float32]:
    """(N, 4) the box of a car 20 m to the north, seen from 3 m above the ground; N = 0: not detected."""
    detector = SyntheticDetector([thing("car", CAR_M, 20.0), *nearer], CAMERA, MOUNT, faults=EXACT)
    found = detector((0.0, 0.0, -3.0), (1.0, 0.0, 0.0, 0.0), 0.0)
    boxes: NDArray[np.float32] = found.xyxy[found.class_id == 0]
    return boxes


[ALONE] = cars_behind()


def test_nothing_before_it_leaves_the_box_whole() -> None:
    for other in (thing("person", (0.5, 0.6, 1.7), 15.0, 9.0), thing("", CAR_M, 26.0)):
        assert np.array_equal(cars_behind(other), [ALONE])


@pytest.mark.parametrize(
    ("size_m", "east_m", "edge"),
    [
        ((8.0, 1.0, 1.2), 0.0, 3),  # a low wall before the whole car
        ((2.0, 0.3, 6.0), -1.5, 0),  # high ones before its sides
        ((2.0, 0.3, 6.0), 1.5, 2),
    ],
)
def test_nearer_box_over_its_span_moves_one_edge(size_m: Vector3, east_m: float, edge: int) -> None:
    [box] = cars_behind(thing("", size_m, 14.0, east_m))
    assert np.flatnonzero(box != ALONE).tolist() == [edge]
    middle = (ALONE[edge] + ALONE[edge - 2]) / 2
    assert abs(box[edge] - middle) < abs(ALONE[edge] - middle) - 5.0


def test_covered_corner_leaves_the_box_whole() -> None:
    assert np.array_equal(cars_behind(thing("", (2.0, 1.0, 1.2), 14.0, 1.5)), [ALONE])


def test_mostly_hidden_object_is_not_detected() -> None:
    assert not len(cars_behind(thing("", (8.0, 1.0, 2.0), 14.0)))
