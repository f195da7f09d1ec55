import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray

from companion.guidance.objects.from_detections import (
    CONTACT_INSET_M,
    HistoryError,
    StateHistory,
    targets_from_detections,
)
from companion.guidance.objects.target import RangeSource, Target
from companion.vehicle.state import Quaternion, Vector3, VehicleState
from tests.companion.guidance.guidance_harness import known
from vision.attitude import quaternion_from_euler, wrap_angle
from vision.camera_model import CameraModel, CameraMount, DistortionModel
from vision.detections import DetectionRecord
from vision.rotation import matrix_from_quaternion

CAMERA = CameraModel.from_horizontal_fov(640, 480, math.radians(80))
DISTORTED = replace(CAMERA, distortion=(-0.12, 0.03, 0.001, -0.001, 0.0))
MOUNT = CameraMount(forward_m=0.1, down_m=0.05, pitch_rad=math.radians(-20))
T0 = 5_000_000_000


def state_at(
    stamp_ns: int,
    attitude: Quaternion,
    position: Vector3 = (0.0, 0.0, -8.0),
    home: Vector3 = (0.0, 0.0, 0.0),
) -> VehicleState:
    return VehicleState(
        attitude_ns=stamp_ns,
        position_ns=stamp_ns,
        attitude=attitude,
        position_ned_m=position,
        home_position_ned_m=home,
    )


def history_of(
    attitude: Quaternion, position: Vector3 = (0.0, 0.0, -8.0), home: Vector3 = (0.0, 0.0, 0.0)
) -> StateHistory:
    history = StateHistory()
    for step in range(10):
        history.add(state_at(T0 + step * 20_000_000, attitude, position, home))
    return history


def detection(
    edges: Sequence[float],
    nearest: Sequence[float] | NDArray[np.float64] | None = None,
    name: str = "car",
    **changes: Any,
) -> DetectionRecord:
    left, top, right, bottom = edges
    record = DetectionRecord(
        class_id=2,
        class_name=name,
        confidence=0.8,
        xyxy=list(edges),
        center=[(left + right) / 2, (top + bottom) / 2],
        depth_m=None if nearest is None else nearest[2],
        nearest_camera_m=None if nearest is None else list(nearest),
    )
    record.update(changes)  # type: ignore[typeddict-item]  # some of its keys
    return record


def localized(
    *detections: DetectionRecord,
    camera: CameraModel = CAMERA,
    mount: CameraMount = MOUNT,
    history: StateHistory | None = None,
    heights: dict[str, float] | None = None,
    at_ns: int = T0,
) -> tuple[Target, ...]:
    """The targets of a frame, by default of a level vehicle 8 m above home."""
    history = history or history_of(quaternion_from_euler(0.0, 0.0, 0.0))
    return targets_from_detections(detections, at_ns, camera, mount, history, heights or {})


def optical_point(
    camera: CameraModel,
    mount: CameraMount,
    attitude: Quaternion,
    position: Sequence[float] | NDArray[np.float64],
    point: Sequence[float],
) -> NDArray[np.float64]:
    body = matrix_from_quaternion(attitude).T @ (np.array(point) - position) - mount.position_frd_m
    return mount.body_from_optical.T @ body


def test_only_boxes_where_the_lens_has_no_rays_have_no_target() -> None:
    fisheye = CameraModel(640, 480, 160.0, 160.0, 319.5, 239.5, (0.05, -0.02, 0.0, 0.0), "equidistant")
    boxes = ((300, 300, 360, 340), (0, 0, 60, 40), (130, 60, 190, 100), (575, 0, 635, 40))
    found = [detection(box, nearest=(0.0, 1.0, 8.0)) for box in boxes]
    assert np.isfinite(fisheye.rays(np.array([(160.0, 80.0)]))).all()
    targets = localized(*found, camera=fisheye)
    assert [target.box_xyxy for target in targets] == [boxes[0], boxes[2]]
    # Its lower edge has no rays, its middle has.
    below = detection((120, 300, 180, 475), nearest=(0.0, 1.0, 8.0))
    (target,) = localized(below, camera=fisheye)
    assert math.isfinite(target.range_sigma_m)
    assert math.isfinite(target.across_sigma_m)


