"""The pilot with a real driver, a real socket and the built-in vehicle in its own process."""

import asyncio
import contextlib
import math
import time

import pytest
from pymavlink import mavutil

from companion.guidance.behaviour import Situation
from companion.guidance.envelope import Envelope
from companion.guidance.grammar import parse
from companion.guidance.pilot import Pilot
from companion.guidance.pilot_event import PilotEventKind
from companion.guidance.registry import behaviour_for
from companion.vehicle.drivers import open_driver
from companion.vehicle.state import FlightMode
from companion.vehicle.streamer import Streamer
from mavlink_sim.testing import running_simulator

SPEED = 2.0


class Service:
    """Driver, streamer and guidance loop, as the service runs them."""

    def __init__(self, kind, port):
        self.driver = open_driver(kind, f"udpin://127.0.0.1:{port}")
        self.streamer = Streamer(self.driver.send_setpoint)
        self.events = []
        self.pilot = Pilot(self.driver, self.streamer, Envelope(), on_event=self.events.append)

    async def guide(self):
        while True:
            now_ns = time.monotonic_ns()
            self.pilot.update(Situation(now_ns, self.driver.state))
            await asyncio.sleep(0.02)

    async def until(self, condition, timeout_s=30.0):
        async with asyncio.timeout(timeout_s):
            while not condition():
                await asyncio.sleep(0.01)

    async def fly(self, text, timeout_s=60.0):
        return await asyncio.wait_for(self.pilot.command(behaviour_for(parse(text))), timeout_s)


@contextlib.asynccontextmanager
async def running_service(kind, port):
    service = Service(kind, port)
    await service.driver.connect(20.0)
    tasks = [asyncio.create_task(service.guide()), asyncio.create_task(service.streamer.run())]
    try:
        yield service
    finally:
        service.pilot.close()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        await service.driver.close()


@contextlib.contextmanager
def pilots_station(port):
    """A second MAVLink client, on the ground station's link."""
    station = mavutil.mavlink_connection(f"udpin:127.0.0.1:{port}", source_system=245, source_component=190)
    try:
        yield station
    finally:
        station.close()


def choose_mode(station, main, sub):
    station.mav.command_long_send(1, 1, mavutil.mavlink.MAV_CMD_DO_SET_MODE, 0, 1, main, sub, 0, 0, 0, 0)


@pytest.mark.parametrize("kind", ["pymavlink", "mavsdk"])
async def test_a_flight_by_commands_until_the_pilot_takes_over(kind):
    with running_simulator(speed=SPEED) as simulator, pilots_station(simulator.gcs_port) as station:
        async with running_service(kind, simulator.onboard_port) as service:
            driver, pilot = service.driver, service.pilot
            await service.until(lambda: driver.state.ready_to_arm and driver.state.position_ned_m)
            assert not driver.state.armed

            outcome = await service.fly("takeoff 3")
            assert outcome.success, outcome.reason
            assert driver.state.altitude_m == pytest.approx(3.0, abs=0.6)

            orbit = pilot.command(behaviour_for(parse("orbit radius=6 speed=2")))
            await service.until(lambda: pilot.phase == "offboard")
            assert driver.state.mode is FlightMode.OFFBOARD
            await service.until(lambda: math.hypot(*driver.state.velocity_ned_mps[:2]) > 1.5)
            assert not orbit.done()

            # The station has to have heard the vehicle to know where to send.
            assert await asyncio.to_thread(station.wait_heartbeat, timeout=10)
            choose_mode(station, 4, 3)  # AUTO.LOITER
            await service.until(orbit.done, 10.0)
            sent = service.streamer.sent_count
            assert orbit.result().reason == "the pilot took over: hold mode"
            assert service.events[-1].kind is PilotEventKind.LOST

            # Well past the time in which PX4 would go back to OFFBOARD if setpoints came.
            watched_until = time.monotonic() + 2.0
            await service.until(lambda: time.monotonic() > watched_until)
            assert service.streamer.sent_count == sent
            assert driver.state.mode is FlightMode.HOLD
            assert not pilot.in_command

            # Only an operator's new command takes the vehicle again.
            landed = await service.fly("land")
            assert landed.success, landed.reason
            assert not driver.state.armed
            assert service.streamer.sent_count == sent


async def test_places_and_paths_are_flown_with_the_built_in_vehicle():
    """By truth as telemetry tells it: where goto ends, and how far beside its path follow-path is."""
    with running_simulator(speed=SPEED, seed=3) as simulator:
        async with running_service("pymavlink", simulator.onboard_port) as service:
            driver = service.driver
            await service.until(lambda: driver.state.ready_to_arm and driver.state.position_ned_m)
            assert (await service.fly("takeoff 4")).success
            home = driver.state.home_position_ned_m
            assert home is not None

            outcome = await service.fly("goto 12 -6 altitude=6 speed=4")
            assert outcome.success, outcome.reason
            north, east, down = driver.state.position_ned_m
            assert math.dist((north - home[0], east - home[1], home[2] - down), (12, -6, 6)) < 1.2

            places = []
            unsubscribe = driver.subscribe(lambda state: places.append(state.position_ned_m))
            outcome = await service.fly("follow-path 12,6 0,6 0,0,4")
            unsubscribe()
            assert outcome.success, outcome.reason
            for corner in ((12.0, 6.0), (0.0, 6.0), (0.0, 0.0)):
                wanted = (home[0] + corner[0], home[1] + corner[1])
                assert min(math.dist(wanted, place[:2]) for place in places) < 1.5, corner
            assert (await service.fly("land")).success
