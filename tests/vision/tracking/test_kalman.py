"""The box filter: independent of the frame rate, with consistent uncertainty."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vision.tracking.kalman import SMALLEST_PX, BoxStates, correct, initiate, predict

elapsed = st.floats(0.001, 1.0)


def box(x: float, y: float, width: float = 40.0, height: float = 60.0) -> np.ndarray:
    return np.array([[x - width / 2, y - height / 2, x + width / 2, y + height / 2]])


def moving(speed_px_s: tuple[float, float]) -> BoxStates:
    states = initiate(box(100, 100))
    states.mean[0, 4:6] = speed_px_s
    return states


def eigenvalues(states: BoxStates) -> np.ndarray:
    return np.linalg.eigvalsh(states.covariance)


def test_initial_box_equals_its_detection() -> None:
    np.testing.assert_allclose(initiate(box(50, 80)).xyxy, box(50, 80))
    assert len(BoxStates.none()) == 0
    assert BoxStates.none().xyxy.shape == (0, 4)


@given(elapsed, elapsed)
def test_two_steps_are_the_same_as_one_over_both(first_s: float, second_s: float) -> None:
    twice = predict(predict(moving((30, -20)), first_s), second_s)
    once = predict(moving((30, -20)), first_s + second_s)
    np.testing.assert_allclose(twice.mean, once.mean)
    np.testing.assert_allclose(twice.covariance, once.covariance, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("elapsed_s", [0.0, -0.5])
def test_no_time_changes_nothing(elapsed_s: float) -> None:
    states = moving((30, -20))
    assert predict(states, elapsed_s) is states


def test_prediction_widens_and_correction_narrows() -> None:
    states = initiate(box(100, 100))
    later = predict(states, 0.5)
    assert np.trace(later.covariance[0]) > np.trace(states.covariance[0])
    seen = correct(later, box(104, 99))
    assert np.trace(seen.covariance[0]) < np.trace(later.covariance[0])
    assert 100 < seen.mean[0, 0] < 104


def test_a_steady_speed_is_learnt_from_frames_at_uneven_times() -> None:
    rng = np.random.default_rng(0)
    states, now_s = initiate(box(100, 100)), 0.0
    for _ in range(25):
        step_s = float(rng.uniform(0.02, 0.2))
        now_s += step_s
        states = correct(predict(states, step_s), box(100 + 60 * now_s, 100 - 35 * now_s))
    np.testing.assert_allclose(states.mean[0, 4:6], [60, -35], atol=2)
    ahead = predict(states, 0.4)
    np.testing.assert_allclose(
        ahead.mean[0, :2], [100 + 60 * (now_s + 0.4), 100 - 35 * (now_s + 0.4)], atol=3
    )


@given(st.lists(st.tuples(elapsed, st.floats(-30, 30), st.floats(5, 200)), min_size=1, max_size=15))
def test_covariance_stays_positive_definite(steps: list[tuple[float, float, float]]) -> None:
    states = initiate(box(100, 100))
    for step_s, shift, width in steps:
        states = correct(predict(states, step_s), box(100 + shift, 100, width))
    np.testing.assert_allclose(states.covariance, states.covariance.transpose(0, 2, 1))
    assert eigenvalues(states).min() > 0


def test_batch_equals_single_updates() -> None:
    first, second = box(100, 100), box(300, 40, 10, 90)
    both = correct(
        predict(initiate(np.concatenate([first, second])), 0.1), np.concatenate([first, second]) + 3
    )
    for index, one in enumerate((first, second)):
        alone = correct(predict(initiate(one), 0.1), one + 3)
        np.testing.assert_allclose(both.mean[index], alone.mean[0])
        np.testing.assert_allclose(both.covariance[index], alone.covariance[0])


def test_a_box_without_a_size_gets_the_smallest() -> None:
    states = initiate(np.array([[10.0, 10.0, 10.0, 5.0]]))
    left, top, right, bottom = states.xyxy[0]
    assert (right - left, bottom - top) == (SMALLEST_PX, SMALLEST_PX)
    assert np.isfinite(correct(predict(states, 0.1), states.xyxy).mean).all()
