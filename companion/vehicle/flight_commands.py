"""Arming, modes and take-off: asked of an autopilot, and believed when it shows them."""

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
_REASONS_S = 0.5  # so long what it says of its checks is waited for
_SHOWN_TIMEOUT_S = 3.0  # HEARTBEAT comes once a second


class FlightCommands:
    """What a driver asks of its autopilot. All methods raise CommandRefusedError; see Driver.

    Args:
        url: of the link, for messages. telemetry: what the autopilot shows.
        command: sends one command with its parameters; the MAV_RESULT.
        ack_is_ours: whether a COMMAND_ACK with these fields answers us.
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
        """Return when the vehicle shows it. `system_id`: whose."""
        telemetry = self._telemetry
        word = "arm" if armed else "disarm"
        if armed and telemetry.two_autopilots(time.monotonic_ns()):
            raise CommandRefusedError(
                f"{self._url}: two autopilots answer as system {system_id}, so neither is armed; "
                "give each an id of its own (MAV_SYS_ID)"
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
                f"the vehicle accepted to {word} but does not show it after {_SHOWN_TIMEOUT_S:g} s"
            )

    async def _failing_checks(self, asked_ns: int) -> str:
        """What keeps it from arming, in its own words; empty if it does not say."""
        telemetry = self._telemetry
        if telemetry.profile.has_events:
            # PX4 tells its checks when they change, and all of them when it is asked to run them.
            with contextlib.suppress(CommandRefusedError):
                await self._command(_RUN_PREARM_CHECKS)
        await telemetry.until(lambda: False, _REASONS_S)
        state = telemetry.state
        said = [
            one for one in state.reports if one.stamp_ns >= asked_ns and among_modes(state.mode, one.modes)
        ]
        # PX4 tells as information what keeps it from some modes alone, such as a missing mission.
        failing = [one for one in said if one.of_a_check] or [one for one in said if one.of_some_modes]
        return words_of(failing)

    async def set_mode(self, mode: FlightMode, *, timeout_s: float = 3.0) -> None:
        """Return when the vehicle shows the mode."""
        telemetry = self._telemetry
        shown_mode, main, sub = telemetry.profile.mode_request(mode, telemetry.state)
        refusals: list[int] = []

        def watch(name: str, fields: Fields) -> None:
            # PX4 >= 1.16: the first acknowledgement always accepts, the second is the Commander's.
            if name != "COMMAND_ACK" or fields["command"] != _DO_SET_MODE or not self._ack_is_ours(fields):
                return
            if fields["result"] not in (ACCEPTED, IN_PROGRESS):
                refusals.append(fields["result"])

        asked_ns = time.monotonic_ns()
        deadline = time.monotonic() + timeout_s

        def shown() -> bool:
            return telemetry.mode_ns > asked_ns and telemetry.state.mode is shown_mode

        async with telemetry.watching(watch):
            result = await self._command(_DO_SET_MODE, _MODE_FLAG_CUSTOM, main, sub)
            if result != ACCEPTED:
                refusals.append(result)
            await telemetry.until(lambda: bool(refusals) or shown(), max(deadline - time.monotonic(), 0.0))
        if refusals:
            telemetry.profile.forget()
            hint = " (is a setpoint stream running?)" if mode is FlightMode.OFFBOARD else ""
            raise CommandRefusedError(
                f"the vehicle refused mode {mode} ({result_name(refusals[0])}){hint}: "
                f"it shows {telemetry.state.mode}"
            )
        if not shown():
            telemetry.profile.forget()
            raise CommandRefusedError(
                f"the vehicle did not enter mode {mode} within {timeout_s:g} s: "
                f"it shows {telemetry.state.mode}"
            )

    async def takeoff(self, altitude_m: float) -> None:
        """The autopilot's own take-off, to a height above home."""
        telemetry = self._telemetry
        if not (math.isfinite(altitude_m) and altitude_m > 0.0):
            raise CommandRefusedError(f"a take-off altitude must be above 0 m, got {altitude_m}")
        if telemetry.profile.takes_off_by_home:
            await self._on_home_position()
        result = await self._command(
            _NAV_TAKEOFF, *telemetry.profile.takeoff_parameters(altitude_m, telemetry.state)
        )
        if result != ACCEPTED:
            raise CommandRefusedError(
                f"the vehicle refused to take off ({result_name(result)}) in mode {telemetry.state.mode}"
            )
        for told, fields in telemetry.profile.takes_off():
            telemetry.take_in(told, fields)

    async def _on_home_position(self) -> None:
        """Let home be told as it is now: PX4 moves it when it arms, and tells it every two seconds only."""
        telemetry, told = self._telemetry, False

        def watch(name: str, _fields: Fields) -> None:
            nonlocal told
            told |= name == "HOME_POSITION"

        async with telemetry.watching(watch):
            result = await self._command(_REQUEST_MESSAGE, HOME_POSITION_ID)
            if not await telemetry.until(lambda: told, _SHOWN_TIMEOUT_S):
                raise CommandRefusedError(
                    "take-off needs home's altitude, and the vehicle has not told it "
                    f"({result_name(result)}; no position yet?)"
                )