def test_target_is_trusted_only_with_a_confirmed_track() -> None:
    tracks: list[dict[str, Any]] = [
        {},  # tracking is off
        {"track_id": None, "track_score": None, "track_state": "none"},
        {"track_id": 4, "track_score": 0.6, "track_state": "tentative"},
        {"track_id": 5, "track_score": 0.7, "track_state": "confirmed"},
    ]
    found = [detection((310, 300, 330, 400), **track) for track in tracks]
    targets = localized(*found)
    assert [target.trusted for target in targets] == [True, False, False, True]
    assert [target.track_id for target in targets] == [None, None, 4, 5]
    assert [target.score for target in targets] == [0.8, 0.8, 0.6, 0.7]


@pytest.mark.parametrize(
    ("other", "trusted"),
    [
        ({"class_name": "truck", "confidence": 0.65}, [True, False]),
        ({"class_name": "truck", "confidence": 0.75}, [False, False]),
        ({"class_name": "truck", "confidence": 0.85}, [False, False]),
        ({"class_name": "truck", "confidence": 0.95}, [False, True]),
        ({"class_name": "truck", "confidence": 0.95, "xyxy": [300, 300, 310, 400]}, [True, True]),
        ({"class_name": "car", "confidence": 0.85}, [True, True]),
    ],
    ids=["much lower", "slightly lower", "slightly higher", "higher", "beside it", "same class"],
)
def test_ambiguous_class_is_not_trusted(other: dict[str, Any], trusted: list[bool]) -> None:
    car = detection((310, 300, 330, 400))
    both = [car, detection((311, 300, 331, 400), **other)]
    assert [t.trusted for t in localized(*both)] == trusted


def test_ambiguity_uses_the_track_score() -> None:
    box = (310, 300, 330, 400)
    tracks: dict[str, Any] = {"track_state": "confirmed"}
    car = detection(box, track_id=1, track_score=0.9, confidence=0.5, **tracks)
    truck = detection(box, track_id=2, track_score=0.6, confidence=0.8, class_name="truck", **tracks)
    targets = localized(car, truck)
    assert [target.trusted for target in targets] == [True, False]


# Roll, pitch, yaw, distance, bearing off the nose, height, (north, east).
Scene = tuple[float, float, float, float, float, float, tuple[float, float]]

angles = st.floats(-0.5, 0.5)
scenes = st.tuples(
    angles,
    angles,
    st.floats(-math.pi, math.pi),
    st.floats(2.0, 40.0),  # distance
    st.floats(-0.6, 0.6),  # bearing off the nose
    st.floats(3.0, 15.0),  # height
    st.tuples(st.floats(-100, 100), st.floats(-100, 100)),
)


@pytest.mark.parametrize("camera", [CAMERA, DISTORTED], ids=["pinhole", "distorted"])
@given(scene=scenes)
def test_ground_point_is_recovered_from_the_box_foot(camera: CameraModel, scene: Scene) -> None:
    roll, pitch, yaw, distance, off, height, (north, east) = scene
    attitude = quaternion_from_euler(roll, pitch, yaw)
    home_down = 1.5
    position = (north, east, home_down - height)
    bearing = yaw + off
    point = (north + distance * math.cos(bearing), east + distance * math.sin(bearing), home_down)
    optical = optical_point(camera, MOUNT, attitude, position, point)
    assume(optical[2] > 0.5)
    x, y = camera.project(optical)[0]
    assume(20 < x < 620 and 40 < y < 470)
    assume(math.atan2(height, distance) > math.radians(4))
    history = history_of(attitude, position, (0.0, 0.0, home_down))
    # Edges, half a pixel beyond the centres of pixels. The bearing is that of the box's middle, the range
    # that of its foot: in a rolled image they differ in direction for a tall box, not for a small one.
    tall = (x - 9.5, y - 29.5, x + 10.5, y + 0.5)
    small = (x - 0.5, y - 1.5, x + 1.5, y + 0.5)
    boxes = [detection(small), detection(tall)]
    at_point, target = localized(*boxes, camera=camera, history=history, at_ns=T0 + 50_000_000)
    away = math.dist(point[:2], known(at_point.position_ned_m)[:2])
    assert away == pytest.approx(CONTACT_INSET_M, abs=0.02 * distance)
    away = math.dist(point[:2], known(target.position_ned_m)[:2])
    # The middle's offset grows with the slant range: 2.2 % of it in the worst of 355,000 scenes searched.
    assert away == pytest.approx(CONTACT_INSET_M, abs=0.03 * math.hypot(distance, height))
    assert target.range_source is RangeSource.GROUND_PLANE
    assert target.ground_range_m == pytest.approx(distance - CONTACT_INSET_M, abs=0.02 * distance)
    assert target.distance_m == pytest.approx(math.hypot(target.ground_range_m, height), rel=1e-6)
    assert target.range_sigma_m > 0.2


