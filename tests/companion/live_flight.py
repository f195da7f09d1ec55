"""Driver, streamer and guidance loop before a simulator: the service without network and pictures."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Callable, Iterator
from typing import Any

from pymavlink import mavutil

from companion.guidance.behaviour import Outcome, Situation
from companion.guidance.envelope import Envelope
from companion.guidance.grammar import parse
from companion.guidance.pilot import Pilot
from companion.guidance.pilot_event import PilotEvent
from companion.guidance.registry import behaviour_for
from companion.vehicle.drivers import open_driver
from companion.vehicle.streamer import Streamer

STATION = (245, 190)


class LiveFlight:
    """The parts that fly, as the service runs them; `guide` says what the pilot knows."""

    def __init__(self, kind: str, port: int) -> None:
        self.driver = open_driver(kind, f"udpin://127.0.0.1:{port}")
        self.streamer = Streamer(self.driver.send_setpoint)
        self.events: list[PilotEvent] = []
        self.pilot = Pilot(self.driver, self.streamer, Envelope(), on_event=self.events.append)

    def turn(self, now_ns: int) -> None:
        """One turn of the guidance loop."""
        self.pilot.update(Situation(now_ns, self.driver.state))

    async def close(self) -> None:
        """After the loops have ended."""
        await self.driver.close()

    async def until(self, condition: Callable[[], object], timeout_s: float = 30.0) -> None:
        async with asyncio.timeout(timeout_s):
            while not condition():
                await asyncio.sleep(0.01)

    async def fly(self, text: str, timeout_s: float = 60.0) -> Outcome:
        return await asyncio.wait_for(self.pilot.command(behaviour_for(parse(text))), timeout_s)

    async def _guide(self) -> None:
        while True:
            self.turn(time.monotonic_ns())
            await asyncio.sleep(0.02)

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        await self.driver.connect(20.0)
        tasks = [asyncio.create_task(self._guide()), asyncio.create_task(self.streamer.run())]
        try:
            yield
        finally:
            self.pilot.close()
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            await self.close()


@contextlib.contextmanager
def ground_station(port: int) -> Iterator[Any]:
    """A second MAVLink client, on the ground station's link: a pilot's."""
    station = mavutil.mavlink_connection(
        f"udpin:127.0.0.1:{port}", source_system=STATION[0], source_component=STATION[1]
    )
    with contextlib.closing(station):
        yield station
