import math
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from companion.geometry.fence import Fence
from companion.guidance.limits.envelope import Envelope, Limits, is_of_height
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import Vector3, VehicleState
from tests.companion.guidance.guidance_harness import known
from tests.companion.guidance.kinematic_vehicle import KinematicVehicle
from vision.attitude import quaternion_from_euler, wrap_angle

LIMITS = Limits()
NOW = 10**12


def vehicle(
    position: Vector3 = (0.0, 0.0, -10.0),
    velocity: Vector3 = (0.0, 0.0, 0.0),
    yaw: float = 0.0,
    home: Vector3 = (0.0, 0.0, 0.0),
) -> VehicleState:
    return VehicleState(
        position_ned_m=position,
        velocity_ned_mps=velocity,
        attitude=quaternion_from_euler(0, 0, yaw),
        home_position_ned_m=home,
    )


def settled(
    envelope: Envelope, setpoint: Setpoint, state: VehicleState, seconds: float = 20.0
) -> tuple[Setpoint, tuple[str, ...]]:
    """The sent velocity once the acceleration limit has settled."""
    for _ in range(round(seconds / 0.1)):
        sent, reasons = envelope.apply(setpoint, state, NOW, 0.1)
    return sent, reasons


speeds = st.floats(-20, 20)
velocities = st.tuples(speeds, speeds, speeds)
positions = st.tuples(st.floats(-400, 400), st.floats(-400, 400), st.floats(-100, 20))
states = st.builds(vehicle, positions, velocities, st.floats(-3, 3), st.tuples(*[st.floats(-20, 20)] * 3))
yaw_arguments = st.one_of(
    st.just({}),
    st.builds(lambda v: {"yaw_rad": v}, st.floats(-3, 3)),
    st.builds(lambda v: {"yaw_rate_radps": v}, st.floats(-6, 6)),
)
velocity_setpoints = st.builds(lambda v, yaw: Setpoint.velocity(v, NOW, **yaw), velocities, yaw_arguments)
setpoints = velocity_setpoints | st.builds(
    lambda p, yaw: Setpoint.position(p, NOW, yaw_rad=yaw), positions, st.floats(-3, 3)
)
durations = st.floats(0, 0.5)


@given(st.lists(st.tuples(velocity_setpoints, states, durations), min_size=1, max_size=6))
def test_velocity_never_exceeds_input_or_limits(
    steps: list[tuple[Setpoint, VehicleState, float]],
) -> None:
    envelope = Envelope(LIMITS)
    for asked, state, dt_s in steps:
        sent, _ = envelope.apply(asked, state, NOW, dt_s)
        assert sent.velocity_ned_mps is not None
        assert asked.velocity_ned_mps is not None
        north, east, down = sent.velocity_ned_mps
        asked_north, asked_east, asked_down = asked.velocity_ned_mps
        assert math.hypot(north, east) <= math.hypot(asked_north, asked_east) + 1e-6
        assert abs(down) <= abs(asked_down) + 1e-9
        assert down * asked_down >= 0
        assert math.hypot(north, east) <= LIMITS.max_horizontal_speed_mps + 1e-6
        assert -LIMITS.max_climb_mps <= down <= LIMITS.max_descend_mps
        if sent.yaw_rate_radps is not None:
            assert abs(sent.yaw_rate_radps) <= LIMITS.max_yaw_rate_radps
        assert sent.deadline_ns == asked.deadline_ns


inside_states = st.builds(
    vehicle,
    st.tuples(st.floats(-140, 140), st.floats(-140, 140), st.floats(-49, -1)),
    velocities,
    st.floats(-3, 3),
)


# Outside the fences the limited position moves back step by step.
@given(setpoints, inside_states, durations)
def test_limited_setpoint_passes_again_unchanged(asked: Setpoint, state: VehicleState, dt_s: float) -> None:
    envelope = Envelope(LIMITS)
    once, _ = envelope.apply(asked, state, NOW, dt_s)
    again, _ = envelope.apply(once, state, NOW, dt_s)
    for name in ("position_ned_m", "velocity_ned_mps"):
        first, second = getattr(once, name), getattr(again, name)
        assert (first is None) == (second is None)
        if first is not None:
            assert second == pytest.approx(first, abs=1e-6)
    if once.yaw_rad is not None:
        assert wrap_angle(known(again.yaw_rad) - once.yaw_rad) == pytest.approx(0.0, abs=1e-6)
    assert again.yaw_rate_radps == once.yaw_rate_radps


