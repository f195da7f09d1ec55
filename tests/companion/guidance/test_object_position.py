"""Positions of tracks, fused over their detections, and their error ellipses."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from companion.guidance.objects.table import ObjectTable
from companion.guidance.objects.target import RangeSource
from companion.guidance.objects.tracked_object import TrackedObject
from companion.vehicle.state import Vector3
from tests.companion.guidance.guidance_harness import known
from tests.companion.guidance.one_object import PERIOD_NS, T0, VEHICLE, seen_car

VEHICLE_SIGMA_M = 0.2


class Fused:
    """What a table makes of the detections of track 7, one frame after the other."""

    def __init__(self) -> None:
        self.table, self.frame = ObjectTable(), -1

    def sees(self, *at: float, vehicle: Vector3 = VEHICLE, sigma_m: float = 1.0, **changes: Any) -> None:
        """The next frame. sigma_m: of the range."""
        self.frame += 1
        sigmas = {"range_sigma_m": sigma_m, "across_sigma_m": 0.3, "vehicle_sigma_m": VEHICLE_SIGMA_M}
        target = seen_car(at, self.frame, vehicle=vehicle, **({"track_id": 7, **sigmas} | changes))
        self.table.update([target], vehicle, target.captured_ns)

    def located(self, track_id: int = 7, now_ns: int = 0) -> TrackedObject | None:
        seen = self.table.of_track(track_id)
        return seen if seen is not None and seen.confirmed and seen.located(now_ns) else None

    @property
    def now(self) -> TrackedObject:
        return known(self.located())

    @property
    def place(self) -> tuple[float, ...]:
        return self.now.position_at(0)[:2]

    @property
    def major_m(self) -> float:
        return self.now.ellipse_at(0).semi_major_m

    def in_sigmas(self, error_m: Any) -> float:
        """The square of an error (north, east), in sigmas of the ellipse."""
        major_m, minor_m, orientation = self.now.ellipse_at(0)
        axis = np.array((math.cos(orientation), math.sin(orientation)))
        along, across = float(error_m @ axis), float(error_m @ (-axis[1], axis[0]))
        return (along / major_m) ** 2 + (across / minor_m) ** 2


def test_one_detection_has_its_own_ellipse() -> None:
    fused = Fused()
    fused.sees(0.0, 20.0)
    ellipse = fused.now.ellipse_at(0)
    assert fused.now.position_at(0) == pytest.approx((0.0, 20.0, 0.0))
    assert ellipse.semi_major_m == pytest.approx(math.hypot(1.0, VEHICLE_SIGMA_M))
    assert ellipse.semi_minor_m == pytest.approx(math.hypot(0.3, VEHICLE_SIGMA_M))
    assert math.degrees(ellipse.orientation_rad) == pytest.approx(90.0)


def test_near_detection_outweighs_far_ones() -> None:
    fused = Fused()
    for _ in range(10):
        fused.sees(20.0, 0.0, sigma_m=4.0, along_error_m=4.0)
    for _ in range(10):
        fused.sees(20.0, 0.0, sigma_m=0.5, vehicle=(12.0, 0.0, -5.0))
    assert fused.place[0] == pytest.approx(20.0, abs=0.1)
    # The mean information of both halves, not the sum of all.
    assert 0.5 < fused.major_m < 0.8


def test_views_from_two_sides_shrink_the_ellipse() -> None:
    one, two, south, west = Fused(), Fused(), (-15.0, 0.0, -5.0), (0.0, -15.0, -5.0)
    for frame in range(20):
        one.sees(0.0, 0.0, vehicle=south)
        two.sees(0.0, 0.0, vehicle=south if frame % 2 else west)
    assert one.major_m == pytest.approx(math.hypot(1.0, VEHICLE_SIGMA_M))
    assert two.major_m < 0.6


def test_ellipse_covers_the_error_that_all_frames_share() -> None:
    """Half of each flight's variance is one error of the whole flight, such as of the camera's mount."""
    rng, inside, errors_m = np.random.default_rng(31), [], []
    for _ in range(100):
        fused, common = Fused(), rng.normal(0.0, math.sqrt(0.5), 3)
        turn = float(rng.uniform(0.0, math.pi))
        for frame in range(60):
            angle = turn * frame / 60
            vehicle = (-12.0 * math.cos(angle), -12.0 * math.sin(angle), -5.0)
            along_m, across_m = common[:2] + rng.normal(0.0, math.sqrt(0.5), 2)
            fused.sees(
                0.0, 0.0, vehicle=vehicle,
                along_error_m=float(along_m), across_error_m=0.3 * float(across_m),
            )  # fmt: skip
        error = np.array(fused.place) + rng.normal(0.0, VEHICLE_SIGMA_M, 2)
        inside.append(fused.in_sigmas(error) < 5.99)
        errors_m.append(math.hypot(*error))
    assert np.mean(inside) >= 0.95
    assert np.median(errors_m) < 0.7


def test_moving_object_has_its_newest_position() -> None:
    fused, rng = Fused(), np.random.default_rng(5)
    for frame in range(60):  # 3 m/s
        fused.sees(12.0, 0.3 * frame - 9.0, sigma_m=0.5, along_error_m=float(rng.normal(0.0, 0.1)))
    assert fused.now.moving
    assert fused.now.located_ns == T0 + 59 * PERIOD_NS
    assert math.dist(fused.place, (12.0, 8.7)) < 0.5


def test_standing_object_seen_from_a_moving_vehicle_stands() -> None:
    fused = Fused()
    for frame in range(60):  # towards it at 3 m/s, the range 5 % too long
        north = 0.3 * frame - 30.0
        fused.sees(0.0, 0.0, vehicle=(north, 0.0, -5.0), along_error_m=-0.05 * north)
    assert not fused.now.moving


@pytest.mark.parametrize("speed_mps", [0.0, 0.5])
def test_only_a_displacement_beyond_the_common_error_is_motion(speed_mps: float) -> None:
    """The attitude is wrong by its sigma: the error is that of a range by the ground, from 5 m above."""
    fused, error_rad = Fused(), 0.06 if speed_mps == 0.0 else 0.01
    for frame in range(70):
        vehicle, north = (0.3 * frame - 32.0, 0.0, -5.0), -0.1 * speed_mps * frame
        sigma_m = error_rad * (north - vehicle[0]) ** 2 / 5.0
        fused.sees(north, 0.0, vehicle=vehicle, sigma_m=sigma_m, along_error_m=sigma_m)
        if frame >= 60 or speed_mps == 0.0:
            assert fused.now.moving == (speed_mps > 0.0)


@pytest.mark.parametrize("speed_mps", [0.7, 1.2])
@pytest.mark.parametrize("along", [False, True], ids=["across", "away"])
def test_ellipse_covers_a_slow_walker(speed_mps: float, along: bool) -> None:
    fused, rng = Fused(), np.random.default_rng(17)
    for frame in range(200):
        walked_m = speed_mps * 0.1 * frame
        at = (8.0 + walked_m, 0.0) if along else (12.0, walked_m - 10.0 * speed_mps)
        off_m = [float(rng.normal(0.3, 0.2)), float(rng.normal(0.0, 0.1))]
        fused.sees(*at, sigma_m=0.5, along_error_m=off_m[0], across_error_m=off_m[1])
        error = np.array(fused.place) - at
        assert fused.in_sigmas(error) < 5.99
        assert along or math.hypot(*error) < 1.5


def test_object_that_was_moved_is_located_again() -> None:
    fused = Fused()
    for frame in range(40):
        fused.sees(12.0, 0.0 if frame < 20 else 4.0, sigma_m=0.5)
    assert fused.place == pytest.approx((12.0, 4.0), abs=0.01)


def test_outliers_that_do_not_fit_each_other_are_left_out() -> None:
    fused = Fused()
    for north in (*[10.0] * 50, 30.0, 4.0, 22.0, 10.0):
        fused.sees(north, 0.0, sigma_m=0.3)
        assert fused.place == pytest.approx((10.0, 0.0), abs=0.01)
        assert not fused.now.moving
    assert fused.now.located_ns == T0 + 53 * PERIOD_NS


def test_spread_of_fitting_outliers_is_part_of_the_error() -> None:
    fused = Fused()
    for north in (*[10.0] * 20, 30.0, 30.6, 29.7):
        fused.sees(north, 0.0, sigma_m=0.3, across_sigma_m=0.2)
    assert fused.place == pytest.approx((29.7, 0.0))
    spread_m = math.sqrt(0.21)  # of the three
    assert fused.major_m == pytest.approx(math.hypot(0.3, spread_m, VEHICLE_SIGMA_M), abs=0.01)


def test_object_that_is_cut_off_for_long_has_no_position() -> None:
    """It was seen whole, then drives away, 2 m/s² up to 3 m/s, cut off by the image's edge."""
    fused = Fused()
    for _ in range(5):
        fused.sees(10.0, 0.0, sigma_m=0.3)
    whole_m = fused.major_m
    for frame in range(5, 305):
        elapsed_s = 0.1 * (frame - 4)
        north = 10.0 + (elapsed_s**2 if elapsed_s < 1.5 else 3.0 * elapsed_s - 2.25)
        fused.sees(north, 0.0, vehicle=(north - 10.0, 0.0, -5.0), cut=True)
        if frame - 4 > 25:
            assert fused.located(7, T0 + frame * PERIOD_NS) is None
        else:
            assert fused.major_m > whole_m
            assert not fused.now.moving
            assert north - fused.place[0] < 2.45 * fused.major_m
    # To fly to, there is one.
    assert known(fused.table.of_track(7)).position_at(0)[:2] == pytest.approx((97.75, 0.0), abs=0.1)
    fused.sees(98.0, 0.0, vehicle=(88.0, 0.0, -5.0), sigma_m=0.3)
    assert fused.located(7, T0 + 305 * PERIOD_NS) is not None
    assert fused.place[0] == pytest.approx(98.0, abs=1.0)


