"""Two services on one vehicle: each names the other, and one of them refuses to fly."""

from __future__ import annotations

import json
from typing import Any

import pytest

from companion.guidance.behaviour import Behaviour
from companion.guidance.behaviours.hold import HoldBehaviour
from companion.guidance.behaviours.land import LandBehaviour, ReturnBehaviour
from companion.guidance.behaviours.stop import StopBehaviour
from companion.guidance.behaviours.takeoff import TakeoffBehaviour
from companion.guidance.interface import CommandInput
from companion.service.other_commanders import OtherCommanders
from companion.settings.vehicle import VehicleSection
from companion.vehicle.commander import Commander
from companion.vehicle.state import FlightMode, VehicleState
from mavlink_sim.testing import running_simulator
from tests.companion.live_flight import LiveFlight

S = 1_000_000_000
NOW_NS = 1000 * S


class Here(OtherCommanders):
    """A service that has run for 100 s."""

    def __init__(self, *, allowed: bool = False) -> None:
        self.said: list[tuple[str, str]] = []
        settings = VehicleSection(allow_other_commander=allowed)
        super().__init__(settings, "here", NOW_NS - 100 * S, lambda *event: self.said.append(event))

    def why(
        self, state: VehicleState, behaviour: Behaviour | None = None, *, in_command: bool = False
    ) -> str | None:
        command = CommandInput(1, "a command", behaviour or HoldBehaviour())
        return self.check_requirements(command, state, in_command=in_command, now_ns=NOW_NS)


def beside(uptime_s: float, *, in_command: bool = False, age_s: float = 0.5) -> VehicleState:
    """Of a vehicle that another service commands."""
    received_ns = NOW_NS - round(age_s * S)
    return VehicleState(other_commanders=(Commander((1, 192), received_ns, uptime_s, in_command),))


def status(**changes: Any) -> bytes:
    message = {
        "service": "there",
        "uptime_s": 300.0,
        "vehicle": {"name": "vehicle1"},
        "pilot": {"in_command": False},
    }
    return json.dumps({**message, **changes}).encode()


@pytest.mark.parametrize(
    ("state", "refused"),
    [
        (VehicleState(), False),
        (beside(200.0), True),  # it was there first
        (beside(101.0), True),  # too near to tell
        (beside(50.0), False),  # we were
        (beside(50.0, in_command=True), True),
        (beside(200.0, age_s=4.0), False),  # it has gone
    ],
)
def test_the_later_service_refuses_and_any_beside_one_in_command(state: VehicleState, refused: bool) -> None:
    assert (Here().why(state) is not None) is refused
    assert Here(allowed=True).why(state) is None
    assert Here().why(state, in_command=True) is None


@pytest.mark.parametrize(
    ("behaviour", "refused"),
    [
        (TakeoffBehaviour(5.0), True),
        (HoldBehaviour(), True),
        (LandBehaviour(), False),
        (ReturnBehaviour(), False),
        (StopBehaviour(), False),
    ],
)
def test_what_ends_a_flight_is_never_refused(behaviour: Behaviour, refused: bool) -> None:
    assert (Here().why(beside(200.0), behaviour) is not None) is refused


def test_a_service_of_the_same_name_is_known_by_its_status() -> None:
    here = Here()
    here.on_status(status(), NOW_NS)
    assert here.status(VehicleState(), NOW_NS) == [
        {"via": "zenoh", "identity": "there", "uptime_s": 300.0, "in_command": False}
    ]
    assert here.why(VehicleState()) is not None
    assert here.status(VehicleState(), NOW_NS + 4 * S) == []


@pytest.mark.parametrize(
    "payload",
    [
        status(service="here"),
        status(vehicle={"name": "vehicle2"}),
        b"\xff",
        b"[]",
        b"{}",
        status(uptime_s="long"),
        status(uptime_s=1e300),
        status(vehicle=None),
    ],
)
def test_other_vehicles_and_broken_statuses_count_for_nothing(payload: bytes) -> None:
    here = Here()
    here.on_status(payload, NOW_NS)
    assert here.status(VehicleState(), NOW_NS) == []


def test_who_comes_and_who_goes_is_said_once() -> None:
    here = Here()
    for second in range(3):
        here.watch(beside(200.0, age_s=0.0), NOW_NS + second * S)
    assert [level for level, _ in here.said] == ["error"]
    assert "1/192 by mavlink" in here.said[0][1]
    for second in range(4, 7):
        here.watch(beside(200.0, age_s=0.0), NOW_NS + second * S)
    assert [level for level, _ in here.said] == ["error", "info"]


@pytest.mark.parametrize(("kind", "autopilot"), [("mavsdk", "px4"), ("pymavlink", "ardupilot")])
async def test_two_services_on_two_links_of_one_vehicle(kind: str, autopilot: str) -> None:
    with running_simulator(autopilot=autopilot) as simulator:
        first = LiveFlight(kind, simulator.onboard_port, ran_s=60.0)
        second = LiveFlight(kind, simulator.gcs_port)
        async with first.running(), second.running():
            await first.until(lambda: first.driver.state.other_commanders)
            await second.until(lambda: second.driver.state.other_commanders)
            await first.until(
                lambda: first.driver.state.ready_to_arm and first.driver.state.position_ned_m, 60.0
            )
            refused = await second.fly("takeoff 3")
            assert not refused.success
            assert "allow_other_commander" in refused.reason
            for text in ("takeoff 3", "hold"):
                outcome = await first.fly(text)
                assert outcome.success, outcome.reason
            # Both links must show it: a mode that changes after `land` was asked for is another pilot's.
            await second.until(lambda: second.driver.state.mode is FlightMode.OFFBOARD)
            await second.until(lambda: second.driver.state.other_commanders[-1].in_command)
            assert "in command" in (await second.fly("hold")).reason
            # The one that was refused can still end the flight, as any pilot.
            outcome = await second.fly("land")
            assert outcome.success, outcome.reason
