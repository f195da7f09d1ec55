"""Positions of tracks, fused over their detections, and their error ellipses."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from companion.guidance.objects.table import ObjectTable
from companion.guidance.objects.target import RangeSource, Target
from companion.guidance.objects.tracked_object import TrackedObject
from companion.vehicle.state import Vector3

T0, PERIOD_NS = 10_000_000_000, 100_000_000
VEHICLE_SIGMA_M = 0.2


def seen(
    vehicle: Vector3,
    at: tuple[float, float],
    frame: int,
    *,
    sigma_m: float = 1.0,
    across_m: float = 0.3,
    along_error_m: float = 0.0,
    across_error_m: float = 0.0,
    track_id: int = 7,
) -> Target:
    """A target measured from the vehicle, with these errors along and across the line of sight."""
    north, east = at[0] - vehicle[0], at[1] - vehicle[1]
    range_m, bearing = math.hypot(north, east) + along_error_m, math.atan2(east, north)
    bearing += across_error_m / range_m
    position = (vehicle[0] + range_m * math.cos(bearing), vehicle[1] + range_m * math.sin(bearing), 0.0)
    return Target(
        "car",
        0.9,
        T0 + frame * PERIOD_NS,
        bearing,
        -0.3,
        range_m,
        RangeSource.GROUND_PLANE,
        position,
        track_id=track_id,
        range_sigma_m=sigma_m,
        across_sigma_m=across_m,
        vehicle_sigma_m=VEHICLE_SIGMA_M,
    )


def located(tracks: ObjectTable, track_id: int, now_ns: int = 0) -> TrackedObject | None:
    seen = tracks.of_track(track_id)
    return seen if seen is not None and seen.confirmed and seen.located(now_ns) else None


def position_of(tracks: ObjectTable) -> TrackedObject:
    seen = located(tracks, 7)
    assert seen is not None
    return seen


def place_of(tracks: ObjectTable) -> Vector3:
    return position_of(tracks).position_at(0)


def test_one_detection_has_its_own_ellipse() -> None:
    tracks = ObjectTable()
    tracks.update([seen((0.0, 0.0, -5.0), (0.0, 20.0), 0)], (0.0, 0.0, -5.0), T0)
    fused = position_of(tracks)
    assert fused.position_at(0) == pytest.approx((0.0, 20.0, 0.0))
    assert fused.ellipse_at(0).semi_major_m == pytest.approx(math.hypot(1.0, VEHICLE_SIGMA_M))
    assert fused.ellipse_at(0).semi_minor_m == pytest.approx(math.hypot(0.3, VEHICLE_SIGMA_M))
    assert math.degrees(fused.ellipse_at(0).orientation_rad) == pytest.approx(90.0)


def test_near_detection_outweighs_far_ones() -> None:
    tracks = ObjectTable()
    for frame in range(10):
        far = seen((0.0, 0.0, -5.0), (20.0, 0.0), frame, sigma_m=4.0, along_error_m=4.0)
        tracks.update([far], (0.0, 0.0, -5.0), far.captured_ns)
    for frame in range(10, 20):
        near = seen((12.0, 0.0, -5.0), (20.0, 0.0), frame, sigma_m=0.5)
        tracks.update([near], (12.0, 0.0, -5.0), near.captured_ns)
    assert place_of(tracks)[0] == pytest.approx(20.0, abs=0.1)
    # The mean information of both halves, not the sum of all.
    assert 0.5 < position_of(tracks).ellipse_at(0).semi_major_m < 0.8


def test_views_from_two_sides_shrink_the_ellipse() -> None:
    one, two = ObjectTable(), ObjectTable()
    for frame in range(20):
        south, west = (-15.0, 0.0, -5.0), (0.0, -15.0, -5.0)
        for tracks, vehicle in ((one, south), (two, south if frame % 2 else west)):
            target = seen(vehicle, (0.0, 0.0), frame)
            tracks.update([target], vehicle, target.captured_ns)
    assert position_of(one).ellipse_at(0).semi_major_m == pytest.approx(math.hypot(1.0, VEHICLE_SIGMA_M))
    assert position_of(two).ellipse_at(0).semi_major_m < 0.6


def test_ellipse_covers_the_error_that_all_frames_share() -> None:
    """Half of each flight's variance is one error of the whole flight, such as of the camera's mount."""
    rng, inside, errors_m = np.random.default_rng(31), [], []
    for _ in range(100):
        tracks, common = ObjectTable(), rng.normal(0.0, math.sqrt(0.5), 3)
        turn = float(rng.uniform(0.0, math.pi))
        for frame in range(60):
            angle = turn * frame / 60
            vehicle = (-12.0 * math.cos(angle), -12.0 * math.sin(angle), -5.0)
            own = rng.normal(0.0, math.sqrt(0.5), 2)
            target = seen(
                vehicle,
                (0.0, 0.0),
                frame,
                along_error_m=float(common[0] + own[0]),
                across_error_m=0.3 * float(common[1] + own[1]),
            )
            tracks.update([target], vehicle, target.captured_ns)
        fused = position_of(tracks)
        error = np.array(fused.position_at(0)[:2]) + rng.normal(0.0, VEHICLE_SIGMA_M, 2)
        major_m, minor_m, orientation = fused.ellipse_at(0)
        axis = np.array((math.cos(orientation), math.sin(orientation)))
        along, across = float(error @ axis), float(error @ (-axis[1], axis[0]))
        inside.append((along / major_m) ** 2 + (across / minor_m) ** 2 < 5.99)
        errors_m.append(math.hypot(*error))
    assert np.mean(inside) >= 0.95
    assert np.median(errors_m) < 0.7


def test_moving_object_has_its_newest_position() -> None:
    tracks, vehicle = ObjectTable(), (0.0, 0.0, -5.0)
    rng = np.random.default_rng(5)
    for frame in range(60):
        at = (12.0, 0.3 * frame - 9.0)  # 3 m/s
        target = seen(vehicle, at, frame, sigma_m=0.5, along_error_m=float(rng.normal(0.0, 0.1)))
        tracks.update([target], vehicle, target.captured_ns)
    fused = position_of(tracks)
    assert fused.moving
    assert fused.located_ns == T0 + 59 * PERIOD_NS
    assert math.dist(fused.position_at(0)[:2], (12.0, 8.7)) < 0.5


def test_standing_object_seen_from_a_moving_vehicle_stands() -> None:
    tracks = ObjectTable()
    for frame in range(60):
        vehicle = (0.3 * frame - 30.0, 0.0, -5.0)  # towards it at 3 m/s, the range 5 % too long
        target = seen(vehicle, (0.0, 0.0), frame, along_error_m=0.05 * -vehicle[0])
        tracks.update([target], vehicle, target.captured_ns)
    assert not position_of(tracks).moving


@pytest.mark.parametrize("speed_mps", [0.0, 0.5])
def test_only_a_displacement_beyond_the_common_error_is_motion(speed_mps: float) -> None:
    """The attitude is wrong by its sigma: the error is that of a range by the ground, from 5 m above."""
    tracks, error_rad = ObjectTable(), 0.06 if speed_mps == 0.0 else 0.01
    for frame in range(70):
        vehicle = (0.3 * frame - 32.0, 0.0, -5.0)
        at = (-0.1 * speed_mps * frame, 0.0)
        sigma_m = error_rad * (at[0] - vehicle[0]) ** 2 / 5.0
        target = seen(vehicle, at, frame, sigma_m=sigma_m, along_error_m=sigma_m)
        tracks.update([target], vehicle, target.captured_ns)
        if frame >= 60 or speed_mps == 0.0:
            assert position_of(tracks).moving == (speed_mps > 0.0)


@pytest.mark.parametrize("speed_mps", [0.7, 1.2])
@pytest.mark.parametrize("along", [False, True], ids=["across", "away"])
def test_ellipse_covers_a_slow_walker(speed_mps: float, along: bool) -> None:
    tracks, vehicle, rng = ObjectTable(), (0.0, 0.0, -5.0), np.random.default_rng(17)
    for frame in range(200):
        walked_m = speed_mps * 0.1 * frame
        at = (8.0 + walked_m, 0.0) if along else (12.0, walked_m - 10.0 * speed_mps)
        off_m = [float(rng.normal(0.3, 0.2)), float(rng.normal(0.0, 0.1))]
        target = seen(vehicle, at, frame, sigma_m=0.5, along_error_m=off_m[0], across_error_m=off_m[1])
        tracks.update([target], vehicle, target.captured_ns)
        fused = position_of(tracks)
        error = np.array(fused.position_at(0)[:2]) - at
        major_m, minor_m, orientation = fused.ellipse_at(0)
        axis = np.array((math.cos(orientation), math.sin(orientation)))
        across = float(error @ (-axis[1], axis[0]))
        assert (float(error @ axis) / major_m) ** 2 + (across / minor_m) ** 2 < 5.99
        assert along or math.hypot(*error) < 1.5


def test_object_that_was_moved_is_located_again() -> None:
    tracks, vehicle = ObjectTable(), (0.0, 0.0, -5.0)
    for frame in range(40):
        target = seen(vehicle, (12.0, 0.0 if frame < 20 else 4.0), frame, sigma_m=0.5)
        tracks.update([target], vehicle, target.captured_ns)
    assert place_of(tracks)[:2] == pytest.approx((12.0, 4.0), abs=0.01)


def test_outliers_that_do_not_fit_each_other_are_left_out() -> None:
    tracks, vehicle = ObjectTable(), (0.0, 0.0, -5.0)
    norths = (*[10.0] * 50, 30.0, 4.0, 22.0, 10.0)
    for frame, north in enumerate(norths):
        target = seen(vehicle, (north, 0.0), frame, sigma_m=0.3)
        tracks.update([target], vehicle, target.captured_ns)
        fused = position_of(tracks)
        assert fused.position_at(0)[:2] == pytest.approx((10.0, 0.0), abs=0.01)
        assert not fused.moving
    assert fused.located_ns == T0 + 53 * PERIOD_NS


def test_spread_of_fitting_outliers_is_part_of_the_error() -> None:
    tracks, vehicle = ObjectTable(), (0.0, 0.0, -5.0)
    for frame, north in enumerate((*[10.0] * 20, 30.0, 30.6, 29.7)):
        target = seen(vehicle, (north, 0.0), frame, sigma_m=0.3, across_m=0.2)
        tracks.update([target], vehicle, target.captured_ns)
    fused = position_of(tracks)
    assert fused.position_at(0)[:2] == pytest.approx((29.7, 0.0))
    spread_m = math.sqrt(0.21)  # of the three
    assert fused.ellipse_at(0).semi_major_m == pytest.approx(
        math.hypot(0.3, spread_m, VEHICLE_SIGMA_M), abs=0.01
    )


def test_object_that_is_cut_off_for_long_has_no_position() -> None:
    """It was seen whole, then drives away, 2 m/s² up to 3 m/s, cut off by the image's edge."""
    tracks, vehicle = ObjectTable(), (0.0, 0.0, -5.0)
    for frame in range(5):
        tracks.update([seen(vehicle, (10.0, 0.0), frame, sigma_m=0.3)], vehicle, T0 + frame * PERIOD_NS)
    whole_m = position_of(tracks).ellipse_at(0).semi_major_m
    for frame in range(5, 305):
        elapsed_s = 0.1 * (frame - 4)
        at = (10.0 + (elapsed_s**2 if elapsed_s < 1.5 else 3.0 * elapsed_s - 2.25), 0.0)
        target = replace(seen((at[0] - 10.0, 0.0, -5.0), at, frame), cut=True)
        tracks.update([target], (at[0] - 10.0, 0.0, -5.0), target.captured_ns)
        fused = located(tracks, 7, target.captured_ns)
        if frame - 4 > 25:
            assert fused is None
        else:
            assert fused is not None
            grown_m = fused.ellipse_at(0).semi_major_m
            assert grown_m > whole_m
            assert not fused.moving
            assert at[0] - fused.position_at(0)[0] < 2.45 * grown_m
    # To fly to, there is one.
    cut = tracks.of_track(7)
    assert cut is not None
    assert cut.position_at(0)[:2] == pytest.approx((97.75, 0.0), abs=0.1)
    whole = seen((88.0, 0.0, -5.0), (98.0, 0.0), 305, sigma_m=0.3)
    tracks.update([whole], (88.0, 0.0, -5.0), whole.captured_ns)
    assert located(tracks, 7, whole.captured_ns) is not None
    assert place_of(tracks)[0] == pytest.approx(98.0, abs=1.0)


