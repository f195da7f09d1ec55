"""A seek that sweeps and an operator's word, with a real driver, a real socket and the built-in vehicle."""

from __future__ import annotations

import asyncio
import math

import pytest
from live_flight import STATION, LiveFlight, ground_station

from companion.guidance.behaviour import Outcome, Situation
from companion.guidance.gimbal_hand import GimbalHand
from companion.guidance.grammar import parse
from companion.guidance.registry import behaviour_for
from companion.vehicle.gimbal import NOBODY, GimbalAim
from mavlink_sim.testing import running_simulator


class FlightWithGimbal(LiveFlight):
    """With a camera on its gimbal, which sees nothing."""

    def __init__(self, port):
        super().__init__("pymavlink", port)
        self.told = []
        self.gimbal = GimbalHand(
            self.driver,
            lambda level, text: self.told.append((level, text)),
            carries_camera=True,
            carries_steering=True,
        )

    def turn(self, now_ns):
        state = self.driver.state
        sight = self.gimbal.sight(now_ns, state)
        self.pilot.update(Situation(now_ns, state, (), 0.05, not sight.undirected, gimbal=sight))
        self.gimbal.update(now_ns, state, self.pilot.behaviour)

    async def close(self):
        await self.gimbal.close()
        await super().close()

    @property
    def pitch_deg(self):
        return math.degrees(self.driver.state.gimbal.pitch_rad)


async def test_a_sweep_an_operators_word_and_a_station_that_wins() -> None:
    with (
        running_simulator(speed=2.0, gimbal=True) as simulator,
        ground_station(simulator.gcs_port) as station,
    ):

        def configures(system, component):
            station.mav.command_long_send(1, 1, 1001, 0, system, component, -1, -1, 0, 0, 0)

        service = FlightWithGimbal(simulator.onboard_port)
        async with service.running():
            driver = service.driver
            await service.until(lambda: driver.state.ready_to_arm and driver.state.position_ned_m)
            await service.gimbal.find()
            assert await service.gimbal.point(GimbalAim(math.radians(-20.0)), None) == Outcome(
                True, "the gimbal looks 20° down"
            ), "on the ground too, and nothing flies for it"
            assert not service.pilot.in_command
            await service.until(lambda: driver.state.gimbal.primary_control == NOBODY)
            assert service.pitch_deg == pytest.approx(-20.0, abs=3.0), "given back, it stays"

            assert (await service.fly("takeoff 4")).success
            seek = service.pilot.command(behaviour_for(parse("seek car sweep=-50 sweep_rate=30 laps=5")))
            await service.until(lambda: driver.state.gimbal.primary_control == driver.own_address)
            await service.until(lambda: service.pitch_deg < -44.0)
            await service.until(lambda: service.pitch_deg > -6.0)
            busy = await service.gimbal.point(GimbalAim(0.0), service.pilot.behaviour)
            assert busy == Outcome(False, "gimbal: seek moves it; end that first")

            assert await asyncio.to_thread(station.wait_heartbeat, timeout=10)
            configures(*STATION)
            await service.until(seek.done)
            assert seek.result().reason.startswith("seek lost the gimbal: ")
            assert any("the gimbal is not moved" in text for _, text in service.told)
            await service.until(lambda: driver.state.gimbal.primary_control == STATION)
            refused = await service.gimbal.point(GimbalAim(0.0), service.pilot.behaviour)
            assert refused.reason == (
                "gimbal needs control of the gimbal (245/190 has it, and must give it back)"
            )
            # Refused, or ended at once where the pilot's newest look at the vehicle was from before.
            again = await service.fly("seek car sweep=-50")
            assert "245/190 has" in again.reason
            assert driver.state.gimbal.primary_control == STATION, "it was not taken back"

            configures(-3, -3)
            await service.until(lambda: driver.state.gimbal.primary_control == NOBODY)
            pointed = await service.gimbal.point(GimbalAim(0.0), service.pilot.behaviour)
            assert pointed == Outcome(True, "the gimbal looks level")
            assert service.pilot.behaviour.name == "hold", "what flies goes on"
            # PX4 takes the gimbal at a landing, turns it ahead and gives it back.
            assert (await service.fly("land")).success
