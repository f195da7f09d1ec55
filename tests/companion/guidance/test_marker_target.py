"""Marker targets in local NED for any attitude, and the objects of pads."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from companion.guidance.objects.from_detections import HistoryError, StateHistory
from companion.guidance.objects.from_markers import (
    MarkerSight,
    MarkerTarget,
    looks_down,
    marker_targets,
    object_detections,
)
from companion.guidance.objects.table import ObjectTable
from companion.guidance.objects.tracked_object import DRIFT_S, TrackedObject
from companion.vehicle.state import Vector3, VehicleState
from tests.companion.guidance.guidance_harness import known
from vision.attitude import quaternion_from_euler, wrap_angle
from vision.camera_model import CameraModel, CameraMount
from vision.markers import PadMarker, marker_from_corners, square
from vision.rotation import matrix_from_quaternion

CAMERA = CameraModel.from_horizontal_fov(640, 480, math.radians(75.0))
DOWNWARD = CameraMount(forward_m=0.1, right_m=-0.05, down_m=0.08, pitch_rad=-math.pi / 2)


def seen(
    position: Vector3,
    roll: float,
    pitch: float,
    yaw: float,
    centre: tuple[float, float],
    heading: float,
    *,
    identifier: int = 7,
    size_m: float = 0.6,
    on_pads: dict[int, PadMarker] | None = None,
    noise: NDArray[np.float64] | None = None,
) -> MarkerTarget:
    """The target of a downward camera for a marker at `centre` (north, east) on the ground."""
    attitude = quaternion_from_euler(roll, pitch, yaw)
    history = StateHistory()
    history.add(
        VehicleState(
            attitude_ns=1000, position_ns=1000, attitude=attitude, position_ned_m=position,
            home_position_ned_m=(0.0, 0.0, 0.0), velocity_ned_mps=(0.0, 0.0, 0.0),
        )
    )  # fmt: skip
    ned_from_body = matrix_from_quaternion(attitude)
    eye = np.array(position) + ned_from_body @ DOWNWARD.position_frd_m
    cosine, sine = math.cos(heading), math.sin(heading)
    ned_from_marker = np.array([[-sine, cosine, 0.0], [cosine, sine, 0.0], [0.0, 0.0, -1.0]])
    corners = square(size_m) @ ned_from_marker.T + (*centre, 0.0)
    pixels = CAMERA.project((corners - eye) @ (ned_from_body @ DOWNWARD.body_from_optical))
    marker = known(
        marker_from_corners(identifier, pixels + (0.0 if noise is None else noise), size_m, CAMERA)
    )
    return marker_targets([marker], 1000, DOWNWARD, history, on_pads or {})[0]


@settings(max_examples=50, deadline=None)
@given(
    roll=st.floats(-0.3, 0.3), pitch=st.floats(-0.3, 0.3), yaw=st.floats(-3.0, 3.0),
    north=st.floats(-1.0, 1.0), east=st.floats(-1.0, 1.0), height=st.floats(2.0, 9.0),
    heading=st.floats(-3.0, 3.0),
)  # fmt: skip
def test_banking_does_not_displace_the_marker(
    roll: float, pitch: float, yaw: float, north: float, east: float, height: float, heading: float
) -> None:
    position = (12.0, -7.0, -height)
    target = seen(position, roll, pitch, yaw, (12.0 + north, -7.0 + east), heading)
    assert target.position_ned_m == pytest.approx((12.0 + north, -7.0 + east, 0.0), abs=0.02)
    assert target.pad_ned_m == target.position_ned_m
    assert target.ground_range_m == pytest.approx(math.hypot(north, east), abs=0.02)
    assert abs(wrap_angle(target.heading_rad - heading)) < 0.05
    body = matrix_from_quaternion(quaternion_from_euler(roll, pitch, yaw)).T @ (north, east, height)
    assert target.pad_offset_frd_m == pytest.approx(tuple(body), abs=0.03)


@settings(max_examples=30, deadline=None)
@given(
    roll=st.floats(-0.3, 0.3), pitch=st.floats(-0.3, 0.3), yaw=st.floats(-3.0, 3.0), heading=st.floats(-3, 3)
)
def test_pose_in_the_body_frame(roll: float, pitch: float, yaw: float, heading: float) -> None:
    position = (1.0, -2.0, -3.0)
    target = seen(position, roll, pitch, yaw, (1.3, -2.2), heading)
    body_from_ned = matrix_from_quaternion(quaternion_from_euler(roll, pitch, yaw)).T
    offset = body_from_ned @ np.subtract((1.3, -2.2, 0.0), position)
    assert target.body.position_m == pytest.approx(tuple(offset), abs=0.01)
    upper = body_from_ned @ [math.cos(heading), math.sin(heading), 0.0]
    axes = matrix_from_quaternion(target.body.rotation)
    assert axes[:, 1] == pytest.approx(upper, abs=0.05)
    covariance = target.body.matrix
    assert np.linalg.eigvalsh(covariance).min() > 0.0
    # 0.1 px of 90 px is a thousandth of the range of 3 m along the line of sight, and less across.
    sigma_m = target.body.range_sigma_m
    assert 0.0005 * 3.0 < sigma_m < 0.003 * 3.0
    assert np.linalg.eigvalsh(covariance[:3, :3])[0] < (0.3 * sigma_m) ** 2


@settings(max_examples=30, deadline=None)
@given(heading=st.floats(-3.1, 3.1), seed=st.integers(0, 1000))
def test_off_centre_marker_gives_the_pad_position(heading: float, seed: int) -> None:
    """The small marker is seen nearly face on, where its rotation is ambiguous."""
    right, up = 0.3, 0.58
    cosine, sine = math.cos(heading), math.sin(heading)
    centre = (up * cosine - right * sine, up * sine + right * cosine)
    noise = np.random.default_rng(seed).normal(0.0, 0.3, (4, 2))
    on_pads = {21: PadMarker(21, 7, right, up)}
    target = seen(
        (0.0, 0.0, -2.0), 0.05, -0.1, 0.4, centre, heading,
        identifier=21, size_m=0.2, on_pads=on_pads, noise=noise,
    )  # fmt: skip
    assert target.pad == 7
    assert target.pad_ned_m[:2] == pytest.approx((0.0, 0.0), abs=0.06)


def test_without_the_pose_at_capture_there_is_no_target() -> None:
    marker = known(
        marker_from_corners(1, CAMERA.project(square(0.5) * (1, -1, 1) + (0, 0, 3.0)), 0.5, CAMERA)
    )
    with pytest.raises(HistoryError, match="no attitude"):
        marker_targets([marker], 1000, DOWNWARD, StateHistory(), {})
    assert marker_targets([], 1000, DOWNWARD, StateHistory(), {}) == ()


@pytest.mark.parametrize(
    ("pitch_deg", "down"), [(-90, True), (-75, True), (-60, False), (-20, False), (0, False)]
)
def test_looks_down_needs_nadir_inside_the_image(pitch_deg: float, down: bool) -> None:
    assert looks_down(CAMERA, CameraMount(pitch_rad=math.radians(pitch_deg))) is down


def test_missing_marker_detection_is_named() -> None:
    assert "markers.dictionary" in (MarkerSight().unavailable(1.5) or "")
    nothing = known(MarkerSight(missing="").unavailable(1.5))
    assert "none received" in nothing
    old = known(MarkerSight((), 1, 2.0, False, "").unavailable(1.5))
    assert "2.0 s old" in old
    assert MarkerSight((), 1, 0.1, True, "").unavailable(1.5) is None


def pad_detection(
    north: float, stamp_s: float, *, identifier: int = 7, right: float = 0.0, sigma: float = 0.05
) -> MarkerTarget:
    """A confirmed marker 3 m below, `right` of the centre of a pad that is `north` of home."""
    target = seen((0.0, 0.0, -3.0), 0.0, 0.0, 0.0, (0.0, 0.0), 0.0, identifier=identifier)
    return replace(
        target,
        captured_ns=round(stamp_s * 1e9),
        pad=7,
        pad_ned_m=(north, 0.0, 0.0),
        position_ned_m=(north, right, 0.0),
        range_sigma_m=sigma,
        confirmed=True,
    )


class Pad:
    """The objects of markers that a vehicle sees from 3 m above home."""

    def __init__(self) -> None:
        self.table = ObjectTable()

    def add(self, *markers: MarkerTarget, at_s: float | None = None) -> bool:
        """Whether marker 7 is in this frame, and is taken."""
        here = (0.0, 0.0, -3.0)
        captured_ns = markers[0].captured_ns if at_s is None else round(at_s * 1e9)
        self.table.update(object_detections(markers, here), here, captured_ns)
        return self.of(7).last_ns == captured_ns

    def of(self, identifier: int) -> TrackedObject:
        return known(self.table.of_track(identifier))


def test_single_outlier_is_rejected_and_agreeing_ones_not() -> None:
    pad = Pad()
    for step in range(10):
        assert pad.add(pad_detection(1.0, 1.1 + step * 0.05))
    assert not pad.add(pad_detection(3.0, 1.7))
    assert pad.of(7).position_at(2_000_000_000)[0] == pytest.approx(1.0, abs=0.01)
    believed = [pad.add(pad_detection(3.0, 1.75 + step * 0.05)) for step in range(8)]
    assert believed == [False, *[True] * 7]
    assert pad.of(7).object_id == 1
    assert pad.of(7).position_at(3_000_000_000)[0] == pytest.approx(3.0, abs=0.1)


@pytest.mark.parametrize("off", [(0.5, 0.0), (0.0, 0.5)])
def test_small_outlier_is_rejected_in_any_direction(off: tuple[float, float]) -> None:
    """A box says less across the line of sight than a marker."""
    pad = Pad()
    for step in range(10):
        pad.add(pad_detection(1.0, 1.0 + step * 0.05))
    assert not pad.add(replace(pad_detection(1.0, 1.5), pad_ned_m=(1.0 + off[0], off[1], 0.0)))


@pytest.mark.parametrize(("speed", "moving"), [(0.2, False), (1.5, True)])
def test_pad_is_where_it_is_seen_and_goes_on_unseen(speed: float, moving: bool) -> None:
    """A standing one drifts with the estimate, for a moment; of a moving one the estimate has no lag."""
    rng, pad = np.random.default_rng(4), Pad()
    for step in range(80):
        pad.add(pad_detection(speed * step * 0.05 + rng.normal(0.0, 0.02), 1.0 + step * 0.05))
    last_s, unseen_s = 1.0 + 79 * 0.05, 2.0
    last_ns, later_ns = round(last_s * 1e9), round((last_s + unseen_s) * 1e9)
    assert pad.of(7).moving is moving
    assert pad.of(7).velocity_at(last_ns)[0] == pytest.approx(speed, abs=0.12)
    assert pad.of(7).position_at(last_ns)[0] == pytest.approx(speed * 3.95, abs=0.03)
    assert pad.of(7).position_at(last_ns + 500_000_000)[0] == pytest.approx(speed * 4.45, abs=0.1)
    ahead_s = unseen_s if moving else DRIFT_S
    assert pad.of(7).position_at(later_ns)[0] == pytest.approx(speed * (3.95 + ahead_s), abs=0.25)
    assert (pad.of(7).velocity_at(later_ns) != (0.0, 0.0)) is moving


def test_noise_of_the_range_hardly_changes_the_height() -> None:
    pad, rng, heights = Pad(), np.random.default_rng(2), []
    for step in range(80):
        target = pad_detection(0.0, 1.0 + step * 0.05)
        pad.add(replace(target, pad_ned_m=(0.0, 0.0, float(rng.normal(0.0, 0.2)))))
        heights.append(known(pad.of(7).position_ned_m)[2])
    assert float(np.std(heights[20:])) < 0.11


def test_the_most_exact_marker_of_a_pad_says_where_it_is() -> None:
    pad = Pad()
    own, large = pad_detection(1.0, 1.0, sigma=0.2), pad_detection(1.4, 1.0, identifier=21, right=0.5)
    pad.add(own, large)
    assert pad.of(7).position_ned_m == (1.4, 0.0, 0.0)
    assert pad.of(7).detection.range_sigma_m == 0.05
    # The other one is an object of its own.
    assert pad.of(21).position_ned_m == (1.4, 0.5, 0.0)
    assert {each.class_name for each in pad.table.objects} == {"marker 7", "marker 21"}


def test_pad_goes_on_while_only_a_part_of_it_is_seen() -> None:
    pad = Pad()
    for step in range(60):
        at_s = 1.0 + step * 0.05
        both = [pad_detection(1.0, at_s), pad_detection(1.0, at_s, identifier=21, right=0.5)]
        assert pad.add(*(both, both[:1], both[1:])[step // 5 % 3])
    assert pad.of(7).object_id == 1
    assert pad.of(7).position_ned_m == pytest.approx((1.0, 0.0, 0.0), abs=1e-6)
    # One that lies on no pad that is seen is its own pad.
    alone = Pad()
    alone.add(pad_detection(1.0, 1.0))
    assert [each.class_name for each in alone.table.objects] == ["marker 7"]


def test_sigma_of_a_position_is_stated_in_both_directions() -> None:
    below = seen((0.0, 0.0, -3.0), 0.0, 0.0, 0.0, (0.0, 0.0), 0.0)
    [detection] = object_detections([below], (0.0, 0.0, -3.0))
    covariance = known(detection.position_covariance)
    # 5 cm of the mount and 1 degree of 3 m, the same all around below.
    assert np.sqrt(np.diag(covariance)) == pytest.approx([0.073, 0.073], abs=0.005)
