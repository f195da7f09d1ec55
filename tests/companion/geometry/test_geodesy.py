"""Distances on the earth."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.geometry.geodesy import north_east
from companion.vehicle.state import Vector3


@given(st.floats(-60, 60), st.floats(-180, 180), st.floats(-2000, 2000), st.floats(-2000, 2000))
def test_north_east_agrees_with_the_ellipsoid(
    latitude: float, longitude: float, north_m: float, east_m: float
) -> None:
    """Compared with the chord between both points in earth-centred coordinates."""

    def earth_centred(position: tuple[float, float]) -> Vector3:
        phi, lam = map(math.radians, position)
        normal = 6378137.0 / math.sqrt(1 - 6.694379990141e-3 * math.sin(phi) ** 2)
        return (
            normal * math.cos(phi) * math.cos(lam),
            normal * math.cos(phi) * math.sin(lam),
            normal * (1 - 6.694379990141e-3) * math.sin(phi),
        )

    there = (latitude + north_m / 111_000, longitude + east_m / (111_000 * math.cos(math.radians(latitude))))
    found = north_east((latitude, longitude), there)
    chord = math.dist(earth_centred((latitude, longitude)), earth_centred(there))
    assert math.hypot(*found) == pytest.approx(chord, abs=0.02)
