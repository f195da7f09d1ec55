"""Commands to the autopilot's gimbal manager: discovery, primary control, pointing.

Aims are sent as commands, not as GIMBAL_MANAGER_SET_PITCHYAW: PX4 does not support that message, and a
command is answered, with DENIED when another component has primary control.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Awaitable, Callable

from companion.vehicle.driver import CommandRefusedError
from companion.vehicle.gimbal import GimbalAim, YawFrame
from companion.vehicle.mav_result import ACCEPTED, result_name
from companion.vehicle.telemetry_state import TelemetryState

logger = logging.getLogger(__name__)

_SET_MESSAGE_INTERVAL, _REQUEST_MESSAGE = 511, 512
PITCHYAW, CONFIGURE = 1000, 1001  # MAV_CMD_DO_GIMBAL_MANAGER_…
_INFORMATION_ID = 280
# GIMBAL_DEVICE_ATTITUDE_STATUS, at the rate of the vehicle's attitude; GIMBAL_MANAGER_STATUS.
_RATES_HZ = {285: 50.0, 281: 5.0}
_INFORMATION_TIMEOUT_S = 1.0
_PAUSE_S = 5.0
UNCHANGED, RELEASE = -1.0, -3.0
# GIMBAL_MANAGER_FLAGS: roll and pitch relative to the horizon, yaw relative to the nose or to north.
_ROLL_LOCK, _PITCH_LOCK, _YAW_LOCK, _YAW_IN_VEHICLE_FRAME, _YAW_IN_EARTH_FRAME = 4, 8, 16, 32, 64
_YAW_FLAGS = {YawFrame.NOSE: _YAW_IN_VEHICLE_FRAME, YawFrame.NORTH: _YAW_LOCK | _YAW_IN_EARTH_FRAME}


def pitchyaw_parameters(aim: GimbalAim) -> tuple[float, ...]:
    """The first five parameters of DO_GIMBAL_MANAGER_PITCHYAW, without rates."""
    flags = _ROLL_LOCK | _PITCH_LOCK | _YAW_FLAGS[aim.yaw_frame]
    return (math.degrees(aim.pitch_rad), math.degrees(aim.yaw_rad), math.nan, math.nan, float(flags))


class GimbalCommands:
    """The gimbal commands of a driver.

    Args:
        url: of the link, for messages. telemetry: the autopilot's state.
        command: sends one command with its parameters and returns the MAV_RESULT.
    """

    def __init__(
        self,
        url: object,
        telemetry: TelemetryState,
        command: Callable[..., Awaitable[int]],
    ) -> None:
        self._url, self._telemetry, self._command = url, telemetry, command
        self._finding = asyncio.Lock()
        self._search_requested = False

    async def find(self) -> bool:
        """Request the manager's information and, if it answers, its streams. False: no answer."""
        async with self._finding:
            try:
                if not self._known():
                    result = await self._command(_REQUEST_MESSAGE, _INFORMATION_ID)
                    if result != ACCEPTED or not await self._telemetry.until(
                        self._known, _INFORMATION_TIMEOUT_S
                    ):
                        return False
                    logger.info("%s: gimbal manager found", self._url)
                for message_id, rate_hz in _RATES_HZ.items():
                    result = await self._command(_SET_MESSAGE_INTERVAL, message_id, round(1e6 / rate_hz))
                    if result != ACCEPTED:
                        logger.info(
                            "%s: requested rate of message %d refused (%s)",
                            self._url,
                            message_id,
                            result_name(result),
                        )
            except CommandRefusedError as error:
                logger.debug("%s: gimbal discovery: %s", self._url, error)
            return self._known()

    def request_search(self) -> None:
        """Let `run` search again: the link has opened, or the autopilot has restarted."""
        self._search_requested = True

    async def run(self) -> None:
        """Search on request, and when a gimbal reports without known information; until cancelled.

        Not in the task that supervises the link: a missing answer takes seconds to time out.
        """

        def search_due() -> bool:
            return self._search_requested or (self._telemetry.state.gimbal is not None and not self._known())

        while True:
            await self._telemetry.until(search_due, None)
            self._search_requested = False
            if not await self.find():
                await asyncio.sleep(_PAUSE_S)

    async def take_control(self) -> None:
        """Take primary control. Raises CommandRefusedError."""
        system, component = self._telemetry.state.own_address
        await self._send_command(
            "control of the gimbal", CONFIGURE, float(system), float(component), UNCHANGED, UNCHANGED
        )

    async def release_control(self) -> None:
        """Release primary control if it is ours. Raises CommandRefusedError."""
        await self._send_command("to release the gimbal", CONFIGURE, RELEASE, RELEASE, UNCHANGED, UNCHANGED)

    async def point(self, aim: GimbalAim) -> None:
        """Point the gimbal. Raises CommandRefusedError, also when another component has control."""
        await self._send_command("to point the gimbal", PITCHYAW, *pitchyaw_parameters(aim))

    def _known(self) -> bool:
        gimbal = self._telemetry.state.gimbal
        return gimbal is not None and gimbal.information_ns > 0

    async def _send_command(self, what: str, number: int, *parameters: float) -> None:
        gimbal = self._telemetry.state.gimbal
        device = 0.0 if gimbal is None else float(gimbal.device)
        filled = (*parameters, *[0.0] * (6 - len(parameters)), device)
        result = await self._command(number, *filled)
        if result != ACCEPTED:
            raise CommandRefusedError(f"the vehicle refused {what} ({result_name(result)})")