@given(scene=scenes, down=st.floats(-4.0, 4.0))
def test_point_is_recovered_from_its_depth(scene: Scene, down: float) -> None:
    roll, pitch, yaw, distance, off, height, (north, east) = scene
    attitude = quaternion_from_euler(roll, pitch, yaw)
    position = (north, east, -height)
    bearing = yaw + off
    point = (north + distance * math.cos(bearing), east + distance * math.sin(bearing), -height + down)
    optical = optical_point(CAMERA, MOUNT, attitude, position, point)
    assume(optical[2] > 0.5)
    x, y = CAMERA.project(optical)[0]
    assume(0 < x < 640 and 0 < y < 480)
    box = (x - 11.5, y - 6.5, x + 12.5, y + 7.5)
    (target,) = localized(detection(box, optical), history=history_of(attitude, position))
    assert target.range_source is RangeSource.DEPTH
    assert target.position_ned_m == pytest.approx(point, abs=1e-6)
    assert target.ground_range_m == pytest.approx(distance, abs=1e-6)
    assert target.depth_m == pytest.approx(optical[2])
    assert target.distance_m == pytest.approx(math.hypot(distance, down), abs=1e-6)
    # The bearing is that of the camera's ray; the camera sits a little before the vehicle's origin.
    assert abs(wrap_angle(target.bearing_rad - bearing)) < 0.2 / (distance - 0.2)


def test_position_is_at_the_box_not_the_nearest_corner() -> None:
    # A wall square to the view, 6 m ahead, of which the right half is in the box.
    level = CameraMount()
    (target,) = localized(detection((420, 200, 520, 280), (0.5, 0.2, 6.0)), mount=level)
    assert target.ground_range_m == pytest.approx(math.hypot(0.5, 6.0))
    bearing = math.atan((469.5 - CAMERA.cx) / CAMERA.fx)
    assert target.bearing_rad == pytest.approx(bearing)
    north, east, down = known(target.position_ned_m)
    assert (math.hypot(north, east), down) == pytest.approx((target.ground_range_m, -7.8))
    assert math.atan2(east, north) == pytest.approx(bearing)


def test_position_is_in_the_direction_of_the_middle_by_depth() -> None:
    seen = detection((420, 200, 520, 280), (0.5, 0.2, 6.0), middle_px=480.0)
    (target,) = localized(seen, mount=CameraMount())
    bearing = math.atan((479.5 - CAMERA.cx) / CAMERA.fx)
    assert target.bearing_rad == pytest.approx(bearing)
    assert math.atan2(*known(target.position_ned_m)[1::-1]) == pytest.approx(bearing)
    assert target.ground_range_m == pytest.approx(math.hypot(0.5, 6.0))


def test_box_cut_by_the_edge_has_a_larger_sigma() -> None:
    whole, cut = localized(
        detection((10, 300, 60, 400), (-4, 1, 7)), detection((0, 300, 60, 400), (-4, 1, 7))
    )
    assert cut.range_sigma_m > whole.range_sigma_m + 0.05
    assert (whole.cut, cut.cut) == (False, True)


def test_depth_and_distance_have_their_own_sigmas() -> None:
    boxes = [detection((310, 200, 330, 300), (0.0, 3.0, 4.0)), detection((310, 300, 330, 400))]
    boxes += [detection((300, 300, 339, 479))]
    by_depth, by_ground, none = localized(*boxes, mount=CameraMount())
    # 0.07 m and 0.0003 * 4^2.5 m, and 5 m away at a depth of 4 m.
    assert by_depth.depth_sigma_m == pytest.approx(math.hypot(0.07, 0.0096))
    assert by_depth.distance_sigma_m == pytest.approx(1.25 * by_depth.depth_sigma_m)
    assert by_depth.range_sigma_m < by_depth.depth_sigma_m + 0.01
    # The height is 0.3 m off.
    assert math.isnan(by_ground.depth_sigma_m)
    level = by_ground.ground_range_m / by_ground.distance_m
    expected_m = math.hypot(level * by_ground.range_sigma_m, 0.3 * math.hypot(1.0, level))
    assert by_ground.distance_sigma_m == pytest.approx(expected_m, rel=0.02)
    assert math.isnan(none.depth_sigma_m)
    assert math.isnan(none.distance_sigma_m)


