"""Driver, streamer and guidance loop with a simulator: the service without network and perception."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import AsyncIterator, Callable, Iterator, Mapping
from typing import Any

from pymavlink import mavutil

from companion.bench.lockstep_flight import plain_settings
from companion.guidance.behaviour import Outcome
from companion.guidance.core import Guidance
from companion.perception.cameras import PerceptionCamera
from companion.service.factory import driver_of, guidance_options
from companion.service.guidance_loop import GuidanceLoop
from companion.service.health import Health
from companion.service.inputs import InputAssembler
from companion.service.other_commanders import OtherCommanders
from companion.service.systemd_notify import SystemdNotifier
from companion.vehicle.streamer import Streamer

STATION = (245, 190)


class LiveFlight:
    """The service's parts for flight.

    Args:
        ran_s: its uptime at the start.

    Attributes:
        events: (level, text) of all events.
    """

    def __init__(
        self, kind: str, port: int, changes: Mapping[str, str] | None = None, *, ran_s: float = 0.0
    ) -> None:
        link = {"vehicle.driver": kind, "vehicle.url": f"udpin://127.0.0.1:{port}"}
        settings = plain_settings({"detector.enabled": "false", **link, **(changes or {})})
        self.driver = driver_of(settings)
        self.streamer = Streamer(self.driver.send_setpoint, clock_ns=self.driver.watch.now_ns)
        self.events: list[tuple[str, str]] = []
        self.guidance = Guidance(guidance_options(settings))
        self.inputs = InputAssembler(settings, [PerceptionCamera(settings.of_camera(None))], self._event)
        started_ns = time.monotonic_ns() - round(ran_s * 1e9)
        self.others = OtherCommanders(settings.vehicle, "here", started_ns, self._event)
        self._health = Health(self.driver, self.inputs, (), SystemdNotifier({}), self.others, self._event)
        self.loop = GuidanceLoop(
            self.guidance,
            self.inputs,
            self.driver,
            self.streamer,
            rate_hz=50.0,
            on_event=self._event,
            on_step=self.on_step,
            others=self.others,
        )

    def on_step(self, now_ns: int) -> None:
        """Called after every step of guidance."""
        self._health.after_step(now_ns, self.guidance)

    def _event(self, level: str, text: str) -> None:
        self.events.append((level, text))

    async def until(self, condition: Callable[[], object], timeout_s: float = 30.0) -> None:
        async with asyncio.timeout(timeout_s):
            while not condition():
                await asyncio.sleep(0.01)

    async def fly(self, text: str, timeout_s: float = 60.0) -> Outcome:
        """Execute a command and wait for its result."""
        reply = await asyncio.wait_for(self.loop.execute(text), timeout_s)
        return Outcome(reply["success"], reply["reason"])

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        unsubscribe = self.driver.subscribe(self.inputs.on_state)
        await self.driver.connect(20.0)
        runs = (self.loop.run(), self.streamer.run(), self._health.run())
        tasks = [asyncio.create_task(run) for run in runs]
        try:
            yield
        finally:
            self.loop.begin_shutdown()
            await self.loop.wait_released()
            unsubscribe()
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            await self.driver.close()


@contextlib.contextmanager
def ground_station(port: int) -> Iterator[Any]:
    """A second MAVLink client, a ground station on its own link."""
    station = mavutil.mavlink_connection(
        f"udpin:127.0.0.1:{port}", source_system=STATION[0], source_component=STATION[1]
    )
    with contextlib.closing(station):
        yield station
