"""The manual modes: speeds, distances, attitudes."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from mavlink_sim.flight.manual_flight import (
    HeightByStick,
    Position,
    expo,
    super_expo,
    throttle_curve,
    with_dead_zone,
)
from mavlink_sim.flight.transmitter import Sticks
from mavlink_sim.physics.airframe import GRAVITY_MPS2, MAX_THRUST_MPS2, Multirotor
from mavlink_sim.px4.modes import Mode
from mavlink_sim.px4.parameters import Parameters
from mavlink_sim.vehicles.vehicle import Vehicle
from tests.mavlink_sim.conftest import CALIBRATION

REMOTE_CONTROL = {**CALIBRATION, "COM_RC_IN_MODE": 0}


class Piloted:
    """A vehicle without links in still air, hovering 20 m up in a mode, its pilot's sticks centred."""

    def __init__(self, mode: Mode, *, hovering: bool = True, **values: float) -> None:
        self.events: list[str] = []
        self.vehicle = Vehicle(
            parameters={**REMOTE_CONTROL, **values},
            gusts_mps=0.0,
            noise=False,
            ready_after_s=0.1,
            on_event=self.events.append,
        )
        self.autopilot = self.vehicle.autopilot
        self.transmitter = self.vehicle.transmitter
        self.transmitter.on = True
        self.vehicle.step(0.2)
        if hovering:
            assert self.autopilot.arm() == 0
            self.autopilot.takeoff(2.5)
            self.until(lambda: self.autopilot.mode is Mode.HOLD)
            x, y, _ = self.airframe.position
            self.airframe.position = (x, y, -20.0)
            self.airframe.velocity = (0.0, 0.0, 0.0)
        assert self.autopilot.set_mode(mode) == 0

    @property
    def airframe(self) -> Multirotor:
        return self.vehicle.airframe

    @property
    def height_m(self) -> float:
        return -self.airframe.position[2]

    @property
    def speed_mps(self) -> float:
        vx, vy, _ = self.airframe.velocity
        return math.hypot(vx, vy)

    @property
    def asked_mps(self) -> float:
        """The speed asked of the controller; this airframe's large drag keeps it a good deal slower."""
        return math.hypot(*self.autopilot.controller.velocity[:2])

    def fly(self, seconds: float, **sticks: float) -> None:
        self.transmitter.sticks = Sticks(**sticks)
        self.vehicle.step(seconds)

    def until(self, condition: Callable[[], bool], limit_s: float = 20.0, **sticks: float) -> None:
        if sticks:
            self.transmitter.sticks = Sticks(**sticks)
        for _ in range(round(limit_s / 0.02)):
            self.vehicle.step(0.02)
            if condition():
                return
        raise AssertionError(
            f"not within {limit_s} s: {self.autopilot.mode} {self.airframe.position} {self.events}"
        )


@given(st.floats(-1.0, 1.0), st.floats(0.0, 1.0), st.floats(0.0, 0.9))
def test_stick_shapes_are_odd_bounded_and_reach_the_ends(stick: float, share: float, zone: float) -> None:
    shapes: tuple[Callable[[float], float], ...] = (
        lambda value: expo(value, share),
        lambda value: with_dead_zone(value, zone),
        lambda value: super_expo(value, share, zone),
    )
    for shape in shapes:
        assert shape(-stick) == pytest.approx(-shape(stick))
        assert abs(shape(stick)) <= 1.0 + 1e-9
        assert shape(1.0) == pytest.approx(1.0)
        assert shape(0.0) == 0.0


def test_the_throttle_curve_hovers_in_the_middle() -> None:
    hover = GRAVITY_MPS2 / MAX_THRUST_MPS2
    for curve, middle in ((0, hover), (1, 0.54), (2, 0.6)):
        parameters = Parameters({"MPC_THR_CURVE": curve, "MPC_THR_HOVER": 0.6})
        assert throttle_curve(0.0, parameters) == pytest.approx(middle)
        assert throttle_curve(-1.0, parameters) == pytest.approx(0.08)
        assert throttle_curve(1.0, parameters) == pytest.approx(1.0)


