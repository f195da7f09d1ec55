"""`driver = "auto"`: the MAVSDK driver for PX4, the pymavlink driver for ArduPilot."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable

from companion.vehicle.autopilot_driver import AutopilotDriver
from companion.vehicle.autopilot_profile import PX4
from companion.vehicle.driver import SystemStatus
from companion.vehicle.gimbal import Address, GimbalAim
from companion.vehicle.landing_target import LandingTarget
from companion.vehicle.setpoint import Setpoint
from companion.vehicle.state import FlightMode, VehicleState

logger = logging.getLogger(__name__)


class AutoDriver:
    """Choose the driver by the autopilot that answers. See `companion.vehicle.driver.Driver`.

    The listening driver passes its open link to the chosen one. So the endpoint is opened once: no other
    program can bind it in between, and the peer address is kept.

    Args:
        listener: not connected; used for every autopilot except PX4.
        make_for_px4: creates the driver for PX4, not connected. It is slow to load, so it is called in a
            thread, and only after a PX4 heartbeat. Its ImportError or OSError is logged, and the listener is
            used.
    """

    def __init__(self, listener: AutopilotDriver, make_for_px4: Callable[[], AutopilotDriver]) -> None:
        self._listener, self._make_for_px4 = listener, make_for_px4
        self._driver = listener

    @property
    def library(self) -> str:
        """See Driver. "auto" until an autopilot heartbeat was received."""
        return self._driver.library if self.state.autopilot is not None else "auto"

    async def connect(self, timeout_s: float) -> None:
        """See Driver."""
        deadline = time.monotonic() + timeout_s
        kind = await self._driver.listen(timeout_s)
        try:
            if kind == PX4:
                await self._use_driver_for_px4()
            await self._driver.start(max(deadline - time.monotonic(), 1.0))
        except BaseException:
            await self.close()
            raise

    async def _use_driver_for_px4(self) -> None:
        try:
            driver = await asyncio.to_thread(self._make_for_px4)
        except (ImportError, OSError) as error:
            logger.warning(
                "%s: MAVSDK cannot be loaded (%s); using the %s driver",
                self._listener.url,
                error,
                self._listener.library,
            )
            return
        driver.adopt_link(self._listener)
        self._driver = driver

    async def close(self) -> None:
        """See Driver."""
        await self._driver.close()
        self._listener.share_subscribers(self._driver)
        self._driver = self._listener

    @property
    def state(self) -> VehicleState:
        """See Driver."""
        return self._driver.state

    def subscribe(self, callback: Callable[[VehicleState], None]) -> Callable[[], None]:
        """See Driver."""
        return self._driver.subscribe(callback)

    @property
    def own_address(self) -> Address:
        """See Driver."""
        return self._driver.own_address

    async def arm(self) -> None:
        """See Driver."""
        await self._driver.arm()

    async def disarm(self) -> None:
        """See Driver."""
        await self._driver.disarm()

    async def set_mode(self, mode: FlightMode, *, timeout_s: float = 3.0) -> None:
        """See Driver."""
        await self._driver.set_mode(mode, timeout_s=timeout_s)

    async def takeoff(self, altitude_m: float) -> None:
        """See Driver."""
        await self._driver.takeoff(altitude_m)

    def send_setpoint(self, setpoint: Setpoint) -> None:
        """See Driver."""
        self._driver.send_setpoint(setpoint)

    def send_landing_target(self, target: LandingTarget) -> None:
        """See Driver."""
        self._driver.send_landing_target(target)

    def send_heartbeat(
        self, status: SystemStatus, *, uptime_s: float | None = None, in_command: bool = False
    ) -> None:
        """See Driver."""
        self._driver.send_heartbeat(status, uptime_s=uptime_s, in_command=in_command)

    async def find_gimbal(self) -> bool:
        """See Driver."""
        return await self._driver.find_gimbal()

    async def take_gimbal(self) -> None:
        """See Driver."""
        await self._driver.take_gimbal()

    async def point_gimbal(self, aim: GimbalAim) -> None:
        """See Driver."""
        await self._driver.point_gimbal(aim)

    async def give_gimbal_back(self) -> None:
        """See Driver."""
        await self._driver.give_gimbal_back()

    async def get_parameter(self, name: str) -> float:
        """See Driver."""
        return await self._driver.get_parameter(name)

    async def set_parameter(self, name: str, value: float) -> None:
        """See Driver."""
        await self._driver.set_parameter(name, value)