@pytest.mark.parametrize("shown", ["with its range", "by its bearing alone", "with another part"])
def test_object_that_leaves_the_image_keeps_its_position(shown: str) -> None:
    """The middle of the part within the image moves along, or jumps."""
    fused = Fused()
    for frame in range(40):
        leaving = max(frame - 20, 0)
        east = 0.2 * leaving + (2.0 if shown == "with another part" and leaving > 10 else 0.0)
        by_bearing = shown == "by its bearing alone" and leaving > 0
        unranged: dict[str, Any] = (
            {"position_ned_m": None, "range_source": RangeSource.NONE} if by_bearing else {}
        )
        fused.sees(12.0, east, sigma_m=0.5, cut=leaving > 0, **unranged)
        assert not fused.now.occluded
    assert fused.place == pytest.approx((12.0, 0.0))
    assert not fused.now.moving


def test_part_of_an_object_that_leaves_at_the_top_is_left_out() -> None:
    """The upper edge hides more and more of a truck; of the last third only the left half is detected."""
    fused = Fused()
    for frame in range(30):
        height_px = 80.0 - 8.0 * max(frame - 20, 0)
        box = (180.0, 0.0, 300.0, height_px)
        east = -1.6 if height_px < 40.0 else 0.0
        fused.sees(20.0, east, sigma_m=0.3, across_sigma_m=0.1, cut_above=frame > 20, box_xyxy=box)
        assert not fused.now.moving
    assert fused.place == pytest.approx((20.0, 0.0))


