"""Arming, modes and take-off: requested from the autopilot, confirmed by its telemetry."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Awaitable, Callable

from companion.vehicle.autopilot_profile import HOME_POSITION_ID
from companion.vehicle.driver import CommandRefusedError
from companion.vehicle.mav_result import ACCEPTED, IN_PROGRESS, result_name
from companion.vehicle.px4_modes import among_modes
from companion.vehicle.report import words_of
from companion.vehicle.state import FlightMode
from companion.vehicle.telemetry import Fields
from companion.vehicle.telemetry_state import TelemetryState

_MODE_FLAG_CUSTOM = 1
_DO_SET_MODE = 176
_NAV_TAKEOFF = 22
_COMPONENT_ARM_DISARM = 400
_REQUEST_MESSAGE = 512
_RUN_PREARM_CHECKS = 401
# How long to wait for the first report of a failing check, which a busy computer gets late, and then for the
# others.
_FIRST_REASON_S, _REASONS_S = 2.0, 0.5
_SHOWN_TIMEOUT_S = 3.0  # HEARTBEAT is sent once a second


class FlightCommands:
    """The flight commands of a driver. All methods raise CommandRefusedError; see Driver.

    Args:
        url: of the link, for messages. telemetry: the autopilot's state.
        command: sends one command with its parameters and returns the MAV_RESULT.
        ack_is_ours: whether a COMMAND_ACK with these fields is addressed to us.
    """

    def __init__(
        self,
        url: object,
        telemetry: TelemetryState,
        command: Callable[..., Awaitable[int]],
        ack_is_ours: Callable[[Fields], bool],
    ) -> None:
        self._url, self._telemetry = url, telemetry
        self._command, self._ack_is_ours = command, ack_is_ours

    async def arm_or_disarm(self, armed: bool, system_id: int | None) -> None:
        """Arm or disarm, and return when the vehicle reports it. `system_id`: for messages."""
        telemetry = self._telemetry
        word = "arm" if armed else "disarm"
        if armed and telemetry.two_autopilots(time.monotonic_ns()):
            raise CommandRefusedError(
                f"{self._url}: two autopilots answer as system {system_id}: arming refused; "
                "set a unique MAV_SYS_ID on each"
            )
        asked_ns = time.monotonic_ns()
        result = await self._command(_COMPONENT_ARM_DISARM, 1.0 if armed else 0.0)
        if result != ACCEPTED:
            if not armed:
                reason = f"it is {telemetry.state.landed.replace('_', ' ')}"
            elif checks := await self._failing_checks(asked_ns):
                reason = checks
            elif telemetry.state.ready_to_arm:
                reason = f"in mode {telemetry.state.mode}"
            else:
                reason = f"its pre-arm checks fail in mode {telemetry.state.mode}"
            raise CommandRefusedError(f"the vehicle refused to {word} ({result_name(result)}): {reason}")
        if not await telemetry.until(lambda: telemetry.state.armed is armed, _SHOWN_TIMEOUT_S):
            raise CommandRefusedError(
                f"the vehicle accepted to {word} but did not report it within {_SHOWN_TIMEOUT_S:g} s"
            )

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
        reports = [
            report
            for report in state.reports
            if report.stamp_ns >= asked_ns and among_modes(state.mode, report.modes)
        ]
        failing = [report for report in reports if report.is_check]
        return words_of(failing or [report for report in reports if report.is_listed_check])

    async def set_mode(self, mode: FlightMode, *, timeout_s: float = 3.0) -> None:
        """Request a mode, and return when the vehicle reports it."""
        telemetry = self._telemetry
        shown_mode, main, sub = telemetry.profile.mode_request(mode, telemetry.state)
        rejected: list[int] = []

        def watch(name: str, fields: Fields) -> None:
            # PX4 >= 1.16: the first acknowledgement always accepts, the second is the Commander's.
            if name != "COMMAND_ACK" or fields["command"] != _DO_SET_MODE or not self._ack_is_ours(fields):
                return
            if fields["result"] not in (ACCEPTED, IN_PROGRESS):
                rejected.append(fields["result"])

        asked_ns = time.monotonic_ns()
        deadline = time.monotonic() + timeout_s

        def shown() -> bool:
            return telemetry.mode_ns > asked_ns and telemetry.state.mode is shown_mode

        async with telemetry.watching(watch):
            result = await self._command(_DO_SET_MODE, _MODE_FLAG_CUSTOM, main, sub)
            if result != ACCEPTED:
                rejected.append(result)
            await telemetry.until(lambda: bool(rejected) or shown(), max(deadline - time.monotonic(), 0.0))
        if rejected:
            telemetry.profile.clear_request()
            hint = " (is a setpoint stream running?)" if mode is FlightMode.OFFBOARD else ""
            raise CommandRefusedError(
                f"the vehicle refused mode {mode} ({result_name(rejected[0])}){hint}: "
                f"its mode is {telemetry.state.mode}"
            )
        if not shown():
            telemetry.profile.clear_request()
            raise CommandRefusedError(
                f"the vehicle did not enter mode {mode} within {timeout_s:g} s: "
                f"its mode is {telemetry.state.mode}"
            )

    async def takeoff(self, altitude_m: float) -> None:
        """Request the autopilot's own take-off to a height above home, metres."""
        telemetry = self._telemetry
        if not (math.isfinite(altitude_m) and altitude_m > 0.0):
            raise CommandRefusedError(f"the take-off altitude must be above 0 m, got {altitude_m}")
        if telemetry.profile.takeoff_needs_home:
            await self._update_home()
        result = await self._command(
            _NAV_TAKEOFF, *telemetry.profile.takeoff_parameters(altitude_m, telemetry.state)
        )
        if result != ACCEPTED:
            raise CommandRefusedError(
                f"the vehicle refused to take off ({result_name(result)}) in mode {telemetry.state.mode}"
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
            if not await telemetry.until(lambda: received, _SHOWN_TIMEOUT_S):
                raise CommandRefusedError(
                    "home position not received: take-off needs home's altitude "
                    f"({result_name(result)}; no position estimate yet?)"
                )
