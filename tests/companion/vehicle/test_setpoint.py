from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle.setpoint import DEFAULT_LIFETIME_S, Setpoint

finite = st.floats(-1e6, 1e6)
vectors = st.tuples(finite, finite, finite)


# POSITION_TARGET_TYPEMASK, each axis' bit by its name in the specification
_IGNORE = {
    "position": mavlink.POSITION_TARGET_TYPEMASK_X_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_Y_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_Z_IGNORE,
    "velocity": mavlink.POSITION_TARGET_TYPEMASK_VX_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_VY_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_VZ_IGNORE,
    "acceleration": mavlink.POSITION_TARGET_TYPEMASK_AX_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_AY_IGNORE
    | mavlink.POSITION_TARGET_TYPEMASK_AZ_IGNORE,
    "yaw": mavlink.POSITION_TARGET_TYPEMASK_YAW_IGNORE,
    "yaw rate": mavlink.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE,
}


@given(
    vector=vectors,
    is_position=st.booleans(),
    turn=st.sampled_from([None, "yaw", "rate"]),
    angle=finite,
    forward=st.none() | vectors,
)
def test_type_mask_ignores_exactly_the_unset_fields(
    vector: tuple[float, float, float],
    is_position: bool,
    turn: str | None,
    angle: float,
    forward: tuple[float, float, float] | None,
) -> None:
    forward = None if is_position else forward
    setpoint = Setpoint(
        0,
        position_ned_m=vector if is_position else None,
        velocity_ned_mps=None if is_position else vector,
        yaw_rad=angle if turn == "yaw" else None,
        yaw_rate_radps=angle if turn == "rate" else None,
        acceleration_ned_mps2=forward,
    )
    mask = setpoint.type_mask
    assert bool(mask & _IGNORE["position"]) is not is_position
    assert bool(mask & _IGNORE["velocity"]) is is_position
    assert mask & _IGNORE["acceleration"] == (_IGNORE["acceleration"] if forward is None else 0)
    assert bool(mask & _IGNORE["yaw"]) is (turn != "yaw")
    assert bool(mask & _IGNORE["yaw rate"]) is (turn != "rate")
    assert not mask & mavlink.POSITION_TARGET_TYPEMASK_FORCE_SET
    assert mask < 1 << 12


@given(now_ns=st.integers(0, 2**62), lifetime_s=st.floats(0.001, 1000.0), vector=vectors)
def test_setpoint_expires_after_its_lifetime(
    now_ns: int, lifetime_s: float, vector: tuple[float, float, float]
) -> None:
    for make in (Setpoint.velocity, Setpoint.position):
        setpoint = make(vector, now_ns, lifetime_s=lifetime_s)
        assert not setpoint.expired(now_ns)
        assert not setpoint.expired(setpoint.deadline_ns)
        assert setpoint.expired(setpoint.deadline_ns + 1)
        assert setpoint.deadline_ns - now_ns == round(lifetime_s * 1e9)


def test_brake_has_zero_velocity_and_yaw_rate() -> None:
    brake = Setpoint.brake(1000)
    assert brake.velocity_ned_mps == (0.0, 0.0, 0.0)
    assert brake.yaw_rate_radps == 0.0
    assert brake.deadline_ns == 1000 + round(DEFAULT_LIFETIME_S * 1e9)