def test_position_full_stick_reaches_manual_speed_then_stops() -> None:
    pilot = Piloted(Mode.POSCTL)
    pilot.fly(8.0, pitch=1.0)
    assert pilot.asked_mps == pytest.approx(9.9, abs=0.2)
    assert pilot.speed_mps > 7.5
    north, east, _ = pilot.airframe.position
    assert north > 40.0
    assert abs(east) < 0.5
    pilot.fly(12.0)
    held = pilot.airframe.position
    assert pilot.speed_mps < 0.3
    pilot.fly(5.0)
    assert math.dist(held[:2], pilot.airframe.position[:2]) < 0.6


def test_position_half_stick_is_slower_by_the_stick_curve() -> None:
    pilot = Piloted(Mode.POSCTL)
    share = expo(with_dead_zone(0.6, 0.1), 0.6)
    pilot.fly(8.0, roll=0.6)
    assert pilot.asked_mps == pytest.approx(10.0 * share, abs=0.2)
    assert pilot.airframe.velocity[1] > 0.0


def test_position_with_mode_zero_follows_velocities() -> None:
    pilot = Piloted(Mode.POSCTL, MPC_POS_MODE=0, MPC_VEL_MANUAL=4)
    pilot.fly(4.0, pitch=1.0)
    assert pilot.asked_mps == pytest.approx(4.0, abs=0.01)
    assert pilot.speed_mps == pytest.approx(3.5, abs=0.6)
    pilot.fly(4.0)
    assert pilot.speed_mps < 0.2


def test_position_sticks_are_against_the_heading() -> None:
    pilot = Piloted(Mode.POSCTL)
    pilot.fly(1.0, yaw=0.8)
    pilot.fly(2.0)
    yaw = pilot.airframe.yaw_rad
    assert abs(yaw) > 0.5
    pilot.fly(4.0, pitch=0.7)
    vx, vy, _ = pilot.airframe.velocity
    assert math.remainder(math.atan2(vy, vx) - yaw, math.tau) == pytest.approx(0.0, abs=0.1)


def test_full_yaw_stick_turns_at_mpc_man_y_max_then_holds() -> None:
    pilot = Piloted(Mode.POSCTL, MPC_MAN_Y_MAX=60)
    pilot.fly(1.5, yaw=1.0)
    assert math.degrees(pilot.airframe.rates[2]) == pytest.approx(60.0, abs=3.0)
    pilot.fly(2.0)
    held = pilot.airframe.yaw_rad
    pilot.fly(3.0)
    assert pilot.airframe.yaw_rad == pytest.approx(held, abs=0.02)


def test_position_slow_is_slow() -> None:
    pilot = Piloted(Mode.POSITION_SLOW)
    pilot.fly(6.0, pitch=1.0, throttle=1.0)
    assert pilot.asked_mps == pytest.approx(3.0, abs=0.1)
    assert -pilot.airframe.velocity[2] == pytest.approx(1.0, abs=0.2)


def test_collision_prevention_limits_the_sticks() -> None:
    pilot = Piloted(Mode.HOLD)
    pilot.autopilot.stick_guard = lambda acceleration, velocity: (0.0, acceleration[1])
    pilot.autopilot.set_mode(Mode.POSCTL)
    pilot.fly(3.0, pitch=1.0)
    assert pilot.speed_mps < 0.2
    pilot.fly(3.0, roll=1.0)
    assert pilot.speed_mps > 2.0


def test_throttle_climb_within_limits_and_height_hold() -> None:
    for mode in (Mode.POSCTL, Mode.ALTCTL):
        pilot = Piloted(mode)
        pilot.fly(3.0, throttle=1.0)
        assert -pilot.airframe.velocity[2] == pytest.approx(2.8, abs=0.4)
        pilot.fly(5.0)
        held = pilot.height_m
        pilot.fly(4.0)
        assert pilot.height_m == pytest.approx(held, abs=0.15)
        pilot.fly(3.0, throttle=-1.0)
        assert pilot.airframe.velocity[2] == pytest.approx(1.5, abs=0.2)


@settings(deadline=None, max_examples=40)
@given(st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=20))
def test_the_climb_setpoint_never_breaks_its_limits(throttles: list[float]) -> None:
    airframe = Multirotor()
    airframe.position, airframe.on_ground = (0.0, 0.0, -50.0), False
    height = HeightByStick(airframe, Parameters())
    before = 0.0
    for throttle in throttles:
        for _ in range(10):
            _, velocity, acceleration = height.update(throttle, 0.02)
            assert -3.3 <= velocity <= 1.8  # the jerk is limited too, so it may overshoot
            assert -4.0 - 1e-6 <= acceleration <= 4.0 + 1e-6
            assert abs(velocity - before) <= 4.0 * 0.02 + 1e-6
            before = velocity