@given(
    st.tuples(st.floats(-3, 3), st.floats(-3, 3), st.floats(-1.9, 0.9)),
    st.tuples(st.floats(-100, 100), st.floats(-100, 100), st.floats(-40, -5)),
)
def test_setpoint_inside_the_limits_is_the_same_object(velocity: Vector3, position: Vector3) -> None:
    envelope = Envelope(LIMITS)
    asked = Setpoint.velocity(velocity, NOW, yaw_rate_radps=0.5)
    sent, reasons = envelope.apply(asked, vehicle(position, velocity), NOW, 0.02)
    assert sent is asked
    assert reasons == ()


@given(positions, states)
def test_position_stays_inside_the_altitude_band(position: Vector3, state: VehicleState) -> None:
    sent, _ = Envelope(LIMITS).apply(Setpoint.position(position, NOW), state, NOW, 0.02)
    north, east, down = known(sent.position_ned_m)
    here = known(state.position_ned_m)
    assert math.dist((north, east), here[:2]) <= LIMITS.max_horizontal_speed_mps + 1e-6
    assert -LIMITS.max_climb_mps - 1e-6 <= down - here[2] <= LIMITS.max_descend_mps + 1e-6


def within(half_m: float) -> Fence:
    return Fence(((-half_m, -half_m), (half_m, -half_m), (half_m, half_m), (-half_m, half_m)))


SQUARE = within(15.0)


@pytest.mark.parametrize(
    ("limits", "here", "asked", "sent", "reasons"),
    [
        (LIMITS, (199.0, 0.0, -49.5), (300.0, 0.0, -80.0), (200.0, 0.0, -50.0), 2),
        (Limits(fence=SQUARE), (12.0, 0.0, -5.0), (30.0, 0.0, -5.0), (14.5, 0.0, -5.0), 1),
    ],
    ids=["circle", "polygon"],
)
def test_position_outside_the_fence_is_moved_inside(
    limits: Limits, here: Vector3, asked: Vector3, sent: Vector3, reasons: int
) -> None:
    moved, why = Envelope(limits).apply(Setpoint.position(asked, NOW), vehicle(here), NOW, 0.02)
    assert moved.position_ned_m == pytest.approx(sent)
    assert len(why) == reasons
    assert any("fence" in reason or "distance" in reason for reason in why)


def test_velocity_grows_with_limited_acceleration() -> None:
    envelope, state, previous = Envelope(LIMITS), vehicle(), 0.0
    for _ in range(40):
        sent, _ = envelope.apply(Setpoint.velocity((4.0, 0.0, 0.0), NOW), state, NOW, 0.05)
        speed = known(sent.velocity_ned_mps)[0]
        assert speed - previous <= LIMITS.max_acceleration_mps2 * 0.05 + 1e-9
        previous = speed
    assert previous == pytest.approx(4.0)
    assert envelope.apply(Setpoint.velocity((4.0, 0.0, 0.0), NOW), state, NOW, 0.05).reasons == ()


def test_braking_is_never_delayed() -> None:
    envelope = Envelope(LIMITS)
    settled(envelope, Setpoint.velocity((5.0, 0.0, 1.0), NOW), vehicle())
    sent, _ = envelope.apply(Setpoint.brake(NOW), vehicle(velocity=(5.0, 0.0, 1.0)), NOW, 0.02)
    assert sent.velocity_ned_mps == (0.0, 0.0, 0.0)


def test_after_reset_velocity_starts_from_the_measured_one() -> None:
    envelope = Envelope(LIMITS)
    sent, _ = envelope.apply(
        Setpoint.velocity((4.0, 0.0, 0.0), NOW), vehicle(velocity=(3.0, 0.0, 0.0)), NOW, 0.1
    )
    assert known(sent.velocity_ned_mps)[0] == pytest.approx(3.0 + LIMITS.max_acceleration_mps2 * 0.1)


