"""The guidance loop: exchanges data between guidance, streamer, driver and command sources.

The heartbeat and systemd's watchdog are triggered from here, so they supervise this loop.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import Any

from companion.bus.bodies.service import CommandStateBody
from companion.guidance.core import Guidance
from companion.guidance.gimbal.controller import ENDING
from companion.guidance.interface import EventKind, GuidanceInput, GuidanceOutput, StreamStatus
from companion.guidance.mode_control import Phase
from companion.host.clock import Standstill
from companion.recording.guidance_record import StepContext
from companion.service.command_handler import CommandHandler
from companion.service.inputs import InputAssembler
from companion.service.other_commanders import OtherCommanders
from companion.service.requests import RequestRunner, apply_output
from companion.service.slow_updates import SlowUpdates
from companion.vehicle.driver import CommandRefusedError, Driver, TakenOverError
from companion.vehicle.setpoint_loss import setpoint_loss_outcome, without_service_text
from companion.vehicle.state import FlightMode, LandedState, VehicleState
from companion.vehicle.streamer import Streamer, StreamState

# Reported with the command's own result.
_ANSWERED = (EventKind.REFUSED, EventKind.ENDED, EventKind.STARTED)
# How long the shutdown waits for the release of resources such as gimbal control.
RELEASE_TIMEOUT_S = 3.0
_HEARTBEAT_S = 1.2  # autopilots send one a second


def mode_at_shutdown(state: VehicleState, phase: Phase, stream: StreamState) -> FlightMode | None:
    """The mode to request at shutdown; None: none, since the mode is a pilot's or the autopilot's.

    HOLD for a vehicle that flies our setpoints. Where OFFBOARD is only requested, the mode that shows, so
    that it remains.
    """
    if stream is StreamState.SILENT:
        return None
    engaging = phase is Phase.ENGAGING
    if state.mode is FlightMode.OFFBOARD or (engaging and state.mode is FlightMode.TAKEOFF):
        return FlightMode.HOLD
    return state.mode if engaging and state.mode is not FlightMode.UNKNOWN else None


class GuidanceLoop:
    """Steps guidance at its rate, and at once on new input.

    Args:
        rate_hz: of guidance.
        on_event: called with (level, text). on_step: called after every step with its time.
        others: that command the vehicle. no_vehicle: returns why no command can be flown, or None.
        record: called with time, context, input and output of every step.
        on_command_state: called with every state of every command.
    """

    def __init__(
        self,
        guidance: Guidance,
        inputs: InputAssembler,
        driver: Driver,
        streamer: Streamer,
        *,
        rate_hz: float,
        on_event: Callable[[str, str], None],
        on_step: Callable[[int], None],
        others: OtherCommanders,
        no_vehicle: Callable[[], str | None] = lambda: None,
        record: Callable[[int, StepContext, GuidanceInput, GuidanceOutput], None] = lambda *step: None,
        on_command_state: Callable[[CommandStateBody], None] = lambda _: None,
    ) -> None:
        self.guidance, self._inputs = guidance, inputs
        self._driver, self._streamer = driver, streamer
        self._period_s = 1 / rate_hz
        self._on_event, self._on_step, self._record = on_event, on_step, record
        self._wake = asyncio.Event()
        self._requests = RequestRunner(driver, self._wake.set)
        self._commands = CommandHandler(
            lambda identifier, text: inputs.read_command(
                identifier, text, driver.state, guidance.check_requirements
            ),
            inputs.select,
            self._wake.set,
            on_event,
            check_requirements=lambda command: (
                no_vehicle()
                or others.check_requirements(
                    command, driver.state, in_command=guidance.in_command, now_ns=time.monotonic_ns()
                )
            ),
            on_state=on_command_state,
            service=inputs.poses.source,
        )
        self._running = self._ending = self._seen = False
        self._slow = SlowUpdates(on_event)

    async def execute(self, text: str) -> dict[str, Any]:
        """Execute a command; see `Service.command`."""
        return await self._commands.execute(text)

    def on_perception(self) -> None:
        """Step on a new perception result, and send the resulting setpoint at once."""
        self._seen = True
        self._wake.set()

    async def run(self) -> None:
        """Run until cancelled."""
        self._running = True
        try:
            while True:
                now_ns = time.monotonic_ns()
                seen, self._seen = self._seen, False
                self._step(now_ns)
                if seen:
                    self._streamer.send_now(now_ns)
                self._on_step(now_ns)
                await self._wait_for_input_until(now_ns / 1e9 + self._period_s)
        finally:
            self._running = False
            self._driver.watch.end_of_loop()

    async def shut_down(self) -> None:
        """Accept no more commands; switch a vehicle that flies our setpoints to the autopilot's HOLD.

        One that we have armed and that is still on the ground is disarmed instead.
        """
        state = self._driver.state
        on_ground = self.guidance.armed_on_ground and state.landed is LandedState.ON_GROUND
        mode = mode_at_shutdown(state, self.guidance.phase, self._streamer.state)
        try:
            self.begin_shutdown()
        finally:
            self._streamer.stop()
            try:
                if self._driver.state.connected(time.monotonic_ns()):
                    await self._leave(state, mode, on_ground=on_ground)
            except TakenOverError as error:
                self._on_event("warning", f"shutdown: {error}")
                await self._driver.settle()
            except CommandRefusedError as error:
                sticks = self._driver.state.sticks_present
                outcome = setpoint_loss_outcome(self._inputs.parameters, sticks_present=sticks)
                self._on_event("error", f"shutdown: {error}; {outcome.text}")
            finally:
                await self.wait_released()
                if (state := await self._newest_state()).armed:
                    now = without_service_text(state, self._inputs.parameters, has_vehicle=True)
                    self._on_event("warning", f"the service ends, its vehicle is armed: {now}")

    async def _newest_state(self) -> VehicleState:
        """The state with a heartbeat from now on, if one comes: an older one lacks an accepted disarming."""
        now_ns, until_s = time.monotonic_ns(), time.monotonic() + _HEARTBEAT_S
        while (
            (state := self._driver.state).armed and state.heartbeat_ns < now_ns and time.monotonic() < until_s
        ):
            await self._wait_for_input_until(time.monotonic() + self._period_s)
        return state

    async def _leave(self, state: VehicleState, mode: FlightMode | None, *, on_ground: bool) -> None:
        """Disarm on the ground; if that is refused, or in the air, request the mode."""
        if on_ground:
            try:
                await self._driver.disarm(since=state)
                return
            except CommandRefusedError as error:
                if mode is None or isinstance(error, TakenOverError):
                    raise
                self._on_event("warning", f"shutdown: {error}")
        if mode is not None:
            await self._driver.set_mode(mode, timeout_s=2.0, since=state)

    def begin_shutdown(self) -> None:
        """Accept no more commands and stream nothing from now on. `run` continues."""
        self._ending = True
        self._step(time.monotonic_ns())

    async def wait_released(self) -> None:
        """After `begin_shutdown`: release resources, for at most `RELEASE_TIMEOUT_S`."""
        until_s = time.monotonic() + RELEASE_TIMEOUT_S
        try:
            while not self._step(time.monotonic_ns()).released and time.monotonic() < until_s:
                await self._wait_for_input_until(time.monotonic() + self._period_s)
        finally:
            await self._requests.close()
            self._commands.close(ENDING)

    def _step(self, now_ns: int) -> GuidanceOutput:
        seen = self._driver.watch.observe()
        if seen.standstill is not None:
            self._drop_outdated(seen.standstill, now_ns)
        stream = StreamStatus(self._streamer.state, self._streamer.sent_count)
        inputs = self._inputs.assemble(
            now_ns,
            self._driver.state,
            stream,
            answers=self._requests.take_answers(),
            commands=self._commands.take_commands(),
            ending=self._ending,
            standstill=seen.standstill,
        )
        before = self.guidance.behaviour
        begun_ns, used_ns = time.monotonic_ns(), time.thread_time_ns()
        output = self.guidance.step(now_ns, inputs)
        used_ns, passed_ns = time.thread_time_ns() - used_ns, time.monotonic_ns() - begun_ns
        if (behaviour := before or self.guidance.behaviour) is not None:
            self._slow.update(behaviour.name, used_ns, passed_ns, now_ns)
        self._apply(output)
        self._driver.watch.acknowledge(seen)
        if not self._running:  # a step of the shutdown: the next one may be seconds later
            self._driver.watch.end_of_loop()
        context = self._inputs.step_context(self.guidance.gimbal.mounting)
        self._record(now_ns, context, inputs, output)
        return output

    def _drop_outdated(self, standstill: Standstill, now_ns: int) -> None:
        """The computer or the process stood still: nothing from before may take effect."""
        self._on_event("warning", f"{standstill.why}: what was commanded before has ended")
        self._requests.abandon_motion(standstill.why)
        self._driver.abandon(standstill.why)
        self._driver.discard_received()
        self._inputs.discard_received(now_ns)

    def _apply(self, output: GuidanceOutput) -> None:
        apply_output(
            output,
            self._streamer,
            start=self._requests.start,
            cancel=self._requests.cancel,
            send_landing_target=self._driver.send_landing_target,
            send_obstacle_distance=self._driver.send_obstacle_distance,
            request_path=self._inputs.steering.request_path,
        )
        for event in output.events:
            if event.kind not in _ANSWERED:
                self._on_event(event.level, event.message)
        self._commands.on_results(output.results, output.endings)

    async def _wait_for_input_until(self, due_s: float) -> None:
        """Wait for new input, or until a time (CLOCK_MONOTONIC seconds)."""
        try:
            async with asyncio.timeout(due_s - time.monotonic()):
                await self._wake.wait()
        except TimeoutError:
            return
        self._wake.clear()
