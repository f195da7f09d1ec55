"""Text reports of the built-in autopilots, received by both drivers."""

import json
from pathlib import Path

import pytest

from companion.vehicle.driver import CommandRefusedError
from companion.vehicle.drivers import DriverKind, open_driver
from mavlink_sim.testing import running_simulator
from tests.companion.vehicle.fake_autopilot import wait_for_state

pytestmark = pytest.mark.realtime


async def test_px4_arming_refusal_has_its_reason(
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
            assert str(refused.value).endswith("(temporarily rejected): Heading estimate not stable")
            await wait_for_state(driver, lambda state: any(report.name for report in state.reports))
            texts = [report.text for report in driver.state.reports]
            assert "Arming denied: Resolve system health failures first" in texts
            assert "No offboard signal" in texts
        finally:
            await driver.close()
    events = next((tmp_path / "companion" / "metadata").glob("events-*.json"))
    assert json.loads(events.read_bytes())["version"] == 2


async def test_copter_arming_refusal_has_its_reason() -> None:
    with running_simulator(autopilot="ardupilot", ready_after=600.0, speed=2.0) as simulator:
        driver = open_driver("pymavlink", f"udpin://127.0.0.1:{simulator.onboard_port}")
        await driver.connect(20.0)
        try:
            with pytest.raises(CommandRefusedError, match=r"\(.*\): (Pre)?Arm: "):
                await driver.arm()
        finally:
            await driver.close()