@pytest.mark.parametrize("shown", ["with its range", "by its bearing alone", "with another part"])
def test_object_that_leaves_the_image_keeps_its_position(shown: str) -> None:
    """The middle of the part within the image moves along, or jumps."""
    tracks, vehicle = ObjectTable(), (0.0, 0.0, -5.0)
    for frame in range(40):
        leaving = max(frame - 20, 0)
        east_m = 0.2 * leaving + (2.0 if shown == "with another part" and leaving > 10 else 0.0)
        target = replace(seen(vehicle, (12.0, east_m), frame, sigma_m=0.5), cut=leaving > 0)
        if shown == "by its bearing alone" and leaving > 0:
            target = replace(target, position_ned_m=None, range_source=RangeSource.NONE)
        tracks.update([target], vehicle, target.captured_ns)
        assert not position_of(tracks).occluded
    assert place_of(tracks)[:2] == pytest.approx((12.0, 0.0))
    assert not position_of(tracks).moving


def test_part_of_an_object_that_leaves_at_the_top_is_left_out() -> None:
    """The upper edge hides more and more of a truck; of the last third only the left half is detected."""
    tracks, vehicle = ObjectTable(), (0.0, 0.0, -5.0)
    for frame in range(30):
        height_px = 80.0 - 8.0 * max(frame - 20, 0)
        east_m = -1.6 if height_px < 40.0 else 0.0
        target = seen(vehicle, (20.0, east_m), frame, sigma_m=0.3, across_m=0.1)
        box = (180.0, 0.0, 300.0, height_px)
        target = replace(target, cut_above=frame > 20, box_xyxy=box)
        tracks.update([target], vehicle, target.captured_ns)
        assert not position_of(tracks).moving
    assert place_of(tracks)[:2] == pytest.approx((20.0, 0.0))


