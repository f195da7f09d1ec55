"""The parameters of an autopilot's serial ports: which have MAVLink, how fast, and in which mode.

PX4: its MAVLink instances 0 to 2 (`src/modules/mavlink/module.yaml`) and the ports that they are assigned to
(`Tools/serial/generate_config.py`). ArduPilot: SERIAL1 to SERIAL5 (`AP_SerialManager`).
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterable

from companion.vehicle.driver import CommandRefusedError, Driver

PX4_INSTANCES = (0, 1, 2)
PX4_PORTS = {
    6: "URT6",
    101: "TEL1",
    102: "TEL2",
    103: "TEL3",
    104: "TEL4",
    201: "GPS1",
    202: "GPS2",
    203: "GPS3",
    300: "RC",
    301: "WIFI",
    401: "EXT2",
}
"""Value of MAV_x_CONFIG → port, as in SER_<port>_BAUD. 0 is none, 1000 Ethernet."""
PX4_ONBOARD = 2
"""Value of MAV_x_MODE with the streams of a companion."""
ARDUPILOT_PORTS = (1, 2, 3, 4, 5)
ARDUPILOT_MAVLINK = {1: "MAVLink 1", 2: "MAVLink 2"}
"""Values of SERIALx_PROTOCOL."""
# SERIALx_BAUD of common rates that are not thousands (`AP_SerialManager::map_baudrate`).
_BAUDS = {9: 9600, 19: 19_200, 38: 38_400, 57: 57_600, 115: 115_200, 230: 230_400, 460: 460_800, 921: 921_600}


def ardupilot_baud(value: float) -> int:
    """Return the baud rate of SERIALx_BAUD."""
    number = round(value)
    return _BAUDS.get(number, number * 1000 if number <= 2000 else number)


async def read_port_parameters(driver: Driver) -> dict[str, float]:
    """Return those parameters that the autopilot has. It takes up to 5 s; nothing is changed.

    Empty for an autopilot without serial ports, as in a simulation, and for one that is neither PX4 nor
    ArduPilot.
    """
    if driver.state.autopilot == "ArduPilot":
        return await _read(
            driver, [f"SERIAL{x}_{key}" for x in ARDUPILOT_PORTS for key in ("PROTOCOL", "BAUD")]
        )
    if driver.state.autopilot != "PX4":
        return {}
    found = await _read(
        driver, [f"MAV_{x}_{key}" for x in PX4_INSTANCES for key in ("CONFIG", "MODE", "RATE", "FORWARD")]
    )
    ports = {PX4_PORTS.get(round(found.get(f"MAV_{x}_CONFIG", 0))) for x in PX4_INSTANCES} - {None}
    return found | await _read(driver, [f"SER_{port}_BAUD" for port in sorted(map(str, ports))])


async def _read(driver: Driver, names: Iterable[str]) -> dict[str, float]:
    async def value(name: str) -> tuple[str, float] | None:
        try:
            return name, await driver.get_parameter(name)
        except CommandRefusedError:
            return None

    return dict(filter(None, await asyncio.gather(*map(value, names))))
