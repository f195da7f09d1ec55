"""What the built-in autopilots say of themselves, as both drivers hear it."""

import json
from pathlib import Path

import pytest

from companion.vehicle.driver import CommandRefusedError
from companion.vehicle.drivers import DriverKind, open_driver
from mavlink_sim.testing import running_simulator
from tests.companion.vehicle.fake_autopilot import state_shows


async def test_a_px4_that_does_not_arm_says_why(
    kind: DriverKind, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with running_simulator(ready_after=600.0, speed=2.0) as simulator:
        driver = open_driver(kind, f"udpin://127.0.0.1:{simulator.onboard_port}")
        await driver.connect(20.0)
        try:
            with pytest.raises(CommandRefusedError) as refused:
                await driver.arm()
            # Not "No offboard signal" and such: those are about modes that it is not in.
            assert str(refused.value) == (
                "the vehicle refused to arm (temporarily rejected): Heading estimate not stable"
            )
            await state_shows(driver, lambda state: any(one.name for one in state.reports))
            texts = [one.text for one in driver.state.reports]
            assert "Arming denied: Resolve system health failures first" in texts
            assert "No offboard signal" in texts
        finally:
            await driver.close()
    events = next((tmp_path / "companion" / "metadata").glob("events-*.json"))
    assert json.loads(events.read_bytes())["version"] == 2


async def test_a_copter_that_does_not_arm_says_why() -> None:
    with running_simulator(autopilot="ardupilot", ready_after=600.0, speed=2.0) as simulator:
        driver = open_driver("pymavlink", f"udpin://127.0.0.1:{simulator.onboard_port}")
        await driver.connect(20.0)
        try:
            with pytest.raises(CommandRefusedError, match=r"refused to arm \(.*\): (Pre)?Arm: "):
                await driver.arm()
        finally:
            await driver.close()
