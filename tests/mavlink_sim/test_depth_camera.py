"""Depth as a stereo camera measures it: in steps, noisy far off, blind in shadows and out of range."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mavlink_sim.camera.depth_camera import DepthSensor, measured_depth

FOCAL_PX = 400.0
QUIET = DepthSensor(noise_px=0.0, dropout=0.0, minimum_m=0.1, maximum_m=100.0)


def flat(depth_m: float) -> np.ndarray:
    return np.full((48, 64), depth_m, np.float32)


def rng() -> np.random.Generator:
    return np.random.default_rng(5)


@given(st.floats(0.5, 60.0))
def test_the_error_is_half_a_step_of_disparity_at_most(depth_m: float) -> None:
    got = measured_depth(flat(depth_m), FOCAL_PX, QUIET, rng())[10, 10]
    disparity = FOCAL_PX * QUIET.baseline_m / depth_m
    if disparity < QUIET.step_px / 2:
        assert np.isnan(got)
    else:
        assert abs(FOCAL_PX * QUIET.baseline_m / got - disparity) <= QUIET.step_px / 2 + 1e-3


def test_depth_steps_grow_with_square_of_range() -> None:
    slope = np.tile(np.linspace(2.0, 20.0, 4000, dtype=np.float32), (2, 1))
    levels = np.unique(measured_depth(slope, FOCAL_PX, QUIET, rng()))
    levels = levels[np.isfinite(levels)]
    assert len(levels) == pytest.approx((10.0 - 1.0) / 0.125, abs=2)
    gaps = np.diff(levels)
    middle = (levels[1:] + levels[:-1]) / 2
    assert np.allclose(gaps, middle**2 * 0.125 / (FOCAL_PX * 0.05), rtol=0.05)


def test_noise_grows_with_the_square_of_the_range() -> None:
    sensor = DepthSensor(step_px=0.0, noise_px=0.1, dropout=0.0, minimum_m=0.1, maximum_m=100.0)
    near, far = (np.nanstd(measured_depth(flat(z), FOCAL_PX, sensor, rng())) for z in (2.0, 8.0))
    assert near == pytest.approx(4.0 * 0.1 / 20.0, rel=0.1)
    assert far / near == pytest.approx(16.0, rel=0.1)


def test_occluded_pixels_have_no_depth() -> None:
    depth = flat(10.0)
    depth[:, 30:40] = 2.0
    got = measured_depth(depth, FOCAL_PX, QUIET, rng())
    # Disparities 10 and 2: the strip of 8 pixels to the left of the near object.
    assert np.isnan(got[:, 23:30]).all()
    assert np.isfinite(got[:, :21]).all()
    assert np.isfinite(got[:, 30:]).all()


def test_out_of_range_and_in_the_sky_there_is_no_depth() -> None:
    sensor = DepthSensor(minimum_m=1.0, maximum_m=8.0, noise_px=0.0, dropout=0.0)
    for depth_m in (0.5, 9.0, np.nan, np.inf):
        assert np.isnan(measured_depth(flat(depth_m), FOCAL_PX, sensor, rng())).all()
    assert np.isfinite(measured_depth(flat(4.0), FOCAL_PX, sensor, rng())).all()


@pytest.mark.parametrize("share", [0.01, 0.1, 0.4])
def test_dropout_share_matches_setting(share: float) -> None:
    sensor = DepthSensor(dropout=share, noise_px=0.0)
    lost = [
        np.isnan(measured_depth(np.full((240, 320), 4.0, np.float32), FOCAL_PX, sensor, rng())).mean()
        for _ in range(3)
    ]
    assert np.mean(lost) == pytest.approx(share, rel=0.35)


def test_zero_baseline_gives_true_depth_unmodified() -> None:
    depth = flat(3.3)
    got = measured_depth(depth, FOCAL_PX, DepthSensor(baseline_m=0.0, dropout=0.2), rng())
    assert np.all(depth == np.float32(3.3))
    assert np.nanmax(got) == np.nanmin(got) == np.float32(3.3)
    measured_depth(depth, FOCAL_PX, DepthSensor(), rng())
    assert np.all(depth == np.float32(3.3))


def test_the_same_draws_give_the_same_depth() -> None:
    first, again = (measured_depth(flat(5.0), FOCAL_PX, DepthSensor(), rng()) for _ in range(2))
    assert np.array_equal(first, again, equal_nan=True)
    assert first.dtype == np.float32


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"baseline_m": -1.0}, "baseline must be 0 to 2 m"),
        ({"step_px": 5.0}, "0 to 4 px"),
        ({"minimum_m": 5.0, "maximum_m": 5.0}, "range must run upwards"),
        ({"dropout": 1.0}, "dropout must be 0 to below 1"),
    ],
)
def test_invalid_sensor_refused(changes: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        DepthSensor(**changes)
