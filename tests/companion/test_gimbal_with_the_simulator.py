"""Seek with a sweep and gimbal commands, with driver, socket and the simulated vehicle."""

from __future__ import annotations

import asyncio
import math

import pytest

from companion.vehicle.gimbal import NOBODY, GimbalState
from mavlink_sim.testing import running_simulator
from tests.companion.guidance.guidance_harness import assert_failed, known
from tests.companion.live_flight import STATION, LiveFlight, ground_station
from tests.companion.service_process import TWICE
from vision.detections import Detections
from vision.pipeline import PerceptionResult

pytestmark = pytest.mark.realtime


class FlightWithGimbal(LiveFlight):
    """A flight with a camera on the gimbal that detects nothing."""

    def __init__(self, port: int) -> None:
        super().__init__("pymavlink", port, {"camera.on_gimbal": "true", "detector.enabled": "true"})
        self._camera = self.inputs.steering

    def on_step(self, now_ns: int) -> None:
        nothing = Detections.empty(("car",))
        self._camera.update(PerceptionResult(0, now_ns, now_ns, 640, 480, nothing, {}, 0))

    @property
    def gimbal(self) -> GimbalState:
        """The reported state."""
        gimbal = self.driver.state.gimbal
        return known(gimbal)

    @property
    def pitch_deg(self) -> float:
        return math.degrees(known(self.gimbal.pitch_rad))


async def test_sweep_gimbal_command_and_station_takeover() -> None:
    with (
        running_simulator(gimbal=True, **TWICE) as simulator,
        ground_station(simulator.gcs_port) as station,
    ):

        def configures(system: int, component: int) -> None:
            station.mav.command_long_send(1, 1, 1001, 0, system, component, -1, -1, 0, 0, 0)

        service = FlightWithGimbal(simulator.onboard_port)
        async with service.running():
            driver, guidance = service.driver, service.guidance
            await service.until(lambda: driver.state.ready_to_arm and driver.state.position_ned_m)
            pointed = await service.fly("gimbal pitch=-20")
            assert pointed.success, "on the ground too, without flying"
            assert pointed.reason.endswith("20° down")
            assert not guidance.in_command
            await service.until(lambda: service.gimbal.primary_control == NOBODY)
            assert service.pitch_deg == pytest.approx(-20.0, abs=3.0), "released, it stays"

            assert (await service.fly("takeoff 4")).success
            seek = asyncio.create_task(service.fly("seek car sweep=-50 sweep_rate=30 laps=5"))
            await service.until(lambda: service.gimbal.primary_control == driver.own_address)
            await service.until(lambda: service.pitch_deg < -44.0)
            await service.until(lambda: service.pitch_deg > -6.0)
            assert_failed(await service.fly("gimbal pitch=0"), "seek")

            assert await asyncio.to_thread(station.wait_heartbeat, timeout=10)
            configures(*STATION)
            assert (await seek).reason.startswith("seek lost")
            assert any("not moved: " in text for _, text in service.events)
            await service.until(lambda: service.gimbal.primary_control == STATION)
            refused = await service.fly("gimbal pitch=0")
            assert "245/190 has" in refused.reason
            again = await service.fly("seek car sweep=-50")
            assert "245/190 has" in again.reason
            assert service.gimbal.primary_control == STATION, "not taken back"

            configures(-3, -3)
            await service.until(lambda: service.gimbal.primary_control == NOBODY)
            assert (await service.fly("gimbal pitch=0")).success
            assert known(guidance.behaviour).name == "hold", "the behaviour goes on"
            # PX4 takes the gimbal at a landing, points it ahead and releases it.
            assert (await service.fly("land")).success