@pytest.mark.parametrize(
    ("asked", "state", "component", "sign"),
    [
        ((0.0, 0.0, 1.0), vehicle((0, 0, -1.0)), 2, 1),
        ((0.0, 0.0, 1.0), vehicle((0, 0, -0.4)), 2, 1),
        ((0.0, 0.0, -2.0), vehicle((0, 0, -50.0)), 2, -1),
        ((3.0, 0.0, 0.0), vehicle((200.0, 0, -10)), 0, 1),
        ((3.0, 0.0, 0.0), vehicle((250.0, 0, -10)), 0, 1),
    ],
    ids=["floor", "below the floor", "ceiling", "fence", "beyond the fence"],
)
def test_no_outward_velocity_at_a_fence(
    asked: Vector3, state: VehicleState, component: int, sign: int
) -> None:
    sent, reasons = settled(Envelope(LIMITS), Setpoint.velocity(asked, NOW), state)
    assert known(sent.velocity_ned_mps)[component] * sign <= 1e-9
    assert reasons


def test_landing_ignores_the_minimum_altitude_only() -> None:
    state, down = vehicle((0.0, 0.0, -0.6)), Setpoint.velocity((0.0, 0.0, 3.0), NOW)
    envelope = Envelope(LIMITS)
    for _ in range(100):
        sent, _ = envelope.apply(down, state, NOW, 0.05, landing=True)
    assert sent.velocity_ned_mps == pytest.approx((0.0, 0.0, LIMITS.max_descend_mps))
    asked = Setpoint.position((0.0, 0.0, 0.0), NOW)
    assert envelope.apply(asked, state, NOW, 0.05, landing=True).sent is asked
    # Only while `landing` is set.
    velocity = known(envelope.apply(down, state, NOW, 0.05).sent.velocity_ned_mps)
    assert velocity[2] <= 0.0
    position = known(envelope.apply(asked, state, NOW, 0.05).sent.position_ned_m)
    assert position[2] == -LIMITS.min_altitude_m


def test_velocity_along_or_away_from_the_fence_is_kept() -> None:
    state = vehicle((220.0, 0.0, -10.0))
    back, _ = settled(Envelope(LIMITS), Setpoint.velocity((-3.0, 0.0, 0.0), NOW), state)
    assert back.velocity_ned_mps == pytest.approx((-3.0, 0.0, 0.0))
    along, _ = settled(Envelope(LIMITS), Setpoint.velocity((1.0, 3.0, 0.0), NOW), state)
    assert along.velocity_ned_mps == pytest.approx((0.0, 3.0, 0.0), abs=1e-6)


@pytest.mark.parametrize(
    ("asked", "height_m", "of_height"),
    [
        ((0.0, 0.0, -2.0), 49.9, True),  # a climb, below the maximum
        ((0.0, 0.0, 1.0), 1.1, True),
        ((0.0, 0.0, -1.0), 30.0, False),
        ((9.0, 0.0, -4.0), 30.0, False),  # too fast: its climb is cut too
        ((9.0, 0.0, 0.0), 49.9, False),
    ],
)
def test_limits_of_height_differ_from_others(asked: Vector3, height_m: float, of_height: bool) -> None:
    state = vehicle((0.0, 0.0, -height_m))
    limited, reasons = settled(Envelope(LIMITS), Setpoint.velocity(asked, NOW), state)
    assert any(map(is_of_height, reasons)) is of_height
    assert (known(limited.velocity_ned_mps) != asked) is (asked != (0.0, 0.0, -1.0))


def test_fence_is_centred_on_home() -> None:
    state = vehicle((250.0, 0.0, -10.0), home=(200.0, 0.0, 5.0))
    sent, _ = settled(Envelope(LIMITS), Setpoint.velocity((3.0, 0.0, 0.0), NOW), state)
    assert known(sent.velocity_ned_mps)[0] == pytest.approx(3.0)


def test_limits_of_a_position_are_from_home() -> None:
    state = vehicle((250.0, 0.0, -44.0), home=(200.0, 0.0, 5.0))
    asked = Setpoint.position((252.0, 0.0, -46.0), NOW)
    sent, reasons = Envelope(LIMITS).apply(asked, state, NOW, 0.02)
    assert sent.position_ned_m == pytest.approx((252.0, 0.0, 5.0 - LIMITS.max_altitude_m))
    assert [reason.split()[0] for reason in reasons] == ["altitude"]


