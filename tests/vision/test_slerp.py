"""Attitudes between two others."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vision.attitude import Quaternion, euler_from_quaternion, quaternion_from_euler, slerp

quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(v * v for v in q) > 0.01)


@given(quaternions, quaternions, st.floats(0, 1))
def test_slerp_is_proportional_along_the_shorter_arc(
    first: Quaternion, second: Quaternion, fraction: float
) -> None:
    def angle(a: Quaternion, b: Quaternion) -> float:
        one, other = (np.array(q) / np.linalg.norm(q) for q in (a, b))
        return 2 * math.acos(min(1.0, abs(float(one @ other))))

    middle = slerp(first, second, fraction)
    assert math.isclose(sum(v * v for v in middle), 1.0, rel_tol=1e-9)
    whole = angle(first, second)
    assert angle(first, middle) == pytest.approx(whole * fraction, abs=2e-3)
    assert angle(middle, second) == pytest.approx(whole * (1 - fraction), abs=2e-3)


def test_slerp_ignores_the_sign_of_quaternions() -> None:
    w, x, y, z = quaternion_from_euler(0, 0, 0.8)
    half = slerp(quaternion_from_euler(0, 0, 0.4), (-w, -x, -y, -z), 0.5)
    assert euler_from_quaternion(half)[2] == pytest.approx(0.6)
