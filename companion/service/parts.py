"""The parts that may be missing: autopilot, cameras, zenoh, its own clients. The service starts without.

Each has a state with a reason, for `status`, the page and the answers to commands, and none is given up.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import replace

from companion.bus.bodies.service import PartBody
from companion.bus.session import Bus
from companion.host.tasks import error_text, start_together
from companion.perception.cameras import WorkerCamera
from companion.perception.supervisor import PerceptionStartError, PerceptionUnavailableError
from companion.service.part import Part, PartState, part_of_camera
from companion.settings.perception import NO_SOURCE
from companion.settings.vehicle import VehicleSection
from companion.vehicle.driver import Driver, LinkError, LinkUnavailableError

logger = logging.getLogger(__package__)

AUTOPILOT, ZENOH = "autopilot", "zenoh"
NO_VEHICLE_TEXT = "there is no vehicle: vehicle.url is none"
# A link that cannot be opened is tried again after this time.
RETRY_S = 2.0
# A vehicle that is on answers within this time: until then nothing is reported.
_QUIET_S = 3.0
_POLL_S = 0.1


class Parts:
    """Connects and starts the parts, and knows their states.

    Args:
        on_event: called with (level, text) for the operator.
    """

    def __init__(
        self,
        settings: VehicleSection,
        driver: Driver,
        cameras: Sequence[WorkerCamera],
        bus: Bus,
        on_event: Callable[[str, str], None],
    ) -> None:
        self._driver, self._bus, self._on_event = driver, bus, on_event
        self._cameras = [camera for camera in cameras if camera.settings.source.uri != NO_SOURCE]
        self._has_vehicle = settings.expected
        self._link = Part(AUTOPILOT, PartState.STARTING)
        self._since: dict[str, Part] = {}
        self._clients: dict[str, Part] = {}
        self._been_up: set[str] = set()

    def on_client(self, name: str, problem: str, again: bool) -> None:
        """Note why a client that the service runs does not work; empty: it does. `again`: it is retried."""
        failed = PartState.RETRYING if again else PartState.FAILED
        self._clients[name] = Part(name, failed if problem else PartState.READY, problem)

    def now(self, now_ns: int) -> tuple[Part, ...]:
        """Return all parts, the autopilot first."""
        parts = [self._autopilot(now_ns)] if self._has_vehicle else []
        parts += [part_of_camera(camera) for camera in self._cameras]
        missing = self._bus.missing
        parts.append(Part(ZENOH, PartState.MISSING if missing else PartState.READY, missing))
        parts += self._clients.values()
        for index, part in enumerate(parts):
            before = self._since.get(part.name)
            since_ns = before.since_ns if before is not None and before.state is part.state else now_ns
            parts[index] = self._since[part.name] = replace(part, since_ns=since_ns)
            if part.up:
                self._been_up.add(part.name)
        return tuple(parts)

    def bodies(self, now_ns: int) -> list[PartBody]:
        """Return all parts as in `status`."""
        return [
            {
                "name": part.name,
                "state": part.state.value,
                "reason": part.reason,
                "since_ns": part.since_ns,
                "next_try_ns": part.next_try_ns,
            }
            for part in self.now(now_ns)
        ]

    def missing_text(self) -> str:
        """What is waited for, in one line; empty: nothing."""
        now_ns = time.monotonic_ns()
        waiting = [part.text(now_ns) for part in self.now(now_ns) if not part.up]
        return f"waiting for {'; '.join(waiting)}" if waiting else ""

    def no_vehicle(self) -> str | None:
        """Why no command can be flown, until the autopilot was found; None: it was."""
        if not self._has_vehicle:
            return NO_VEHICLE_TEXT
        if self._driver.link_count:
            return None
        return f"no autopilot yet: {self._link.reason or 'its heartbeat is awaited'}"

    async def run(self) -> None:
        """Connect to the autopilot and start the cameras, however long they are missing.

        Raises:
            PerceptionStartError: the settings of a camera are wrong. Never while the vehicle is armed.
        """
        await start_together(self._connect(), *map(self._start, self._cameras), self._announce())

    async def _connect(self) -> None:
        began_s = time.monotonic()
        while self._has_vehicle:
            try:
                await self._driver.connect(None, lambda reason: self._awaited(reason, began_s))
                return
            except LinkError as error:
                reason = str(error)
            except Exception as error:  # a fault of ours, for example with what was received
                reason = error_text(error)
                if reason != self._link.reason:
                    logger.exception("the connection to the autopilot has failed")
            self._note(
                Part(AUTOPILOT, PartState.RETRYING, reason, time.monotonic_ns() + round(RETRY_S * 1e9))
            )
            await asyncio.sleep(RETRY_S)

    def _awaited(self, reason: str, began_s: float) -> None:
        if time.monotonic() - began_s > _QUIET_S:
            self._note(Part(AUTOPILOT, PartState.MISSING, reason))

    def _note(self, part: Part) -> None:
        if part.reason != self._link.reason:
            self._on_event("warning", f"waiting for the autopilot: {part.reason}")
        self._link = part

    async def _start(self, camera: WorkerCamera) -> None:
        try:
            await camera.start()
        except PerceptionStartError as error:
            if self._driver.state.armed:
                self._on_event("error", f"{error}; the service ends after disarming")
                await self._disarmed()
            raise

    async def _disarmed(self) -> None:
        disarmed = asyncio.Event()
        unsubscribe = self._driver.subscribe(lambda state: None if state.armed else disarmed.set())
        try:
            await disarmed.wait()
        finally:
            unsubscribe()

    async def complete(self, within_s: float | None = None, *, autopilot: bool = True) -> None:
        """Wait until autopilot and cameras have been up.

        Args:
            autopilot: False: only the cameras.
            within_s: the time for the autopilot; a camera or a link that has failed once is an error then.
                None: without limit.

        Raises:
            LinkUnavailableError, PerceptionUnavailableError: with `within_s`, for autopilot and cameras.
        """
        deadline_s = None if within_s is None else time.monotonic() + within_s
        others = {ZENOH, *self._clients} | (set() if autopilot else {AUTOPILOT})
        while waiting := [
            part
            for part in self.now(time.monotonic_ns())
            if part.name not in self._been_up and part.name not in others
        ]:
            for part in waiting if deadline_s is not None else ():
                assert deadline_s is not None
                late = time.monotonic() > deadline_s and part.name == AUTOPILOT
                # Wrong settings are never tried again, and end `run`.
                failed = part.state is PartState.FAILED and part.next_try_ns is not None
                if late or failed or part.state is PartState.RETRYING:
                    error = LinkUnavailableError if part.name == AUTOPILOT else PerceptionUnavailableError
                    raise error(part.reason or f"{part.name}: not ready within {within_s:g} s")
            await asyncio.sleep(_POLL_S)

    async def _announce(self) -> None:
        await self.complete()
        others = {ZENOH, *self._clients}
        names = [part.name for part in self.now(time.monotonic_ns()) if part.name not in others]
        if names:
            self._on_event("info", f"up: {', '.join(names)}")

    def _autopilot(self, now_ns: int) -> Part:
        if not self._driver.link_count:
            return self._link
        if self._driver.state.connected(now_ns):
            return Part(AUTOPILOT, PartState.READY)
        return Part(AUTOPILOT, PartState.MISSING, "its heartbeat is lost")