def test_box_within_the_error_of_its_edges_may_be_cut() -> None:
    boxes = [(left, 300, left + 60, 400) for left in (4, CAMERA.width - 64, 10, CAMERA.width - 70)]
    found = localized(*map(detection, boxes))
    assert [target.cut for target in found] == [True, True, False, False]
    assert not any(target.cut_above for target in found)


def test_box_at_the_upper_edge_is_cut_above_only() -> None:
    boxes = [detection((300, top, 360, top + 100)) for top in (0, 4, 10)]
    found = localized(*boxes)
    assert [target.cut_above for target in found] == [True, True, False]
    assert not any(target.cut for target in found)


def test_contact_of_a_wide_box_is_less_known_beside_the_middle() -> None:
    boxes = [(CAMERA.width / 2 - half, 300, CAMERA.width / 2 + half, 400) for half in (10, 80)]
    boxes += [(left + 220, top, right + 220, bottom) for left, top, right, bottom in boxes]
    found = localized(*map(detection, boxes))
    narrow, wide, narrow_beside, wide_beside = [
        target.range_sigma_m / target.ground_range_m**2 for target in found
    ]
    assert wide == pytest.approx(narrow, rel=0.02)
    assert wide_beside > narrow_beside * 1.3


def test_known_height_gives_a_range_without_ground() -> None:
    history = history_of(quaternion_from_euler(0.0, 0.0, 0.0), position=(0.0, 0.0, -1.5))
    # 50 px tall, in a camera pitched 20° down, its foot near the horizon.
    box = [300, 50, 320, 100]
    ((without,), (known,), (cut,), (other,)) = (
        localized(detection(where, name=name), history=history, heights=heights)
        for where, name, heights in (
            (box, "person", {}),
            (box, "person", {"person": 1.7}),
            ([300, 0, 320, 50], "person", {"person": 1.7}),
            (box, "dog", {"person": 1.7}),
        )
    )
    assert (without.range_source, cut.range_source, other.range_source) == (RangeSource.NONE,) * 3
    assert known.range_source is RangeSource.KNOWN_HEIGHT
    # By hand: rows of a pinhole of 381 px, elevations -20° - atan((row - 239.5) / 381).
    top, bottom = (math.tan(math.radians(-20) - math.atan((row - 239.5) / 381.36)) for row in (50, 100))
    assert known.ground_range_m == pytest.approx(1.7 / (top - bottom) + 0.1, rel=0.01)


LEVEL, LOW = quaternion_from_euler(0.0, 0.0, 0.0), (0.0, 0.0, -0.1)
CAR_BOX = (310, 300, 330, 400)
SOURCES: dict[str, tuple[DetectionRecord, dict[str, Any], RangeSource]] = {
    "ground before known height": (detection(CAR_BOX), {"heights": {"car": 1.5}}, RangeSource.GROUND_PLANE),
    "depth before known height": (
        detection((10, 300, 30, 400), (-4.0, 1.0, 7.0)), {"heights": {"car": 1.5}}, RangeSource.DEPTH,
    ),
    "ground, where the depth is NaN": (detection(CAR_BOX, (math.nan,) * 3), {}, RangeSource.GROUND_PLANE),
    "foot near the horizon": (detection((310, 230, 330, 245)), {"mount": CameraMount()}, RangeSource.NONE),
    "on the ground": (detection(CAR_BOX), {"history": history_of(LEVEL, LOW)}, RangeSource.NONE),
}  # fmt: skip


@pytest.mark.parametrize("case", SOURCES)
def test_range_is_of_the_best_source(case: str) -> None:
    seen, options, source = SOURCES[case]
    (target,) = localized(seen, **options)
    assert target.range_source is source


def test_box_cut_by_the_lower_edge_has_no_range() -> None:
    history = history_of(quaternion_from_euler(0, 0, 0.7))
    (target,) = localized(detection((300, 300, 339, 479)), history=history)
    assert target.range_source is RangeSource.NONE
    assert target.position_ned_m is None
    assert math.isnan(target.ground_range_m)
    assert target.bearing_rad == pytest.approx(0.7, abs=0.01)
    assert target.elevation_rad < 0


def test_attitude_is_that_of_the_capture() -> None:
    history = StateHistory()
    for step in range(20):
        yaw = 0.05 * step
        history.add(state_at(T0 + step * 50_000_000, quaternion_from_euler(0, 0, yaw)))
    captured_ns = T0 + 425_000_000  # half way between two samples
    (target,) = localized(detection((310, 200, 330, 300)), history=history, at_ns=captured_ns)
    assert target.bearing_rad == pytest.approx(0.425, abs=1e-6)


