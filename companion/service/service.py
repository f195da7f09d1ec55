"""The service put together: link, perception, guidance, streamer, bus; what is lost is said, and found again.

Everything here runs in one asyncio loop and nothing in it is heavy. The heartbeat and systemd's watchdog are
fed from the guidance loop, so whoever watches them watches the loop that steers.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from companion.bus import topics
from companion.bus.messages import (
    detections_message,
    labels_message,
    setpoint_message,
    tracks_message,
    vehicle_message,
)
from companion.bus.session import Bus
from companion.guidance import grammar
from companion.guidance.behaviour import Situation
from companion.guidance.envelope import Envelope
from companion.guidance.gimbal_hand import GimbalHand
from companion.guidance.obstacles import obstacles_message
from companion.guidance.pilot import Pilot
from companion.guidance.pilot_event import PilotEvent, PilotEventKind
from companion.guidance.pose_sharing import PoseSharing
from companion.guidance.targets import HistoryError, StateHistory
from companion.operator.console import run_console, terminal_is_free
from companion.operator.metrics import MetricsServer
from companion.perception.keeper import PerceptionKeeper, PerceptionStartError
from companion.perception.messages import Preview
from companion.perception.views import View, open_views
from companion.perception.views_markers import MarkerWatch
from companion.service.command_desk import CommandDesk
from companion.service.event import Event
from companion.service.parts import battery_minimum_of, driver_of, limits_of, obstacle_rules_of
from companion.service.status import status_message
from companion.service.systemd_notify import SystemdNotifier
from companion.settings import Settings
from companion.vehicle.driver import CommandRefusedError, Driver, SystemStatus
from companion.vehicle.state import FlightMode, VehicleState
from companion.vehicle.streamer import Streamer, StreamState
from vision.obstacle_sectors import ObstacleSectors
from vision.pipeline import PerceptionResult

logger = logging.getLogger(__package__)

_HEARTBEAT_PERIOD_S = 1.0
_HUD_PERIOD_S = 0.2
_EVENTS_KEPT = 100


class Service:
    """One vehicle's companion.

    Attributes:
        ready: everything is up, and commands are taken.
        views: the cameras with their models, the first one first.
        steering: the view whose targets behaviours see.

    Args:
        settings: all of them.
        on_event: called in the loop with every event, besides the log and the bus.
        console: take commands from the terminal as well.
    """

    def __init__(
        self, settings: Settings, *, on_event: Callable[[Event], None] | None = None, console: bool = False
    ) -> None:
        self.settings = settings
        self._on_event = on_event
        self._console = console
        self.events: deque[Event] = deque(maxlen=_EVENTS_KEPT)
        guidance = settings.guidance
        self.driver: Driver = driver_of(settings)
        self.streamer = Streamer(
            self.driver.send_setpoint, rate_hz=guidance.setpoint_rate_hz, brake_s=guidance.brake_s
        )
        self.pilot = Pilot(
            self.driver,
            self.streamer,
            Envelope(limits_of(settings)),
            on_event=self._pilot_event,
            class_names=self._class_names,
            lifetime_s=guidance.setpoint_lifetime_s,
            battery=battery_minimum_of(settings),
            obstacles=obstacle_rules_of(settings),
        )
        self._obstacles: ObstacleSectors | None = None
        self.views = open_views(settings, on_result=self._use, on_preview=self._show, on_event=self._event)
        self.steering = next(view for view in self.views if view.name == guidance.view)
        self.gimbal = GimbalHand(
            self.driver,
            self._event,
            carries_camera=any(view.settings.camera.gimbal for view in self.views),
            carries_steering=self.steering.settings.camera.gimbal,
            camera_pitch_rad=self.steering.settings.camera.mount().pitch_rad,
        )
        self._commands = CommandDesk(self.pilot, self.steering, self.gimbal, self._event, self._camera_pitch)
        self.poses = PoseSharing(settings.vehicle.name, self._event)
        self.markers = MarkerWatch(self.views)
        self._landing_target_ns = self._gimbal_ns = 0
        self._shown: tuple[FlightMode, bool] | None = None
        self.bus = Bus(
            settings.zenoh,
            settings.vehicle.name,
            on_event=self._event,
            on_command=self.command,
            views=tuple(settings.views),
            listeners=[(topics.POSE, self.poses.hear)],
        )
        self.ready = False
        self._told: dict[str, Any] | None = None
        self._notifier = SystemdNotifier()
        self._history = StateHistory()
        self._started_ns = time.monotonic_ns()
        self._linked = False
        self._seen = asyncio.Event()
        self._stop = asyncio.Event()
        self._ending = False

    async def run(self, ready: Callable[[], None] | None = None) -> None:
        """Start everything, call `ready`, and work until `stop()`; then let the autopilot hold and end.

        Raises:
            LinkError: no autopilot. PerceptionStartError: no model, classes or frames. BusError: no network.
            MetricsError: its library or its address is missing.
        """
        unsubscribe = self.driver.subscribe(self._take_state)
        tasks: list[asyncio.Task[None]] = []
        metrics: MetricsServer | None = None
        try:
            if self.settings.metrics.listen is not None:
                metrics = MetricsServer(self.settings.metrics.listen, lambda: self._told)
                self._event("info", f"metrics on port {metrics.port}")
            await self._start()
            loops = [self._guide(), self.streamer.run(), self._tell_vehicle(), self._tell_status()]
            if self._console and all(terminal_is_free(view.settings.source.uri) for view in self.views):
                loops.append(self._take_console())
            tasks = [asyncio.create_task(loop) for loop in loops]
            self._notifier.ready("flying" if self.driver.state.armed else "ready")
            self._event("info", f"ready: commands on {topics.command_key(self.settings.vehicle.name)}")
            self.ready = True
            if ready is not None:
                ready()
            try:
                await self._until_stopped(tasks)
            finally:
                try:
                    await self._leave()
                finally:
                    await self.gimbal.close()
        finally:
            self._notifier.stopping()
            unsubscribe()
            self.streamer.stop()
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            if metrics is not None:
                await asyncio.to_thread(metrics.close)
            await self.bus.close()  # first: it lets answers go out
            await asyncio.gather(*(view.keeper.stop() for view in self.views), self.driver.close())
            self._notifier.close()

    def stop(self) -> None:
        """End `run()`. In flight under our command, the autopilot is asked to hold first."""
        self._stop.set()

    async def command(self, text: str) -> dict[str, Any]:
        """Do what a command says; the reply tells how it ended: success, reason.

        A command without an end of its own (`hold`, `orbit` with no laps) is answered when it is under way.
        """
        if not self.ready or self._ending:
            reason = "the service is ending" if self._ending else "the service is still starting"
            return {"command": text, "success": False, "reason": reason}
        return await self._commands.do(text)

    async def _start(self) -> None:
        starts = [
            asyncio.create_task(self.bus.start()),
            asyncio.create_task(self.driver.connect(self.settings.vehicle.connect_timeout_s)),
            *(asyncio.create_task(_start(view)) for view in self.views),
        ]
        try:
            done, _ = await asyncio.wait(starts, return_when=asyncio.FIRST_EXCEPTION)
            for task in done:
                task.result()
        finally:
            for task in starts:
                task.cancel()
            await asyncio.gather(*starts, return_exceptions=True)

    async def _until_stopped(self, tasks: list[asyncio.Task[None]]) -> None:
        """Until `stop()`, or until a loop fails: one that steers must not die unseen."""
        stopped = asyncio.create_task(self._stop.wait())
        waiting: set[asyncio.Task[Any]] = {stopped, *tasks}
        try:
            while not stopped.done():
                done, waiting = await asyncio.wait(waiting, return_when=asyncio.FIRST_COMPLETED)
                for task in done:
                    task.result()  # the console may end (end of file); a failure is raised here
        finally:
            stopped.cancel()

    async def _leave(self) -> None:
        """Take no more commands; a vehicle that flies our setpoints goes to the autopilot's own hold."""
        self._ending = True
        self._commands.overtake("the end of the service")
        flying = self.streamer.state is not StreamState.SILENT
        self.pilot.close("the service ends")
        if not flying or not self.driver.state.connected(time.monotonic_ns()):
            return
        try:
            await self.driver.set_mode(FlightMode.HOLD, timeout_s=2.0)
        except CommandRefusedError as error:
            self._event("error", f"leaving: {error}; the autopilot's offboard-loss failsafe takes over")

    async def _take_console(self) -> None:
        """The terminal is a convenience: whatever goes wrong there, the flight goes on."""
        try:
            await run_console(self.command, self.stop, grammar.describe())
        except Exception as error:
            logger.exception("the console failed")
            self._event("warning", f"the console has ended: {type(error).__name__}: {error}")

    async def _guide(self) -> None:
        """The loop that steers; the heartbeat, the watchdog and the video's text go with it.

        It turns at the guidance rate, and at once when the steering camera has seen something new.
        """
        period_s = 1 / self.settings.guidance.rate_hz
        next_heartbeat_s = next_hud_s = time.monotonic()
        seen = False
        while True:
            now_ns = time.monotonic_ns()
            self._watch_link(now_ns)
            self.pilot.update(self._situation(now_ns))
            self.gimbal.update(now_ns, self.driver.state, self.pilot.behaviour)
            self._tell_landing_target()
            if seen:
                self.streamer.hasten(now_ns)
            flown = self.driver.state.mode is FlightMode.OFFBOARD and self.streamer.state is StreamState.FRESH
            self._commands.answer_under_way(flown)
            now_s = now_ns / 1e9
            if now_s >= next_heartbeat_s:
                next_heartbeat_s = now_s + _HEARTBEAT_PERIOD_S
                self.driver.send_heartbeat(
                    SystemStatus.ACTIVE if self._healthy(now_ns) else SystemStatus.CRITICAL
                )
                self._notifier.alive()
            if now_s >= next_hud_s:
                next_hud_s = now_s + _HUD_PERIOD_S
                for view in self.views:
                    view.keeper.send_hud(self._hud())
            seen = await self._something_new_until(now_s + period_s)

    async def _something_new_until(self, due_s: float) -> bool:
        """Whether the steering camera saw something before that time (CLOCK_MONOTONIC seconds)."""
        try:
            async with asyncio.timeout(due_s - time.monotonic()):
                await self._seen.wait()
        except TimeoutError:
            return False
        self._seen.clear()
        return True

    async def _tell_vehicle(self) -> None:
        period_s = 1 / (topics.VEHICLE.rate_hz or 10.0)
        while True:
            now_ns = time.monotonic_ns()
            self.bus.publish(topics.VEHICLE, vehicle_message(self.driver.state, now_ns))
            pose = self.poses.message(self.driver.state, self.pilot.behaviour, now_ns)
            if pose is not None:
                self.bus.publish(topics.POSE, pose)
            for view in self.views:
                view.keeper.watch(self.bus.watched(topics.IMAGE, view.name))
            if self.pilot.in_command:
                self.bus.publish(
                    topics.SETPOINT,
                    {
                        "stamp_ns": now_ns,
                        "asked": setpoint_message(self.pilot.asked),
                        "sent": setpoint_message(self.streamer.last_sent),
                        "sent_ns": self.streamer.last_sent_ns,
                        "stream": self.streamer.state.value,
                        "limited_by": list(self.pilot.limited_by),
                    },
                )
            await asyncio.sleep(period_s)

    async def _tell_status(self) -> None:
        while True:
            self._told = status = self.status()
            self.bus.publish(topics.STATUS, status)
            self._notifier.status(f"{status['vehicle']['mode']}, {status['pilot']['behaviour']}")
            await asyncio.sleep(1 / (topics.STATUS.rate_hz or 1.0))

    def status(self) -> dict[str, Any]:
        """How every part is, as published on `status`."""
        now_ns = time.monotonic_ns()
        return status_message(
            now_ns,
            uptime_s=(now_ns - self._started_ns) / 1e9,
            healthy=self._healthy(now_ns),
            state=self.driver.state,
            pilot=self.pilot,
            streamer=self.streamer,
            views=self.views,
            steering=self.steering,
            poses=self.poses,
            gimbal=self.gimbal.status(now_ns, self.driver.state),
            bus=self.bus,
        )

    def _situation(self, now_ns: int) -> Situation:
        age_s = self.steering.age_s(now_ns)
        gimbal = self.gimbal.sight(now_ns, self.driver.state)
        # What the camera sees is of no use while nobody knows where it looks.
        fresh = age_s is not None and age_s <= self.settings.guidance.perception_max_age_s
        fresh = fresh and not gimbal.undirected
        return Situation(
            now_ns,
            self.driver.state,
            self.steering.targets if fresh else (),
            age_s,
            fresh,
            self._obstacles,
            self.streamer.last_sent,
            neighbourhood=self.poses.around(self.driver.state, now_ns),
            min_separation_m=self.settings.guidance.min_separation_m,
            markers=self.markers.sight(now_ns, self.settings.guidance.perception_max_age_s),
            gimbal=gimbal,
            ranging=self.steering.ranging(self._camera_pitch()),
        )

    def _camera_pitch(self) -> float:
        """Of the steering camera above the horizon, radians, with the vehicle level."""
        camera, gimbal = self.steering.settings.camera, self.driver.state.gimbal
        held_rad = gimbal.pitch_rad if camera.gimbal and gimbal is not None else None
        return math.radians(camera.mount_pitch_deg) + (held_rad or 0.0)

    def _tell_landing_target(self) -> None:
        """What the autopilot lands on by itself, once for every picture that shows it."""
        behaviour = self.pilot.behaviour
        target = None if behaviour is None else behaviour.landing_target
        if target is not None and target.captured_ns > self._landing_target_ns:
            self._landing_target_ns = target.captured_ns
            self.driver.send_landing_target(target)

    def _healthy(self, now_ns: int) -> bool:
        return all(view.seeing(now_ns) for view in self.views) and self.driver.state.connected(now_ns)

    def _watch_link(self, now_ns: int) -> None:
        linked = self.driver.state.connected(now_ns)
        if linked != self._linked:
            self._linked = linked
            if linked:
                self._event("info", "the autopilot is heard")
            else:
                self._event("error", "the autopilot is not heard any more")

    def _take_state(self, state: VehicleState) -> None:
        """Remember where the vehicle was; the trackers want to know where their cameras looked."""
        if (state.mode, state.armed) != self._shown:
            self._shown = (state.mode, state.armed)
            # Whoever changed it, it is not the vehicle that a waiting command was given to.
            now = f"{state.mode.value}, {'armed' if state.armed else 'disarmed'}"
            self._commands.overtake(f"a change of the vehicle (now {now})")
        self._history.add(state)
        if state.attitude is not None:
            for view in self.views:
                view.keeper.send_attitude(state.attitude_ns, state.attitude, state.altitude_m)
        gimbal = state.gimbal
        if gimbal is None or gimbal.attitude_ns == self._gimbal_ns or gimbal.attitude is None:
            return
        self._gimbal_ns = gimbal.attitude_ns
        with contextlib.suppress(HistoryError):
            attitude = self._history.gimbal_at(gimbal.attitude_ns)
            for view in self.views:
                if view.settings.camera.gimbal:
                    view.keeper.send_gimbal(gimbal.attitude_ns, attitude)

    def _use(self, view: View, result: PerceptionResult) -> None:
        """Work out where what a view saw is, if that view steers; publish it, when it has been steered by."""
        markers = None
        try:
            if result.markers is not None:
                name, now_ns = self.settings.vehicle.name, time.monotonic_ns()
                markers = self.markers.take(view, result, self._history, name, now_ns)
                self._seen.set()
            if view is self.steering:
                view.place(result, self._history)
                if result.obstacles is not None:
                    self._obstacles = result.obstacles
                self._seen.set()
        finally:
            # The guidance loop wakes before it: a subscriber can wait for a millisecond, a setpoint not.
            asyncio.get_running_loop().call_soon(self._publish, view, result, markers)

    def _publish(self, view: View, result: PerceptionResult, markers: dict[str, Any] | None) -> None:
        try:
            self._publish_all(view, result, markers)
        except Exception as error:
            # It was flown by, and that goes on; that nobody hears of it must not pass in silence.
            logger.exception("a detection message could not be published")
            view.unplaced = f"{type(error).__name__}: {error}"

    def _publish_all(self, view: View, result: PerceptionResult, markers: dict[str, Any] | None) -> None:
        name, now_ns = self.settings.vehicle.name, time.monotonic_ns()
        message = detections_message(result, name, now_ns, view.name, self.driver.state.clock)
        self.bus.publish(topics.DETECTIONS, message, view.name)
        self.bus.publish(topics.LABELS, labels_message(result), view.name)
        if result.track_events:
            self.bus.publish(topics.TRACKS, tracks_message(result, name, now_ns, view.name), view.name)
        if markers is not None:
            self.bus.publish(topics.MARKERS, {**markers, "published_ns": now_ns}, view.name)
        if view is self.steering and result.obstacles is not None:
            self.bus.publish(topics.OBSTACLES, obstacles_message(result.obstacles, name))
        view.keeper.published(result)

    def _show(self, view: View, preview: Preview) -> None:
        """A picture for whoever watches; what it is of goes with it."""
        stamps = {"view": view.name, "sequence": preview.sequence, "captured_ns": preview.captured_ns}
        self.bus.publish_picture(topics.IMAGE, preview.jpeg, stamps, view.name)

    def _class_names(self) -> tuple[str, ...] | None:
        """What the steering detector knows; None while there is none to ask."""
        return self.steering.class_names

    @property
    def perception(self) -> PerceptionKeeper:
        """Of the steering view."""
        return self.steering.keeper

    def _hud(self) -> tuple[str, ...]:
        state: VehicleState = self.driver.state
        altitude = "-" if state.altitude_m is None else f"{state.altitude_m:.1f} m"
        speed = state.velocity_ned_mps
        horizontal = "-" if speed is None else f"{(speed[0] ** 2 + speed[1] ** 2) ** 0.5:.1f} m/s"
        return (
            f"{state.mode.value}  {'armed' if state.armed else 'disarmed'}",
            self.pilot.status,
            f"height {altitude}  speed {horizontal}",
        )

    def _pilot_event(self, event: PilotEvent) -> None:
        lost = event.kind in (PilotEventKind.LOST, PilotEventKind.BATTERY, PilotEventKind.BLIND)
        if event.kind in (PilotEventKind.LOST, PilotEventKind.BATTERY):
            self._commands.overtake(f"an event ({event.message})")
        # What is refused or ended is told with the command's own outcome.
        if event.kind not in (PilotEventKind.REFUSED, PilotEventKind.ENDED, PilotEventKind.STARTED):
            self._event("warning" if lost else "info", event.message)

    def _event(self, level: str, text: str) -> None:
        event = Event(time.monotonic_ns(), level, text)
        self.events.append(event)
        logger.log(getattr(logging, level.upper()), "%s", text)
        self.bus.publish(topics.EVENTS, asdict(event))
        if self._on_event is not None:
            self._on_event(event)


async def _start(view: View) -> None:
    """Start a view; its name goes into what it says when it cannot."""
    try:
        await view.keeper.start()
    except PerceptionStartError as error:
        if view.name is None:
            raise
        raise PerceptionStartError(f"view {view.name}: {error}") from error
