"""Which parameters of an autopilot's serial ports are read, and what they mean."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

import pytest

from companion.vehicle.driver import CommandRefusedError, Driver
from companion.vehicle.port_parameters import ardupilot_baud, read_port_parameters

PX4 = {
    "MAV_0_CONFIG": 101.0,
    "MAV_0_MODE": 0.0,
    "MAV_1_CONFIG": 102.0,
    "MAV_1_MODE": 2.0,
    "MAV_1_FORWARD": 0.0,
    "MAV_2_CONFIG": 1000.0,  # Ethernet
    "SER_TEL1_BAUD": 57600.0,
    "SER_TEL2_BAUD": 921600.0,
    "SER_GPS1_BAUD": 0.0,
}


class Autopilot:
    """A driver of an autopilot with some parameters. `asked`: the names that were requested."""

    def __init__(self, name: str | None, parameters: dict[str, float]) -> None:
        self.state, self.parameters, self.asked = SimpleNamespace(autopilot=name), parameters, set[str]()

    async def get_parameter(self, name: str) -> float:
        self.asked.add(name)
        if name not in self.parameters:
            raise CommandRefusedError(name)
        return self.parameters[name]


async def read(autopilot: Autopilot) -> dict[str, float]:
    return await read_port_parameters(cast(Driver, autopilot))


async def test_px4_has_the_baud_rates_of_the_ports_with_mavlink() -> None:
    autopilot = Autopilot("PX4", PX4)
    found = await read(autopilot)
    assert found == {name: value for name, value in PX4.items() if name != "SER_GPS1_BAUD"}
    assert {name for name in autopilot.asked if name.startswith("SER_")} == {"SER_TEL1_BAUD", "SER_TEL2_BAUD"}


async def test_simulated_px4_without_ports_has_none() -> None:
    autopilot = Autopilot("PX4", {})
    assert await read(autopilot) == {}
    assert len(autopilot.asked) == 12


async def test_ardupilot_has_protocol_and_baud_rate_of_each_port() -> None:
    parameters = {"SERIAL2_PROTOCOL": 2.0, "SERIAL2_BAUD": 921.0}
    assert await read(Autopilot("ArduPilot", parameters | {"SERIAL2_OPTIONS": 0.0})) == parameters


@pytest.mark.parametrize("name", [None, "Generic"])
async def test_nothing_is_requested_from_other_autopilots(name: Any) -> None:
    autopilot = Autopilot(name, PX4)
    assert await read(autopilot) == {}
    assert not autopilot.asked


@pytest.mark.parametrize(
    ("value", "baud"),
    [(57, 57_600), (115, 115_200), (921, 921_600), (1500, 1_500_000), (2000, 2_000_000), (460800, 460_800)],
)
def test_baud_rate_of_ardupilot(value: float, baud: int) -> None:
    assert ardupilot_baud(value) == baud