def test_whole_object_farther_away_at_the_upper_edge_counts() -> None:
    """Its box is lower than half of the one from near, because it is far."""
    fused = Fused()
    for frame, range_m in enumerate((5.0, 20.0)):
        box = (180.0, 0.0, 300.0, 800.0 / range_m)
        fused.sees(20.0, 0.0, vehicle=(20.0 - range_m, 0.0, -5.0), cut_above=frame > 0, box_xyxy=box)
    assert fused.now.located_ns == T0 + PERIOD_NS


@pytest.mark.parametrize("first_cut", [0, 10])
def test_object_that_moves_along_the_upper_edge_is_moving(first_cut: int) -> None:
    """3 m/s; its box is cut off, but not to a small part. It was never seen whole, or before."""
    fused = Fused()
    for frame in range(30):
        cut = frame >= first_cut
        box = (180.0, 0.0, 300.0, 50.0 if cut else 80.0)
        east = 0.3 * max(frame - 10, 0)
        fused.sees(20.0, east, sigma_m=0.3, across_sigma_m=0.1, cut_above=cut, box_xyxy=box)
    assert fused.now.moving
    assert fused.place[1] == pytest.approx(0.3 * 19, abs=0.3)


def test_cut_off_box_counts_until_the_object_is_seen_whole() -> None:
    fused = Fused()
    for east, cut in ((3.0, True), (3.0, True), (1.5, False)):
        fused.sees(12.0, east, cut=cut)
        assert fused.place[1] == pytest.approx(east)


def test_ranges_of_an_object_in_front_are_left_out() -> None:
    fused = Fused()
    for frame in range(40):
        hidden_m = -5.0 if frame in (10, 11, 25, 39) else 0.0
        fused.sees(20.0, 0.0, vehicle=(0.1 * frame, 0.0, -5.0), sigma_m=0.4, along_error_m=hidden_m)
        assert not fused.now.moving
        assert fused.place == pytest.approx((20.0, 0.0), abs=0.01)


@pytest.mark.parametrize(
    "change", [{"source": RangeSource.NONE}, {"trusted": False}, {"track_id": None}], ids=str
)
def test_only_trusted_tracks_with_a_range_are_fused(change: dict[str, Any]) -> None:
    fused = Fused()
    fused.sees(10.0, 0.0, **change)
    assert fused.located() is None


def test_track_is_forgotten_after_a_minute() -> None:
    fused = Fused()
    fused.sees(10.0, 0.0)
    fused.table.update([], VEHICLE, T0 + 59_000_000_000)
    assert fused.located(7, T0) is not None
    fused.table.update([], VEHICLE, T0 + 61_000_000_000)
    assert fused.located(7, T0) is None