@pytest.mark.parametrize(
    ("asked", "state", "limit"),
    [
        (Setpoint.position((50.0, 0.0, -10.0), NOW), vehicle(), "horizontal speed"),
        (Setpoint.position((0.0, 0.0, -20.0), NOW), vehicle(), "climb"),
        (Setpoint.position((0.0, 0.0, -5.0), NOW), vehicle(), "descent"),
        (Setpoint.velocity((3.0, 0.0, 0.0), NOW), vehicle((200.0, 0.0, -10.0), (3.0, 0.0, 0.0)), "distance"),
    ],
    ids=["far", "above", "below", "away from home"],
)
def test_limit_that_acts_is_named(asked: Setpoint, state: VehicleState, limit: str) -> None:
    (reason,) = Envelope(LIMITS).apply(asked, state, NOW, 0.02).reasons
    assert reason.startswith(limit)


def fast(acceleration_mps2: float) -> Limits:
    return Limits(max_horizontal_speed_mps=20.0, max_acceleration_mps2=acceleration_mps2, fence=within(50.0))


@pytest.mark.parametrize(
    ("limits", "start_m", "asked", "lag_s", "end_m", "over_m"),
    [
        (LIMITS, 150.0, (5.0, 0.0, 0.0), 0.3, (199.0, 0.0), 200.3),
        (Limits(fence=SQUARE), 0.0, (4.0, 2.0, 0.0), 0.3, (14.0, 14.0), 15.0),
        *(
            (fast(acceleration_mps2), -40.0, (20.0, 0.0, 0.0), lag_s, (40.0, 0.0), 50.0)
            for acceleration_mps2 in (2.0, 5.0, 10.0, 20.0)
            for lag_s in (0.2, 0.4)
        ),
    ],
)
def test_vehicle_flown_at_a_fence_stops_inside(
    limits: Limits, start_m: float, asked: Vector3, lag_s: float, end_m: tuple[float, float], over_m: float
) -> None:
    flown, envelope = KinematicVehicle(position=[start_m, 0.0, -5.0], lag_s=lag_s), Envelope(limits)
    reasons: set[str] = set()
    for _ in range(3000):
        setpoint = Setpoint.velocity(asked, flown.now_ns)
        sent, why = envelope.apply(setpoint, flown.state, flown.now_ns, 0.02)
        reasons.update(why)
        flown.fly(sent, 0.02)
        assert max(flown.position[:2]) < over_m
    assert flown.position[0] > end_m[0]
    assert flown.position[1] >= end_m[1]
    assert any("fence" in reason or "distance" in reason for reason in reasons)


def test_yaw_setpoint_is_rate_limited() -> None:
    envelope = Envelope(LIMITS)
    headings: list[float] = []
    for _ in range(50):
        asked = Setpoint.velocity((0.0, 0.0, 0.0), NOW, yaw_rad=-3.0)
        yaw_rad = known(envelope.apply(asked, vehicle(yaw=3.0), NOW, 0.02).sent.yaw_rad)
        headings.append(yaw_rad)
    steps = [wrap_angle(b - a) for a, b in zip([3.0, *headings], headings, strict=False)]
    assert all(0 <= step <= 0.02 + 1e-9 for step in steps)
    assert headings[-1] == pytest.approx(-3.0)


def test_position_setpoint_without_position_is_a_brake() -> None:
    sent, reasons = Envelope(LIMITS).apply(Setpoint.position((5, 0, -5), NOW), VehicleState(), NOW, 0.02)
    assert sent.velocity_ned_mps == (0.0, 0.0, 0.0)
    assert reasons == ("position unknown",)


def test_steep_velocity_keeps_its_direction() -> None:
    asked = Setpoint.velocity((8.0, 0.0, -8.0), 1)
    sent, why = Envelope(Limits(max_acceleration_mps2=20.0)).apply(asked, KinematicVehicle().state, 1, 0.2)
    north, _, down = known(sent.velocity_ned_mps)
    assert down == pytest.approx(-2.0)
    assert north == pytest.approx(2.0)
    assert any("climb" in reason for reason in why)


