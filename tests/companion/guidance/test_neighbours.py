"""Neighbours: age of poses, prediction, and which vehicles are known."""

from __future__ import annotations

import json
import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.bus.vehicle_messages import pose_message
from companion.guidance.behaviour import Behaviour, BehaviourContext, BehaviourOutput, Requirement
from companion.guidance.formation.neighbours import (
    Neighbour,
    Neighbourhood,
    Neighbours,
    missing_neighbours,
)
from companion.guidance.formation.pose import Pose
from companion.guidance.requirements import check_requirements
from companion.vehicle.global_position import Anchor
from companion.vehicle.state import Vector3, VehicleState
from tests.companion.guidance.guidance_harness import known
from tests.companion.guidance.test_pose import NOW_NS, STATE

SECOND = 10**9
PLACE = Anchor(47.4, 8.5, 493.0, (0.0, 0.0, 0.0))


def pose(
    published_ns: int,
    name: str = "alpha",
    offset: Vector3 = (10.0, 0.0, 0.0),
    source: str = "a",
) -> Pose:
    latitude, longitude, altitude = PLACE.globally(offset)
    place, moving = (latitude, longitude, altitude), ((2.0, 0.0, 0.0), 0.5, 0.1)
    return Pose(name, source, published_ns, 0.0, *place, *moving, "alone", True, None)


def state_at(now_ns: int) -> VehicleState:
    return replace(
        STATE,
        heartbeat_ns=now_ns,
        attitude_ns=now_ns,
        position_ns=now_ns,
        global_ns=now_ns,
        velocity_ned_mps=(0.0, 0.0, 0.0),
    )


def alpha_of(neighbours: Neighbours, now_ns: int) -> Neighbour:
    alpha = neighbours.neighbourhood(state_at(now_ns), now_ns).named("alpha")
    return known(alpha)


@given(
    st.floats(-80, 80), st.floats(-180, 180), st.tuples(*[st.floats(-3000, 3000)] * 2, st.floats(-100, 100))
)
def test_global_conversion_round_trip(latitude: float, longitude: float, position: Vector3) -> None:
    anchor = Anchor(latitude, longitude, 100.0, (3.0, -4.0, 5.0))
    assert anchor.local(*anchor.globally(position)) == pytest.approx(position, abs=0.01)


def test_different_local_origins_are_supported() -> None:
    neighbours = Neighbours("beta")
    neighbours.on_message(json.dumps(pose_message(pose(0))).encode(), NOW_NS)
    # The own local origin differs: this vehicle is at (1, 2, -5).
    alpha = alpha_of(neighbours, NOW_NS)
    assert alpha.position_ned_m == pytest.approx((11.0, 2.0, -5.0), abs=0.02)


def test_age_includes_the_delay_despite_clock_offset() -> None:
    neighbours, apart_ns = Neighbours("beta"), 7_000 * SECOND
    delays_s = [0.1, 0.03, 0.25]
    for index, delay_s in enumerate(delays_s):
        sent_ns = index * SECOND // 10
        neighbours.ingest(pose(sent_ns), NOW_NS + sent_ns + apart_ns + round(delay_s * 1e9))
    now_ns = NOW_NS + apart_ns + 2 * SECOND // 10 + round(0.3e9)
    # The last was sent 0.3 s ago; the minimum delay is unknown.
    assert neighbours.ages_s(now_ns)["alpha"] == pytest.approx(0.3 - 0.03, abs=0.002)


def test_prediction_of_a_neighbour_is_limited() -> None:
    neighbours = Neighbours("beta")
    neighbours.ingest(pose(0), NOW_NS)
    for after_s, north, silent in ((0.5, 12.0, False), (3.0, 13.0, True)):
        now_ns = NOW_NS + round(after_s * 1e9)
        alpha = alpha_of(neighbours, now_ns)
        assert alpha.position_ned_m[0] == pytest.approx(north, abs=0.02)
        assert alpha.silent is silent
        assert alpha.velocity_ned_mps == ((0.0, 0.0, 0.0) if silent else (2.0, 0.0, 0.0))
        assert alpha.heading_rad == pytest.approx(0.5 + 0.1 * min(after_s, 1.0))


