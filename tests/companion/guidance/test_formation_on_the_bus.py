"""Several vehicles from one process: each its driver, pilot and zenoh session, and keys of its own."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import math
import os
import socket
import time

from companion.bus import topics
from companion.bus.session import Bus
from companion.guidance.behaviour import Situation
from companion.guidance.envelope import Envelope
from companion.guidance.formation import FormationBehaviour
from companion.guidance.grammar import parse
from companion.guidance.pilot import Pilot
from companion.guidance.pose_sharing import PoseSharing
from companion.guidance.registry import behaviour_for
from companion.settings import ZenohSection
from companion.vehicle.drivers import open_driver
from companion.vehicle.streamer import Streamer
from mavlink_sim.testing import free_port, running_simulator

VEHICLES = int(os.environ.get("FORMATION_VEHICLES", "3"))


class Companion:
    """One vehicle's service, without a camera."""

    def __init__(self, name, member, zenoh_port, known_ports):
        self.name = name
        self.events = []
        self.poses = PoseSharing(name, lambda level, text: self.events.append(text))
        self.driver = open_driver(
            "pymavlink",
            f"udpin://127.0.0.1:{member.onboard_port}",
            system_id=member.system_id,
            own_system_id=member.system_id,
        )
        self.streamer = Streamer(self.driver.send_setpoint)
        self.pilot = Pilot(self.driver, self.streamer, Envelope(), on_event=self.events.append)
        self.bus = Bus(
            ZenohSection(
                connect=tuple(f"tcp/127.0.0.1:{port}" for port in known_ports),
                listen=(f"tcp/127.0.0.1:{zenoh_port}",),
            ),
            name,
            on_event=lambda level, text: self.events.append(text),
            on_command=self.command,
            listeners=[(topics.POSE, self.poses.hear)],
        )

    async def command(self, text):
        outcome = await self.pilot.command(behaviour_for(parse(text)))
        return {"success": outcome.success, "reason": outcome.reason}

    def around(self):
        return self.poses.around(self.driver.state, time.monotonic_ns())

    async def guide(self):
        for turn in itertools.count():
            now_ns = time.monotonic_ns()
            self.pilot.update(Situation(now_ns, self.driver.state, neighbourhood=self.around()))
            if turn % 2 == 0:
                message = self.poses.message(self.driver.state, self.pilot.behaviour, now_ns)
                if message is not None:
                    self.bus.publish(topics.POSE, message)
            await asyncio.sleep(0.05)


@contextlib.asynccontextmanager
async def companions(simulator, count):
    ports, members = [], []
    for index, vehicle in enumerate(simulator.vehicles[:count]):
        port = free_port(socket.SOCK_STREAM)
        members.append(Companion(f"vehicle{index + 1}", vehicle, port, ports.copy()))
        ports.append(port)
    tasks = []
    try:
        for member in members:
            await member.bus.start()
        await asyncio.gather(*(member.driver.connect(30.0) for member in members))
        for member in members:
            tasks += [asyncio.create_task(member.guide()), asyncio.create_task(member.streamer.run())]
        yield members
    finally:
        for member in members:
            member.pilot.close()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for member in members:
            await member.bus.close()
            await member.driver.close()


async def until(condition, timeout_s=60.0):
    async with asyncio.timeout(timeout_s):
        while not condition():
            await asyncio.sleep(0.02)


async def test_vehicles_of_one_process_share_their_poses_and_fly_in_formation():
    with running_simulator(vehicles=VEHICLES, spacing=7.0, ready_after=0.0) as simulator:
        async with companions(simulator, VEHICLES) as fleet:
            leader, followers = fleet[0], fleet[1:]
            names = {member.name for member in fleet}
            await until(
                lambda: all(m.driver.state.ready_to_arm and m.driver.state.home_position_ned_m for m in fleet)
            )
            # Everybody hears everybody else and nobody itself, each on a key of its own.
            await until(lambda: all({v.name for v in m.around().vehicles} == names - {m.name} for m in fleet))
            # The grid of the fleet, though each has its own local origin.
            second = next(v for v in leader.around().vehicles if v.name == "vehicle2")
            assert (
                abs(math.dist(second.position_ned_m[:2], leader.driver.state.position_ned_m[:2]) - 7.0) < 2.0
            )

            refused = await followers[0].command("formation line leader=nobody")
            until_s = time.monotonic() + 30.0
            while "heard are vehicle1" not in refused["reason"] and time.monotonic() < until_s:
                await asyncio.sleep(0.02)  # a pilot knows of its last turn what was heard
                refused = await followers[0].command("formation line leader=nobody")
            assert "the pose of nobody (none came; heard are vehicle1" in refused["reason"]
            taken_off = await asyncio.gather(*(member.command("takeoff 5") for member in fleet))
            assert all(outcome["success"] for outcome in taken_off), taken_off

            for member in followers:
                member.pilot.command(behaviour_for(parse("formation line leader=vehicle1 spacing=6")))

            def error_m(member):
                behaviour = member.pilot.behaviour
                formed = isinstance(behaviour, FormationBehaviour) and behaviour.note is not None
                return behaviour.note.error_m if formed and behaviour.slot_offset_ned_m else math.inf

            await until(lambda: max(map(error_m, followers)) < 1.0)

            def role():
                return leader.poses.message(leader.driver.state, None, time.monotonic_ns())["role"]

            await until(lambda: role() == "leader")
            least_m = []

            def watch():
                here = leader.driver.state.position_ned_m
                least_m.extend(math.dist(v.position_ned_m, here) for v in leader.around().vehicles)
                return flight.done()

            flight = asyncio.ensure_future(leader.command("goto forward=12 right=6 speed=2"))
            await until(watch)
            assert flight.result()["success"], flight.result()
            await until(lambda: max(map(error_m, followers)) < 1.0)
            assert min(least_m) > 3.0
            # A vehicle whose service ends is not heard any more, and its followers hold.
            await leader.bus.close()
            await until(lambda: all("is not heard" in m.pilot.status for m in followers))
            assert all(json.dumps(m.poses.status(time.monotonic_ns())) for m in fleet)
