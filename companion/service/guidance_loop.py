"""The loop that steers: moves values between guidance, the streamer, the driver and whoever commands.

The heartbeat and systemd's watchdog are fed from here, so whoever watches them watches the loop that steers.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from typing import Any

from companion.guidance.core import Guidance
from companion.guidance.gimbal.controller import ENDING
from companion.guidance.interface import EventKind, GuidanceOutput, StreamStatus
from companion.service.command_handler import CommandHandler
from companion.service.inputs import InputAssembler
from companion.service.other_commanders import OtherCommanders
from companion.service.requests import RequestRunner
from companion.vehicle.driver import Driver
from companion.vehicle.streamer import Streamer

# Told with the command's own answer.
_ANSWERED = (EventKind.REFUSED, EventKind.ENDED, EventKind.STARTED)
# A step that takes longer holds up the setpoints of the 50 Hz stream: processor time, and time that passed
# (longer, because other programs may have the processor).
SLOW_STEP_NS, STALLED_STEP_NS = 5_000_000, 50_000_000
# Of one behaviour it is said so often.
SLOW_AGAIN_NS = 10_000_000_000
# The end of the service waits this long for what is held to be given back.
RELEASE_TIMEOUT_S = 3.0


class GuidanceLoop:
    """Steps guidance at its rate, and at once when something has come that it should know.

    Args:
        rate_hz: of guidance.
        on_event: called with (level, text). on_step: called after every step with its time.
        others: who else commands the vehicle.
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
    ) -> None:
        self.guidance, self._inputs = guidance, inputs
        self._driver, self._streamer = driver, streamer
        self._period_s = 1 / rate_hz
        self._on_event, self._on_step = on_event, on_step
        self._wake = asyncio.Event()
        self._seen = False
        self._requests = RequestRunner(driver, self._wake.set)
        self._commands = CommandHandler(
            lambda identifier, text: inputs.read_command(
                identifier, text, driver.state, guidance.check_requirements
            ),
            self._wake.set,
            on_event,
            check_requirements=lambda command: others.check_requirements(
                command, driver.state, in_command=guidance.in_command, now_ns=time.monotonic_ns()
            ),
        )
        self._ending = False
        self._slow: tuple[str, int] = ("", 0)

    async def execute(self, text: str) -> dict[str, Any]:
        """Do what a command says; see `Service.command`."""
        return await self._commands.execute(text)

    def on_seen(self) -> None:
        """The steering camera has seen something: the setpoint that follows from it leaves at once."""
        self._seen = True
        self._wake.set()

    async def run(self) -> None:
        """Until cancelled."""
        while True:
            now_ns = time.monotonic_ns()
            seen, self._seen = self._seen, False
            self._step(now_ns)
            if seen:
                self._streamer.send_now(now_ns)
            self._on_step(now_ns)
            await self._something_new_until(now_ns / 1e9 + self._period_s)

    def begin_to_end(self) -> None:
        """From now on take no commands and stream nothing. `run`, where it still runs, goes on."""
        self._ending = True
        self._step(time.monotonic_ns())

    async def until_released(self) -> None:
        """After `begin_to_end`: give back what is held, and wait for that, but not for ever."""
        until_s = time.monotonic() + RELEASE_TIMEOUT_S
        try:
            while not self._step(time.monotonic_ns()).released and time.monotonic() < until_s:
                await self._something_new_until(time.monotonic() + self._period_s)
        finally:
            await self._requests.close()
            self._commands.close(ENDING)

    def _step(self, now_ns: int) -> GuidanceOutput:
        stream = StreamStatus(self._streamer.state, self._streamer.sent_count)
        inputs = self._inputs.assemble(
            now_ns,
            self._driver.state,
            stream,
            answers=self._requests.take_answers(),
            commands=self._commands.take_commands(),
            ending=self._ending,
        )
        name = "" if self.guidance.behaviour is None else self.guidance.behaviour.name
        begun_ns, used_ns = time.monotonic_ns(), time.thread_time_ns()
        output = self.guidance.step(now_ns, inputs)
        self._warn_slow(name, time.thread_time_ns() - used_ns, time.monotonic_ns() - begun_ns, now_ns)
        self._apply(output)
        return output

    def _warn_slow(self, before: str, used_ns: int, passed_ns: int, now_ns: int) -> None:
        """Name a behaviour whose update is slow (`before`: the one of before the step, if there was one).

        While an update blocks nothing is sent, and the autopilot's failsafe acts."""
        name = before or ("" if self.guidance.behaviour is None else self.guidance.behaviour.name)
        if not name or (used_ns < SLOW_STEP_NS and passed_ns < STALLED_STEP_NS):
            return
        last, told_ns = self._slow
        if name != last or now_ns - told_ns >= SLOW_AGAIN_NS:
            self._slow = (name, now_ns)
            text = f"{used_ns / 1e6:.0f} ms of processor time, {passed_ns / 1e6:.0f} ms in all"
            self._on_event("warning", f"{name}: slow update ({text}); at most 5 ms are expected")

    def _apply(self, output: GuidanceOutput) -> None:
        if output.setpoint is None:
            self._streamer.stop()
        else:
            self._streamer.submit(output.setpoint)
        for identifier in output.cancelled:
            self._requests.cancel(identifier)
        for request in output.requests:
            self._requests.start(request)
        if output.landing_target is not None:
            self._driver.send_landing_target(output.landing_target)
        for event in output.events:
            if event.kind not in _ANSWERED:
                self._on_event(event.level, event.message)
        for result in output.results:
            self._commands.on_result(result)

    async def _something_new_until(self, due_s: float) -> None:
        """Return when something has come, or at that time (CLOCK_MONOTONIC seconds)."""
        try:
            async with asyncio.timeout(due_s - time.monotonic()):
                await self._wake.wait()
        except TimeoutError:
            return
        self._wake.clear()
