"""Own motion against what is seen: what is inconsistent, and what is not."""

from __future__ import annotations

import math

import numpy as np
import pytest

from companion.guidance.objects.closing_check import LEAST_FLOWN_M, Approached, ClosingCheck
from companion.guidance.objects.target import RangeSource, Target
from companion.vehicle.state import Vector3

PERIOD_NS = 66_000_000
HEIGHT_M = 4.0


def seen_at(
    stamp_ns: int,
    north_m: float,
    *,
    sigma_m: float = 0.2,
    box_px: float = 0.0,
    cut: bool = False,
    track_id: int | None = None,
) -> Target:
    """An object on the ground `north_m` ahead, with a box that is `box_px` beside its place."""
    box = (300.0 + box_px, 200.0, 340.0 + box_px, 300.0)
    return Target(
        "person",
        0.9,
        stamp_ns,
        0.0,
        -math.atan2(HEIGHT_M, north_m),
        ground_range_m=north_m,
        range_source=RangeSource.GROUND_PLANE,
        position_ned_m=(north_m, 0.0, 0.0),
        box_xyxy=box,
        track_id=track_id,
        distance_m=math.hypot(north_m, HEIGHT_M),
        distance_sigma_m=sigma_m,
        cut=cut,
        cut_above=cut,
    )


def flown(
    *,
    speed_mps: float,
    away_mps: float = 0.0,
    noise_m: float = 0.0,
    sigma_m: float = 0.2,
    box_px: float = 1.0,
    seconds: float = 6.0,
    approached: bool = True,
    cut: bool = False,
    freezes_s: float = math.inf,
    rounded: bool = False,
    used: bool = True,
) -> tuple[str, float]:
    """The fault of a flight to an object that recedes, and how far was flown until then."""
    check, rng, north_m, offset_px = ClosingCheck(), np.random.default_rng(5), 0.0, 0.0
    for number in range(round(seconds * 1e9 / PERIOD_NS)):
        stamp_ns = 10**9 + number * PERIOD_NS
        time_s = number * PERIOD_NS / 1e9
        north_m = speed_mps * time_s
        range_m = 15.0 + (away_mps - speed_mps) * time_s + float(rng.normal(0.0, noise_m))
        if time_s < freezes_s:
            offset_px = float(rng.uniform(-box_px, box_px))
            offset_px = round(offset_px) if rounded else offset_px
        target = seen_at(stamp_ns, range_m, sigma_m=sigma_m, box_px=offset_px, cut=cut)
        position: Vector3 = (north_m, 0.0, -HEIGHT_M)
        seen = Approached(target) if approached else None
        fault = check.update(seen, (target,), stamp_ns, position, used=used)
        if fault:
            return fault, north_m
    return "", north_m


@pytest.mark.parametrize("away_mps", [-1.5, -0.5, 0.0, 0.5, 1.0])
@pytest.mark.parametrize(("noise_m", "sigma_m"), [(0.0, 0.1), (0.3, 0.5), (1.0, 1.5)])
def test_an_object_that_comes_nearer_is_consistent(away_mps: float, noise_m: float, sigma_m: float) -> None:
    fault, _ = flown(speed_mps=2.0, away_mps=away_mps, noise_m=noise_m, sigma_m=sigma_m)
    assert not fault


@pytest.mark.parametrize("speed_mps", [0.5, 1.0, 2.0, 4.0])
@pytest.mark.parametrize("sigma_m", [0.1, 0.7, 1.5])
def test_a_distance_that_does_not_fall_is_a_fault(speed_mps: float, sigma_m: float) -> None:
    fault, flown_m = flown(
        speed_mps=speed_mps, away_mps=speed_mps, noise_m=sigma_m / 5, sigma_m=sigma_m, seconds=20.0
    )
    assert "fell by" in fault
    # Three blocks of half a second at most after the way that is needed.
    assert LEAST_FLOWN_M < flown_m < max(LEAST_FLOWN_M, 2.0 * sigma_m) + 1.5 * speed_mps + 0.1


def frozen_boxes(*, speed_mps: float = 2.0, cut: bool = False, **options: bool) -> tuple[str, float]:
    """The fault of a flight whose boxes move in the image for a second, and then stay."""
    options = {"approached": False, "cut": cut, **options}
    return flown(speed_mps=speed_mps, away_mps=speed_mps, box_px=3.0, freezes_s=1.0, **options)


