"""Text reports of the built-in autopilots, received by both drivers."""

import asyncio
import json
import lzma
from pathlib import Path
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as mavlink

from companion.vehicle.driver import CommandRefusedError, Driver
from companion.vehicle.drivers import DriverKind, open_driver
from mavlink_sim.releases import RELEASES
from mavlink_sim.testing import running_simulator
from tests.companion.vehicle.fake_autopilot import FakeAutopilot, wait_for_state

pytestmark = pytest.mark.realtime


# Both drivers pass every frame to the same reader.
@pytest.mark.parametrize("kind", ["pymavlink", pytest.param("mavsdk", marks=pytest.mark.slow)])
async def test_denied_arming_of_px4_has_its_reason(
    kind: DriverKind, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with running_simulator(ready_after=600.0, speed=2.0) as simulator:
        driver = open_driver(kind, f"udpin://127.0.0.1:{simulator.onboard_port}")
        await driver.connect(20.0)
        try:
            with pytest.raises(CommandRefusedError) as refused:
                await driver.arm()
            # Without "No offboard signal" and similar reports, which affect other modes.
            heading, signal = "Heading estimate not stable", "No offboard signal"
            denied = "Arming denied: Resolve system health failures first"
            assert str(refused.value).endswith(f"(temporarily rejected): {heading}")
            await wait_for_state(driver, lambda state: any(report.name for report in state.reports))
            texts = [report.text for report in driver.state.reports]
            assert denied in texts
            assert signal in texts
        finally:
            await driver.close()
    events = next((tmp_path / "companion" / "metadata").glob("events-*.json.xz"))
    assert json.loads(lzma.decompress(events.read_bytes()))["version"] == 2


@pytest.mark.parametrize("release", RELEASES)
async def test_check_of_level_info_is_the_reason_of_every_release(
    release: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A missing mission, of all modes. Its text is in the metadata, whose path differs by release."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    parameters = {"COM_ARM_MIS_REQ": 1.0}
    with running_simulator(px4=release, parameters=parameters, ready_after=0.0) as simulator:
        driver = open_driver("pymavlink", f"udpin://127.0.0.1:{simulator.onboard_port}")
        await driver.connect(20.0)
        try:
            await wait_for_state(driver, lambda state: state.home_position_ned_m is not None)
            with pytest.raises(CommandRefusedError) as refused:
                await driver.arm()
        finally:
            await driver.close()
    assert str(refused.value).endswith(" valid mission available")


async def test_reasons_of_denied_arming_may_come_late(driver: Driver, autopilot: FakeAutopilot) -> None:
    """On a busy computer; the second one after the first."""
    loop = asyncio.get_running_loop()
    compass, logging = b"PreArm: Compass not healthy", b"PreArm: Logging failed"

    def report(text: bytes) -> None:
        autopilot.send(mavlink.MAVLink_statustext_message(2, text))

    def refuse(message: Any) -> None:
        autopilot.acknowledge(message.command, mavlink.MAV_RESULT_DENIED)
        if message.command == mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
            loop.call_later(1.0, report, compass)
            loop.call_later(1.2, report, logging)

    autopilot.answers["COMMAND_LONG"] = refuse
    with pytest.raises(CommandRefusedError, match=f": {compass.decode()}; {logging.decode()}$"):
        await driver.arm()


async def test_denied_arming_of_copter_has_its_reason() -> None:
    with running_simulator(autopilot="ardupilot", ready_after=600.0, speed=2.0) as simulator:
        driver = open_driver("pymavlink", f"udpin://127.0.0.1:{simulator.onboard_port}")
        await driver.connect(20.0)
        try:
            await wait_for_state(driver, lambda state: state.vtol_state is not None)
            with pytest.raises(CommandRefusedError, match=r"\(.*\): (Pre)?Arm: "):
                await driver.arm()
        finally:
            await driver.close()