def test_position_and_height_are_interpolated_at_own_stamps() -> None:
    history = StateHistory()
    attitude = quaternion_from_euler(0, 0, 0)
    for step in range(5):
        state = state_at(T0 + step * 40_000_000, attitude, (float(step), 0.0, -float(step)))
        history.add(replace(state, attitude_ns=T0 + step * 35_000_000))
    pose = history.at(T0 + 60_000_000)
    assert pose.position_ned_m == pytest.approx((1.5, 0.0, -1.5))
    assert pose.height_m == pytest.approx(1.5)


def test_times_outside_the_history_are_refused() -> None:
    history = history_of(quaternion_from_euler(0, 0, 0))
    history.at(T0 - 190_000_000)
    history.at(T0 + 180_000_000 + 190_000_000)
    with pytest.raises(HistoryError, match=r"0\.30 s older"):
        history.at(T0 - 300_000_000)
    with pytest.raises(HistoryError, match=r"0\.32 s newer"):
        history.at(T0 + 500_000_000)
    with pytest.raises(HistoryError, match="received yet"):
        StateHistory().at(T0)


def test_history_is_bounded_and_ignores_old_stamps() -> None:
    history = StateHistory(duration_s=1.0)
    for step in range(1000):
        history.add(state_at(T0 + step * 20_000_000, quaternion_from_euler(0, 0, 0)))
        history.add(state_at(T0, quaternion_from_euler(0, 0, 1)))
    assert len(history._attitudes) <= 51
    assert len(history._positions) <= 51


@pytest.mark.parametrize("roll_deg", [-15.0, 15.0])
def test_wide_object_in_a_rolled_image_is_ranged_correctly(roll_deg: float) -> None:
    # A wall 6 m wide and 2 m tall, 10 m ahead and square to the camera.
    attitude, position = quaternion_from_euler(math.radians(roll_deg), 0.0, 0.0), np.array((0.0, 0.0, -3.0))
    corners = [(10.0, east, down) for east in (-3.0, 3.0) for down in (-2.0, 0.0)]
    seen = np.array([optical_point(CAMERA, MOUNT, attitude, position, corner) for corner in corners])
    pixels = CAMERA.project(seen) + 0.5
    box = (*pixels.min(axis=0), *pixels.max(axis=0))
    level = quaternion_from_euler(0.0, 0.0, 0.0)
    history, unrolled = history_of(attitude, (0.0, 0.0, -3.0)), history_of(level, (0.0, 0.0, -3.0))
    (target,) = localized(detection(box), history=history)
    (plain,) = localized(detection(box), history=unrolled)
    # The ray through the middle of the edge would give 7.9 m.
    assert target.ground_range_m == pytest.approx(10.0 - CONTACT_INSET_M, abs=1.5)
    assert target.range_sigma_m > plain.range_sigma_m + 0.3
    assert abs(target.ground_range_m - (10.0 - CONTACT_INSET_M)) < 2 * target.range_sigma_m


@pytest.mark.parametrize(
    ("coefficients", "model"),
    [((-0.4, 0.0, 0.0, 0.0), "plumb_bob"), ((0.1, -0.4, 0.0, 0.0), "equidistant")],
)
def test_no_number_of_a_target_is_nan_where_a_lens_folds(
    coefficients: tuple[float, ...], model: DistortionModel
) -> None:
    camera = CameraModel(640, 480, 300.0, 300.0, 320.0, 240.0, coefficients, model)
    boxes = [(x, y, x + 80, y + 60) for x in range(0, 561, 40) for y in range(0, 421, 30)]
    targets = localized(*map(detection, boxes), camera=camera, heights={"car": 1.5})
    assert 0 < len(targets) < len(boxes)
    ranged = [target for target in targets if target.position_ned_m is not None]
    assert ranged
    for target in targets:
        assert math.isfinite(target.bearing_rad)
        assert math.isfinite(target.elevation_rad)
        assert math.isfinite(target.ground_range_m) == (target.position_ned_m is not None)
    for target in ranged:
        numbers = (
            *known(target.position_ned_m),
            target.distance_m,
            target.range_sigma_m,
            target.across_sigma_m,
        )
        assert all(map(math.isfinite, numbers)), target
