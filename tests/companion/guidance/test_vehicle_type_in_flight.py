"""A vehicle that is not flown, by its type: no command begins, and an active one ends at once."""

from __future__ import annotations

from dataclasses import replace

import pytest

from companion.guidance.behaviour import Behaviour
from companion.guidance.behaviours.hold import HoldBehaviour
from companion.guidance.behaviours.land import LandBehaviour, ReturnBehaviour
from companion.guidance.behaviours.stop import StopBehaviour
from companion.guidance.behaviours.takeoff import TakeoffBehaviour
from companion.guidance.gimbal.controller import FIND_TIMEOUT_S
from companion.guidance.interface import EventKind, FindGimbal, GuidanceInput, Request
from companion.vehicle.state import FlightMode
from companion.vehicle.vehicle_type import ARDUPILOT, PX4, VTOL_STATE_MISSING, VtolState
from tests.companion.guidance.guidance_harness import GuidanceHarness, assert_failed, engaged, flying, parked
from tests.companion.guidance.test_command_queue import NeedsGimbal

FIXED_WING, QUADROTOR, ROVER, TILTROTOR = 1, 2, 10, 21
Identity = tuple[str, int, int, VtolState | None]
UNKNOWN: Identity = ("ArduPilot", QUADROTOR, ARDUPILOT, None)
COPTER: Identity = ("ArduPilot", QUADROTOR, ARDUPILOT, VtolState.UNDEFINED)
HOVERING: Identity = ("PX4", TILTROTOR, PX4, VtolState.MC)
QUADPLANE: Identity = ("ArduPilot", QUADROTOR, ARDUPILOT, VtolState.MC)
NOT_FLOWN: list[Identity] = [
    QUADPLANE,  # in hover, with Q_MAV_TYPE 2
    ("ArduPilot", FIXED_WING, ARDUPILOT, VtolState.MC),  # a quadplane
    ("ArduPilot", QUADROTOR, ARDUPILOT, VtolState.FW),  # the same in forward flight
    ("ArduPilot", ROVER, ARDUPILOT, VtolState.UNDEFINED),
    ("PX4", FIXED_WING, PX4, VtolState.UNDEFINED),
    ("PX4", QUADROTOR, ARDUPILOT, VtolState.UNDEFINED),  # another vehicle on the same link
    ("PX4", TILTROTOR, PX4, VtolState.TRANSITION_TO_FW),
    ("PX4", TILTROTOR, PX4, VtolState.FW),
]


class Vehicle(GuidanceHarness):
    """The harness with a vehicle whose type changes."""

    def __init__(self, identity: Identity, *, in_the_air: bool = True) -> None:
        self.identity = identity
        super().__init__(flying() if in_the_air else parked(), inputs=self._identified)

    def _identified(self, inputs: GuidanceInput) -> GuidanceInput:
        name, mav_type, autopilot, vtol_state = self.identity
        state = replace(
            inputs.state, autopilot=name, mav_type=mav_type, mav_autopilot=autopilot, vtol_state=vtol_state
        )
        # Plane's parameter distinguishes the one that hovers from Copter.
        state = replace(state, is_plane=self.identity is QUADPLANE)
        return replace(inputs, state=state)


@pytest.mark.parametrize("identity", NOT_FLOWN)
@pytest.mark.parametrize(
    "behaviour",
    [HoldBehaviour(), LandBehaviour(), ReturnBehaviour(), StopBehaviour(), TakeoffBehaviour(5.0)],
    ids=lambda behaviour: behaviour.name,
)
def test_no_flight_command_begins(behaviour: Behaviour, identity: Identity) -> None:
    harness = Vehicle(identity, in_the_air=not isinstance(behaviour, TakeoffBehaviour))
    harness.run(0.1)
    outcome = harness.outcome(harness.command(behaviour), 1.0)
    assert_failed(outcome, "vehicle")
    harness.run(3.0)
    assert harness.autopilot.requests == []
    assert harness.autopilot.setpoints == []


@pytest.mark.parametrize("identity", NOT_FLOWN)
def test_change_of_type_ends_our_command_at_once(identity: Identity) -> None:
    harness = Vehicle(HOVERING)
    pending = engaged(harness, "orbit")
    requests, sent = list(harness.autopilot.requests), len(harness.autopilot.setpoints)
    harness.identity = identity
    harness.run()
    assert harness.outputs[-1].setpoint is None
    assert len(harness.autopilot.setpoints) == sent
    assert_failed(harness.outcome(pending, 1.0), "vehicle")
    assert harness.events[-1].kind is EventKind.LOST
    harness.run(2.0)
    harness.identity = HOVERING
    harness.run(2.0)
    harness.close()
    harness.run(2.0)
    assert len(harness.autopilot.setpoints) == sent
    assert harness.autopilot.requests == requests  # no HOLD either


@pytest.mark.parametrize("identity", NOT_FLOWN)
def test_type_that_changes_while_landing_ends_the_command(identity: Identity) -> None:
    harness = Vehicle(HOVERING)
    pending = harness.command("land")
    harness.run(0.5)
    harness.identity = identity
    assert_failed(harness.outcome(pending, 1.0), "vehicle")
    assert not harness.guidance.in_command


def test_hovering_vtol_of_px4_flies_like_a_multicopter() -> None:
    harness = Vehicle(HOVERING)
    engaged(harness)
    assert harness.outcome(harness.command("goto forward=2 right=0"), 30.0).success


@pytest.mark.parametrize("text", ["takeoff 3", "goto 5 0"])
def test_command_waits_until_the_type_is_known(text: str) -> None:
    harness = Vehicle(UNKNOWN, in_the_air=not text.startswith("takeoff"))
    harness.run(0.1)
    pending = harness.command(text)
    harness.run(FIND_TIMEOUT_S - 0.5)
    assert not pending.done()
    assert harness.autopilot.requests == []
    harness.identity = COPTER
    assert harness.outcome(pending, 40.0).success


def test_command_is_refused_while_the_type_stays_unknown() -> None:
    harness = Vehicle(UNKNOWN, in_the_air=False)
    harness.run(0.1)
    outcome = harness.outcome(harness.command("takeoff 3"), FIND_TIMEOUT_S + 0.5)
    assert (outcome.success, outcome.reason) == (False, VTOL_STATE_MISSING)
    assert harness.autopilot.requests == []


def test_gimbal_is_requested_once_the_type_is_known() -> None:
    harness = Vehicle(UNKNOWN)
    found, start = list[Request](), harness.autopilot.start

    def started(request: Request) -> None:
        if isinstance(request.action, FindGimbal):
            found.append(request)
        else:
            start(request)

    harness.autopilot.start = started  # type: ignore[method-assign]
    harness.run(0.1)
    harness.command(NeedsGimbal())
    harness.run(0.5)
    assert not found
    harness.identity = COPTER
    harness.run(0.5)
    assert len(found) == 1


def test_pilots_mode_supersedes_a_command_that_waits_for_the_type() -> None:
    harness = Vehicle(UNKNOWN, in_the_air=False)
    harness.run(0.1)
    pending = harness.command("takeoff 3")
    harness.run(0.1)
    harness.autopilot.change_mode(FlightMode.POSITION)
    assert_failed(harness.outcome(pending, 1.0), "superseded by ")
    harness.identity = COPTER
    harness.run(2.0)
    assert harness.autopilot.requests == []
