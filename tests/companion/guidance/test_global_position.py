"""A place on the earth is the same in local NED for every command, message and other vehicle."""

from __future__ import annotations

from dataclasses import replace

import pytest

from companion.bus.vehicle_messages import geodetic_origin
from companion.guidance.formation.neighbours import Neighbours
from companion.guidance.motion import local_from_global
from companion.perception.map_position import map_origin_ned_m
from companion.vehicle.state import Vector3
from tests.companion.guidance.guidance_harness import known
from tests.companion.guidance.test_neighbours import state_at
from tests.companion.guidance.test_pose import NOW_NS

HERE = (47.4, 8.5, 493.0)
# By the time of the global position it has flown on by a metre.
STATE = replace(
    state_at(NOW_NS),
    position_ned_m=(5.0, -2.0, -4.0),
    velocity_ned_mps=(10.0, 0.0, 0.0),
    position_ns=NOW_NS - 10**8,
    global_ns=NOW_NS,
    latitude_deg=HERE[0],
    longitude_deg=HERE[1],
    altitude_amsl_m=HERE[2],
)
MOVED: Vector3 = (6.0, -2.0, -4.0)


def test_place_is_the_same_for_everyone() -> None:
    assert local_from_global(STATE, NOW_NS, HERE[:2]) == pytest.approx(MOVED[:2], abs=1e-6)
    assert map_origin_ned_m(HERE, STATE) == pytest.approx(MOVED, abs=1e-6)
    anchor = known(Neighbours("alone").neighbourhood(STATE, NOW_NS).anchor)
    assert anchor.local(*HERE) == pytest.approx(MOVED, abs=1e-6)
    assert known(geodetic_origin(STATE, NOW_NS)).place(MOVED) == pytest.approx(HERE, abs=1e-6)
