"""Several vehicles in one process, each with its own driver, guidance, zenoh session and keys."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import socket
import time
from collections.abc import AsyncIterator, Callable
from typing import Any

import pytest

from companion.bus import topics
from companion.bus.listeners import Listener
from companion.bus.session import Bus
from companion.bus.vehicle_messages import pose_message
from companion.guidance.behaviours.formation import FormationBehaviour
from companion.guidance.formation.neighbours import Neighbourhood
from companion.settings import ZenohSection
from mavlink_sim.testing import QUICK_FLIGHT, FleetMember, RunningSimulator, free_port, running_simulator
from tests.companion.guidance.guidance_harness import known
from tests.companion.live_flight import LiveFlight

pytestmark = pytest.mark.realtime


class Companion:
    """The service of one vehicle, without a camera."""

    def __init__(self, name: str, member: FleetMember, zenoh_port: int, known_ports: list[int]) -> None:
        self.name = name
        changes = {"vehicle.name": name, "vehicle.system_id": f"{member.system_id}"}
        self.flight = LiveFlight("pymavlink", member.onboard_port, changes)
        self.driver, self.guidance = self.flight.driver, self.flight.guidance
        self.poses = self.flight.inputs.poses
        self.bus = Bus(
            ZenohSection(
                connect=tuple(f"tcp/127.0.0.1:{port}" for port in known_ports),
                listen=(f"tcp/127.0.0.1:{zenoh_port}",),
            ),
            name,
            on_event=lambda level, text: None,
            on_command=self.flight.loop.execute,
            listeners=[Listener(topics.POSE, self.poses.on_message)],
        )

    async def command(self, text: str) -> dict[str, Any]:
        return await self.flight.loop.execute(text)

    def neighbourhood(self) -> Neighbourhood:
        return self.poses.neighbourhood(self.driver.state, time.monotonic_ns())

    async def publish(self) -> None:
        while True:
            pose = self.poses.pose(
                self.driver.state,
                None if self.guidance.behaviour is None else self.guidance.behaviour.note,
                time.monotonic_ns(),
                in_command=self.guidance.in_command,
            )
            if pose is not None:
                self.bus.publish(topics.POSE, pose_message(pose))
            await asyncio.sleep(0.1)


@contextlib.asynccontextmanager
async def companions(simulator: RunningSimulator, count: int) -> AsyncIterator[list[Companion]]:
    ports: list[int] = []
    members = []
    for index, vehicle in enumerate(simulator.vehicles[:count]):
        port = free_port(socket.SOCK_STREAM)
        members.append(Companion(f"vehicle{index + 1}", vehicle, port, ports.copy()))
        ports.append(port)
    async with contextlib.AsyncExitStack() as stack:
        for member in members:
            await member.bus.start()
            stack.push_async_callback(member.bus.close)
        for member in members:
            await stack.enter_async_context(member.flight.running())
        publishing = [asyncio.create_task(member.publish()) for member in members]
        try:
            yield members
        finally:
            for task in publishing:
                task.cancel()
            await asyncio.gather(*publishing, return_exceptions=True)


async def until(condition: Callable[[], object], timeout_s: float = 60.0) -> None:
    async with asyncio.timeout(timeout_s):
        while not condition():
            await asyncio.sleep(0.02)


@pytest.mark.parametrize("vehicles", [2, pytest.param(5, marks=pytest.mark.slow)])
async def test_vehicles_share_poses_and_fly_in_formation(vehicles: int) -> None:
    with running_simulator(
        vehicles=vehicles, spacing=7.0, ready_after=0.0, parameters=QUICK_FLIGHT
    ) as simulator:
        async with companions(simulator, vehicles) as fleet:
            leader, followers = fleet[0], fleet[1:]
            names = {member.name for member in fleet}
            await until(
                lambda: all(m.driver.state.ready_to_arm and m.driver.state.home_position_ned_m for m in fleet)
            )
            # Every vehicle receives all others, but not itself, each on its own key.
            await until(
                lambda: all({v.name for v in m.neighbourhood().vehicles} == names - {m.name} for m in fleet)
            )
            # Positions of the fleet's grid, although each has its own local origin.
            second = next(v for v in leader.neighbourhood().vehicles if v.name == "vehicle2")
            first_ned_m = known(leader.driver.state.position_ned_m)
            assert abs(math.dist(second.position_ned_m[:2], first_ned_m[:2]) - 7.0) < 2.0

            refused = await followers[0].command("formation line leader=nobody")
            until_s = time.monotonic() + 30.0
            while "vehicle1" not in refused["reason"] and time.monotonic() < until_s:
                await asyncio.sleep(0.02)
                refused = await followers[0].command("formation line leader=nobody")
            assert "nobody" in refused["reason"]
            taken_off = await asyncio.gather(*(member.command("takeoff 3") for member in fleet))
            assert all(outcome["success"] for outcome in taken_off), taken_off

            formed = [member.command("formation line leader=vehicle1 spacing=6") for member in followers]
            assert all(reply["success"] for reply in await asyncio.gather(*formed))

            def error_m(member: Companion) -> float:
                behaviour = member.guidance.behaviour
                if not isinstance(behaviour, FormationBehaviour) or behaviour.note is None:
                    return math.inf
                return behaviour.note.error_m if behaviour.slot_offset_ned_m else math.inf

            await until(lambda: max(map(error_m, followers)) < 1.0)

            def role() -> object:
                now_ns = time.monotonic_ns()
                pose = known(leader.poses.pose(leader.driver.state, None, now_ns, in_command=True))
                return pose_message(pose)["role"]

            await until(lambda: role() == "leader")
            least_m: list[float] = []

            def watch() -> bool:
                here = known(leader.driver.state.position_ned_m)
                least_m.extend(math.dist(v.position_ned_m, here) for v in leader.neighbourhood().vehicles)
                return flight.done()

            flight = asyncio.ensure_future(leader.command("goto forward=6 right=3 speed=2"))
            await until(watch)
            assert flight.result()["success"], flight.result()
            await until(lambda: max(map(error_m, followers)) < 1.0)
            assert min(least_m) > 3.0
            # When a service ends, its poses stop and its followers hold.
            await leader.bus.close()
            await until(lambda: all("no pose" in m.guidance.status for m in followers))
            assert all(json.dumps(m.poses.ages_s(time.monotonic_ns())) for m in fleet)
