"""Two services on one vehicle: each detects the other, and one of them refuses to fly."""

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
from tests.companion.service_process import TWICE

S = 1_000_000_000
NOW_NS = 1000 * S


class Here(OtherCommanders):
    """A service with an uptime of 100 s."""

    def __init__(self, *, allowed: bool = False) -> None:
        self.events: list[tuple[str, str]] = []
        settings = VehicleSection(allow_other_commander=allowed)
        super().__init__(settings, "here", NOW_NS - 100 * S, lambda *event: self.events.append(event))

    def reason(
        self, state: VehicleState, behaviour: Behaviour | None = None, *, in_command: bool = False
    ) -> str | None:
        command = CommandInput(1, "a command", behaviour or HoldBehaviour())
        return self.check_requirements(command, state, in_command=in_command, now_ns=NOW_NS)


def beside(uptime_s: float, *, in_command: bool = False, age_s: float = 0.5) -> VehicleState:
    """State of a vehicle with another service."""
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
        (beside(200.0), True),  # the other is older
        (beside(101.0), True),  # same age within the tolerance
        (beside(50.0), False),  # ours is older
        (beside(50.0, in_command=True), True),
        (beside(200.0, age_s=4.0), False),  # gone
    ],
)
def test_later_service_refuses_to_engage(state: VehicleState, refused: bool) -> None:
    assert (Here().reason(state) is not None) is refused
    assert Here(allowed=True).reason(state) is None
    assert Here().reason(state, in_command=True) is None


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
def test_commands_that_end_a_flight_are_allowed(behaviour: Behaviour, refused: bool) -> None:
    assert (Here().reason(beside(200.0), behaviour) is not None) is refused


def test_other_service_is_detected_by_its_status() -> None:
    here = Here()
    here.on_status(status(), NOW_NS)
    assert here.status(VehicleState(), NOW_NS) == [
        {"via": "zenoh", "identity": "there", "uptime_s": 300.0, "in_command": False}
    ]
    assert here.reason(VehicleState()) is not None
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
def test_foreign_and_invalid_statuses_are_ignored(payload: bytes) -> None:
    here = Here()
    here.on_status(payload, NOW_NS)
    assert here.status(VehicleState(), NOW_NS) == []


def test_appearance_and_loss_are_reported_once() -> None:
    here = Here()
    for second in range(3):
        here.watch(beside(200.0, age_s=0.0), NOW_NS + second * S)
    assert [level for level, _ in here.events] == ["error"]
    assert "1/192 by mavlink" in here.events[0][1]
    for second in range(4, 7):
        here.watch(beside(200.0, age_s=0.0), NOW_NS + second * S)
    assert [level for level, _ in here.events] == ["error", "info"]


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("kind", "autopilot"),
    [("mavsdk", "px4"), pytest.param("pymavlink", "ardupilot", marks=pytest.mark.slow)],
)
async def test_two_services_on_two_links_of_one_vehicle(kind: str, autopilot: str) -> None:
    options = TWICE if autopilot == "px4" else {**TWICE, "parameters": {"LAND_SPEED": 200}}
    with running_simulator(autopilot=autopilot, **options) as simulator:
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
            # Both links must report it: a mode change after the `land` command counts as another pilot's.
            await second.until(lambda: second.driver.state.mode is FlightMode.OFFBOARD)
            await second.until(lambda: second.driver.state.other_commanders[-1].in_command)
            assert "in command" in (await second.fly("hold")).reason
            # The refused service can still end the flight, as any pilot.
            outcome = await second.fly("land")
            assert outcome.success, outcome.reason