def test_whole_object_farther_away_at_the_upper_edge_counts() -> None:
    """Its box is lower than half of the one from near, because it is far."""
    tracks = ObjectTable()
    for frame, range_m in enumerate((5.0, 20.0)):
        vehicle, box = (20.0 - range_m, 0.0, -5.0), (180.0, 0.0, 300.0, 800.0 / range_m)
        target = replace(seen(vehicle, (20.0, 0.0), frame), cut_above=frame > 0, box_xyxy=box)
        tracks.update([target], vehicle, target.captured_ns)
    assert position_of(tracks).located_ns == T0 + PERIOD_NS


def test_object_that_moves_along_the_upper_edge_is_moving() -> None:
    """3 m/s; its box is cut off, but not to a small part. It was never seen whole, or before."""
    for first_cut in (0, 10):
        tracks, vehicle = ObjectTable(), (0.0, 0.0, -5.0)
        for frame in range(30):
            east_m = 0.3 * max(frame - 10, 0)
            target = seen(vehicle, (20.0, east_m), frame, sigma_m=0.3, across_m=0.1)
            cut = frame >= first_cut
            target = replace(target, cut_above=cut, box_xyxy=(180.0, 0.0, 300.0, 50.0 if cut else 80.0))
            tracks.update([target], vehicle, target.captured_ns)
        assert position_of(tracks).moving
        assert place_of(tracks)[1] == pytest.approx(0.3 * 19, abs=0.3)


