"""The service: link, perception, guidance, streamer and bus. It starts without the parts that are missing.

Everything here runs in one asyncio loop and nothing in it is heavy.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from functools import partial
from typing import Any

from companion.bus import topics
from companion.bus.bodies.service import StatusBody
from companion.bus.listeners import Listener
from companion.bus.messages import Localization
from companion.bus.session import Bus
from companion.bus.status_message import status_message
from companion.guidance.core import Guidance
from companion.host.tasks import keep_running, run_until
from companion.operator.console import Ask, run_console, terminal_is_free
from companion.operator.metrics import MetricsServer
from companion.perception.cameras import WorkerCamera, open_cameras
from companion.perception.supervisor import PerceptionSupervisor
from companion.recording.tap import FlightTap, run_record
from companion.service.event import Event, EventLog
from companion.service.factory import clients_of, driver_of, gimbal_mounting, guidance_options, streamer_of
from companion.service.guidance_loop import GuidanceLoop
from companion.service.health import Health
from companion.service.inputs import InputAssembler
from companion.service.live_settings import LiveSettings
from companion.service.other_commanders import OtherCommanders
from companion.service.parts import Parts
from companion.service.publisher import Publisher, localization_of
from companion.service.queries import Queries
from companion.service.systemd_notify import SystemdNotifier
from companion.settings import Settings
from companion.vehicle.driver import Driver
from companion.vehicle.state import VehicleState
from vision.pipeline import PerceptionResult


class Service:
    """The companion service of one vehicle.

    Attributes:
        ready: commands are answered. parts: autopilot and cameras, which may still be missing.
        cameras: the cameras with their models, the first one first.
        events: the newest, at most a hundred. target: how a console in this process reaches it.

    Args:
        settings: all of them.
        on_event: called in the loop with every event, besides the log and the bus.
        console: also accept commands from the terminal. ask: answers plain sentences there.
        dropped_lines: returns the number of dropped log lines, for `status`.

    >>> from companion import Service, Settings
    >>> service = Service(Settings())  # connects to nothing before `run`
    >>> service.ready, list(service.events)
    (False, [])
    """

    def __init__(
        self,
        settings: Settings,
        *,
        on_event: Callable[[Event], None] | None = None,
        console: bool = False,
        ask: Ask | None = None,
        dropped_lines: Callable[[], int] = lambda: 0,
    ) -> None:
        self.settings, self._console, self._ask, self._dropped_lines = settings, console, ask, dropped_lines
        log = EventLog(lambda event: self.bus.publish(topics.EVENTS, event), on_event)
        self.events, self._event = log.newest, log.add
        self.driver: Driver = driver_of(settings, lambda sent, data: self._tap.on_bytes(sent, data))
        self.streamer = streamer_of(settings, self.driver.send_setpoint, self.driver.watch.now_ns)
        self.guidance = Guidance(guidance_options(settings))
        self.cameras = open_cameras(
            settings,
            on_result=self._on_result,
            on_preview=lambda camera, preview: self._publisher.publish_preview(camera, preview),
            on_event=self._event,
            on_calibration=self._on_calibration,
        )
        self.inputs = InputAssembler(settings, self.cameras, self._event)
        identity = self.inputs.poses.source
        self.others = OtherCommanders(settings.vehicle, identity, time.monotonic_ns(), self._event)
        self._live = LiveSettings(settings, self.driver, self.inputs, self.cameras, self._event)
        self._queries = Queries(self._live, self.status, self.driver)
        self.target = self._queries.target(self.command)
        self.bus = Bus(
            settings.zenoh,
            settings.vehicle.name,
            on_event=self._event,
            on_command=self.command,
            queries=self._queries.handlers(self.cameras),
            on_settings=self._live.answer,
            views=tuple(settings.cameras),
            listeners=[
                Listener(topics.POSE, self.inputs.poses.on_message),
                Listener(topics.STATUS, self.others.on_status),
                Listener(topics.VELOCITY, self.inputs.velocities.on_message, settings.vehicle.name),
            ],
        )
        self.parts = Parts(settings.vehicle, self.driver, self.cameras, self.bus, self._event)
        record = run_record(settings, self.guidance.options, identity)
        self._tap = FlightTap(self.bus, record, expected=bool(settings.recording.directory))
        self._publisher = Publisher(settings.vehicle.name, self.bus, self.driver, self.inputs, self._queries)
        self._loop = GuidanceLoop(
            *(self.guidance, self.inputs, self.driver, self.streamer),
            rate_hz=settings.guidance.rate_hz,
            on_event=self._event,
            on_step=lambda now_ns: self._health.after_step(now_ns, self.guidance),
            others=self.others,
            no_vehicle=self.parts.no_vehicle,
            record=self._tap.on_step,
            on_command_state=lambda state: self.bus.publish(topics.COMMAND_STATE, state),
        )
        self._notifier = SystemdNotifier()
        self._health = Health(
            *(self.driver, self.inputs, self.cameras, self._notifier, self.others, self._event),
            has_vehicle=settings.vehicle.expected,
        )
        self.ready = self._ending = False
        self._status: StatusBody | None = None
        self._stop = asyncio.Event()

    async def run(self, ready: Callable[[], object] = lambda: None) -> None:
        """Open the bus, call `ready`, start the parts, run until `stop()`; then let the autopilot hold.

        Raises:
            PerceptionStartError: wrong settings, see `PerceptionSupervisor.start`; never while armed.
            BusError: zenoh cannot listen. MetricsError: no library, or its address is not available.
        """
        async with clients_of(self.settings, self._event, self.parts.on_client):
            self._tap.start()
            await self._run(ready)

    async def _run(self, ready: Callable[[], object]) -> None:
        unsubscribe = self.driver.subscribe(self._on_state)
        tasks: list[asyncio.Task[None]] = []
        metrics: MetricsServer | None = None
        try:
            if self.settings.metrics.listen is not None:
                metrics = MetricsServer(self.settings.metrics.listen, lambda: self._status)
                self._event("info", f"metrics on port {metrics.port}")
            await self.bus.start()
            loops = [self._loop.run(), self.streamer.run(), self.parts.run(), self._health.run()]
            publish = partial(self._publisher.publish_vehicle, self.guidance, self.streamer, self.cameras)
            loops.append(keep_running("status", self._publish_status, self._event))
            loops.append(keep_running("vehicle messages", publish, self._event))
            if self._console and all(terminal_is_free(camera.settings.source.uri) for camera in self.cameras):
                loops.append(run_console({"": self.target}, self.stop, self._event, self._ask))
            tasks = [asyncio.create_task(loop) for loop in loops]
            self._notifier.ready("ready")
            self._event("info", f"ready: commands on {topics.command_key(self.settings.vehicle.name)}")
            self.ready = True
            ready()
            try:
                await run_until(self._stop, tasks)
            finally:
                self._ending = True
                await self._loop.shut_down()
        finally:
            self._notifier.stopping()
            unsubscribe()
            self.streamer.stop()
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            if metrics is not None:
                await asyncio.to_thread(metrics.close)
            await asyncio.to_thread(self._tap.close)
            await self.bus.close()  # first: it sends pending answers
            await asyncio.gather(*(camera.supervisor.stop() for camera in self.cameras), self.driver.close())
            self._notifier.close()

    def stop(self) -> None:
        """End `run()`. In flight under our command, HOLD is requested first."""
        self._stop.set()

    async def command(self, text: str) -> dict[str, Any]:
        """Execute a command; returns its result: id, success, reason.

        An endless command (`hold`) is answered when it is in progress; its end comes on `command_state`.
        """
        if not self.ready or self._ending:
            reason = "the service is shutting down" if self._ending else "the service is still starting"
            return {"command": text, "success": False, "reason": reason}
        return await self._loop.execute(text)

    def status(self) -> StatusBody:
        """The state of every part, as published on `status`."""
        now_ns = time.monotonic_ns()
        return status_message(
            now_ns,
            uptime_s=self.others.uptime_s(now_ns),
            unhealthy=self._health.unhealthy(now_ns),
            parts=self.parts.bodies(now_ns),
            driver=self.driver,
            guidance=self.guidance,
            streamer=self.streamer,
            cameras=self.cameras,
            steering=self.inputs.steering,
            poses=self.inputs.poses,
            parameters=self.inputs.parameters,
            bus=self.bus,
            others=self.others.status(self.driver.state, now_ns),
            dropped_lines=self._dropped_lines(),
            changed_settings=self._live.changes(),
        )

    @property
    def perception(self) -> PerceptionSupervisor:
        """The supervisor of the steering camera."""
        return next(camera for camera in self.cameras if camera is self.inputs.steering).supervisor

    async def _publish_status(self) -> None:
        while True:
            self._status = status = self.status()
            self.bus.publish(topics.STATUS, status)
            self._publisher.publish_cameras(self.cameras)
            flown = f"{self.driver.state.mode.value}, {self.guidance.status}"
            self._notifier.status(self.parts.missing_text() or flown)
            await self._publisher.wait_status_due()

    def _on_state(self, state: VehicleState) -> None:
        self.inputs.on_state(state)
        for camera in self.cameras:
            camera.send_state(state, self.inputs.history)

    def _on_calibration(self) -> None:
        sections = [camera.settings.camera for camera in self.cameras]
        self.guidance.gimbal.mounting = gimbal_mounting(sections, self.inputs.steering.settings.camera)

    def _on_result(self, camera: WorkerCamera, result: PerceptionResult) -> None:
        """Localize a camera's result, let guidance use it, then publish it."""
        markers, localization = None, Localization(error="failed")
        try:
            markers = self.inputs.on_result(camera, result)
            if markers is not None and markers.vision is not None:
                self.driver.send_vision_position(markers.vision)
            localization = localization_of(camera)
            if camera is self.inputs.steering or markers is not None:
                self._loop.on_perception()
        finally:
            # The guidance loop runs first: a subscriber can wait for a millisecond, a setpoint cannot.
            publish = self._publisher.publish_result
            asyncio.get_running_loop().call_soon(publish, camera, result, markers, localization)
