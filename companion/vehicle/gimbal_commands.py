"""Finding a gimbal's manager in the autopilot, and what is asked of it: control, and where to look.

What is asked goes as commands, not as GIMBAL_MANAGER_SET_PITCHYAW: PX4 does not take that message, and a
command is answered, with DENIED when somebody else has taken control.
"""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Awaitable, Callable

from companion.vehicle.driver import CommandRefusedError
from companion.vehicle.gimbal import Address, GimbalAim
from companion.vehicle.mav_result import ACCEPTED, result_name
from companion.vehicle.telemetry_state import TelemetryState

logger = logging.getLogger(__name__)

_SET_MESSAGE_INTERVAL, _REQUEST_MESSAGE = 511, 512
PITCHYAW, CONFIGURE = 1000, 1001  # MAV_CMD_DO_GIMBAL_MANAGER_…
_INFORMATION_ID = 280
# GIMBAL_DEVICE_ATTITUDE_STATUS, as often as the vehicle's own attitude; GIMBAL_MANAGER_STATUS.
_RATES_HZ = {285: 50.0, 281: 5.0}
_TOLD_TIMEOUT_S = 1.0
_PAUSE_S = 5.0
UNCHANGED, RELEASE = -1.0, -3.0
# GIMBAL_MANAGER_FLAGS: roll and pitch against the horizon, yaw against the nose.
_ROLL_LOCK, _PITCH_LOCK, _YAW_IN_VEHICLE_FRAME = 4, 8, 32
FOLLOWING_NOSE = float(_ROLL_LOCK | _PITCH_LOCK | _YAW_IN_VEHICLE_FRAME)


class GimbalCommands:
    """What a driver asks of its autopilot's gimbal manager.

    Args:
        url: of the link, for messages. telemetry: what the autopilot shows.
        command: sends one command with its parameters; the MAV_RESULT.
        own_address: from whom our commands come.
    """

    def __init__(
        self,
        url: object,
        telemetry: TelemetryState,
        command: Callable[..., Awaitable[int]],
        own_address: Address,
    ) -> None:
        self._url, self._telemetry, self._command = url, telemetry, command
        self._own_address = own_address
        self._finding = asyncio.Lock()
        self._wanted = False

    async def find(self) -> bool:
        """Ask for the manager and, where one answers, for its streams. False: none answers."""
        async with self._finding:
            try:
                if not self._known():
                    result = await self._command(_REQUEST_MESSAGE, _INFORMATION_ID)
                    if result != ACCEPTED or not await self._telemetry.until(self._known, _TOLD_TIMEOUT_S):
                        return False
                    logger.info("%s: the autopilot has a gimbal", self._url)
                for message_id, rate_hz in _RATES_HZ.items():
                    result = await self._command(_SET_MESSAGE_INTERVAL, message_id, round(1e6 / rate_hz))
                    if result != ACCEPTED:
                        logger.info(
                            "%s: the autopilot does not send message %d at the rate wanted (%s)",
                            self._url,
                            message_id,
                            result_name(result),
                        )
            except CommandRefusedError as error:
                logger.debug("%s: looking for a gimbal: %s", self._url, error)
            return self._known()

    def look_for_one(self) -> None:
        """Let `keep` ask soon: the link has opened, or the autopilot has restarted."""
        self._wanted = True

    async def keep(self) -> None:
        """Ask when told to, and when a gimbal is heard that has not told what it can do; for ever.

        Not in the task that watches the link: whoever does not answer takes seconds not to.
        """
        while True:
            await self._telemetry.until(
                lambda: self._wanted or (self._telemetry.state.gimbal is not None and not self._known()), None
            )
            self._wanted = False
            if not await self.find():
                await asyncio.sleep(_PAUSE_S)

    async def take(self) -> None:
        """Take primary control. Raises CommandRefusedError."""
        system, component = self._own_address
        await self._demand(
            "control of the gimbal", CONFIGURE, float(system), float(component), UNCHANGED, UNCHANGED
        )

    async def give_back(self) -> None:
        """Give primary control back, if it is ours. Raises CommandRefusedError."""
        await self._demand("to give the gimbal back", CONFIGURE, RELEASE, RELEASE, UNCHANGED, UNCHANGED)

    async def point(self, aim: GimbalAim) -> None:
        """Let it look there. Raises CommandRefusedError, also when somebody else has control of it."""
        pitch, yaw = math.degrees(aim.pitch_rad), math.degrees(aim.yaw_rad)
        nan = math.nan
        await self._demand("to point the gimbal", PITCHYAW, pitch, yaw, nan, nan, FOLLOWING_NOSE)

    def _known(self) -> bool:
        gimbal = self._telemetry.state.gimbal
        return gimbal is not None and gimbal.information_ns > 0

    async def _demand(self, what: str, number: int, *parameters: float) -> None:
        gimbal = self._telemetry.state.gimbal
        device = 0.0 if gimbal is None else float(gimbal.device)
        filled = (*parameters, *[0.0] * (6 - len(parameters)), device)
        result = await self._command(number, *filled)
        if result != ACCEPTED:
            raise CommandRefusedError(f"the vehicle refused {what} ({result_name(result)})")