def test_neighbour_is_removed_after_30_s_of_silence() -> None:
    neighbours = Neighbours("beta")
    neighbours.ingest(pose(0), NOW_NS)
    assert neighbours.neighbourhood(state_at(NOW_NS + 29 * SECOND), NOW_NS + 29 * SECOND).vehicles
    assert not neighbours.neighbourhood(state_at(NOW_NS + 31 * SECOND), NOW_NS + 31 * SECOND).vehicles


def test_late_pose_does_not_replace_a_newer_one() -> None:
    neighbours = Neighbours("beta")
    neighbours.ingest(pose(2 * SECOND), NOW_NS)
    neighbours.ingest(pose(1 * SECOND, offset=(50.0, 0.0, 0.0)), NOW_NS + 1)
    assert neighbours.refused == 1
    assert alpha_of(neighbours, NOW_NS).position_ned_m[0] < 12.0
    # A restarted service has a new clock.
    neighbours.ingest(pose(5, offset=(50.0, 0.0, 0.0), source="restarted"), NOW_NS + 2)
    assert alpha_of(neighbours, NOW_NS).position_ned_m[0] > 50.0


def test_own_message_is_ignored_and_a_namesake_is_not() -> None:
    neighbours = Neighbours("beta")
    neighbours.ingest(pose(1, "beta", source=neighbours.source), NOW_NS)
    assert not neighbours.neighbourhood(state_at(NOW_NS), NOW_NS).vehicles
    neighbours.ingest(pose(1, "beta", source="other"), NOW_NS)
    others = neighbours.neighbourhood(state_at(NOW_NS), NOW_NS)
    assert [vehicle.name for vehicle in others.vehicles] == ["beta (other)"]
    assert neighbours.namesakes == {"other"}
    assert others.named("beta") is None


def test_without_own_position_there_are_no_neighbours() -> None:
    neighbours = Neighbours("beta")
    neighbours.ingest(pose(1), NOW_NS)
    others = neighbours.neighbourhood(replace(state_at(NOW_NS), latitude_deg=math.nan), NOW_NS)
    assert others.vehicles == ()
    assert others.problem is not None
    assert "longitude not received" in others.problem


class Needy(Behaviour):
    name = "needy"
    requirements = frozenset({Requirement.NEIGHBOURS})
    neighbour_names = ("alpha",)

    def update(self, dt_s: float, context: BehaviourContext) -> BehaviourOutput:
        raise NotImplementedError


def test_missing_neighbour_is_named_in_the_reply() -> None:
    neighbours = Neighbours("beta")

    def words(now_ns: int) -> str | None:
        state = state_at(now_ns)
        return check_requirements(
            Needy(),
            BehaviourContext(now_ns, state, neighbourhood=neighbours.neighbourhood(state, now_ns)),
            None,
        )

    assert "no poses received" in (words(NOW_NS) or "")
    neighbours.ingest(pose(1, "gamma"), NOW_NS)
    assert "received: gamma" in (words(NOW_NS) or "")
    neighbours.ingest(pose(1), NOW_NS)
    assert words(NOW_NS) is None
    assert "alpha (stale: 2.0 s)" in (words(NOW_NS + 2 * SECOND) or "")
    (alone,) = missing_neighbours(None, (), state_at(NOW_NS), NOW_NS)
    assert alone.startswith("neighbours (")
    assert "not share poses" in alone
    lost = neighbours.neighbourhood(replace(state_at(NOW_NS), global_ns=0), NOW_NS)
    assert "stale" in missing_neighbours(lost, (), state_at(NOW_NS), NOW_NS)[0]
    here = neighbours.neighbourhood(state_at(NOW_NS), NOW_NS)
    assert "than itself" in missing_neighbours(here, ("beta",), state_at(NOW_NS), NOW_NS)[0]
    # Without any other vehicle the own position is asked for when a behaviour needs it.
    nobody = Neighbourhood("beta")
    assert missing_neighbours(nobody, (), state_at(NOW_NS), NOW_NS) == []
    assert "stale" in missing_neighbours(nobody, (), replace(state_at(NOW_NS), global_ns=0), NOW_NS)[0]
