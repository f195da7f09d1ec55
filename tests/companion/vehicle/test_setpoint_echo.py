"""The setpoint that the autopilot reports to follow, compared with those that were sent."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle import autopilot_driver, telemetry_state
from companion.vehicle.drivers import DriverKind
from companion.vehicle.setpoint import IGNORE_POSITION, Setpoint, setpoint_fields
from companion.vehicle.setpoint_echo import FOREIGN, KEPT_S, SetpointEcho
from companion.vehicle.state import FlightMode, LandedState, Vector3, VehicleState
from tests.companion.vehicle.scripted_link import PX4, QUADROTOR, ScriptedDriver

pytestmark = pytest.mark.other_commander
NAN = math.nan
NONE: Vector3 = (NAN, NAN, NAN)
FLYING = VehicleState(autopilot="PX4", mode=FlightMode.OFFBOARD, armed=True, landed=LandedState.IN_AIR)
COPTER = replace(FLYING, autopilot="ArduPilot")
OFFBOARD = 6 << 16


def setpoint(position: Vector3 | None = None, velocity: Vector3 | None = None) -> dict[str, Any]:
    sent = Setpoint(0, position_ned_m=position, velocity_ned_mps=velocity)
    return setpoint_fields(sent, 1)


def reported(position: Vector3 = NONE, velocity: Vector3 = NONE, mask: int = 0) -> dict[str, Any]:
    """As PX4 reports it; by its mask as ArduPilot."""
    values = zip(("x", "y", "z", "vx", "vy", "vz"), (*position, *velocity), strict=True)
    return {"type_mask": mask, **dict(values)}


class Stream:
    """Our setpoints, every 20 ms, and the autopilot's reports, every 0.2 s, from a second of flight on."""

    def __init__(self, state: VehicleState = FLYING) -> None:
        self.echo, self.state, self.now_ns = SetpointEcho(), state, 1_000_000_000
        self.answered = True
        self.run(1.5, setpoint(velocity=(0.0, 0.0, 0.0)))

    @property
    def noticed(self) -> bool:
        return self.state.foreign_setpoint is not None

    def run(self, seconds: float, sent: dict[str, Any], followed: dict[str, Any] | None = None) -> None:
        for tick in range(round(seconds / 0.02)):
            self.now_ns += 20_000_000
            self.echo.sent(sent, self.now_ns)
            if tick % 10 == 5 and followed is not None:
                answered_ns = self.now_ns - (500_000_000 if self.answered else 1_000_000_000)
                self.echo.received(followed, self.state, self.now_ns, answered_ns)
            if tick % 50 == 25:
                self.state = self.echo.confirm(self.state, self.now_ns)


