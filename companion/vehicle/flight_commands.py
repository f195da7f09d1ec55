"""Arming, modes and take-off: requested from the autopilot, confirmed by its telemetry."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import time
from collections.abc import Awaitable, Callable

from companion.host.tasks import spawn
from companion.vehicle.autopilot_profile import HOME_POSITION_ID
from companion.vehicle.driver import CommandRefusedError, TakenOverError
from companion.vehicle.mav_result import result_name
from companion.vehicle.mode_changes import (
    ARM_DISARM,
    DO_SET_MODE,
    MODE_FLAG_CUSTOM,
    NAV_TAKEOFF,
    SHOWN_TIMEOUT_S,
    Ending,
    ModeChange,
    ModeChanges,
)
from companion.vehicle.px4_modes import among_modes
from companion.vehicle.report import words_of
from companion.vehicle.state import FlightMode, VehicleState
from companion.vehicle.telemetry import Fields
from companion.vehicle.telemetry_state import TelemetryState

logger = logging.getLogger(__name__)

_REQUEST_MESSAGE = 512
_RUN_PREARM_CHECKS = 401
# How long to wait for the first report of a failing check, which a busy computer gets late, and then for the
# others.
_FIRST_REASON_S, _REASONS_S = 2.0, 0.5
_HOME_TIMEOUT_S = 3.0
# Between two looks at the clock of a pending change.
_TICK_S = 0.05


class FlightCommands:
    """The flight commands of a driver. All methods raise CommandRefusedError; see Driver.

    Args:
        url: of the link, for messages. telemetry: the autopilot's state.
        command: sends one command with its parameters, repeated until answered; returns the MAV_RESULT.
        send: sends one command once: number, parameters, confirmation. Raises CommandRefusedError without a
            link.
        ack_is_ours: whether a COMMAND_ACK with these fields is addressed to us.
        no_answer: builds the error for a command without an answer.
        clock_ns: of the driver's `watch`: it counts a suspend.
    """

    def __init__(
        self,
        url: object,
        telemetry: TelemetryState,
        command: Callable[..., Awaitable[int]],
        send: Callable[[int, tuple[float, ...], int], None],
        ack_is_ours: Callable[[Fields], bool],
        no_answer: Callable[[str], CommandRefusedError],
        clock_ns: Callable[[], int],
    ) -> None:
        self._url, self._telemetry = url, telemetry
        self._command, self._ack_is_ours, self._no_answer = command, ack_is_ours, no_answer
        self._changes = ModeChanges(
            send, lambda custom_mode: telemetry.profile.mode_parameters(custom_mode), self._on_restored
        )
        self._clock_ns = clock_ns
        self._pending: set[ModeChange] = set()
        self._restoring: set[asyncio.Task[None]] = set()
        telemetry.watch(self._watch)

    def _watch(self, name: str, fields: Fields) -> None:
        """Pass on what the vehicle sends, in its order of arrival."""
        if name in ("HEARTBEAT", "CURRENT_MODE"):
            telemetry = self._telemetry
            self._changes.on_report(telemetry.state, self._clock_ns(), telemetry.answered_ns)
        elif name == "COMMAND_ACK" and self._ack_is_ours(fields):
            self._changes.on_acknowledgement(fields["command"], fields["result"], self._clock_ns())

    def abandon(self, why: str) -> None:
        """End what is pending, and watch no more for its effect."""
        for change in list(self._pending):
            self._changes.drop(change, f"{change.what}: {why}")
        self._changes.forget()

    async def close(self) -> None:
        """End what is pending."""
        self.abandon(f"{self._url}: the link was closed before an answer was received")
        for task in self._restoring:
            task.cancel()
        await asyncio.gather(*self._restoring, return_exceptions=True)

    @property
    def in_transit(self) -> bool:
        """Whether a change is pending, or an acknowledgement to our address may still arrive."""
        return self._changes.in_transit(self._clock_ns())

    async def settled(self) -> None:
        """Wait until no message of ours can arrive after another's change of the mode."""
        telemetry = self._telemetry

        def settled() -> bool:
            return self._changes.settled(self._clock_ns(), telemetry.answered_ns)

        while not await telemetry.until(settled, _TICK_S):
            pass

    def _on_restored(self, change: ModeChange, text: str) -> None:
        """Our message has overridden a pilot's change, which is requested again."""
        logger.warning("%s: %s", self._url, text)
        self._telemetry.on_mode_restored(text)
        task = spawn(self._follow(change), f"mode of {self._url}")
        self._restoring.add(task)
        task.add_done_callback(self._restoring.discard)

    async def _change(self, change: ModeChange) -> None:
        """Request a change until it ends. Raises CommandRefusedError, except for a rejection."""
        telemetry = self._telemetry
        self._changes.begin(change, telemetry.state, self._clock_ns())
        await self._follow(change)
        if change.ending is Ending.NO_ANSWER:
            raise self._no_answer(change.why)
        if change.ending is Ending.TAKEN_OVER:
            raise TakenOverError(change.why)
        if change.ending in (Ending.DROPPED, Ending.NOT_SHOWN):
            raise CommandRefusedError(change.why)

    async def _follow(self, change: ModeChange) -> None:
        """Let time pass for a change until it has ended."""
        telemetry, boots = self._telemetry, self._telemetry.restart_count
        self._pending.add(change)
        try:
            while not await telemetry.until(lambda: change.ending is not None, _TICK_S):
                now_ns = self._clock_ns()
                if telemetry.restart_count != boots or not telemetry.state.connected(now_ns):
                    self._changes.drop(change, f"{change.what}: the autopilot has restarted or is silent")
                self._changes.tick(now_ns)
        finally:
            self._pending.discard(change)
            self._changes.drop(change, f"{change.what} was cancelled")

    async def arm_or_disarm(
        self,
        armed: bool,
        system_id: int | None,
        *,
        since: VehicleState | None = None,
        valid_until_ns: int | None = None,
    ) -> None:
        """Arm or disarm, and return when the vehicle reports it. `system_id`: for messages."""
        telemetry = self._telemetry
        if armed and telemetry.two_autopilots(self._clock_ns()):
            raise CommandRefusedError(
                f"{self._url}: two autopilots answer as system {system_id}: arming refused; "
                "set a unique MAV_SYS_ID on each"
            )
        asked_ns = time.monotonic_ns()
        parameters = (1.0 if armed else 0.0,)
        word = "arming" if armed else "disarming"
        change = ModeChange(word, ARM_DISARM, parameters, since or telemetry.state, None, armed)
        change.valid_until_ns = valid_until_ns
        await self._change(change)
        if change.result is not None:
            if not armed:
                reason = f"it is {telemetry.state.landed.replace('_', ' ')}"
            elif checks := await self._failing_checks(asked_ns):
                reason = checks
            elif telemetry.state.ready_to_arm:
                reason = f"in mode {telemetry.state.mode}"
            else:
                reason = f"its pre-arm checks fail in mode {telemetry.state.mode}"
            raise CommandRefusedError(f"{change.why}: {reason}")

    async def _failing_checks(self, asked_ns: int) -> str:
        """Return the autopilot's texts of the failing pre-arm checks; empty if it reports none."""
        telemetry = self._telemetry
        if telemetry.profile.has_events:
            # PX4 reports its checks when they change, and all of them after RUN_PREARM_CHECKS.
            with contextlib.suppress(CommandRefusedError):
                await self._command(_RUN_PREARM_CHECKS)
        if await telemetry.until(lambda: bool(self._checks_since(asked_ns)), _FIRST_REASON_S):
            await telemetry.until(lambda: False, _REASONS_S)
        return self._checks_since(asked_ns)

    def _checks_since(self, asked_ns: int) -> str:
        state = self._telemetry.state
        failing = [
            report
            for report in state.reports
            if report.stamp_ns >= asked_ns and report.is_check and among_modes(state.mode, report.modes)
        ]
        return words_of(sorted(failing, key=lambda report: report.level))

    async def set_mode(
        self,
        mode: FlightMode,
        *,
        timeout_s: float = SHOWN_TIMEOUT_S,
        since: VehicleState | None = None,
        valid_until_ns: int | None = None,
    ) -> None:
        """Request a mode, and return when the vehicle reports it."""
        telemetry = self._telemetry
        custom_mode = telemetry.profile.mode_request(mode, telemetry.state)
        parameters = (MODE_FLAG_CUSTOM, *telemetry.profile.mode_parameters(custom_mode))
        before = since or telemetry.state
        change = ModeChange(f"mode {mode}", DO_SET_MODE, parameters, before, custom_mode)
        change.timeout_s, change.valid_until_ns = timeout_s, valid_until_ns
        try:
            await self._change(change)
        except CommandRefusedError:
            telemetry.profile.clear_request()
            raise
        if change.result is not None:
            telemetry.profile.clear_request()
            hint = " (is a setpoint stream running?)" if mode is FlightMode.OFFBOARD else ""
            raise CommandRefusedError(f"{change.why}{hint}: its mode is {telemetry.state.mode}")

    async def takeoff(
        self, altitude_m: float, *, since: VehicleState | None = None, valid_until_ns: int | None = None
    ) -> None:
        """Request the autopilot's own take-off to a height above home, metres."""
        telemetry = self._telemetry
        before = since or telemetry.state
        if not (math.isfinite(altitude_m) and altitude_m > 0.0):
            raise CommandRefusedError(f"the take-off altitude must be above 0 m, got {altitude_m}")
        if telemetry.profile.takeoff_needs_home:
            await self._update_home()
        parameters = telemetry.profile.takeoff_parameters(altitude_m, telemetry.state)
        mode = telemetry.profile.takeoff_mode()
        change = ModeChange("take-off", NAV_TAKEOFF, parameters, before, mode, done_by_acknowledgement=True)
        change.valid_until_ns = valid_until_ns
        await self._change(change)
        if change.result is not None:
            result = result_name(change.result)
            raise CommandRefusedError(
                f"the vehicle refused to take off ({result}) in mode {telemetry.state.mode}"
            )
        for name, fields in telemetry.profile.on_takeoff_accepted():
            telemetry.apply(name, fields)

    async def _update_home(self) -> None:
        """Request HOME_POSITION: PX4 moves home when it arms, and sends it every two seconds only."""
        telemetry, received = self._telemetry, False

        def watch(name: str, _fields: Fields) -> None:
            nonlocal received
            received |= name == "HOME_POSITION"

        async with telemetry.watching(watch):
            result = await self._command(_REQUEST_MESSAGE, HOME_POSITION_ID)
            if not await telemetry.until(lambda: received, _HOME_TIMEOUT_S):
                raise CommandRefusedError(
                    "home position not received: take-off needs home's altitude "
                    f"({result_name(result)}; no position estimate yet?)"
                )