@settings(deadline=None, max_examples=40)
@given(st.lists(st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)), min_size=1, max_size=15))
def test_the_position_setpoint_never_outruns_the_manual_speed(pushes: list[tuple[float, float]]) -> None:
    airframe = Multirotor()
    airframe.position, airframe.on_ground = (0.0, 0.0, -50.0), False
    sticks = [Sticks()]
    task = Position(airframe, Parameters(), lambda: sticks[0])
    for pitch, roll in pushes:
        sticks[0] = Sticks(pitch=pitch, roll=roll)
        for _ in range(15):
            setpoint = task.update(0.02)
            assert math.hypot(*setpoint.velocity[:2]) <= 11.0


def test_altitude_tilts_drifts_on_and_holds_its_height() -> None:
    pilot = Piloted(Mode.ALTCTL)
    height_m = pilot.height_m
    pilot.fly(1.5, roll=1.0)
    assert math.degrees(pilot.airframe.roll_rad) == pytest.approx(35.0, abs=2.0)
    pilot.fly(1.0)
    assert abs(math.degrees(pilot.airframe.roll_rad)) < 2.0
    assert pilot.speed_mps > 1.0  # only drag brakes
    assert pilot.height_m == pytest.approx(height_m, abs=0.7)


@pytest.mark.parametrize("mode", [Mode.STABILIZED, Mode.MANUAL])
def test_stabilized_sticks_are_tilt_and_thrust(mode: Mode) -> None:
    pilot = Piloted(mode)
    pilot.fly(2.0)
    assert abs(pilot.airframe.velocity[2]) < 0.3  # the middle of the throttle hovers
    pilot.fly(1.0, pitch=1.0)
    assert math.degrees(pilot.airframe.pitch_rad) == pytest.approx(-35.0, abs=2.0)
    pilot.fly(1.0)
    assert abs(math.degrees(pilot.airframe.pitch_rad)) < 1.0
    pilot.fly(1.0, throttle=0.6)
    assert pilot.airframe.velocity[2] < -1.0


def test_acro_turns_at_the_sticks_rates_and_stays_tilted() -> None:
    pilot = Piloted(Mode.ACRO)
    pilot.fly(0.5, roll=0.5)
    assert math.degrees(pilot.airframe.rates[0]) == pytest.approx(50.0, abs=5.0)
    pilot.fly(0.4)
    tilted = pilot.airframe.roll_rad
    assert math.degrees(tilted) > 15.0
    pilot.fly(0.5)
    assert pilot.airframe.roll_rad == pytest.approx(tilted, abs=0.05)


@pytest.mark.parametrize(
    ("mode", "climb", "sink"),
    [(Mode.POSCTL, 1.0, -1.0), (Mode.ALTCTL, 1.0, -1.0), (Mode.STABILIZED, 0.3, -0.15)],
)
def test_each_manual_mode_takes_off_and_lands_by_sticks(mode: Mode, climb: float, sink: float) -> None:
    pilot = Piloted(mode, hovering=False)
    pilot.fly(0.2, throttle=-1.0)
    assert pilot.autopilot.arm() == 0
    pilot.fly(2.0, throttle=-1.0)
    assert pilot.autopilot.landed
    pilot.until(lambda: pilot.height_m > 2.0, 12.0, throttle=climb)
    assert not pilot.autopilot.landed
    pilot.until(lambda: pilot.airframe.on_ground, 20.0, throttle=sink)
    pilot.until(lambda: not pilot.autopilot.armed, 8.0, throttle=-1.0)
    assert "disarmed (after landing)" in pilot.events


def test_a_centred_throttle_does_not_lift_an_armed_vehicle() -> None:
    pilot = Piloted(Mode.POSCTL, hovering=False)
    pilot.fly(0.2)
    assert pilot.autopilot.arm() == 0
    pilot.fly(4.0, throttle=0.2)
    assert pilot.autopilot.landed
    assert pilot.height_m < 0.05