HERE: Vector3 = (3.0, -2.0, -6.0)
# What PX4 v1.14.4, v1.16.2, v1.18.0-beta1 and Copter 4.7 were seen to report, and what they were not.
FOLLOWED = [
    (setpoint(velocity=(1.5, 0.5, 0.0)), reported(velocity=(1.5, 0.5, 0.0)), False),
    (setpoint(velocity=(1.5, 0.5, 0.0)), reported((0.0, 0.0, 0.0), (1.499, 0.5, 0.0), 3079), False),
    (setpoint(HERE), reported(HERE, (0.1, 0.2, 0.0)), False),  # its controller's velocity beside it
    (setpoint(HERE), reported(HERE, (0.0, 0.0, 0.0), 3576), False),
    (setpoint(velocity=(0.0, 0.0, -7.0)), reported(velocity=(0.0, 0.0, -3.0)), False),  # MPC_Z_VEL_MAX_UP
    (setpoint(velocity=(0.0, 0.0, 3.0)), reported(velocity=(0.0, 0.0, 1.5)), False),  # MPC_Z_VEL_MAX_DN
    (setpoint(velocity=(8.0, 6.0, 0.0)), reported(velocity=(4.0, 3.0, 0.0)), False),  # MPC_XY_VEL_MAX
    (setpoint(velocity=(0.0, 0.0, -1.0)), reported(velocity=(0.0, 0.0, -0.1)), False),  # a take-off's ramp
    (setpoint(velocity=(1.0, 0.0, 0.0)), reported(mask=63), False),  # nothing is followed
    (setpoint(velocity=(1.0, 0.0, 0.0)), reported(velocity=(NAN, NAN, 0.0)), False),
    (setpoint(velocity=(0.05, 0.02, 0.0)), reported(velocity=(1.5, 0.0, 0.0)), True),
    (setpoint(velocity=(-1.5, 0.0, 0.0)), reported(velocity=(0.0, 0.0, 0.0)), True),
    (setpoint(velocity=(-1.5, 0.0, 0.0)), reported(velocity=(1.5, 0.0, 0.0)), True),
    (setpoint(velocity=(2.0, 0.0, 0.0)), reported(velocity=(1.0, 1.0, 0.0)), True),
    (setpoint(velocity=(2.0, 0.0, 0.0)), reported(velocity=(3.0, 0.0, 0.0)), True),
    (setpoint(velocity=(0.0, 0.0, 1.0)), reported(velocity=(0.0, 0.0, -1.0)), True),
    (setpoint(velocity=(0.0, 0.3, 0.0)), reported(HERE, (1.0, 0.0, 0.0)), True),
    (setpoint(HERE), reported((6.0, -2.0, -6.0)), True),
    (setpoint(HERE), reported(velocity=(0.0, 0.0, 0.0)), True),
    (setpoint(velocity=(1.0, 0.0, 0.0)), reported((NAN, NAN, -6.0), (1.0, 0.0, 0.0), 35), True),  # a height
    (setpoint(velocity=HERE), reported(HERE), True),  # the same numbers, of another kind
]


@pytest.mark.parametrize(("sent", "followed", "foreign"), FOLLOWED)
def test_setpoint_that_was_not_sent_is_foreign(
    sent: dict[str, Any], followed: dict[str, Any], foreign: bool
) -> None:
    stream = Stream()
    stream.run(4.0, sent, sent)
    assert not stream.noticed
    stream.run(4.0, sent, followed)
    assert stream.noticed is foreign


def test_both_setpoints_are_named_as_text() -> None:
    stream = Stream()
    stream.run(2.0, setpoint(velocity=(0.5, 0.0, 0.0)), reported(HERE))
    found = stream.state.foreign_setpoint
    assert found is not None
    assert found.sent == "north 0.50 m/s, east 0.00 m/s, down 0.00 m/s"
    assert found.followed == "north 3.00 m, east -2.00 m, down -6.00 m"
    assert found.since_ns < found.stamp_ns <= stream.now_ns


axis = st.floats(-4.0, 4.0)
OURS = st.lists(
    st.one_of(
        st.builds(lambda *v: setpoint(velocity=v), axis, axis, axis),
        st.builds(lambda *v: setpoint(v), axis, axis, axis),
    ),
    min_size=2,
    max_size=40,
)


