"""Two services on one vehicle: each detects the other, and one of them refuses to fly."""

from __future__ import annotations

import asyncio
import contextlib
import json
from dataclasses import replace
from typing import Any

import pytest

from companion.guidance.behaviour import Behaviour
from companion.guidance.behaviours.hold import HoldBehaviour
from companion.guidance.behaviours.land import LandBehaviour, ReturnBehaviour
from companion.guidance.behaviours.stop import StopBehaviour
from companion.guidance.behaviours.takeoff import TakeoffBehaviour
from companion.guidance.interface import CommandInput
from companion.host.peer_data import PeerDataError
from companion.service.other_commanders import FOREIGN_OFFBOARD, FOREIGN_SETPOINTS, OtherCommanders
from companion.settings.vehicle import VehicleSection
from companion.vehicle.autopilot_parameters import NOTHING_READ, AutopilotParameters, FirmwareVersion
from companion.vehicle.commander import Commander, ForeignSetpoint
from companion.vehicle.setpoint_loss import SetpointLossOutcome, setpoint_loss_outcome
from companion.vehicle.state import FlightMode, VehicleState
from mavlink_sim.testing import running_simulator
from mavlink_sim.wire.setpoints import velocity_setpoint
from tests.companion.live_flight import LiveFlight, ground_station
from tests.companion.service.test_health import PX4_VALUES
from tests.companion.service_process import TWICE

S = 1_000_000_000
NOW_NS = 1000 * S


class Here(OtherCommanders):
    """A service with an uptime of 100 s."""

    def __init__(self, *, allowed: bool = False) -> None:
        self.events: list[tuple[str, str]] = []
        settings = VehicleSection(allow_other_commander=allowed)
        super().__init__(settings, "here", NOW_NS - 100 * S, lambda *event: self.events.append(event))

    def watch(
        self,
        state: VehicleState,
        now_ns: int,
        setpoint_loss: SetpointLossOutcome | None = None,
        *,
        in_command: bool = False,
        exact_echo: bool = True,
    ) -> None:
        setpoint_loss = setpoint_loss or setpoint_loss_outcome(NOTHING_READ, sticks_present=False)
        super().watch(state, now_ns, setpoint_loss, in_command=in_command, exact_echo=exact_echo)

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
    with contextlib.suppress(PeerDataError):  # counted by the table of listeners
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


def offboard(now_ns: int, **changes: Any) -> VehicleState:
    """PX4 in the air that flies setpoints."""
    state = VehicleState(autopilot="PX4", mode=FlightMode.OFFBOARD, armed=True, heartbeat_ns=now_ns)
    return replace(state, **changes)


@pytest.mark.parametrize(
    ("changes", "in_command", "noticed"),
    [
        ({}, False, True),
        ({}, True, False),  # ours
        ({"armed": False}, False, False),  # PX4 shows it after a landing
        ({"mode": FlightMode.HOLD}, False, False),
        ({"autopilot": "ArduPilot"}, False, False),  # it stays in GUIDED without setpoints
    ],
)
def test_setpoints_of_another_program_are_noticed_on_px4(
    changes: dict[str, Any], in_command: bool, noticed: bool
) -> None:
    here = Here()
    for second in range(7):
        now_ns = NOW_NS + second * S
        state = offboard(now_ns, **changes)
        here.watch(state, now_ns, in_command=in_command)
        if second < 5:  # PX4 leaves OFFBOARD some time after our own last setpoint
            assert here.present(state, now_ns) == []
    found = [(other.identity, other.in_command) for other in here.present(state, now_ns)]
    assert found == ([(FOREIGN_OFFBOARD, True)] if noticed else [])
    assert [level for level, _ in here.events] == (["error"] if noticed else [])
    command = CommandInput(1, "hold", HoldBehaviour())
    refused = here.check_requirements(command, state, in_command=False, now_ns=now_ns)
    assert (refused is not None) is noticed


@pytest.mark.parametrize(
    ("parameters", "sticks_present", "noticed_after_s"),
    [
        ({}, False, 5),
        ({"NAV_RCL_ACT": 0.0}, False, None),  # it stays in OFFBOARD
        ({"NAV_RCL_ACT": 7.0}, False, None),
        ({"NAV_RCL_ACT": 0.0}, True, 5),  # it changes to position mode
        ({"COM_OF_LOSS_T": 10.0}, False, 13),
    ],
)
def test_offboard_counts_where_px4_would_have_left_it(
    parameters: dict[str, float], sticks_present: bool, noticed_after_s: int | None
) -> None:
    known = tuple((PX4_VALUES | parameters).items())
    read = AutopilotParameters("PX4", FirmwareVersion(1, 18), 1, known)
    setpoint_loss = setpoint_loss_outcome(read, sticks_present=sticks_present)
    here = Here()
    for second in range(60):
        now_ns = NOW_NS + second * S
        here.watch(offboard(now_ns), now_ns, setpoint_loss)
        noticed = noticed_after_s is not None and second >= noticed_after_s
        assert bool(here.present(offboard(now_ns), now_ns)) is noticed, second