def test_boxes_that_stop_changing_are_a_fault_for_any_behaviour() -> None:
    fault, flown_m = frozen_boxes()
    assert "pixels" in fault
    assert flown_m == pytest.approx(2.0 + LEAST_FLOWN_M, abs=0.3)


@pytest.mark.parametrize("case", [{"speed_mps": 0.0}, {"cut": True}, {"rounded": True}, {"used": False}])
def test_boxes_may_stay_where_that_shows_nothing(case: dict[str, float]) -> None:
    assert frozen_boxes(**case)[0] == ""  # type: ignore[arg-type]


@pytest.mark.parametrize("tracks", [True, False])
@pytest.mark.parametrize("beside_s", [0.0, 2.0])
def test_a_part_of_the_vehicle_stays_at_its_pixels(beside_s: float, tracks: bool) -> None:
    check, rng = ClosingCheck(), np.random.default_rng(5)
    for number in range(150):
        stamp_ns = 10**9 + number * PERIOD_NS
        gear = seen_at(stamp_ns, 10.0, track_id=1 if tracks else None)
        other = seen_at(stamp_ns, 10.0, box_px=100.0 + rng.normal(0.0, 2.0), track_id=2 if tracks else None)
        seen = (other, gear) if number * PERIOD_NS / 1e9 < beside_s else (gear,)
        assert not check.update(None, seen, stamp_ns, (0.3 * number, 0.0, -HEIGHT_M))


def test_a_camera_that_froze_before_the_command_is_found() -> None:
    check, rng, offset_px = ClosingCheck(), np.random.default_rng(5), 0.0
    for number in range(60):
        stamp_ns = 10**9 + number * PERIOD_NS
        offset_px = rng.normal(0.0, 2.0) if number < 15 else offset_px
        seen = seen_at(stamp_ns, 10.0, box_px=offset_px)
        check.update(None, (seen,), stamp_ns, (0.1 * max(0, number - 30), 0.0, -HEIGHT_M), used=number > 30)
        if number == 30:
            check.reset()
    assert "pixels" in check.fault


def test_a_followed_object_may_keep_its_distance() -> None:
    assert flown(speed_mps=3.0, away_mps=3.0, approached=False)[0] == ""


def test_an_object_that_moves_is_compared_by_height_alone() -> None:
    check = ClosingCheck()
    level_fault = ""
    for number in range(60):
        stamp_ns = 10**9 + number * PERIOD_NS
        seen = Approached(seen_at(stamp_ns, 10.0, box_px=float(number % 3)), moves=True)
        level_fault = level_fault or check.update(seen, (), stamp_ns, (0.2 * number, 0.0, -HEIGHT_M))
    assert level_fault == ""
    check.reset()
    for number in range(60):
        stamp_ns = 10**9 + number * PERIOD_NS
        down_m = -20.0 + 0.1 * number
        below = Target(
            "marker 7",
            1.0,
            stamp_ns,
            0.0,
            -math.pi / 2,
            range_source=RangeSource.MARKER,
            position_ned_m=(0.0, 0.0, down_m + 8.0),
            distance_m=8.0,
            range_sigma_m=0.1,
        )
        check.update(Approached(below, moves=True), (), stamp_ns, (0.0, 0.0, down_m))
    assert "marker 7" in check.fault


@pytest.mark.parametrize("between", ["another track", "none for a moment", "another behaviour"])
def test_distances_of_two_objects_are_not_compared(between: str) -> None:
    check = ClosingCheck()
    for number in range(120):
        stamp_ns, north_m = 10**9 + number * PERIOD_NS, 0.1 * number
        second = number >= 40
        track_id = 2 if second and between == "another track" else 1
        place_m = 20.0 if second else 10.0
        seen = seen_at(stamp_ns, place_m - north_m, box_px=float(number % 3), track_id=track_id)
        if number == 40 and between == "another behaviour":
            check.begin_again()
        approached = None if number == 40 and between == "none for a moment" else Approached(seen)
        assert not check.update(approached, (seen,), stamp_ns, (north_m, 0.0, -HEIGHT_M))


def test_beginning_again_keeps_the_fault() -> None:
    check = ClosingCheck()
    for number in range(60):
        stamp_ns = 10**9 + number * PERIOD_NS
        seen = Approached(seen_at(stamp_ns, 10.0))
        check.update(seen, (), stamp_ns, (0.2 * number, 0.0, -HEIGHT_M))
    check.begin_again()
    assert check.fault
