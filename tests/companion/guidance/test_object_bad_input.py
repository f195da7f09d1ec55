"""What a camera may send that is wrong: the table of objects stays one that can be flown to."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.rendered import camera_settings
from companion.bench.lockstep_flight import LockstepFlight
from companion.bench.synthetic_camera import SyntheticCamera
from companion.bench.synthetic_detector import SceneObject, ScenePose, SyntheticDetector
from companion.guidance.objects.table import MOST_OBJECTS, ObjectTable
from companion.guidance.objects.target import Target
from companion.guidance.objects.tracked_object import TrackedObject
from companion.vehicle.state import Vector3
from tests.companion.guidance.guidance_harness import assert_succeeded, in_the_air
from tests.companion.guidance.one_object import PERIOD_NS, T0, VEHICLE, seen_car
from vision.attitude import Quaternion
from vision.camera_model import CameraModel, CameraMount
from vision.detections import Detections

HERE, THERE = (20.0, 0.0), (45.0, 10.0)
NAN, INF = math.nan, math.inf
Frame = Callable[[int], Sequence[Target]]


def car(at: tuple[float, float], frame: int, track_id: int = 7, **changes: Any) -> Target:
    return replace(seen_car(at, frame, track_id=track_id), **changes)


def fed(frames: Frame, count: int = 30) -> ObjectTable:
    table = ObjectTable()
    for number in range(count):
        table.update(frames(number), VEHICLE, T0 + number * PERIOD_NS)
        check(table.objects)
    return table


def check(objects: Sequence[TrackedObject]) -> None:
    """Every number is one, covariances are positive, and identities are unique."""
    for each in objects:
        covariance = np.array(each.covariance)
        numbers = (*(each.position_ned_m or ()), *each.velocity_ned_mps, *covariance.flat, each.doubt)
        assert all(map(math.isfinite, numbers)), each
        assert np.linalg.eigvalsh((covariance + covariance.T) / 2.0)[0] > -1e-6, each
        assert each.first_ns <= each.last_ns
        assert each.position_ned_m is None or each.located(each.last_ns) or each.located_ns > 0
    ids = [each.object_id for each in objects]
    tracks = [track_id for each in objects for track_id in each.track_ids]
    assert len(set(ids)) == len(ids)
    assert len(set(tracks)) == len(tracks), "one id of the image tracker is of one object"


def place(each: TrackedObject) -> tuple[float, float]:
    assert each.position_ned_m is not None
    return (round(each.position_ned_m[0], 1), round(each.position_ned_m[1], 1))


# What is wrong → the objects' ids, track ids and places after 30 frames.
SEQUENCES: dict[str, tuple[Frame, list[tuple[int, tuple[int, ...], tuple[float, float]]]]] = {
    "it jumps for good": (
        lambda frame: [car(HERE if frame < 10 else THERE, frame)],
        [(1, (7,), THERE)],
    ),
    "it jumps for two frames": (
        lambda frame: [car(THERE if frame in (10, 11) else HERE, frame)],
        [(1, (7,), HERE)],
    ),
    "it is here and there in turn": (
        lambda frame: [car(THERE if frame % 2 else HERE, frame)],
        [(1, (7,), HERE)],
    ),
    "two ids on one object": (
        lambda frame: [car(HERE, frame), car((20.1, 0.05), frame, 8)],
        [(1, (7,), HERE)],
    ),
    "two ids in turn on one object": (
        lambda frame: [car(HERE, frame, 7 + frame % 2)],
        [(1, (7, 8), HERE)],
    ),
    "one id on two objects": (
        lambda frame: [car((15.0, 8.0), frame, confidence=0.5), car(HERE, frame)],
        [(1, (7,), HERE)],
    ),
    "two objects exchange their ids": (
        lambda frame: [
            car(HERE, frame, 7 if frame < 15 else 8),
            car((15.0, 8.0), frame, 8 if frame < 15 else 7),
        ],
        [(1, (8,), HERE), (2, (7,), (15.0, 8.0))],
    ),
    "its class flips": (
        lambda frame: [car(HERE, frame, class_name="truck" if frame % 2 else "car")],
        [(1, (7,), HERE)],
    ),
    "no frame has anything": (lambda frame: [], []),
}  # fmt: skip


@pytest.mark.parametrize("what", SEQUENCES)
def test_wrong_sequence_leaves_the_object(what: str) -> None:
    frames, expected = SEQUENCES[what]
    objects = fed(frames).objects
    assert [(each.object_id, each.track_ids, place(each)) for each in objects] == expected
    assert all(each.class_name == "car" for each in objects), "that of the first frame"


def test_class_that_flips_for_good_is_in_doubt() -> None:
    (each,) = fed(lambda frame: [car(HERE, frame, class_name="car" if frame < 10 else "truck")]).objects
    assert (each.class_name, each.ambiguous, each.certain) == ("car", True, False)
    assert each.doubt == pytest.approx(20 / 30)


@pytest.mark.parametrize("number", [4, 9])
def test_late_or_repeated_frame_changes_nothing(number: int) -> None:
    table = fed(lambda frame: [car(HERE, frame)], 10)
    before = table.objects
    assert table.update([car(THERE, number)], VEHICLE, T0 + number * PERIOD_NS) is before


def test_old_detection_in_a_new_frame_is_not_seen() -> None:
    table = fed(lambda frame: [car(HERE, frame)], 10)
    (each,) = table.update([car(THERE, 4)], VEHICLE, T0 + 10 * PERIOD_NS)
    assert (each.occluded, place(each), each.last_ns) == (True, HERE, T0 + 9 * PERIOD_NS)


def test_frame_without_a_place_of_the_vehicle_changes_nothing() -> None:
    table = fed(lambda frame: [car(HERE, frame)], 10)
    before = table.objects
    assert table.update([car(HERE, 10)], (NAN, 0.0, -5.0), T0 + 10 * PERIOD_NS) is before


WRONG: dict[str, dict[str, Any]] = {
    "position is no number": {"position_ned_m": (NAN, NAN, NAN)},
    "north is no number": {"position_ned_m": (NAN, 1.0, 0.0)},
    "down is no number": {"position_ned_m": (20.0, 0.0, NAN)},
    "position is infinite": {"position_ned_m": (INF, 1.0, 0.0)},
    "position is beyond the earth": {"position_ned_m": (1e200, 1.0, 0.0)},
    "position is the vehicle's": {"position_ned_m": (0.0, 0.0, -5.0), "ground_range_m": 0.0},
    "bearing is no number": {"bearing_rad": NAN},
    "bearing is infinite": {"bearing_rad": INF},
    "elevation is no number": {"elevation_rad": NAN},
    "bearing alone is no number": {"bearing_rad": NAN, "position_ned_m": None},
    "range is no number": {"ground_range_m": NAN},
    "range is negative": {"ground_range_m": -3.0},
    "range is infinite": {"ground_range_m": INF},
    "sigma is no number": {"range_sigma_m": NAN},
    "sigma is infinite": {"range_sigma_m": INF},
    "sigma is zero": {"range_sigma_m": 0.0, "across_sigma_m": 0.0},
    "sigma is negative": {"range_sigma_m": -1.0},
    "vehicle's sigma is no number": {"vehicle_sigma_m": NAN},
    "vehicle's sigma is infinite": {"vehicle_sigma_m": INF},
    "box has no size": {"box_xyxy": (5.0, 5.0, 5.0, 5.0)},
    "box is turned over": {"box_xyxy": (9.0, 9.0, 5.0, 5.0)},
    "box is no number": {"box_xyxy": (NAN,) * 4},
    "confidence is no number": {"confidence": NAN},
}  # fmt: skip


@pytest.mark.parametrize("when", [range(1), range(4, 7), range(30)], ids=["first", "middle", "always"])
@pytest.mark.parametrize("what", WRONG)
def test_wrong_number_of_one_detection_stays_there(what: str, when: range) -> None:
    table = fed(lambda frame: [car(HERE, frame, **(WRONG[what] if frame in when else {}))])
    if len(when) < 10:
        assert [place(each) for each in table.objects] == [HERE]


@pytest.mark.parametrize("what", WRONG)
def test_wrong_detection_beside_it_does_not_move_an_object(what: str) -> None:
    table = fed(lambda frame: [car(HERE, frame), car((30.0, 12.0), frame, 9, **WRONG[what])])
    assert (table.objects[0].track_ids, place(table.objects[0])) == ((7,), HERE)


NUMBERS = st.one_of(
    st.floats(), st.floats(-60.0, 60.0), st.sampled_from([0.0, NAN, INF, -INF, 1e-300, 1e300])
)
DETECTIONS = st.lists(
    st.builds(
        lambda at, track_id, name, changes: (at, track_id, name, changes),
        st.tuples(st.floats(-40.0, 40.0), st.floats(-40.0, 40.0)),
        st.one_of(st.none(), st.integers(1, 4)),
        st.sampled_from(["car", "truck"]),
        st.one_of(
            st.just({}),
            st.fixed_dictionaries(
                {},
                optional={
                    "position_ned_m": st.one_of(st.none(), st.tuples(NUMBERS, NUMBERS, NUMBERS)),
                    "bearing_rad": NUMBERS,
                    "elevation_rad": NUMBERS,
                    "ground_range_m": NUMBERS,
                    "range_sigma_m": NUMBERS,
                    "across_sigma_m": NUMBERS,
                    "vehicle_sigma_m": NUMBERS,
                    "confidence": NUMBERS,
                    "box_xyxy": st.tuples(NUMBERS, NUMBERS, NUMBERS, NUMBERS),
                    "cut": st.booleans(),
                    "cut_above": st.booleans(),
                    "trusted": st.booleans(),
                },
            ),
        ),
    ),
    max_size=4,
)


@settings(max_examples=60, deadline=None)
@given(st.lists(st.tuples(st.integers(-2, 20), DETECTIONS), max_size=8))
def test_no_input_breaks_the_table(frames: list[tuple[int, list[Any]]]) -> None:
    table, captured_ns = ObjectTable(), T0
    for step, detections in frames:
        captured_ns += step * PERIOD_NS
        targets = []
        for at, track_id, name, changes in detections:
            at = at if math.hypot(*at) > 0.1 else (1.0, 1.0)
            target = seen_car(at)
            targets.append(
                replace(target, captured_ns=captured_ns, track_id=track_id, class_name=name, **changes)
            )
        check(table.update(targets, VEHICLE, captured_ns))


def test_a_hundred_objects_keep_their_identities() -> None:
    bearings = [math.tau * index / 100.0 for index in range(100)]
    ranges_m = np.random.default_rng(1).uniform(15.0, 60.0, 100)
    places = [(r * math.cos(b), r * math.sin(b)) for r, b in zip(ranges_m, bearings, strict=True)]

    def frame(number: int) -> list[Target]:
        # A third of them is not detected for a second.
        hidden = range(0, 100, 3) if 10 <= number < 20 else ()
        return [car(at, number, 1 + index) for index, at in enumerate(places) if index not in hidden]

    objects = fed(frame).objects
    assert [each.track_ids for each in objects] == [(1 + index,) for index in range(100)]
    assert all(math.dist(place(each), at) < 0.2 for each, at in zip(objects, places, strict=True))


def test_objects_of_a_flickering_detector_are_bounded() -> None:
    table = ObjectTable()
    for number in range(40):
        targets = [car((20.0 + index, 3.0 * number), number, 1 + 20 * number + index) for index in range(20)]
        table.update(targets, VEHICLE, T0 + number * PERIOD_NS)
    assert len(table.objects) <= MOST_OBJECTS


def test_no_object_gets_the_number_of_a_forgotten_one() -> None:
    table = ObjectTable()
    before = table.update([car((20.0, 0.0), 0, 3)], VEHICLE, T0)
    table.clear()
    assert table.objects == ()
    after = table.update([car((20.0, 0.0), 1, 3)], VEHICLE, T0 + PERIOD_NS)
    assert [each.object_id for each in after] == [before[0].object_id + 1]


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2))])
def test_approach_arrives_among_wrong_boxes(seed: int) -> None:
    """Without a size, turned over, outside of the image, of no numbers, twice, of other classes."""
    camera, mount = (
        CameraModel.from_horizontal_fov(640, 480, math.radians(80.0)),
        CameraMount(pitch_rad=-0.26),
    )
    scene = [SceneObject("car", (4.2, 1.8, 1.5), lambda _: ScenePose(18.0, 1.0, 0.3))]
    detector = SyntheticDetector(scene, camera, mount, seed=seed)
    rng = np.random.default_rng(seed)
    boxes = np.array(
        [
            (300, 200, 300, 200),
            (340, 260, 300, 200),
            (-500, -500, 5000, 5000),
            (NAN, NAN, NAN, NAN),
            (1e30, 0, 1e30, 1e30),
        ],
        np.float32,
    )

    def wrong(place: Vector3, attitude: Quaternion, seconds: float) -> Detections:
        found = detector(place, attitude, seconds)
        also = boxes[rng.random(len(boxes)) < 0.3]
        count = len(also)
        names = found.class_names
        return Detections(
            np.concatenate([found.xyxy, found.xyxy, also]),
            np.concatenate([found.confidence, found.confidence, rng.random(count)]).astype(np.float32),
            np.concatenate([found.class_id, found.class_id, rng.integers(0, len(names), count)]),
            names,
        )

    seen = SyntheticCamera(camera_settings(camera, mount, {}), detect=wrong)
    flight = LockstepFlight.of_vehicle(in_the_air(seed=seed), camera=seen)
    flight.run(1.0)
    identifier = flight.command("approach car distance=5")

    def ended() -> bool:
        check(seen.perceived.objects.objects)
        assert flight.guidance.setpoints.sent is None or all(
            map(math.isfinite, flight.guidance.setpoints.sent.velocity_ned_mps or (0.0,))
        )
        return flight.outcome(identifier) is not None

    assert flight.run_until(ended, 60.0)
    assert_succeeded(flight.outcome(identifier))
    assert scene[0].range_m(flight.vehicle.truth.position_ned_m, 0.0) == pytest.approx(5.0, abs=1.5)
