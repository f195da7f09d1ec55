"""A seek that sweeps and an operator's word, with a real driver, a real socket and the built-in vehicle."""

from __future__ import annotations

import asyncio
import math

import pytest

from companion.guidance.behaviour import Outcome
from companion.vehicle.gimbal import NOBODY, GimbalState
from mavlink_sim.testing import running_simulator
from tests.companion.live_flight import STATION, LiveFlight, ground_station
from vision.detections import Detections
from vision.pipeline import PerceptionResult


class FlightWithGimbal(LiveFlight):
    """With a camera on its gimbal, which sees nothing."""

    def __init__(self, port: int) -> None:
        super().__init__("pymavlink", port, {"camera.on_gimbal": "true", "detector.enabled": "true"})
        self._view = self.inputs.steering

    def on_step(self, now_ns: int) -> None:
        nothing = Detections.empty(("car",))
        self._view.update(PerceptionResult(0, now_ns, now_ns, 640, 480, nothing, {}, 0))

    @property
    def gimbal(self) -> GimbalState:
        """What the vehicle tells of it."""
        gimbal = self.driver.state.gimbal
        assert gimbal is not None
        return gimbal

    @property
    def pitch_deg(self) -> float:
        assert self.gimbal.pitch_rad is not None
        return math.degrees(self.gimbal.pitch_rad)


async def test_a_sweep_an_operators_word_and_a_station_that_wins() -> None:
    with (
        running_simulator(speed=2.0, gimbal=True) as simulator,
        ground_station(simulator.gcs_port) as station,
    ):

        def configures(system: int, component: int) -> None:
            station.mav.command_long_send(1, 1, 1001, 0, system, component, -1, -1, 0, 0, 0)

        service = FlightWithGimbal(simulator.onboard_port)
        async with service.running():
            driver, guidance = service.driver, service.guidance
            await service.until(lambda: driver.state.ready_to_arm and driver.state.position_ned_m)
            assert await service.fly("gimbal pitch=-20") == Outcome(True, "the gimbal looks 20° down"), (
                "on the ground too, and nothing flies for it"
            )
            assert not guidance.in_command
            await service.until(lambda: service.gimbal.primary_control == NOBODY)
            assert service.pitch_deg == pytest.approx(-20.0, abs=3.0), "given back, it stays"

            assert (await service.fly("takeoff 4")).success
            seek = asyncio.create_task(service.fly("seek car sweep=-50 sweep_rate=30 laps=5"))
            await service.until(lambda: service.gimbal.primary_control == driver.own_address)
            await service.until(lambda: service.pitch_deg < -44.0)
            await service.until(lambda: service.pitch_deg > -6.0)
            busy = await service.fly("gimbal pitch=0")
            assert busy == Outcome(False, "gimbal: seek moves it; end that first")

            assert await asyncio.to_thread(station.wait_heartbeat, timeout=10)
            configures(*STATION)
            assert (await seek).reason.startswith("seek lost the gimbal: ")
            assert any("the gimbal is not moved" in text for _, text in service.events)
            await service.until(lambda: service.gimbal.primary_control == STATION)
            refused = await service.fly("gimbal pitch=0")
            assert refused.reason == (
                "gimbal needs control of the gimbal (245/190 has it, and must give it back)"
            )
            again = await service.fly("seek car sweep=-50")
            assert "245/190 has" in again.reason
            assert service.gimbal.primary_control == STATION, "it was not taken back"

            configures(-3, -3)
            await service.until(lambda: service.gimbal.primary_control == NOBODY)
            assert await service.fly("gimbal pitch=0") == Outcome(True, "the gimbal looks level")
            assert guidance.behaviour is not None
            assert guidance.behaviour.name == "hold", "what flies goes on"
            # PX4 takes the gimbal at a landing, turns it ahead and gives it back.
            assert (await service.fly("land")).success
