"""Pose messages: round trip and validation."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.bus.vehicle_messages import pose_message
from companion.guidance.formation.pose import (
    FormationNote,
    Plan,
    Pose,
    PoseError,
    Structure,
    pose_from_message,
    pose_of,
)
from companion.vehicle.state import LandedState, VehicleState
from tests.companion.guidance.guidance_harness import known
from vision.attitude import quaternion_from_euler

STRUCTURE = Structure((47.4, 8.5, 490.0), (1.0, 0.0, 0.0), 0.1, (47.39, 8.5, 480.0), 12.25, True)
NOTE = FormationNote(
    "alpha", Plan(3, "beta", "wedge", 5.0), 2, 0.25, (("beta", 1), ("gamma", 2)), 2, 0.5, -0.1, STRUCTURE
)
POSE = Pose("beta", "ab12", 5_000, 0.02, 47.4, 8.5, 491.0, (1.0, -2.0, 0.5), 1.5, 0.2, "follower", True, NOTE)
TAKEN = replace(POSE, in_command=False, mode="return")
NOW_NS = 10**12
STATE = VehicleState(
    heartbeat_ns=NOW_NS,
    attitude_ns=NOW_NS,
    position_ns=NOW_NS,
    global_ns=NOW_NS - 20_000_000,
    armed=True,
    landed=LandedState.IN_AIR,
    position_ned_m=(1.0, 2.0, -5.0),
    velocity_ned_mps=(1.0, 0.0, 0.0),
    attitude=quaternion_from_euler(0.0, 0.0, 0.7),
    angular_velocity_frd_radps=(0.0, 0.0, 0.3),
    latitude_deg=47.4,
    longitude_deg=8.5,
    altitude_amsl_m=493.0,
)


@pytest.mark.parametrize(
    "pose",
    [
        TAKEN,
        replace(POSE, in_command=True, mode="offboard"),
        replace(TAKEN, formation=None),
        replace(POSE, formation=replace(NOTE, wish=None, structure=None)),
    ],
)
def test_pose_message_round_trip(pose: Pose) -> None:
    assert pose_from_message(json.loads(json.dumps(pose_message(pose)))) == pose


def test_pose_of_another_program_has_no_command_or_mode() -> None:
    message = json.loads(json.dumps(pose_message(TAKEN)))
    del message["in_command"], message["mode"]
    assert pose_from_message(message) == replace(TAKEN, in_command=None, mode="unknown")


def test_pose_has_position_and_age() -> None:
    pose = known(pose_of(STATE, NOW_NS, vehicle="beta", source="s"))
    assert (pose.age_s, pose.latitude_deg, pose.altitude_amsl_m) == (0.02, 47.4, 493.0)
    assert pose.heading_rad == pytest.approx(0.7)
    assert pose.turn_rate_radps == pytest.approx(0.3)
    assert pose.airborne
    parked = known(pose_of(replace(STATE, armed=False), NOW_NS, vehicle="b", source="s"))
    assert not parked.airborne


@pytest.mark.parametrize(
    "state",
    [
        replace(STATE, latitude_deg=math.nan),
        replace(STATE, global_ns=NOW_NS - 10**9),
        replace(STATE, position_ns=NOW_NS - 10**9),
        replace(STATE, velocity_ned_mps=None),
    ],
)
def test_no_pose_without_a_global_position(state: VehicleState) -> None:
    assert pose_of(state, NOW_NS, vehicle="beta", source="s") is None


def test_turn_rate_from_body_rates_and_roll() -> None:
    banked = replace(
        STATE,
        attitude=quaternion_from_euler(math.pi / 6, 0.0, 0.7),
        angular_velocity_frd_radps=(0.0, 0.5 * math.sin(math.pi / 6), 0.5 * math.cos(math.pi / 6)),
    )
    turning = known(pose_of(banked, NOW_NS, vehicle="b", source="s"))
    assert turning.turn_rate_radps == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        (("latitude_deg",), 91.0),
        (("latitude_deg",), math.nan),
        (("velocity_ned_mps",), [1.0, 2.0]),
        (("velocity_ned_mps",), [1.0, 2.0, "x"]),
        (("published_ns",), True),
        (("published_ns",), 2**70),
        (("role",), "king"),
        (("vehicle",), ""),
        (("in_command",), 1),
        (("mode",), 4),
        (("formation", "plan", "shape"), "star"),
        (("formation", "plan", "spacing_m"), 0.0),
        (("formation", "slots"), {"beta": 0}),
        (("formation", "slots"), [1]),
        (("formation", "structure", "origin"), [0.0, 0.0, 1e9]),
    ],
)
def test_invalid_field_is_rejected_by_name(path: Sequence[str], value: object) -> None:
    message = json.loads(json.dumps(pose_message(POSE)))
    inner = message
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    with pytest.raises(PoseError, match=rf"^pose\.{'.'.join(path)}.*, got"):
        pose_from_message(message)


@pytest.mark.parametrize("key", sorted(set(pose_message(POSE)) - {"in_command", "mode"}))
def test_missing_field_is_rejected(key: str) -> None:
    message: dict[str, Any] = {**pose_message(POSE)}
    del message[key]
    with pytest.raises(PoseError, match=f"{key}: Field required"):
        pose_from_message(message)


json_value = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=6,
)


@given(st.sampled_from(sorted(pose_message(POSE))), json_value)
def test_any_field_value_is_a_pose_or_rejected(key: str, value: object) -> None:
    message: dict[str, Any] = {**pose_message(POSE)}
    message[key] = value
    try:
        pose = pose_from_message(message)
    except PoseError:
        return
    assert math.isfinite(sum(pose.velocity_ned_mps) + pose.latitude_deg + pose.heading_rad)
