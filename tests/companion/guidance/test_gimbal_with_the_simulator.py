"""A seek that sweeps and an operator's word, with a real driver, a real socket and the built-in vehicle."""

from __future__ import annotations

import asyncio
import contextlib
import math
import time

import pytest
from pymavlink import mavutil

from companion.guidance.behaviour import Outcome, Situation
from companion.guidance.envelope import Envelope
from companion.guidance.gimbal_hand import GimbalHand
from companion.guidance.grammar import parse
from companion.guidance.pilot import Pilot
from companion.guidance.registry import behaviour_for
from companion.vehicle.drivers import open_driver
from companion.vehicle.gimbal import NOBODY, GimbalAim
from companion.vehicle.streamer import Streamer
from mavlink_sim.testing import running_simulator

STATION = (245, 190)


class Service:
    """Driver, streamer, guidance loop and gimbal, as the service runs them; its camera sees nothing."""

    def __init__(self, port):
        self.driver = open_driver("pymavlink", f"udpin://127.0.0.1:{port}")
        self.streamer = Streamer(self.driver.send_setpoint)
        self.events = []
        self.pilot = Pilot(self.driver, self.streamer, Envelope(), on_event=lambda event: None)
        self.gimbal = GimbalHand(
            self.driver,
            lambda level, text: self.events.append((level, text)),
            carries_camera=True,
            carries_steering=True,
        )

    async def guide(self):
        while True:
            now_ns, state = time.monotonic_ns(), self.driver.state
            sight = self.gimbal.sight(now_ns, state)
            self.pilot.update(Situation(now_ns, state, (), 0.05, not sight.undirected, gimbal=sight))
            self.gimbal.update(now_ns, state, self.pilot.behaviour)
            await asyncio.sleep(0.02)

    async def until(self, condition, timeout_s=30.0):
        async with asyncio.timeout(timeout_s):
            while not condition():
                await asyncio.sleep(0.01)

    async def fly(self, text):
        return await asyncio.wait_for(self.pilot.command(behaviour_for(parse(text))), 60.0)

    @property
    def pitch_deg(self):
        return math.degrees(self.driver.state.gimbal.pitch_rad)


@contextlib.asynccontextmanager
async def running_service(port):
    service = Service(port)
    await service.driver.connect(20.0)
    tasks = [asyncio.create_task(service.guide()), asyncio.create_task(service.streamer.run())]
    try:
        yield service
    finally:
        service.pilot.close()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await service.gimbal.close()
        await service.driver.close()


async def test_a_sweep_an_operators_word_and_a_station_that_wins() -> None:
    with running_simulator(speed=2.0, gimbal=True) as simulator:
        station = mavutil.mavlink_connection(
            f"udpin:127.0.0.1:{simulator.gcs_port}", source_system=STATION[0], source_component=STATION[1]
        )

        def configures(system, component):
            station.mav.command_long_send(1, 1, 1001, 0, system, component, -1, -1, 0, 0, 0)

        with contextlib.closing(station):
            async with running_service(simulator.onboard_port) as service:
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
                assert any("the gimbal is not moved" in text for _, text in service.events)
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