def test_brief_offboard_of_ours_is_no_other_commander() -> None:
    here = Here()
    for second in range(20):
        now_ns = NOW_NS + second * S
        here.watch(offboard(now_ns), now_ns, in_command=second % 4 == 0)
        assert here.present(offboard(now_ns), now_ns) == []


@pytest.mark.parametrize("exact_echo", [True, False])
def test_setpoints_beside_ours_are_reported_with_both(exact_echo: bool) -> None:
    here, state = Here(), VehicleState(foreign_setpoint=ForeignSetpoint(NOW_NS, NOW_NS - S, "OURS", "THEIRS"))
    for second in range(3):
        here.watch(state, NOW_NS + second * S, in_command=True, exact_echo=exact_echo)
    status = here.status(state, NOW_NS + 2 * S)
    assert [(other["identity"], other["in_command"]) for other in status] == [(FOREIGN_SETPOINTS, True)][
        : int(exact_echo)
    ]
    assert [level for level, _ in here.events] == ["error"][: int(exact_echo)]
    assert all("OURS" in text and "THEIRS" in text for _, text in here.events)
    assert (here.reason(state) is not None) is exact_echo
    assert here.reason(state, in_command=True) is None
    assert here.reason(state, StopBehaviour()) is None
    here.watch(state, NOW_NS + 4 * S, exact_echo=exact_echo)
    assert here.status(state, NOW_NS + 4 * S) == []


@pytest.mark.parametrize(
    ("autopilot", "version", "options", "exact"),
    [
        ("PX4", (1, 14), None, True),
        ("PX4", (1, 18), None, True),
        ("PX4", (1, 13), None, False),
        ("PX4", None, None, False),
        ("ArduPilot", (4, 7), 0.0, True),
        ("ArduPilot", (4, 7), 32.0, False),  # it reports the velocity that it has reached
        ("ArduPilot", (4, 7), None, False),
        ("ArduPilot", (4, 0), 0.0, False),
        (None, None, None, False),
    ],
)
def test_echo_counts_where_it_is_known_to_be_exact(
    autopilot: str | None, version: tuple[int, int] | None, options: float | None, exact: bool
) -> None:
    values = () if options is None else (("GUID_OPTIONS", options),)
    firmware = None if version is None else FirmwareVersion(*version)
    assert AutopilotParameters(autopilot, firmware, 1, values).exact_echo is exact


def test_command_with_our_address_refuses_until_it_is_over() -> None:
    here = Here()
    state = VehicleState(foreign_command_ns=NOW_NS - S, address_shared_ns=NOW_NS - S)
    assert here.reason(state) is not None
    assert here.reason(state, StopBehaviour()) is None
    assert here.reason(VehicleState(foreign_command_ns=NOW_NS - 4 * S)) is None


def test_shared_and_changed_address_are_reported_once() -> None:
    here = Here()
    for second in range(3):
        here.watch(VehicleState(address_shared_ns=NOW_NS), NOW_NS + second * S, in_command=True)
    assert [level for level, _ in here.events] == ["error"]
    for second in range(3):
        here.watch(VehicleState(own_address=(1, 193)), NOW_NS + second * S)
    assert [level for level, _ in here.events] == ["error", "warning"]
    assert "1/191" in here.events[1][1]
    assert "1/193" in here.events[1][1]


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


@pytest.mark.realtime
@pytest.mark.other_commander
@pytest.mark.parametrize("kind", ["pymavlink", pytest.param("mavsdk", marks=pytest.mark.slow)])
async def test_setpoints_of_a_ground_station_beside_ours_are_noticed(kind: str) -> None:
    with running_simulator(**TWICE) as simulator, ground_station(simulator.gcs_port) as station:
        flight = LiveFlight(kind, simulator.onboard_port)
        async with flight.running():
            await flight.until(
                lambda: flight.driver.state.ready_to_arm and flight.driver.state.position_ned_m
            )
            for text in ("takeoff 3", "hold"):
                outcome = await flight.fly(text)
                assert outcome.success, outcome.reason
            assert await asyncio.to_thread(station.wait_heartbeat, timeout=10)
            other = velocity_setpoint(0.5, 0.0, 0.0)

            async def stream() -> None:
                while True:
                    station.mav.send(other)
                    await asyncio.sleep(0.1)

            sending = asyncio.create_task(stream())
            try:
                await flight.until(lambda: any(FOREIGN_SETPOINTS in text for _, text in flight.events))
            finally:
                sending.cancel()
            now_ns = flight.driver.state.heartbeat_ns
            assert FOREIGN_SETPOINTS in [
                one["identity"] for one in flight.others.status(flight.driver.state, now_ns)
            ]
            assert flight.guidance.in_command