def test_cut_off_box_counts_until_the_object_is_seen_whole() -> None:
    tracks, vehicle = ObjectTable(), (0.0, 0.0, -5.0)
    for frame in range(3):
        target = replace(seen(vehicle, (12.0, 3.0 if frame < 2 else 1.5), frame), cut=frame < 2)
        tracks.update([target], vehicle, target.captured_ns)
        assert place_of(tracks)[1] == pytest.approx(3.0 if frame < 2 else 1.5)


def test_ranges_of_an_object_in_front_are_left_out() -> None:
    tracks = ObjectTable()
    for frame in range(40):
        vehicle = (0.1 * frame, 0.0, -5.0)
        hidden = frame in (10, 11, 25, 39)
        target = seen(vehicle, (20.0, 0.0), frame, sigma_m=0.4, along_error_m=-5.0 if hidden else 0.0)
        tracks.update([target], vehicle, target.captured_ns)
        fused = position_of(tracks)
        assert not fused.moving
        assert fused.position_at(0)[:2] == pytest.approx((20.0, 0.0), abs=0.01)


def test_only_trusted_tracks_with_a_range_are_fused() -> None:
    tracks, vehicle = ObjectTable(), (0.0, 0.0, -5.0)
    target = seen(vehicle, (10.0, 0.0), 0)
    no_range = replace(
        target, position_ned_m=None, range_source=RangeSource.NONE, range_sigma_m=math.nan, track_id=3
    )
    targets = [no_range, replace(target, trusted=False, track_id=4), replace(target, track_id=None)]
    tracks.update(targets, vehicle, T0)
    assert [located(tracks, track_id, T0) for track_id in (3, 4, 7)] == [None] * 3


def test_track_is_forgotten_after_a_minute() -> None:
    tracks, vehicle = ObjectTable(), (0.0, 0.0, -5.0)
    tracks.update([seen(vehicle, (10.0, 0.0), 0)], vehicle, T0)
    tracks.update([], vehicle, T0 + 59_000_000_000)
    assert located(tracks, 7, T0) is not None
    tracks.update([], vehicle, T0 + 61_000_000_000)
    assert located(tracks, 7, T0) is None