@given(ours=OURS, delay_s=st.floats(0.0, KEPT_S - 0.5), mode_s=st.floats(0.1, 1.0))
def test_none_is_noticed_in_any_stream_of_ours(
    ours: list[dict[str, Any]], delay_s: float, mode_s: float
) -> None:
    echo, state, now_ns = SetpointEcho(), FLYING, 0
    sent: list[tuple[int, dict[str, Any]]] = []
    for step in range(20 * len(ours)):
        now_ns = step * 20_000_000
        sent.append((now_ns, ours[step // 20]))
        echo.sent(sent[-1][1], now_ns)
        arrived = [fields for stamp_ns, fields in sent if stamp_ns <= now_ns - delay_s * 1e9]
        if arrived and step % 8 == 0:
            echo.received(arrived[-1], state, now_ns, now_ns)
        if step % round(mode_s / 0.02) == 0:
            state = echo.confirm(state, now_ns)
    assert state.foreign_setpoint is None


OURS_NOW, THEIRS = setpoint(velocity=(-1.5, 0.0, 0.0)), reported(velocity=(1.5, 0.0, 0.0))


def test_few_setpoints_among_many_of_ours_are_noticed() -> None:
    """As of another program that sends two a second: here one report in twenty seconds."""
    stream = Stream()
    for number in range(FOREIGN):
        assert not stream.noticed, number
        stream.run(20.0, OURS_NOW, OURS_NOW)
        stream.run(0.2, OURS_NOW, THEIRS)
        stream.run(1.0, OURS_NOW, OURS_NOW)
    assert stream.noticed


def test_rare_setpoints_are_not_noticed() -> None:
    stream = Stream()
    for _ in range(4):
        stream.run(0.2, OURS_NOW, THEIRS)
        stream.run(61.0, OURS_NOW, OURS_NOW)
    assert not stream.noticed


def test_what_is_followed_in_another_mode_does_not_count() -> None:
    """PX4 1.14 reports a mode once a second: until then the new mode's goal is compared with ours."""
    stream = Stream()
    for _ in range(5):
        stream.run(0.5, OURS_NOW, THEIRS)
        stream.state = stream.echo.confirm(replace(stream.state, mode=FlightMode.HOLD), stream.now_ns)
        stream.state = replace(stream.state, mode=FlightMode.OFFBOARD)
        stream.run(0.6, OURS_NOW, THEIRS)
        stream.run(2.0, OURS_NOW, OURS_NOW)
    assert not stream.noticed


@pytest.mark.parametrize(
    "state",
    [
        replace(FLYING, armed=False),
        replace(FLYING, landed=LandedState.ON_GROUND),
        replace(FLYING, landed=LandedState.TAKING_OFF),
        replace(FLYING, mode=FlightMode.TAKEOFF),
        replace(COPTER, alters_velocities=True),
    ],
)
def test_only_our_flight_by_setpoints_is_judged(state: VehicleState) -> None:
    stream = Stream(state)
    stream.run(5.0, OURS_NOW, THEIRS)
    assert not stream.noticed


def test_position_counts_beside_copters_fence() -> None:
    stream = Stream(replace(COPTER, alters_velocities=True))
    stream.run(5.0, OURS_NOW, reported(HERE, mask=3576))
    assert stream.noticed


def test_link_that_answers_nothing_proves_nothing() -> None:
    """Copter stops after GUID_TIMEOUT where ours do not arrive."""
    stream = Stream()
    stream.answered = False
    stream.run(5.0, OURS_NOW, reported(velocity=(0.0, 0.0, 0.0)))
    assert not stream.noticed
    stream.answered = True
    stream.run(5.0, OURS_NOW, reported(velocity=(0.0, 0.0, 0.0)))
    assert stream.noticed


def test_pause_of_our_stream_begins_again() -> None:
    stream = Stream()
    for _ in range(5):
        stream.run(0.4, OURS_NOW, THEIRS)
        stream.now_ns += 600_000_000
        stream.run(0.9, OURS_NOW, THEIRS)
        stream.now_ns += 600_000_000
    assert not stream.noticed


def test_both_drivers_notice_it(kind: DriverKind, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [1_000_000_000]
    for module in (autopilot_driver, telemetry_state):
        monkeypatch.setattr(module.time, "monotonic_ns", lambda: clock[0])
    one = ScriptedDriver(kind)
    telemetry = one.driver._telemetry
    one.driver._send_message = lambda *_: None  # type: ignore[method-assign]
    for _ in range(10):
        one.receive(mavlink.MAVLink_heartbeat_message(QUADROTOR, PX4, 29 | 128, OFFBOARD, 4, 3))
        one.receive(mavlink.MAVLink_extended_sys_state_message(0, 2))
        telemetry.answered_ns = clock[0]
        for tick in range(10):
            one.driver.send_setpoint(Setpoint.velocity((0.0, 0.0, 0.0), one.driver.watch.now_ns()))
            velocity = (1.0, 0.0, 0.0) if tick == 5 else (0.0, 0.0, 0.0)
            one.receive(
                mavlink.MAVLink_position_target_local_ned_message(
                    0, 1, IGNORE_POSITION, *NONE, *velocity, 0.1, 0.2, 0.3, 0.0, 0.0
                )
            )
            clock[0] += 40_000_000
    found = one.driver.state.foreign_setpoint
    assert found is not None
    assert found.followed.startswith("north 1.00 m/s")