def test_last_home_is_kept_and_fence_needs_a_home() -> None:
    vehicle = KinematicVehicle(position=[149.0, 0.0, -5.0])
    homeless = replace(vehicle.state, home_position_ned_m=None)
    at_home = replace(vehicle.state, home_position_ned_m=(100.0, 0.0, 0.0))
    limits = Limits(fence=within(50.0))
    out = Setpoint.velocity((5.0, 0.0, 0.0), 1)
    envelope = Envelope(limits)
    sent, why = envelope.apply(out, homeless, 1, 0.02)
    assert sent.velocity_ned_mps == (0.0, 0.0, 0.0)
    assert "home position" in why[0]
    first, _ = envelope.apply(out, at_home, 1, 0.02)
    envelope.reset()
    again, _ = envelope.apply(out, homeless, 1, 0.02)
    assert again.velocity_ned_mps == pytest.approx(first.velocity_ned_mps)


def feed_forward(
    acceleration: Vector3, velocity: Vector3 = (0.0, 0.0, 0.0), position: Vector3 = (0.0, 0.0, -5.0)
) -> tuple[Vector3 | None, tuple[str, ...]]:
    """The limited feed-forward of a vehicle that is commanded its current velocity."""
    vehicle = KinematicVehicle(position=list(position), velocity=list(velocity))
    limits = Limits(fence=within(20.0))
    setpoint = Setpoint.velocity(velocity, 1, acceleration_ned_mps2=acceleration)
    sent, why = Envelope(limits).apply(setpoint, vehicle.state, 1, 0.02)
    return sent.acceleration_ned_mps2, why


HERE = (0.0, 0.0, -5.0)
# Acceleration, velocity, position, and what is left of the acceleration.
FEED_FORWARD: dict[str, tuple[Vector3, Vector3, Vector3, Vector3 | None]] = {
    "inside the limits": ((0.0, 2.0, 0.0), (4.0, 0.0, 0.0), HERE, (0.0, 2.0, 0.0)),
    "more than the greatest": ((0.0, 30.0, 0.0), (4.0, 0.0, 0.0), HERE, (0.0, 3.0, 0.0)),
    "slow": ((0.0, 3.0, 0.0), (0.5, 0.0, 0.0), HERE, (0.0, 0.5, 0.0)),
    "stopped": ((0.0, 3.0, 0.0), (0.0, 0.0, 0.0), HERE, None),
    "away from a fence": ((-2.0, 0.0, 0.0), (0.0, 4.0, 0.0), (19.0, 0.0, -5.0), (-2.0, 0.0, 0.0)),
    "to a fence": ((2.0, 0.0, 0.0), (0.0, 4.0, 0.0), (19.4, 0.0, -5.0), None),
    "over the fence": ((3.0, 0.0, 0.0), (0.0, 1.0, 0.0), (19.9, 0.0, -5.0), None),
    "over the greatest speed": ((3.0, 0.0, 0.0), (5.0, 0.0, 0.0), HERE, (0.0, 0.0, 0.0)),
    "above the greatest altitude": ((0.0, 0.0, -3.0), (0.0, 0.0, 0.0), (0.0, 0.0, -49.9), None),
    "below the lowest altitude": ((0.0, 0.0, 3.0), (0.0, 0.0, 0.0), (0.0, 0.0, -1.1), None),
    "faster down than allowed": ((0.0, 0.0, 3.0), (0.0, 0.0, 0.9), (0.0, 0.0, -20.0), None),
}


@pytest.mark.parametrize("case", FEED_FORWARD)
def test_feed_forward_is_limited(case: str) -> None:
    acceleration, velocity, position, expected = FEED_FORWARD[case]
    left, why = feed_forward(acceleration, velocity, position)
    assert left == (expected if expected is None else pytest.approx(expected))
    assert bool(why) is (case in ("to a fence", "over the fence"))


KNOWN = KinematicVehicle(position=[0.0, 0.0, -5.0]).state


@pytest.mark.parametrize(
    "state", [replace(KNOWN, velocity_ned_mps=None), replace(KNOWN, position_ned_m=None)]
)
def test_feed_forward_is_dropped_without_known_motion(state: VehicleState) -> None:
    setpoint = Setpoint.velocity((1.0, 0.0, 0.0), 1, acceleration_ned_mps2=(1.0, 0.0, 0.0))
    sent, why = Envelope().apply(setpoint, state, 1, 0.2)
    assert sent.acceleration_ned_mps2 is None
    assert any("unknown" in reason for reason in why)
